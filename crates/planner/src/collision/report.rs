//! Contacts, by name.

use std::fmt;

use glamx::DVec3;

/// Two things in contact, by index in the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Pair {
    /// Two links (indices of [`super::Scene::links`]).
    Links(usize, usize),
    /// A link and an obstacle (index of [`super::Scene::obstacles`]).
    Obstacle(usize, usize),
}

/// What the distance of a pair is measured by.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Measured {
    /// The shapes themselves.
    #[default]
    Shapes,
    /// Their triangles touch; how deep is that of their convex hulls: no less than the true depth.
    Depth,
    /// A convex hull that is used in place of a mesh: the mesh itself may be farther away.
    Hull,
}

/// A pair, its distance and closest points.
#[derive(Debug, Clone, PartialEq)]
pub struct Contact {
    /// The pair, by index.
    pub pair: Pair,
    /// Name of the link.
    pub link: String,
    /// Name of the other link or obstacle.
    pub other: String,
    /// Distance of their surfaces, less the padding [m]; negative: penetration depth.
    pub distance: f64,
    /// Closest point on the link, in the world's frame [m].
    pub on_link: DVec3,
    /// Closest point on the other.
    pub on_other: DVec3,
    /// What they are measured by.
    pub by: Measured,
}

impl Contact {
    /// Returns what a message adds if a hull speaks for a mesh; otherwise nothing.
    pub fn note(&self) -> &'static str {
        if self.by == Measured::Hull { " (by a convex hull, not by triangles)" } else { "" }
    }
}

/// The precision is that of the distance: 4 digits if none is given.
impl fmt::Display for Contact {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (Self { link, other, distance, .. }, note) = (self, self.note());
        let digits = f.precision().unwrap_or(4);
        let kind = if matches!(self.pair, Pair::Links(..)) { "link" } else { "obstacle" };
        if *distance > 0.0 {
            write!(f, "link {link:?} is {distance:.digits$} m from {kind} {other:?}{note}")
        } else if self.by == Measured::Depth {
            write!(f, "link {link:?} touches {kind} {other:?}, up to {:.digits$} m deep", -distance)
        } else {
            write!(f, "link {link:?} is {:.digits$} m deep in {kind} {other:?}{note}", -distance)
        }
    }
}

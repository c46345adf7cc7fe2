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
}

/// The precision is that of the distance: 4 digits if none is given.
impl fmt::Display for Contact {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { link, other, distance, .. } = self;
        let digits = f.precision().unwrap_or(4);
        let kind = if matches!(self.pair, Pair::Links(..)) { "link" } else { "obstacle" };
        if *distance > 0.0 {
            write!(f, "link {link:?} is {distance:.digits$} m from {kind} {other:?}")
        } else {
            write!(f, "link {link:?} is {:.digits$} m deep in {kind} {other:?}", -distance)
        }
    }
}

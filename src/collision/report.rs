//! What touches, by name.

use std::fmt;

use glamx::DVec3;

/// Two things that touch, by index in the scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Pair {
    /// Two links (indices of [`super::Scene::links`]).
    Links(usize, usize),
    /// A link and an obstacle (index of [`super::Scene::obstacles`]).
    Obstacle(usize, usize),
}

/// Two things, how far apart they are and where.
#[derive(Debug, Clone, PartialEq)]
pub struct Contact {
    /// Which, by index.
    pub pair: Pair,
    /// Name of the link.
    pub link: String,
    /// Name of what it is close to: another link or an obstacle.
    pub other: String,
    /// Distance of their surfaces, padding included [m]; negative: how deep they overlap.
    pub distance: f64,
    /// The closest point on the link, in the world's frame [m].
    pub on_link: DVec3,
    /// The closest point on the other.
    pub on_other: DVec3,
}

impl fmt::Display for Contact {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { link, other, distance, .. } = self;
        let kind = if matches!(self.pair, Pair::Links(..)) { "link" } else { "obstacle" };
        if *distance > 0.0 {
            write!(f, "link {link:?} is {:.1} mm from {kind} {other:?}", distance * 1e3)
        } else {
            write!(f, "link {link:?} is {:.1} mm deep in {kind} {other:?}", -distance * 1e3)
        }
    }
}

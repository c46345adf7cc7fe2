//! The way out of a start that touches a little: free enough as long as nothing goes deeper.

use super::path::{Path, between, distance, length};
use crate::collision::{CollisionChecker, Stop};

/// Looks along one piece of the way out.
const LOOKS: u32 = 8;
/// How deep a start may touch [m].
pub(super) const CONTACT: f64 = 0.003;
/// How much deeper than at the start anything may go [m].
const DEEPER: f64 = 1e-4;

/// The start of a path that touches, and how far the path goes until nothing does.
#[derive(Debug, Clone, PartialEq)]
pub struct Leaving {
    start: Vec<f64>,
    depth: f64,
    reach: f64,
}

impl Leaving {
    /// That of a path; none where its start is free.
    pub fn of<C: CollisionChecker>(checker: &mut C, path: &Path) -> Option<Self> {
        let start = path.first()?.clone();
        let depth = checker.contacts(&start).first().map(|contact| -contact.distance).filter(|depth| *depth >= 0.0)?;
        if depth > CONTACT + DEEPER {
            return None;
        }
        let free = path.iter().position(|q| checker.is_free(q))?;
        let reach = length(path.get(..=free)?);
        Some(Self { start, depth, reach })
    }

    /// Whether a straight piece belongs to the way out, and goes no deeper.
    fn allows<C: CollisionChecker>(&self, checker: &mut C, a: &[f64], b: &[f64]) -> bool {
        let mut at = a.to_vec();
        let near = |q: &[f64]| distance(&self.start, q) <= self.reach + 1e-9;
        near(a)
            && near(b)
            && (0..=LOOKS).all(|k| {
                between(a, b, f64::from(k) / f64::from(LOOKS), &mut at);
                checker.contacts(&at).first().is_none_or(|contact| -contact.distance <= self.depth + DEEPER)
            })
    }
}

/// Whether a straight piece of a path is free, or a way out of where the path starts.
pub(super) fn passes<C: CollisionChecker>(
    checker: &mut C,
    leaving: Option<&Leaving>,
    a: &[f64],
    b: &[f64],
    stop: &Stop,
) -> bool {
    checker.motion_is_free(a, b, stop) || leaving.is_some_and(|leaving| leaving.allows(checker, a, b))
}

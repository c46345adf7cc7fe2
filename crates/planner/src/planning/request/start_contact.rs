//! Escapes from a start in slight contact: the path is valid while no penetration increases.

use crate::collision::{CollisionChecker, Stop};
use crate::planning::search::level::Level;
use crate::planning::search::path::{Path, between, distance, length};
use crate::planning::search::settings::EscapeSettings;

/// Start of a path in contact, and the length of the path until it is free.
#[derive(Debug, Clone, PartialEq)]
pub struct EscapePath {
    start: Vec<f64>,
    depth: f64,
    reach: f64,
    settings: EscapeSettings,
}

impl EscapePath {
    /// Returns the escape path of `path`; `None` if its start is free.
    pub fn of<C: CollisionChecker>(checker: &mut C, path: &Path, settings: &EscapeSettings) -> Option<Self> {
        let start = path.first().filter(|start| !checker.is_free(start))?.clone();
        let depth = checker.contacts(&start).first().map(|contact| -contact.distance).filter(|depth| *depth >= 0.0)?;
        if depth > settings.max_depth + settings.depth_tolerance {
            return None;
        }
        let free = path.iter().position(|q| checker.is_free(q))?;
        let reach = length(path.get(..=free)?);
        Some(Self { start, depth, reach, settings: *settings })
    }

    /// Returns whether a straight piece is part of the escape path and penetrates no deeper.
    fn allows<C: CollisionChecker>(&self, checker: &mut C, a: &[f64], b: &[f64]) -> bool {
        let EscapeSettings { depth_tolerance, samples, .. } = self.settings;
        let mut at = a.to_vec();
        let near = |q: &[f64]| distance(&self.start, q) <= self.reach + 1e-9;
        near(a)
            && near(b)
            && (0..=samples).all(|k| {
                between(a, b, f64::from(k) / f64::from(samples), &mut at);
                checker.contacts(&at).first().is_none_or(|contact| -contact.distance <= self.depth + depth_tolerance)
            })
    }
}

/// Returns whether a straight piece of a path is free, as far as its level looks, or part of its escape path.
pub(in crate::planning) fn passes<C: CollisionChecker>(
    checker: &mut C,
    level: Level,
    escape_path: Option<&EscapePath>,
    (a, b): (&[f64], &[f64]),
    stop: &Stop,
) -> bool {
    let free = if level.proves() { checker.motion_is_free(a, b, stop) } else { checker.motion_looks_free(a, b) };
    free || escape_path.is_some_and(|escape_path| escape_path.allows(checker, a, b))
}

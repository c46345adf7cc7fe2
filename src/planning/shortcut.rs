//! Shortcutting: removes corners where the straight line is free, then cuts between random points.

use crate::collision::checker::{CollisionChecker, Stop};
use crate::robot::random::Random;

use super::path::{Path, between, distance, length, tidy, unwind, unwind_all};

/// Settings of the shortcutting.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShortcutSettings {
    /// Number of random cuts.
    pub tries: usize,
    /// Maximum consecutive cuts without a gain.
    pub max_idle_tries: usize,
    /// Minimum part of the path that a cut must save.
    pub gain: f64,
}

impl Default for ShortcutSettings {
    fn default() -> Self {
        Self { tries: 100, max_idle_tries: 25, gain: 1e-3 }
    }
}

/// Shortens a path; every new edge is checked, the other edges stay unchanged. The same seed gives the same path. When
/// stopped, returns the path found so far.
pub fn shorten<C: CollisionChecker>(
    checker: &mut C,
    path: &[Vec<f64>],
    settings: &ShortcutSettings,
    seed: u64,
    stop: &Stop,
) -> Path {
    let turns = checker.turns().to_vec();
    let mut path = leave_out(checker, path, &turns, stop);
    let mut random = Random::new(seed);
    let mut idle = 0;
    for _ in 0..settings.tries {
        if path.len() < 3 || idle >= settings.max_idle_tries || stop.is_over() {
            break;
        }
        let whole = length(&path);
        let (s, t) = (random.unit() * whole, random.unit() * whole);
        let (a, mut b) = (point_at(&path, s.min(t)), point_at(&path, s.max(t)));
        unwind(&mut b.1, &a.1, &turns);
        idle += 1;
        let saved = (s - t).abs() - distance(&a.1, &b.1);
        if a.0 == b.0 || saved < settings.gain * whole || !checker.motion_is_free(&a.1, &b.1, stop) {
            continue;
        }
        let mut shorter: Path = path[..=a.0].to_vec();
        let mut rest = [&[point_at(&path, s.max(t)).1], &path[b.0 + 1..]].concat();
        unwind_all(&mut rest, &a.1, &turns);
        shorter.push(a.1);
        shorter.append(&mut rest);
        path = tidy(&shorter);
        idle = 0;
    }
    leave_out(checker, &path, &turns, stop)
}

/// From each configuration, connects straight to the farthest one that is reachable.
fn leave_out<C: CollisionChecker>(checker: &mut C, path: &[Vec<f64>], turns: &[bool], stop: &Stop) -> Path {
    let mut path = path.to_vec();
    let mut kept: Path = path.first().cloned().into_iter().collect();
    let mut at = 0;
    while at + 1 < path.len() {
        let free = |to: &usize| {
            let mut there = path[*to].clone();
            unwind(&mut there, &path[at], turns);
            checker.motion_is_free(&path[at], &there, stop)
        };
        let next = (at + 2..path.len()).rev().find(free);
        let (from, next) = (path[at].clone(), next.unwrap_or(at + 1));
        unwind_all(&mut path[next..], &from, turns);
        kept.push(path[next].clone());
        at = next;
    }
    kept
}

/// Returns the point at a length along a path, and its edge.
fn point_at(path: &[Vec<f64>], at: f64) -> (usize, Vec<f64>) {
    let mut rest = at;
    for (edge, pair) in path.windows(2).enumerate() {
        let step = distance(&pair[0], &pair[1]);
        if rest <= step || edge + 2 == path.len() {
            let mut q = pair[0].clone();
            between(&pair[0], &pair[1], if step > 0.0 { (rest / step).min(1.0) } else { 0.0 }, &mut q);
            return (edge, q);
        }
        rest -= step;
    }
    (0, path.first().cloned().unwrap_or_default())
}

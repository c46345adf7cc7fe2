//! Shortcutting: removes corners where the straight line is free, and cuts those that remain, in turn (Geraerts and
//! Overmars, "Creating high-quality paths for motion planning", 2007; the corners as the subdivision of a B-spline).

use super::path::{Path, between, distance, tidy, unwind, unwind_all};
use super::settings::ShortcutSettings;

/// Checks an edge.
pub type IsFree<'a> = &'a mut dyn FnMut(&[f64], &[f64]) -> bool;

/// Shortens a path; every new edge is checked, the other edges stay unchanged or are parts of what they were. `turns`
/// marks the continuous joints.
pub fn shorten(path: &[Vec<f64>], turns: &[bool], settings: &ShortcutSettings, is_free: IsFree<'_>) -> Path {
    let mut path = path.to_vec();
    for _ in 0..settings.rounds {
        let removed = remove_corners(&mut path, turns, is_free);
        let cut = cut_corners(&mut path, settings.min_change, is_free);
        path = tidy(path);
        if !removed && !cut {
            break;
        }
    }
    path
}

/// From each configuration, connects straight to the farthest one that is reachable; returns whether any was removed.
fn remove_corners(path: &mut Path, turns: &[bool], is_free: IsFree<'_>) -> bool {
    let before = path.len();
    let mut at = 0;
    while at + 2 < path.len() {
        let free = |to: &usize| {
            let mut there = path[*to].clone();
            unwind(&mut there, &path[at], turns);
            is_free(&path[at], &there)
        };
        let next = (at + 2..path.len()).rev().find(free);
        if let Some(next) = next {
            path.drain(at + 1..next);
            let from = path[at].clone();
            unwind_all(&mut path[at + 1..], &from, turns);
        }
        at += 1;
    }
    path.len() < before
}

/// Moves each corner halfway to the line between the middles of its edges, if it can be reached from there; returns
/// whether any was moved.
fn cut_corners(path: &mut Path, min_change: f64, is_free: IsFree<'_>) -> bool {
    let mut cut = false;
    let mut made: Path = Vec::with_capacity(2 * path.len());
    made.extend(path.first().cloned());
    for i in 1..path.len().saturating_sub(1) {
        let (corner, after) = (&path[i], &path[i + 1]);
        let (mut first, mut second, mut moved) = (made[made.len() - 1].clone(), corner.clone(), corner.clone());
        if i == 1 {
            between(&path[0], corner, 0.5, &mut first);
            made.push(first.clone());
        }
        between(corner, after, 0.5, &mut second);
        for (((moved, corner), a), b) in moved.iter_mut().zip(corner).zip(&first).zip(&second) {
            *moved = 0.5 * corner + 0.25 * (a + b);
        }
        let moves = distance(corner, &moved) > min_change && is_free(&first, &moved) && is_free(&moved, &second);
        made.push(if moves { moved } else { corner.clone() });
        made.push(second);
        cut |= moves;
    }
    made.extend(path.last().cloned().filter(|_| path.len() > 1));
    if cut {
        *path = made;
    }
    cut
}

//! Joint paths: configurations to be joined by straight lines.
//!
//! A joint that turns without end comes to the same after a whole turn. A path holds its positions as they follow each
//! other, without jumps: 3.1, 3.2, 3.3 rad, not 3.1, -3.08.

use std::f64::consts::TAU;

/// Configurations that follow each other.
pub type Path = Vec<Vec<f64>>;

/// Euclidean distance of two configurations [rad].
pub fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| (y - x) * (y - x)).sum::<f64>().sqrt()
}

/// Length of a path [rad], in the Euclidean norm of all joints.
pub fn length(path: &[Vec<f64>]) -> f64 {
    path.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum()
}

/// Turns the joints of `q` that turn without end by whole turns, so that the way from `near` is the short way round.
/// The others, and those that are near already, are left as they are to the last bit.
pub fn unwind(q: &mut [f64], near: &[f64], turns: &[bool]) {
    for ((q, near), _) in q.iter_mut().zip(near).zip(turns).filter(|(_, turns)| **turns) {
        let whole = ((near - *q) / TAU).round();
        *q += if whole == 0.0 { 0.0 } else { whole * TAU };
    }
}

/// Turns all configurations of a piece of path by the same whole turns, so that its first one is near `near`: the same
/// motion, where it goes on without a jump.
pub fn unwind_all(path: &mut [Vec<f64>], near: &[f64], turns: &[bool]) {
    let Some(first) = path.first().cloned() else { return };
    let mut moved = first.clone();
    unwind(&mut moved, near, turns);
    if moved != first {
        for q in path {
            q.iter_mut().zip(moved.iter().zip(&first)).for_each(|(q, (to, from))| *q += to - from);
        }
    }
}

/// Writes the configuration at part `t` of the way from `a` to `b`.
pub fn between(a: &[f64], b: &[f64], t: f64, out: &mut [f64]) {
    for ((o, x), y) in out.iter_mut().zip(a).zip(b) {
        *o = x + (y - x) * t;
    }
}

/// A path without repeated and without needless configurations: those on the line between their neighbours.
pub fn tidy(path: &[Vec<f64>]) -> Path {
    let mut tidy: Path = Vec::with_capacity(path.len());
    for q in path {
        if tidy.last().is_some_and(|last| distance(last, q) < 1e-12) {
            continue;
        }
        if let [.., before, middle] = tidy.as_slice() {
            let (first, second, whole) = (distance(before, middle), distance(middle, q), distance(before, q));
            if first + second - whole < 1e-12 * whole.max(1.0) {
                tidy.pop();
            }
        }
        tidy.push(q.clone());
    }
    tidy
}

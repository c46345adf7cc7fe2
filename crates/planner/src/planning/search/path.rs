//! Joint paths: configurations joined by straight lines.
//!
//! A continuous joint repeats after a whole turn. A path holds consecutive positions without jumps: 3.1, 3.2, 3.3 rad,
//! not 3.1, -3.08.

use std::f64::consts::TAU;

/// Consecutive configurations.
pub type Path = Vec<Vec<f64>>;

/// Returns the Euclidean distance of two configurations [rad].
pub fn distance(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| (y - x) * (y - x)).sum::<f64>().sqrt()
}

/// Returns the length of a path [rad], in the Euclidean norm of all joints.
pub fn length(path: &[Vec<f64>]) -> f64 {
    // The sum of no numbers is -0.
    0.0 + path.windows(2).map(|pair| distance(&pair[0], &pair[1])).sum::<f64>()
}

/// Shifts the continuous joints of `q` by whole turns to the positions nearest to `near`. All other joints, and those
/// already nearest, keep their exact values.
pub fn unwind(q: &mut [f64], near: &[f64], turns: &[bool]) {
    for ((q, near), _) in q.iter_mut().zip(near).zip(turns).filter(|(_, turns)| **turns) {
        let whole = ((near - *q) / TAU).round();
        *q += if whole == 0.0 { 0.0 } else { whole * TAU };
    }
}

/// Shifts all configurations of a piece of path by the same whole turns, so that the first one is nearest to `near`:
/// the same motion, continued without a jump.
pub fn unwind_all(path: &mut [Vec<f64>], near: &[f64], turns: &[bool]) {
    let Some(first) = path.first().filter(|_| turns.contains(&true)).cloned() else { return };
    let mut moved = first.clone();
    unwind(&mut moved, near, turns);
    if moved != first {
        for q in path {
            q.iter_mut().zip(moved.iter().zip(&first)).for_each(|(q, (to, from))| *q += to - from);
        }
    }
}

/// Writes the configuration at part `t` between `a` and `b`.
pub fn between(a: &[f64], b: &[f64], t: f64, out: &mut [f64]) {
    for ((o, x), y) in out.iter_mut().zip(a).zip(b) {
        *o = x + (y - x) * t;
    }
}

/// Returns a path without repeated configurations and without those on the line between their neighbours.
pub fn tidy(mut path: Path) -> Path {
    let kept = tidy_indices(&path);
    for (to, from) in kept.iter().enumerate() {
        path.swap(to, *from);
    }
    path.truncate(kept.len());
    path
}

/// Returns the index of each configuration of a path that remains when it is [tidy].
pub fn tidy_indices(path: &[Vec<f64>]) -> Vec<usize> {
    let mut kept: Vec<usize> = Vec::with_capacity(path.len());
    for (i, q) in path.iter().enumerate() {
        if kept.last().is_some_and(|last| distance(&path[*last], q) < 1e-12) {
            continue;
        }
        if let [.., before, middle] = kept[..] {
            let (before, middle) = (&path[before], &path[middle]);
            let (first, second, whole) = (distance(before, middle), distance(middle, q), distance(before, q));
            if first + second - whole < 1e-12 * whole.max(1.0) {
                kept.pop();
            }
        }
        kept.push(i);
    }
    kept
}

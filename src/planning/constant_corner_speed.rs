//! Speeds whose average over a time window keeps velocity, acceleration and jerk limits by construction: each corner is
//! passed at constant speed, held for half a window before and after it, and no line changes from acceleration to
//! deceleration within a window. So a window contains at most one change of acceleration, and none while the average is
//! in a corner.
//!
//! Good where lines are long compared to the distance travelled in a window.

use super::blend::{Curve, Piece};
use super::topp::{GridPoint, JointBound, fastest, hardest, set_times, switches};

/// Points of a corner at which its speed is computed.
const SAMPLES: usize = 16;
/// Part of the jerk limits that a corner uses: between samples the jerk may be slightly higher.
const JERK_RATIO: f64 = 0.98;

/// Returns the grid points of a curve with speeds and times, from rest to rest; `None` if a corner leaves no line on
/// which to change speed.
pub(super) fn constant_corner_speed(curve: &Curve, bounds: &[JointBound], window: f64) -> Option<Vec<GridPoint>> {
    let speeds = corner_speeds(curve, bounds, window)?;
    let mut points = vec![GridPoint::default()];
    let mut start = 0.0;
    for (p, piece) in curve.iter().enumerate() {
        let [from, to] = [p, p + 1].map(|i| speeds[i]);
        let x = to * to;
        let end = GridPoint { piece: p, at: piece.length, s: start + piece.length, x, time: 0.0 };
        if !piece.bends {
            // Same speed next to a corner as in it.
            let (after, before) = (0.5 * window * from, 0.5 * window * to);
            let begin = GridPoint { piece: p, at: after, s: start + after, x: from * from, time: 0.0 };
            let brake = GridPoint { at: end.at - before, s: end.s - before, ..end };
            points.extend((after > 0.0).then_some(begin));
            switches(&begin, &brake, hardest(piece, bounds), fastest(piece, bounds), window, &mut points);
            points.extend((before > 0.0).then_some(brake));
        }
        points.push(end);
        start += piece.length;
    }
    set_times(&mut points);
    Some(points)
}

/// Returns the speed at the end of each piece, preceded by that of the start; in a corner the same at both ends.
fn corner_speeds(curve: &Curve, bounds: &[JointBound], window: f64) -> Option<Vec<f64>> {
    let n = curve.len();
    let mut speeds = vec![f64::INFINITY; n + 1];
    (speeds[0], speeds[n]) = (0.0, 0.0);
    for (p, piece) in curve.iter().enumerate() {
        let most = if piece.bends {
            corner_speed(piece, bounds)
        } else {
            // The constant speed beside both ends must fit on the line.
            fastest(piece, bounds).sqrt().min(piece.length / window)
        };
        for end in [p, p + 1] {
            speeds[end] = speeds[end].min(most);
        }
    }
    // Speeds that are reachable along the lines, from behind and from ahead.
    let reached = |piece: &Piece, slow: f64, fast: f64| {
        if piece.bends {
            return fast.min(slow);
        }
        // f² = slow² + 2·u·(length − ½·window·(slow + f))
        let (push, half) = (hardest(piece, bounds), 0.5 * window);
        let lost = push * half;
        let room = slow * slow + 2.0 * push * (piece.length - half * slow);
        fast.min((lost * lost + room.max(0.0)).sqrt() - lost).max(0.0)
    };
    for p in (0..n).rev() {
        speeds[p] = reached(&curve[p], speeds[p + 1], speeds[p]);
    }
    for p in 0..n {
        speeds[p + 1] = reached(&curve[p], speeds[p], speeds[p + 1]);
    }
    let inner = speeds.get(1..n).unwrap_or_default();
    inner.iter().all(|v| *v > 1e-6).then_some(speeds)
}

/// Returns the maximum constant speed in a corner.
fn corner_speed(corner: &Piece, bounds: &[JointBound]) -> f64 {
    let (mut speed, mut square, mut cube) = (f64::INFINITY, f64::INFINITY, f64::INFINITY);
    for k in 0..=SAMPLES {
        let t = corner.progress(corner.length * k as f64 / SAMPLES as f64);
        for ((direction, turn), bound) in corner.direction.iter().zip(&corner.turn).zip(bounds) {
            speed = speed.min(bound.velocity / (direction + turn * t.part).abs().max(1e-12));
            square = square.min(bound.acceleration / (turn * t.d1).abs().max(1e-12));
            cube = cube.min(JERK_RATIO * bound.jerk / (turn * t.d2).abs().max(1e-12));
        }
    }
    speed.min(square.sqrt()).min(cube.cbrt())
}

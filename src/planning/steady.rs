//! Speeds whose average over a window of time keeps velocity, acceleration and jerk limits by construction: each
//! corner is passed at one speed, which is held for half a window before and after it, and no line changes from
//! speeding up to braking within a window. So a window never holds more than one change of speed, and none while the
//! average is in a corner.
//!
//! Good where lines are long compared to what is travelled in a window.

use super::blend::{Curve, Piece};
use super::topp::{GridPoint, JointBound, fastest, hardest, set_times, switches};

/// Points of a corner at which its speed is found.
const LOOKS: usize = 16;
/// Part of the jerk limits that a corner uses: between the looks it may take a little more.
const PART: f64 = 0.98;

/// The points of a curve with speeds and times, from rest to rest; nothing where a corner leaves no line in between to
/// change speed on.
pub(super) fn steady(curve: &Curve, bounds: &[JointBound], window: f64) -> Option<Vec<GridPoint>> {
    let speeds = corner_speeds(curve, bounds, window)?;
    let mut points = vec![GridPoint::default()];
    let mut start = 0.0;
    for (p, piece) in curve.iter().enumerate() {
        let [from, to] = [p, p + 1].map(|i| speeds[i]);
        let x = to * to;
        let end = GridPoint { piece: p, at: piece.length, s: start + piece.length, x, time: 0.0 };
        if !piece.bends {
            // Beside a corner, as fast as in it.
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

/// The speed at the end of each piece, with that of the start before them: in a corner the same at both ends.
fn corner_speeds(curve: &Curve, bounds: &[JointBound], window: f64) -> Option<Vec<f64>> {
    let n = curve.len();
    let mut speeds = vec![f64::INFINITY; n + 1];
    (speeds[0], speeds[n]) = (0.0, 0.0);
    for (p, piece) in curve.iter().enumerate() {
        let most = if piece.bends {
            corner_speed(piece, bounds)
        } else {
            // What is held beside both ends fits on the line.
            fastest(piece, bounds).sqrt().min(piece.length / window)
        };
        for end in [p, p + 1] {
            speeds[end] = speeds[end].min(most);
        }
    }
    // Speeds that the lines allow to reach, from behind and from the front.
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

/// The highest constant speed in a corner.
fn corner_speed(corner: &Piece, bounds: &[JointBound]) -> f64 {
    let (mut speed, mut square, mut cube) = (f64::INFINITY, f64::INFINITY, f64::INFINITY);
    for k in 0..=LOOKS {
        let t = corner.turned(corner.length * k as f64 / LOOKS as f64);
        for ((direction, turn), bound) in corner.direction.iter().zip(&corner.turn).zip(bounds) {
            speed = speed.min(bound.velocity / (direction + turn * t.part).abs().max(1e-12));
            square = square.min(bound.acceleration / (turn * t.d1).abs().max(1e-12));
            cube = cube.min(PART * bound.jerk / (turn * t.d2).abs().max(1e-12));
        }
    }
    speed.min(square.sqrt()).min(cube.cbrt())
}

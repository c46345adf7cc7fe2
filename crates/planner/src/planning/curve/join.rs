//! One curve along several, which passes the places where they meet at a distance instead of resting there.
//!
//! Before a meeting place the first curve slows down to a stop while the second starts, and both motions are added: the
//! direction turns by the smooth step `3x² − 2x³`, as in the corners of a path
//! ([`blend`](crate::planning::timing::blend)), but between curves of any shape.

use super::joint_curve::JointCurve;
use super::settings::JoinSettings;
use crate::planning::search::path::Path;
use crate::planning::timing::blend::{Curve, Piece, curves};

/// Returns the curve through the corners of a path, each rounded within its deviation [rad]; `None` if it rests
/// somewhere.
pub fn rounded(path: &[Vec<f64>], deviation: &[f64], settings: &JoinSettings) -> Option<JointCurve> {
    let pieces: Curve = match <[Curve; 1]>::try_from(curves(path, deviation)) {
        Ok([pieces]) => pieces,
        Err(_) => return None,
    };
    let mut points: Path = vec![path.first()?.clone()];
    for (i, piece) in pieces.iter().enumerate() {
        let mut add = |s: f64| points.push(piece.jets(s).map(|jet| jet.q).collect());
        if piece.bends {
            (1..=settings.samples).for_each(|k| add(piece.length * k as f64 / settings.samples as f64));
            continue;
        }
        // Next to a corner as dense as in it, and twice as far apart from one to the next.
        let spacing =
            |corner: Option<&Piece>| corner.map_or(settings.spacing, |corner| corner.length / settings.samples as f64);
        let [mut before, mut after] = [spacing(i.checked_sub(1).map(|i| &pieces[i])), spacing(pieces.get(i + 1))];
        let (mut from, mut ends) = (0.0, vec![piece.length]);
        while from + before + after < ends[ends.len() - 1] {
            if before <= after {
                from += before;
                add(from);
                before = (2.0 * before).min(settings.spacing);
            } else {
                ends.push(ends[ends.len() - 1] - after);
                after = (2.0 * after).min(settings.spacing);
            }
        }
        ends.iter().rev().for_each(|s| add(*s));
    }
    JointCurve::through(&points)
}

/// Returns the curve along several. `passed` returns the distance [m] of the end effectors from where they are at one
/// configuration when they are at another: they pass each meeting place within `blend` [m].
pub fn joined(
    curves: &[JointCurve],
    blend: f64,
    passed: impl Fn(&[f64], &[f64]) -> f64,
    settings: &JoinSettings,
) -> Option<JointCurve> {
    let last = curves.len().checked_sub(1)?;
    // Of a curve that is blended at both ends each may have a half.
    let room = |i: usize| curves[i].length() * if i == 0 || i == last { 0.95 } else { 0.475 };
    let mut points: Path = Vec::new();
    let mut begin = 0.0;
    for (i, curve) in curves.iter().enumerate() {
        let meeting = curves.get(i + 1).map(|next| Meeting { before: curve, after: next });
        let half = meeting.as_ref().map_or(0.0, |meeting| {
            let (mut low, mut high) = (0.0, room(i).min(room(i + 1)));
            if meeting.passes(high, &passed) <= settings.share * blend {
                return high;
            }
            for _ in 0..settings.rounds {
                let middle = 0.5 * (low + high);
                let near = meeting.passes(middle, &passed) <= settings.share * blend;
                if near { low = middle } else { high = middle }
            }
            low
        });
        let end = curve.length() - half;
        let mut q = Vec::new();
        let inner = curve.knots().iter().filter(|s| **s > begin + 1e-6 && **s < end - 1e-6);
        for s in [begin].iter().chain(inner).chain(&[end]) {
            curve.at(*s, &mut q);
            points.push(q.clone());
        }
        if let Some(meeting) = meeting {
            points.extend((1..settings.samples).map(|k| meeting.at(half, k as f64 / settings.samples as f64)));
        }
        begin = half;
    }
    JointCurve::through(&points)
}

/// Where one curve ends and the next begins.
struct Meeting<'a> {
    before: &'a JointCurve,
    after: &'a JointCurve,
}

impl Meeting<'_> {
    /// Returns the configuration at part `x` (0–1) of a blend that takes `half` of each curve [rad].
    fn at(&self, half: f64, x: f64) -> Vec<f64> {
        let along = 2.0 * half * x;
        let second = 2.0 * half * (x * x * x - 0.5 * x * x * x * x);
        let first = self.before.length() - half + along - second;
        let corner = self.after.jets(0.0);
        let sum = self.before.jets(first).zip(self.after.jets(second)).zip(corner);
        sum.map(|((a, b), corner)| a.q + b.q - corner.q).collect()
    }

    /// Returns how far the end effectors pass the meeting place: the nearest is in the middle.
    fn passes(&self, half: f64, passed: impl Fn(&[f64], &[f64]) -> f64) -> f64 {
        let corner: Vec<f64> = self.after.jets(0.0).map(|jet| jet.q).collect();
        passed(&corner, &self.at(half, 0.5))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::search::path::distance;

    #[test]
    fn two_lines_are_blended_where_they_meet_and_their_rest_is_kept() {
        let line = |from: [f64; 2], to: [f64; 2]| {
            let at = |k: u32| (0..2).map(|j| from[j] + (to[j] - from[j]) * f64::from(k) / 15.0).collect();
            JointCurve::through(&(0..=15).map(at).collect::<Path>()).unwrap()
        };
        let curves = [line([0.0, 0.0], [1.0, 0.0]), line([1.0, 0.0], [1.0, 1.0])];
        for blend in [0.02, 0.1] {
            let whole = joined(&curves, blend, distance, &JoinSettings::default()).unwrap();
            let (mut q, mut nearest) = (Vec::new(), f64::INFINITY);
            for k in 0..=2000 {
                whole.at(whole.length() * f64::from(k) / 2000.0, &mut q);
                nearest = nearest.min(distance(&q, &[1.0, 0.0]));
            }
            assert!((0.5 * blend..=blend).contains(&nearest), "{nearest} for {blend}");
        }
        let path = [vec![0.0, 0.0], vec![1.0, 0.0], vec![1.0, 1.0]];
        assert!(rounded(&path, &[0.0; 3], &JoinSettings::default()).is_none());
        let curve = rounded(&path, &[0.05; 3], &JoinSettings::default()).unwrap();
        let bend = |s: f64| curve.jets(s).map(|jet| jet.d2 * jet.d2).sum::<f64>().sqrt();
        let sharpest = (0..=1000).map(|k| bend(curve.length() * f64::from(k) / 1000.0)).fold(0.0, f64::max);
        assert!(sharpest < 12.0, "a curvature of {sharpest}");
    }
}

//! Corner blending: turns a joint path into a curve `q(s)` with continuous curvature within a given deviation of the
//! straight path.
//!
//! Between straight pieces the direction turns by a smooth step `σ(x) = 3x² − 2x³`: `q'(s) = u₁ + (u₂ − u₁)·σ`, for
//! `s` from `−L` to `L` around the corner. So `q` is of fourth degree, meets both lines with equal position, direction
//! and curvature, and passes the corner at a distance of `3/16·L·|u₂ − u₁|`.

use crate::planning::search::path::distance;

/// Norm of a change of direction above which a corner is a reversal, which is not blended: the speed would be zero in
/// it.
pub(in crate::planning) const REVERSAL: f64 = 1.99;

/// A piece of a curve: a line or a blended corner.
#[derive(Debug, Clone, PartialEq)]
pub struct Piece {
    /// Length of its parameter interval [rad].
    pub length: f64,
    /// Start configuration [rad].
    pub start: Vec<f64>,
    /// Direction at the start, of length 1.
    pub direction: Vec<f64>,
    /// Change of direction over the piece; zero for a line.
    pub turn: Vec<f64>,
    /// Whether the piece is a corner.
    pub bends: bool,
    /// Index of the corner in the path; for a line, that of its end point.
    pub corner: usize,
}

/// A point of a curve: position and its first three derivatives with respect to the parameter.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Jet {
    /// Position [rad].
    pub q: f64,
    /// First derivative.
    pub d1: f64,
    /// Second derivative [1/rad].
    pub d2: f64,
    /// Third derivative [1/rad²].
    pub d3: f64,
}

/// Progress of a corner: the integral of `σ`, `σ`, and its first two derivatives. Common to all joints.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CornerProgress {
    /// ∫σ ds [rad].
    pub area: f64,
    /// σ, from 0 to 1.
    pub part: f64,
    /// dσ/ds [1/rad].
    pub d1: f64,
    /// d²σ/ds² [1/rad²].
    pub d2: f64,
}

impl Piece {
    /// Returns the progress at parameter `s` from the piece's start [rad].
    pub fn progress(&self, s: f64) -> CornerProgress {
        if !self.bends {
            return CornerProgress::default();
        }
        let inverse = 1.0 / self.length;
        let x = s * inverse;
        CornerProgress {
            area: s * x * x * (1.0 - 0.5 * x),
            part: x * x * (3.0 - 2.0 * x),
            d1: 6.0 * x * (1.0 - x) * inverse,
            d2: 6.0 * (1.0 - 2.0 * x) * inverse * inverse,
        }
    }

    /// Returns all joints at parameter `s` from the piece's start [rad].
    pub fn jets(&self, s: f64) -> impl Iterator<Item = Jet> + '_ {
        let t = self.progress(s);
        self.start.iter().zip(&self.direction).zip(&self.turn).map(move |((start, direction), turn)| Jet {
            q: start + direction * s + turn * t.area,
            d1: direction + turn * t.part,
            d2: turn * t.d1,
            d3: turn * t.d2,
        })
    }
}

/// Consecutive pieces between two rests.
pub type Curve = Vec<Piece>;

/// Builds the curves of a path. At corner `i` (an inner configuration) the curve stays within `deviation[i]` [rad,
/// Euclidean] of the path. At a corner with deviation 0 the motion rests: one curve ends, the next begins.
pub fn curves(path: &[Vec<f64>], deviation: &[f64]) -> Vec<Curve> {
    let mut curves = Vec::new();
    let mut curve: Curve = Vec::new();
    // Part of the current line that the previous corner uses.
    let mut taken = 0.0;
    for (i, line) in path.windows(2).enumerate() {
        let (a, b) = (&line[0], &line[1]);
        let whole = distance(a, b);
        let corner = path.get(i + 2).map(|next| Corner::new(a, b, next, deviation.get(i + 1).copied().unwrap_or(0.0)));
        let used = corner.as_ref().map_or(0.0, |c| c.half);
        let direction = direction(a, b);
        let straight = whole - taken - used;
        if straight > 1e-9 * whole {
            let start = a.iter().zip(&direction).map(|(x, u)| x + u * taken).collect();
            let turn = vec![0.0; a.len()];
            curve.push(Piece { length: straight, start, direction, turn, bends: false, corner: i + 1 });
        }
        match corner {
            Some(corner) if corner.half > 0.0 => {
                curve.push(corner.piece(b, i + 1));
                taken = corner.half;
            }
            _ => {
                taken = 0.0;
                curves.extend((!curve.is_empty()).then(|| std::mem::take(&mut curve)));
            }
        }
    }
    curves
}

struct Corner {
    u1: Vec<f64>,
    u2: Vec<f64>,
    /// Length used on each of the two lines [rad].
    half: f64,
}

impl Corner {
    fn new(a: &[f64], b: &[f64], c: &[f64], deviation: f64) -> Self {
        let (u1, u2) = (direction(a, b), direction(b, c));
        let turn = distance(&u1, &u2);
        let room = 0.5 * distance(a, b).min(distance(b, c));
        let sharp = turn > REVERSAL || deviation <= 0.0;
        let half = if sharp { 0.0 } else { (16.0 * deviation / (3.0 * turn.max(1e-9))).min(room) };
        Self { u1, u2, half }
    }

    fn piece(&self, middle: &[f64], corner: usize) -> Piece {
        let start = middle.iter().zip(&self.u1).map(|(m, u)| m - u * self.half).collect();
        let turn = self.u1.iter().zip(&self.u2).map(|(u1, u2)| u2 - u1).collect();
        Piece { length: 2.0 * self.half, start, direction: self.u1.clone(), turn, bends: true, corner }
    }
}

fn direction(a: &[f64], b: &[f64]) -> Vec<f64> {
    let length = distance(a, b).max(f64::MIN_POSITIVE);
    a.iter().zip(b).map(|(x, y)| (y - x) / length).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::search::path::Path;
    use dimos_robot::random::Random;

    #[test]
    fn curves_are_smooth_and_keep_to_the_path() {
        let mut random = Random::new(5);
        for _ in 0..50 {
            let path: Path = (0..6).map(|_| (0..4).map(|_| random.between(-1.0, 1.0)).collect()).collect();
            let all = curves(&path, &[0.05; 6]);
            let curve: Curve = all.concat();
            if all.len() > 1 {
                continue;
            }
            for pair in curve.windows(2) {
                for (end, start) in pair[0].jets(pair[0].length).zip(pair[1].jets(0.0)) {
                    assert!((end.q - start.q).abs() < 1e-9, "{end:?} {start:?}");
                    assert!((end.d1 - start.d1).abs() < 1e-9 && (end.d2 - start.d2).abs() < 1e-6);
                }
            }
            for piece in curve.iter().filter(|p| p.bends) {
                let middle: Vec<f64> = piece.jets(piece.length / 2.0).map(|jet| jet.q).collect();
                assert!(distance(&middle, &path[piece.corner]) <= 0.05 + 1e-9);
            }
            let last = curve.last().unwrap();
            let end: Vec<f64> = last.jets(last.length).map(|jet| jet.q).collect();
            assert!(distance(&end, &path[5]) < 1e-9);
        }
    }

    #[test]
    fn a_corner_without_deviation_is_a_rest() {
        let path = vec![vec![0.0, 0.0], vec![1.0, 0.0], vec![1.0, 1.0]];
        assert_eq!(curves(&path, &[0.0; 3]).len(), 2);
        assert_eq!(curves(&path, &[0.1; 3]).len(), 1);
        // A reversal is a rest too.
        let back = vec![vec![0.0, 0.0], vec![1.0, 0.0], vec![0.5, 0.0]];
        assert_eq!(curves(&back, &[0.1; 3]).len(), 2);
    }
}

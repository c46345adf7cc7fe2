//! A smooth curve through configurations: a cubic spline with continuous curvature over its length in joint space.

use crate::planning::search::path::{Path, distance};
use crate::planning::timing::blend::Jet;

/// Configurations closer to each other than this are one [rad, Euclidean over all joints].
const SAME: f64 = 1e-9;

/// A curve with continuous second derivatives. Its parameter is the length of the polyline through its configurations
/// [rad, Euclidean over all joints].
#[derive(Debug, Clone, PartialEq)]
pub struct JointCurve {
    /// Parameter of each configuration, from 0.
    knots: Vec<f64>,
    /// The configurations, one after the other [rad or m].
    configurations: Path,
    /// Second derivative at each [1/rad].
    bends: Path,
}

/// A piece between two configurations, at some parameter.
struct Piece {
    /// Index of the first.
    first: usize,
    /// Distance from the first, and to the second [rad].
    parts: [f64; 2],
    length: f64,
}

impl JointCurve {
    /// Returns the curve through configurations; those equal to the one before are left out. `None` if fewer than two
    /// are left. At its ends it continues as the curve through the four configurations next to them does.
    pub fn through(configurations: &[Vec<f64>]) -> Option<Self> {
        let (mut knots, mut kept): (Vec<f64>, Path) = (Vec::new(), Path::new());
        for q in configurations {
            let step = kept.last().map_or(f64::INFINITY, |last| distance(last, q));
            if step > SAME {
                knots.push(knots.last().map_or(0.0, |last| last + step));
                kept.push(q.clone());
            }
        }
        (kept.len() >= 2).then(|| Self { bends: bends(&knots, &kept), knots, configurations: kept })
    }

    /// Returns its length: the largest parameter [rad].
    pub fn length(&self) -> f64 {
        self.knots.last().copied().unwrap_or(0.0)
    }

    /// Returns the configurations that it passes [rad or m].
    pub fn configurations(&self) -> &Path {
        &self.configurations
    }

    /// Returns the parameter of each configuration [rad].
    pub fn knots(&self) -> &[f64] {
        &self.knots
    }

    /// Returns the number of joints.
    pub fn joints(&self) -> usize {
        self.configurations.first().map_or(0, Vec::len)
    }

    fn piece(&self, s: f64) -> Piece {
        let s = s.clamp(0.0, self.length());
        let first = self.knots.partition_point(|knot| *knot <= s).clamp(1, self.knots.len() - 1) - 1;
        let (from, to) = (self.knots[first], self.knots[first + 1]);
        Piece { first, parts: [s - from, to - s], length: to - from }
    }

    /// Returns position and derivatives of all joints at parameter `s` [rad].
    pub fn jets(&self, s: f64) -> impl Iterator<Item = Jet> + '_ {
        let Piece { first, parts: [a, b], length } = self.piece(s);
        let inverse = 1.0 / length;
        let [q0, q1] = [&self.configurations[first], &self.configurations[first + 1]];
        let [m0, m1] = [&self.bends[first], &self.bends[first + 1]];
        q0.iter().zip(q1).zip(m0.iter().zip(m1)).map(move |((q0, q1), (m0, m1))| {
            // Of the chord, and of the bends at its ends.
            let (qa, qb) = ((a * a * inverse - length) * a, (b * b * inverse - length) * b);
            let (da, db) = (3.0 * a * a * inverse - length, length - 3.0 * b * b * inverse);
            Jet {
                q: (b * q0 + a * q1) * inverse + (qb * m0 + qa * m1) / 6.0,
                d1: (q1 - q0) * inverse + (db * m0 + da * m1) / 6.0,
                d2: (b * m0 + a * m1) * inverse,
                d3: (m1 - m0) * inverse,
            }
        })
    }

    /// Writes the configuration at parameter `s` [rad].
    pub fn at(&self, s: f64, q: &mut Vec<f64>) {
        q.clear();
        q.extend(self.jets(s).map(|jet| jet.q));
    }
}

impl JointCurve {
    /// Returns whether all its joints stay within limits [rad or m], also between its configurations.
    pub fn stays_inside(&self, limits: &[[f64; 2]]) -> bool {
        let inside = |s: f64| self.jets(s).zip(limits).all(|(jet, [lower, upper])| (*lower..=*upper).contains(&jet.q));
        // Where a position has an extreme its curve is flat: eight places of a piece show it.
        self.knots.windows(2).all(|pair| (0..8).all(|k| inside(pair[0] + (pair[1] - pair[0]) * f64::from(k) / 8.0)))
            && inside(self.length())
    }
}

impl JointCurve {
    /// Returns how far a joint is from configurations that the curve passes in this order [rad or m].
    pub fn farthest(&self, configurations: &[Vec<f64>]) -> f64 {
        let apart = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        let places = 4 * configurations.len().max(self.knots.len());
        let (mut at, mut next, mut k) = (Vec::new(), Vec::new(), 0);
        self.at(0.0, &mut at);
        let mut farthest = 0.0_f64;
        for q in configurations {
            // Onwards while that is closer.
            while k < places {
                self.at(self.length() * (k + 1) as f64 / places as f64, &mut next);
                if apart(&next, q) > apart(&at, q) {
                    break;
                }
                std::mem::swap(&mut at, &mut next);
                k += 1;
            }
            farthest = farthest.max(apart(&at, q));
        }
        farthest
    }
}

/// Returns the second derivatives of the cubic spline through configurations.
fn bends(knots: &[f64], configurations: &[Vec<f64>]) -> Path {
    let (n, joints) = (knots.len(), configurations[0].len());
    let mut bends = vec![vec![0.0; joints]; n];
    let slopes = [0, n - 1].map(|end| end_slope(knots, configurations, end));
    // The equations of all joints have the same three diagonals: (before, main, after).
    let lengths: Vec<f64> = knots.windows(2).map(|pair| pair[1] - pair[0]).collect();
    let rise = |i: usize, j: usize| (configurations[i + 1][j] - configurations[i][j]) / lengths[i];
    let mut after = vec![0.0; n];
    for i in 0..n {
        let before = if i == 0 { 0.0 } else { lengths[i - 1] };
        let next = lengths.get(i).copied().unwrap_or(0.0);
        let pivot = 1.0 / (2.0 * (before + next) - before * if i == 0 { 0.0 } else { after[i - 1] });
        after[i] = next * pivot;
        for j in 0..joints {
            let from = if i == 0 { slopes[0][j] } else { rise(i - 1, j) };
            let to = if i + 1 == n { slopes[1][j] } else { rise(i, j) };
            let carried = if i == 0 { 0.0 } else { before * bends[i - 1][j] };
            bends[i][j] = (6.0 * (to - from) - carried) * pivot;
        }
    }
    for i in (0..n - 1).rev() {
        let (own, known) = bends.split_at_mut(i + 1);
        own[i].iter_mut().zip(&known[0]).for_each(|(bend, known)| *bend -= after[i] * known);
    }
    bends
}

/// Returns the derivative at an end of the polynomial through the (up to) four configurations next to it.
fn end_slope(knots: &[f64], configurations: &[Vec<f64>], end: usize) -> Vec<f64> {
    let count = knots.len().min(4);
    let nearest: Vec<usize> = (0..count).map(|k| if end == 0 { k } else { end - k }).collect();
    let mut slope = vec![0.0; configurations[0].len()];
    for &k in &nearest {
        // Derivative of Lagrange's polynomial of configuration k.
        let others = || nearest.iter().filter(|i| **i != k);
        let weight: f64 = if k == end {
            others().map(|i| 1.0 / (knots[end] - knots[*i])).sum()
        } else {
            let passed = others().filter(|i| **i != end).map(|i| (knots[end] - knots[*i]) / (knots[k] - knots[*i]));
            passed.product::<f64>() / (knots[k] - knots[end])
        };
        slope.iter_mut().zip(&configurations[k]).for_each(|(slope, q)| *slope += weight * q);
    }
    slope
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_cubic_is_its_own_curve_and_curvature_is_continuous() {
        let cubic = |x: f64| vec![x, x * x * x - x, 0.5 * x * x];
        let points: Path = (0..=20).map(|k| cubic(0.1 * f64::from(k))).collect();
        let curve = JointCurve::through(&points).unwrap();
        let mut q = Vec::new();
        for k in 0..200 {
            curve.at(curve.length() * f64::from(k) / 199.0, &mut q);
            assert!(distance(&q, &cubic(q[0])) < 1e-3, "{q:?}");
        }
        for knot in &curve.knots()[1..20] {
            for (a, b) in curve.jets(knot - 1e-9).zip(curve.jets(knot + 1e-9)) {
                assert!((a.q - b.q).abs() < 1e-7 && (a.d1 - b.d1).abs() < 1e-6 && (a.d2 - b.d2).abs() < 1e-5);
            }
        }
    }

    #[test]
    fn two_configurations_are_a_straight_line_and_one_is_none() {
        let curve = JointCurve::through(&[vec![0.0, 1.0], vec![0.0, 1.0], vec![3.0, 5.0]]).unwrap();
        assert_eq!((curve.length(), curve.configurations().len()), (5.0, 2));
        for jet in curve.jets(2.0) {
            assert!(jet.d2.abs() < 1e-12 && jet.d3.abs() < 1e-12, "{jet:?}");
        }
        assert_eq!(JointCurve::through(&[vec![1.0], vec![1.0]]), None);
    }
}

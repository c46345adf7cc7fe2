//! The smoothest curve that passes given configurations within a tolerance: a cubic B-spline whose coefficients'
//! third differences are penalized (Eilers and Marx, "Flexible smoothing with B-splines and penalties", 1996), as much
//! as the tolerance allows.

use super::joint_curve::JointCurve;
use super::settings::FitSettings;
use crate::planning::search::path::{Path, between, distance};

/// Diagonals of the equations beside the main one: a B-spline overlaps three others.
const BAND: usize = 3;
/// Factors of the third difference of four neighbours.
const THIRD: [f64; 4] = [-1.0, 3.0, -3.0, 1.0];

/// Returns the curve from the first to the last configuration [rad or m] that passes each joint of those between
/// within `tolerance`; `None` if nothing moves, or no curve with the settings' number of pieces does.
pub fn fit(configurations: &[Vec<f64>], tolerance: f64, settings: &FitSettings) -> Option<JointCurve> {
    let mut places = vec![0.0];
    for pair in configurations.windows(2) {
        places.push(places.last()? + distance(&pair[0], &pair[1]));
    }
    let length = *places.last()?;
    if configurations.len() < 4 || length.is_nan() || length <= 0.0 {
        return JointCurve::through(configurations);
    }
    let [fewest, most] = settings.pieces;
    let pieces = (settings.per_point * configurations.len()).clamp(fewest, most);
    let given = Given { configurations, places: &places, pieces, length };
    let within = |smooth: &Path| given.error(smooth) <= settings.share * tolerance;
    let (mut low, mut high) = settings.penalty;
    let mut best = Some(given.smooth(low)?).filter(within);
    if best.is_none() {
        // Nothing is smoothed: the curve through them all.
        return JointCurve::through(configurations);
    }
    for _ in 0..settings.rounds {
        let middle = (low * high).sqrt();
        match given.smooth(middle).filter(within) {
            Some(smooth) => (best, low) = (Some(smooth), middle),
            None => high = middle,
        }
    }
    let coefficients = best?;
    let mut path: Path = (0..=pieces).map(|k| given.at(&coefficients, length * k as f64 / pieces as f64)).collect();
    if let ([first, .., last], [start, .., goal]) = (path.as_mut_slice(), configurations) {
        first.clone_from(start);
        last.clone_from(goal);
    }
    JointCurve::through(&path)
}

/// Returns places on the straight lines through configurations, at most `spacing` apart [rad].
pub fn dense(configurations: &[Vec<f64>], spacing: f64) -> Path {
    let mut places: Path = configurations.first().cloned().into_iter().collect();
    for pair in configurations.windows(2) {
        let parts = (distance(&pair[0], &pair[1]) / spacing).ceil().max(1.0) as usize;
        places.extend((1..=parts).map(|k| {
            let mut q = pair[1].clone();
            between(&pair[0], &pair[1], k as f64 / parts as f64, &mut q);
            q
        }));
    }
    places
}

/// Configurations to pass, at places along the polyline through them [rad].
struct Given<'a> {
    configurations: &'a [Vec<f64>],
    places: &'a [f64],
    pieces: usize,
    length: f64,
}

impl Given<'_> {
    /// Returns the first of four coefficients that count at a place, and their weights.
    fn weights(&self, place: f64) -> (usize, [f64; 4]) {
        let x = (place / self.length * self.pieces as f64).clamp(0.0, self.pieces as f64);
        let first = (x as usize).min(self.pieces - 1);
        let u = x - first as f64;
        let v = 1.0 - u;
        let middle = |u: f64| (4.0 - 6.0 * u * u + 3.0 * u * u * u) / 6.0;
        (first, [v * v * v / 6.0, middle(u), middle(v), u * u * u / 6.0])
    }

    fn at(&self, coefficients: &Path, place: f64) -> Vec<f64> {
        let (first, weights) = self.weights(place);
        let mut q = vec![0.0; self.configurations[0].len()];
        for (weight, of) in weights.iter().zip(&coefficients[first..]) {
            q.iter_mut().zip(of).for_each(|(q, c)| *q += weight * c);
        }
        q
    }

    /// Returns the largest distance of a joint from a given position.
    fn error(&self, coefficients: &Path) -> f64 {
        let of = |(given, place): (&Vec<f64>, &f64)| {
            let is = self.at(coefficients, *place);
            given.iter().zip(is).map(|(given, is)| (given - is).abs()).fold(0.0, f64::max)
        };
        self.configurations.iter().zip(self.places).map(of).fold(0.0, f64::max)
    }

    /// Returns the coefficients with a penalty; `None` if the equations have no solution.
    fn smooth(&self, penalty: f64) -> Option<Path> {
        let (size, joints, last) = (self.pieces + BAND, self.configurations[0].len(), self.places.len() - 1);
        let mut rows = vec![[0.0; BAND + 1]; size];
        let mut right = vec![vec![0.0; joints]; size];
        for (k, (q, place)) in self.configurations.iter().zip(self.places).enumerate() {
            let (first, weights) = self.weights(*place);
            // The ends are where the motion begins and ends.
            let share = if k == 0 || k == last { 1e4 } else { 1.0 };
            for m in 0..4 {
                for n in m..4 {
                    rows[first + m][n - m] += share * weights[m] * weights[n];
                }
                right[first + m].iter_mut().zip(q).for_each(|(r, q)| *r += share * weights[m] * q);
            }
        }
        for first in 0..size - BAND {
            for m in 0..4 {
                for n in m..4 {
                    rows[first + m][n - m] += penalty * THIRD[m] * THIRD[n];
                }
            }
        }
        solve(&mut rows, &mut right).then_some(right)
    }
}

/// Solves symmetric equations with seven diagonals, of which those from the main one on are given, in place; returns
/// whether they are positive definite.
fn solve(rows: &mut [[f64; BAND + 1]], right: &mut [Vec<f64>]) -> bool {
    let n = rows.len();
    for i in 0..n {
        let row = rows[i];
        if row[0].is_nan() || row[0] <= 0.0 {
            return false;
        }
        let (before, after) = right.split_at_mut(i + 1);
        for m in 1..=BAND.min(n - 1 - i) {
            let factor = row[m] / row[0];
            for k in m..=BAND {
                rows[i + m][k - m] -= factor * row[k];
            }
            after[m - 1].iter_mut().zip(&before[i]).for_each(|(a, b)| *a -= factor * b);
        }
    }
    for i in (0..n).rev() {
        let (before, after) = right.split_at_mut(i + 1);
        let own = &mut before[i];
        for m in 1..=BAND.min(n - 1 - i) {
            own.iter_mut().zip(&after[m - 1]).for_each(|(x, known)| *x -= rows[i][m] * known);
        }
        own.iter_mut().for_each(|x| *x /= rows[i][0]);
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_robot::random::Random;

    /// A circle with noise: the fit keeps to it, and has little of the noise's curvature.
    #[test]
    fn noise_within_the_tolerance_is_smoothed_and_all_points_are_passed() {
        let mut random = Random::new(3);
        for (count, noise) in [(10, 0.0), (50, 0.0), (400, 1e-3), (4000, 1e-3)] {
            let at = |k: usize| 1.5 * std::f64::consts::TAU * k as f64 / (count - 1) as f64 / 1.5;
            let mut blur = || noise * random.between(-1.0, 1.0);
            let points: Path = (0..count).map(|k| vec![at(k).cos() + blur(), at(k).sin() + blur(), 0.3]).collect();
            let curve = fit(&points, 5e-3, &FitSettings::default()).unwrap();
            let (mut q, mut farthest, mut sharpest) = (Vec::new(), 0.0_f64, 0.0_f64);
            for k in 0..=1000 {
                let s = curve.length() * f64::from(k) / 1000.0;
                curve.at(s, &mut q);
                farthest = farthest.max((q[0].hypot(q[1]) - 1.0).abs());
                sharpest = sharpest.max(curve.jets(s).map(|jet| jet.d2 * jet.d2).sum::<f64>().sqrt());
            }
            let allowed = if count == 10 { 0.02 } else { 6e-3 };
            assert!(farthest < allowed, "{count} points: {farthest} off the circle");
            assert!(sharpest < 1.3, "{count} points: curvature {sharpest}");
        }
    }
}

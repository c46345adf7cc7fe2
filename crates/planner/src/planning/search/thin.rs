//! Thinning of a recorded path: the fewest waypoints whose straight lines stay within a tolerance of it, in its order
//! (Douglas and Peucker, "Algorithms for the reduction of the number of points required to represent a digitized line",
//! 1973).
//!
//! A recorded motion may go back along its own line, as a wiping motion does: a line is kept only if the record runs
//! along it without turning back by more than the tolerance.

use super::path::Path;

/// Returns the path through the fewest of these points. No joint is farther from its straight lines than `tolerance`
/// [rad] at any point.
pub fn thin(points: &[Vec<f64>], tolerance: f64) -> Path {
    let mut kept = vec![false; points.len()];
    let last = points.len().saturating_sub(1);
    [0, last].into_iter().for_each(|i| kept.iter_mut().skip(i).take(1).for_each(|kept| *kept = true));
    let mut spans = vec![(0, last)];
    while let Some((a, b)) = spans.pop() {
        if let Some((_, worst)) = farthest(points, a, b).filter(|(off, _)| *off > tolerance) {
            kept[worst] = true;
            spans.extend([(a, worst), (worst, b)]);
        }
    }
    points.iter().zip(kept).filter(|(_, kept)| *kept).map(|(q, _)| q.clone()).collect()
}

/// Returns the point between two others that is farthest from their line, or from which the path turns back farthest,
/// and that distance [rad, of one joint]; `None` without a point between them.
fn farthest(points: &[Vec<f64>], a: usize, b: usize) -> Option<(f64, usize)> {
    let (from, to) = (points.get(a)?, points.get(b)?);
    let way: Vec<f64> = from.iter().zip(to).map(|(x, y)| y - x).collect();
    let square: f64 = way.iter().map(|w| w * w).sum();
    let widest = way.iter().fold(0.0_f64, |most, w| most.max(w.abs()));
    let mut worst: Option<(f64, usize)> = None;
    let (mut ahead, mut turn) = (0.0, a);
    for (k, q) in points.iter().enumerate().take(b).skip(a + 1) {
        let along: f64 = q.iter().zip(from).zip(&way).map(|((q, x), w)| (q - x) * w).sum();
        let part = if square > 0.0 { (along / square).clamp(0.0, 1.0) } else { 0.0 };
        let off = q.iter().zip(from).zip(&way).map(|((q, x), w)| (q - x - part * w).abs()).fold(0.0, f64::max);
        // `turn` is the farthest point so far, where the path turned back.
        let back = (ahead - part) * widest;
        if part >= ahead {
            (ahead, turn) = (part, k);
        }
        let (off, at) = if back > off && turn > a { (back, turn) } else { (off, k) };
        if worst.is_none_or(|(most, _)| off > most) {
            worst = Some((off, at));
        }
    }
    worst
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::search::path::tidy;
    use dimos_robot::random::Random;

    /// Largest distance of a joint from the nearest point of a path [rad], in the order of the path.
    fn off(points: &[Vec<f64>], path: &Path) -> f64 {
        let (mut piece, mut most) = (0, 0.0_f64);
        for q in points {
            let distance = |piece: usize| {
                let (a, b) = (&path[piece], &path[piece + 1]);
                (0..=100).fold(f64::MAX, |least, k| {
                    let t = f64::from(k) / 100.0;
                    let off = q.iter().zip(a.iter().zip(b)).map(|(q, (a, b))| (q - a - t * (b - a)).abs());
                    least.min(off.fold(0.0, f64::max))
                })
            };
            while piece + 2 < path.len() && distance(piece + 1) <= distance(piece) {
                piece += 1;
            }
            most = most.max(distance(piece));
        }
        most
    }

    /// A curve that a hand led, with the noise of encoders.
    fn led(noise: f64) -> Vec<Vec<f64>> {
        let mut random = Random::new(7);
        let mut wobble = move || random.between(-noise, noise);
        let at = |k: i32, wobble: f64| {
            let t = f64::from(k) * 0.01;
            vec![0.5 * t.sin() + wobble, 0.3 * (1.3 * t).cos() - wobble, 0.1 * t]
        };
        (0..1000).map(|k| at(k, wobble())).collect()
    }

    #[test]
    fn few_waypoints_stay_within_the_tolerance() {
        let points = led(5e-4);
        let mut before = usize::MAX;
        for tolerance in [0.0015, 0.005, 0.02] {
            let path = thin(&points, tolerance);
            assert!(path.len() < before && path.len() < 150, "{} waypoints at {tolerance} rad", path.len());
            assert!(off(&points, &path) <= tolerance * 1.02, "{tolerance}: {}", off(&points, &path));
            assert!(path.first() == points.first() && path.last() == points.last());
            before = path.len();
        }
    }

    #[test]
    fn a_path_that_goes_back_along_its_own_line_keeps_every_turn() {
        let points: Vec<Vec<f64>> = (0..=400).map(|k| vec![(f64::from(k) * 0.05).sin(), 0.0]).collect();
        let path = thin(&points, 0.005);
        // 20 rad of a sine: six turns between the ends.
        let turns = tidy(path.clone());
        assert_eq!(turns.len(), 8, "{path:?}");
        for q in &turns[1..7] {
            assert!((q[0].abs() - 1.0).abs() < 0.005, "{q:?}");
        }
        assert!(path.len() < 12, "{path:?}");
        // A rest with noise below the tolerance is one line.
        let rest: Vec<Vec<f64>> = (0..100).map(|k| vec![1e-3 * f64::from(k % 2)]).collect();
        assert_eq!(thin(&rest, 0.005).len(), 2);
        assert_eq!(thin(&rest[..1], 0.005).len(), 1);
        assert!(thin(&[], 0.005).is_empty());
    }
}

//! Trajectories with jerk limits: measured sample by sample, as an arm gets them.

use dimos::joint::JointBounds;
use dimos::planning::search::path::{distance, tidy};
use dimos::planning::timing::settings::TimingSettings;
use dimos::planning::timing::{Timed, time};
use dimos::robot::random::Random;
use dimos::trajectory::{Cursor, Sample, Spline};

const NAMES: [&str; 7] = ["a", "b", "c", "d", "e", "f", "g"];

/// Limits of joints that differ.
fn bounds(jerk: f64) -> Vec<JointBounds> {
    let joint = |j: usize| {
        let part = 1.0 + 0.15 * j as f64;
        JointBounds { velocity: 2.0 * part, acceleration: 5.0 / part, jerk: jerk * part, ..JointBounds::NONE }
    };
    (0..7).map(joint).collect()
}

/// `count` waypoints, each at most `step` from the one before in every joint.
fn walk(count: usize, step: f64, seed: u64) -> Vec<Vec<f64>> {
    let mut random = Random::new(seed);
    let mut q = vec![0.0; 7];
    let mut next = || {
        q.iter_mut().for_each(|x| *x += random.between(-step, step));
        q.clone()
    };
    (0..count).map(|_| next()).collect()
}

/// A smooth curve, of many short pieces.
fn wave(count: usize) -> Vec<Vec<f64>> {
    let at = |k: usize| (0..7).map(|j| (0.02 * k as f64 * (1.0 + 0.3 * j as f64) + j as f64).sin()).collect();
    (0..count).map(at).collect()
}

fn timed(path: &[Vec<f64>], bounds: &[JointBounds], deviation: f64) -> Timed {
    let names: Vec<String> = NAMES.iter().map(|n| (*n).to_owned()).collect();
    time(&names, path, bounds, &TimingSettings { deviation, ..TimingSettings::default() }, |_, _| true).unwrap()
}

/// Distance of a configuration from a path.
fn off(path: &[Vec<f64>], q: &[f64]) -> f64 {
    let from = |pair: &[Vec<f64>]| {
        let (a, b) = (&pair[0], &pair[1]);
        let along: f64 = a.iter().zip(b).zip(q).map(|((a, b), q)| (q - a) * (b - a)).sum();
        let t = (along / distance(a, b).powi(2)).clamp(0.0, 1.0);
        let near: Vec<f64> = a.iter().zip(b).map(|(a, b)| a + (b - a) * t).collect();
        distance(&near, q)
    };
    path.windows(2).map(from).fold(f64::INFINITY, f64::min)
}

#[test]
fn every_sample_keeps_all_limits_and_the_corners_deviation() {
    let paths = [walk(2, 1.5, 1), walk(2, 0.003, 2), walk(5, 1.5, 3), walk(40, 0.1, 4), walk(10, 1.5, 5), wave(60)];
    for (number, path) in paths.iter().enumerate() {
        for (deviation, jerk) in [(0.05, 40.0), (0.001, 40.0), (0.05, 600.0), (0.0, 40.0)] {
            let bounds = bounds(jerk);
            let timed = timed(path, &bounds, deviation);
            let what = format!("path {number}, deviation {deviation}, jerk {jerk}");
            let spline = Spline::new(&timed.trajectory).unwrap();
            let (mut cursor, mut samples) = (Cursor::default(), vec![Sample::default(); 7]);
            let mut before = vec![0.0; 7];
            let step = 1e-3;
            for k in 0..=(spline.duration() / step) as usize {
                spline.sample(k as f64 * step, &mut cursor, &mut samples);
                for ((s, b), last) in samples.iter().zip(&bounds).zip(&mut before) {
                    assert!(s.velocity.abs() <= b.velocity * 1.001, "{what}: {} at {k} ms", s.velocity);
                    assert!(s.acceleration.abs() <= b.acceleration * 1.001, "{what}: {} at {k} ms", s.acceleration);
                    let change = (s.acceleration - *last).abs() / step;
                    assert!(change <= b.jerk * 1.01, "{what}: jerk {change} of {} at {k} ms", b.jerk);
                    *last = s.acceleration;
                }
                if k % 10 != 0 {
                    continue;
                }
                let q: Vec<f64> = samples.iter().map(|s| s.position).collect();
                assert!(off(&tidy(path.clone()), &q) <= deviation + 1e-6, "{what}: {} off at {k} ms", off(path, &q));
            }
            assert!(samples.iter().all(|s| s.velocity.abs() < 0.2), "{what} is not at rest at its end");
            assert_eq!(timed.trajectory.points[0].positions[..], path[0]);
            assert_eq!(timed.trajectory.points.last().unwrap().positions[..], *path.last().unwrap());
            assert!(timed.trajectory.points.last().unwrap().velocities.iter().all(|v| *v == 0.0));
        }
    }
}

#[test]
fn a_jerk_limit_costs_little_time_where_lines_are_long() {
    // From rest to full acceleration and back takes 0.1 s at each corner at least; a motion without jerk limits is the
    // quickest there is.
    for seed in 0..3 {
        let path = walk(30, 3.0, seed);
        for deviation in [0.05, 0.001] {
            let quickest = timed(
                &path,
                &[JointBounds { velocity: 2.0, acceleration: 5.0, jerk: f64::INFINITY, ..JointBounds::NONE }; 7],
                deviation,
            );
            let smooth = timed(
                &path,
                &[JointBounds { velocity: 2.0, acceleration: 5.0, jerk: 50.0, ..JointBounds::NONE }; 7],
                deviation,
            );
            let ratio = smooth.duration / quickest.duration;
            assert!((1.0..1.11).contains(&ratio), "seed {seed}, deviation {deviation}: {ratio}");
        }
    }
}

#[test]
fn a_smooth_curve_is_not_slowed_down_at_each_of_its_short_pieces() {
    // At constant speed in each corner it would take twice as long: 10.7 and 5.7 s.
    for (jerk, most) in [(50.0, 5.6), (f64::INFINITY, 2.1)] {
        let bounds = [JointBounds { velocity: 2.0, acceleration: 5.0, jerk, ..JointBounds::NONE }; 7];
        let duration = timed(&wave(60), &bounds, 1e-3).duration;
        assert!(duration < most, "jerk {jerk}: {duration} s");
    }
}

#[test]
fn the_same_path_gets_the_same_trajectory() {
    let path = walk(40, 0.5, 9);
    assert_eq!(timed(&path, &bounds(50.0), 0.02), timed(&path, &bounds(50.0), 0.02));
}

//! Trajectories, the timing of paths, and curves.

use dimos::joint::JointBounds;
use dimos::planning::curve::clock::quickest;
use dimos::planning::curve::fit::fit;
use dimos::planning::curve::settings::{ClockSettings, FitSettings};
use dimos::planning::timing::settings::TimingSettings;
use dimos::planning::timing::time;
use dimos::trajectory::{Cursor, JointTrajectory, Sample, Spline, TrajectoryPoint};

use crate::bytes::Bytes;
use crate::{Target, bug};

/// How far a limit may be exceeded by rounding.
const LIMIT: f64 = 1.0001;
/// Larger numbers may overflow where they are multiplied.
const LARGE: f64 = 1e30;

/// Trajectories as they are given.
pub const TRAJECTORY: Target = Target {
    name: "trajectory",
    about: "a spline within its own extremes, or an error",
    run: trajectory,
    seeds: || vec![(0_u8..90).map(|i| i.wrapping_mul(37) | 8).collect()],
};

fn trajectory(data: &[u8]) {
    let mut from = Bytes(data);
    let (joints, kinds, mut clock) = (1 + from.below(3), from.byte(), 0.0);
    let mut points = Vec::new();
    while !from.is_empty() && points.len() < 24 {
        let mut list = |there: bool| (0..if there { joints } else { 0 }).map(|_| from.number()).collect();
        let point = TrajectoryPoint {
            time_from_start: clock,
            positions: list(true),
            velocities: list(kinds & 1 == 1),
            accelerations: list(kinds & 3 == 3),
        };
        points.push(point);
        clock += if kinds & 4 == 4 { from.number() } else { from.between(1e-4, 2.0) };
    }
    let joint_names = (0..joints).map(|j| format!("j{j}")).collect();
    let trajectory = JointTrajectory { joint_names, points };
    let valid = trajectory.validate();
    let Ok(spline) = Spline::new(&trajectory) else { return };
    assert!(valid.is_ok(), "a spline of what is not valid");
    let values = trajectory.points.iter().flat_map(|p| p.positions.iter().chain(&p.velocities).chain(&p.accelerations));
    let short = trajectory.points.windows(2).any(|pair| pair[1].time_from_start - pair[0].time_from_start < 1e-3);
    if short || values.clone().any(|v| v.abs() > LARGE) {
        return;
    }
    let (mut cursor, mut out) = (Cursor::default(), vec![Sample::default(); joints]);
    for k in 0..=50 {
        spline.sample(spline.duration() * f64::from(k) / 50.0, &mut cursor, &mut out);
        for (joint, sample) in out.iter().enumerate() {
            let most = spline.extremes(joint);
            let within = |value: f64, low: f64, high: f64| {
                let slack = 1e-6 * (1.0 + low.abs().max(high.abs()));
                (low - slack..=high + slack).contains(&value)
            };
            assert!(within(sample.position, most.lowest, most.highest), "{sample:?} beyond {most:?}");
            assert!(within(sample.velocity, -most.fastest, most.fastest), "{sample:?} beyond {most:?}");
            bug(1, most.fastest > 30.0);
        }
    }
    bug(2, trajectory.points.len() == 7);
    bug(3, joints == 3 && kinds & 7 == 3 && trajectory.points.len() > 2);
}

/// A path of configurations, and limits of its joints.
fn path(from: &mut Bytes) -> (Vec<Vec<f64>>, Vec<JointBounds>, Vec<String>) {
    let joints = 1 + from.below(4);
    let with_jerk = from.byte() & 1 == 1;
    let bound = |from: &mut Bytes| JointBounds {
        lower: -3.0,
        upper: 3.0,
        velocity: from.between(0.05, 5.0),
        acceleration: from.between(0.1, 20.0),
        jerk: if with_jerk { from.between(1.0, 500.0) } else { f64::INFINITY },
    };
    let bounds = (0..joints).map(|_| bound(from)).collect();
    let mut path: Vec<Vec<f64>> = Vec::new();
    while path.len() < 2 || (!from.is_empty() && path.len() < 30) {
        // Steps of all sizes, none at all included.
        let scale = [0.0, 1e-12, 1e-9, 1e-6, 1e-3, 0.1, 1.0, 3.0][from.below(8)];
        let last = path.last().cloned().unwrap_or_else(|| vec![0.0; joints]);
        path.push(last.iter().map(|q| (q + from.between(-scale, scale)).clamp(-3.0, 3.0)).collect());
    }
    (path, bounds, (0..joints).map(|j| format!("j{j}")).collect())
}

/// Paths in joint space.
pub const TIMING: Target = Target {
    name: "timing",
    about: "a motion from rest to rest within all limits that passes the ends of its path, or an error",
    run: timing,
    seeds: || vec![(0_u8..120).map(|i| i.wrapping_mul(53) ^ 91).collect()],
};

fn timing(data: &[u8]) {
    let mut from = Bytes(data);
    let settings = TimingSettings {
        deviation: [0.0, 1e-3, 0.05, 0.3][from.below(4)],
        speed: from.between(0.01, 1.0),
        ..TimingSettings::default()
    };
    let (path, bounds, names) = path(&mut from);
    let Ok(timed) = time(&names, &path, &bounds, &settings, |_, _| true) else { return };
    assert!(timed.duration.is_finite() && timed.duration > 0.0);
    let e = timed.excess;
    assert!(e.velocity <= LIMIT && e.acceleration <= LIMIT && e.jerk <= LIMIT, "{e:?}");
    let spline = Spline::new(&timed.trajectory).expect("a motion is a trajectory");
    for (joint, (first, last)) in path[0].iter().zip(&path[path.len() - 1]).enumerate() {
        let far = (spline.start(joint) - first).abs().max((spline.goal(joint) - last).abs());
        assert!(far < 1e-9, "joint {joint} misses its end by {far} rad");
        assert!(spline.extremes(joint).fastest <= LIMIT * bounds[joint].velocity + 1e-9);
    }
    bug(1, timed.duration > 100.0);
    bug(2, path.len() > 20);
    bug(3, names.len() == 4 && timed.deviation.iter().filter(|d| **d > 0.0).count() > 2);
}

/// Curves through configurations.
pub const CURVE: Target = Target {
    name: "curve",
    about: "the quickest motion within all limits, or none",
    run: curve,
    seeds: || vec![(0_u8..120).map(|i| i.wrapping_mul(29) ^ 17).collect()],
};

fn curve(data: &[u8]) {
    let mut from = Bytes(data);
    let tolerance = [1e-6, 1e-4, 1e-3, 0.05][from.below(4)];
    let (path, bounds, _) = path(&mut from);
    let Some(curve) = fit(&path, tolerance, &FitSettings::default()) else { return };
    assert!(curve.length().is_finite() && curve.length() > 0.0);
    let Some((states, excess)) = quickest(&curve, &bounds, |_, _| 0.0, &ClockSettings::default()) else { return };
    assert!(excess.velocity <= LIMIT && excess.acceleration <= LIMIT && excess.jerk <= LIMIT, "{excess:?}");
    let times = states.times();
    assert!(times.windows(2).all(|pair| pair[0] < pair[1]) && times.iter().all(|t| t.is_finite()), "{times:?}");
    bug(1, times.last().is_some_and(|end| *end > 60.0));
    bug(2, path.len() > 12 && tolerance > 0.01);
    bug(3, bounds.len() == 2 && bounds.iter().all(|bound| bound.velocity < 0.5));
}

//! Time parameterization: blended corners, the highest speeds that the limits allow, and a check of the result.
//!
//! Corners are passed at constant speed ([`constant_corner_speed`](super::constant_corner_speed)): the points are where
//! the jerk changes, and the spline through them is the motion. Where lines are short, the speed changes in corners too
//! ([`topp`](super::topp)). Then, without jerk limits, the points are the grid points of the speed profile. With jerk
//! limits the parameter's motion `s(t)` is averaged over a time window, which keeps the curve and limits the jerk.

use crate::joint::DEFAULT_ACCELERATION;
use crate::robot::model::Limits;
use crate::trajectory::{JointTrajectory, TrajectoryError, TrajectoryPoint};

use super::blend::{Curve, curves};
use super::constant_corner_speed::RoundedPath;
use super::jerk_limit::averaged;
use super::path::{Path, tidy_indices};
use super::topp::{GridPoint, JointBound, parameterize};
use super::verify::{Excess, excess};

/// Largest distance of a corner's curve from the straight pieces that are checked in its place [rad].
const SAGITTA: f64 = 2e-4;

/// Settings of the time parameterization.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimingSettings {
    /// Maximum deviation at corners [rad, Euclidean over all joints]; 0: the motion rests at every corner.
    pub deviation: f64,
    /// Part of the full speed, above 0 and at most 1: scales the motion in time.
    pub speed: f64,
}

impl Default for TimingSettings {
    fn default() -> Self {
        Self { deviation: 0.05, speed: 1.0 }
    }
}

/// A trajectory and its figures.
#[derive(Debug, Clone, PartialEq)]
pub struct Timed {
    /// The trajectory.
    pub trajectory: JointTrajectory,
    /// Its duration [s].
    pub duration: f64,
    /// Deviation at each corner [rad]; 0 where the motion rests.
    pub deviation: Vec<f64>,
    /// Largest part of its limits that the motion uses: an upper bound, measured on its spline ([`excess`]).
    pub excess: Excess,
}

/// Why a path has no time parameterization.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TimingError {
    /// The path has no length.
    #[error("the path does not move")]
    NoMotion,
    /// A value is not finite, or a configuration has the wrong number of joints.
    #[error("configuration {0} of the path is not a configuration of {1} joints with finite positions")]
    Shape(usize, usize),
    /// A joint has no positive finite limit.
    #[error("joint {0:?} needs a positive and finite limit of {1}")]
    Limit(String, &'static str),
    /// The speed is out of range.
    #[error("the speed must be above 0 and at most 1, not {0}")]
    Speed(f64),
    /// The motion would collide.
    #[error("the timed motion collides between {0:.3} s and {1:.3} s")]
    NotFree(f64, f64),
    /// The result is not a valid trajectory.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryError),
}

/// Returns the bounds of joints: the given limits, [`DEFAULT_ACCELERATION`] if there is no acceleration limit, an
/// infinite jerk if there is no jerk limit.
pub fn bounds(names: &[String], limits: &[Limits]) -> Result<Vec<JointBound>, TimingError> {
    let bound = |(name, l): (&String, &Limits)| {
        let acceleration = l.acceleration.unwrap_or(DEFAULT_ACCELERATION);
        let jerk = l.jerk.unwrap_or(f64::INFINITY);
        for (what, x) in [("velocity", l.velocity), ("acceleration", acceleration)] {
            if x <= 0.0 || !x.is_finite() {
                return Err(TimingError::Limit(name.clone(), what));
            }
        }
        if jerk <= 0.0 || jerk.is_nan() {
            return Err(TimingError::Limit(name.clone(), "jerk"));
        }
        Ok(JointBound { velocity: l.velocity, acceleration, jerk })
    };
    names.iter().zip(limits).map(bound).collect()
}

/// Times a path. `free` tests the straight motion between two configurations: corners that collide are blended less, at
/// last not at all, and the complete trajectory is checked at the end.
pub fn time(
    names: &[String],
    path: &[Vec<f64>],
    bounds: &[JointBound],
    settings: &TimingSettings,
    free: impl FnMut(&[f64], &[f64]) -> bool,
) -> Result<Timed, TimingError> {
    time_within(names, path, bounds, &vec![settings.deviation; path.len()], settings.speed, free)
}

/// Times a path as [`time`] does, with a maximum deviation for each of its configurations [rad, Euclidean over all
/// joints]. Where it is 0 the motion rests.
pub fn time_within(
    names: &[String],
    path: &[Vec<f64>],
    bounds: &[JointBound],
    deviation: &[f64],
    speed: f64,
    mut free: impl FnMut(&[f64], &[f64]) -> bool,
) -> Result<Timed, TimingError> {
    let dof = names.len();
    let bad = |q: &Vec<f64>| q.len() != dof || q.iter().any(|x| !x.is_finite());
    if let Some(at) = path.iter().position(bad) {
        return Err(TimingError::Shape(at, dof));
    }
    if !(speed > 0.0 && speed <= 1.0) {
        return Err(TimingError::Speed(speed));
    }
    let kept = tidy_indices(path);
    let path: Path = kept.iter().map(|i| path[*i].clone()).collect();
    if path.len() < 2 || bounds.len() != dof {
        return Err(TimingError::NoMotion);
    }
    let of = |i: &usize| deviation.get(*i).copied().unwrap_or(0.0).max(0.0);
    let deviation: Vec<f64> = kept.iter().map(of).collect();
    let rounded = RoundedPath::new(&path, bounds, &deviation);
    if variable_is_quicker(&rounded, &path, bounds, &deviation) {
        at_variable_corner_speed(names, &path, bounds, deviation, speed, &mut free)
    } else {
        at_constant_corner_speed(names, (&path, rounded), bounds, deviation, speed, &mut free)
    }
}

/// Returns whether a motion that changes its speed in corners is quicker than one that does not. It takes ten times as
/// long to compute, so it is not where it would gain little.
fn variable_is_quicker(rounded: &RoundedPath<'_>, path: &Path, bounds: &[JointBound], deviation: &[f64]) -> bool {
    let speeds = rounded.speeds();
    if rounded.suits(&speeds) {
        return false;
    }
    let duration = |curve: &Curve| {
        let mut points = at_variable_speed(curve, bounds);
        slow_down(&mut points, bounds);
        points.last().map_or(0.0, |p| p.time_from_start)
    };
    curves(path, deviation).iter().map(duration).sum::<f64>() < rounded.duration(&speeds)
}

/// Times a path whose corners are passed at constant speed.
fn at_constant_corner_speed(
    names: &[String],
    (path, mut rounded): (&Path, RoundedPath<'_>),
    bounds: &[JointBound],
    mut deviation: Vec<f64>,
    speed: f64,
    free: &mut impl FnMut(&[f64], &[f64]) -> bool,
) -> Result<Timed, TimingError> {
    let (mut from, mut to) = (path[0].clone(), path[0].clone());
    for (i, deviation) in deviation.iter_mut().enumerate().take(path.len() - 1).skip(1) {
        while !corner_is_free(&rounded, i, (&mut from, &mut to), free) {
            *deviation = if *deviation > 2e-3 { *deviation * 0.4 } else { 0.0 };
            rounded.blend(i, *deviation);
        }
    }
    let mut points = rounded.motion(&rounded.speeds());
    let excess = slow_down(&mut points, bounds);
    // What is between the corners was part of the path, and is all that the motion passes besides.
    for i in 0..path.len() - 1 {
        rounded.ends_of_line(i, &mut from, &mut to);
        if !free(&from, &to) {
            return Err(TimingError::NotFree(0.0, points.last().map_or(0.0, |p| p.time_from_start)));
        }
    }
    finished(names, path, (points, excess), deviation, speed)
}

/// Returns whether a corner is free, in pieces that are as straight as the motion is checked elsewhere.
fn corner_is_free(
    rounded: &RoundedPath<'_>,
    i: usize,
    (from, to): (&mut Vec<f64>, &mut Vec<f64>),
    free: &mut impl FnMut(&[f64], &[f64]) -> bool,
) -> bool {
    let pieces = rounded.pieces(i, SAGITTA);
    rounded.in_corner(i, 0.0, to);
    (1..=pieces).all(|k| {
        std::mem::swap(from, to);
        rounded.in_corner(i, k as f64 / pieces as f64, to);
        free(from, to)
    })
}

/// Times a path by time-optimal path parameterization, with jerk limits by averaging.
fn at_variable_corner_speed(
    names: &[String],
    path: &Path,
    bounds: &[JointBound],
    mut deviation: Vec<f64>,
    speed: f64,
    free: &mut impl FnMut(&[f64], &[f64]) -> bool,
) -> Result<Timed, TimingError> {
    let rounded = round_corners(path, &mut deviation, free);
    let mut timed = emit(names, path, bounds, &rounded, deviation, speed)?;
    if free_throughout(&timed.trajectory, free).is_err() {
        // Between its points the trajectory deviates slightly from a blended curve. Without blending it does not.
        let sharp = vec![0.0; path.len()];
        timed = emit(names, path, bounds, &curves(path, &sharp), sharp, speed)?;
        free_throughout(&timed.trajectory, free)?;
    }
    Ok(timed)
}

/// Returns the curves with blended corners, sharpened until they are free.
fn round_corners(path: &Path, deviation: &mut [f64], free: &mut impl FnMut(&[f64], &[f64]) -> bool) -> Vec<Curve> {
    let (mut from, mut to) = (path[0].clone(), path[0].clone());
    let mut rounded = curves(path, deviation);
    for _ in 0..8 {
        let mut blocked = Vec::new();
        for piece in rounded.iter().flatten().filter(|p| p.bends) {
            let mut passes = |k: usize| {
                let s = piece.length * k as f64 / 8.0;
                std::mem::swap(&mut from, &mut to);
                to.iter_mut().zip(piece.jets(s)).for_each(|(q, jet)| *q = jet.q);
                k == 0 || free(&from, &to)
            };
            if !(0..=8).all(&mut passes) {
                blocked.push(piece.corner);
            }
        }
        if blocked.is_empty() {
            break;
        }
        for corner in blocked {
            deviation[corner] = if deviation[corner] > 2e-3 { deviation[corner] * 0.4 } else { 0.0 };
        }
        rounded = curves(path, deviation);
    }
    rounded
}

fn emit(
    names: &[String],
    path: &Path,
    bounds: &[JointBound],
    curves: &[Curve],
    deviation: Vec<f64>,
    speed: f64,
) -> Result<Timed, TimingError> {
    let mut points: Vec<TrajectoryPoint> = Vec::new();
    let mut excess = Excess::default();
    for curve in curves {
        let mut own = at_variable_speed(curve, bounds);
        excess = excess.max(slow_down(&mut own, bounds));
        let start = points.last().map_or(0.0, |p| p.time_from_start);
        let skip = usize::from(!points.is_empty());
        points.extend(own.into_iter().skip(skip).map(|mut p| {
            p.time_from_start += start;
            p
        }));
    }
    finished(names, path, (points, excess), deviation, speed)
}

/// Returns the points of the motion along a curve, before it is slowed down to what its spline needs.
fn at_variable_speed(curve: &Curve, bounds: &[JointBound]) -> Vec<TrajectoryPoint> {
    let jerky = bounds.iter().any(|b| b.jerk.is_finite());
    if jerky { averaged(curve, bounds) } else { on_grid(curve, &parameterize(curve, bounds)) }
}

/// Returns a trajectory of points that keep the bounds, at a part of its speed.
fn finished(
    names: &[String],
    path: &Path,
    (mut points, excess): (Vec<TrajectoryPoint>, Excess),
    deviation: Vec<f64>,
    speed: f64,
) -> Result<Timed, TimingError> {
    // The ends are exactly those of the path.
    if let (Some(first), Some(last)) = (points.first_mut(), path.first()) {
        first.positions.clone_from(last);
    }
    if let (Some(end), Some(goal)) = (points.last_mut(), path.last()) {
        end.positions.clone_from(goal);
    }
    stretch(&mut points, 1.0 / speed);
    let trajectory = JointTrajectory { joint_names: names.to_vec(), points };
    trajectory.validate()?;
    let excess = excess.stretched(1.0 / speed);
    let duration = trajectory.points.last().map_or(0.0, |p| p.time_from_start);
    Ok(Timed { trajectory, duration, deviation, excess })
}

/// Returns the grid points themselves.
fn on_grid(curve: &Curve, grid: &[GridPoint]) -> Vec<TrajectoryPoint> {
    let mut points: Vec<TrajectoryPoint> = Vec::with_capacity(grid.len());
    let last = grid.len().saturating_sub(1);
    for (i, g) in grid.iter().enumerate() {
        // Points closer than this add no information.
        let near = |p: &TrajectoryPoint| g.time - p.time_from_start < 2e-4;
        if points.len() > 1 && points.last().is_some_and(near) {
            if i < last {
                continue;
            }
            points.pop();
        }
        let (piece, speed) = (&curve[g.piece], g.x.sqrt());
        let (positions, velocities) = piece.jets(g.at).map(|jet| (jet.q, jet.d1 * speed)).unzip();
        points.push(TrajectoryPoint { time_from_start: g.time, positions, velocities, accelerations: Vec::new() });
    }
    points
}

/// Stretches points in time until their spline keeps all bounds; returns the use of the limits afterwards.
fn slow_down(points: &mut [TrajectoryPoint], bounds: &[JointBound]) -> Excess {
    let found = excess(points, bounds);
    let factor = match found.slower() {
        slower if slower > 1.0 => slower * (1.0 + 1e-9),
        _ => 1.0,
    };
    stretch(points, factor);
    found.stretched(factor)
}

/// Stretches the same motion in time by a factor.
fn stretch(points: &mut [TrajectoryPoint], factor: f64) {
    if factor == 1.0 {
        return;
    }
    let inverse = 1.0 / factor;
    for p in points {
        p.time_from_start *= factor;
        p.velocities.iter_mut().for_each(|v| *v *= inverse);
        p.accelerations.iter_mut().for_each(|a| *a *= inverse * inverse);
    }
}

/// Checks the motion as it will be sampled: from each point to the middle of its segment, and on to the next.
fn free_throughout(
    trajectory: &JointTrajectory,
    free: &mut impl FnMut(&[f64], &[f64]) -> bool,
) -> Result<(), TimingError> {
    let mut middle = vec![0.0; trajectory.joint_names.len()];
    for pair in trajectory.points.windows(2) {
        let (a, b) = (&pair[0], &pair[1]);
        let h = b.time_from_start - a.time_from_start;
        // Cubic or quintic segment.
        let (first, second) = if a.accelerations.is_empty() { (h / 8.0, 0.0) } else { (h * 5.0 / 32.0, h * h / 64.0) };
        for (j, q) in middle.iter_mut().enumerate() {
            let sum = |p: &TrajectoryPoint| p.accelerations.get(j).copied().unwrap_or(0.0);
            *q = 0.5 * (a.positions[j] + b.positions[j])
                + first * (a.velocities[j] - b.velocities[j])
                + second * (sum(a) + sum(b));
        }
        if !free(&a.positions, &middle) || !free(&middle, &b.positions) {
            return Err(TimingError::NotFree(a.time_from_start, b.time_from_start));
        }
    }
    Ok(())
}

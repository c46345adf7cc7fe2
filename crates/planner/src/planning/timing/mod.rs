//! Time parameterization: blended corners, the highest speeds that the limits allow, and a check of the result.
//!
//! Corners are passed at constant speed ([`constant_corner_speed`](constant_corner_speed)): the points are where
//! the jerk changes, and the spline through them is the motion. Where lines are short, the speed changes in corners too
//! ([`topp`](topp)). Then, without jerk limits, the points are the grid points of the speed profile. With jerk
//! limits the parameter's motion `s(t)` is averaged over a time window, which keeps the curve and limits the jerk.

pub mod blend;
pub(in crate::planning) mod constant_corner_speed;
pub(in crate::planning) mod jerk_limit;
pub mod settings;
pub mod tool_timing;
pub mod topp;
pub mod verify;

use std::borrow::Cow;

use dimos_kernels::states::{Eight, States};

use dimos_core::joint::{DEFAULT_ACCELERATION, JointBounds};
use dimos_core::trajectory::{JointTrajectory, JointValues, TrajectoryError, TrajectoryPoint};
use dimos_robot::model::Limits;

use self::blend::{Curve, curves};
use self::constant_corner_speed::RoundedPath;
use self::jerk_limit::averaged;
use self::settings::{CornerSettings, TimingSettings};
use self::topp::{GridPoint, parameterize};
use self::verify::{Excess, excess};
use crate::planning::search::path::tidy_indices;

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
pub fn bounds(names: &[String], limits: &[Limits]) -> Result<Vec<JointBounds>, TimingError> {
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
        Ok(JointBounds { lower: l.lower, upper: l.upper, velocity: l.velocity, acceleration, jerk })
    };
    names.iter().zip(limits).map(bound).collect()
}

/// Times a path. `free` tests the straight motion between two configurations: corners that collide are blended less, at
/// last not at all, and the complete trajectory is checked at the end.
pub fn time(
    names: &[String],
    path: &[Vec<f64>],
    bounds: &[JointBounds],
    settings: &TimingSettings,
    free: impl FnMut(&[f64], &[f64]) -> bool,
) -> Result<Timed, TimingError> {
    time_within(names, path, bounds, &vec![settings.deviation; path.len()], settings, free)
}

/// Times a path as [`time`] does, with a maximum deviation for each of its configurations [rad, Euclidean over all
/// joints], in place of that of the settings. Where it is 0 the motion rests.
pub fn time_within(
    names: &[String],
    path: &[Vec<f64>],
    bounds: &[JointBounds],
    deviation: &[f64],
    settings: &TimingSettings,
    mut free: impl FnMut(&[f64], &[f64]) -> bool,
) -> Result<Timed, TimingError> {
    let (dof, speed) = (names.len(), settings.speed);
    let bad = |q: &Vec<f64>| q.len() != dof || q.iter().any(|x| !x.is_finite());
    if let Some(at) = path.iter().position(bad) {
        return Err(TimingError::Shape(at, dof));
    }
    if !(speed > 0.0 && speed <= 1.0) {
        return Err(TimingError::Speed(speed));
    }
    let kept = tidy_indices(path);
    let path: Cow<'_, [Vec<f64>]> =
        if kept.len() == path.len() { path.into() } else { kept.iter().map(|i| path[*i].clone()).collect() };
    if path.len() < 2 || bounds.len() != dof {
        return Err(TimingError::NoMotion);
    }
    let of = |i: &usize| deviation.get(*i).copied().unwrap_or(0.0).max(0.0);
    let deviation: Vec<f64> = kept.iter().map(of).collect();
    let rounded = RoundedPath::new(&path, bounds, &deviation, &settings.corners);
    let speeds = rounded.speeds();
    if variable_is_quicker((&rounded, &speeds), &path, bounds, &deviation, settings) {
        at_variable_corner_speed(names, &path, bounds, deviation, settings, &mut free)
    } else {
        at_constant_corner_speed(names, (&path, rounded, speeds), bounds, deviation, settings, &mut free)
    }
}

/// Returns whether a motion that changes its speed in corners is quicker than one that does not. It takes ten times as
/// long to compute, so it is not where it would gain little.
fn variable_is_quicker(
    (rounded, speeds): (&RoundedPath, &[f64]),
    path: &[Vec<f64>],
    bounds: &[JointBounds],
    deviation: &[f64],
    settings: &TimingSettings,
) -> bool {
    if rounded.suits(speeds) {
        return false;
    }
    let duration = |curve: &Curve| {
        let mut states = at_variable_speed(curve, bounds, settings);
        slow_down(&mut states, bounds);
        states.duration()
    };
    curves(path, deviation).iter().map(duration).sum::<f64>() < rounded.duration(speeds)
}

/// Times a path whose corners are passed at constant speed.
fn at_constant_corner_speed(
    names: &[String],
    (path, mut rounded, mut speeds): (&[Vec<f64>], RoundedPath, Vec<f64>),
    bounds: &[JointBounds],
    mut deviation: Vec<f64>,
    settings: &TimingSettings,
    free: &mut impl FnMut(&[f64], &[f64]) -> bool,
) -> Result<Timed, TimingError> {
    let (mut from, mut to) = (path[0].clone(), path[0].clone());
    let (mut factors, mut places) = (Vec::new(), Vec::new());
    let mut sharper = false;
    for (i, deviation) in deviation.iter_mut().enumerate().take(path.len() - 1).skip(1) {
        // In pieces that are as straight as the motion is checked elsewhere.
        let mut is_free = |rounded: &RoundedPath| {
            let each = rounded.corner(i, settings.corners.sagitta, &mut factors, &mut places);
            let place = |k: usize| &places[k * each..(k + 1) * each].as_flattened()[..names.len()];
            (1..places.len() / each).all(|k| free(place(k - 1), place(k)))
        };
        while !is_free(&rounded) {
            *deviation = settings.corners.sharper(*deviation);
            rounded.blend(i, *deviation);
            sharper = true;
        }
    }
    if sharper {
        speeds = rounded.speeds();
    }
    let mut states = rounded.motion(&speeds);
    let excess = slow_down(&mut states, bounds);
    // The lines between the corners were part of the path, and complete the motion.
    for i in 0..path.len() - 1 {
        rounded.ends_of_line(i, &mut from, &mut to);
        if !free(&from, &to) {
            return Err(TimingError::NotFree(0.0, states.duration()));
        }
    }
    finished(names, path, bounds, (states, excess), deviation, settings.speed)
}

/// Times a path by time-optimal path parameterization, with jerk limits by averaging.
fn at_variable_corner_speed(
    names: &[String],
    path: &[Vec<f64>],
    bounds: &[JointBounds],
    mut deviation: Vec<f64>,
    settings: &TimingSettings,
    free: &mut impl FnMut(&[f64], &[f64]) -> bool,
) -> Result<Timed, TimingError> {
    let rounded = round_corners(path, &mut deviation, &settings.corners, free);
    let mut timed = emit(names, path, bounds, &rounded, deviation, settings)?;
    if free_throughout(&timed.trajectory, free).is_err() {
        // Between its points the trajectory deviates slightly from a blended curve. Without blending it does not.
        let sharp = vec![0.0; path.len()];
        timed = emit(names, path, bounds, &curves(path, &sharp), sharp, settings)?;
        free_throughout(&timed.trajectory, free)?;
    }
    Ok(timed)
}

/// Returns the curves with blended corners, sharpened until they are free.
fn round_corners(
    path: &[Vec<f64>],
    deviation: &mut [f64],
    settings: &CornerSettings,
    free: &mut impl FnMut(&[f64], &[f64]) -> bool,
) -> Vec<Curve> {
    let (mut from, mut to) = (path[0].clone(), path[0].clone());
    let mut rounded = curves(path, deviation);
    for _ in 0..settings.max_sharpenings {
        let mut blocked = Vec::new();
        for piece in rounded.iter().flatten().filter(|p| p.bends) {
            let mut passes = |k: usize| {
                let s = piece.length * k as f64 / settings.pieces as f64;
                std::mem::swap(&mut from, &mut to);
                to.iter_mut().zip(piece.jets(s)).for_each(|(q, jet)| *q = jet.q);
                k == 0 || free(&from, &to)
            };
            if !(0..=settings.pieces).all(&mut passes) {
                blocked.push(piece.corner);
            }
        }
        if blocked.is_empty() {
            break;
        }
        for corner in blocked {
            deviation[corner] = settings.sharper(deviation[corner]);
        }
        rounded = curves(path, deviation);
    }
    rounded
}

fn emit(
    names: &[String],
    path: &[Vec<f64>],
    bounds: &[JointBounds],
    curves: &[Curve],
    deviation: Vec<f64>,
    settings: &TimingSettings,
) -> Result<Timed, TimingError> {
    let mut states = States::new(names.len(), 0);
    let mut excess = Excess::default();
    for curve in curves {
        let mut own = at_variable_speed(curve, bounds, settings);
        excess = excess.max(slow_down(&mut own, bounds));
        let start = states.duration();
        states.append(&own, start);
    }
    finished(names, path, bounds, (states, excess), deviation, settings.speed)
}

/// Returns whether the spline through states is quintic: with jerk limits accelerations have no jumps.
fn is_quintic(bounds: &[JointBounds]) -> bool {
    bounds.iter().any(|b| b.jerk.is_finite())
}

/// Returns the states of the motion along a curve, before it is slowed down to what its spline needs.
fn at_variable_speed(curve: &Curve, bounds: &[JointBounds], settings: &TimingSettings) -> States {
    if is_quintic(bounds) {
        averaged(curve, bounds, settings)
    } else {
        on_grid(curve, &parameterize(curve, bounds, settings.corner_intervals))
    }
}

/// Returns the trajectory of states that keep the bounds, at a part of its speed.
fn finished(
    names: &[String],
    path: &[Vec<f64>],
    bounds: &[JointBounds],
    (mut states, excess): (States, Excess),
    deviation: Vec<f64>,
    speed: f64,
) -> Result<Timed, TimingError> {
    // The ends are exactly those of the path.
    if let Some(last) = states.times().len().checked_sub(1) {
        for (state, q) in [(0, &path[0]), (last, &path[path.len() - 1])] {
            states.values_mut(state, 0).copy_from_slice(q);
        }
    }
    states.stretch(1.0 / speed);
    let trajectory = trajectory_of(names, &states, is_quintic(bounds))?;
    let excess = excess.stretched(1.0 / speed);
    Ok(Timed { trajectory, duration: states.duration(), deviation, excess })
}

/// Returns the trajectory of states, with accelerations if it is quintic.
pub(in crate::planning) fn trajectory_of(
    names: &[String],
    states: &States,
    quintic: bool,
) -> Result<JointTrajectory, TimingError> {
    let point = |time_from_start: f64, [positions, velocities, accelerations]: [JointValues; 3]| TrajectoryPoint {
        time_from_start,
        positions,
        velocities,
        accelerations: if quintic { accelerations } else { JointValues::new() },
    };
    let times = states.times().iter();
    let points = match states.in_one_block() {
        // Avoids a second copy.
        Some(rows) => {
            let list = |row: &Eight| JointValues::from_buf_and_len(*row, names.len());
            times.zip(rows).map(|(time, [p, v, a])| point(*time, [list(p), list(v), list(a)])).collect()
        }
        None => {
            let list = |state, which| JointValues::from_slice(states.values(state, which));
            times.enumerate().map(|(i, time)| point(*time, [list(i, 0), list(i, 1), list(i, 2)])).collect()
        }
    };
    let trajectory = JointTrajectory { joint_names: names.to_vec(), points };
    // The trajectory reports errors; this check is faster where there is none.
    if !states.are_finite_and_in_order() {
        trajectory.validate()?;
    }
    Ok(trajectory)
}

/// Returns the grid points themselves.
fn on_grid(curve: &Curve, grid: &[GridPoint]) -> States {
    let joints = curve.first().map_or(0, |piece| piece.start.len());
    let mut states = States::new(joints, grid.len());
    let last = grid.len().saturating_sub(1);
    for (i, g) in grid.iter().enumerate() {
        // Points closer than this add no information.
        if states.times().len() > 1 && g.time - states.duration() < 2e-4 {
            if i < last {
                continue;
            }
            states.pop();
        }
        let speed = g.x.sqrt();
        states.push(g.time, curve[g.piece].jets(g.at).map(|jet| [jet.q, jet.d1 * speed, 0.0]));
    }
    states
}

/// Stretches a motion in time until its spline keeps all bounds; returns the use of the limits afterwards.
fn slow_down(states: &mut States, bounds: &[JointBounds]) -> Excess {
    let found = excess(states, bounds, is_quintic(bounds));
    let factor = match found.slower() {
        slower if slower > 1.0 => slower * (1.0 + 1e-9),
        _ => 1.0,
    };
    states.stretch(factor);
    found.stretched(factor)
}

/// Checks the motion as it will be sampled: from each point to the middle of its segment, and on to the next.
pub(in crate::planning) fn free_throughout(
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

//! Speeds: what is ordered, and what the arm's limits promise.

use std::collections::VecDeque;
use std::f64::consts::PI;
use std::time::{Duration, Instant};

use super::Check;
use super::Needs::Motion;
use super::context::{Context, between, pause, require};
use dimos_core::joint::ControlMode;

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Motion, "planned_speed_is_kept", "a planned motion is as fast as it was ordered", planned_speed),
    Check::new(Motion, "fast_set_points_are_followed", "setpoints at half of velocity_max are followed", fast_stream),
];

/// Speed of a slow move, as a fraction of the top speed.
const SLOW: f64 = 0.1;
/// Its length [rad].
const SLOW_WAY: f64 = 0.3;
/// Speeds are averages over this time [s].
const WINDOW: f64 = 0.1;
/// A joint may be this many times as fast as ordered: readings on a busy machine are late.
const TOO_FAST: f64 = 2.5;
/// The joint that determines the duration must be this many times as fast as ordered at least, once on the way.
const TOO_SLOW: f64 = 0.4;

/// Peak speed of a fast stream, as a fraction of the top speed, and its duration [s].
const FAST: f64 = 0.5;
const FAST_TIME: f64 = 0.6;
/// Time between its setpoints [s].
const STEP: f64 = 0.01;
/// Part of a joint's way that may be missing after the last setpoint. With a tenth of `velocity_max`, more than two
/// thirds are missing.
const MISSING: f64 = 0.25;

fn planned_speed(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::Position) {
        return context.skip("it has no position mode");
    }
    slow_move(context, |_| Ok(()))
}

/// Moves slowly for a second, and does something on the way. Fails if a joint is much faster than ordered, or the arm
/// much slower.
pub fn slow_move(
    context: &mut Context,
    on_the_way: impl FnOnce(&mut Context) -> Result<(), String>,
) -> Result<(), String> {
    context.ready(ControlMode::Position)?;
    let (start, limits) = (context.positions()?, context.limits()?);
    let ranges = limits.position_lower.iter().zip(&limits.position_upper);
    let away = |(q, (lower, upper)): (&f64, (&f64, &f64))| match (q + SLOW_WAY <= *upper, q - SLOW_WAY >= *lower) {
        (true, _) => q + SLOW_WAY,
        (false, true) => q - SLOW_WAY,
        (false, false) => *q,
    };
    let target: Vec<f64> = start.iter().zip(ranges).map(away).collect();
    // All ways are equal: the slowest joint determines the duration, where the arm coordinates its joints.
    let moved = target.iter().zip(&start).zip(&limits.velocity_max).enumerate().filter(|(_, ((a, b), _))| a != b);
    let slowest = moved.map(|(i, (_, top))| (i, SLOW * top)).min_by(|(_, a), (_, b)| a.total_cmp(b));
    context.command(&target, SLOW)?;
    let (began, mut on_the_way, mut seen) = (Instant::now(), Some(on_the_way), VecDeque::new());
    let mut reached: Option<f64> = None;
    while began.elapsed() < Duration::from_secs(1) {
        pause(&mut *context.adapter, Duration::from_millis(10));
        if began.elapsed() > Duration::from_millis(300)
            && let Some(act) = on_the_way.take()
        {
            act(context)?;
        }
        let reading = context.joints()?;
        let now = reading.stamp.map_or(began.elapsed().as_secs_f64(), |stamp| stamp.0 as f64 * 1e-9);
        seen.push_back((now, reading.position));
        while seen.get(1).is_some_and(|(then, _)| now - then >= WINDOW) {
            seen.pop_front();
        }
        let Some((then, before)) = seen.front().filter(|(then, _)| now - then >= WINDOW) else { continue };
        let moved = reading.position.iter().zip(before).map(|(now, before)| (now - before).abs());
        for (i, (moved, top)) in moved.zip(&limits.velocity_max).enumerate() {
            let (speed, ordered) = (moved / (now - then), SLOW * top);
            require(speed <= TOO_FAST * ordered, || {
                format!("joint {} moves at {speed:.2} rad/s, ordered were {ordered:.2}", i + 1)
            })?;
            if slowest.is_some_and(|(slowest, _)| slowest == i) {
                reached = Some(reached.unwrap_or_default().max(speed));
            }
        }
    }
    let (Some((joint, ordered)), Some(reached)) = (slowest, reached) else { return Ok(()) };
    require(reached >= TOO_SLOW * ordered, || {
        format!("joint {} moves at {reached:.3} rad/s at most, ordered were {ordered:.3}", joint + 1)
    })
}

/// An arm that limits its setpoints to less than the `velocity_max` that it states falls behind its trajectories.
fn fast_stream(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::ServoPosition) {
        return context.skip("it has no servo mode");
    }
    context.ready(ControlMode::ServoPosition)?;
    let (home, limits) = (context.positions()?, context.limits()?);
    // Half a cosine wave; its peak acceleration is at most half of what the arm allows.
    let accelerations = limits.acceleration_max.iter().zip(&limits.velocity_max);
    let time = accelerations.map(|(most, top)| 2.0 * PI * FAST * top / most).fold(FAST_TIME, f64::max);
    let ranges = limits.position_lower.iter().zip(&limits.position_upper);
    let away: Vec<f64> = home
        .iter()
        .zip(ranges)
        .zip(&limits.velocity_max)
        .map(|((q, (lower, upper)), top)| {
            let way = 2.0 / PI * FAST * top * time;
            if upper - q > q - lower { q + way.min(0.8 * (upper - q)) } else { q - way.min(0.8 * (q - lower)) }
        })
        .collect();
    // A busy machine may keep the emulator from moving; an arm that is too slow fails every time.
    let mut result = stream_in_turn(context, &home, &away, time);
    for _ in 0..2 {
        if result.is_err() {
            let here = context.standstill()?;
            if context.stream(&here, &home).is_err() {
                return result;
            }
            result = stream_in_turn(context, &home, &away, time);
        }
    }
    result
}

/// Streams one joint after another, from the base on: together they would make the tool faster than some controllers
/// allow.
fn stream_in_turn(context: &mut Context, home: &[f64], away: &[f64], time: f64) -> Result<(), String> {
    let mut from = home.to_vec();
    for joint in 0..home.len() {
        let mut to = from.clone();
        if let (Some(to), Some(away)) = (to.get_mut(joint), away.get(joint)) {
            *to = *away;
        }
        stream_fast(context, &from, &to, time)?;
        from = to;
    }
    Ok(())
}

fn stream_fast(context: &mut Context, from: &[f64], to: &[f64], time: f64) -> Result<(), String> {
    let steps = (time / STEP).ceil();
    for step in 1..=steps as u32 {
        let part = 0.5 - 0.5 * (f64::from(step) / steps * PI).cos();
        context.command(&between(from, to, part), 1.0)?;
        pause(&mut *context.adapter, Duration::from_secs_f64(STEP));
    }
    let (reached, most) = (context.positions()?, context.droop());
    let tops = context.limits()?.velocity_max;
    for (i, (((a, b), reached), top)) in from.iter().zip(to).zip(&reached).zip(&tops).enumerate() {
        let (way, missing) = ((b - a).abs(), (b - reached).abs());
        let peak = PI / 2.0 * way / time;
        // A joint with a short range does not get fast.
        require(peak < 0.6 * FAST * top || missing <= MISSING * way + most, || {
            format!(
                "joint {} was {missing:.3} rad from the last of its setpoints, which were up to {peak:.2} rad/s fast; its \
                 velocity_max is {top:.2} rad/s",
                i + 1
            )
        })?;
    }
    Ok(())
}

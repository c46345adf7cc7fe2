//! Motion: units, signs, order of joints, stopping, refusing.

use std::time::{Duration, Instant};

use super::Check;
use super::Needs::Motion;
use super::context::{Context, between, farthest, pause, require};
use crate::adapter::JointReading;
use dimos_core::joint::ControlMode;

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Motion, "planned_moves_arrive", "each joint moves to its target, in rad", planned_moves_arrive),
    Check::new(Motion, "set_points_are_followed", "streamed positions are followed", set_points_are_followed),
    Check::new(Motion, "velocities_are_kept", "rad/s written is rad/s moved and read", velocities_are_kept),
    Check::new(Motion, "velocities_are_those_of_motion", "rad/s read is rad/s moved, in position modes", measured),
    Check::new(Motion, "joints_are_the_arms_own", "values and order match the emulated joints", own_joints),
    Check::new(Motion, "disabled_arms_do_not_move", "commands without power are refused", disabled_arms),
    Check::new(Motion, "nonsense_is_refused", "NaN and wrong lengths are refused, nothing moves", nonsense),
];

fn planned_moves_arrive(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::Position) {
        return context.skip("it has no position mode");
    }
    context.ready(ControlMode::Position)?;
    let start = context.positions()?;
    let target = context.nearby(&start)?;
    for goal in [&target, &start] {
        context.command(goal, 0.5)?;
        context.arrive("arrival", goal)?;
    }
    Ok(())
}

fn set_points_are_followed(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::ServoPosition) {
        return context.skip("it has no servo mode");
    }
    context.ready(ControlMode::ServoPosition)?;
    let start = context.positions()?;
    let target = context.nearby(&start)?;
    context.stream(&start, &target)
}

/// An adapter with the same mistake in both directions agrees with itself. The emulator's true positions reveal it.
fn own_joints(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::Position) || context.true_positions().is_none() {
        return context.skip("its emulator has no true positions");
    }
    context.leave_out_calibration()?;
    context.ready(ControlMode::Position)?;
    let start = context.positions()?;
    let target = context.nearby(&start)?;
    for goal in [&target, &start] {
        let read = context.positions()?;
        let found = context.true_positions().unwrap_or_default();
        require(farthest(&read, &found) < context.holding(), || format!("read {read:?}, the arm is at {found:?}"))?;
        context.command(goal, 0.5)?;
        context.arrive("arrival", goal)?;
        // A coarse encoder shows the arrival before it.
        context.standstill()?;
        let found = context.true_positions().unwrap_or_default();
        require(farthest(goal, &found) < context.arrival(), || format!("sent to {goal:?}, the arm is at {found:?}"))?;
    }
    Ok(())
}

fn velocities_are_kept(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::Velocity) {
        return context.skip("it has no velocity mode");
    }
    context.ready(ControlMode::Velocity)?;
    // A busy machine may interrupt the stream of commands once; a wrong adapter fails every time.
    let mut result = stream_velocities(context);
    for _ in 0..2 {
        if result.is_err() {
            context.standstill()?;
            result = stream_velocities(context);
        }
    }
    result
}

/// Velocities are compared with the differences of positions: an arm may have no velocity mode.
fn measured(context: &mut Context) -> Result<(), String> {
    // A planned motion is smooth; between setpoints an arm may slow down.
    let planned = context.has_mode(ControlMode::Position).then_some(ControlMode::Position);
    let Some(mode) = planned.or(context.position_mode()) else { return context.skip("it has no position mode") };
    context.ready(mode)?;
    if context.joints()?.velocity.is_none() {
        return context.skip("it measures no velocities");
    }
    let start = context.positions()?;
    let away = context.nearby(&start)?;
    // A busy machine may interrupt the stream of setpoints; a wrong adapter fails every time.
    let mut result = compare_velocities(context, &start, &away);
    for (from, to) in [(&away, &start), (&start, &away)] {
        if result.is_err() {
            let here = context.standstill()?;
            context.stream(&here, from)?;
            result = compare_velocities(context, from, to);
        }
    }
    result
}

/// Moves from one pose to another; compares the distances with the integrals of the velocities read.
fn compare_velocities(context: &mut Context, from: &[f64], to: &[f64]) -> Result<(), String> {
    const POINTS: u32 = 60;
    let servo = context.adapter.get_control_mode() == ControlMode::ServoPosition;
    let dof = context.config.dof;
    let mut travelled = vec![0.0; dof];
    let mut last: Option<(f64, JointReading)> = None;
    let mut first = None;
    let began = Instant::now();
    if !servo {
        context.command(to, 0.2)?;
    }
    for i in 1..=POINTS {
        if servo {
            context.command(&between(from, to, f64::from(i) / f64::from(POINTS)), 1.0)?;
        }
        pause(&mut *context.adapter, Duration::from_millis(10));
        let reading = context.joints()?;
        let now = reading.stamp.map_or(began.elapsed().as_secs_f64(), |stamp| stamp.0 as f64 * 1e-9);
        if let Some((then, before)) = last {
            let ends = before.velocity.iter().flatten().zip(reading.velocity.iter().flatten());
            for (sum, (a, b)) in travelled.iter_mut().zip(ends) {
                *sum += 0.5 * (a + b) * (now - then);
            }
        }
        first.get_or_insert(reading.position);
        last = Some((now, reading));
    }
    let (Some(first), Some((_, end))) = (first, last) else { return Ok(()) };
    for (i, ((a, b), sum)) in first.iter().zip(&end.position).zip(&travelled).enumerate() {
        let moved = b - a;
        let close = (moved - sum).abs() < if servo { 0.7 } else { 0.3 } * moved.abs() + 0.005;
        require(close, || format!("joint {} moved by {moved:.4} rad; its velocities add up to {sum:.4} rad", i + 1))?;
    }
    Ok(())
}

fn stream_velocities(context: &mut Context) -> Result<(), String> {
    const SPEED: f64 = 0.1;
    let start = context.positions()?;
    let away = context.nearby(&start)?;
    let wanted: Vec<f64> = start.iter().zip(&away).map(|(a, b)| SPEED.copysign(b - a)).collect();
    let mut measured = None;
    // The speed between two positions on the way is independent of how long the arm takes to start.
    let mut half = None;
    let mut end = (start, Instant::now());
    for i in 0..40 {
        context.command_velocities(&wanted)?;
        pause(&mut *context.adapter, Duration::from_millis(10));
        let reading = context.joints()?;
        let positions = reading.position.get(..wanted.len()).unwrap_or_default().to_vec();
        end = (positions, Instant::now());
        if i == 15 {
            half = Some(end.clone());
        }
        measured = reading.velocity;
    }
    context.stop()?;
    let (from, then) = half.ok_or("the arm's motion could not be measured")?;
    let seconds = (end.1 - then).as_secs_f64();
    for (i, ((a, b), wanted)) in from.iter().zip(&end.0).zip(&wanted).enumerate() {
        let found = (b - a) / seconds;
        let close = (found - wanted).abs() < 0.5 * SPEED;
        require(close, || format!("joint {}: {wanted} rad/s written, {found:.4} rad/s moved", i + 1))?;
    }
    if let Some(measured) = measured {
        let off = farthest(&measured, &wanted);
        require(off < 0.5 * SPEED, || format!("velocities written {wanted:?}, read {measured:?}"))?;
    }
    Ok(())
}

fn disabled_arms(context: &mut Context) -> Result<(), String> {
    let mode = context.first_mode();
    context.ready(mode)?;
    context.adapter.write_enable(false).map_err(|e| format!("write_enable: {e}"))?;
    context.until("the motors to go off", |context| Ok(!context.enabled()?))?;
    let holds = context.row.holds_when_disabled; // an arm without brakes falls
    let start = context.positions()?;
    let target = context.nearby(&start)?;
    let result = context.adapter.write_joint_positions(&target, 0.1);
    require(result.is_err(), || "a command without power is accepted".into())?;
    if holds {
        context.stays(&start, context.holding())?;
    }
    context.adapter.write_enable(true).map_err(|e| format!("write_enable: {e}"))?;
    if holds { context.stays(&start, context.settling()) } else { Ok(()) }
}

fn nonsense(context: &mut Context) -> Result<(), String> {
    let modes = context.row.modes.iter().filter(|mode| mode.is_position() || **mode == ControlMode::Velocity);
    for mode in modes.filter(|mode| context.has_mode(**mode)).collect::<Vec<_>>() {
        context.ready(*mode)?;
        let start = context.standstill()?;
        let mut not_finite = start.clone();
        for bad in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            not_finite.iter_mut().take(1).for_each(|value| *value = bad);
            for values in [&not_finite[..], start.get(1..).unwrap_or_default(), &[]] {
                let result = if *mode == ControlMode::Velocity {
                    context.adapter.write_joint_velocities(values)
                } else {
                    context.adapter.write_joint_positions(values, 0.1)
                };
                require(result.is_err(), || format!("{}: {values:?} is accepted", mode.name()))?;
            }
        }
        context.stays(&start, context.holding())?;
    }
    Ok(())
}

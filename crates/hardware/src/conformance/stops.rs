//! Stops from every state of an arm.

use std::time::Duration;

use super::Check;
use super::Needs::{Faults, Motion};
use super::context::{Context, farthest, pause, require};
use super::gripper::in_unit;
use crate::adapter::{AdapterError, JointReading, Stop};
use crate::device::gripper::GripperStop;
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::arm::{GripperUnit, StopPoint};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::ControlMode;

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Motion, "stop_at_rest_is_harmless", "write_stop at rest changes nothing", stop_at_rest),
    Check::new(Motion, "stop_ends_motion", "write_stop ends a planned move", stop_ends_motion),
    Check::new(Motion, "stop_ends_streaming", "write_stop between setpoints holds the arm", stop_ends_streaming),
    Check::new(Motion, "stop_ends_velocity", "write_stop ends a velocity at once", stop_ends_velocity),
    Check::new(
        Motion,
        "stop_is_no_fault",
        "after a stop, activate and set_control_mode allow motion",
        stop_is_no_fault,
    ),
    Check::new(Motion, "stop_holds_the_gripper", "after a stop a moving gripper can be held", stop_holds_gripper),
    Check::new(
        Faults,
        "stop_without_answer",
        "no stop is confirmed by an arm that does not answer",
        stop_without_answer,
    ),
    Check::new(Faults, "stop_in_error_is_harmless", "write_stop in error clears nothing", stop_in_error),
];

/// How long an arm does not answer [s]: longer than any check.
const SILENCE: f64 = 60.0;
/// Speed of the planned move that is stopped, as a fraction of the top speed.
pub(super) const SLOW: f64 = 0.1;
/// Speed of the stream that is stopped [rad/s].
const SPEED: f64 = 0.1;
/// Minimum remaining travel of the gripper for a stop to reach it in motion [m; see `in_unit`].
const GRIPPER_ROOM: f64 = 0.02;
fn stop_at_rest(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    let start = context.positions()?;
    context.adapter.write_stop(&StopPoint::default()).map_err(|e| format!("write_stop when disabled: {e}"))?;
    require(!context.enabled()?, || "write_stop switched the motors on".into())?;
    context.activate()?;
    for _ in 0..3 {
        context.stop()?;
    }
    context.stays(&start, context.settling())?;
    require(context.enabled()?, || "write_stop switched the motors off".into())
}

/// Starts a long move, and waits until the arm is moving.
pub fn set_off(context: &mut Context) -> Result<Vec<f64>, String> {
    let start = context.positions()?;
    let far = context.far()?;
    context.command(&far, SLOW)?;
    context.until("motion", |context| Ok(farthest(&context.positions()?, &start) > 0.01))?;
    Ok(far)
}

fn stop_ends_motion(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::Position) {
        return context.skip("it has no position mode");
    }
    context.ready(ControlMode::Position)?;
    let far = set_off(context)?;
    context.stop()?;
    let stopped = context.standstill()?;
    require(farthest(&stopped, &far) > 0.01, || "it moved to its target in spite of the stop".into())?;
    require(context.enabled()?, || "the motors are off".into())?;
    context.stays(&stopped, context.holding())
}

fn stop_ends_streaming(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::ServoPosition) {
        return context.skip("it has no servo mode");
    }
    context.ready(ControlMode::ServoPosition)?;
    let start = context.positions()?;
    let away = context.nearby(&start)?;
    let point = |part: f64| -> Vec<f64> {
        start.iter().zip(&away).map(|(a, b)| a + (SPEED * 0.4 * part).copysign(b - a)).collect()
    };
    for i in 1..=40 {
        context.command(&point(f64::from(i) / 40.0), 1.0)?;
        pause(&mut *context.adapter, Duration::from_millis(10));
    }
    context.stop()?;
    let stopped = context.standstill()?;
    let off = farthest(&stopped, &point(1.0));
    let most = context.coasting(SPEED)? + context.settling();
    require(off < most, || format!("it is {off:.4} rad from where it was stopped"))?;
    require(context.enabled()?, || "the motors are off".into())?;
    context.stays(&stopped, context.holding())
}

fn stop_ends_velocity(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::Velocity) {
        return context.skip("it has no velocity mode");
    }
    context.ready(ControlMode::Velocity)?;
    let start = context.positions()?;
    let away = context.nearby(&start)?;
    let wanted: Vec<f64> = start.iter().zip(&away).map(|(a, b)| SPEED.copysign(b - a)).collect();
    for _ in 0..30 {
        context.command_velocities(&wanted)?;
        pause(&mut *context.adapter, Duration::from_millis(10));
    }
    let moving = farthest(&context.positions()?, &start);
    require(moving > 0.003, || format!("0.3 s at {SPEED} rad/s moved it by {moving:.4} rad"))?;
    context.stop()?;
    let here = context.positions()?;
    let stopped = context.standstill()?;
    let coasted = farthest(&stopped, &here);
    let most = context.coasting(SPEED)?;
    require(coasted < most, || format!("it moved {coasted:.4} rad after the stop"))?;
    require(context.enabled()?, || "the motors are off".into())?;
    context.stays(&stopped, context.holding())
}

fn stop_is_no_fault(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::Position) {
        return context.skip("it has no position mode");
    }
    context.ready(ControlMode::Position)?;
    let start = context.positions()?;
    set_off(context)?;
    for _ in 0..3 {
        context.stop()?;
    }
    context.standstill()?;
    let error = context.error()?;
    require(error.0 == 0, || format!("after a stop it reports error {}: {}", error.0, error.1))?;
    context.activate()?;
    context.set_mode(ControlMode::Position).map_err(|e| format!("set_control_mode: {e}"))?;
    context.command(&start, 0.5)?;
    context.arrive("arrival", &start)
}

/// Holds the gripper as the device thread does after a stop that does not affect it.
fn stop_holds_gripper(context: &mut Context) -> Result<(), String> {
    context.ready(context.first_mode())?;
    let info = context.adapter.gripper().map(|gripper| gripper.info()).unwrap_or_default();
    if info.unit == GripperUnit::OnOff {
        return context.skip("its gripper only opens and closes");
    }
    if context.gripper()?.is_none() {
        return context.skip("it has no gripper");
    }
    let Some((closed, open)) = info.range else { return context.skip("the range of its gripper is unknown") };
    // On a busy machine the gripper may arrive before the stop: then the check is repeated in the other direction.
    for target in [open, closed, open, closed, open] {
        if let Some(stopped) = stop_gripper_on_its_way(context, target, info.unit)? {
            return gripper_stays(context, stopped, info.unit);
        }
    }
    context.skip("its gripper is too fast to be stopped in motion")
}

/// Moves the gripper and stops it. Returns where it stopped; `None` if it had arrived.
fn stop_gripper_on_its_way(context: &mut Context, target: f64, unit: GripperUnit) -> Result<Option<f64>, String> {
    let length = |metres| in_unit(unit, metres);
    let left = |opening: Option<f64>| opening.map_or(0.0, |opening| (target - opening).abs());
    context.command_gripper(target)?;
    let way = left(context.gripper()?);
    context.until("the gripper's motion", |context| Ok(left(context.gripper()?) < 0.95 * way.max(length(0.01))))?;
    if left(context.gripper()?) < length(GRIPPER_ROOM) {
        context.until("the gripper's arrival", |context| Ok(left(context.gripper()?) < length(0.001)))?;
        context.activate()?;
        return Ok(None);
    }
    context.stop()?;
    let mut stop = GripperStop::default();
    stop.begin(MonotonicClock.now());
    let mut rest = (context.gripper()?, MonotonicClock.now());
    context.until("the gripper's rest", |context| {
        let (opening, now) = (context.gripper()?, MonotonicClock.now());
        if let Some(here) = opening.and_then(|opening| stop.observe(opening, unit, now)) {
            context.command_gripper(here).map_err(|e| format!("holding the gripper: {e}"))?;
        }
        if left(opening) != left(rest.0) {
            rest = (opening, now);
        }
        Ok(now.since(rest.1) > Duration::from_millis(400))
    })?;
    let went = left(rest.0);
    require(went > length(0.002), || format!("it moved to {target} {} in spite of a stop", unit.name()))?;
    Ok(rest.0)
}

fn gripper_stays(context: &mut Context, stopped: f64, unit: GripperUnit) -> Result<(), String> {
    pause(&mut *context.adapter, Duration::from_millis(300));
    let now = context.gripper()?.unwrap_or(f64::NAN);
    let stayed = (now - stopped).abs() < in_unit(unit, 0.001);
    require(stayed, || format!("it moved from {stopped:.4} to {now:.4} {}", unit.name()))
}

fn stop_without_answer(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Silent).lasting(SILENCE)) {
        return context.skip("its emulator cannot be silent");
    }
    context.ready(context.first_mode())?;
    context.trigger_faults()?;
    // States that were on their way.
    context.until("the silence", |context| Ok(context.adapter.read_joints(&mut JointReading::default()).is_err()))?;
    for _ in 0..3 {
        let result = context.adapter.write_stop(&StopPoint::default());
        require(result != Ok(Stop::Confirmed), || "a stop is confirmed although the arm is silent".into())?;
    }
    Ok(())
}

fn stop_in_error(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::ErrorCode)) {
        return context.skip("its emulator cannot be in error");
    }
    context.ready(context.first_mode())?;
    context.trigger_faults()?;
    context.until("the error", |context| Ok(context.error()?.0 != 0))?;
    let (start, error) = (context.standstill()?, context.error()?);
    for _ in 0..3 {
        let result = context.adapter.write_stop(&StopPoint::default());
        let fine = matches!(result, Ok(_) | Err(AdapterError::Fault { .. } | AdapterError::Rejected(_)));
        require(fine && context.adapter.is_connected(), || format!("write_stop in error: {result:?}"))?;
    }
    context.stays(&start, context.holding())?;
    let after = context.error()?;
    require(after == error, || format!("write_stop turned the error {error:?} into {after:?}"))
}

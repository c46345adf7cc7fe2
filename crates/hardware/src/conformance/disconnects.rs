//! Disconnects in every state of an arm, and the reconnects after them.
//!
//! Each time: the adapter notices the disconnect, `connect` reconnects, the first state after that is newer than the
//! connection, and the adapter has changed neither motors nor joints nor errors.

use std::time::{Duration, Instant};

use super::Check;
use super::Needs::Faults;
use super::context::{Context, farthest, pause, require};
use crate::adapter::{AdapterError, JointReading, Stop};
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::arm::StopPoint;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::ControlMode;

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Faults, "cut_when_disabled", "a cut connection is noticed and reconnects while disabled", when_disabled),
    Check::new(
        Faults,
        "cut_when_enabled",
        "a cut connection reconnects while enabled, and the arm holds",
        when_enabled,
    ),
    Check::new(Faults, "cut_in_motion", "a cut connection reconnects in motion, and the arm can be stopped", in_motion),
    Check::new(
        Faults,
        "cut_while_streaming",
        "a cut connection reconnects between setpoints, and the arm stops",
        while_streaming,
    ),
    Check::new(Faults, "cut_in_error", "a cut connection reconnects in error, and no error is cleared", in_error),
    Check::new(Faults, "power_cut", "after a loss of power the motors stay off", power),
    Check::new(Faults, "stop_into_the_void", "no stop is confirmed without a connection", stop_into_the_void),
];

const NO_CUT: &str = "its emulator cannot cut the connection";
/// Maximum duration of a call without a connection.
const CALL_TIMEOUT: Duration = Duration::from_secs(3);
/// Duration of the loss of power [s].
const POWER_OFF_TIME: f64 = 0.5;

/// Cuts the connection and waits until the adapter has noticed.
fn cut(context: &mut Context) -> Result<(), String> {
    context.trigger_faults()?;
    let mut reading = JointReading::default();
    context.until("the cut", |context| Ok(context.adapter.read_joints(&mut reading).is_err()))?;
    context.until("is_connected to be false", |context| {
        let _ = context.adapter.read_joints(&mut reading);
        Ok(!context.adapter.is_connected())
    })?;
    let answer = context.adapter.read_joints(&mut reading);
    require(answer == Err(AdapterError::NotConnected), || format!("after the cut: {answer:?}"))
}

/// Reconnects with retries, as the device thread does. Returns the joint positions [rad] after that.
fn reconnect(context: &mut Context) -> Result<Vec<f64>, String> {
    let mut began = MonotonicClock.now();
    context.until("the connection", |context| {
        began = MonotonicClock.now();
        match context.adapter.connect() {
            Ok(()) => Ok(true),
            Err(AdapterError::Io(_) | AdapterError::Timeout(_)) => Ok(false),
            Err(error) => Err(format!("connect after the cut: {error}")),
        }
    })?;
    require(context.adapter.is_connected(), || "connect succeeds, is_connected is false".into())?;
    let mut reading = JointReading::default();
    context.adapter.read_joints(&mut reading).map_err(|e| format!("the first read_joints after connect: {e}"))?;
    let fresh = reading.stamp.is_none_or(|stamp| stamp >= began);
    require(fresh, || "the first state after connect was measured before it".into())?;
    context.positions()
}

fn when_disabled(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Disconnect)) {
        return context.skip(NO_CUT);
    }
    context.connect()?;
    let start = context.positions()?;
    cut(context)?;
    reconnect(context)?;
    context.stays(&start, context.rest())?;
    require(!context.enabled()?, || "reconnecting switched the motors on".into())
}

fn when_enabled(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Disconnect)) {
        return context.skip(NO_CUT);
    }
    context.ready(context.first_mode())?;
    let start = context.positions()?;
    cut(context)?;
    reconnect(context)?;
    context.stays(&start, context.settling())
}

fn in_motion(context: &mut Context) -> Result<(), String> {
    if !context.has_mode(ControlMode::Position) || !context.prepare(Fault::new(FaultKind::Disconnect)) {
        return context.skip("no planned moves, or its emulator cannot cut the connection");
    }
    context.ready(ControlMode::Position)?;
    set_off(context)?;
    cut(context)?;
    reconnect(context)?;
    // An arm that stops on its own needs some time.
    pause(&mut *context.adapter, Duration::from_millis(300));
    let here = context.positions()?;
    pause(&mut *context.adapter, Duration::from_millis(100));
    let continued = farthest(&context.positions()?, &here) > 0.002;
    context.stop()?;
    let stopped = context.standstill()?;
    context.stays(&stopped, context.holding())?;
    context.found(if continued {
        "the arm continues its move without a client; a stop after reconnecting ends it"
    } else {
        "the arm stops when its client disconnects"
    })
}

/// Starts a long, slow move, and waits until the arm is moving.
fn set_off(context: &mut Context) -> Result<(), String> {
    let (start, far) = (context.positions()?, context.far()?);
    context.command(&far, 0.05)?;
    context.until("motion", |context| Ok(farthest(&context.positions()?, &start) > 0.005))
}

fn while_streaming(context: &mut Context) -> Result<(), String> {
    let servo = ControlMode::ServoPosition;
    if !context.has_mode(servo) || !context.prepare(Fault::new(FaultKind::Disconnect)) {
        return context.skip("it has no servo mode, or its emulator cannot cut the connection");
    }
    context.ready(servo)?;
    let mut point = context.positions()?;
    let away = context.nearby(&point)?;
    let step: Vec<f64> = point.iter().zip(&away).map(|(a, b)| 0.001_f64.copysign(b - a)).collect();
    for _ in 0..20 {
        point.iter_mut().zip(&step).for_each(|(value, step)| *value += step);
        context.command(&point, 1.0)?;
        pause(&mut *context.adapter, Duration::from_millis(10));
    }
    cut(context)?;
    let refused = context.adapter.write_joint_positions(&point, 1.0);
    require(refused == Err(AdapterError::NotConnected), || format!("a setpoint after the cut: {refused:?}"))?;
    let here = reconnect(context)?;
    let off = farthest(&here, &point);
    require(off < 0.02 + context.settling(), || format!("it is {off:.4} rad from its last setpoint"))?;
    // 0.1 rad/s for as long as its controller bridges a gap.
    context.stays(&here, context.settling() + 0.1 * context.row.gap_tolerance.as_secs_f64())
}

fn in_error(context: &mut Context) -> Result<(), String> {
    let faults = [FaultKind::ErrorCode, FaultKind::Disconnect];
    if !faults.into_iter().all(|kind| context.prepare(Fault::new(kind))) {
        return context.skip("its emulator cannot be in error, or cannot cut the connection");
    }
    context.ready(context.first_mode())?;
    context.trigger_faults()?;
    context.until("the error", |context| Ok(context.error()?.0 != 0))?;
    let (error, start) = (context.error()?, context.standstill()?);
    cut(context)?;
    reconnect(context)?;
    context.stays(&start, context.settling())?;
    let after = context.error()?;
    require(after == error, || format!("reconnecting turned the error {error:?} into {after:?}"))
}

fn power(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::PowerLoss).lasting(POWER_OFF_TIME)) {
        return context.skip("its emulator cannot lose power");
    }
    context.ready(context.first_mode())?;
    cut(context)?;
    let start = reconnect(context)?;
    if context.row.holds_when_disabled {
        context.stays(&start, context.settling())?;
    }
    require(!context.enabled()?, || "the motors are on after a loss of power".into())
}

fn stop_into_the_void(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Disconnect)) {
        return context.skip(NO_CUT);
    }
    context.ready(context.first_mode())?;
    context.trigger_faults()?;
    context.until("a stop that is not taken", |context| {
        let began = Instant::now();
        let result = context.adapter.write_stop(&StopPoint::default());
        let took = began.elapsed();
        require(took < CALL_TIMEOUT, || format!("write_stop on a cut wire took {took:?}"))?;
        // An adapter whose stop is not confirmed may have to read before it notices.
        let _ = context.adapter.read_joints(&mut JointReading::default());
        Ok(result.is_err())
    })?;
    for _ in 0..20 {
        let result = context.adapter.write_stop(&StopPoint::default());
        require(result != Ok(Stop::Confirmed), || "a stop is confirmed without a connection".into())?;
    }
    Ok(())
}

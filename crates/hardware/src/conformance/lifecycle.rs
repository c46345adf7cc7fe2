//! Connecting, activating and disconnecting move nothing.

use std::time::{Duration, Instant};

use super::Check;
use super::Needs::{Faults, Motion, Nothing};
use super::context::{Context, farthest, require};
use crate::adapter::{AdapterError, JointReading};
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::arm::StopPoint;

/// Maximum duration of `connect` at an address that does not answer.
const UNREACHABLE: Duration = Duration::from_secs(3);

/// How far joints are moved by hand [rad].
const BY_HAND: f64 = 0.1;
/// Time in which an arm without brakes falls back to its rest.
const FALL_TIME: Duration = Duration::from_secs(1);

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Nothing, "not_connected_is_said", "calls before connect return NotConnected", not_connected_is_said),
    Check::new(Nothing, "connecting_changes_nothing", "connect enables and moves nothing", connecting_changes_nothing),
    Check::new(Motion, "activation_holds", "activate enables and holds within 0.005 rad", activation_holds),
    Check::new(Faults, "enabling_moves_nothing", "an arm moved by hand while disabled stays there", enabling_displaced),
    Check::new(Motion, "leaving_moves_nothing", "deactivate and disconnect move nothing", leaving_moves_nothing),
    Check::new(Nothing, "connects_twice", "connecting again, or after disconnecting, works", connects_twice),
    Check::new(Faults, "unreachable_is_clear", "an address without arm fails within 3 s", unreachable_is_clear),
    Check::new(Faults, "silence_is_clear", "an arm that accepts but is silent fails within 3 s", silence_is_clear),
    Check::new(Faults, "wrong_arm_is_refused", "another number of joints is refused", wrong_arm_is_refused),
    Check::new(Faults, "wrong_model_is_refused", "another model is refused", wrong_model_is_refused),
];

fn not_connected_is_said(context: &mut Context) -> Result<(), String> {
    context.adapter.disconnect();
    let mut buffer = vec![0.0; context.config.dof];
    let adapter = &mut context.adapter;
    require(!adapter.is_connected(), || "is_connected is true".into())?;
    let answers = [
        ("read_joint_positions", adapter.read_joint_positions(&mut buffer).err()),
        ("read_joints", adapter.read_joints(&mut JointReading::default()).err()),
        ("read_state", adapter.read_state().err()),
        ("read_error", adapter.read_error().err()),
        ("read_enabled", adapter.read_enabled().err()),
        ("write_joint_positions", adapter.write_joint_positions(&buffer, 0.1).err()),
        ("write_stop", adapter.write_stop(&StopPoint::default()).err()),
        ("write_enable", adapter.write_enable(true).err()),
        ("write_clear_errors", adapter.write_clear_errors().err()),
    ];
    for (name, answer) in answers {
        require(answer == Some(AdapterError::NotConnected), || format!("{name} answers {answer:?}"))?;
    }
    Ok(())
}

fn connecting_changes_nothing(context: &mut Context) -> Result<(), String> {
    let untouched = context.truth().motor_switches;
    context.connect()?;
    require(context.truth().motor_switches == untouched, || "connect switched motors on and off".into())?;
    require(context.adapter.is_connected(), || "is_connected is false".into())?;
    let start = context.positions()?;
    // A real arm is in the state in which its last user left it; an emulator has just been switched on.
    let before = context.real && context.enabled()?;
    if context.real {
        context.adapter.disconnect();
        context.connect()?;
    }
    require(context.enabled()? == before, || "the motors are on".into())?;
    context.stays(&start, context.rest())?;
    if before { context.found("the motors were on and stay on") } else { Ok(()) }
}

fn activation_holds(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    let start = context.positions()?;
    context.activate()?;
    context.stays(&start, context.settling())
}

/// A servo goes to its old goal when its motor comes on, unless the goal is set to where the joint is before.
fn enabling_displaced(context: &mut Context) -> Result<(), String> {
    let joints = context.config.dof;
    let by_hand = |joint| Fault { joint, amount: BY_HAND, ..Fault::new(FaultKind::Pushed) };
    if context.emulator.is_none() || !(1..=joints).all(|joint| context.prepare(by_hand(joint))) {
        return context.skip("its emulator cannot be moved by hand");
    }
    let mode = context.position_mode();
    context.ready(mode.unwrap_or(context.first_mode()))?;
    if mode.is_some() {
        let start = context.positions()?;
        let goal = context.nearby(&start)?;
        context.stream(&start, &goal)?;
    }
    context.adapter.write_enable(false).map_err(|e| format!("write_enable: {e}"))?;
    context.until("the motors to go off", |context| Ok(!context.enabled()?))?;
    let rest = context.standstill()?;
    for _ in 0..joints {
        context.trigger_faults()?;
    }
    // An arm without brakes may have fallen, and fall back.
    let begun = Instant::now();
    context.until("the displacement", |context| {
        let moved = farthest(&context.positions()?, &rest) > 0.5 * BY_HAND;
        Ok(moved || (!context.row.holds_when_disabled && begun.elapsed() > FALL_TIME))
    })?;
    let displaced = context.standstill()?;
    context.activate()?;
    context.stays(&displaced, context.settling())
}

fn leaving_moves_nothing(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    context.activate()?;
    let start = context.positions()?;
    context.adapter.deactivate(&StopPoint::default()).map_err(|e| format!("deactivate: {e}"))?;
    require(context.enabled()?, || "deactivate switched the motors off".into())?;
    context.adapter.disconnect();
    context.adapter.disconnect();
    require(!context.adapter.is_connected(), || "is_connected is true".into())?;
    let before = context.truth();
    context.connect()?;
    require(context.truth().motor_switches == before.motor_switches, || "connect switched motors off and on".into())?;
    // An adapter may say that an arm is not enabled before it is activated again: the emulator has the motors.
    let on = if context.emulator.is_some() { before.motors_on != Some(false) } else { context.enabled()? };
    require(on, || "disconnect switched the motors off: an arm without brakes falls".into())?;
    context.stays(&start, context.settling())
}

fn connects_twice(context: &mut Context) -> Result<(), String> {
    for _ in 0..3 {
        context.connect()?;
        context.connect()?;
        let first = context.positions()?;
        context.adapter.disconnect();
        context.connect()?;
        let moved = farthest(&context.positions()?, &first);
        require(moved <= context.rest(), || format!("the arm moved by {moved} rad"))?;
        context.adapter.disconnect();
    }
    Ok(())
}

fn unreachable_is_clear(context: &mut Context) -> Result<(), String> {
    if context.emulator.take().is_none() {
        return context.skip("it has no address");
    }
    let start = Instant::now();
    fails_clearly(context, start)?;
    let (error, address) = (context.adapter.connect().err(), &context.config.address);
    let text = error.map_or(String::new(), |e| e.to_string());
    require(text.contains(address.as_str()), || format!("the error does not name {address}: {text}"))
}

fn silence_is_clear(context: &mut Context) -> Result<(), String> {
    if context.emulator.is_none() || !context.prepare(Fault::new(FaultKind::Silent).lasting(60.0)) {
        return context.skip("its emulator cannot be silent");
    }
    context.trigger_faults()?;
    fails_clearly(context, Instant::now())
}

fn fails_clearly(context: &mut Context, start: Instant) -> Result<(), String> {
    let result = context.adapter.connect();
    let took = start.elapsed();
    let expected = matches!(result, Err(AdapterError::Io(_) | AdapterError::Timeout(_)));
    require(expected, || format!("connect answers {result:?}"))?;
    require(took < UNREACHABLE, || format!("connect took {took:?}"))?;
    require(!context.adapter.is_connected(), || "is_connected is true".into())
}

fn wrong_arm_is_refused(context: &mut Context) -> Result<(), String> {
    if context.emulator.is_none() || !context.prepare(Fault::new(FaultKind::WrongDof)) {
        return context.skip("its emulator cannot be another arm");
    }
    context.trigger_faults()?;
    let result = context.adapter.connect();
    let text = result.as_ref().err().map_or(String::new(), |e| e.to_string());
    let numbers = [context.config.dof, context.config.dof + 1].map(|n| n.to_string());
    require(matches!(result, Err(AdapterError::Rejected(_))), || format!("connect answers {result:?}"))?;
    require(numbers.iter().all(|n| text.contains(n)), || format!("expected and found are not both in: {text}"))?;
    require(!context.adapter.is_connected(), || "is_connected is true".into())
}

fn wrong_model_is_refused(context: &mut Context) -> Result<(), String> {
    if context.emulator.is_none() || !context.prepare(Fault::new(FaultKind::WrongModel)) {
        return context.skip("its emulator cannot be another model");
    }
    context.trigger_faults()?;
    let result = context.adapter.connect();
    let text = result.as_ref().err().map_or(String::new(), |e| e.to_string());
    require(matches!(result, Err(AdapterError::Rejected(_))), || format!("connect answers {result:?}"))?;
    require(text.contains("model"), || format!("the error does not name the model: {text}"))?;
    require(!context.adapter.is_connected(), || "is_connected is true".into())
}

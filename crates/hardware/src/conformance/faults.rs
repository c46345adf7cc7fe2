//! Faults: errors, E-stop, damaged packets.

use super::Check;
use super::Needs::Faults;
use std::time::Duration;

use super::context::{Context, farthest, require};
use crate::adapter::{AdapterError, JointReading};
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::clock::{Clock, MonotonicClock};

/// How long readings are checked after a damaged packet: many periods of any arm.
const OBSERVATION_TIME: Duration = Duration::from_millis(500);

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Faults, "errors_have_code_and_text", "an error is reported, refuses motion, is cleared", errors),
    Check::new(Faults, "errors_of_any_joint", "an error of the last joint is reported", last_joint),
    Check::new(Faults, "clearing_enables_nothing", "an error is cleared with the motors off", clearing),
    Check::new(Faults, "estop_needs_two_acts", "after an E-stop: clear, then enable", estop),
    Check::new(Faults, "noise_is_survived", "noise costs at most three readings", noise),
    Check::new(Faults, "damage_is_survived", "a damaged reply costs at most three readings", damage),
    Check::new(Faults, "truncation_is_survived", "half a reply costs at most three readings", truncation),
];

fn errors(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::ErrorCode).code(context.row.error_code)) {
        return context.skip("its emulator cannot be in error");
    }
    context.ready(context.first_mode())?;
    let healthy = context.error()?;
    require(healthy == (0, String::new()), || format!("without an error it reports {healthy:?}"))?;
    context.trigger_faults()?;
    context.until("the error", |context| Ok(context.error()?.0 != 0))?;
    let (code, text) = context.error()?;
    require(code == i32::from(context.row.error_code) && !text.is_empty(), || format!("error {code}, text {text:?}"))?;
    let start = context.positions()?;
    let refused = context.adapter.write_joint_positions(&start, 0.1);
    let is_fault = matches!(refused, Err(AdapterError::Fault { .. }));
    require(is_fault, || format!("motion in error: expected AdapterError::Fault, it answers {refused:?}"))?;
    context.clear_errors().map_err(|e| format!("write_clear_errors: {e}"))?;
    context.until("the error to be cleared", |context| Ok(context.error()?.0 == 0))?;
    // The motors of an arm in error may be off: without brakes it falls.
    if context.row.holds_when_disabled || context.enabled()? {
        context.stays(&start, context.settling())?;
    }
    context.activate()
}

/// Where each drive reports its own error, all of them are read.
fn last_joint(context: &mut Context) -> Result<(), String> {
    let joint = context.config.dof;
    if !context.prepare(Fault { joint, ..Fault::new(FaultKind::ErrorCode).code(context.row.error_code) }) {
        return context.skip("its emulator cannot be in error");
    }
    context.ready(context.first_mode())?;
    context.trigger_faults()?;
    context.until("the error", |context| Ok(context.error()?.0 != 0))?;
    context.clear_errors().map_err(|e| format!("write_clear_errors: {e}"))?;
    context.until("the error to be cleared", |context| Ok(context.error()?.0 == 0))
}

fn clearing(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::ErrorCode).code(context.row.error_code)) {
        return context.skip("its emulator cannot be in error");
    }
    context.connect()?;
    if context.enabled()? {
        context.adapter.write_enable(false).map_err(|e| format!("write_enable: {e}"))?;
        context.until("the motors to go off", |context| Ok(!context.enabled()?))?;
    }
    context.trigger_faults()?;
    context.until("the error", |context| Ok(context.error()?.0 != 0))?;
    context.clear_errors().map_err(|e| format!("write_clear_errors: {e}"))?;
    context.until("the error to be cleared", |context| Ok(context.error()?.0 == 0))?;
    require(!context.enabled()?, || "clearing switched the motors on".into())
}

fn estop(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Estop).lasting(0.3)) {
        return context.skip("its emulator has no E-stop line");
    }
    context.ready(context.first_mode())?;
    let mut start = context.positions()?;
    context.trigger_faults()?;
    context.until("the E-stop", |context| Ok(context.error()?.0 != 0))?;
    require(context.adapter.write_enable(true).is_err(), || "enabling in E-stop is accepted".into())?;
    context.until("the release", |context| Ok(context.clear_errors().is_ok()))?;
    require(!context.enabled()?, || "clearing switched the motors on".into())?;
    context.activate()?;
    if !context.row.holds_when_disabled {
        start = context.standstill()?; // an arm without brakes has fallen
    }
    context.stays(&start, context.settling())
}

fn noise(context: &mut Context) -> Result<(), String> {
    survives(context, FaultKind::Garbage)
}

fn damage(context: &mut Context) -> Result<(), String> {
    survives(context, FaultKind::Corrupt)
}

fn truncation(context: &mut Context) -> Result<(), String> {
    survives(context, FaultKind::Truncated)
}

fn survives(context: &mut Context, kind: FaultKind) -> Result<(), String> {
    if !context.prepare(Fault::new(kind)) {
        return context.skip("its emulator cannot play this fault");
    }
    context.connect()?;
    let start = context.positions()?;
    let began = MonotonicClock.now();
    context.trigger_faults()?;
    // The damage may affect the next reading, or one of the streamed states.
    let (mut failures, most) = (0, context.holding());
    let mut reading = JointReading::default();
    while MonotonicClock.now().since(began) < OBSERVATION_TIME {
        match context.adapter.read_joints(&mut reading) {
            Ok(()) => {
                let position = reading.position.get(..start.len()).unwrap_or_default();
                let moved = farthest(position, &start);
                require(moved < most, || format!("a damaged packet was accepted: {moved} rad off"))?;
            }
            Err(_) => failures += 1,
        }
        require(failures <= 3, || "more than three readings failed".into())?;
        std::thread::sleep(Duration::from_millis(2));
    }
    require(context.adapter.is_connected(), || "the connection was closed".into())?;
    context.stays(&start, context.holding())
}

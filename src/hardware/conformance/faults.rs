//! When things go wrong.

use super::Check;
use super::context::{Context, require};
use crate::hardware::sim::faults::{Fault, FaultKind};
use crate::hardware::spec::{AdapterError, JointReading};

/// The error code that is injected.
const CODE: u16 = 2;

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check { name: "errors_have_code_and_text", about: "an error is told, refuses motion, is cleared", run: errors },
    Check { name: "estop_needs_two_acts", about: "after an E-stop: clear, then enable", run: estop },
    Check { name: "broken_connections_are_noticed", about: "a cut wire is noticed and mended", run: broken },
    Check { name: "noise_is_survived", about: "noise costs at most three readings", run: noise },
    Check { name: "damage_is_survived", about: "a damaged reply costs at most three readings", run: damage },
    Check { name: "truncation_is_survived", about: "half a reply costs at most three readings", run: truncation },
];

fn errors(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::ErrorCode).code(CODE)) {
        return context.skip("its double cannot be in error");
    }
    context.ready(context.row.modes.first().copied().unwrap_or_default())?;
    let healthy = context.adapter.read_error().map_err(|e| e.to_string())?;
    require(healthy == (0, String::new()), || format!("without error it says {healthy:?}"))?;
    context.strike()?;
    context.until("the error", |context| {
        context.positions()?;
        Ok(context.adapter.read_error().map_err(|e| e.to_string())?.0 != 0)
    })?;
    let (code, text) = context.adapter.read_error().map_err(|e| e.to_string())?;
    require(code == i32::from(CODE) && !text.is_empty(), || format!("error {code}, text {text:?}"))?;
    let start = context.positions()?;
    let refused = context.adapter.write_joint_positions(&start, 0.1);
    require(matches!(refused, Err(AdapterError::Fault { .. })), || format!("motion in error: {refused:?}"))?;
    context.adapter.write_clear_errors().map_err(|e| format!("write_clear_errors: {e}"))?;
    let cleared = context.adapter.read_error().map_err(|e| e.to_string())?;
    require(cleared.0 == 0, || format!("after clearing: {cleared:?}"))?;
    context.stays(&start, 0.005)?;
    context.adapter.activate().map_err(|e| format!("activate after clearing: {e}"))
}

fn estop(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Estop).lasting(0.3)) {
        return context.skip("its double has no E-stop line");
    }
    context.ready(context.row.modes.first().copied().unwrap_or_default())?;
    let start = context.positions()?;
    context.strike()?;
    context.until("the E-stop", |context| {
        context.positions()?;
        Ok(context.adapter.read_error().map_err(|e| e.to_string())?.0 != 0)
    })?;
    require(context.adapter.write_enable(true).is_err(), || "enabling in E-stop is accepted".into())?;
    context.until("the release", |context| Ok(context.adapter.write_clear_errors().is_ok()))?;
    require(!context.enabled()?, || "clearing switched the motors on".into())?;
    context.adapter.activate().map_err(|e| format!("activate: {e}"))?;
    context.stays(&start, 0.005)
}

fn broken(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault::new(FaultKind::Disconnect)) {
        return context.skip("its double cannot cut the wire");
    }
    context.ready(context.row.modes.first().copied().unwrap_or_default())?;
    context.strike()?;
    let mut reading = JointReading::default();
    context.until("the cut", |context| Ok(context.adapter.read_joints(&mut reading).is_err()))?;
    context.until("is_connected to be false", |context| {
        let _ = context.adapter.read_joints(&mut reading);
        Ok(!context.adapter.is_connected())
    })?;
    let answer = context.adapter.read_joints(&mut reading);
    require(answer == Err(AdapterError::NotConnected), || format!("after the cut: {answer:?}"))?;
    context.connect()?;
    let start = context.positions()?;
    context.stays(&start, 0.005)
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
        return context.skip("its double has no such fault");
    }
    context.connect()?;
    let start = context.positions()?;
    context.strike()?;
    let mut failures = 0;
    let mut reading = JointReading::default();
    while context.adapter.read_joints(&mut reading).is_err() {
        failures += 1;
        require(failures <= 3, || "more than three readings failed".into())?;
    }
    require(context.adapter.is_connected(), || "the connection was given up".into())?;
    context.stays(&start, 1e-3)
}

//! Reading the arm, its modes and its optional parts.

use std::time::{Duration, Instant};

use super::Check;
use super::Needs::{Faults, Motion, Nothing};
use super::context::{Context, farthest, pause, require};
use super::streamed_state;
use crate::adapter::{AdapterError, JointReading};
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::joint::ControlMode;

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Nothing, "reads_agree", "read_joints agrees with the single reads", reads_agree),
    Check::new(Nothing, "positions_are_plausible", "positions are in rad, inside the limits", plausible),
    Check::new(Nothing, "stamps_are_of_the_past", "stamps increase and are never in the future", stamps),
    Check::new(Motion, "reads_do_not_allocate", "a cycle's reads and writes allocate nothing", no_allocation),
    Check::new(Faults, "enabled_means_every_motor", "with one motor off it is not enabled", every_motor),
    Check::new(Motion, "modes_are_what_it_says", "its modes work, others are Unsupported", modes),
    Check::new(
        Motion,
        "optional_parts_never_fail",
        "its parts answer; velocities in no mode of it are Unsupported",
        optional_parts,
    ),
];

fn reads_agree(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    let dof = context.config.dof;
    let reading = context.joints()?;
    let mut buffer = vec![f64::NAN; dof];
    context.adapter.read_joint_positions(&mut buffer).map_err(|e| e.to_string())?;
    let (position, rest) = reading.position.split_at(dof);
    require(farthest(position, &buffer) <= context.rest() && buffer.iter().all(|v| v.is_finite()), || {
        format!("read_joint_positions {buffer:?}, read_joints {position:?}")
    })?;
    require(rest.iter().all(|v| *v == 0.0), || "entries past dof are not zero".into())?;
    let velocities = context.adapter.read_joint_velocities(&mut buffer).map_err(|e| e.to_string())?;
    require(velocities == reading.velocity.is_some(), || "the two disagree on having velocities".into())?;
    // A velocity may be the difference of two positions.
    let still = (2.0 * context.row.resolution * context.row.native_rate).max(if context.real { 0.05 } else { 1e-3 });
    require(!velocities || buffer.iter().all(|v| v.abs() < still), || format!("velocities at rest: {buffer:?}"))?;
    let efforts = context.adapter.read_joint_efforts(&mut buffer).map_err(|e| e.to_string())?;
    require(efforts == reading.effort.is_some(), || "the two disagree on having torques".into())?;
    context.adapter.read_state().map(|_| ()).map_err(|e| format!("read_state: {e}"))
}

fn every_motor(context: &mut Context) -> Result<(), String> {
    let joint = context.config.dof.min(2);
    if context.emulator.is_none() || !context.prepare(Fault { joint, ..Fault::new(FaultKind::MotorOff) }) {
        return context.skip("its emulator has no motor per joint");
    }
    context.ready(context.first_mode())?;
    context.trigger_faults()?;
    context.until("read_enabled to be false with one motor off", |context| Ok(!context.enabled()?))
}

fn plausible(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    let (positions, limits) = (context.positions()?, context.limits()?);
    let degrees: Vec<_> = positions.iter().map(|v| format!("{:.1}°", v.to_degrees())).collect();
    context.found(format!("at {}", degrees.join(" ")))?;
    let range = limits.position_lower.iter().zip(&limits.position_upper);
    for (i, (position, (lower, upper))) in positions.iter().zip(range).enumerate() {
        // A joint may rest as far outside as it may be enabled.
        let tolerance = context.row.outside.max(0.01);
        let inside = (lower - tolerance..=upper + tolerance).contains(position);
        require(inside, || format!("joint {}: {position} rad is outside {lower} to {upper}", i + 1))?;
    }
    Ok(())
}

fn stamps(context: &mut Context) -> Result<(), String> {
    use dimos_core::clock::{Clock, Mono, MonotonicClock};
    context.connect()?;
    let mut last = Mono::ZERO;
    for _ in 0..20 {
        let reading = context.joints()?;
        let Some(stamp) = reading.stamp else { return context.skip("its states have no time stamp") };
        require(stamp >= last, || format!("{stamp:?} after {last:?}"))?;
        require(stamp <= MonotonicClock.now(), || format!("{stamp:?} is in the future"))?;
        last = stamp;
        pause(&mut *context.adapter, Duration::from_millis(2));
    }
    Ok(())
}

/// Cycles with a new state and a command that are checked, and maximum number of cycles to get them: on a CAN bus a
/// state may arrive in several pieces.
const GOOD_CYCLES: u32 = 40;
const CYCLES: u32 = 600;
/// A longer cycle has asked again.
const ASKED_AGAIN: Duration = Duration::from_millis(20);

fn no_allocation(context: &mut Context) -> Result<(), String> {
    let Some(allocations) = context.allocations else { return context.skip("no counting allocator") };
    let servo = context.has_mode(ControlMode::ServoPosition);
    context.ready(if servo { ControlMode::ServoPosition } else { ControlMode::Position })?;
    let hold = context.positions()?;
    let mut reading = JointReading::default();
    let (mut good, mut last) = (0, None);
    for cycle in 0..CYCLES {
        // A streamed state must arrive before a cycle has anything to process.
        let pushed = context.adapter.state_fd().is_some();
        if pushed {
            streamed_state::await_state(context)?;
        }
        let (before, began) = (allocations(), Instant::now());
        let adapter = &mut context.adapter;
        let read = adapter.read_joints(&mut reading).is_ok()
            && adapter.read_error().is_ok()
            && adapter.read_enabled().is_ok()
            && adapter.read_state().is_ok()
            && adapter.gripper().is_none_or(|gripper| gripper.read_gripper_position().is_ok())
            && adapter.cartesian().is_none_or(|poses| poses.read_cartesian_position().is_ok())
            && adapter.force_torque().is_none_or(|sensor| sensor.read_force_torque().is_ok());
        let written = adapter.write_joint_positions(&hold, 0.1).is_ok();
        let made = allocations() - before;
        // The first cycles may fill caches, and one that asks again for a late reply has an error to report.
        let counts = cycle >= 5 && read && written && began.elapsed() < ASKED_AGAIN;
        require(made == 0 || !counts, || format!("{made} allocations in cycle {cycle}"))?;
        let news = !pushed || reading.stamp != last;
        last = reading.stamp;
        good += u32::from(read && written && news && cycle >= 5);
        if good == GOOD_CYCLES {
            return Ok(());
        }
    }
    Err(format!("of {CYCLES} cycles {good} brought a state and took a command, {GOOD_CYCLES} are needed"))
}

fn modes(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    context.activate()?;
    let start = context.standstill()?;
    for &mode in ControlMode::ALL {
        let result = context.set_mode(mode);
        if context.has_mode(mode) {
            require(result.is_ok(), || format!("{}: {result:?}", mode.name()))?;
            let now = context.adapter.get_control_mode();
            require(now == mode, || format!("set to {}, reports {}", mode.name(), now.name()))?;
            context.stays(&start, context.holding())?;
        } else {
            require(result == Err(AdapterError::Unsupported), || format!("{}: {result:?}", mode.name()))?;
        }
    }
    Ok(())
}

fn optional_parts(context: &mut Context) -> Result<(), String> {
    context.ready(context.first_mode())?;
    let dof = context.config.dof;
    let adapter = &mut context.adapter;
    if let Some(gripper) = adapter.gripper() {
        gripper.read_gripper_position().map_err(|e| format!("read_gripper_position: {e}"))?;
    }
    if let Some(sensor) = adapter.force_torque() {
        sensor.read_force_torque().map_err(|e| format!("read_force_torque: {e}"))?;
    }
    let pose = adapter.cartesian().map_or(Ok(None), |poses| poses.read_cartesian_position());
    if let Some(pose) = pose.map_err(|e| format!("read_cartesian_position: {e}"))?.map(|stated| stated.tcp) {
        // A pose at 20 m or 7 rad is in millimetres or degrees.
        require(pose.xyz.iter().all(|v| v.abs() < 20.0), || format!("{:?} is not in metres", pose.xyz))?;
        require(pose.rpy.iter().all(|v| v.abs() < 7.0), || format!("{:?} is not in rad", pose.rpy))?;
    }
    if !adapter.get_info().modes.contains(&ControlMode::Velocity) {
        let result = adapter.write_joint_velocities(&vec![0.0; dof]);
        require(result == Err(AdapterError::Unsupported), || {
            format!("no velocity mode, but writing gives {result:?}")
        })?;
    }
    Ok(())
}

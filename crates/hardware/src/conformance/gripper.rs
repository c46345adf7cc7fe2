//! The gripper: its unit, its range, its force.

use super::Check;
use super::Needs::Motion;
use super::context::{Context, require};
use super::speed::slow_move;
use crate::adapter::AdapterError;
use dimos_core::arm::{GripperInfo, GripperUnit};
use dimos_core::joint::ControlMode;

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Motion, "gripper_is_in_its_unit", "the gripper moves to its target [m or rad]", unit),
    Check::new(Motion, "gripper_is_the_arms_own", "its values match the emulated gripper", own_gripper),
    Check::new(Motion, "gripper_range_is_kept", "positions outside its range are refused and move nothing", range),
    Check::new(Motion, "gripper_moves_no_joint", "its commands change no motion of the joints", moves_no_joint),
    Check::new(Motion, "gripper_force_is_kept", "forces outside their range are refused, others reach the arm", force),
];

/// Positions that agree [m].
const TOLERANCE: f64 = 0.001;
/// Radians of a rotary jaw that correspond to a metre of opening, for tolerances.
const RADIANS_PER_METRE: f64 = 10.0;

/// Returns a length of a gripper with an opening [m], or what corresponds to it for a rotary one [rad].
pub fn in_unit(unit: GripperUnit, metres: f64) -> f64 {
    match unit {
        GripperUnit::Meters => metres,
        GripperUnit::Radians => metres * RADIANS_PER_METRE,
        GripperUnit::OnOff => f64::from(metres > 0.0),
    }
}

/// Makes the arm ready; returns what is known of its gripper and its position, `None` without a gripper.
fn ready(context: &mut Context) -> Result<Option<(GripperInfo, f64)>, String> {
    context.ready(context.first_mode())?;
    let Some(info) = context.adapter.gripper().map(|gripper| gripper.info()) else { return Ok(None) };
    if let (GripperUnit::OnOff, Some((closed, _)), None) = (info.unit, info.range, context.gripper()?) {
        // Its position is the order: nothing is known of it before the first one.
        context.command_gripper(closed)?;
        arrives(context, info.unit, closed)?;
    }
    Ok(context.gripper()?.map(|position| (info, position)))
}

/// A target that differs from `from` and is within the range.
fn target(info: &GripperInfo, from: f64) -> f64 {
    let (closed, open) = info.range.unwrap_or((0.0, in_unit(info.unit, 0.04)));
    if info.unit == GripperUnit::OnOff {
        return if from == closed { open } else { closed };
    }
    let middle = (closed + open) / 2.0;
    // From the middle, a quarter of the range towards open.
    if (from - middle).abs() > (open - closed).abs() / 8.0 { middle } else { middle + (open - closed) / 4.0 }
}

fn arrives(context: &mut Context, unit: GripperUnit, target: f64) -> Result<(), String> {
    let tolerance = in_unit(unit, TOLERANCE);
    context.until("the gripper", |context| Ok(context.gripper()?.is_some_and(|now| (now - target).abs() < tolerance)))
}

/// A command that writes the goals of all servos again makes a slow motion a fast one.
fn moves_no_joint(context: &mut Context) -> Result<(), String> {
    let Some((info, from)) = ready(context)? else { return context.skip("it has no gripper") };
    if !context.has_mode(ControlMode::Position) {
        return context.skip("it has no position mode");
    }
    slow_move(context, |context| context.command_gripper(target(&info, from)))
}

/// Checks for a third of a second that the gripper does not move.
fn rests(context: &mut Context, unit: GripperUnit, from: f64) -> Result<(), String> {
    for _ in 0..33 {
        std::thread::sleep(std::time::Duration::from_millis(10));
        let now = context.gripper()?.unwrap_or(f64::NAN);
        let moved = (now - from).abs();
        require(moved < in_unit(unit, TOLERANCE), || format!("it moved by {moved:.4} {}", unit.name()))?;
    }
    Ok(())
}

fn unit(context: &mut Context) -> Result<(), String> {
    let Some((info, start)) = ready(context)? else { return context.skip("it has no gripper") };
    // An opening of half a metre is in millimetres; an angle of a turn is in degrees.
    let plausible = match info.unit {
        GripperUnit::Meters => -0.01..0.5,
        GripperUnit::Radians => -6.3..6.3,
        GripperUnit::OnOff => 0.0..1.5,
    };
    let named = info.unit.name();
    require(plausible.contains(&start), || format!("a position of {start} {named}"))?;
    if let Some((closed, open)) = info.range {
        let valid = plausible.contains(&closed) && plausible.contains(&open) && closed != open;
        require(valid, || format!("a range of {closed} to {open} {named}"))?;
        let (lower, upper, margin) = (closed.min(open), closed.max(open), in_unit(info.unit, 0.005));
        let inside = (lower - margin..=upper + margin).contains(&start);
        require(inside, || format!("a position of {start} {named} is outside {lower} to {upper}"))?;
    }
    let target = target(&info, start);
    context.command_gripper(target)?;
    arrives(context, info.unit, target)?;
    context.found(named)
}

/// An adapter that takes open for closed in both directions agrees with itself. The emulated gripper reveals it.
fn own_gripper(context: &mut Context) -> Result<(), String> {
    context.leave_out_calibration()?;
    let Some((info, start)) = ready(context)? else { return context.skip("it has no gripper") };
    if context.truth().gripper_position.is_none() {
        return context.skip("the true position of its emulated gripper is unknown");
    }
    let (tolerance, unit) = (in_unit(info.unit, 2.0 * TOLERANCE), info.unit.name());
    for (position, moves) in [(start, false), (target(&info, start), true)] {
        if moves {
            context.command_gripper(position)?;
            arrives(context, info.unit, position)?;
        }
        let found = context.truth().gripper_position.unwrap_or(f64::NAN);
        require((found - position).abs() < tolerance, || {
            format!("it reads {position:.4} {unit}, the emulated gripper is at {found:.4} {unit}")
        })?;
    }
    Ok(())
}

fn range(context: &mut Context) -> Result<(), String> {
    let Some((info, start)) = ready(context)? else { return context.skip("it has no gripper") };
    let Some((closed, open)) = info.range else { return context.skip("the range of its gripper is unknown") };
    let away = (open - closed) / 2.0;
    for position in [closed - away, open + away, f64::NAN, f64::INFINITY] {
        let result = context.command_gripper(position);
        require(result.is_err(), || format!("{position} {} is taken", info.unit.name()))?;
    }
    rests(context, info.unit, start)?;
    context.found(format!("{closed:.4} to {open:.4} {}", info.unit.name()))
}

fn force(context: &mut Context) -> Result<(), String> {
    let Some((info, start)) = ready(context)? else { return context.skip("it has no gripper") };
    let (target, unit) = (target(&info, start), info.force_unit.name());
    let command = |context: &mut Context, position: f64, force: f64| {
        let gripper = context.adapter.gripper().ok_or(AdapterError::Unsupported);
        gripper.and_then(|gripper| gripper.write_gripper_position_with_force(position, force))
    };
    let Some((least, most)) = info.force_range else {
        let result = command(context, target, 1.0);
        require(result == Err(AdapterError::Unsupported), || {
            format!("no force control, but writing gives {result:?}")
        })?;
        rests(context, info.unit, start)?;
        return context.found("no force control");
    };
    require(0.0 <= least && least < most && most.is_finite(), || format!("a range of {least} to {most} {unit}"))?;
    let mut wrong = vec![most * 1.1, f64::NAN, f64::INFINITY, -most];
    wrong.extend((least > 0.0).then_some(least / 2.0));
    for force in wrong {
        let result = command(context, target, force);
        require(result.is_err(), || format!("a force of {force} {unit} is taken"))?;
    }
    rests(context, info.unit, start)?;
    // A command has reached the arm once the gripper is at its target.
    context.command_gripper(target)?;
    arrives(context, info.unit, target)?;
    let own = context.truth().gripper_force;
    let (low, middle) = (least + (most - least) / 8.0, (least + most) / 2.0);
    for (position, force) in [(start, middle), (target, low)] {
        command(context, position, force).map_err(|e| format!("write_gripper_position_with_force: {e}"))?;
        arrives(context, info.unit, position)?;
        let reached = context.truth().gripper_force;
        let same = reached.is_none_or(|reached| (reached - force).abs() <= (most - least) / 100.0);
        require(same, || format!("{force} {unit} was commanded, the arm has {reached:?} {unit}"))?;
    }
    context.command_gripper(start)?;
    arrives(context, info.unit, start)?;
    let after = context.truth().gripper_force;
    require(after == own, || format!("without a force the arm has {own:?} {unit}, after a force {after:?} {unit}"))?;
    let measured = context.adapter.gripper().map_or(Ok(None), |gripper| gripper.read_gripper_force());
    let measured = measured.map_err(|e| format!("read_gripper_force: {e}"))?;
    let plausible = measured.is_none_or(|force| force.abs() <= 2.0 * most);
    require(plausible, || format!("a measured force of {measured:?} {unit}"))?;
    let measured = measured.map_or("not measured".to_owned(), |force| format!("measured {force:.2} {unit}"));
    context.found(format!("{least} to {most} {unit}, {measured}"))
}

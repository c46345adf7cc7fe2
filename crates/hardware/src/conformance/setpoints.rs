//! Setpoints: what a row says that its arm takes arrives there, and what is not commanded does not.

use std::time::Duration;

use super::Check;
use super::Needs::Motion;
use super::context::{Context, require, when_there_is_room};
use dimos_core::arm::{Field, Setpoint, SetpointFields};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::{ControlMode, Joints, MAX_DOF, joints_of};

/// The checks of this file.
pub const CHECKS: &[Check] =
    &[Check::new(Motion, "setpoints_arrive_whole", "what the row takes of a setpoint reaches the arm", arrive_whole)];

/// Difference of a value that is rounding on the wire, relative and absolute.
const ROUNDING: f64 = 1e-3;
/// How long the setpoints of the check hold.
const VALID: Duration = Duration::from_millis(80);

fn arrive_whole(context: &mut Context) -> Result<(), String> {
    let of_row = (context.row.check)(&context.config).map(|checked| checked.setpoint).unwrap_or_default();
    context.connect()?;
    let fields = context.adapter.setpoint_fields().unwrap_or(of_row);
    if context.emulator.is_none() {
        return context.skip("its arm is in memory");
    }
    let taken = |fields: &SetpointFields| fields.named().iter().filter(|(_, field)| field.is_taken()).count();
    if taken(&fields) == 0 {
        return context.skip("its row takes positions only");
    }
    let modes = context.adapter.get_info().modes;
    for mode in [ControlMode::ServoPosition, ControlMode::Impedance].into_iter().filter(|mode| modes.contains(mode)) {
        context.activate()?;
        context.set_mode(mode).map_err(|e| format!("set_control_mode {}: {e}", mode.name()))?;
        let full = setpoint(context, mode)?;
        write(context, &full)?;
        compare(context, &fields, &full)?;
        let bare = Setpoint { effort: None, ..setpoint(context, mode)? };
        write(context, &bare)?;
        compare(context, &fields, &bare)?;
        context.stop()?;
        context.standstill()?;
    }
    context.found(format!("{} of 7 fields besides positions", taken(&fields)))
}

/// Returns a setpoint where the arm is, with another value for each field and joint.
fn setpoint(context: &mut Context, mode: ControlMode) -> Result<Setpoint, String> {
    let (here, at) = (joints_of(&context.positions()?), MonotonicClock.now());
    let each = |first: f64, step: f64| -> Joints { std::array::from_fn(|i| first + step * i as f64) };
    let gains = mode == ControlMode::Impedance;
    Ok(Setpoint {
        velocity: each(0.01, 0.001),
        acceleration: Some(each(-0.2, 0.03)),
        effort: Some(each(0.25, -0.125)),
        stiffness: gains.then(|| each(60.0, 2.0)),
        damping: gains.then(|| each(2.0, 0.125)),
        expires: Some(at.after(VALID)),
        ..Setpoint::new(mode, here, at)
    })
}

fn write(context: &mut Context, setpoint: &Setpoint) -> Result<(), String> {
    let adapter = &mut context.adapter;
    when_there_is_room(|| adapter.write_setpoint(setpoint)).map_err(|e| format!("write_setpoint: {e}"))
}

fn compare(context: &mut Context, fields: &SetpointFields, sent: &Setpoint) -> Result<(), String> {
    // An answer shows that what was sent before has arrived.
    context.positions()?;
    let dof = context.config.dof;
    let Some(found) = context.truth().setpoint else {
        return Err("its row takes more than positions, and its emulator has received no whole setpoint".to_owned());
    };
    let close = |a: f64, b: f64| (a - b).abs() <= ROUNDING * (1.0 + b.abs());
    let all = |a: &Joints, b: &Joints| a.iter().zip(b).take(dof.min(MAX_DOF)).all(|(a, b)| close(*a, *b));
    let list = |name: &str, field: Field, found: Option<Joints>, sent: Option<Joints>| {
        let same = match (found, sent) {
            (None, None) => true,
            (Some(found), Some(sent)) => all(&found, &sent),
            _ => false,
        };
        require(!field.is_taken() || same, || format!("{name}: sent {sent:?}, arrived {found:?}"))
    };
    list("position", Field::Taken, Some(found.position), Some(sent.position))?;
    list("velocity", fields.velocity, Some(found.velocity), Some(sent.velocity))?;
    list("acceleration", fields.acceleration, found.acceleration, sent.acceleration)?;
    list("effort", fields.effort, found.effort, sent.effort)?;
    list("stiffness", fields.stiffness, found.stiffness, sent.stiffness)?;
    list("damping", fields.damping, found.damping, sent.damping)?;
    let times = |name: &str, field: Field, found: Option<f64>, sent: Option<f64>| {
        let same = found.zip(sent).map_or(found == sent, |(found, sent)| close(found, sent));
        require(!field.is_taken() || same, || format!("{name}: sent {sent:?} s, arrived {found:?} s"))
    };
    times("at", fields.at, Some(found.at.seconds_since(sent.at)), Some(0.0))?;
    times("expires", fields.expires, found.valid_for(), sent.valid_for())?;
    require(found.mode == sent.mode, || format!("mode: sent {:?}, arrived {:?}", sent.mode, found.mode))
}

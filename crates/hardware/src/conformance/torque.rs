//! Efforts: what an arm reports of them, and what carries it when efforts and gains are commanded.
//!
//! Nothing is known here of an arm's masses. The effort with which its own control holds it, as its emulator knows it,
//! is that of gravity; an arm that is held by commanded efforts and gains must rest where these put it.

use std::time::Duration;

use super::Check;
use super::Needs::Motion;
use super::context::{Context, between, pause, require, when_there_is_room};
use crate::adapter::AdapterError;
use dimos_core::arm::{Load, Setpoint};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::{ControlMode, Joints, MAX_DOF, joints_of};

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Motion, "efforts_are_those_of_the_arm", "efforts read are the motors', joint by joint", efforts),
    Check::new(Motion, "gravity_is_carried", "efforts and gains that are written hold the arm's weight", gravity),
    Check::new(Motion, "gains_ramp", "gains rise as they are written, and the arm with them", gains),
    Check::new(Motion, "payload_is_felt", "a load that is set reaches the controller", payload),
];

/// Time between setpoints.
const STEP: Duration = Duration::from_millis(10);
/// How long a setpoint holds: a busy machine may be late.
const VALID: Duration = Duration::from_millis(500);
/// An effort below this is none [Nm or N].
const NONE: f64 = 0.05;
/// Tolerance of an effort that is read: part of the largest one, and absolute [Nm or N].
const TOLERANCE: (f64, f64) = (0.15, 0.02);
/// The least effort of gravity that is worth a check [Nm or N].
const WEIGHT: f64 = 1.0;
/// Where the heaviest joint would rest without the efforts, and where it does rest in the test of the gains: below its
/// setpoint [rad or m].
const WITHOUT: f64 = 0.3;
const SAG: f64 = 0.1;
/// Damping for a stiffness [s].
const DAMPING: f64 = 0.15;
/// How many times as stiff the ramp makes the arm, and its steps.
const RISE: f64 = 3.0;
const STEPS: u32 = 60;
/// Share of the heaviest joint's effort by which it may change in a step of the ramp.
const JUMP: f64 = 0.25;

/// Compares the efforts that are read with the true ones, at rest and on the way.
fn efforts(context: &mut Context) -> Result<(), String> {
    // A planned motion is smooth, whatever a busy machine does.
    let planned = context.has_mode(ControlMode::Position).then_some(ControlMode::Position);
    let Some(mode) = planned.or(context.position_mode()) else { return context.skip("it has no position mode") };
    context.ready(mode)?;
    if context.joints()?.effort.is_none() {
        return context.skip("it reports no efforts");
    }
    if context.truth().efforts.is_none() {
        return context.skip("the efforts of its arm are not known");
    }
    let start = context.positions()?;
    let away = context.nearby(&start)?;
    // A busy machine may read late; a wrong adapter is wrong every time.
    let mut result = compare(context, &start, &away);
    for (from, to) in [(&away, &start), (&start, &away)] {
        if result.is_err() {
            let here = context.standstill()?;
            context.stream(&here, from)?;
            result = compare(context, from, to);
        }
    }
    let largest = result?;
    if largest < NONE {
        return context.skip("its emulated arm needs no efforts");
    }
    context.found(format!("up to {largest:.2}"))
}

/// Moves from one pose to the other, and returns the largest effort met.
fn compare(context: &mut Context, from: &[f64], to: &[f64]) -> Result<f64, String> {
    const POINTS: u32 = 60;
    let servo = context.adapter.get_control_mode() == ControlMode::ServoPosition;
    if !servo {
        context.command(to, 0.2)?;
    }
    let mut largest = 0.0_f64;
    for i in 1..=POINTS {
        if servo {
            context.command(&between(from, to, f64::from(i) / f64::from(POINTS)), 1.0)?;
        }
        pause(&mut *context.adapter, STEP);
        let before = context.truth().efforts.unwrap_or_default();
        let read = context.joints()?.effort.ok_or("a reading has no efforts now")?;
        let after = context.truth().efforts.unwrap_or_default();
        let joints = read.iter().zip(before.iter().zip(&after)).take(context.config.dof);
        largest = before.iter().chain(&after).fold(largest, |most, effort| most.max(effort.abs()));
        for (joint, (read, (before, after))) in joints.enumerate() {
            // Between the two truths, or those of a state before.
            let tolerance = TOLERANCE.0 * largest + TOLERANCE.1 + (after - before).abs();
            let near = |truth: &f64| (read - truth).abs() <= tolerance;
            require(near(before) || near(after), || {
                format!("joint {}: effort {read:.3} read, its motor has {after:.3}", joint + 1)
            })?;
        }
    }
    Ok(largest)
}

/// An arm in impedance mode, at rest in a pose in which a joint carries weight.
struct Carried {
    /// The pose [rad or m].
    pose: Joints,
    /// The efforts that hold it [Nm or N].
    weight: Joints,
    /// The joint that carries the most.
    joint: usize,
}

impl Carried {
    /// Prepares the arm; `None`, with the reason in the context, if it cannot be carried by efforts and gains.
    fn prepare(context: &mut Context) -> Result<Option<Self>, String> {
        let skip = |context: &mut Context, why| context.skip(why).map(|()| None);
        if !context.has_mode(ControlMode::Impedance) {
            return skip(context, "it has no impedance mode");
        }
        if context.emulator.is_none() {
            return skip(context, "its arm is in memory");
        }
        let of_row = (context.row.check)(&context.config).map(|checked| checked.setpoint).unwrap_or_default();
        context.ready(context.position_mode().unwrap_or(ControlMode::Impedance))?;
        let fields = context.adapter.setpoint_fields().unwrap_or(of_row);
        if !(fields.effort.is_taken() && fields.stiffness.is_taken() && fields.damping.is_taken()) {
            return skip(context, "its row takes no efforts with gains");
        }
        let Some(weight) = context.truth().efforts else {
            return skip(context, "the efforts of its arm are not known");
        };
        let pose = joints_of(&context.standstill()?);
        let heaviest = weight.iter().enumerate().max_by(|a, b| a.1.abs().total_cmp(&b.1.abs()));
        let (joint, most) = heaviest.map_or((0, 0.0), |(joint, effort)| (joint, effort.abs()));
        if most < WEIGHT {
            return skip(context, "its emulated arm has no weight");
        }
        context.set_mode(ControlMode::Impedance).map_err(|e| format!("set_control_mode impedance: {e}"))?;
        Ok(Some(Self { pose, weight, joint }))
    }

    /// Returns the effort of the heaviest joint against gravity [Nm or N].
    fn most(&self) -> f64 {
        self.weight.get(self.joint).copied().unwrap_or_default()
    }

    /// Writes the setpoint of the pose with a stiffness and efforts.
    fn hold(&self, context: &mut Context, stiffness: f64, effort: Option<Joints>) -> Result<(), String> {
        let at = MonotonicClock.now();
        let setpoint = Setpoint {
            effort,
            stiffness: Some([stiffness; MAX_DOF]),
            damping: Some([DAMPING * stiffness; MAX_DOF]),
            expires: Some(at.after(VALID)),
            ..Setpoint::new(ControlMode::Impedance, self.pose, at)
        };
        let adapter = &mut context.adapter;
        when_there_is_room(|| adapter.write_setpoint(&setpoint)).map_err(|e| format!("write_setpoint: {e}"))?;
        pause(&mut *context.adapter, STEP);
        Ok(())
    }

    /// Returns how far the heaviest joint is from the pose, against its effort [rad or m].
    fn sag(&self, context: &mut Context) -> Result<f64, String> {
        let here = context.positions()?;
        let at = |list: &[f64]| list.get(self.joint).copied().unwrap_or_default();
        Ok((at(&self.pose) - at(&here)) * self.most().signum())
    }

    /// Lets the arm sink to where a stiffness alone carries it.
    fn sink(&self, context: &mut Context, stiffness: f64) -> Result<(), String> {
        for _ in 0..150 {
            self.hold(context, stiffness, None)?;
        }
        Ok(())
    }

    /// Requires the sag that a stiffness alone leaves, within its half: the weight changes with the pose.
    fn require_sag(&self, context: &mut Context, expected: f64, stiffness: f64) -> Result<(), String> {
        let sag = self.sag(context)?;
        require((0.5 * expected..1.5 * expected).contains(&sag), || {
            format!(
                "joint {} carries {:.1}: with a stiffness of {stiffness:.0} it sinks by {expected:.3}, and is {sag:.3} below \
                 its setpoint",
                self.joint + 1,
                self.most().abs(),
            )
        })
    }

    /// Stops the arm and waits for its rest.
    fn end(context: &mut Context) -> Result<(), String> {
        context.stop()?;
        context.standstill().map(drop)
    }
}

fn gravity(context: &mut Context) -> Result<(), String> {
    let Some(carried) = Carried::prepare(context)? else { return Ok(()) };
    let stiffness = carried.most().abs() / WITHOUT;
    for _ in 0..80 {
        carried.hold(context, stiffness, Some(carried.weight))?;
        let sag = carried.sag(context)?;
        require(sag.abs() < 0.2 * WITHOUT, || {
            format!(
                "joint {} is {sag:.3} below its setpoint, with the {:.1} that carry it written: are efforts handed on, \
                 and with their sign?",
                carried.joint + 1,
                carried.most()
            )
        })?;
    }
    let stiff = carried.most().abs() / SAG;
    carried.sink(context, stiff)?;
    carried.require_sag(context, SAG, stiff)?;
    context.found(format!("joint {} carries {:.1}", carried.joint + 1, carried.most().abs()))?;
    Carried::end(context)
}

/// Raises the stiffness of an arm that is below its setpoint: its effort rises with it, in no jump.
fn gains(context: &mut Context) -> Result<(), String> {
    let Some(carried) = Carried::prepare(context)? else { return Ok(()) };
    let stiffness = carried.most().abs() / SAG;
    carried.sink(context, stiffness)?;
    carried.require_sag(context, SAG, stiffness)?;
    let effort = |context: &Context| {
        let efforts = context.truth().efforts.unwrap_or_default();
        efforts.get(carried.joint).copied().unwrap_or_default()
    };
    let mut before = effort(context);
    for step in 1..=STEPS {
        let raised = stiffness * (1.0 + (RISE - 1.0) * f64::from(step) / f64::from(STEPS));
        carried.hold(context, raised, None)?;
        let now = effort(context);
        require((now - before).abs() < JUMP * carried.most().abs(), || {
            format!("joint {}: its effort jumps from {before:.1} to {now:.1} in a ramp of gains", carried.joint + 1)
        })?;
        before = now;
    }
    carried.sink(context, RISE * stiffness)?;
    carried.require_sag(context, SAG / RISE, RISE * stiffness)?;
    Carried::end(context)
}

/// What is read back may be what the adapter remembers: the emulated controller has what arrived.
fn payload(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    if context.adapter.payload().is_none() {
        return context.skip("it takes no payload");
    }
    if context.truth().load.is_none() {
        return context.skip("the load of its arm is not known");
    }
    let load = Load { mass: 0.6, center: [0.02, -0.01, 0.05], inertia: [1e-3, 0.0, 1e-4, 2e-3, 0.0, 3e-3] };
    for load in [load, Load { mass: 0.9, ..load }, Load::default()] {
        let payload = context.adapter.payload().ok_or(AdapterError::Unsupported);
        payload.and_then(|part| part.write_payload(&load)).map_err(|e| format!("write_payload: {e}"))?;
        context.joints()?;
        let arrived = context.truth().load;
        let same = arrived.is_some_and(|arrived| load.agrees_with(&arrived));
        require(same, || format!("{load:?} is set, its arm has {arrived:?}"))?;
    }
    Ok(())
}

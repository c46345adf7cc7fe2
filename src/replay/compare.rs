//! Compares the outputs of a replayed tick with those in the log.

use std::fmt;

use serde::Serialize;

use super::inputs::{LoggedTick, values};
use super::recorded::Recorded;
use dimos_control::coordinator::TickOutput;
use dimos_core::arm::VelocitySource;
use dimos_core::joint::ControlMode;
use dimos_core::telemetry::describe::{Described, Names, describe};
use dimos_log::messages::Event;

/// A value that differs.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum Value {
    /// A number, and its bits.
    Number {
        /// A number and its bits.
        value: f64,
        /// IEEE 754 bits of the double, in hexadecimal.
        bits: String,
    },
    /// Anything else.
    Text(String),
}

impl Value {
    fn number(value: f64) -> Self {
        Self::Number { value, bits: format!("{:016x}", value.to_bits()) }
    }

    fn text(value: impl fmt::Display) -> Self {
        Self::Text(value.to_string())
    }
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Number { value, bits } => write!(f, "{value:?} (bits {bits})"),
            Self::Text(text) if text.is_empty() => write!(f, "nothing"),
            Self::Text(text) => write!(f, "{text}"),
        }
    }
}

/// The first difference.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// Index of the tick.
    pub tick: u64,
    /// Time [s after the first tick].
    pub time: f64,
    /// The differing quantity, e.g. `position command`.
    pub what: &'static str,
    /// The arm concerned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
    /// The joint concerned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub joint: Option<String>,
    /// Logged value.
    pub logged: Value,
    /// Replayed value.
    pub rerun: Value,
}

/// A differing quantity, its arm and joint, and both values.
type Mismatch = (&'static str, Option<(usize, Option<usize>)>, Value, Value);

/// Compares ticks with a log.
#[derive(Debug)]
pub(super) struct Comparison<'a> {
    pub names: &'a Names,
}

impl<'a> Comparison<'a> {
    pub fn new(recorded: &'a Recorded) -> Self {
        Self { names: &recorded.names }
    }

    /// Returns the first difference; `time` is the tick's time after the first tick [ns].
    pub fn compare(&self, logged: &LoggedTick, output: &TickOutput, time: u64) -> Option<Difference> {
        let (what, place, then, now) = self.arms(logged, output).or_else(|| self.events(&logged.events, output))?;
        let arm = place.and_then(|(arm, joint)| Some((self.names.arms.get(arm)?, joint)));
        Some(Difference {
            tick: logged.tick.tick,
            time: time as f64 * 1e-9,
            what,
            arm: arm.map(|(names, _)| names.hardware_id.clone()),
            joint: arm.and_then(|(names, joint)| names.joints.get(joint?).cloned()),
            logged: then,
            rerun: now,
        })
    }

    /// Returns the events that only the log has, and those that only the replay has, as text.
    pub fn other_events(&self, logged: &[Event], output: &TickOutput) -> (Vec<String>, Vec<String>) {
        let mut now: Vec<Described> = output.events.iter().map(|event| describe(event, self.names)).collect();
        let mut only_then = Vec::new();
        for then in logged {
            match now.iter().position(|now| is_reported_by(now, then)) {
                Some(at) => drop(now.remove(at)),
                None => only_then.push(then.text.clone()),
            }
        }
        (only_then, now.into_iter().map(|event| event.text).collect())
    }

    /// Passes on the command of each joint in the log and now; NaN where there is none, or one of another mode.
    pub fn commands(&self, logged: &LoggedTick, output: &TickOutput, mut each: impl FnMut(usize, &str, f64, f64)) {
        let mut first = 0;
        for ((then, now), names) in logged.arms.iter().zip(&output.arms).zip(&self.names.arms) {
            let dof = names.joints.len();
            let mode = ControlMode::of_name(&then.output.mode);
            let none = [f64::NAN; dimos_core::joint::MAX_DOF];
            let was = mode.and_then(|mode| values(column(mode, logged).1, first, dof)).unwrap_or(none);
            let comparable = now.command.mode.is_some() && (mode.is_none() || mode == now.command.mode);
            let is = if comparable { now.command.values } else { none };
            for ((j, name), (then, now)) in names.joints.iter().enumerate().zip(was.iter().zip(&is)) {
                each(first + j, name, *then, *now);
            }
            first += dof;
        }
    }

    fn arms(&self, logged: &LoggedTick, output: &TickOutput) -> Option<Mismatch> {
        let mut first = 0;
        let arms = logged.arms.iter().zip(&output.arms).zip(&self.names.arms).enumerate();
        for (i, ((then, now), names)) in arms {
            let dof = names.joints.len();
            let joint = |what, then: f64, now: f64, j| {
                (then.to_bits() != now.to_bits())
                    .then(|| (what, Some((i, Some(j))), Value::number(then), Value::number(now)))
            };
            if now.state.velocity_source == VelocitySource::Estimated {
                let mut pairs = then.velocity.iter().zip(&now.state.velocity).take(dof).enumerate();
                let found = pairs.find_map(|(j, (then, now))| joint("estimated velocity", *then, *now, j));
                if found.is_some() {
                    return found;
                }
            }
            let (command, wanted) = (&now.command, &then.output);
            if let Some(mode) = command.mode {
                let absent = [f64::NAN; dimos_core::joint::MAX_DOF];
                let effort = command.effort.unwrap_or(absent);
                let (what, column) = column(mode, logged);
                for (what, column, now) in
                    [(what, column, &command.values), ("effort command", &logged.commands.effort[..], &effort)]
                {
                    let then = values(column, first, dof).unwrap_or(absent);
                    let mut pairs = then.iter().zip(now).take(dof).enumerate();
                    if let Some(found) = pairs.find_map(|(j, (then, now))| joint(what, *then, *now, j)) {
                        return Some(found);
                    }
                }
            }
            first += dof;
            let name = command.mode.map_or("", ControlMode::name);
            let arm = |what, then: Value, now: Value| Some((what, Some((i, None)), then, now));
            if wanted.mode != name {
                return arm("mode of the command", Value::text(&wanted.mode), Value::text(name));
            }
            if wanted.gripper_seq != command.gripper_seq {
                let (then, now) = (wanted.gripper_seq, command.gripper_seq);
                return arm("number of gripper commands", Value::text(then), Value::text(now));
            }
            if command.gripper_seq > 0 && wanted.gripper.to_bits() != command.gripper.to_bits() {
                let (then, now) = (Value::number(wanted.gripper), Value::number(command.gripper));
                return arm("gripper command", then, now);
            }
            let limits = [
                ("force of the gripper command", &wanted.gripper_force, command.gripper_force),
                ("speed of the gripper command", &wanted.gripper_speed, command.gripper_speed),
            ];
            for (what, then, now) in limits {
                let values = [then.first().copied(), now];
                if let [before, after] = values.map(|value| value.map(f64::to_bits))
                    && before != after
                {
                    let [then, now] = values.map(|value| value.map_or_else(|| Value::text("none"), Value::number));
                    return arm(what, then, now);
                }
            }
            if wanted.stop_seq != command.stop_seq {
                return arm("number of stops", Value::text(wanted.stop_seq), Value::text(command.stop_seq));
            }
            if wanted.start_seq != command.start_seq {
                return arm("number of starts", Value::text(wanted.start_seq), Value::text(command.start_seq));
            }
            let numbers = (wanted.seq, wanted.next_tick_ns) == (command.seq, command.next_tick.0);
            if then.output_is_new && !numbers {
                let text = |seq, next| Value::Text(format!("command {seq}, next tick at {next} ns"));
                return arm(
                    "count of commands",
                    text(wanted.seq, wanted.next_tick_ns),
                    text(command.seq, command.next_tick.0),
                );
            }
        }
        None
    }

    fn events(&self, logged: &[Event], output: &TickOutput) -> Option<Mismatch> {
        if logged.is_empty() && output.events.is_empty() {
            return None;
        }
        let count = logged.len().max(output.events.len());
        (0..count).find_map(|k| {
            let (then, now) = (logged.get(k), output.events.get(k).map(|event| describe(event, self.names)));
            let same = then.zip(now.as_ref()).is_some_and(|(then, now)| is_reported_by(now, then));
            (!same).then(|| {
                let then = then.map_or(Value::text(""), |e| Value::text(&e.text));
                ("event", None, then, now.map_or(Value::text(""), |d| Value::Text(d.text)))
            })
        })
    }
}

/// Returns the logged commands of a mode, and what they are.
fn column(mode: ControlMode, logged: &LoggedTick) -> (&'static str, &[f64]) {
    match mode {
        ControlMode::Velocity => ("velocity command", &logged.commands.velocity),
        _ => ("position command", &logged.commands.position),
    }
}

/// Returns whether a message reports this event. The sentence may differ between versions.
fn is_reported_by(now: &Described, then: &Event) -> bool {
    let name = |name: &Option<String>| name.clone().unwrap_or_default();
    let bits = |values: &[f64]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    now.kind == then.kind
        && now.status == then.status
        && now.request.as_slice() == then.request
        && (name(&now.arm), name(&now.task), name(&now.joint))
            == (then.arm.clone(), then.task.clone(), then.joint.clone())
        && bits(&now.values) == bits(&then.values)
}

//! Samples of one arm as messages.

use super::messages::{ArmInput, ArmOutput, ArmStatus, Header};
use crate::arm::{ArmCommand, ArmState};
use crate::joint::ControlMode;
use crate::telemetry::describe::cause_text;
use crate::telemetry::{ArmSample, TickSample};

/// Returns whether two states differ in the fields of `ArmInput`. NaN differs from itself: a superfluous message is
/// better than a lost one.
pub(super) fn input_differs(a: &ArmState, b: &ArmState) -> bool {
    let values = |s: &ArmState| (s.gripper, s.pose, s.wrench, s.effort.is_some(), s.velocity_source);
    let flags = |s: &ArmState| (s.seq, s.stamp, s.mode, s.enabled, s.error, s.link, s.self_held, s.written);
    let more = |s: &ArmState| (s.interference, s.own_delay_ns);
    values(a) != values(b) || flags(a) != flags(b) || more(a) != more(b)
}

/// Returns whether two commands differ in the fields of `ArmOutput`, except for counters that change on their own.
pub(super) fn output_differs(a: &ArmCommand, b: &ArmCommand) -> bool {
    let parts = |c: &ArmCommand| (c.mode, c.gripper.to_bits(), c.gripper_seq, c.stop_seq, c.start_seq);
    parts(a) != parts(b)
}

/// Returns what a tick read of an arm, except joint values.
pub(super) fn input(header: &Header, tick: u64, s: &ArmState) -> ArmInput {
    ArmInput {
        header: header.clone(),
        tick,
        seq: s.seq,
        stamp_ns: s.stamp.0,
        velocity_source: s.velocity_source.name().into(),
        has_effort: s.effort.is_some(),
        gripper: s.gripper.into_iter().collect(),
        pose: s.pose.map_or_else(Vec::new, |p| [p.xyz, p.rpy].concat()),
        wrench: s.wrench.map_or_else(Vec::new, Vec::from),
        mode: s.mode.name().into(),
        enabled: s.enabled,
        error: s.error,
        link: s.link.name().into(),
        self_held: s.self_held,
        written: s.written,
        interference: s.interference.name().into(),
        own_delay_ns: s.own_delay_ns,
    }
}

/// Returns what a tick commands an arm, except joint values.
pub(super) fn output(header: &Header, tick: u64, c: &ArmCommand) -> ArmOutput {
    ArmOutput {
        header: header.clone(),
        tick,
        seq: c.seq,
        mode: c.mode.map_or("", ControlMode::name).into(),
        gripper: c.gripper,
        gripper_seq: c.gripper_seq,
        stop_seq: c.stop_seq,
        next_tick_ns: c.next_tick.0,
        start_seq: c.start_seq,
    }
}

/// Returns the status of an arm.
pub(super) fn status(header: Header, tick: &TickSample, sample: &ArmSample, error_text: &str) -> ArmStatus {
    let s = &sample.state;
    ArmStatus {
        header,
        tick: tick.tick,
        phase: sample.phase.name().into(),
        cause: sample.cause.name().into(),
        cause_text: cause_text(sample.cause),
        link: s.link.name().into(),
        mode: s.mode.name().into(),
        enabled: s.enabled,
        error: s.error,
        error_text: if s.error == 0 { String::new() } else { error_text.to_owned() },
        age: if s.seq == 0 { f64::NAN } else { tick.deadline.seconds_since(s.stamp) },
        velocity_source: s.velocity_source.name().into(),
        seq: s.seq,
        self_held: s.self_held,
    }
}

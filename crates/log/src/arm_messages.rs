//! Samples of one arm as messages.

use super::messages::{self, ArmInput, ArmIo, ArmOutput, ArmStatus, Header, Inertia, InertiaStamped, Vector3};
use dimos_core::arm::{AnalogUnit, ArmCommand, ArmState, Commanded, IoInfo, IoState, JointStatus, Load};
use dimos_core::joint::{ControlMode, Joints};
use dimos_core::telemetry::texts::cause_text;
use dimos_core::telemetry::{ArmSample, TickSample};

/// Returns whether two states differ in the fields of `ArmInput`. NaN differs from itself: a superfluous message is
/// better than a lost one.
pub(super) fn input_differs(a: &ArmState, b: &ArmState) -> bool {
    let values = |s: &ArmState| (s.gripper, s.gripper_force, s.pose, s.wrench, s.effort.is_some(), s.velocity_source);
    let flags = |s: &ArmState| (s.seq, s.stamp, s.mode, s.enabled, s.error, s.link, s.self_held, s.written);
    let more = |s: &ArmState| (s.interference, s.own_delay_ns, s.stop_input_open, s.device_ns, s.refused, s.commanded);
    values(a) != values(b)
        || flags(a) != flags(b)
        || more(a) != more(b)
        || a.speed_fraction != b.speed_fraction
        || a.inputs != b.inputs
        || (a.effort_kind, a.missing) != (b.effort_kind, b.missing)
}

/// Returns whether two commands differ in the fields of `ArmOutput`, except for counters that change on their own.
pub(super) fn output_differs(a: &ArmCommand, b: &ArmCommand) -> bool {
    let limits = |c: &ArmCommand| [c.gripper_force, c.gripper_speed].map(|value| value.map(f64::to_bits));
    let gripper = |c: &ArmCommand| (c.gripper.to_bits(), limits(c), c.gripper_seq);
    let parts = |c: &ArmCommand| (c.mode, gripper(c), c.stop_seq, c.start_seq);
    parts(a) != parts(b) || a.gains != b.gains
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
        pose: s.pose.and_then(|p| p.flange()).map_or_else(Vec::new, |p| [p.xyz, p.rpy].concat()),
        wrench: s.wrench.map_or_else(Vec::new, Vec::from),
        mode: s.mode.name().into(),
        enabled: s.enabled,
        error: s.error,
        link: s.link.name().into(),
        self_held: s.self_held,
        written: s.written,
        interference: s.interference.name().into(),
        own_delay_ns: s.own_delay_ns,
        stop_input_open: s.stop_input_open,
        device_ns: s.device_ns.into_iter().collect(),
        gripper_force: s.gripper_force.into_iter().collect(),
        commanded_position: of_joints(s, |commanded| &commanded.position),
        commanded_velocity: of_joints(s, |commanded| &commanded.velocity),
        refused: s.refused,
        speed_fraction: s.speed_fraction.into_iter().collect(),
        inputs: s.inputs.into_iter().collect(),
        effort_kind: s.effort_kind.name().into(),
        missing: s.missing.iter().map(|joint| joint as u8).collect(),
    }
}

/// Returns a list of what the arm's controller commands; empty if it reports nothing.
fn of_joints(s: &ArmState, list: fn(&Commanded) -> &Joints) -> Vec<f64> {
    s.commanded.as_ref().map_or_else(Vec::new, |commanded| list(commanded).iter().take(s.dof).copied().collect())
}

/// Returns what a tick commands an arm, except joint values.
pub(super) fn output(header: &Header, tick: u64, c: &ArmCommand, dof: usize) -> ArmOutput {
    let of_mode = c.gains.filter(|_| c.mode == Some(ControlMode::Impedance));
    let gains = |which: usize| {
        let list = of_mode.as_ref().and_then(|gains| gains.get(which));
        list.map_or_else(Vec::new, |list| list.iter().take(dof).copied().collect())
    };
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
        gripper_force: c.gripper_force.into_iter().collect(),
        gripper_speed: c.gripper_speed.into_iter().collect(),
        stiffness: gains(0),
        damping: gains(1),
    }
}

/// Returns the levels of inputs and outputs.
pub(super) fn io(header: Header, info: &IoInfo, state: &IoState) -> ArmIo {
    let levels = |bits: u32, count: u8| (0..count).map(move |i| (bits.checked_shr(i.into()).unwrap_or(0) & 1) as u8);
    let units = |units: &[AnalogUnit]| units.iter().map(|unit| unit.name().to_owned()).collect();
    let values = |values: &[f64], count: usize| values.iter().take(count).copied().collect();
    ArmIo {
        header,
        digital_inputs: levels(state.digital_inputs, info.digital_inputs).collect(),
        digital_outputs: levels(state.digital_outputs, info.digital_outputs).collect(),
        analog_inputs: values(&state.analog_inputs, info.analog_inputs.len()),
        analog_outputs: values(&state.analog_outputs, info.analog_outputs.len()),
        analog_input_units: units(info.analog_inputs),
        analog_output_units: units(info.analog_outputs),
    }
}

/// Returns the condition of joints with these names.
pub(super) fn joint_status(header: Header, names: &[String], joints: &[JointStatus]) -> messages::JointStatus {
    let joints = joints.get(..names.len()).unwrap_or_default();
    let column = |value: fn(&JointStatus) -> Option<f64>| -> Vec<f64> {
        let any = joints.iter().any(|joint| value(joint).is_some());
        joints.iter().filter(|_| any).map(|joint| value(joint).unwrap_or(f64::NAN)).collect()
    };
    messages::JointStatus {
        header,
        name: names.to_vec(),
        temperature: column(|joint| joint.temperature),
        current: column(|joint| joint.current),
        voltage: column(|joint| joint.voltage),
        load: column(|joint| joint.load),
        error: joints.iter().map(|joint| joint.error).collect::<Option<_>>().unwrap_or_default(),
    }
}

/// Returns a load at the flange.
pub(super) fn payload(header: Header, load: &Load) -> InertiaStamped {
    let ([x, y, z], [ixx, ixy, ixz, iyy, iyz, izz]) = (load.center, load.inertia);
    let inertia = Inertia { m: load.mass, com: Vector3 { x, y, z }, ixx, ixy, ixz, iyy, iyz, izz };
    InertiaStamped { header, inertia }
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

//! Optional parts: condition of the joints, inputs and outputs, the load at the flange. On a real arm they are only
//! read.

use super::Check;
use super::Needs::{Faults, Motion, Nothing};
use super::context::{Context, farthest, require};
use crate::adapter::{AdapterError, AdapterResult, Io};
use crate::registry::Teach;
use crate::sim::faults::{Fault, FaultKind};
use dimos_core::arm::{IoInfo, IoState, JointStatus, Load, MAX_ANALOG, MAX_DIGITAL};

/// The checks of this file.
pub const CHECKS: &[Check] = &[
    Check::new(Nothing, "io_is_read", "inputs and outputs are within their numbers, finite", io_is_read),
    Check::new(Motion, "outputs_are_read_back", "an output that is set is read back, alone", outputs),
    Check::new(Nothing, "joint_status_is_read", "temperatures, currents, voltages, loads are plausible", joint_status),
    Check::new(Nothing, "payload_is_read", "the load at the flange is that of a body", payload_is_read),
    Check::new(Motion, "payload_is_read_back", "a load that is set is read back, also when enabled", payload),
    Check::new(Faults, "hand_guiding_gives_way", "guided it gives way to a hand; stopped or enabled it holds", guiding),
    Check::new(Faults, "inputs_are_seen", "a digital input that changes is read at once", inputs),
];

/// How far a hand moves a joint [rad].
const BY_HAND: f64 = 0.04;
/// How long a digital input stays low [s].
const LOW: f64 = 0.3;

fn guiding(context: &mut Context) -> Result<(), String> {
    let push = Fault { amount: BY_HAND, ..Fault::new(FaultKind::Pushed) };
    let pushes = context.emulator.is_some() && (0..4).all(|_| context.prepare(push));
    context.connect()?;
    let (claimed, there) = (context.row.teach == Teach::HandGuiding, context.adapter.hand_guiding().is_some());
    require(claimed == there, || format!("hand guiding: {there}, its row says {claimed}"))?;
    if !(there && pushes) {
        return context.skip(if there { "its emulator cannot be moved by hand" } else { "it has no hand guiding" });
    }
    context.ready(context.position_mode().unwrap_or(context.first_mode()))?;
    let start = context.positions()?;
    context.trigger_faults()?;
    context.stays(&start, context.settling())?;
    for by_stop in [true, false] {
        context.until("the guiding to begin", |context| match context.adapter.hand_guiding() {
            Some(arm) => match arm.begin_hand_guiding() {
                Err(AdapterError::Rejected(_)) => Ok(false),
                begun => begun.map(|()| true).map_err(|e| format!("begin_hand_guiding: {e}")),
            },
            None => Err("the hand guiding is gone".into()),
        })?;
        let before = context.positions()?;
        context.trigger_faults()?;
        context.until("the arm to give way", |context| Ok(farthest(&context.positions()?, &before) > 0.5 * BY_HAND))?;
        let here = context.standstill()?;
        if !by_stop {
            context.activate()?;
            return context.stays(&here, context.settling());
        }
        context.stop()?;
        context.trigger_faults()?;
        context.stays(&here, context.settling())?;
        context.activate()?;
    }
    Ok(())
}

/// Returns the channels; `None` without any.
fn info(context: &mut Context) -> Option<IoInfo> {
    context.adapter.io().map(|io| io.get_io())
}

fn with<T>(context: &mut Context, what: &str, act: impl FnOnce(&mut dyn Io) -> AdapterResult<T>) -> Result<T, String> {
    let io = context.adapter.io().ok_or(AdapterError::Unsupported);
    io.and_then(act).map_err(|e| format!("{what}: {e}"))
}

fn read(context: &mut Context) -> Result<IoState, String> {
    let mut state = IoState::default();
    with(context, "read_io", |io| io.read_io(&mut state))?;
    Ok(state)
}

/// Arms report temperatures in whole degrees [°C].
const ROUNDED: f64 = 0.5;

fn joint_status(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    context.joints()?;
    let dof = context.config.dof;
    let Some(monitor) = context.adapter.joint_monitor() else { return context.skip("it reports no joint status") };
    let mut joints = vec![JointStatus::default(); dof];
    monitor.read_joint_status(&mut joints).map_err(|e| format!("read_joint_status: {e}"))?;
    let mut offsets = vec![0.0; dof];
    monitor.read_calibration_offsets(&mut offsets).map_err(|e| format!("read_calibration_offsets: {e}"))?;
    let angles = offsets.iter().all(|v| v.abs() <= std::f64::consts::TAU);
    require(angles, || format!("calibration offsets {offsets:?} are not in rad, or more than a turn"))?;
    for (i, joint) in joints.iter().enumerate() {
        let quantities = [
            ("temperature [°C]", joint.temperature, -40.0..=150.0),
            ("current [A]", joint.current, -100.0..=100.0),
            ("voltage [V]", joint.voltage, 0.0..=100.0),
            ("load", joint.load, -5.0..=5.0),
        ];
        for (what, value, range) in quantities {
            let plausible = value.is_none_or(|value| range.contains(&value));
            require(plausible, || format!("joint {}: {what} is {value:?}", i + 1))?;
        }
        let known = *joint != JointStatus::default();
        require(known, || format!("joint {}: nothing is reported; return None for the part", i + 1))?;
    }
    for (i, (joint, own)) in joints.iter().zip(context.truth().temperatures.iter().flatten()).enumerate() {
        let same = joint.temperature.is_none_or(|celsius| (celsius - own).abs() <= ROUNDED);
        require(same, || format!("joint {}: {:?} °C, the emulated drive has {own} °C", i + 1, joint.temperature))?;
    }
    if let (Some(allocations), Some(monitor)) = (context.allocations, context.adapter.joint_monitor()) {
        let before = allocations();
        let read = monitor.read_joint_status(&mut joints);
        let after = allocations();
        require(read.is_err() || after == before, || format!("it allocates {} times", after - before))?;
    }
    let celsius: Vec<_> = joints.iter().filter_map(|joint| joint.temperature).map(|t| format!("{t:.0}")).collect();
    context.found(format!("{} °C", celsius.join(" ")))
}

fn io_is_read(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    let Some(info) = info(context) else { return context.skip("it has no inputs and outputs") };
    let digital = info.digital_inputs.max(info.digital_outputs) <= MAX_DIGITAL;
    let analog = info.analog_inputs.len().max(info.analog_outputs.len()) <= MAX_ANALOG;
    require(digital && analog, || format!("more channels than a state holds: {info:?}"))?;
    let state = read(context)?;
    let beyond = |bits: u32, count: u8| bits.checked_shr(count.into()).unwrap_or(0) != 0;
    let spare =
        beyond(state.digital_inputs, info.digital_inputs) || beyond(state.digital_outputs, info.digital_outputs);
    require(!spare, || format!("a channel that get_io lacks is high: {state:?}"))?;
    for (values, units) in [(&state.analog_inputs, info.analog_inputs), (&state.analog_outputs, info.analog_outputs)] {
        let (used, spare) = values.split_at(units.len());
        let valid = used.iter().all(|v| v.is_finite()) && spare.iter().all(|v| *v == 0.0);
        require(valid, || format!("analogue values {values:?} of {} channels", units.len()))?;
    }
    if let Some(allocations) = context.allocations {
        read(context)?;
        // A connection may make room for the first reply.
        let before = allocations();
        read(context)?;
        let after = allocations();
        require(after == before, || format!("read_io allocates {} times", after - before))?;
    }
    let names = |kind: &str, count: u8| (0..count).map(|i| format!("{kind}{i}")).collect::<Vec<_>>().join(" ");
    context.found(format!("{} {}", names("di", info.digital_inputs), names("do", info.digital_outputs)))
}

fn outputs(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    let Some(info) = info(context) else { return context.skip("it has no inputs and outputs") };
    for output in 0..info.digital_outputs {
        for high in [true, false] {
            let before = read(context)?.digital_outputs;
            with(context, "write_digital_output", |io| io.write_digital_output(output, high))?;
            let after = read(context)?.digital_outputs;
            let expected = before & !(1 << output) | u32::from(high) << output;
            require(after == expected, || format!("do{output} = {high}: outputs {before:b}, then {after:b}"))?;
        }
    }
    let beyond = with(context, "", |io| io.write_digital_output(info.digital_outputs, true));
    require(beyond.is_err(), || format!("do{} is set, which get_io lacks", info.digital_outputs))?;
    for output in 0..info.analog_outputs.len() {
        let before = read(context)?.analog_outputs;
        let range = if before.get(output).is_some_and(|v| *v > 1.0) { 0.5 } else { 1.5 };
        let number = output as u8;
        with(context, "write_analog_output", |io| io.write_analog_output(number, range))?;
        let after = read(context)?.analog_outputs;
        let close = |i: usize, value: f64| after.get(i).is_some_and(|v| (v - value).abs() < 0.01);
        let others = before.iter().enumerate().all(|(i, v)| i == output || close(i, *v));
        require(close(output, range) && others, || format!("ao{output} = {range}: {before:?}, then {after:?}"))?;
        let infinite = with(context, "", |io| io.write_analog_output(number, f64::NAN));
        require(infinite.is_err(), || format!("ao{output} is set to NaN"))?;
    }
    Ok(())
}

fn payload_is_read(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    let Some(payload) = context.adapter.payload() else { return context.skip("it takes no payload") };
    let load = payload.read_payload().map_err(|e| format!("read_payload: {e}"))?;
    let gravity = payload.read_mounting().map_err(|e| format!("read_mounting: {e}"))?;
    let length = gravity.map_or(1.0, |g| g.iter().map(|v| v * v).sum::<f64>().sqrt());
    require((length - 1.0).abs() < 0.01, || format!("the direction of gravity {gravity:?} is no unit vector"))?;
    let Some(load) = load else { return context.found("not reported") };
    load.check()?;
    context.found(format!("{:.3} kg at {:?} m", load.mass, load.center))
}

/// Sets a load and reads it back.
fn carries(context: &mut Context, load: &Load) -> Result<(), String> {
    let payload = context.adapter.payload().ok_or("payload is None now")?;
    payload.write_payload(load).map_err(|e| format!("write_payload: {e}"))?;
    let actual = payload.read_payload().map_err(|e| format!("read_payload: {e}"))?;
    require(actual.is_none_or(|actual| load.agrees_with(&actual)), || format!("{load:?} is set, {actual:?} is read"))
}

fn payload(context: &mut Context) -> Result<(), String> {
    context.connect()?;
    if context.adapter.payload().is_none() {
        return context.skip("it takes no payload");
    }
    let tool = Load { mass: 0.5, center: [0.01, -0.02, 0.06], inertia: [1e-3, 0.0, 1e-4, 2e-3, 0.0, 3e-3] };
    carries(context, &tool)?;
    let mode = context.first_mode();
    context.activate()?;
    context.set_mode(mode).map_err(|e| e.to_string())?;
    let rest = context.standstill()?;
    carries(context, &Load { mass: 0.8, ..tool })?;
    if context.adapter.payload().is_some_and(|payload| payload.resets_controller()) {
        context.activate()?;
        context.set_mode(mode).map_err(|e| e.to_string())?;
    }
    context.stays(&rest, context.settling())?;
    let same = context.adapter.get_control_mode() == mode;
    require(same, || format!("it is in {} mode afterwards", context.adapter.get_control_mode().name()))?;
    require(context.enabled()?, || "its motors are off afterwards".into())?;
    carries(context, &Load::default())
}

fn inputs(context: &mut Context) -> Result<(), String> {
    if !context.prepare(Fault { input: 1, ..Fault::new(FaultKind::InputLow).lasting(LOW) }) {
        return context.skip("its emulator has no digital inputs");
    }
    context.connect()?;
    let before = read(context)?;
    require(before.input(0) && before.input(1), || "its inputs are not high".into())?;
    context.trigger_faults()?;
    let level = |context: &mut Context| -> Result<IoState, String> {
        context.joints()?;
        read(context)
    };
    context.until("di1 to be low", |context| Ok(!level(context)?.input(1)))?;
    let low = level(context)?;
    require(low.input(0), || "di0 changed with di1".into())?;
    context.until("di1 to be high again", |context| Ok(level(context)?.input(1)))
}

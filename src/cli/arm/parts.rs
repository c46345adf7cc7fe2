//! `dimos arm io|payload ARM`: the optional parts of an arm.

use std::collections::BTreeMap;
use std::path::PathBuf;

use super::super::arguments::{finite, length};
use super::super::exit::{Exit, Result};
use super::super::output;
use super::ArmArgs;
use dimos_core::arm::GripperUnit;
use dimos_rpc::api::{AnalogReport, ArmIo, ArmIoSet, ArmPayload, ArmPayloadSet, ArmTare, IoReport, LoadReport};
use dimos_rpc::report::{ArmReport, JointStatusReport};

/// Arguments of `arm io`.
#[derive(Debug, clap::Args)]
pub struct IoArgs {
    #[command(flatten)]
    which: ArmArgs,
    /// Set an output: `do3=1`, or `ao0=2.5` in the unit of the channel; repeat for more
    #[arg(long, value_name = "OUTPUT=VALUE", value_parser = assignment)]
    set: Vec<(String, f64)>,
}

fn assignment(text: &str) -> std::result::Result<(String, f64), String> {
    let (name, value) = text.split_once('=').ok_or("give OUTPUT=VALUE, for example do3=1")?;
    Ok((name.trim().to_owned(), finite(value.trim())?))
}

/// Arguments of `arm payload`.
#[derive(Debug, clap::Args)]
pub struct PayloadArgs {
    #[command(flatten)]
    pub(super) which: ArmArgs,
    /// Find the load: the arm moves to ten places around this one, and its efforts show it
    #[arg(long, conflicts_with = "mass")]
    identify: bool,
    /// With --identify: write the places and efforts to this file
    #[arg(long, value_name = "FILE", requires = "identify")]
    pub(super) save: Option<PathBuf>,
    /// With --identify: go to the places of this file, which was saved without the load; only the difference counts
    #[arg(long, value_name = "FILE", requires = "identify")]
    pub(super) unloaded: Option<PathBuf>,
    /// Set the mass of everything at the flange [kg]
    #[arg(long, value_name = "KG", value_parser = finite, allow_negative_numbers = true)]
    mass: Option<f64>,
    /// Its centre in the flange frame [m]; default: the flange
    #[arg(long, value_names = ["X", "Y", "Z"], num_args = 3, value_parser = length, allow_negative_numbers = true, requires = "mass")]
    center: Option<Vec<f64>>,
    /// Its inertia about the centre, along the axes of the flange frame [kg·m²]; default: a point mass
    #[arg(long, value_names = ["XX", "XY", "XZ", "YY", "YZ", "ZZ"], num_args = 6, value_parser = finite, allow_negative_numbers = true, requires = "mass")]
    inertia: Option<Vec<f64>>,
}

/// Runs `arm payload`.
pub fn payload(args: &PayloadArgs) -> Result {
    if args.identify {
        return super::identify::run(args);
    }
    let (mut client, arm) = (args.which.target_run.connect()?, args.which.arm.clone());
    let reply = match args.mass {
        None => client.call(ArmPayload { arm })?,
        Some(mass) => {
            let center = args.center.as_deref().and_then(|v| v.try_into().ok()).unwrap_or_default();
            let inertia = args.inertia.as_deref().and_then(|v| v.try_into().ok()).unwrap_or_default();
            client.call(ArmPayloadSet { arm, mass, center, inertia })?
        }
    };
    if args.which.target_run.json {
        output::json(&reply);
    } else {
        let text = reply.payload.as_ref().map_or_else(|| "not reported by the controller".to_owned(), payload_text);
        output::line(format_args!("{}: payload {text}", args.which.arm));
    }
    Ok(Exit::Ok)
}

/// Returns a load as text.
pub fn payload_text(load: &LoadReport) -> String {
    let [x, y, z] = load.center.map(|v| output::fixed(v, 4));
    let inertia = match load.inertia.iter().all(|v| *v == 0.0) {
        true => String::new(),
        false => format!(", inertia {} kg·m²", load.inertia.map(|v| output::fixed(v, 5)).join(" ")),
    };
    format!("{} kg, centre {x} {y} {z} m{inertia}", output::fixed(load.mass, 3))
}

/// Runs `arm tare`.
pub fn tare(which: &ArmArgs) -> Result {
    let reply = which.target_run.connect()?.call(ArmTare { arm: which.arm.clone() })?;
    if which.target_run.json {
        output::json(&reply);
    } else {
        let [fx, fy, fz, tx, ty, tz] = reply.wrench.map(|value| output::fixed(value, 2));
        output::line(format_args!("{}: zero is now {fx} {fy} {fz} N, {tx} {ty} {tz} Nm", which.arm));
    }
    Ok(Exit::Ok)
}

/// Runs `arm io`.
pub fn io(args: &IoArgs) -> Result {
    let (mut client, arm) = (args.which.target_run.connect()?, args.which.arm.clone());
    let report = if args.set.is_empty() {
        client.call(ArmIo { arm })?
    } else {
        client.call(ArmIoSet { arm, outputs: args.set.iter().cloned().collect::<BTreeMap<_, _>>() })?
    };
    if args.which.target_run.json {
        output::json(&report);
        return Ok(Exit::Ok);
    }
    io_lines(&report).iter().for_each(output::line);
    Ok(Exit::Ok)
}

/// Returns the condition of joints as lines of text: one per quantity, the joints in order; errors of the drives only
/// if one has an error.
pub fn joint_lines(joints: &[JointStatusReport]) -> Vec<String> {
    type Value = fn(&JointStatusReport) -> Option<f64>;
    let quantities: [(&str, usize, Value); 6] = [
        ("temperature °C", 0, |j| j.temperature),
        ("current A", 2, |j| j.current),
        ("supply V", 1, |j| j.voltage),
        ("load %", 0, |j| j.load.map(|v| v * 100.0)),
        ("drive error", 0, |j| j.error.map(f64::from)),
        ("calibration offset rad", 4, |j| j.calibration_offset),
    ];
    let line = |(name, digits, value): (&str, usize, Value)| {
        let cells = joints.iter().map(|j| value(j).map_or_else(|| "-".to_owned(), |v| output::fixed(v, digits)));
        joints.iter().any(|j| value(j).is_some()).then(|| format!("{name}: {}", cells.collect::<Vec<_>>().join(" ")))
    };
    let healthy = joints.iter().all(|j| j.error.is_none_or(|code| code == 0));
    quantities.into_iter().filter(|(name, ..)| !(healthy && *name == "drive error")).filter_map(line).collect()
}

/// Returns inputs and outputs as lines of text.
pub fn io_lines(report: &IoReport) -> Vec<String> {
    let digital = |kind: &str, levels: &[bool]| -> Vec<String> {
        levels.iter().enumerate().map(|(i, high)| format!("{kind}{i}={}", u8::from(*high))).collect()
    };
    let analog = |kind: &str, values: &[AnalogReport]| -> Vec<String> {
        values.iter().enumerate().map(|(i, v)| format!("{kind}{i}={:.3} {}", v.value, v.unit)).collect()
    };
    let inputs = [digital("di", &report.digital_inputs), analog("ai", &report.analog_inputs)].concat();
    let outputs = [digital("do", &report.digital_outputs), analog("ao", &report.analog_outputs)].concat();
    let mut lines = Vec::new();
    for (kind, channels) in [("inputs", inputs), ("outputs", outputs)] {
        if !channels.is_empty() {
            lines.push(format!("{kind}: {}", channels.join(" ")));
        }
    }
    if let Some(stop) = &report.stop_input {
        let state = if stop.open { "open: the arm is held" } else { "closed" };
        lines.push(format!("stop input {}: {state}", stop.input));
    }
    lines
}

/// Returns ranges and measured force of an arm's gripper; `None` without one, or if nothing is known of it.
pub fn gripper_line(arm: &ArmReport) -> Option<String> {
    let (unit, force_unit) = (arm.gripper_unit.as_deref()?, arm.gripper_force_unit.as_deref().unwrap_or_default());
    let range = arm.gripper_range.map(|[closed, open]| match unit == GripperUnit::OnOff.name() {
        true => format!("only opens ({open}) and closes ({closed}); nothing measures its fingers"),
        false => format!("{closed:.4} {unit} closed, {open:.4} {unit} open"),
    });
    let commands = arm.gripper_force_range.map(|[least, most]| format!("force {least} to {most} {force_unit}"));
    let measured = arm.gripper_force.map(|force| format!("measured force {force:.2} {force_unit}"));
    let speed = arm.gripper_has_speed.then(|| "speed control".to_owned());
    let parts: Vec<String> = [range, commands, speed, measured].into_iter().flatten().collect();
    (!parts.is_empty()).then(|| format!("gripper {}", parts.join("; ")))
}

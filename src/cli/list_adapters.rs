//! `dimos list-adapters`: the arms that this program supports, and grippers and sensors with their own connections.

use serde_json::json;

use super::exit::{Exit, Result};
use super::output::{self, Table};
use dimos_core::joint::MAX_DOF;
use dimos_hardware::check::Checked;
use dimos_hardware::peripheral::PeripheralSpec;
use dimos_hardware::registry::{Absent, AdapterConfig, AdapterSpec, OptionsSpec, Registry, Teach};

/// Arguments of `list-adapters`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
LEVEL    how far it is proven
           works       compiles, connects
           conformant  passes the conformance suite against a test double
           emulated    passes it against an emulator of its wire format, which
                       `address: sim` starts
HOLDS    whether the arm keeps its pose when its motors are disabled
GRIPPER  whether the adapter drives one
TEACH    how it is led by hand (dimos arm teach)")]
pub struct Args {
    /// Print JSON
    #[arg(long)]
    pub json: bool,
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    if args.json {
        let peripherals = registry.peripherals().iter().map(peripheral);
        let rows = registry.rows().iter().map(to_json).chain(registry.absent().map(lacking)).chain(peripherals);
        output::json(&rows.collect::<Vec<_>>());
        return Ok(Exit::Ok);
    }
    lines(registry).iter().for_each(output::wrapped);
    Ok(Exit::Ok)
}

/// Returns the table, and a paragraph for each adapter.
fn lines(registry: &Registry) -> Vec<String> {
    let mut table = Table::new(&["NAME", "LEVEL", "TRANSPORT", ">DOF", ">RATE Hz", "HOLDS", "GRIPPER", "TEACH"]);
    for row in registry.rows() {
        table.row([
            row.name.to_owned(),
            row.level.name().to_owned(),
            row.transport.to_owned(),
            dof(row),
            format!("{:.0}", row.native_rate),
            if row.holds_when_disabled { "yes" } else { "no, falls" }.to_owned(),
            if row.gripper { "yes" } else { "no" }.to_owned(),
            teach(row).to_owned(),
        ]);
    }
    for absent in registry.absent() {
        let nothing = ["-"; 6].map(str::to_owned);
        table.row([absent.name.to_owned(), "not in this build".to_owned()].into_iter().chain(nothing));
    }
    let mut lines = table.lines();
    if !registry.peripherals().is_empty() {
        let mut table = Table::new(&["AT AN ARM", "LEVEL", "PART", ">RATE Hz"]);
        for row in registry.peripherals() {
            let rate = format!("{:.0}", row.native_rate);
            table.row([row.name.to_owned(), row.level.name().to_owned(), row.part.text().to_owned(), rate]);
        }
        lines.push(String::new());
        lines.extend(table.lines());
    }
    for row in registry.rows() {
        lines.extend([String::new(), format!("{}: {}", row.name, row.about)]);
        lines.push(format!("  address: {}", row.address.form));
        lines.push(format!("  units on the wire: {}", row.wire_units));
        lines.push(format!("  modes: {}", modes(row).join(", ")));
        // The limits of an adapter for any number of joints are those of no arm.
        let checked = checked(row);
        if let Some((dof, Checked { limits, .. })) = checked.as_ref().filter(|_| row.dof.1 < MAX_DOF) {
            let fastest = limits.velocity_max.iter().copied().fold(0.0, f64::max);
            let joints = if *dof == 1 { "joint" } else { "joints" };
            lines.push(format!("  limits: {dof} {joints}, up to {fastest:.2} rad/s ({:.0}°/s)", fastest.to_degrees()));
        }
        lines.extend(checked.iter().flat_map(|(_, checked)| setpoints(checked)));
        lines.push(format!("  options: {}", options(&row.options).join(", ")));
    }
    for row in registry.peripherals() {
        lines.extend([String::new(), format!("{}: {}", row.name, row.about)]);
        lines.push(format!("  in a blueprint: hardware[].{}", row.part.name()));
        lines.push(format!("  address: {}", row.address.form));
        lines.push(format!("  options: {}", options(&row.options).join(", ")));
    }
    for absent in registry.absent() {
        lines.extend([String::new(), format!("{}: {}", absent.name, absent.about)]);
        lines.push(format!("  not in this build: {}", absent.remedy));
    }
    lines
}

fn dof(row: &AdapterSpec) -> String {
    match row.dof {
        (least, most) if least == most => least.to_string(),
        (least, most) => format!("{least}–{most}"),
    }
}

fn teach(row: &AdapterSpec) -> &'static str {
    match row.teach {
        Teach::HandGuiding => "hand guiding",
        Teach::MotorsOff => "motors off",
        Teach::No(_) => "no",
    }
}

fn modes(row: &AdapterSpec) -> Vec<&'static str> {
    row.modes.iter().map(|mode| mode.name()).collect()
}

/// Returns what its arm is given of setpoints besides positions, and why not the rest.
fn setpoints(checked: &Checked) -> Vec<String> {
    let fields = checked.setpoint.named();
    let taken: Vec<&str> = fields.iter().filter(|(_, field)| field.is_taken()).map(|(name, _)| *name).collect();
    let mut lines =
        vec![format!("  setpoints: {}", ["position"].into_iter().chain(taken).collect::<Vec<_>>().join(", "))];
    for (names, objection) in objections(checked) {
        lines.push(format!("    without {}: {objection}", names.join(", ")));
    }
    lines
}

/// Returns the fields that it is not given, by reason.
fn objections(checked: &Checked) -> Vec<(Vec<&'static str>, String)> {
    let mut reasons: Vec<(Vec<&'static str>, String)> = Vec::new();
    for (name, field) in checked.setpoint.named() {
        let Some(objection) = field.objection() else { continue };
        match reasons.iter_mut().find(|(_, reason)| *reason == objection) {
            Some((names, _)) => names.push(name),
            None => reasons.push((vec![name], objection)),
        }
    }
    reasons
}

/// Returns what is known of an arm with the most joints and no options.
fn checked(row: &AdapterSpec) -> Option<(usize, Checked)> {
    let config = |dof| AdapterConfig {
        hardware_id: row.name.to_owned(),
        address: String::new(),
        dof,
        options: serde_json::Value::Null,
    };
    (row.dof.0..=row.dof.1).rev().find_map(|dof| Some((dof, (row.check)(&config(dof)).ok()?)))
}

/// Returns the names of its options.
fn options(spec: &OptionsSpec) -> Vec<String> {
    let schema = (spec.schema)(&mut schemars::SchemaGenerator::default());
    let properties = schema.get("properties").and_then(|properties| properties.as_object());
    properties.map(|properties| properties.keys().cloned().collect()).unwrap_or_default()
}

fn to_json(row: &AdapterSpec) -> serde_json::Value {
    let checked = checked(row);
    let fields = checked.iter().flat_map(|(_, checked)| checked.setpoint.named());
    let setpoint = fields.map(|(name, field)| {
        let said = json!({"taken": field.is_taken(), "objection": field.objection()});
        (name.to_owned(), said)
    });
    json!({
        "name": row.name,
        "about": row.about,
        "in_this_build": true,
        "level": row.level.name(),
        "transport": row.transport,
        "dof": {"min": row.dof.0, "max": row.dof.1},
        "modes": modes(row),
        "wire_units": row.wire_units,
        "native_rate_hz": row.native_rate,
        "address": {"form": row.address.form, "required": row.address.required},
        "holds_when_disabled": row.holds_when_disabled,
        "teach": teach(row),
        "options": options(&row.options),
        "setpoint": setpoint.collect::<serde_json::Map<_, _>>(),
        "limits": checked.as_ref().map(|(dof, Checked { limits, .. })| json!({
            "dof": dof,
            "position_lower": limits.position_lower,
            "position_upper": limits.position_upper,
            "velocity_max": limits.velocity_max,
        })),
        "gripper": row.gripper,
        "emulator": row.emulate.is_some(),
    })
}

/// A gripper or a sensor with its own connection; an arm has no `part`.
fn peripheral(row: &PeripheralSpec) -> serde_json::Value {
    json!({
        "name": row.name,
        "about": row.about,
        "part": row.part.name(),
        "in_this_build": true,
        "level": row.level.name(),
        "native_rate_hz": row.native_rate,
        "address": {"form": row.address.form, "required": row.address.required},
        "options": options(&row.options),
        "emulator": row.emulate.is_some(),
    })
}

/// An adapter that is not in this build: only how to get it.
fn lacking(absent: &Absent) -> serde_json::Value {
    json!({"name": absent.name, "about": absent.about, "in_this_build": false, "remedy": absent.remedy})
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_adapter_missing_in_this_build_is_listed_with_its_remedy() {
        let absent = Absent { name: "servobot", about: "a serial arm", remedy: "build with --features servobot" };
        let lines = lines(&dimos_arms::registry().lacking(&[absent]));
        assert!(lines.iter().any(|line| line.starts_with("servobot  not in this build")), "{lines:?}");
        assert_eq!(lines.last().unwrap(), "  not in this build: build with --features servobot");
        let gripper = lines.iter().find(|line| line.starts_with("robotiq_2f85 ")).unwrap();
        assert_eq!(gripper.split_whitespace().collect::<Vec<_>>(), ["robotiq_2f85", "emulated", "gripper", "50"]);
        let rows = dimos_arms::registry();
        let listed = |name: &str| lines.iter().any(|line| line.starts_with(&format!("{name}: ")));
        assert!(rows.rows().iter().all(|row| listed(row.name)) && listed("servobot"), "{lines:?}");
    }
}

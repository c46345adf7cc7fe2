//! `dimos adapter emulate|test NAME` for a gripper or a sensor with its own connection.

use std::time::{Duration, Instant};

use serde_json::json;

use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output::{self, Table};
use super::choice::not_started;
use super::emulate::{Args, LOOK, Link, script};
use crate::runtime::arm::device_lock;
use dimos_hardware::conformance::peripheral::{CHECKS, PeripheralCheck, run as run_check};
use dimos_hardware::peripheral::{Part, PeripheralSpec};
use dimos_hardware::registry::{AdapterConfig, EmulatorAddress, SIM};
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_rpc::run_dir::RunDir;

/// For how long a device is read.
const WATCH: Duration = Duration::from_secs(2);

/// Runs the verb: on a pseudo-terminal, or with `--bind` at the port of Modbus TCP.
pub fn run(args: &Args, row: &PeripheralSpec) -> Result {
    let place = match args.bind {
        Some(address) => EmulatorAddress::Bind(address),
        None if args.can.is_some() => return Err(Failure::usage(format!("{} has no CAN bus", row.name))),
        None => EmulatorAddress::Pty,
    };
    let options = args.choice.options()?;
    let config = AdapterConfig { hardware_id: row.name.to_owned(), address: String::new(), dof: 0, options };
    let none = || Failure::usage(format!("{} has no emulator", row.name));
    let emulator = row.emulate.ok_or_else(none)?(&config, &place).map_err(not_started)?;
    if args.fault.iter().any(|text| text == "list") {
        let mut table = Table::new(&["KIND", "~WHAT GOES WRONG"]);
        // One in the far future only asks whether it can be played.
        let playable = |kind: &FaultKind| emulator.inject(Fault::new(*kind).at(1e6)).is_ok();
        FaultKind::all()
            .into_iter()
            .filter(|(kind, _)| playable(kind))
            .for_each(|(kind, about)| table.row([kind.name(), about]));
        table.print();
        return Ok(Exit::Ok);
    }
    for text in &args.fault {
        script(text)?.into_iter().try_for_each(|fault| emulator.inject(fault)).map_err(Failure::usage)?;
    }
    let signals = Signals::watch_with_hangup();
    let link = args.link.as_deref().map(|path| Link::to(&emulator.address(), path)).transpose()?;
    let address = link.as_ref().map_or_else(|| emulator.address(), |link| link.address.clone());
    announce(args, row, &address);
    let began = Instant::now();
    loop {
        if let Some(signal) = signals.last() {
            return Ok(Exit::by_signal(signal));
        }
        let left = args.duration.map(|duration| duration.saturating_sub(began.elapsed()));
        if left.is_some_and(|left| left.is_zero()) {
            return Ok(Exit::Ok);
        }
        std::thread::sleep(left.unwrap_or(LOOK).min(LOOK));
    }
}

fn announce(args: &Args, row: &PeripheralSpec, address: &str) {
    let (name, part) = (row.name, row.part.name());
    if args.json {
        let event = json!({"event": "started", "adapter": name, "part": part, "simulated": true, "address": address});
        return output::json(&event);
    }
    output::line(format_args!("{name} SIMULATED at {address}"));
    output::line(format_args!("  blueprint  hardware[].{part}: {{adapter_type: {name}, address: \"{address}\"}}"));
    output::note("Ctrl-C ends it");
}

/// `dimos adapter test NAME`: the suite on the emulator; at an address what the device reports for two seconds, without
/// motion.
pub fn test(args: &super::test::Args, row: &PeripheralSpec) -> Result {
    if args.allow_motion || args.lag || args.first_day || args.report.is_some() {
        let failure = Failure::usage(format!("{} is a {}, not an arm", row.name, row.part.text()));
        return Err(failure.hint("it takes --address, --option, --only and --json"));
    }
    let options = args.choice.options()?;
    let checked = match args.address.as_deref().map(str::trim) {
        None | Some("") => {
            let failure = Failure::usage(format!("where is it? {} needs --address", row.name));
            return Err(failure.hint(format!("--address {}, or --address {SIM} for its emulator", row.address.form)));
        }
        Some(SIM) => suite(args, row, &options),
        Some(address) => vec![("reads", reads(row, address, options)?)],
    };
    let failed = checked.iter().filter(|(_, result)| result.is_err()).count();
    if args.json {
        let checks = checked.iter().map(|(name, result)| match result {
            Ok(found) => json!({"name": name, "result": "passed", "found": found}),
            Err(what) => json!({"name": name, "result": "failed", "why": what}),
        });
        output::json(&json!({"adapter": row.name, "passed": failed == 0, "checks": checks.collect::<Vec<_>>()}));
    } else {
        for (name, result) in &checked {
            match result {
                Ok(found) => output::wrapped(format_args!("passed  {name} {found}")),
                Err(what) => output::wrapped(format_args!("FAILED  {what}")),
            }
        }
    }
    match failed {
        0 => Ok(Exit::Ok),
        failed => Err(Failure::new(Exit::Failed, format!("{failed} of {} checks failed", checked.len()))),
    }
}

type Checked = (&'static str, std::result::Result<String, String>);

fn suite(args: &super::test::Args, row: &PeripheralSpec, options: &serde_json::Value) -> Vec<Checked> {
    let chosen = CHECKS.iter().filter(|check| args.only.as_ref().is_none_or(|text| check.name.contains(text)));
    let made =
        |check: &PeripheralCheck| (check.name, run_check(row, options, check).map(|()| format!("({})", check.about)));
    chosen.map(made).collect()
}

/// Connects and reads for two seconds. Nothing moves.
fn reads(
    row: &PeripheralSpec,
    address: &str,
    options: serde_json::Value,
) -> Result<std::result::Result<String, String>> {
    let full = (row.address.check)(address)
        .map_err(|e| Failure::usage(format!("--address {address}: {e}")).hint(row.address.form))?;
    let _lock = device_lock::take(row.name, &full, RunDir::standard().is_closed())
        .map_err(|e| Failure::new(Exit::Hardware, e.to_string()).hint(e.hint()))?;
    let config = AdapterConfig { hardware_id: row.name.to_owned(), address: full, dof: 0, options };
    let mut device = (row.create)(&config).map_err(|e| Failure::of(Exit::Usage, e))?;
    let info = device.connect().map_err(|e| Failure::of(Exit::Hardware, e))?;
    let (began, mut reads, mut failed) = (Instant::now(), 0, 0);
    while began.elapsed() < WATCH {
        match device.read() {
            Ok(()) => reads += 1,
            Err(_) => failed += 1,
        }
    }
    let rate = f64::from(reads) / began.elapsed().as_secs_f64();
    let known = |value: Option<String>| value.unwrap_or_else(|| "unknown".to_owned());
    let what = match row.part {
        Part::Gripper => {
            let gripper = device.gripper();
            let unit = gripper.as_ref().map_or("", |gripper| gripper.get_gripper_unit().name());
            let at = device.gripper().and_then(|gripper| gripper.read_gripper_position().ok().flatten());
            format!("position {}", known(at.map(|at| format!("{at:.4} {unit}"))))
        }
        Part::ForceTorque => {
            let wrench = device.force_torque().and_then(|sensor| sensor.read_force_torque().ok().flatten());
            format!("wrench {}", known(wrench.map(|wrench| format!("{wrench:.2?} N, Nm"))))
        }
    };
    let condition = device.condition().name().replace('_', " ");
    device.disconnect();
    let name = [info.vendor.as_str(), info.model.as_str()].join(" ");
    let text = format!("{}: {condition}, {what}; {rate:.0} readings a second, {failed} failed", name.trim());
    Ok(if reads > 0 { Ok(text) } else { Err(text) })
}

//! `dimos adapter emulate NAME` for a gripper or a sensor with its own connection.

use std::time::Instant;

use serde_json::json;

use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output;
use super::choice::not_started;
use super::emulate::{Args, LOOK, Link, script};
use dimos_hardware::peripheral::PeripheralSpec;
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};

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

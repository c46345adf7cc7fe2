//! `dimos arm configure ADAPTER`: the settings that motors keep without power.

use super::super::ask;
use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output::{self, Table};
use super::bus::{self, failure};
use dimos_hardware::registry::Registry;
use dimos_hardware::service::Setting;

/// Arguments of `arm configure`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
Only settings with another value are written, with the motors off, and read back: the memory of motors wears.")]
pub struct Args {
    #[command(flatten)]
    bus: bus::BusArgs,
    /// Show the settings with another value, write nothing; exit code 1 if there are any
    #[arg(long)]
    check: bool,
    /// Ask nothing; motors that are on are switched off
    #[arg(long, conflicts_with = "check")]
    yes: bool,
    /// Print the settings with another value as JSON
    #[arg(long)]
    json: bool,
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    let signals = Signals::watch_with_hangup();
    let mut bus = args.bus.open(registry)?;
    bus.identify()?;
    let found = bus.service.settings().map_err(failure)?;
    if args.json {
        output::json(&found);
    } else {
        print(&found);
    }
    match found.len() {
        0 => {
            output::note("all settings are as the adapter wants them");
            return Ok(Exit::Ok);
        }
        count if args.check => {
            let what = format!("{count} settings have another value");
            return Err(Failure::new(Exit::Failed, what).hint(format!("dimos arm configure {} writes them", args.bus)));
        }
        _ => {}
    }
    if !args.yes {
        ask::needs_terminal("--yes asks nothing")?;
    }
    // Before the motors are switched off: without the consent an arm must not fall.
    if !args.yes {
        ask::enter(&signals, "Check these settings, which are written with the motors off")?;
    }
    bus.release(&signals, args.yes)?;
    bus.service.write_settings().map_err(failure)?;
    output::note(format_args!("{} settings were written and read back", found.len()));
    Ok(Exit::Ok)
}

fn print(found: &[Setting]) {
    if found.is_empty() {
        return;
    }
    let mut table = Table::new(&["JOINT", "SETTING", ">FOUND", ">WANTED"]);
    for Setting { motor, name, found, wanted, .. } in found {
        table.row([(*motor).to_owned(), (*name).to_owned(), found.to_string(), wanted.to_string()]);
    }
    table.print();
}

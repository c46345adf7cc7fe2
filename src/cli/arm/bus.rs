//! Which arm, and its bus: what the verbs without a run share.

use std::fmt;

use super::super::adapter::choice::Choice;
use super::super::ask;
use super::super::exit::{Exit, Failure, Result};
use super::super::follow::Signals;
use super::super::output;
use crate::runtime::arm::device_lock::{self, DeviceLock};
use dimos_hardware::adapter::AdapterError;
use dimos_hardware::registry::{AdapterSpec, Registry};
use dimos_hardware::service::{OpenService, Service};
use dimos_rpc::run_dir::RunDir;

/// Which arm, and where.
#[derive(Debug, clap::Args)]
pub struct BusArgs {
    /// The adapter: a name that `dimos list-adapters` shows
    #[arg(value_name = "ADAPTER")]
    name: String,
    /// Where the arm is, as in a blueprint; `dimos arm find-port` finds it
    #[arg(long)]
    address: String,
    /// An option of the adapter, as under `options` in a blueprint (repeatable)
    #[arg(long = "option", value_name = "KEY=VALUE", value_parser = super::super::arguments::setting)]
    options: Vec<(String, String)>,
}

/// An open bus, locked against runs.
pub struct Bus {
    /// The arm's motors.
    pub service: Box<dyn Service>,
    _lock: DeviceLock,
}

/// As on the command line, for hints: `so101 --address /dev/ttyACM0`.
impl fmt::Display for BusArgs {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} --address {}", self.name, self.address)?;
        self.options.iter().try_for_each(|(key, value)| write!(f, " --option {key}={value}"))
    }
}

/// Locks a device against runs and other verbs. `address` is complete.
pub fn lock(row: &AdapterSpec, address: &str) -> Result<DeviceLock> {
    let taken = device_lock::take(row.name, address, RunDir::standard().is_closed());
    taken.map_err(|e| Failure::new(Exit::Hardware, e.to_string()).hint(e.hint()))
}

/// Returns the row of an adapter with work to do outside a run, and its service.
pub fn row(
    name: &str,
    options: &[(String, String)],
    registry: &Registry,
) -> Result<(AdapterSpec, OpenService, Choice)> {
    let choice = Choice { name: name.to_owned(), dof: None, model: None, options: options.to_vec() };
    let row = choice.row(registry)?;
    let Some(open) = row.service else {
        let able: Vec<_> = registry.rows().iter().filter(|row| row.service.is_some()).map(|row| row.name).collect();
        let what = format!("{} needs no work on its bus: calibration and numbers are its controller's", row.name);
        return Err(Failure::usage(what).hint(format!("adapters with such a bus: {}", able.join(", "))));
    };
    Ok((row, open, choice))
}

impl BusArgs {
    /// Locks the device and opens its bus.
    pub fn open(&self, registry: &Registry) -> Result<Bus> {
        let (row, open, choice) = row(&self.name, &self.options, registry)?;
        let full = (row.address.check)(&self.address)
            .map_err(|e| Failure::usage(format!("--address {}: {e}", self.address)).hint(row.address.form))?;
        let config = choice.config(&row, &full)?;
        let lock = lock(&row, &full)?;
        Ok(Bus { service: open(&config).map_err(failure)?, _lock: lock })
    }
}

impl Bus {
    /// Reads which arm it is, and prints it.
    pub fn identify(&mut self) -> Result<()> {
        output::note(self.service.identify().map_err(failure)?);
        Ok(())
    }

    /// Switches the motors off, if any is on: an arm without brakes drops. Asks before, unless `yes`.
    pub fn release(&mut self, signals: &Signals, yes: bool) -> Result<()> {
        let on = self.service.powered().map_err(failure)?;
        if !on.is_empty() {
            output::note(format_args!("motors are on: {}", on.join(", ")));
            if !yes {
                ask::enter(signals, "Support the arm: it drops when its motors are switched off")?;
            }
        }
        self.service.release().map_err(failure)
    }
}

/// The failure of a call of the arm.
pub fn failure(error: AdapterError) -> Failure {
    let exit = match error {
        AdapterError::Rejected(_) | AdapterError::Unsupported => Exit::Failed,
        _ => Exit::Hardware,
    };
    Failure::of(exit, error)
}

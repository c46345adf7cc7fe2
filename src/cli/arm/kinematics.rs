//! `dimos arm kinematics ARM|ADAPTER`: an arm's own dimensions, as its maker measured them and its controller has them.

use std::path::PathBuf;

use super::super::adapter::choice::Choice;
use super::super::arguments::Target;
use super::super::exit::{Exit, Failure, Result};
use super::super::output::{self, Table, fixed};
use super::bus;
use crate::runtime::tool::kept_kinematics::{self, KeptKinematics};
use dimos_core::arm::Dh;
use dimos_hardware::registry::Registry;
use dimos_rpc::api::Status;

/// Arguments of `arm kinematics`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
A run reads them when it connects, corrects its models with them, and keeps them for planners without the arm.
For such a planner on another computer, write the file, and copy it into its $XDG_STATE_HOME/dimos/kinematics.

  dimos arm kinematics arm --write arm.json    # of a live run
  dimos arm kinematics ur --address 192.168.1.10 --write arm.json")]
pub struct Args {
    /// An arm of the live run, by its hardware_id; with --address an adapter: a name that `dimos list-adapters` shows
    #[arg(value_name = "ARM|ADAPTER")]
    pub arm: String,
    /// Address of an arm without a run
    #[arg(long, conflicts_with = "run")]
    pub address: Option<String>,
    /// An option of the adapter, as under `options` in a blueprint (repeatable)
    #[arg(long = "option", value_name = "KEY=VALUE", requires = "address", value_parser = super::super::arguments::setting)]
    pub options: Vec<(String, String)>,
    /// Write them to this file
    #[arg(long, value_name = "FILE")]
    pub write: Option<PathBuf>,
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    let kept = match &args.address {
        Some(address) => args.read(registry, address)?,
        None => args.of_run()?,
    };
    if let Some(path) = &args.write {
        std::fs::write(path, kept.to_text()).map_err(|error| {
            Failure::new(Exit::Failed, format!("{} is not written: {error}", path.display()))
                .hint("is the folder there, and may you write to it?")
        })?;
    }
    if args.target_run.json {
        output::json(&kept);
        return Ok(Exit::Ok);
    }
    output::line(format_args!("serial {}, checksum {}", kept.serial, kept.kinematics.checksum));
    let mut table = Table::new(&["JOINT", ">THETA rad", ">A m", ">D m", ">ALPHA rad", ">DATA SHEET A", ">D"]);
    let actual = kept.kinematics.actual.iter().flatten();
    for (index, (Dh { theta, a, d, alpha }, sheet)) in actual.zip(&kept.kinematics.nominal).enumerate() {
        let own = [*theta, *a, *d, *alpha].map(|value| fixed(value, 6));
        let [theta, a, d, alpha] = own;
        table.row([(index + 1).to_string(), theta, a, d, alpha, fixed(sheet.a, 6), fixed(sheet.d, 6)]);
    }
    table.print();
    Ok(Exit::Ok)
}

impl Args {
    /// Returns those of an arm of the live run, which has kept them when it connected.
    fn of_run(&self) -> Result<KeptKinematics> {
        let arm = self.target_run.connect()?.call(Status {})?.arms.into_iter().find(|arm| arm.hardware_id == self.arm);
        let name = &self.arm;
        let Some(arm) = arm else {
            let what = format!("the run has no arm {name}");
            return Err(Failure::usage(what).hint("without a run give the adapter and --address"));
        };
        let serial = arm.identity.as_deref().and_then(|identity| identity.strip_prefix("serial "));
        let kept = serial.and_then(|serial| kept_kinematics::of_serial(&arm.adapter, serial));
        kept.ok_or_else(|| {
            let what = format!("no factory kinematics of {name} are kept here ({} at {})", arm.adapter, arm.address);
            Failure::new(Exit::Failed, what).hint(match arm.simulated {
                true => "those of a simulated arm are not kept",
                false => "a run keeps what a controller reports with its serial number, on the run's own computer",
            })
        })
    }

    /// Asks the controller.
    fn read(&self, registry: &Registry, address: &str) -> Result<KeptKinematics> {
        let choice = Choice { name: self.arm.clone(), dof: None, model: None, options: self.options.clone() };
        let row = choice.row(registry)?;
        let address = (row.address.check)(address)
            .map_err(|e| Failure::usage(format!("--address {address}: {e}")).hint(row.address.form))?;
        let config = choice.config(&row, &address)?;
        let _lock = bus::lock(&row, &address)?;
        let mut adapter = (row.create)(&config).map_err(bus::failure)?;
        adapter.connect().map_err(bus::failure)?;
        let (found, serial) = (adapter.factory_kinematics(), adapter.get_info().serial_number);
        adapter.disconnect();
        let lacks = |what: String| Failure::new(Exit::Failed, what);
        let kinematics = found.filter(|found| found.actual.is_some()).ok_or_else(|| {
            lacks(format!("the controller of {} at {address} reports no factory kinematics", row.name))
        })?;
        let serial = serial.ok_or_else(|| lacks("the controller reports no serial number".to_owned()))?;
        Ok(KeptKinematics { adapter: row.name.to_owned(), address, serial, kinematics })
    }
}

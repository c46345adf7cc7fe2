//! `dimos speed`, `pause` and `resume`: the speed override of a run.

use super::arguments::{self, Target};
use super::exit::{Exit, Result};
use super::output;
use dimos_core::telemetry::texts::percent;
use dimos_rpc::api::{Speed, SpeedReport};

/// Arguments of `speed`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// Fraction of the speed of all motions, as 0.3 or 30%; without it the present one is shown
    #[arg(value_parser = arguments::speed, allow_negative_numbers = true)]
    pub fraction: Option<f64>,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Arguments of `pause` and `resume`.
#[derive(Debug, clap::Args)]
pub struct PauseArgs {
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs `speed`.
pub fn run(args: &Args) -> Result {
    change(&args.target_run, Speed { fraction: args.fraction, paused: None })
}

/// Runs `pause`, or `resume`.
pub fn pause(args: &PauseArgs, on: bool) -> Result {
    change(&args.target_run, Speed { fraction: None, paused: Some(on) })
}

fn change(target: &Target, call: Speed) -> Result {
    let report = target.connect()?.call(call)?;
    match target.json {
        true => output::json(&report),
        false => output::line(describe(&report)),
    }
    Ok(Exit::Ok)
}

/// Describes an override in one line.
pub fn describe(report: &SpeedReport) -> String {
    let percent = percent(report.fraction);
    match report.paused {
        true => format!("paused; at {percent} of the speed after `dimos resume`"),
        false => format!("speed {percent}"),
    }
}

//! `dimos move ARM q…`: a direct motion to joint positions.

use super::arguments::{Target, finite, speed};
use super::exit::{Exit, Result};
use super::follow::{Signals, follow};
use super::output;
use crate::rpc::api::{DEFAULT_SPEED, Move};

/// Arguments of `move`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// The arm's hardware_id
    pub arm: String,
    /// Where its joints shall go [rad], one value per joint
    #[arg(required = true, value_name = "POSITION", value_parser = finite, allow_negative_numbers = true)]
    pub target: Vec<f64>,
    /// Fraction of the velocity and acceleration limits to use, 0.1–1
    #[arg(long, value_name = "FRACTION", default_value_t = DEFAULT_SPEED, value_parser = speed)]
    pub speed: f64,
    /// Return when the motion has begun
    #[arg(long)]
    pub no_wait: bool,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let mut client = args.target_run.connect()?;
    let signals = (!args.no_wait).then(Signals::watch);
    let begun = client.call(Move { arm: args.arm.clone(), target: args.target.clone(), speed: args.speed })?;
    output::note(format_args!(
        "motion {} on {}: {:.2} s, direct, not collision-checked",
        begun.motion, begun.task, begun.duration
    ));
    match signals {
        Some(signals) => follow(&mut client, begun.motion, &begun.task, &signals, args.target_run.json),
        None => {
            if args.target_run.json {
                output::json(&begun);
            }
            Ok(Exit::Ok)
        }
    }
}

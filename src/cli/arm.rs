//! `dimos arm enable|disable|reset|gripper ARM`: what an arm is ready for.

use clap::Subcommand;

use super::arguments::{Target, finite};
use super::exit::{Exit, Result};
use super::output;
use crate::rpc::api::{ArmDisable, ArmEnable, ArmReset, Gripper};

/// Arguments of `arm`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Enable the motors and make the arm ready for motion, where it is
    Enable(Which),
    /// Disable the motors; an arm that `list-adapters` does not say to hold falls, unless supported
    Disable(Which),
    /// Clear a latched hold or a fault; moves nothing, enables nothing
    Reset(Which),
    /// Open or close the gripper
    Gripper {
        #[command(flatten)]
        which: Which,
        /// Opening [m]
        #[arg(value_parser = finite, allow_negative_numbers = true)]
        position: f64,
    },
}

#[derive(Debug, clap::Args)]
struct Which {
    /// The arm's hardware_id
    arm: String,
    #[command(flatten)]
    target_run: Target,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let (Action::Enable(which) | Action::Disable(which) | Action::Reset(which) | Action::Gripper { which, .. }) =
        &args.action;
    let mut client = which.target_run.connect()?;
    let arm = which.arm.clone();
    let reply = match &args.action {
        Action::Enable(_) => client.call(ArmEnable { arm })?,
        Action::Disable(_) => client.call(ArmDisable { arm })?,
        Action::Reset(_) => client.call(ArmReset { arm })?,
        Action::Gripper { position, .. } => {
            let done = client.call(Gripper { arm, position: *position })?;
            if which.target_run.json {
                output::json(&done);
            } else {
                output::line(format_args!("{}: gripper to {position:.4} m", which.arm));
            }
            return Ok(Exit::Ok);
        }
    };
    if which.target_run.json {
        output::json(&reply);
    } else {
        output::line(format_args!("{}: {}", reply.arm, reply.phase));
        if matches!(args.action, Action::Reset(_)) {
            output::note(format_args!("next, when it may move again: dimos arm enable {}", reply.arm));
        }
    }
    Ok(Exit::Ok)
}

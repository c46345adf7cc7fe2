//! `dimos arm enable|disable|reset|gripper ARM`: motors, latch and gripper of an arm.

use clap::Subcommand;

use super::arguments::{Target, finite};
use super::exit::{Exit, Failure, Result};
use super::output;
use crate::rpc::api::{ArmDisable, ArmEnable, ArmReset, Gripper, Status};
use crate::rpc::client::Client;
use crate::rpc::report::ArmReport;

/// Arguments of `arm`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Enable the motors at the current position and make the arm ready for motion
    Enable(ArmArgs),
    /// Decelerate the arm to rest and disable the motors; an arm without brakes (`list-adapters`: HOLDS = no) drops
    /// unless supported
    Disable {
        #[command(flatten)]
        which: ArmArgs,
        /// Disable the motors at once, even while the arm moves
        #[arg(long)]
        now: bool,
    },
    /// Clear a latched hold or a fault; moves nothing, enables nothing
    Reset(ArmArgs),
    /// Open or close the gripper
    Gripper {
        #[command(flatten)]
        which: ArmArgs,
        /// Opening [m], or `open`, or `close`
        #[arg(value_name = "OPENING", value_parser = opening, allow_negative_numbers = true)]
        opening: Opening,
    },
}

#[derive(Debug, clap::Args)]
struct ArmArgs {
    /// Name of the arm (hardware_id)
    arm: String,
    #[command(flatten)]
    target_run: Target,
}

/// Requested opening of a gripper.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Opening {
    /// This opening [m].
    Metres(f64),
    /// Fully open.
    Open,
    /// Closed.
    Close,
}

fn opening(text: &str) -> std::result::Result<Opening, String> {
    match text {
        "open" => Ok(Opening::Open),
        "close" => Ok(Opening::Close),
        _ => finite(text).map(Opening::Metres).map_err(|e| format!("{e}; give metres, `open` or `close`")),
    }
}

impl Opening {
    /// Returns the opening in metres: the run knows the gripper's range.
    fn of(self, client: &mut Client, arm: &str) -> Result<f64> {
        if let Self::Metres(position) = self {
            return Ok(position);
        }
        let reported = client.call(Status {})?.arms.into_iter().find(|a| a.hardware_id == arm);
        match reported {
            Some(ArmReport { gripper_range: Some([closed, open]), .. }) => {
                Ok(if self == Self::Open { open } else { closed })
            }
            // The run reports a wrong name.
            None => Ok(0.0),
            Some(_) => {
                let what = format!("{arm} has no gripper, or does not report its range");
                Err(Failure::new(Exit::Failed, what).hint(format!("give it in metres: dimos arm gripper {arm} 0.04")))
            }
        }
    }
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let (Action::Enable(which) | Action::Disable { which, .. } | Action::Reset(which) | Action::Gripper { which, .. }) =
        &args.action;
    let mut client = which.target_run.connect()?;
    let arm = which.arm.clone();
    let reply = match &args.action {
        Action::Enable(_) => client.call(ArmEnable { arm })?,
        Action::Disable { now, .. } => client.call(ArmDisable { arm, now: *now })?,
        Action::Reset(_) => client.call(ArmReset { arm })?,
        Action::Gripper { opening, .. } => {
            let position = opening.of(&mut client, &arm)?;
            let done = client.call(Gripper { arm, position })?;
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
        if let Some(note) = &reply.note {
            output::note(format_args!("{}: {note}", reply.arm));
        }
        if matches!(args.action, Action::Reset(_)) {
            output::note(format_args!("to make it ready for motion: dimos arm enable {}", reply.arm));
        }
    }
    Ok(Exit::Ok)
}

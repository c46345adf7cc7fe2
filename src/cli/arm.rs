//! `dimos arm enable|disable|reset|gripper ARM`: what an arm is ready for.

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
    /// Enable the motors and make the arm ready for motion, where it is
    Enable(Which),
    /// Bring the arm to rest and disable the motors; an arm without brakes (`list-adapters`: HOLDS = no) drops unless
    /// supported
    Disable {
        #[command(flatten)]
        which: Which,
        /// Switch the motors off at once, also while the arm moves
        #[arg(long)]
        now: bool,
    },
    /// Clear a latched hold or a fault; moves nothing, enables nothing
    Reset(Which),
    /// Open or close the gripper
    Gripper {
        #[command(flatten)]
        which: Which,
        /// Opening [m], or `open`, or `close`
        #[arg(value_name = "OPENING", value_parser = opening, allow_negative_numbers = true)]
        opening: Opening,
    },
}

#[derive(Debug, clap::Args)]
struct Which {
    /// The arm's hardware_id
    arm: String,
    #[command(flatten)]
    target_run: Target,
}

/// How far a gripper shall open.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Opening {
    /// So far [m].
    Metres(f64),
    /// As far as it goes.
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
    /// In metres: the run knows how far the gripper of its arm goes.
    fn of(self, client: &mut Client, arm: &str) -> Result<f64> {
        if let Self::Metres(position) = self {
            return Ok(position);
        }
        let reported = client.call(Status {})?.arms.into_iter().find(|a| a.hardware_id == arm);
        match reported {
            Some(ArmReport { gripper_range: Some([closed, open]), .. }) => {
                Ok(if self == Self::Open { open } else { closed })
            }
            // The run says what is wrong with the name.
            None => Ok(0.0),
            Some(_) => {
                let what = format!("{arm} has no gripper, or does not say how far it goes");
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
            output::note(format_args!("next, when it may move again: dimos arm enable {}", reply.arm));
        }
    }
    Ok(Exit::Ok)
}

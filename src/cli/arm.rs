//! `dimos arm enable|disable|reset|gripper|io|payload|tool ARM`: motors, latch, gripper and optional parts of an arm in
//! a run; `find-port`, `setup-motors`, `calibrate` and `configure`: work on an arm without a run, directly on its bus.

mod bus;
mod calibrate;
mod configure;
mod find_port;
mod live_table;
pub(super) mod parts;
mod setup_motors;
pub(super) mod tool;

use clap::Subcommand;

use super::arguments::{Target, finite};
use super::exit::{Exit, Failure, Result};
use super::output;
use crate::hardware::registry::Registry;
use crate::rpc::api::{ArmDisable, ArmEnable, ArmReply, ArmReset, Gripper, Method, Status};
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
    /// Open or close the gripper, with a largest force if it has force control
    Gripper {
        #[command(flatten)]
        which: ArmArgs,
        /// Opening [m], angle [rad] of a rotary gripper, `open`, or `close`; `dimos status` shows the range
        #[arg(value_name = "POSITION", value_parser = opening, allow_negative_numbers = true)]
        opening: Opening,
        /// Largest force [N, Nm or %; `dimos status` shows unit and range]; default: the one set in the arm
        #[arg(long, value_name = "FORCE", value_parser = finite, allow_negative_numbers = true)]
        force: Option<f64>,
    },
    /// List serial ports, and find the arm's by unplugging it or by asking each; no run needed
    FindPort(find_port::Args),
    /// Number the motors of a new arm, one after the other; no run needed
    SetupMotors(setup_motors::Args),
    /// Record the middle pose and the range of each joint by hand; motors off, no run needed
    Calibrate(calibrate::Args),
    /// Compare the motors' stored settings with those the adapter wants, and write them; no run needed
    Configure(configure::Args),
    /// Show the digital and analogue inputs and outputs, or set outputs
    Io(parts::IoArgs),
    /// Show the load at the flange, or set it: the arm must be at rest
    Payload(parts::PayloadArgs),
    /// Show the tool centre point, whose pose is the arm's, or set it: the arm must be at rest
    Tool(tool::Args),
}

/// Which arm.
#[derive(Debug, clap::Args)]
pub struct ArmArgs {
    /// Name of the arm (hardware_id)
    pub arm: String,
    /// Which run
    #[command(flatten)]
    pub target_run: Target,
}

/// Requested position of a gripper.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Opening {
    /// This position [m or rad].
    Position(f64),
    /// Fully open.
    Open,
    /// Closed.
    Close,
}

pub(super) fn opening(text: &str) -> std::result::Result<Opening, String> {
    match text {
        "open" => Ok(Opening::Open),
        "close" => Ok(Opening::Close),
        _ => finite(text).map(Opening::Position).map_err(|e| format!("{e}; give m or rad, `open` or `close`")),
    }
}

impl Opening {
    /// Returns the position [m or rad]: the run knows the gripper's range.
    pub(super) fn of(self, client: &mut Client, arm: &str) -> Result<f64> {
        if let Self::Position(position) = self {
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
                Err(Failure::new(Exit::Failed, what).hint(format!("give it as a number: dimos arm gripper {arm} 0.04")))
            }
        }
    }
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    match &args.action {
        Action::Enable(which) => phase(which, ArmEnable { arm: which.arm.clone() }).map(|_| Exit::Ok),
        Action::Disable { which, now } => {
            phase(which, ArmDisable { arm: which.arm.clone(), now: *now }).map(|_| Exit::Ok)
        }
        Action::Reset(which) => {
            let phase = phase(which, ArmReset { arm: which.arm.clone() })?;
            if !which.target_run.json && phase != "ready" {
                output::note(format_args!("to make it ready for motion: dimos arm enable {}", which.arm));
            }
            Ok(Exit::Ok)
        }
        Action::Gripper { which, opening, force } => gripper(which, *opening, *force),
        Action::Io(args) => parts::io(args),
        Action::Payload(args) => parts::payload(args),
        Action::Tool(args) => tool::run(args),
        Action::FindPort(args) => find_port::run(args, registry),
        Action::SetupMotors(args) => setup_motors::run(args, registry),
        Action::Calibrate(args) => calibrate::run(args, registry),
        Action::Configure(args) => configure::run(args, registry),
    }
}

/// Sends a request that changes the arm's phase; prints and returns the phase that it has then.
fn phase(which: &ArmArgs, request: impl Method<Reply = ArmReply>) -> Result<String> {
    let reply = which.target_run.connect()?.call(request)?;
    if which.target_run.json {
        output::json(&reply);
    } else {
        output::line(format_args!("{}: {}", reply.arm, reply.phase));
        if let Some(note) = &reply.note {
            output::note(format_args!("{}: {note}", reply.arm));
        }
    }
    Ok(reply.phase)
}

fn gripper(which: &ArmArgs, opening: Opening, force: Option<f64>) -> Result {
    let (mut client, arm) = (which.target_run.connect()?, which.arm.clone());
    let position = opening.of(&mut client, &arm)?;
    let done = client.call(Gripper { arm, position, force })?;
    if which.target_run.json {
        output::json(&done);
    } else {
        let unit = done.force_unit.as_deref().unwrap_or_default();
        let force = done.force.map_or_else(String::new, |force| format!(", force at most {force} {unit}"));
        output::line(format_args!("{}: gripper to {position:.4} {}{force}", which.arm, done.unit));
    }
    Ok(Exit::Ok)
}

//! `dimos jog ARM`: drives an arm from the keyboard, only while a key is held.
//!
//! ```text
//!  keys ─▶ active_motions ─▶ drive (next target of a stream) ─rpc─▶ a task of the run
//!                            screen ◀─ watch (state and status, on its own connection)
//! ```
//!
//! Dead-man by design: jog sends targets while a motion is active, and nothing else moves the arm. If jog crashes,
//! hangs, or loses its terminal or its run, the stream ends and the task's timeout decelerates the joints to rest.

mod active_motions;
mod drive;
mod fingers;
mod keys;
mod link;
mod screen;
mod session;
pub(super) mod terminal;
mod watch;

use std::io::{self, IsTerminal};

use anyhow::Context;

use super::arguments::{Target, finite};
use super::exit::{Failure, Result};
use super::follow::Signals;
use dimos_rpc::api::{Lease, Status};
use dimos_rpc::{Code, RpcError};
use drive::Drives;
use session::{Session, Setting};
use terminal::Terminal;
use watch::Watch;

/// Arguments of `jog`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
W/S A/D Q/E move the end effector along x, y, z, R/F T/G Y/H rotate it about them (roll, pitch, yaw); B: axes of the base \
or of the tool. Tab: single joints: 1-9 select one, +/- or the arrows move it. O and C open and close the gripper, a tap by a \
small step. [ ] speed, Space rest, X latched stop, Esc \
leave. Hold a key to move: the arm decelerates to rest within 0.25 s of the last key press, or at key-up if the terminal \
reports it (kitty keyboard protocol).

Needs a task of type eef_twist, and one of type velocity (or servo) for single joints; the blueprints keyboard-teleop-… \
have both.
In a run with a planner the arm stops before it touches itself, another arm or an obstacle that the planner knows; \
without one it is not collision-checked. This is not a safety function: keep the arm's own stop within reach.")]
pub struct Args {
    /// Name of the arm (hardware_id)
    arm: String,
    /// Start in joint mode
    #[arg(long)]
    joints: bool,
    /// Start with the axes of the tool frame
    #[arg(long, conflicts_with = "joints")]
    tool: bool,
    /// Speed of the end effector at 100 % [m/s]
    #[arg(long, value_name = "M/S", default_value = "0.25", value_parser = above_zero)]
    linear: f64,
    /// Angular speed of the end effector at 100 % [rad/s]
    #[arg(long, value_name = "RAD/S", default_value = "1", value_parser = above_zero)]
    angular: f64,
    /// Speed of a single joint at 100 % [rad/s]
    #[arg(long, value_name = "RAD/S", default_value = "0.5", value_parser = above_zero)]
    joint: f64,
    /// The run to talk to; needed only when several are live
    #[arg(long, value_name = "NAME")]
    run: Option<String>,
}

fn above_zero(text: &str) -> std::result::Result<f64, String> {
    match finite(text)? {
        value if value > 0.0 && value <= 10.0 => Ok(value),
        _ => Err("must be above 0 and at most 10".into()),
    }
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    if !io::stdin().is_terminal() || !io::stdout().is_terminal() {
        let failure = Failure::usage("jog needs a terminal: stdin or stdout is not one");
        return Err(failure.hint("`dimos task stream TASK` reads targets from stdin or a file"));
    }
    let mut client = Target { run: args.run.clone(), json: false }.connect()?;
    let status = client.call(Status {})?;
    if !status.arms.iter().any(|arm| arm.hardware_id == args.arm) {
        let names: Vec<&str> = status.arms.iter().map(|arm| arm.hardware_id.as_str()).collect();
        let error = RpcError::unknown(Code::UnknownArm, "arm", &args.arm, &names);
        return Err(dimos_rpc::client::ClientError::Refused(error).into());
    }
    let joints = session::joints_of(&mut client, &args.arm)?;
    let drives = Drives::of(&status.tasks, &joints);
    if drives == Drives::default() {
        return Err(Drives::missing(&args.arm));
    }
    // Report other clients that command the arm before the screen is taken.
    client.call(Lease { arm: Some(args.arm.clone()) })?;
    let signals = Signals::watch_with_hangup();
    let watch = Watch::start(&status.run, &args.arm)?;
    let mut session = Session::new(client, watch, drives, setting(args, &status.run));
    let terminal = Terminal::open().context("cannot use the terminal")?;
    session.run(terminal, &signals)
}

fn setting(args: &Args, run: &str) -> Setting {
    Setting {
        run: run.to_owned(),
        arm: args.arm.clone(),
        joint_mode: args.joints,
        tool_frame: args.tool,
        linear: args.linear,
        angular: args.angular,
        joint: args.joint,
    }
}

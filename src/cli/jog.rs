//! `dimos jog ARM`: drives an arm from the keyboard, at most for as long as a key is held.
//!
//! ```text
//!  keys ─▶ hold (which motions are alive) ─▶ drive (the next target of a stream) ─rpc─▶ a task of the run
//!                                            screen ◀─ watch (state and status, on a connection of its own)
//! ```
//!
//! Dead-man by design: jog sends targets while a motion is alive and nothing else keeps the arm moving, so that when jog
//! dies, hangs, or loses its terminal or its run, the stream ends and the task's timeout brings the joints to rest.

mod drive;
mod hold;
mod keys;
mod screen;
mod session;
mod terminal;
mod watch;

use std::io::{self, IsTerminal};

use anyhow::Context;

use super::arguments::{Target, finite};
use super::exit::{Failure, Result};
use super::follow::Signals;
use crate::rpc::api::{Lease, Status};
use crate::rpc::{Code, RpcError};
use drive::Drives;
use session::{Session, Setting};
use terminal::Terminal;
use watch::Watch;

/// Arguments of `jog`.
#[derive(Debug, clap::Args)]
#[command(after_help = "\
W/S A/D Q/E move the end effector along x, y, z, R/F T/G Y/H turn it about them (roll, pitch, yaw); B: axes of the base or
of the tool. Tab: single joints: 1-9 choose one, +/- or the arrows move it. [ ] speed, Space rest now, X latched stop, Esc
leave. A motion fades within 0.25 s after the last key, so that a key must be held; where the terminal tells when keys go
up (kitty keyboard protocol), it ends then.

Needs a task of type eef_twist, and one of type velocity (or servo) for single joints; the blueprints keyboard-teleop-…
have both.
Not collision-checked. An operational control and no safety function: keep the arm's own stop at hand.")]
pub struct Args {
    /// The arm's name in the blueprint
    arm: String,
    /// Begin with single joints
    #[arg(long)]
    joints: bool,
    /// Begin along the axes of the tool
    #[arg(long, conflicts_with = "joints")]
    tool: bool,
    /// Speed of the end effector at 100 % [m/s]
    #[arg(long, value_name = "M/S", default_value = "0.25", value_parser = above_zero)]
    linear: f64,
    /// Turning speed of the end effector at 100 % [rad/s]
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
        _ => Err("must be above 0, and 10 at most".into()),
    }
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    if !io::stdin().is_terminal() || !io::stdout().is_terminal() {
        let failure = Failure::usage("jog reads keys from a terminal, and stdin or stdout is none");
        return Err(failure.hint("`dimos task stream TASK` takes targets from stdin or a file"));
    }
    let mut client = Target { run: args.run.clone(), json: false }.connect()?;
    let status = client.call(Status {})?;
    if !status.arms.iter().any(|arm| arm.hardware_id == args.arm) {
        let names: Vec<&str> = status.arms.iter().map(|arm| arm.hardware_id.as_str()).collect();
        let error = RpcError::unknown(Code::UnknownArm, "arm", &args.arm, &names);
        return Err(crate::rpc::client::ClientError::Refused(error).into());
    }
    let joints = session::joints_of(&mut client, &args.arm)?;
    let drives = Drives::of(&status.tasks, &joints);
    if drives == Drives::default() {
        return Err(Drives::missing(&args.arm));
    }
    // Whoever else commands the arm is told before the screen is taken.
    client.call(Lease { arm: Some(args.arm.clone()) })?;
    let signals = Signals::watch_with_hangup();
    let watch = Watch::start(&status.run, &args.arm)?;
    let mut session = Session::new(client, watch, drives, setting(args, &status.run));
    let terminal = Terminal::open().context("the terminal cannot be used")?;
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

//! `dimos arm enable|disable|reset|teach|gripper|io|payload|tool ARM`: motors, latch, leading, gripper and optional
//! parts of an arm in a run; `find-port`, `setup-motors`, `calibrate` and `configure`: work on an arm without a run,
//! directly on its bus.

mod bus;
mod calibrate;
mod configure;
mod find_port;
mod home;
mod identify;
mod kinematics;
mod live_table;
pub(super) mod parts;
mod setup_motors;
mod teach;
pub(super) mod tool;

use std::time::Duration;

use clap::Subcommand;

use super::arguments::{Target, duration, finite, speed};
use super::exit::{Exit, Result};
use super::follow::Signals;
use super::grip::{GripAction, Opening, opening};
use super::output;
use dimos_hardware::registry::Registry;
use dimos_rpc::api::{ArmDisable, ArmEnable, ArmReply, ArmReset, GripObjects, Method};

/// Arguments of `arm`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Enable the motors at the current position and make the arm ready for motion
    Enable {
        #[command(flatten)]
        which: ArmArgs,
        /// Hold an arm that rests outside its position limits, to lead or move it inward
        #[arg(long)]
        outside: bool,
    },
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
    /// Lead the arm by hand, and record the motion
    Teach(teach::Args),
    /// Let `move` and `execute` move an arm at full speed: until then, one that you have not driven yet moves at 25 %
    FullSpeed(ArmArgs),
    /// Open or close the gripper, and wait for the outcome: open, closed, holding an object, blocked
    #[command(after_help = "\
Exit code 0: the fingers are where they were sent, or hold an object. 1: blocked, or no outcome within --timeout.

  dimos arm gripper arm home                  # where it needs that: once
  dimos arm gripper arm close --force 20
  dimos arm gripper arm close --attach cup    # cup is part of the arm then
  dimos arm gripper arm open --detach")]
    Gripper(GripperArgs),
    /// List serial ports, and find the arm's by unplugging it or by asking each; no run needed
    FindPort(find_port::Args),
    /// Number the motors of a new arm, one after the other; no run needed
    SetupMotors(setup_motors::Args),
    /// Record the middle pose and the range of each joint by hand; motors off, no run needed
    Calibrate(calibrate::Args),
    /// Show an arm's dimensions, as its maker measured them and its controller has them
    Kinematics(kinematics::Args),
    /// Compare the motors' stored settings with those the adapter wants, and write them; no run needed
    Configure(configure::Args),
    /// Show the digital and analogue inputs and outputs, or set outputs
    Io(parts::IoArgs),
    /// Show the load at the flange, or set it: the arm must be at rest
    Payload(parts::PayloadArgs),
    /// Make the present force and torque zero, for --until and `state`: the arm must be at rest
    Tare(ArmArgs),
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

/// Arguments of `arm gripper`.
#[derive(Debug, clap::Args)]
struct GripperArgs {
    #[command(flatten)]
    which: ArmArgs,
    /// Opening [m], angle [rad] of a rotary gripper, `open`, or `close`; `dimos status` shows the range. `home`
    /// activates a gripper with its own connection: its fingers move to their ends
    #[arg(value_name = "POSITION", value_parser = act, allow_negative_numbers = true)]
    act: Act,
    /// Largest force [N, Nm or %; `dimos status` shows unit and range]; default: the one set in the arm
    #[arg(long, value_name = "FORCE", value_parser = finite, allow_negative_numbers = true)]
    force: Option<f64>,
    /// Fraction of the gripper's top speed, 0.01–1; default: the speed set in the arm
    #[arg(long, value_name = "FRACTION", value_parser = speed)]
    speed: Option<f64>,
    /// Attach this object of the planner's world to the arm once the gripper holds it
    #[arg(long, value_name = "OBJECT", conflicts_with_all = ["detach", "no_wait"])]
    attach: Option<String>,
    /// Detach the objects that the arm holds once the fingers have opened
    #[arg(long, conflicts_with = "no_wait")]
    detach: bool,
    /// Maximum time for the outcome: 5s, or a number of seconds; default: 20s
    #[arg(long, value_name = "TIME", value_parser = duration, conflicts_with = "no_wait")]
    timeout: Option<Duration>,
    /// Return when the command was sent
    #[arg(long)]
    no_wait: bool,
}

/// What a gripper does.
#[derive(Debug, Clone, Copy)]
enum Act {
    /// It is homed.
    Home,
    /// It goes to a position.
    To(Opening),
}

/// Parses a position, `open`, `close` or `home`.
fn act(text: &str) -> std::result::Result<Act, String> {
    if text == "home" { Ok(Act::Home) } else { opening(text).map(Act::To) }
}

/// Runs the verb.
pub fn run(args: &Args, registry: &Registry) -> Result {
    match &args.action {
        Action::Enable { which, outside } => {
            phase(which, ArmEnable { arm: which.arm.clone(), outside: *outside }).map(|_| Exit::Ok)
        }
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
        Action::FullSpeed(which) => super::full_speed::run(which),
        Action::Gripper(args) => gripper(args),
        Action::Teach(args) => teach::run(args),
        Action::Io(args) => parts::io(args),
        Action::Payload(args) => parts::payload(args),
        Action::Tare(which) => parts::tare(which),
        Action::Tool(args) => tool::run(args),
        Action::Kinematics(args) => kinematics::run(args, registry),
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

fn gripper(args: &GripperArgs) -> Result {
    let Act::To(opening) = args.act else { return home::run(args) };
    let (signals, which) = (Signals::watch(), &args.which);
    let mut client = which.target_run.connect()?;
    let objects = match &args.attach {
        Some(name) => Some(GripObjects::Attach(name.clone())),
        None => args.detach.then_some(GripObjects::Detach),
    };
    let (force, speed, timeout) = (args.force, args.speed, args.timeout);
    let action = GripAction { opening, force, speed, timeout, objects };
    if !args.no_wait {
        return action.run(&mut client, &which.arm, &signals, which.target_run.json).map(|()| Exit::Ok);
    }
    let sent = action.send(&mut client, &which.arm)?;
    if which.target_run.json {
        output::json(&sent);
    } else {
        let unit = sent.force_unit.as_deref().unwrap_or_default();
        let force = sent.force.map_or_else(String::new, |force| format!(", force at most {force} {unit}"));
        output::line(format_args!("{}: gripper to {:.4} {}{force}", which.arm, sent.position, sent.unit));
    }
    Ok(Exit::Ok)
}

//! `dimos proxy xarm [ARM]`: programs of the vendor's SDK command a run's arm as if it were theirs.
//!
//! ```text
//!  xarm-python-sdk ──502, 30000–30003──▶ control box (the emulator's) ──▶ RunArm ──rpc──▶ a run's tasks
//! ```
//!
//! The proxy is a client of the run: it holds the lease while the program moves the arm, and every command passes the
//! run's limits and guards.

mod ends;
mod refusals;
mod replies;
mod run_arm;
mod run_link;
mod tool_line;

use std::net::IpAddr;
use std::thread::sleep;
use std::time::Duration;

use clap::Subcommand;

use super::arguments::Target;
use super::exit::{Exit, Failure, Result};
use super::follow::Signals;
use super::output;
use dimos_arms::xarm::emulator::{ControlBox, ControlledArm, Links};
use dimos_arms::xarm::model::Model;
use dimos_arms::xarm::protocol::gripper::GripperKind;
use dimos_hardware::sim::events::{self, SimEvent};
use dimos_rpc::api::{State, Status};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::{ArmReport, StatusReport};
use dimos_rpc::{Code, RpcError};
use run_arm::{ArmInfo, RunArm, StreamTask};
use run_link::RunLink;

/// Period of repeated velocities, queued moves and messages.
const PERIOD: Duration = Duration::from_millis(10);
/// Time for the last requests to reach the run.
const FLUSH_TIME: Duration = Duration::from_millis(50);

/// Arguments of `proxy`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    protocol: Protocol,
}

#[derive(Debug, Subcommand)]
enum Protocol {
    /// Serve an arm of a run to programs that use the SDK of UFACTORY's xArm
    #[command(after_help = "\
The program connects to the address of --listen. Mode 0 (set_servo_angle) needs a trajectory task, mode 1 \
(set_servo_angle_j) a servo task, mode 4 (vc_set_joint_velocity) a velocity task, each with all joints of the arm. The \
arm may be of any make with 5, 6 or 7 joints. set_state(4) and emergency_stop() are `dimos stop ARM`; afterwards \
clean_error() and motion_enable(True) are `dimos arm reset` and `dimos arm enable`. Moves are not collision-checked.
Ports 502, 503 and 30000 to 30003; port 502 needs root, CAP_NET_BIND_SERVICE, or \
sysctl net.ipv4.ip_unprivileged_port_start=502.")]
    Xarm(Xarm),
}

/// Arguments of `proxy xarm`.
#[derive(Debug, clap::Args)]
struct Xarm {
    /// Name of the arm (hardware_id); needed only if the run has several
    arm: Option<String>,
    /// Loopback address to listen on
    #[arg(long, value_name = "ADDRESS", default_value = "127.0.0.1")]
    listen: IpAddr,
    /// Model that the program sees: xarm5, xarm6, xarm7, lite6, xarm850 [default: the xArm with this number of joints]
    #[arg(long, value_parser = model)]
    model: Option<Model>,
    /// The run to talk to; needed only when several are live
    #[arg(long, value_name = "NAME")]
    run: Option<String>,
}

fn model(text: &str) -> std::result::Result<Model, String> {
    let all = [Model::Xarm5, Model::Xarm6, Model::Xarm7, Model::Lite6, Model::Xarm850];
    let found = all.into_iter().find(|model| model.option() == text);
    found.ok_or_else(|| format!("must be one of {}", all.map(Model::option).join(", ")))
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    let Protocol::Xarm(args) = &args.protocol;
    let mut client = Target { run: args.run.clone(), json: false }.connect()?;
    let status = client.call(Status {})?;
    let arm = choose(&status, args.arm.as_deref())?;
    let mut info = info(&mut client, &status, arm)?;
    let model = model_of(args.model, &info)?;
    info.links = (arm.adapter == "xarm").then(|| Links::of(model));
    let gripper = if info.gripper_range.is_some() { GripperKind::Xarm } else { GripperKind::None };
    let streams = [&info.servo, &info.velocity].map(|task| task.as_ref().map(|task| task.name.clone()));
    let link = RunLink::open(&status.run, &info.arm, streams)?;
    let shared = link.shared.clone();
    let signals = Signals::watch_with_hangup();
    events::open();
    let serving = ControlBox::start(model, gripper, RunArm::new(link, info.clone()), args.listen)
        .map_err(|error| Failure::of(Exit::Failed, error))?;
    announce(&status.run, model, &info, serving.address());
    let ended = loop {
        shared.take_notes().into_iter().for_each(output::note);
        while let Some((_, event)) = events::take() {
            match event {
                SimEvent::Connected => output::note("a client connected"),
                SimEvent::Disconnected => output::note("a client disconnected"),
                SimEvent::Rejected => output::note("a client was rejected: too many are connected"),
                SimEvent::Foreign => output::note("a program of another user was disconnected"),
                SimEvent::Fault(_) => {}
            }
        }
        if let Some(error) = shared.take_loss() {
            break Err(error.into());
        }
        if let Some(signal) = signals.last() {
            break Ok(Exit::by_signal(signal));
        }
        serving.with(|_| ());
        sleep(PERIOD);
    };
    // What this program has begun ends with it.
    serving.with(|arm| {
        arm.stop();
        arm.end();
    });
    sleep(FLUSH_TIME);
    ended
}

fn choose<'a>(status: &'a StatusReport, wanted: Option<&str>) -> Result<&'a ArmReport> {
    let names: Vec<&str> = status.arms.iter().map(|arm| arm.hardware_id.as_str()).collect();
    match (wanted, &status.arms[..]) {
        (None, [arm]) => Ok(arm),
        (None, _) => {
            let failure = Failure::usage(format!("run {} has the arms {}", status.run, names.join(", ")));
            Err(failure.hint("name one: dimos proxy xarm ARM"))
        }
        (Some(name), arms) => arms
            .iter()
            .find(|arm| arm.hardware_id == name)
            .ok_or_else(|| ClientError::Refused(RpcError::unknown(Code::UnknownArm, "arm", name, &names)).into()),
    }
}

/// Reads what does not change: limits and tasks.
fn info(client: &mut Client, status: &StatusReport, arm: &ArmReport) -> Result<ArmInfo> {
    let state = client.call(State {})?.arms.into_iter().find(|state| state.hardware_id == arm.hardware_id);
    let names: Vec<String> = state.into_iter().flat_map(|state| state.joints).map(|joint| joint.name).collect();
    let stream = |method: &str| {
        let whole = |task: &&dimos_rpc::report::TaskReport| {
            task.takes(method) && task.joints.len() == names.len() && names.iter().all(|j| task.joints.contains(j))
        };
        let task = status.tasks.iter().filter(whole).max_by_key(|task| task.priority)?;
        let joints = task.joints.iter().filter_map(|joint| names.iter().position(|name| name == joint)).collect();
        Some(StreamTask { name: task.name.clone(), joints })
    };
    let covers = |task: &&dimos_rpc::report::TaskReport| {
        task.takes("execute") && names.iter().all(|joint| task.joints.contains(joint))
    };
    let trajectory = status.tasks.iter().filter(covers).min_by_key(|task| task.joints.len());
    Ok(ArmInfo {
        arm: arm.hardware_id.clone(),
        links: None,
        limits: arm.position_limits.clone(),
        // The SDK's gripper opens by a width.
        gripper_range: arm.gripper_range.filter(|_| arm.gripper_unit.as_deref() == Some("m")),
        trajectory: trajectory.map(|task| task.name.clone()),
        servo: stream("servo"),
        velocity: stream("velocity"),
    })
}

fn model_of(wanted: Option<Model>, info: &ArmInfo) -> Result<Model> {
    let joints = info.limits.len();
    match wanted.or_else(|| Model::of_dof(joints)) {
        Some(model) if model.axes() == joints => Ok(model),
        Some(model) => {
            let what =
                format!("{} has {joints} joints, {} {} has {}", info.arm, model.article(), model.name(), model.axes());
            Err(Failure::usage(what).hint("omit --model, or choose one with as many joints"))
        }
        None => {
            let what = format!("{} has {joints} joints: the protocol of the xArm is for 5, 6 or 7", info.arm);
            Err(Failure::usage(what))
        }
    }
}

/// Prints where it is, and which task executes what.
fn announce(run: &str, model: Model, info: &ArmInfo, address: &str) {
    let arm = &info.arm;
    output::line(format_args!("{} at {address}: {arm} of run {run}", model.name()));
    let servo = info.servo.as_ref().map(|task| task.name.clone());
    let velocity = info.velocity.as_ref().map(|task| task.name.clone());
    let tasks =
        [(0, "trajectory", 10, info.trajectory.clone()), (1, "servo", 12, servo), (4, "velocity", 14, velocity)];
    for (mode, kind, priority, task) in tasks {
        match task {
            Some(task) => output::line(format_args!("  mode {mode}  {task}")),
            None => output::line(format_args!(
                "  mode {mode}  none; add to the blueprint's `tasks`: {{name: {kind}_{arm}, type: {kind}, joint_names: \
                 {{hardware: {arm}}}, priority: {priority}}}"
            )),
        }
    }
    output::note("Ctrl-C ends it");
}

//! `dimos task list|invoke|stream`: single tasks of a run.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use clap::{Subcommand, ValueEnum};

use super::arguments::{Target, hertz};
use super::exit::{Exit, Failure, Result};
use super::follow::Signals;
use super::targets::{Source, Width};
use super::{output, status};
use dimos_rpc::api::{Cancel, Pose, Servo, Start, Status, Twist, TwistFrame, Velocity};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::TaskReport;
use dimos_rpc::{Code, RpcError};

/// Poll period for Ctrl-C while waiting for the next target.
const POLL_PERIOD: Duration = Duration::from_millis(50);
/// Default rate of targets from a file [Hz].
const FILE_RATE: f64 = 50.0;

/// Arguments of `task`.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// List the tasks of a run: state and joints
    List {
        #[command(flatten)]
        target_run: Target,
    },
    /// Start or cancel one task
    Invoke {
        /// Name of the task
        task: String,
        /// What to do
        method: Method,
        #[command(flatten)]
        target_run: Target,
    },
    /// Stream targets to a task, one per line, from a file or stdin
    #[command(after_help = "\
A line is a JSON array, or numbers separated by blanks or commas: one per joint of the task, rad for a servo task, rad/s for a \
velocity task; for an eef_twist task x y z [m/s] and the angular velocity about x y z [rad/s], in the base frame; for a \
cartesian_ik task x y z [m] and roll pitch yaw [rad] or a quaternion x y z w. Empty lines and those that begin with # are \
skipped. At most one target per tick takes effect. At the end of the stream a servo task holds the last target, all others \
decelerate to rest.")]
    Stream {
        /// Name of the task
        task: String,
        /// File with the targets; default, or with -: stdin
        file: Option<PathBuf>,
        /// Targets per second [Hz]; default: 50 from a file, as they arrive from stdin
        #[arg(long, value_name = "HZ", value_parser = hertz, alias = "rate")]
        hz: Option<f64>,
        /// For a servo task: the last number of each line is a target of the arm's gripper [m, or rad of a rotary one]
        #[arg(long)]
        gripper: bool,
        #[command(flatten)]
        target_run: Target,
    },
}

/// Method of `task invoke`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Method {
    /// State of the task and its reason, as `task list` shows
    #[value(hide = true)]
    State,
    /// Start a follow task: the arm approaches its leader at 0.3 rad/s at most, then follows it
    Start,
    /// Cancel its motion by decelerating
    #[value(alias = "stop")]
    Cancel,
}

/// Runs the verb.
pub fn run(args: &Args) -> Result {
    match &args.action {
        Action::List { target_run } => {
            let tasks = target_run.connect()?.call(Status {})?.tasks;
            if target_run.json {
                output::json(&tasks)
            } else {
                status::print_tasks(&tasks)
            }
            Ok(Exit::Ok)
        }
        Action::Invoke { task, method, target_run } => invoke(task, *method, target_run),
        Action::Stream { task, file, hz, gripper, target_run } => {
            let mut client = target_run.connect()?;
            let report = find(&mut client, task)?;
            let targets = Targets::of(&report)?;
            let joints = report.joints.len();
            let width = match targets {
                Targets::Positions if *gripper => Width::JointsAndGripper(joints),
                _ if *gripper => return Err(Failure::usage(format!("--gripper is for a servo task, not for {task}"))),
                Targets::Twist => Width::Twist,
                Targets::Pose => Width::Pose,
                Targets::Positions | Targets::Velocities => Width::Joints(joints),
            };
            let (source, rate) = match file.as_deref().filter(|path| path.as_os_str() != "-") {
                Some(path) => (Source::file(path, width, "task stream")?, hz.or(Some(FILE_RATE))),
                None => (Source::stdin(width, "task stream"), *hz),
            };
            stream(&mut client, &report, targets, source, rate, target_run.json)
        }
    }
}

fn find(client: &mut Client, name: &str) -> Result<TaskReport> {
    let mut tasks = client.call(Status {})?.tasks;
    match tasks.iter().position(|task| task.name == name) {
        Some(at) => Ok(tasks.swap_remove(at)),
        None => {
            let names: Vec<String> = tasks.into_iter().map(|task| task.name).collect();
            Err(refusal(RpcError::unknown(Code::UnknownTask, "task", name, &names)))
        }
    }
}

fn refusal(error: RpcError) -> Failure {
    ClientError::Refused(error).into()
}

fn invoke(task: &str, method: Method, target_run: &Target) -> Result {
    let mut client = target_run.connect()?;
    match method {
        Method::State => show(&mut client, task, target_run.json)?,
        Method::Start => {
            client.call(Start { task: task.to_owned() })?;
            show(&mut client, task, target_run.json)?;
        }
        Method::Cancel => {
            let reply = client.call(Cancel { task: Some(task.to_owned()), ..Cancel::default() })?;
            if target_run.json {
                output::json(&reply);
            } else {
                reply.tasks.iter().for_each(|(task, status)| output::line(format_args!("{task}: {status}")));
            }
        }
    }
    Ok(Exit::Ok)
}

/// Prints a task.
fn show(client: &mut Client, task: &str, json: bool) -> Result<()> {
    let report = find(client, task)?;
    if json {
        output::json(&report)
    } else {
        status::print_tasks(&[report])
    }
    Ok(())
}

/// Kind of the targets that a task follows as a stream.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Targets {
    Positions,
    Velocities,
    Twist,
    Pose,
}

impl Targets {
    fn of(task: &TaskReport) -> Result<Self> {
        let target = |method: &String| match method.as_str() {
            "servo" => Some(Self::Positions),
            "velocity" => Some(Self::Velocities),
            "twist" => Some(Self::Twist),
            "pose" => Some(Self::Pose),
            _ => None,
        };
        task.takes.iter().find_map(target).ok_or_else(|| {
            let text = format!("{} is a {} task and does not follow streams", task.name, task.kind);
            refusal(RpcError::new(Code::WrongTask, text).hint("`dimos task list` shows the types"))
        })
    }
}

/// Sends targets until they end or a signal arrives.
fn stream(
    client: &mut Client,
    task: &TaskReport,
    targets: Targets,
    mut source: Source,
    rate: Option<f64>,
    json: bool,
) -> Result {
    let signals = Signals::watch();
    let period = rate.map(|rate| Duration::from_secs_f64(1.0 / rate));
    let (began, mut sent, mut left_out, mut beat) = (Instant::now(), 0_u64, 0_u64, Instant::now());
    let ended = loop {
        if let Some(signal) = signals.last() {
            break Some(signal);
        }
        let wait = beat.saturating_duration_since(Instant::now());
        if !wait.is_zero() {
            std::thread::sleep(wait.min(POLL_PERIOD));
            continue;
        }
        let target = match source.next(POLL_PERIOD) {
            Ok(Some(target)) => target,
            Ok(None) if source.is_over() => break None,
            Ok(None) => continue,
            Err(mistake) => {
                end(client, task)?;
                return Err(mistake);
            }
        };
        sent += 1;
        match send(client, task, targets, target) {
            Err(ClientError::Refused(refusal)) if refusal.code == Code::OutOfReach => {
                left_out += 1;
                output::note(format_args!("target {sent}: {refusal}"));
            }
            result => result?,
        }
        if let Some(period) = period {
            beat = (beat + period).max(Instant::now() - period);
        }
    };
    let now = find(client, &task.name)?;
    if matches!(now.state.as_str(), "FAULT" | "ABORTED") {
        let why = now.reason.unwrap_or_else(|| "unknown reason".into());
        let failure = Failure::new(Exit::Failed, format!("{}: {} after {sent} targets: {why}", now.name, now.state));
        return Err(failure.hint("`dimos status` shows what the arm waits for"));
    }
    if ended.is_some() || targets != Targets::Positions {
        end(client, task)?;
    }
    let seconds = began.elapsed().as_secs_f64();
    if json {
        let report = serde_json::json!({"task": task.name, "targets": sent, "left_out": left_out, "seconds": seconds});
        output::json(&report);
    } else {
        output::line(format_args!("{}: {sent} targets in {seconds:.2} s", task.name));
    }
    if left_out > 0 && ended.is_none() {
        return Err(Failure::new(Exit::Failed, format!("{}: {left_out} of {sent} targets were left out", task.name)));
    }
    Ok(ended.map_or(Exit::Ok, Exit::by_signal))
}

/// Sends a target in the form of the stream.
fn send(
    client: &mut Client,
    task: &TaskReport,
    targets: Targets,
    target: Vec<f64>,
) -> std::result::Result<(), ClientError> {
    let name = task.name.clone();
    let three = |from: usize| std::array::from_fn(|i| target.get(from + i).copied().unwrap_or_default());
    match targets {
        Targets::Positions => {
            let mut positions = target;
            let gripper = positions.split_off(positions.len().min(task.joints.len())).first().copied();
            client.call(Servo { task: name, positions, gripper })?
        }
        Targets::Velocities => client.call(Velocity { task: name, velocities: target })?,
        Targets::Twist => {
            client.call(Twist { task: name, linear: three(0), angular: three(3), frame: TwistFrame::Base })?
        }
        Targets::Pose => {
            let quat = target.get(3..7).map(|q| std::array::from_fn(|i| q.get(i).copied().unwrap_or_default()));
            let rpy = quat.is_none().then(|| three(3));
            client.call(Pose { task: name, xyz: three(0), rpy, quat })?
        }
    };
    Ok(())
}

/// Ends the stream's task at once; otherwise it would continue until its timeout, or hold its joints at zero velocity.
fn end(client: &mut Client, task: &TaskReport) -> Result<()> {
    client.call(Cancel { task: Some(task.name.clone()), ..Cancel::default() })?;
    Ok(())
}

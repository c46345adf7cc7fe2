//! The course of a goal: executed by the run, watched until the arm is at rest.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use super::goal::{Code, Curve, Goal, Outcome, Values};
use dimos_core::clock::wall_now;
use dimos_rpc::api::{Cancel, Execute, Motion, OnBehalfOf, State, Status};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::error::RpcError;
use dimos_rpc::report::MotionReport;

/// Period of the feedback.
const PERIOD: Duration = Duration::from_millis(50);
/// A start that is later than this is refused [s].
const MAX_AHEAD: f64 = 0.05;

/// What a goal is executed by.
#[derive(Debug, Clone)]
pub struct Way {
    /// The run.
    pub run: String,
    /// Its socket.
    pub socket: PathBuf,
    /// The trajectory task.
    pub task: String,
    /// What the run shows as commander.
    pub behalf: OnBehalfOf,
}

/// Who watches a goal.
pub trait Watcher {
    /// Takes the index of the point from which the motion comes, and positions and velocities: of the trajectory, and
    /// measured.
    fn feedback(&self, index: i32, desired: &Values, actual: &Values);
    /// Returns whether the goal is to be cancelled.
    fn is_cancelled(&self) -> bool;
    /// Returns whether the node has ended: the run then does with the motion what `on_lost` says.
    fn has_ended(&self) -> bool;
}

/// Executes a goal, and returns how it ended; the arm is at rest then. Its lease is that of its connection.
pub fn follow(way: &Way, goal: Goal, watcher: &dyn Watcher) -> Outcome {
    let text = |error: ClientError| match error.hint() {
        Some(hint) => format!("{error} (hint: {hint})"),
        None => error.to_string(),
    };
    let mut moves = false;
    match course(way, goal, watcher, &mut moves) {
        Ok(outcome) => outcome,
        Err(error) if moves => Outcome::new(Code::PathToleranceViolated, text(error)),
        Err(error) => Outcome::new(Code::InvalidGoal, text(error)),
    }
}

fn course(way: &Way, mut goal: Goal, watcher: &dyn Watcher, moves: &mut bool) -> Result<Outcome, ClientError> {
    let mut client = Client::connect(&way.run, &way.socket)?;
    client.call(way.behalf.clone())?;
    let status = client.call(Status {})?;
    let of_task = status.tasks.iter().find(|task| task.name == way.task);
    let own = of_task.map(|task| task.joints.clone()).unwrap_or_default();
    if let Some(refused) = refused(&goal, &own, &way.task) {
        return Ok(refused);
    }
    if goal.needs_start() {
        let at = measured(&mut client, &goal.joints)?.positions;
        goal.begin_at(at);
    }
    let curve = match goal.curve() {
        Ok(curve) => curve,
        Err(outcome) => return Ok(outcome),
    };
    let execute = Execute { trajectory: goal.trajectory(), task: Some(way.task.clone()), retraces_to: None };
    let begun = match client.call(execute) {
        Ok(begun) => begun,
        Err(ClientError::Refused(error)) => return Ok(Outcome::new(Code::InvalidGoal, refusal(&error))),
        Err(error) => return Err(error),
    };
    *moves = true;
    watch(&mut client, (begun.motion, &way.task), &goal, curve, watcher)
}

/// Returns why a goal cannot begin.
fn refused(goal: &Goal, own: &[String], task: &str) -> Option<Outcome> {
    let sorted = |joints: &[String]| {
        let mut joints = joints.to_vec();
        joints.sort_unstable();
        joints
    };
    if sorted(own) != sorted(&goal.joints) {
        return Some(Outcome::new(Code::InvalidJoints, format!("{task} has the joints {}", own.join(", "))));
    }
    if goal.stamp == 0.0 {
        return None;
    }
    let ahead = goal.stamp - wall_now() as f64 * 1e-9;
    if ahead + goal.duration() < 0.0 {
        let text = format!("the trajectory ended {:.3} s ago", -ahead - goal.duration());
        return Some(Outcome::new(Code::OldHeaderTimestamp, text));
    }
    (ahead > MAX_AHEAD).then(|| {
        Outcome::new(
            Code::InvalidGoal,
            format!("it would start in {ahead:.3} s: send it when it starts, or without a stamp"),
        )
    })
}

fn refusal(error: &RpcError) -> String {
    let hint = error.hint.as_ref().map(|hint| format!(" (hint: {hint})")).unwrap_or_default();
    format!("{}: {}{hint}", error.code.name(), error.message)
}

/// Follows a motion to its end.
fn watch(
    client: &mut Client,
    (motion, task): (u64, &str),
    goal: &Goal,
    mut curve: Curve,
    watcher: &dyn Watcher,
) -> Result<Outcome, ClientError> {
    let mut ended: Option<Outcome> = None;
    let report = loop {
        let report = client.call(Motion { motion })?;
        if report.done {
            break report;
        }
        let time = report.progress * goal.duration();
        let (desired, actual) = (curve.at(time), measured(client, &goal.joints)?);
        watcher.feedback(curve.index(time), &desired, &actual);
        if watcher.has_ended() {
            return Ok(Outcome::new(Code::PathToleranceViolated, "the node has ended"));
        }
        if ended.is_none() {
            ended = match goal.off_path(&desired, &actual) {
                _ if watcher.is_cancelled() => {
                    Some(Outcome { cancelled: true, ..Outcome::new(Code::Successful, "cancelled") })
                }
                Some(text) => Some(Outcome::new(Code::PathToleranceViolated, text)),
                None => None,
            };
            if ended.is_some() {
                client.call(Cancel { task: Some(task.to_owned()), ..Cancel::default() })?;
            }
        }
        std::thread::sleep(PERIOD);
    };
    match ended {
        // It had arrived when it was to be cancelled.
        Some(outcome) if !(outcome.cancelled && arrived(&report)) => Ok(outcome),
        _ if arrived(&report) => arrival(client, goal, curve),
        _ => {
            let code = if report.progress >= 1.0 { Code::GoalToleranceViolated } else { Code::PathToleranceViolated };
            Ok(Outcome::new(code, report.error.unwrap_or(report.state)))
        }
    }
}

fn arrived(report: &MotionReport) -> bool {
    report.state == "COMPLETED" && report.error.is_none()
}

/// Waits until all joints are within the goal's own tolerances.
fn arrival(client: &mut Client, goal: &Goal, mut curve: Curve) -> Result<Outcome, ClientError> {
    let (began, target) = (Instant::now(), curve.at(goal.duration()));
    loop {
        let Some(text) = goal.off_goal(&target, &measured(client, &goal.joints)?) else {
            return Ok(Outcome::new(Code::Successful, ""));
        };
        if began.elapsed().as_secs_f64() > goal.late {
            return Ok(Outcome::new(Code::GoalToleranceViolated, text));
        }
        std::thread::sleep(PERIOD);
    }
}

/// Returns measured positions and velocities of joints.
fn measured(client: &mut Client, joints: &[String]) -> Result<Values, ClientError> {
    let state = client.call(State {})?;
    let mut values = Values::default();
    for joint in joints {
        let of_joint = state.arms.iter().flat_map(|arm| &arm.joints).find(|report| report.name == *joint);
        values.positions.push(of_joint.and_then(|report| report.position).unwrap_or(f64::NAN));
        values.velocities.push(of_joint.and_then(|report| report.velocity).unwrap_or(f64::NAN));
    }
    Ok(values)
}

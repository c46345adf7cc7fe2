//! Events as text for the log, rpc and the terminal.
//!
//! The tick reports indices, because it may not allocate; this module resolves them to names.

use serde::Serialize;

use super::texts::{apart, because, outcome_text, percent, reason_text};
use super::{Cause, Event, LimitKind, Outcome, Phase, Reason, TaskState};
use crate::named::named;

/// The names behind the tick's indices, in the order of the blueprint.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Names {
    /// The arms.
    pub arms: Vec<ArmNames>,
    /// The tasks.
    pub tasks: Vec<String>,
}

/// Names of one arm and its joints.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ArmNames {
    /// The arm's `hardware_id`.
    pub hardware_id: String,
    /// Its joints, in the arm's order; unique over all arms.
    pub joints: Vec<String>,
}

impl Names {
    /// Returns an arm's `hardware_id`.
    pub fn arm(&self, arm: u16) -> String {
        self.arms.get(usize::from(arm)).map_or_else(|| format!("arm #{arm}"), |a| a.hardware_id.clone())
    }

    /// Returns a task's name.
    pub fn task(&self, task: u16) -> String {
        self.tasks.get(usize::from(task)).cloned().unwrap_or_else(|| format!("task #{task}"))
    }

    /// Returns the name of a joint, counted over all arms.
    pub fn joint(&self, joint: u16) -> String {
        let mut all = self.arms.iter().flat_map(|a| &a.joints);
        all.nth(usize::from(joint)).cloned().unwrap_or_else(|| format!("joint #{joint}"))
    }
}

named! {
    /// Severity of an event.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
    #[serde(rename_all = "lowercase")]
    pub enum Severity {
        /// Normal operation.
        Info = "info",
        /// A request or a command was not carried out as wanted.
        Warn = "warn",
        /// An arm is held, or the tick misses its deadlines.
        Error = "error",
    }
}

/// An event with names and a sentence. Fields that do not apply are `None` or empty.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Described {
    /// `request`, `task`, `preempted`, `mode_conflict`, `arm`, `limited`, `overrun`, `speed`, `degraded`, `guard`,
    /// `stop` or `share`.
    pub kind: &'static str,
    /// Severity.
    pub severity: Severity,
    /// The request it answers.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub request: Option<u64>,
    /// The arm concerned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
    /// The task concerned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
    /// The joint concerned.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub joint: Option<String>,
    /// Status word: of the outcome, the task's state, the arm's phase, the limit.
    pub status: &'static str,
    /// Numbers of the event: an error [rad], a step [rad], the requested value of a limited joint, skipped periods and
    /// lateness [ns], an arm's error code.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub values: Vec<f64>,
    /// One sentence, without a full stop.
    pub text: String,
    /// Who asked for it, if it is the effect of a request.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
}

impl Described {
    /// Returns the sentence with who asked for it.
    pub fn line(&self) -> String {
        self.by.as_ref().map_or_else(|| self.text.clone(), |by| format!("{}, by {by}", self.text))
    }
}

/// Returns whether an event is the effect of a request that the same tick answered, and not of something else.
pub fn follows_request(event: &Event) -> bool {
    match event {
        Event::Request(..) => true,
        Event::Arm(_, _, cause) => matches!(cause, Cause::None | Cause::Operator),
        Event::Task(_, _, reason) => matches!(
            reason,
            Reason::None | Reason::Cancelled | Reason::StreamEnded | Reason::ArmHeld(_, Cause::Operator)
        ),
        Event::Preempted(..) => true,
        _ => false,
    }
}

/// Describes an event.
pub fn describe(event: &Event, names: &Names) -> Described {
    match *event {
        Event::Request(id, outcome) => request(id, outcome, names),
        Event::Task(task, state, reason) => task_changed(task, state, reason, names),
        Event::Preempted(loser, winner, joint, equal) => {
            let why = if equal { "has the same priority and is listed first" } else { "has the higher priority" };
            let (loser, winner, joint) = (names.task(loser), names.task(winner), names.joint(joint));
            let text = format!("task {loser} lost {joint} to {winner}, which {why}");
            Described { task: Some(loser), joint: Some(joint), ..plain("preempted", Severity::Warn, "preempted", text) }
        }
        Event::ModeConflict(loser, winner, arm) => {
            let (loser, winner, arm) = (names.task(loser), names.task(winner), names.arm(arm));
            let text = format!("task {loser} was rejected: {winner} uses another control mode on {arm}");
            let d = plain("mode_conflict", Severity::Warn, "refused", text);
            Described { task: Some(loser), arm: Some(arm), ..d }
        }
        Event::Arm(arm, phase, cause) => arm_changed(arm, phase, cause, names),
        Event::Limited(joint, kind, asked) => {
            let joint = names.joint(joint);
            let text = format!("{joint} is limited in {}: {asked:.4} {} commanded", kind.name(), unit(kind));
            let d = plain("limited", Severity::Warn, kind.name(), text);
            Described { joint: Some(joint), values: vec![asked], ..d }
        }
        Event::Overrun(skipped, late_ns) => {
            let periods = if skipped == 1 { "period" } else { "periods" };
            let text = format!("overrun: {skipped} {periods} skipped, {:.3} ms late", late_ns as f64 * 1e-6);
            let d = plain("overrun", Severity::Warn, "skipped", text);
            Described { values: vec![f64::from(skipped), late_ns as f64], ..d }
        }
        Event::Speed(fraction, paused) => {
            let percent = percent(fraction);
            let (status, text) = match paused {
                true => ("paused", format!("all motions are paused; speed {percent} afterwards")),
                false => ("set", format!("speed {percent}")),
            };
            Described { values: vec![fraction], ..plain("speed", Severity::Info, status, text) }
        }
        Event::Degraded => {
            let text = "ten consecutive ticks were late by a period or more".into();
            plain("degraded", Severity::Error, "late", text)
        }
        Event::Guard(arm, guarded) => {
            let arm = names.arm(arm);
            let d = match guarded {
                Some(pair) => {
                    let text = format!("collision guard: {arm} decelerates, {}", apart(&pair));
                    let d = plain("guard", Severity::Warn, "blocked", text);
                    Described { values: vec![pair.distance], ..d }
                }
                None => plain("guard", Severity::Info, "released", format!("collision guard: {arm} is free to move")),
            };
            Described { arm: Some(arm), ..d }
        }
    }
}

fn plain(kind: &'static str, severity: Severity, status: &'static str, text: String) -> Described {
    let (request, arm, task, joint, by) = (None, None, None, None, None);
    Described { kind, severity, request, arm, task, joint, status, values: Vec::new(), text, by }
}

fn request(id: u64, outcome: Outcome, names: &Names) -> Described {
    let severity = match outcome {
        Outcome::Accepted | Outcome::Cancelled | Outcome::AlreadyStopped => Severity::Info,
        _ => Severity::Warn,
    };
    let text = format!("request {id}: {}", outcome_text(&outcome, names));
    let mut d = Described { request: Some(id), ..plain("request", severity, outcome.name(), text) };
    match outcome {
        Outcome::Accepted | Outcome::Cancelled | Outcome::AlreadyStopped | Outcome::ShuttingDown | Outcome::Paused => {}
        Outcome::AlreadyExecuting(task) | Outcome::WrongTask(task) | Outcome::InvalidTarget(task) => {
            d.task = Some(names.task(task));
        }
        Outcome::NonFinite(joint) => d.joint = Some(names.joint(joint)),
        Outcome::StartStateMismatch(joint, by) | Outcome::OutOfLimits(joint, by) | Outcome::OutOfReach(joint, by) => {
            d.joint = Some(names.joint(joint));
            d.values = vec![by];
        }
        Outcome::GripperOutOfLimits(arm, value) | Outcome::GripperForceOutOfLimits(arm, value) => {
            d.arm = Some(names.arm(arm));
            d.values = vec![value];
        }
        Outcome::StartStateUnavailable(arm)
        | Outcome::ArmMoving(arm)
        | Outcome::NoGripper(arm)
        | Outcome::NoGripperForce(arm)
        | Outcome::NoGripperSpeed(arm)
        | Outcome::Superseded(arm, _) => {
            d.arm = Some(names.arm(arm));
        }
        Outcome::ArmNotReady(arm, _, cause) | Outcome::ArmLatched(arm, cause) | Outcome::StillFaulted(arm, cause) => {
            d.arm = Some(names.arm(arm));
            d.values = code(cause);
        }
    }
    d
}

fn task_changed(task: u16, state: TaskState, reason: Reason, names: &Names) -> Described {
    let severity = match (state, reason) {
        (_, Reason::None | Reason::Cancelled | Reason::StreamEnded | Reason::Until(..)) => Severity::Info,
        (_, Reason::Approaching | Reason::InStep) => Severity::Info,
        (_, Reason::ArmHeld(_, Cause::Operator | Cause::StopInput | Cause::Shutdown)) => Severity::Warn,
        (_, Reason::WayBlocked | Reason::LeaseEnded(_)) => Severity::Warn,
        (TaskState::Aborted | TaskState::Fault, _) => Severity::Error,
        _ => Severity::Warn,
    };
    let name = names.task(task);
    let why = reason_text(&reason, names);
    let colon = if why.is_empty() { "" } else { ": " };
    let text = format!("task {name} is {}{colon}{why}", state.name());
    let mut d = Described { task: Some(name), ..plain("task", severity, state.name(), text) };
    match reason {
        Reason::None | Reason::Cancelled | Reason::Timeout | Reason::StreamEnded | Reason::WayBlocked => {}
        Reason::Approaching | Reason::InStep => {}
        Reason::PathTolerance(joint, value)
        | Reason::GoalTolerance(joint, value)
        | Reason::GoalVelocity(joint, value)
        | Reason::TrackingError(joint, value)
        | Reason::LeaderAway(joint, value)
        | Reason::Gap(joint, value, _)
        | Reason::Jump(joint, value) => {
            d.joint = Some(names.joint(joint));
            d.values = vec![value];
        }
        Reason::Preempted(_, joint) | Reason::NonFinite(joint) => d.joint = Some(names.joint(joint)),
        Reason::Guarded(arm) | Reason::LeaseEnded(arm) | Reason::Unsensed(arm, _) => d.arm = Some(names.arm(arm)),
        Reason::Until(_, value) => d.values = vec![value],
        Reason::ArmHeld(arm, cause) | Reason::LeaderLost(arm, cause) => {
            d.arm = Some(names.arm(arm));
            d.values = code(cause);
        }
    }
    d
}

fn arm_changed(arm: u16, phase: Phase, cause: Cause, names: &Names) -> Described {
    let severity = match (phase, cause) {
        (Phase::Held, Cause::Operator | Cause::StopInput | Cause::Shutdown) => Severity::Warn,
        (Phase::Held, _) => Severity::Error,
        (_, Cause::None | Cause::Operator | Cause::Shutdown) => Severity::Info,
        _ => Severity::Warn,
    };
    let name = names.arm(arm);
    let text = format!("{name} is {}{}", phase.name(), because(cause));
    Described { arm: Some(name), values: code(cause), ..plain("arm", severity, phase.name(), text) }
}

fn code(cause: Cause) -> Vec<f64> {
    match cause {
        Cause::Fault(code) => vec![f64::from(code)],
        Cause::Tracking(_, by)
        | Cause::PositionJump(_, by)
        | Cause::MovedWhileActivating(_, by)
        | Cause::LedTooFast(_, by)
        | Cause::TooFast(_, by)
        | Cause::LedOutOfRange(_, by)
        | Cause::TurnLost(_, by)
        | Cause::ReadingInconsistent(_, by)
        | Cause::ReadingFollows(_, by)
        | Cause::OutsideRange(_, by)
        | Cause::Gap(_, by, _) => vec![by],
        Cause::StartMismatch(_, written, read) => vec![written, read],
        _ => Vec::new(),
    }
}

fn unit(kind: LimitKind) -> &'static str {
    match kind {
        LimitKind::Position => "rad",
        LimitKind::Velocity => "rad/s",
        LimitKind::Acceleration => "rad/s²",
        LimitKind::Tool => "m/s",
        LimitKind::Effort => "Nm",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names() -> Names {
        let arm = |id: &str| ArmNames { hardware_id: id.into(), joints: crate::joint::make_joints(id, 2) };
        Names { arms: vec![arm("left"), arm("right")], tasks: vec!["traj_left".into(), "servo".into()] }
    }

    #[test]
    fn joints_are_counted_over_all_arms() {
        assert_eq!(names().joint(0), "left_joint1");
        assert_eq!(names().joint(3), "right_joint2");
        assert_eq!(names().joint(4), "joint #4");
    }

    #[test]
    fn an_aborted_task_names_its_joint_and_error() {
        let d = describe(&Event::Task(0, TaskState::Aborted, Reason::GoalTolerance(1, 0.02)), &names());
        assert_eq!(d.text, "task traj_left is ABORTED: left_joint2 ended 0.0200 rad (1.15°) from the goal");
        assert_eq!((d.severity, d.status, d.joint.as_deref()), (Severity::Error, "ABORTED", Some("left_joint2")));
        assert_eq!(d.values, [0.02]);
    }

    #[test]
    fn a_start_that_is_refused_says_where_the_joint_was_commanded_and_where_it_is_read() {
        let d = describe(&Event::Arm(0, Phase::Held, Cause::StartMismatch(1, 0.5, -0.25)), &names());
        assert!(d.text.contains("joint 2 is commanded at 0.5000 rad and read at -0.2500 rad"), "{}", d.text);
        assert_eq!(d.values, [0.5, -0.25]);
    }

    #[test]
    fn a_held_arm_says_why() {
        let d = describe(&Event::Arm(1, Phase::Held, Cause::Fault(31)), &names());
        assert_eq!(d.text, "right is held (the arm reports error 31)");
        assert_eq!(d.values, [31.0]);
        let d = describe(&Event::Arm(1, Phase::Ready, Cause::None), &names());
        assert_eq!((d.text.as_str(), d.severity), ("right is ready", Severity::Info));
    }

    #[test]
    fn a_refused_request_carries_its_id_and_status() {
        let d = describe(&Event::Request(7, Outcome::StartStateMismatch(0, 0.5)), &names());
        assert_eq!((d.request, d.status), (Some(7), "START_STATE_MISMATCH"));
        assert_eq!(
            d.text,
            "request 7: the first point or target is 0.5000 rad (28.65°) from the position of left_joint1"
        );
        let d = describe(&Event::Request(8, Outcome::GripperOutOfLimits(1, -0.01)), &names());
        let text = "request 8: the gripper of right cannot go to -0.0100 m: an opening must be 0 m or more";
        assert_eq!((d.text.as_str(), d.status), (text, "OUT_OF_LIMITS"));
        assert_eq!((d.arm.as_deref(), d.joint, d.values), (Some("right"), None, vec![-0.01]));
    }
}

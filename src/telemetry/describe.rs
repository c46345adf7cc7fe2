//! Events as text for the log, rpc and the terminal.
//!
//! The tick reports indices, because it may not allocate; this module resolves them to names.

use serde::Serialize;

use super::{Age, Bound, Cause, Event, Guarded, Interruption, LimitKind, Outcome, Phase, Reason, TaskState};
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

/// Returns what the collision guard keeps apart as text.
fn apart(pair: &Guarded) -> String {
    format!("{} and {} at {:.0} mm", pair.link, pair.other, pair.distance * 1e3)
}

fn plain(kind: &'static str, severity: Severity, status: &'static str, text: String) -> Described {
    Described { kind, severity, request: None, arm: None, task: None, joint: None, status, values: Vec::new(), text }
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

/// Writes a fraction as `30 %`: to 0.1 %, and below 1 % to 0.001 %.
pub fn percent(fraction: f64) -> String {
    let percent = fraction * 100.0;
    let decimals = if percent.abs() < 1.0 { 1000.0 } else { 10.0 };
    format!("{} %", (percent * decimals).round() / decimals)
}

/// Returns the outcome of a request as text.
pub fn outcome_text(outcome: &Outcome, names: &Names) -> String {
    match *outcome {
        Outcome::Accepted => "accepted".into(),
        Outcome::Cancelled => "the motion is being cancelled".into(),
        Outcome::AlreadyStopped => "there was no motion to cancel".into(),
        Outcome::AlreadyExecuting(task) => format!("task {} is executing already", names.task(task)),
        Outcome::StartStateMismatch(joint, by) => {
            format!("the first point or target is {} from the position of {}", angle(by), names.joint(joint))
        }
        Outcome::StartStateUnavailable(arm) => format!("no recent state of {}", names.arm(arm)),
        Outcome::ArmNotReady(arm, phase, cause) => {
            format!("{} is not ready: {}{}", names.arm(arm), phase.name(), because(cause))
        }
        Outcome::Paused => "motions are paused, and a native motion does not wait".into(),
        Outcome::ArmMoving(arm) => format!("{} still moves", names.arm(arm)),
        Outcome::ArmLatched(arm, cause) => format!("{} is held{}: reset it first", names.arm(arm), because(cause)),
        Outcome::StillFaulted(arm, cause) => format!("{} cannot be reset yet{}", names.arm(arm), because(cause)),
        Outcome::WrongTask(task) => format!("task {} does not support this request", names.task(task)),
        Outcome::NonFinite(joint) => format!("the target of {} is not a finite number", names.joint(joint)),
        Outcome::OutOfLimits(joint, by) => {
            format!("the target of {} is outside its limits by {}", names.joint(joint), angle(by))
        }
        Outcome::OutOfReach(joint, by) => format!(
            "the target of {} is {} from the one before, further than the joint gets in that time: it is left out",
            names.joint(joint),
            angle(by)
        ),
        Outcome::GripperOutOfLimits(arm, opening) => {
            format!("the gripper of {} cannot go to {opening:.4} m: an opening must be 0 m or more", names.arm(arm))
        }
        Outcome::GripperForceOutOfLimits(arm, force) => {
            format!("a force of {force} is outside the range of the gripper of {}", names.arm(arm))
        }
        Outcome::NoGripperForce(arm) => format!("the gripper of {} has no force control", names.arm(arm)),
        Outcome::NoGripperSpeed(arm) => format!("the gripper of {} has no speed control", names.arm(arm)),
        Outcome::InvalidTarget(task) => {
            format!("the target of task {} is not finite, or its orientation is invalid", names.task(task))
        }
        Outcome::NoGripper(arm) => format!("{} has no gripper", names.arm(arm)),
        Outcome::Superseded(arm, by) => {
            format!("{} after this motion was requested", interruption_text(by, &names.arm(arm)))
        }
        Outcome::ShuttingDown => "the run is shutting down".into(),
    }
}

/// Returns what interrupted an arm as text.
fn interruption_text(interruption: Interruption, arm: &str) -> String {
    match interruption {
        Interruption::Stopped => format!("{arm} was stopped by an operator"),
        Interruption::Held(cause) => format!("{arm} was held{}", because(cause)),
        Interruption::Disabled => format!("{arm} was disabled"),
        Interruption::LinkLost => format!("the connection to {arm} was lost"),
        Interruption::PowerLost => format!("the motors of {arm} were switched off"),
        Interruption::LeaseTaken(_) => format!("another client took the lease of {arm}"),
        Interruption::LeaseEnded(_) => format!("the lease of {arm} was released"),
    }
}

fn task_changed(task: u16, state: TaskState, reason: Reason, names: &Names) -> Described {
    let severity = match (state, reason) {
        (_, Reason::None | Reason::Cancelled | Reason::StreamEnded) => Severity::Info,
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
        Reason::Guarded(arm) | Reason::LeaseEnded(arm) => d.arm = Some(names.arm(arm)),
        Reason::ArmHeld(arm, cause) | Reason::LeaderLost(arm, cause) => {
            d.arm = Some(names.arm(arm));
            d.values = code(cause);
        }
    }
    d
}

/// Returns the reason of a task's state as text; empty if there is none.
pub fn reason_text(reason: &Reason, names: &Names) -> String {
    match *reason {
        Reason::None => String::new(),
        Reason::Cancelled => "cancelled".into(),
        Reason::WayBlocked => "the rest of its way is no longer known to be free".into(),
        Reason::Timeout => "no target within its timeout".into(),
        Reason::StreamEnded => "its stream was ended".into(),
        Reason::PathTolerance(joint, by) => format!("{} was {} from the path", names.joint(joint), angle(by)),
        Reason::GoalTolerance(joint, by) => format!("{} ended {} from the goal", names.joint(joint), angle(by)),
        Reason::GoalVelocity(joint, v) => {
            format!("{} was at the goal and still moved at {v:.3} rad/s", names.joint(joint))
        }
        Reason::Preempted(task, joint) => format!("task {} took {}", names.task(task), names.joint(joint)),
        Reason::ArmHeld(arm, cause) => format!("{} is held{}", names.arm(arm), because(cause)),
        Reason::NonFinite(joint) => format!("the command of {} was not a finite number", names.joint(joint)),
        Reason::Jump(joint, by) => format!("the command of {} jumped by {}", names.joint(joint), angle(by)),
        Reason::TrackingError(joint, by) => {
            format!("tracking error of {} was {}", names.joint(joint), angle(by))
        }
        Reason::Approaching => "approaching its leader".into(),
        Reason::InStep => "in step with its leader".into(),
        Reason::LeaderLost(arm, cause) => {
            format!("the position of its leader {} is unknown{}", names.arm(arm), because(cause))
        }
        Reason::LeaderAway(joint, by) => {
            format!("{} was {} from its leader, more than `max_approach`", names.joint(joint), angle(by))
        }
        Reason::Guarded(arm) => format!("the collision guard stopped {}", names.arm(arm)),
        Reason::Gap(joint, by, time) => format!(
            "after a gap in the setpoints {} stopped {} from the path, {time:.2} s after the last one",
            names.joint(joint),
            angle(by)
        ),
        Reason::LeaseEnded(arm) => {
            format!("the client that sent it has disconnected, or released {}", names.arm(arm))
        }
    }
}

/// Returns what limits an end effector as text; empty if nothing does.
pub fn bound_text(bound: Bound, names: &Names) -> String {
    match bound {
        Bound::None => String::new(),
        Bound::Velocity(joint) => format!("the velocity limit of {}", names.joint(joint)),
        Bound::Position(joint) => format!("the position limit of {}", names.joint(joint)),
        Bound::Acceleration(joint) => format!("the acceleration limit of {}", names.joint(joint)),
        Bound::Singularity => "a singularity nearby".into(),
        Bound::Invalid => "a target that is not finite".into(),
        Bound::Guard(pair) => format!("the collision guard: {}", apart(&pair)),
    }
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

/// Returns why an arm is held as text; empty for `Cause::None`.
pub fn cause_text(cause: Cause) -> String {
    match cause {
        Cause::None => String::new(),
        Cause::Operator => "stopped by an operator".into(),
        Cause::Stale(age) => stale_text(age),
        Cause::Fault(code) => format!("the arm reports error {code}"),
        Cause::LinkLost => "the connection was lost".into(),
        Cause::NonFinite => "a command was not a finite number".into(),
        Cause::Jump => "a command jumped".into(),
        Cause::Overrun => {
            "100 ms or more passed between two ticks: this computer was too busy; see `dimos doctor`".into()
        }
        Cause::HeartbeatLost => "the device thread saw no heartbeat of the tick".into(),
        Cause::PowerLost => "the motors were disabled unexpectedly".into(),
        Cause::Tracking(joint, by) => format!(
            "tracking error of joint {} is {}: it is blocked, pushed or moved by another program",
            joint + 1,
            angle(by)
        ),
        Cause::PositionJump(joint, by) => {
            format!("the position of joint {} jumped by {}", joint + 1, angle(by))
        }
        Cause::TurnLost(joint, by) => format!(
            "joint {} reads {} away: its turn count is lost; restart the arm's controller, and check its pose",
            joint + 1,
            angle(by)
        ),
        Cause::SeamCrossed(joint) => {
            format!("joint {} crossed the seam of its encoder: turn it back into its range by hand", joint + 1)
        }
        Cause::ReadingInconsistent(joint, by) => {
            format!("position and velocity of joint {} contradict each other by {}", joint + 1, angle(by))
        }
        Cause::ReadingFollows(joint, by) => format!(
            "the reading of joint {} moved by {} with its setpoint without coming nearer: it is not that of the joint",
            joint + 1,
            angle(by)
        ),
        Cause::StartMismatch(joint, written, read) => format!(
            "joint {} is commanded at {written:.4} rad and read at {read:.4} rad, which nothing explains; if the reading is \
             right, reset and enable the arm again",
            joint + 1
        ),
        Cause::OutsideRange(joint, by) => format!(
            "joint {} is {} outside its range; move it inside by hand, or enable the arm with --outside",
            joint + 1,
            angle(by)
        ),
        Cause::Gap(joint, by, time) => format!(
            "after a gap in its setpoints, {time:.2} s since the last one, joint {} did not stop where its motion could \
             continue: {} away",
            joint + 1,
            angle(by)
        ),
        Cause::SetpointRefused => "a setpoint was refused".into(),
        Cause::LedTooFast(joint, velocity) => format!(
            "the controller moved joint {} at {velocity:.3} rad/s, beyond 1.1 times its velocity limit",
            joint + 1
        ),
        Cause::LedOutOfRange(joint, position) => {
            format!("the controller moved joint {} to {position:.4} rad, outside its range", joint + 1)
        }
        Cause::MovedWhileActivating(joint, by) => {
            format!("joint {} moved by {} while the arm was being enabled", joint + 1, angle(by))
        }
        Cause::ModeChanged => "the panel, hand guiding or another program changed the control mode".into(),
        Cause::StoppedElsewhere => "the panel or another program stopped the arm".into(),
        Cause::PowerChanged => "the panel or another program enabled the motors".into(),
        Cause::StopInput => "the stop input is open".into(),
        Cause::WayBlocked => "it could not rest before what is in its way".into(),
        Cause::Shutdown => "the run is shutting down".into(),
    }
}

/// Returns the figures of a stale state as text.
fn stale_text(age: Age) -> String {
    let ms = |us: u32| (us + 500) / 1000;
    let own = if age.own_us >= 500 {
        format!("; this computer was stalled for {} ms", ms(age.own_us))
    } else {
        String::new()
    };
    // Other reasons for a stale state: reads fail, or positions are implausible.
    if age.age_us <= age.limit_us {
        return "its state cannot be read".into();
    }
    format!("no state for {} ms (limit {} ms{own})", ms(age.age_us), ms(age.limit_us))
}

fn because(cause: Cause) -> String {
    if cause == Cause::None { String::new() } else { format!(" ({})", cause_text(cause)) }
}

fn code(cause: Cause) -> Vec<f64> {
    match cause {
        Cause::Fault(code) => vec![f64::from(code)],
        Cause::Tracking(_, by)
        | Cause::PositionJump(_, by)
        | Cause::MovedWhileActivating(_, by)
        | Cause::LedTooFast(_, by)
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

fn angle(rad: f64) -> String {
    format!("{rad:.4} rad ({:.2}°)", rad.to_degrees())
}

fn unit(kind: LimitKind) -> &'static str {
    match kind {
        LimitKind::Position => "rad",
        LimitKind::Velocity => "rad/s",
        LimitKind::Acceleration => "rad/s²",
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

//! The tick's codes in words: what became of a request, why a task or an arm is in its state, what happened.

use serde_json::json;

use super::error::{Code, RpcError};
use super::report::CauseReport;
use super::streams::{EventReport, Level};
use crate::telemetry::{Cause, Event, LimitKind, Outcome, Phase, Reason, TaskState};

/// Names for the indices that the tick uses: those of the blueprint.
#[derive(Debug, Clone, Default)]
pub struct Names {
    /// The arms.
    pub arms: Vec<String>,
    /// The tasks.
    pub tasks: Vec<String>,
    /// The joints, over all arms.
    pub joints: Vec<String>,
}

fn name(of: &[String], index: u16) -> &str {
    of.get(usize::from(index)).map_or("?", String::as_str)
}

impl Names {
    /// Name of an arm.
    pub fn arm(&self, index: u16) -> &str {
        name(&self.arms, index)
    }

    /// Name of a task.
    pub fn task(&self, index: u16) -> &str {
        name(&self.tasks, index)
    }

    /// Name of a joint.
    pub fn joint(&self, index: u16) -> &str {
        name(&self.joints, index)
    }

    /// The status word of a request that was taken on, or the refusal in words.
    pub fn outcome(&self, outcome: &Outcome) -> Result<&'static str, RpcError> {
        let Some(code) = Code::of(outcome) else { return Ok(outcome.name()) };
        let error = |message: String| RpcError::new(code, message);
        Err(match *outcome {
            Outcome::Accepted | Outcome::Cancelled | Outcome::AlreadyStopped => return Ok(outcome.name()),
            Outcome::AlreadyExecuting(task) => error(format!("task {} is executing already", self.task(task)))
                .hint("wait for it, or end it with `dimos cancel`"),
            Outcome::StartStateMismatch(joint, distance) => {
                let joint = self.joint(joint);
                error(format!("the trajectory starts {distance:.3} rad away from where {joint} is"))
                    .hint("move to its first point, then execute it")
                    .data(json!({"joint": joint, "distance": distance}))
            }
            Outcome::StartStateUnavailable(arm) => error(format!("there is no fresh state of {}", self.arm(arm)))
                .hint("`dimos status` shows its link and the age of its state"),
            Outcome::ArmNotReady(arm, phase, cause) => not_ready(code, self.arm(arm), phase, cause),
            Outcome::ArmLatched(arm, cause) => {
                let arm = self.arm(arm);
                error(format!("{arm} is held: {}", cause_text(cause)))
                    .hint(format!("when it may move again: `dimos arm reset {arm}`, then `dimos arm enable {arm}`"))
            }
            Outcome::StillFaulted(arm, cause) => {
                let arm = self.arm(arm);
                error(format!("{arm} cannot be reset yet: {}", cause_text(cause)))
                    .hint(format!("remove the cause, then again: `dimos arm reset {arm}`"))
            }
            Outcome::WrongTask(task) => error(format!("task {} cannot do that", self.task(task)))
                .hint("`dimos status` lists the tasks and their types"),
            Outcome::NonFinite(joint) => error(format!("the target of {} is not finite", self.joint(joint))),
            Outcome::OutOfLimits(joint, by) => {
                let joint = self.joint(joint);
                error(format!("the target of {joint} is {by:.4} beyond its limit"))
                    .hint("limits: the arm's own, narrowed by `limits` in the blueprint")
                    .data(json!({"joint": joint, "by": by}))
            }
            Outcome::NoGripper(arm) => error(format!("{} has no gripper", self.arm(arm))),
            Outcome::ShuttingDown => error("the run is ending".into()),
        })
    }

    /// Why a task is in its state; `None` when there is nothing special.
    pub fn reason(&self, reason: &Reason) -> Option<String> {
        Some(match *reason {
            Reason::None => return None,
            Reason::Cancelled => "cancelled".into(),
            Reason::Timeout => "its stream of targets stopped".into(),
            Reason::PathTolerance(joint, by) => format!("{} was {by:.4} rad off the path", self.joint(joint)),
            Reason::GoalTolerance(joint, by) => {
                format!("{} was still {by:.4} rad from the goal when the goal time was over", self.joint(joint))
            }
            Reason::Preempted(task, joint) => format!("task {} took {}", self.task(task), self.joint(joint)),
            Reason::ArmHeld(arm, cause) => format!("{} is held: {}", self.arm(arm), cause_text(cause)),
            Reason::NonFinite(joint) => format!("its command for {} was not finite", self.joint(joint)),
            Reason::Jump(joint, step) => format!("its command for {} jumped by {step:.3} rad", self.joint(joint)),
        })
    }

    /// An event for the stream `events`.
    pub fn event(&self, tick: u64, stamp: f64, event: &Event) -> EventReport {
        let report =
            |level, kind: &str, text| EventReport { tick, stamp, level, kind: kind.into(), text, ..Default::default() };
        match *event {
            Event::Request(id, outcome) => match self.outcome(&outcome) {
                Ok(word) => report(Level::Info, "request", format!("request {id}: {word}")),
                Err(e) => report(Level::Warning, "request", format!("request {id}: {}: {e}", outcome.name())),
            },
            Event::Task(task, state, reason) => {
                let name = self.task(task);
                let text = match self.reason(&reason) {
                    Some(reason) => format!("task {name}: {}: {reason}", state.name()),
                    None => format!("task {name}: {}", state.name()),
                };
                let failed = matches!(state, TaskState::Aborted | TaskState::Fault) && reason != Reason::Cancelled;
                let level = if failed { Level::Error } else { Level::Info };
                EventReport { task: Some(name.into()), ..report(level, "task", text) }
            }
            Event::Preempted(loser, winner, joint, equal) => {
                let (loser, winner, joint) = (self.task(loser), self.task(winner), self.joint(joint));
                let how = if equal { ", of the same priority but named first in the blueprint" } else { "" };
                let text = format!("task {loser} lost {joint} to task {winner}{how}");
                let (task, joint) = (Some(loser.into()), Some(joint.into()));
                EventReport { task, joint, ..report(Level::Warning, "preempted", text) }
            }
            Event::ModeConflict(loser, winner, arm) => {
                let (loser, winner, arm) = (self.task(loser), self.task(winner), self.arm(arm));
                let text = format!("task {loser} was refused {arm}: task {winner} uses it in another mode");
                let (task, arm) = (Some(loser.into()), Some(arm.into()));
                EventReport { task, arm, ..report(Level::Warning, "mode_conflict", text) }
            }
            Event::Arm(arm, phase, cause) => {
                let name = self.arm(arm);
                let (level, text) = match cause {
                    Cause::None => (Level::Info, format!("{name}: {}", phase.name())),
                    Cause::Operator | Cause::Shutdown => {
                        (Level::Info, format!("{name}: {}: {}", phase.name(), cause_text(cause)))
                    }
                    _ => (Level::Error, format!("{name}: {}: {}", phase.name(), cause_text(cause))),
                };
                EventReport { arm: Some(name.into()), ..report(level, "arm", text) }
            }
            Event::Limited(joint, kind, asked) => {
                let joint = self.joint(joint);
                let text = format!("{joint}: {} limited, {asked:.3} {} was asked", kind.name(), unit(kind));
                EventReport { joint: Some(joint.into()), ..report(Level::Warning, "limited", text) }
            }
            Event::Overrun(periods, late_ns) => {
                let late = late_ns as f64 * 1e-6;
                report(Level::Warning, "overrun", format!("the tick was {late:.1} ms late; {periods} periods skipped"))
            }
            Event::Degraded => {
                report(Level::Error, "degraded", "ten ticks in a row were late by a period or more".into())
            }
        }
    }
}

fn unit(kind: LimitKind) -> &'static str {
    match kind {
        LimitKind::Position => "rad",
        LimitKind::Velocity => "rad/s",
        LimitKind::Acceleration => "rad/s²",
    }
}

/// What to do before an arm can move depends on what it waits for.
fn not_ready(code: Code, arm: &str, phase: Phase, cause: Cause) -> RpcError {
    let held = if cause == Cause::None { String::new() } else { format!(": {}", cause_text(cause)) };
    let error = RpcError::new(code, format!("{arm} is not ready for motion, it is {}{held}", phase.name()));
    match phase {
        Phase::Unknown => error.hint("it has not told its state yet; see `dimos status`"),
        Phase::Disabled | Phase::Standby => error.hint(format!("dimos arm enable {arm}")),
        Phase::Held => error.hint(format!("dimos arm reset {arm}, then dimos arm enable {arm}")),
        Phase::Activating | Phase::Ready => error.hint("try again in a moment"),
    }
}

/// Why an arm is held, for people.
pub fn cause_text(cause: Cause) -> String {
    match cause {
        Cause::None => "nothing happened".into(),
        Cause::Operator => "stopped by an operator".into(),
        Cause::Stale => "its states stopped coming".into(),
        Cause::Fault(code) => format!("the arm reports error {code}"),
        Cause::LinkLost => "the connection was lost".into(),
        Cause::NonFinite => "a command was not finite".into(),
        Cause::Jump => "a command jumped further than a joint may".into(),
        Cause::Overrun => "the tick lost too much time".into(),
        Cause::HeartbeatLost => "its device thread heard nothing of the tick and held it by itself".into(),
        Cause::PowerLost => "its motors went off without being asked".into(),
        Cause::Shutdown => "the run is ending".into(),
    }
}

/// Why an arm is held, for `status`; `None` when it is not.
pub fn cause(cause: Cause) -> Option<CauseReport> {
    (cause != Cause::None).then(|| CauseReport { name: cause.name().into(), text: cause_text(cause) })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names() -> Names {
        let of = |list: &[&str]| list.iter().map(|s| s.to_string()).collect();
        Names { arms: of(&["left", "right"]), tasks: of(&["traj", "servo"]), joints: of(&["l1", "r1"]) }
    }

    #[test]
    fn refusals_name_what_they_are_about() {
        let names = names();
        for (outcome, message, hint) in [
            (Outcome::AlreadyExecuting(1), "task servo is executing already", "dimos cancel"),
            (Outcome::StartStateMismatch(1, 0.25), "0.250 rad away from where r1 is", "first point"),
            (Outcome::ArmLatched(1, Cause::Operator), "right is held: stopped by an operator", "dimos arm reset right"),
            (
                Outcome::ArmNotReady(0, Phase::Standby, Cause::None),
                "left is not ready for motion, it is standby",
                "enable left",
            ),
            (Outcome::OutOfLimits(0, 0.5), "l1 is 0.5000 beyond", "limits"),
        ] {
            let error = names.outcome(&outcome).unwrap_err();
            assert!(error.message.contains(message), "{error:?}");
            assert!(error.hint.as_deref().unwrap_or_default().contains(hint), "{error:?}");
            assert_eq!(error.code.name(), outcome.name());
        }
        assert_eq!(names.outcome(&Outcome::AlreadyStopped), Ok("ALREADY_STOPPED"));
    }

    #[test]
    fn every_refusal_has_the_code_of_its_status_word() {
        let (phase, cause) = (Phase::Held, Cause::Stale);
        for outcome in [
            Outcome::StartStateUnavailable(0),
            Outcome::ArmNotReady(0, phase, cause),
            Outcome::StillFaulted(0, cause),
            Outcome::WrongTask(0),
            Outcome::NonFinite(0),
            Outcome::NoGripper(0),
            Outcome::ShuttingDown,
        ] {
            assert_eq!(names().outcome(&outcome).unwrap_err().code.name(), outcome.name());
        }
    }

    #[test]
    fn events_name_what_they_are_about_and_how_much_they_matter() {
        let lost = names().event(5, 1.0, &Event::Preempted(1, 0, 1, true));
        assert_eq!(lost.text, "task servo lost r1 to task traj, of the same priority but named first in the blueprint");
        assert_eq!((lost.task.as_deref(), lost.joint.as_deref(), lost.tick), (Some("servo"), Some("r1"), 5));
        let level = |event| names().event(0, 0.0, &event).level;
        assert_eq!(level(Event::Arm(0, Phase::Held, Cause::Operator)), Level::Info);
        assert_eq!(level(Event::Arm(0, Phase::Held, Cause::LinkLost)), Level::Error);
        assert_eq!(level(Event::Task(0, TaskState::Aborted, Reason::Cancelled)), Level::Info);
        assert_eq!(level(Event::Task(0, TaskState::Aborted, Reason::GoalTolerance(0, 0.1))), Level::Error);
        assert!(names().event(0, 0.0, &Event::Limited(9, LimitKind::Velocity, 2.0)).text.starts_with("?:"));
    }
}

//! What outcomes, reasons, causes and bounds are called in messages.

use super::describe::Names;
use super::{Age, Bound, Cause, Guarded, Interruption, Outcome, Reason};
use crate::until::Condition;

/// Returns what the collision guard keeps apart as text.
pub(super) fn apart(pair: &Guarded) -> String {
    format!("{} and {} at {:.0} mm", pair.link, pair.other, pair.distance * 1e3)
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
        Reason::Until(condition, value) => until_text(condition, value),
        Reason::Unsensed(arm, condition) => {
            format!("the {} of {} is no longer known, and was awaited", condition.name(), names.arm(arm))
        }
        Reason::LeaseEnded(arm) => {
            format!("the client that sent it has disconnected, or released {}", names.arm(arm))
        }
    }
}

/// Returns which condition ended a motion, and what was measured.
pub fn until_text(condition: Condition, value: f64) -> String {
    match condition {
        Condition::Input => format!("ended by an input: {}", if value > 0.5 { "high" } else { "low" }),
        _ => format!("ended by {}: {value:.3} {}", condition.name(), condition.unit()),
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
        Bound::Tool => "the speed limit of the tool".into(),
        Bound::Invalid => "a target that is not finite".into(),
        Bound::Guard(pair) => format!("the collision guard: {}", apart(&pair)),
    }
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
        Cause::TooFast(joint, velocity) => format!(
            "joint {} moved at {velocity:.3} rad/s, beyond 1.1 times its velocity limit, in impedance mode",
            joint + 1
        ),
        Cause::JointLost(joint) => {
            format!("joint {} no longer answers: its motor is without power, or its cable is loose", joint + 1)
        }
        Cause::MovedWhileActivating(joint, by) => {
            format!("joint {} moved by {} while the arm was being enabled", joint + 1, angle(by))
        }
        Cause::ModeChanged => "the panel, hand guiding or another program changed the control mode".into(),
        Cause::StoppedElsewhere => "the panel or another program stopped the arm".into(),
        Cause::IdentityChanged => "another arm answers than the one with which the run began".into(),
        Cause::LimitsChanged => "the limits of its controller have become narrower than those of the run".into(),
        Cause::ToolLost => "its gripper is lost, with what it holds".into(),
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

pub(super) fn because(cause: Cause) -> String {
    if cause == Cause::None { String::new() } else { format!(" ({})", cause_text(cause)) }
}

pub(super) fn angle(rad: f64) -> String {
    format!("{rad:.4} rad ({:.2}°)", rad.to_degrees())
}

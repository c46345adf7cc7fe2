//! Telemetry of the tick: plain data of fixed size, pushed into one ring. The recorder thread reads it, logs it, and
//! passes events on to rpc and the text log. Nothing here allocates.

pub mod describe;
mod interruption;
mod label;
pub mod texts;
mod who;

use serde::{Deserialize, Serialize};

use crate::arm::{ArmCommand, ArmState};
use crate::clock::Mono;
use crate::named::named;
use crate::until::Condition;

pub use interruption::{Interruption, Origin};
pub use label::Label;
pub use who::Who;

/// One entry of the ring.
// The ring holds values: a box would allocate in the tick.
#[expect(clippy::large_enum_variant, reason = "samples go through a ring of fixed slots")]
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Sample {
    /// An arm's sample. One per arm and tick, before the tick's `Tick`.
    Arm(ArmSample),
    /// Closes a tick.
    Tick(TickSample),
    /// An event of the tick with this index.
    Event(u64, Event),
}

/// State and command of one arm in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ArmSample {
    /// Index of the arm, in the order of the blueprint.
    pub arm: u16,
    /// The state as the tick read it (with estimated velocities filled in).
    pub state: ArmState,
    /// The command as passed to the device thread.
    pub command: ArmCommand,
    /// The arm's phase after the tick.
    pub phase: Phase,
    /// Reason for the phase.
    pub cause: Cause,
}

/// Timing of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct TickSample {
    /// Index of the tick, counted from 0.
    pub tick: u64,
    /// The tick's deadline: the time it works with.
    pub deadline: Mono,
    /// Assumed deadline of the next tick.
    pub next: Mono,
    /// Wake-up after the deadline [ns].
    pub late_ns: u64,
    /// Time from wake-up to the last command passed to the device threads [ns].
    pub compute_ns: u64,
    /// Whole periods skipped before this tick.
    pub skipped: u32,
    /// Lateness that caused the skip [ns]: of this tick or of the previous one.
    pub overrun_ns: u64,
    /// Samples dropped by a full ring since the last one that was accepted.
    pub dropped: u32,
}

named! {
    /// Phase of an arm.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    pub enum Phase {
        /// No state yet.
        #[default]
        Unknown = "unknown",
        /// Motors off: no commands are sent.
        Disabled = "disabled",
        /// Just enabled: holds its position for the duration of the ramp.
        Activating = "activating",
        /// Holds or follows its tasks.
        Ready = "ready",
        /// Latched hold after a stop or a fault: waits for `reset`.
        Held = "held",
        /// Reset after a latched hold: waits for `enable`. Holds, if powered.
        Standby = "standby",
        /// Moved by hand, or by its own controller: gets no setpoints. Ended by `enable`, `disable` or a stop.
        Led = "led",
    }
}

named! {
    /// What moves an arm in [`Phase::Led`].
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "snake_case")]
    pub enum LedBy {
        /// A hand, with the motors on: the controller compensates gravity.
        Hand = "hand",
        /// A hand, with the motors off: the arm is supported by that hand only.
        HandMotorsOff = "hand_motors_off",
        /// Its controller, to a pose that it was given.
        Controller = "controller",
    }
}

/// Age of a state and its limit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Age {
    /// Age without this computer's own delays [µs].
    pub age_us: u32,
    /// Its limit [µs].
    pub limit_us: u32,
    /// Time during which this computer's threads could not run [µs].
    pub own_us: u32,
}

/// Why an arm is held.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub enum Cause {
    /// No cause.
    #[default]
    None,
    /// An operator's `stop`.
    Operator,
    /// No state for longer than its age limit.
    Stale(Age),
    /// The arm reports an error.
    Fault(i32),
    /// The device thread lost the connection to the arm.
    LinkLost,
    /// A command was not finite.
    NonFinite,
    /// A command jumped by more than a joint's limit.
    Jump,
    /// The tick skipped too much time.
    Overrun,
    /// The device thread held the arm on its own.
    HeartbeatLost,
    /// The motors were disabled unexpectedly.
    PowerLost,
    /// A joint of the arm (counted from 0) has this tracking error, compared with its setpoints of the last `lag`
    /// seconds [rad, or rad/s in velocity mode].
    Tracking(u16, f64),
    /// The measured position of a joint jumped by this much [rad].
    PositionJump(u16, f64),
    /// The measured position of a joint is off by whole turns: its step [rad].
    TurnLost(u16, f64),
    /// A joint crossed the seam of its encoder under power.
    SeamCrossed(u16),
    /// Position and velocity of a joint contradict each other by this much [rad].
    ReadingInconsistent(u16, f64),
    /// The reading of a joint moved by this much with its setpoint, without coming nearer to it [rad].
    ReadingFollows(u16, f64),
    /// A joint is to start at the first position and is at the second one, and nothing explains the difference [rad].
    StartMismatch(u16, f64, f64),
    /// A joint is this far outside its range, beyond what the arm may be enabled at [rad].
    OutsideRange(u16, f64),
    /// After a gap in its setpoints the arm did not stop where its motion could continue: the joint, how far it is
    /// from there [rad], and the time since the last setpoint [s].
    Gap(u16, f64, f64),
    /// The arm's adapter refused a setpoint.
    SetpointRefused,
    /// A joint of the arm moved this far while the arm was being enabled [rad].
    MovedWhileActivating(u16, f64),
    /// The arm's controller moved a joint (counted from 0) at this velocity, beyond 1.1 times its limit [rad/s].
    LedTooFast(u16, f64),
    /// The arm's controller moved a joint (counted from 0) to this position, outside its range [rad].
    LedOutOfRange(u16, f64),
    /// A joint moved at this velocity in impedance mode, beyond 1.1 times its limit [rad/s].
    TooFast(u16, f64),
    /// A joint no longer answers: its motor is lost.
    JointLost(u16),
    /// The arm is in a mode that this run did not order.
    ModeChanged,
    /// The motors were enabled, and not by this run.
    PowerChanged,
    /// The arm was stopped, paused or reset, and not by this run.
    StoppedElsewhere,
    /// Another arm than the one of the run answers.
    IdentityChanged,
    /// The limits of the arm's controller have become narrower than those of the run.
    LimitsChanged,
    /// A gripper with its own connection is lost, with what it holds.
    ToolLost,
    /// The arm's stop input is open.
    StopInput,
    /// Something appeared in the way of its motion, and it could not rest before it.
    WayBlocked,
    /// The run is shutting down.
    Shutdown,
}

impl Cause {
    /// Returns whether a panel, a person or another program controls the arm: it then gets neither setpoints nor a
    /// stop.
    pub fn is_foreign(self) -> bool {
        matches!(self, Self::ModeChanged | Self::PowerChanged | Self::StoppedElsewhere)
    }

    /// Returns whether what follows the arm stops with it: a person has stopped it, or something is in its way.
    pub fn stops_followers(self) -> bool {
        matches!(self, Self::Operator | Self::StopInput | Self::WayBlocked)
    }

    /// Returns its name in rpc and logs.
    pub fn name(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::Operator => "operator_stop",
            Self::Stale(_) => "stale",
            Self::Fault(_) => "arm_fault",
            Self::LinkLost => "link_lost",
            Self::NonFinite => "non_finite_command",
            Self::Jump => "jump_refused",
            Self::Overrun => "overrun",
            Self::HeartbeatLost => "heartbeat_lost",
            Self::PowerLost => "power_lost",
            Self::Tracking(..) => "tracking",
            Self::PositionJump(..) => "position_jump",
            Self::TurnLost(..) => "turn_lost",
            Self::SeamCrossed(_) => "seam_crossed",
            Self::ReadingInconsistent(..) => "reading_inconsistent",
            Self::ReadingFollows(..) => "reading_follows",
            Self::StartMismatch(..) => "start_mismatch",
            Self::OutsideRange(..) => "outside_range",
            Self::Gap(..) => "gap",
            Self::SetpointRefused => "setpoint_refused",
            Self::MovedWhileActivating(..) => "moved_while_activating",
            Self::LedTooFast(..) => "led_too_fast",
            Self::TooFast(..) => "too_fast",
            Self::JointLost(_) => "joint_lost",
            Self::LedOutOfRange(..) => "led_out_of_range",
            Self::ModeChanged => "mode_changed",
            Self::PowerChanged => "power_changed",
            Self::IdentityChanged => "identity_changed",
            Self::LimitsChanged => "limits_changed",
            Self::ToolLost => "tool_lost",
            Self::StoppedElsewhere => "stopped_elsewhere",
            Self::StopInput => "stop_input",
            Self::WayBlocked => "way_blocked",
            Self::Shutdown => "shutdown",
        }
    }
}

named! {
    /// State of a task, with the reference system's names.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
    pub enum TaskState {
        /// Idle.
        #[default]
        Idle = "IDLE",
        /// In motion, or following a stream.
        Executing = "EXECUTING",
        /// Decelerating after a cancel.
        Cancelling = "CANCELLING",
        /// Reached its goal.
        Completed = "COMPLETED",
        /// Ended before its goal: cancelled, preempted, out of tolerance, or the arm was held.
        Aborted = "ABORTED",
        /// A command was rejected as unsafe for the arm.
        Fault = "FAULT",
    }
}

/// Reason of a task's state.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Reason {
    /// No reason.
    #[default]
    None,
    /// An operator's cancel.
    Cancelled,
    /// The rest of its motion was no longer known to be free.
    WayBlocked,
    /// No target within its timeout.
    Timeout,
    /// Its stream was ended by the client, or by an operator's cancel.
    StreamEnded,
    /// A joint was further from the path than the path tolerance: joint, error [rad].
    PathTolerance(u16, f64),
    /// A joint did not arrive within the goal time: joint, error [rad].
    GoalTolerance(u16, f64),
    /// A joint was at its goal and still moved after the goal time: joint, velocity [rad/s].
    GoalVelocity(u16, f64),
    /// Another task took a joint: the other task, the joint.
    Preempted(u16, u16),
    /// The arm is held: arm, cause.
    ArmHeld(u16, Cause),
    /// A command was not finite: joint.
    NonFinite(u16),
    /// A command jumped: joint, step [rad].
    Jump(u16, f64),
    /// The tracking error of a joint exceeded the task's tolerance: joint, error [rad].
    TrackingError(u16, f64),
    /// On its way to its leader.
    Approaching,
    /// It follows its leader.
    InStep,
    /// The position of its leader is unknown: the leader, why.
    LeaderLost(u16, Cause),
    /// A joint was too far from its leader's to approach it: joint, distance [rad].
    LeaderAway(u16, f64),
    /// The collision guard stopped the arm: the arm.
    Guarded(u16),
    /// After a gap in the setpoints a joint rested too far from the path to continue: joint, distance [rad], time since
    /// the last setpoint [s].
    Gap(u16, f64, f64),
    /// The client that sent its targets released the lease of the arm, or disconnected: the arm.
    LeaseEnded(u16),
    /// A condition that was awaited ended it before its goal: the condition, what was measured [N, Nm, m, s, or 1 for a
    /// high input].
    Until(Condition, f64),
    /// A condition that was awaited could not be judged any longer: the arm that it is about, the condition.
    Unsensed(u16, Condition),
}

/// Two things that the collision guard keeps apart.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Guarded {
    /// A link.
    pub link: Label,
    /// Another link, or an obstacle.
    pub other: Label,
    /// Their distance at the setpoints [m]; a lower bound.
    pub distance: f64,
}

/// What limits the motion of a task.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Bound {
    /// Nothing.
    #[default]
    None,
    /// The velocity limit of this joint.
    Velocity(u16),
    /// A position limit of this joint.
    Position(u16),
    /// The acceleration limit of this joint.
    Acceleration(u16),
    /// A singularity nearby.
    Singularity,
    /// Its target or its state is not finite.
    Invalid,
    /// The collision guard.
    Guard(Guarded),
    /// The speed limit of the tool.
    Tool,
}

named! {
    /// Effect of a limit on a command.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum LimitKind {
        /// Position held inside its range.
        Position = "position",
        /// Velocity reduced.
        Velocity = "velocity",
        /// Acceleration reduced.
        Acceleration = "acceleration",
        /// Velocity of all joints reduced: the tool would be too fast.
        Tool = "tool speed",
        /// Effort reduced.
        Effort = "effort",
    }
}

/// An event of a tick. Indices are those of the blueprint: arms, tasks, joints (over all arms).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Event {
    /// A request was handled: id and outcome.
    Request(u64, Outcome),
    /// A task changed its state.
    Task(u16, TaskState, Reason),
    /// A task lost a joint: loser, winner, joint, whether both have the same priority.
    Preempted(u16, u16, u16, bool),
    /// A task's command was rejected because a task with priority on the same arm uses another mode: loser, winner,
    /// arm.
    ModeConflict(u16, u16, u16),
    /// An arm changed its phase.
    Arm(u16, Phase, Cause),
    /// A joint's commands began to be limited: joint, limit, commanded value [rad, rad/s, rad/s² or Nm].
    Limited(u16, LimitKind, f64),
    /// Periods were skipped: number, lateness of the tick [ns].
    Overrun(u32, u64),
    /// The speed override changed: the fraction, and whether all motions are paused.
    Speed(f64, bool),
    /// Ten consecutive ticks were late by a period or more.
    Degraded,
    /// The collision guard begins to decelerate an arm, or releases it: the arm, what it keeps apart.
    Guard(u16, Option<Guarded>),
}

/// Outcome of a request, with the reference system's names where they exist.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// Accepted.
    Accepted,
    /// The motion is being cancelled.
    Cancelled,
    /// There was no motion to cancel.
    AlreadyStopped,
    /// The task is already executing: the task.
    AlreadyExecuting(u16),
    /// The trajectory does not start where the arm is: joint, distance [rad].
    StartStateMismatch(u16, f64),
    /// No recent state of the arm: the arm.
    StartStateUnavailable(u16),
    /// The arm is not ready for motion: arm, its phase and cause.
    ArmNotReady(u16, Phase, Cause),
    /// The arm still moves: the arm.
    ArmMoving(u16),
    /// Motions are paused, and the request is for one that cannot wait.
    Paused,
    /// The arm's latch must be reset first: arm, cause.
    ArmLatched(u16, Cause),
    /// The cause of the arm's latch persists: arm, cause.
    StillFaulted(u16, Cause),
    /// The task does not support the request.
    WrongTask(u16),
    /// A target is not finite: joint.
    NonFinite(u16),
    /// A target is outside the joint's limits: joint, by how much [rad or rad/s].
    OutOfLimits(u16, f64),
    /// A target of a stream is further from the one before than the joint gets in that time: joint, step [rad].
    OutOfReach(u16, f64),
    /// A gripper position is not finite, or an opening negative: the arm, the position [m or rad].
    GripperOutOfLimits(u16, f64),
    /// A gripper force is outside its range: the arm, the force [N or Nm].
    GripperForceOutOfLimits(u16, f64),
    /// The gripper has no force control: the arm.
    NoGripperForce(u16),
    /// The gripper takes no speed, or not this one: the arm.
    NoGripperSpeed(u16),
    /// The target is not finite, or its orientation is invalid: the task.
    InvalidTarget(u16),
    /// The arm has no gripper: the arm.
    NoGripper(u16),
    /// The arm was interrupted after the motion had been requested: the arm, by what first.
    Superseded(u16, Interruption),
    /// The run is shutting down.
    ShuttingDown,
}

impl Outcome {
    /// Returns its status word in rpc and logs.
    pub fn name(self) -> &'static str {
        match self {
            Self::Accepted => "ACCEPTED",
            Self::Cancelled => "CANCELLED",
            Self::AlreadyStopped => "ALREADY_STOPPED",
            Self::AlreadyExecuting(_) => "ALREADY_EXECUTING",
            Self::StartStateMismatch(..) => "START_STATE_MISMATCH",
            Self::StartStateUnavailable(_) => "START_STATE_UNAVAILABLE",
            Self::ArmNotReady(..) => "ARM_NOT_READY",
            Self::ArmMoving(..) => "ARM_MOVING",
            Self::Paused => "PAUSED",
            Self::ArmLatched(..) => "ARM_LATCHED",
            Self::StillFaulted(..) => "STILL_FAULTED",
            Self::WrongTask(_) => "WRONG_TASK",
            Self::NonFinite(_) => "NON_FINITE",
            Self::OutOfLimits(..) | Self::GripperOutOfLimits(..) | Self::GripperForceOutOfLimits(..) => "OUT_OF_LIMITS",
            Self::NoGripperForce(_) | Self::NoGripperSpeed(_) => "UNSUPPORTED",
            Self::OutOfReach(..) => "OUT_OF_REACH",
            Self::InvalidTarget(_) => "INVALID_TARGET",
            Self::NoGripper(_) => "NO_GRIPPER",
            Self::Superseded(..) => "SUPERSEDED",
            Self::ShuttingDown => "SHUTTING_DOWN",
        }
    }
}

/// Published state of a task.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TaskView {
    /// Its state.
    pub state: TaskState,
    /// Its reason.
    pub reason: Reason,
    /// Id of its current or latest motion; 0 = none yet.
    pub motion: u64,
    /// Part of the motion completed (0–1).
    pub progress: f64,
    /// Time along the motion [s].
    pub elapsed: f64,
    /// Remaining time of the motion [s].
    pub remaining: f64,
    /// What limits its motion: where the task knows, else the first of its joints whose commands are limited.
    pub bound: Bound,
    /// Largest distance of a joint from its leader's, while it follows one [rad].
    pub distance: Option<f64>,
}

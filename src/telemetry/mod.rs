//! What the tick tells about itself: plain data of fixed size, pushed into one ring, read by the recorder thread,
//! which logs it, and hands events on to rpc and the text log. Nothing here allocates.

pub mod describe;

use crate::arm::{ArmCommand, ArmState};
use crate::clock::Mono;
use crate::named::named;

/// One entry of the ring.
// The ring holds values: a box would be an allocation in the tick.
#[allow(clippy::large_enum_variant)]
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Sample {
    /// What a tick read of one arm and what it commands. One per arm and tick, before the tick's `Tick`.
    Arm(ArmSample),
    /// Closes a tick.
    Tick(TickSample),
    /// Something happened in the tick with this index.
    Event(u64, Event),
}

/// What a tick read of one arm and what it commands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ArmSample {
    /// Index of the arm, in the blueprint's order.
    pub arm: u16,
    /// The state as the tick read it (with estimated velocities filled in).
    pub state: ArmState,
    /// The command as it went to the device thread.
    pub command: ArmCommand,
    /// The arm's phase after the tick.
    pub phase: Phase,
    /// Why it is in that phase.
    pub cause: Cause,
}

/// Timing of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TickSample {
    /// Index of the tick, counted from 0.
    pub tick: u64,
    /// The tick's deadline: the time it works with.
    pub deadline: Mono,
    /// When it took the next tick to be due.
    pub next: Mono,
    /// Wake-up after the deadline [ns].
    pub late_ns: u64,
    /// Time from wake-up to the last command handed over [ns].
    pub compute_ns: u64,
    /// Whole periods skipped before this tick.
    pub skipped: u32,
    /// The lateness that cost them [ns]: of this tick or of the one before.
    pub overrun_ns: u64,
    /// Samples that found the ring full since the last tick that got through.
    pub dropped: u32,
}

named! {
    /// What an arm is ready for.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
    pub enum Phase {
        /// No state yet.
        #[default]
        Unknown = "unknown",
        /// Motors off: nothing is sent.
        Disabled = "disabled",
        /// Just enabled: holds where it is, for the length of the ramp.
        Activating = "activating",
        /// Holds or follows its tasks.
        Ready = "ready",
        /// Latched hold after a stop or a fault: waits for `reset`.
        Held = "held",
        /// Reset after a latched hold: waits for `enable`. Holds, if powered.
        Standby = "standby",
    }
}

/// Age of a state, and what it is compared with.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Age {
    /// Age without this computer's own delays [µs].
    pub age_us: u32,
    /// Its limit [µs].
    pub limit_us: u32,
    /// Time in which this computer's threads could not run [µs].
    pub own_us: u32,
}

/// Why an arm is held.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Cause {
    /// Nothing happened.
    #[default]
    None,
    /// An operator's `stop`.
    Operator,
    /// No state for longer than its age limit.
    Stale(Age),
    /// The arm reports an error.
    Fault(i32),
    /// The device thread lost the arm.
    LinkLost,
    /// A command was not finite.
    NonFinite,
    /// A command jumped further than a joint may.
    Jump,
    /// The tick lost too much time.
    Overrun,
    /// The device thread held the arm by itself.
    HeartbeatLost,
    /// The motors went off without being asked.
    PowerLost,
    /// A joint of the arm (counted from 0) is this far from its set points of the last `lag` seconds [rad, or rad/s in
    /// velocity mode].
    Tracking(u16, f64),
    /// A joint of the arm was measured this far from where it can be [rad].
    PositionJump(u16, f64),
    /// A joint of the arm moved this far while the arm was being enabled [rad].
    MovedWhileActivating(u16, f64),
    /// The arm is in a mode that this run did not order.
    ModeChanged,
    /// The motors were enabled, and not by this run.
    PowerChanged,
    /// The arm was stopped, paused or reset, and not by this run.
    StoppedElsewhere,
    /// The run is ending.
    Shutdown,
}

impl Cause {
    /// Whether a panel, a person or another program has the arm: it then gets neither set points nor a stop.
    pub fn is_foreign(self) -> bool {
        matches!(self, Self::ModeChanged | Self::PowerChanged | Self::StoppedElsewhere)
    }

    /// The name used in rpc and logs.
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
            Self::MovedWhileActivating(..) => "moved_while_activating",
            Self::ModeChanged => "mode_changed",
            Self::PowerChanged => "power_changed",
            Self::StoppedElsewhere => "stopped_elsewhere",
            Self::Shutdown => "shutdown",
        }
    }
}

named! {
    /// State of a task, with the reference system's names.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
    pub enum TaskState {
        /// Nothing to do.
        #[default]
        Idle = "IDLE",
        /// In motion, or following a stream.
        Executing = "EXECUTING",
        /// Slowing down after a cancel.
        Cancelling = "CANCELLING",
        /// Ended where it should.
        Completed = "COMPLETED",
        /// Ended elsewhere.
        Aborted = "ABORTED",
        /// A command of it was refused as unfit for the arm.
        Fault = "FAULT",
    }
}

/// Why a task is in its state.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Reason {
    /// Nothing special.
    #[default]
    None,
    /// An operator's cancel.
    Cancelled,
    /// Its stream of targets stopped.
    Timeout,
    /// Its stream of targets was ended by whom it came from, or by an operator's cancel.
    StreamEnded,
    /// A joint was further from the path than the path tolerance: joint, error [rad].
    PathTolerance(u16, f64),
    /// A joint did not arrive within the goal time: joint, error [rad].
    GoalTolerance(u16, f64),
    /// Another task took a joint: the other task, the joint.
    Preempted(u16, u16),
    /// The arm is held: arm, cause.
    ArmHeld(u16, Cause),
    /// A command was not finite: joint.
    NonFinite(u16),
    /// A command jumped: joint, step [rad].
    Jump(u16, f64),
    /// A joint was further from where it was commanded to be than the task allows: joint, error [rad].
    TrackingError(u16, f64),
}

/// What holds an end effector back.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Bound {
    /// Nothing.
    #[default]
    None,
    /// The highest speed of this joint.
    Velocity(u16),
    /// The end of this joint's range.
    Position(u16),
    /// The arm is close to a singular configuration.
    Singularity,
    /// Its target or its state is nothing to compute with.
    Invalid,
}

named! {
    /// What a limit did to a command.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum LimitKind {
        /// Position held inside its range.
        Position = "position",
        /// Velocity reduced.
        Velocity = "velocity",
        /// Acceleration reduced.
        Acceleration = "acceleration",
    }
}

/// Something that happened in a tick. Indices are those of the blueprint: arms, tasks, joints (over all arms).
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Event {
    /// A request was handled: its id and what came of it.
    Request(u64, Outcome),
    /// A task changed its state.
    Task(u16, TaskState, Reason),
    /// A task lost a joint: loser, winner, joint, whether both have the same priority.
    Preempted(u16, u16, u16, bool),
    /// A task's command was refused because a better one on the same arm uses another mode: loser, winner, arm.
    ModeConflict(u16, u16, u16),
    /// An arm changed its phase.
    Arm(u16, Phase, Cause),
    /// Commands of a joint began to be limited: joint, which limit, what was asked [rad, rad/s or rad/s²].
    Limited(u16, LimitKind, f64),
    /// Periods were skipped: how many, how late the tick was [ns].
    Overrun(u32, u64),
    /// Ten ticks in a row were late by a period or more.
    Degraded,
}

/// What came of a request, with the reference system's names where it has one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Outcome {
    /// Taken on.
    Accepted,
    /// Motion is being ended.
    Cancelled,
    /// There was no motion to end.
    AlreadyStopped,
    /// The task is executing already: the task.
    AlreadyExecuting(u16),
    /// The trajectory does not start where the arm is: joint, distance [rad].
    StartStateMismatch(u16, f64),
    /// No fresh state of the arm: the arm.
    StartStateUnavailable(u16),
    /// The arm is not ready for motion: arm, its phase and cause.
    ArmNotReady(u16, Phase, Cause),
    /// The arm's latch must be reset first: arm, cause.
    ArmLatched(u16, Cause),
    /// The thing that latched the arm still stands: arm, cause.
    StillFaulted(u16, Cause),
    /// The task cannot do that.
    WrongTask(u16),
    /// A target is not finite: joint.
    NonFinite(u16),
    /// A target is outside the joint's limits: joint, by how much [rad or rad/s].
    OutOfLimits(u16, f64),
    /// The target is not finite, or its orientation is none: the task.
    InvalidTarget(u16),
    /// The arm has no gripper: the arm.
    NoGripper(u16),
    /// The run is ending.
    ShuttingDown,
}

impl Outcome {
    /// The status word used in rpc and logs.
    pub fn name(self) -> &'static str {
        match self {
            Self::Accepted => "ACCEPTED",
            Self::Cancelled => "CANCELLED",
            Self::AlreadyStopped => "ALREADY_STOPPED",
            Self::AlreadyExecuting(_) => "ALREADY_EXECUTING",
            Self::StartStateMismatch(..) => "START_STATE_MISMATCH",
            Self::StartStateUnavailable(_) => "START_STATE_UNAVAILABLE",
            Self::ArmNotReady(..) => "ARM_NOT_READY",
            Self::ArmLatched(..) => "ARM_LATCHED",
            Self::StillFaulted(..) => "STILL_FAULTED",
            Self::WrongTask(_) => "WRONG_TASK",
            Self::NonFinite(_) => "NON_FINITE",
            Self::OutOfLimits(..) => "OUT_OF_LIMITS",
            Self::InvalidTarget(_) => "INVALID_TARGET",
            Self::NoGripper(_) => "NO_GRIPPER",
            Self::ShuttingDown => "SHUTTING_DOWN",
        }
    }
}

/// What is told of a task.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TaskView {
    /// What it does.
    pub state: TaskState,
    /// Why.
    pub reason: Reason,
    /// Id of its present or last motion; 0 = none yet.
    pub motion: u64,
    /// How much of the motion is done (0–1).
    pub progress: f64,
    /// Time along the motion [s].
    pub elapsed: f64,
    /// Time to the motion's end [s].
    pub remaining: f64,
    /// What holds its end effector back, while it moves one.
    pub bound: Bound,
}

//! The part of a task that differs from type to type: a body that takes targets and claims joints in every tick.
//!
//! A body runs on the real-time thread: it never allocates, locks, logs, does I/O or panics. It holds plain data only.
//! The coordinator keeps the motion of a trajectory and frees it on another thread.

use super::request::{Goal, Motion};
use super::task_robot::FramePose;
use dimos_core::clock::Mono;
use dimos_core::joint::Joints;
use dimos_core::telemetry::{Cause, Outcome, Reason, TaskState, TaskView};
use dimos_core::until::Sensed;

/// State and limits of a joint, as a task sees them.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct JointView {
    /// Measured position [rad].
    pub position: f64,
    /// Measured or estimated velocity [rad/s].
    pub velocity: f64,
    /// Measured effort [Nm or N]; `None`: the arm reports none, or the joint's motor does not answer.
    pub effort: Option<f64>,
    /// Last commanded position [rad].
    pub commanded: f64,
    /// Last commanded velocity [rad/s], in the time that passes here: a controller that slows its arm has its own.
    pub commanded_velocity: f64,
    /// Lowest commanded position [rad].
    pub lower: f64,
    /// Highest commanded position [rad].
    pub upper: f64,
    /// Effort of the last command beside the arm's own control [Nm or N]; `None`: none was commanded.
    pub commanded_effort: Option<f64>,
    /// Highest effort of commands [Nm or N]; `None`: the arm is commanded none.
    pub effort_limit: Option<f64>,
    /// Acceleration limit [rad/s²].
    pub acceleration: f64,
    /// Velocity limit [rad/s].
    pub velocity_limit: f64,
    /// Jerk limit [rad/s³].
    pub jerk: f64,
    /// Distance of the joint from the range of its setpoints of the last `lag` seconds [rad].
    pub tracking_error: f64,
    /// How far a joint that droops may be read from its setpoint at rest [rad]; 0 for one that does not.
    pub droop: f64,
    /// Fraction of its speed at which the arm's controller runs motions, if it reports one.
    pub speed_fraction: Option<f64>,
    /// Index of its arm.
    pub arm: u16,
    /// When position and velocity were measured.
    pub stamp: Mono,
    /// Why they are not those of the joint at present: no recent state, a lost connection, an error of the arm; or that
    /// a person has stopped the arm.
    pub fault: Cause,
}

/// Context of a call of a body.
#[derive(Debug, Clone, Copy)]
pub struct Context<'a> {
    /// The tick's time.
    pub now: Mono,
    /// Length of the control step [s]; along a path in the arm's own time, which its controller may slow.
    pub dt: f64,
    /// Speed override: the fraction of its speed that a motion is to have, 0 while paused. A task that
    /// [applies it](TaskBody::applies_speed) changes to it within its limits.
    pub speed: f64,
    /// Fraction of the velocity limits of streams: follows `speed` smoothly.
    pub pace: f64,
    /// Index of the task, for outcomes that name it.
    pub task: u16,
    /// The task's joints: indices over all arms' joints, in the blueprint's order.
    pub joints: &'a [u16],
    /// Whether the task is active: executing or decelerating.
    pub active: bool,
    /// Whether all claims of the last tick were commanded.
    pub granted: bool,
    /// The motion of the last [`Target::Trajectory`], until the task ends.
    pub motion: Option<&'a Motion>,
    /// All joints of all arms.
    pub views: &'a [JointView],
    /// What each arm feels.
    pub sensed: &'a [Sensed],
}

impl Context<'_> {
    /// Returns the view of a joint; zeros for an index that does not exist.
    pub fn joint(&self, joint: u16) -> JointView {
        self.views.get(joint as usize).copied().unwrap_or_default()
    }

    /// Returns what an arm feels; nothing is known of one that does not exist.
    pub fn sensed(&self, arm: u16) -> Sensed {
        self.sensed.get(usize::from(arm)).copied().unwrap_or_default()
    }
}

/// Meaning of a task's claims.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Demand {
    /// The task claims nothing.
    #[default]
    Nothing,
    /// Joint positions [rad].
    Positions,
    /// Joint velocities [rad/s].
    Velocities,
    /// Joint positions [rad or m] that the arm yields from, as [`TaskBody::compliance`] says.
    Impedance,
}

/// How a joint yields in impedance mode. Its effort is `stiffness * (claimed - position) + damping * (velocity of the
/// claims - velocity) + effort`, plus what the arm is fed forward. With stiffness 0 the joint is commanded by its
/// effort alone.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Compliance {
    /// Stiffness [Nm/rad or N/m]; `None`: that with which the arm holds. Above the arm's highest, it is that one.
    pub stiffness: Option<f64>,
    /// Damping [Nm·s/rad or N·s/m]; `None`: that with which the arm holds.
    pub damping: Option<f64>,
    /// Effort [Nm or N], within the arm's limits of efforts and their rate.
    pub effort: f64,
}

impl Compliance {
    /// Returns whether it is made of numbers.
    pub fn is_finite(&self) -> bool {
        self.effort.is_finite() && [self.stiffness, self.damping].iter().flatten().all(|gain| gain.is_finite())
    }
}

/// Request of a task to one joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Claim {
    /// Index over all arms' joints.
    pub joint: u16,
    /// [rad], [m] or [rad/s], by the task's demand.
    pub value: f64,
}

/// Target that a client sends to a task.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Target<'a> {
    /// A motion to execute.
    Trajectory(&'a Motion),
    /// Positions of the task's joints, in their order [rad]; all finite.
    Positions(Joints),
    /// Velocities of the task's joints, in their order [rad/s]; all finite.
    Velocities(Joints),
    /// Points for the task's joints, in their order, from this time on.
    Chunk(&'a Motion, Mono),
    /// A pose or a twist of the end effector; any values.
    EndEffector(Goal),
    /// None: the task finds its targets itself.
    Start,
}

impl Target<'_> {
    /// Returns its kind.
    pub fn kind(&self) -> TargetKind {
        match self {
            Self::Trajectory(_) => TargetKind::Trajectory,
            Self::Positions(_) => TargetKind::Positions,
            Self::Velocities(_) => TargetKind::Velocities,
            Self::Chunk(..) => TargetKind::Chunk,
            Self::EndEffector(Goal::Pose { .. }) => TargetKind::Pose,
            Self::EndEffector(Goal::Twist { .. }) => TargetKind::Twist,
            Self::Start => TargetKind::Start,
        }
    }
}

/// Kinds of targets. Each has its own rpc method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TargetKind {
    /// A trajectory.
    Trajectory,
    /// Joint positions.
    Positions,
    /// Joint velocities.
    Velocities,
    /// Joint positions with times.
    Chunk,
    /// A pose of the end effector.
    Pose,
    /// A twist of the end effector.
    Twist,
    /// A start without a target.
    Start,
}

impl TargetKind {
    /// All kinds.
    pub const ALL: [Self; 7] =
        [Self::Trajectory, Self::Positions, Self::Velocities, Self::Chunk, Self::Pose, Self::Twist, Self::Start];

    /// Returns the rpc method that sends one.
    pub fn method(self) -> &'static str {
        match self {
            Self::Trajectory => "execute",
            Self::Positions => "servo",
            Self::Velocities => "velocity",
            Self::Chunk => "chunk",
            Self::Pose => "pose",
            Self::Twist => "twist",
            Self::Start => "start",
        }
    }
}

/// How a task continues after a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Step {
    /// It continues.
    Continue,
    /// It continues, and reports this reason from now on.
    ContinueFor(Reason),
    /// It has ended. The coordinator decelerates its joints to rest.
    End(TaskState, Reason),
}

/// What a task does on a cancel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnCancel {
    /// It ends; the coordinator decelerates its joints to rest.
    End,
    /// It decelerates along its path, then ends.
    Decelerate,
}

/// What a task does when a task of higher priority takes one of its joints.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnLoss {
    /// It ends.
    End,
    /// It continues with the other joints, and does not claim this one before its next target.
    Continue,
}

/// Behaviour of a task type. `crate::conformance` checks the rules.
pub trait TaskBody: std::fmt::Debug + Send {
    /// Takes a target, or rejects it with the outcome for the client. Called with the kinds of targets of the type
    /// only.
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome>;

    /// Rejects a trajectory that does not begin where the joints are. Takes nothing.
    fn check_start(&self, cx: &Context<'_>, motion: &Motion) -> Result<(), Outcome> {
        let _ = (cx, motion);
        Ok(())
    }

    /// Claims joints of the task for this tick, each at most once. Called while the task is active.
    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step;

    /// Returns how a joint that it has claimed in this tick yields. Called for types whose demand is
    /// [`Demand::Impedance`].
    fn compliance(&self, joint: u16) -> Compliance {
        let _ = joint;
        Compliance::default()
    }

    /// The task has ended: discards its target.
    fn end(&mut self);

    /// A client cancels the executing task.
    fn cancel(&mut self) -> OnCancel {
        OnCancel::End
    }

    /// A task of higher priority took `joint` of the task's `joints`.
    fn lose(&mut self, joints: &[u16], joint: u16) -> OnLoss {
        let _ = (joints, joint);
        OnLoss::End
    }

    /// Returns whether the body itself applies [`Context::speed`] or [`Context::pace`]. For one that does not,
    /// the velocity limits of its joints are scaled.
    fn applies_speed(&self) -> bool {
        false
    }

    /// No command reached an arm since the tick of `at`: continues from the command of that tick, from rest. The next
    /// tick is not granted: a body that integrates from [`JointView::commanded`] then needs nothing else.
    fn rewind(&mut self, at: Mono, now: Mono) {
        let _ = (at, now);
    }

    /// A gap has ended, and the arm rests where its joints are commanded: continues from the nearest point of the path
    /// since the tick of `at`, at rest. An error has the joint that is farther than `tolerance` [rad] from the path,
    /// and its distance. A body without a path continues from where the joints are.
    fn rejoin(&mut self, cx: &Context<'_>, at: Mono, tolerance: f64) -> Result<(), (u16, f64)> {
        let _ = (cx, at, tolerance);
        Ok(())
    }

    /// Returns the target with which a task with `auto_start` begins; `None`: it waits for a client.
    fn first_target(&self) -> Option<Target<'static>> {
        None
    }

    /// Returns whether the gripper of the task's arm now follows that of the leader.
    fn follows_gripper(&self) -> bool {
        false
    }

    /// Replaces the tool of the end effector; `false`: the type moves none. Called only while the task is not active.
    fn set_tool(&mut self, tool: &FramePose) -> bool {
        let _ = tool;
        false
    }

    /// Adds to the status: motion, progress, the limit that slows the end effector.
    fn describe(&self, view: &mut TaskView) {
        let _ = view;
    }
}

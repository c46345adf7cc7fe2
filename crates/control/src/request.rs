//! Requests to the coordinator. They arrive through a ring. The tick frees nothing: a motion that ended leaves it
//! through [`TickOutput::retired`](super::coordinator::TickOutput).

use super::task_robot::FramePose;
use dimos_core::clock::Mono;
use dimos_core::joint::Joints;
use dimos_core::telemetry::{LedBy, Origin};
use dimos_core::trajectory::Spline;
use dimos_core::until::Until;

/// A request with its id. `Event::Request` with the same id has the outcome.
#[derive(Debug)]
pub struct Envelope {
    /// Chosen by the sender; increases.
    pub id: u64,
    /// When and by whom it was requested; `None`: what interrupted an arm since is not compared.
    pub origin: Option<Origin>,
    /// The request.
    pub request: Request,
}

/// Request to the coordinator. Indices are those of the configuration.
#[derive(Debug)]
pub enum Request {
    /// Execute a motion by a trajectory task.
    Execute {
        /// The task.
        task: u16,
        /// The motion.
        motion: Box<Motion>,
    },
    /// Decelerate and end the motion of a task, or of all.
    Cancel {
        /// The task; `None`: all.
        task: Option<u16>,
    },
    /// The rest of a motion is no longer known to be free: something is in its way, or it could not be checked. It
    /// decelerates along its path if it rests in time, else its arms are held.
    WayBlocked {
        /// Its task.
        task: u16,
        /// Its number: another motion of the task continues.
        motion: u64,
        /// Whether it rests in time.
        in_time: bool,
    },
    /// New target of a servo task [rad], in the order of the task's joints.
    Servo {
        /// The task.
        task: u16,
        /// Positions [rad].
        target: Joints,
    },
    /// New target of a velocity task [rad/s], in the order of the task's joints.
    Velocity {
        /// The task.
        task: u16,
        /// Velocities [rad/s].
        target: Joints,
    },
    /// New chunk of a chunk task.
    Chunk {
        /// The task.
        task: u16,
        /// The time of its first point.
        start: Mono,
        /// Its curve; the points are equally spaced in time. The task copies it.
        motion: Box<Motion>,
    },
    /// New goal of a Cartesian task: a pose or a twist, by the task's type.
    CartesianTarget {
        /// The task.
        task: u16,
        /// The goal.
        goal: Goal,
    },
    /// Start a task that takes no targets.
    Start {
        /// The task.
        task: u16,
    },
    /// Another tool for the end effector of a Cartesian task that is not active.
    Tool {
        /// The task.
        task: u16,
        /// Pose of the tool centre point in the frame of the task's link.
        tool: FramePose,
    },
    /// Another tool at an arm whose tool has a speed limit.
    ArmTool {
        /// The arm.
        arm: u16,
        /// Pose of the tool centre point in the frame of the link that carries it.
        tool: FramePose,
    },
    /// Latch the hold of an arm, or of all.
    Stop {
        /// The arm; `None`: all.
        arm: Option<u16>,
    },
    /// Clear an arm's latch. Moves nothing.
    Reset {
        /// The arm.
        arm: u16,
    },
    /// The arm was enabled: hold it at its position, then accept motion.
    Enabled {
        /// The arm.
        arm: u16,
        /// Whether it may rest outside its position limits.
        outside: bool,
    },
    /// The arm will be disabled: decelerate it to rest and refuse motion. A led arm gets its own stop.
    PrepareDisable {
        /// The arm.
        arm: u16,
    },
    /// The arm will be led: it gets no more setpoints. It must be at rest, without an active task.
    Lead {
        /// The arm.
        arm: u16,
        /// What moves it.
        by: LedBy,
    },
    /// End the motion that an arm's own controller makes.
    EndNative {
        /// The arm.
        arm: u16,
    },
    /// Open or close a gripper.
    Gripper {
        /// The arm.
        arm: u16,
        /// Position [m, or rad for a rotary gripper].
        opening: f64,
        /// Largest force, in the gripper's force unit; `None`: the device's own.
        force: Option<f64>,
        /// Fraction of the gripper's top speed (0–1]; `None`: the device's own.
        speed: Option<f64>,
    },
    /// Set the speed override.
    Speed {
        /// Fraction of the speed, 0.01 to 1.
        fraction: f64,
    },
    /// Pause all motions on their paths, or resume them.
    Pause {
        /// Whether they are to pause.
        on: bool,
    },
    /// A client took the lease of an arm without a motion: what others have requested before does not move it.
    LeaseTaken {
        /// The arm.
        arm: u16,
        /// The client's connection.
        client: u64,
    },
    /// A client released the lease of an arm, or disconnected: its chunks end, and what it has requested before does
    /// not move the arm.
    LeaseEnded {
        /// The arm.
        arm: u16,
        /// The client's connection.
        client: u64,
    },
    /// The run shuts down: decelerate all arms to rest and refuse further requests.
    Shutdown,
}

/// A motion, ready to be sampled.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// Chosen by the sender, to ask for its state later.
    pub id: u64,
    /// The joints that move: indices over all arms' joints.
    pub joints: Vec<u16>,
    /// The trajectory of these joints.
    pub spline: Spline,
    /// What ends it before its goal.
    pub until: Option<Until>,
}

/// Requested pose or twist of an end effector.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Goal {
    /// A pose, in the frame that poses of the task are given in.
    Pose {
        /// x, y, z [m].
        position: [f64; 3],
        /// Quaternion x, y, z, w.
        orientation: [f64; 4],
    },
    /// A velocity.
    Twist {
        /// Of the origin [m/s].
        linear: [f64; 3],
        /// Angular [rad/s].
        angular: [f64; 3],
        /// Along the axes of the end effector itself, not of the base.
        tool: bool,
    },
}

//! Requests to the coordinator. They arrive through a ring; nothing in them is freed by the tick: a
//! trajectory that is done goes back through [`TickOutput::retired`](super::coordinator::TickOutput).

use crate::joint::Joints;
use crate::trajectory::Spline;

/// A request with its id. `Event::Request` with the same id has the outcome.
#[derive(Debug)]
pub struct Envelope {
    /// Chosen by the sender; increases.
    pub id: u64,
    /// What is asked.
    pub request: Request,
}

/// What can be asked of the coordinator. Indices are those of the configuration.
#[derive(Debug)]
pub enum Request {
    /// Execute a motion by a trajectory task.
    Execute {
        /// The task.
        task: u16,
        /// The motion.
        motion: Box<Motion>,
    },
    /// Slow down and end what a task does, or what all do.
    Cancel {
        /// The task; `None`: all.
        task: Option<u16>,
    },
    /// A new target of a servo task [rad], in the order of the task's joints.
    Servo {
        /// The task.
        task: u16,
        /// Positions [rad].
        target: Joints,
    },
    /// A new target of a velocity task [rad/s], in the order of the task's joints.
    Velocity {
        /// The task.
        task: u16,
        /// Velocities [rad/s].
        target: Joints,
    },
    /// A new goal of a Cartesian task: a pose, or a twist, as the task's type is.
    Steer {
        /// The task.
        task: u16,
        /// The goal.
        goal: Goal,
    },
    /// Latched hold of an arm, or of all.
    Stop {
        /// The arm; `None`: all.
        arm: Option<u16>,
    },
    /// Clear an arm's latch. Moves nothing.
    Reset {
        /// The arm.
        arm: u16,
    },
    /// The arm was enabled: hold it where it is, then let it move.
    Ready {
        /// The arm.
        arm: u16,
    },
    /// Bring the arm to rest and take no motion for it, because it will be disabled.
    Park {
        /// The arm.
        arm: u16,
    },
    /// Open or close a gripper.
    Gripper {
        /// The arm.
        arm: u16,
        /// Opening [m].
        opening: f64,
    },
    /// The run is ending: bring everything to rest, take nothing more.
    Shutdown,
}

/// A motion, ready to be sampled.
#[derive(Debug, Clone, PartialEq)]
pub struct Motion {
    /// Chosen by the sender, to ask for its state later.
    pub id: u64,
    /// The joints that move: indices over all arms' joints.
    pub joints: Vec<u16>,
    /// The curve, one joint each.
    pub spline: Spline,
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

//! What a coordinator is made from: arms, tasks and their parameters, resolved to indices and SI units.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::arm::Supervision;
use crate::joint::{ControlMode, JointLimits};
use crate::robot::kinematics::Kinematics;

/// A step of a command further than this from the one before it is refused [rad].
pub const JUMP: f64 = 0.2;
/// Commands stay this far inside the position limits [rad].
pub const POSITION_MARGIN: f64 = 0.01;
/// How long an arm only holds after it was enabled.
pub const ACTIVATION_RAMP: Duration = Duration::from_millis(200);

/// Version of the tick's rules. The same states and requests give the same commands only under the same version.
pub const CONTROL_VERSION: u32 = 2;

/// Logs without a version are of the first one.
fn first_version() -> u32 {
    1
}

/// Everything a coordinator knows beforehand.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CoordinatorConfig {
    /// Which rules its ticks follow, [`CONTROL_VERSION`] of the program that recorded it.
    #[serde(default = "first_version")]
    pub version: u32,
    /// Ticks per second [Hz].
    pub rate: f64,
    /// The arms, in the blueprint's order.
    pub arms: Vec<ArmConfig>,
    /// The tasks, in the blueprint's order.
    pub tasks: Vec<TaskConfig>,
}

impl CoordinatorConfig {
    /// Length of a period.
    pub fn period(&self) -> Duration {
        Duration::from_nanos((1e9 / self.rate).round() as u64)
    }
}

/// One arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ArmConfig {
    /// Its `hardware_id`.
    pub name: String,
    /// Number of joints.
    pub dof: usize,
    /// Effective limits, one entry per joint in every list.
    pub limits: JointLimits,
    /// The modes it can be commanded in.
    pub modes: Vec<ControlMode>,
    /// Whether it has a gripper.
    pub gripper: bool,
    /// Its own velocity limits, before the blueprint narrows them [rad/s]; empty: `limits` are its own.
    #[serde(default)]
    pub own_velocity: Vec<f64>,
    /// Period of the device's states, as the device thread reads them.
    #[serde(default)]
    pub read_period: Duration,
    /// Longest regular time between two set points on the wire; the tick's period where that is longer.
    #[serde(default)]
    pub write_period: Duration,
    /// Figures with which its measurements and its motion are checked.
    #[serde(default)]
    pub supervision: Supervision,
}

impl ArmConfig {
    /// The mode in which positions are streamed to it.
    pub fn position_mode(&self) -> Option<ControlMode> {
        [ControlMode::ServoPosition, ControlMode::Position].into_iter().find(|m| self.modes.contains(m))
    }
}

/// One task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskConfig {
    /// Its name.
    pub name: String,
    /// Its type and parameters.
    pub kind: TaskKind,
    /// Its joints: indices over all arms' joints, in the blueprint's order.
    pub joints: Vec<u16>,
    /// The higher one wins a joint.
    pub priority: i32,
    /// Whether it starts with the run.
    pub auto_start: bool,
}

/// Type of a task, with its parameters.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TaskKind {
    /// Executes trajectories.
    Trajectory(TrajectoryParams),
    /// Follows a stream of positions.
    Servo(ServoParams),
    /// Follows a stream of velocities.
    Velocity(VelocityParams),
    /// Takes an end effector to a stream of poses.
    CartesianIk(Box<CartesianParams>),
    /// Moves an end effector with a stream of twists.
    EefTwist(Box<CartesianParams>),
}

impl TaskKind {
    /// The name used in blueprints.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Trajectory(_) => "trajectory",
            Self::Servo(_) => "servo",
            Self::Velocity(_) => "velocity",
            Self::CartesianIk(_) => "cartesian_ik",
            Self::EefTwist(_) => "eef_twist",
        }
    }
}

/// Parameters of a trajectory task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrajectoryParams {
    /// How far the first point may be from the arm [rad].
    pub start_position_tolerance: f64,
    /// How far the arm may be from its set points of the last `lag` seconds while it moves [rad]; 0 = not checked.
    pub path_tolerance: f64,
    /// How near the arm must come to the goal [rad].
    pub goal_tolerance: f64,
    /// How long it may take to arrive after the trajectory's end [s].
    pub goal_time: f64,
}

impl Default for TrajectoryParams {
    fn default() -> Self {
        Self { start_position_tolerance: 0.05, path_tolerance: 0.1, goal_tolerance: 0.01, goal_time: 2.0 }
    }
}

/// Parameters of a servo task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ServoParams {
    /// How long a target stands without a new one [s]; 0 = for ever.
    pub timeout: f64,
    /// Where the task takes its joints when it starts by itself [rad].
    pub default_positions: Option<Vec<f64>>,
}

impl Default for ServoParams {
    fn default() -> Self {
        Self { timeout: 0.5, default_positions: None }
    }
}

/// Parameters of a velocity task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct VelocityParams {
    /// How long a target stands without a new one [s]; 0 = for ever.
    pub timeout: f64,
    /// After the timeout: keep the joints at zero velocity, or let them go.
    pub zero_on_timeout: bool,
}

impl Default for VelocityParams {
    fn default() -> Self {
        Self { timeout: 0.2, zero_on_timeout: true }
    }
}

/// Parameters of a Cartesian task, and the robot that it moves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CartesianParams {
    /// How long a target stands without a new one [s]; 0 = for ever.
    pub timeout: f64,
    /// Highest speed of the end effector's origin [m/s].
    pub max_linear_velocity: f64,
    /// Highest angular speed of the end effector [rad/s].
    pub max_angular_velocity: f64,
    /// Highest acceleration of the end effector's origin [m/s²].
    pub max_linear_acceleration: f64,
    /// Highest angular acceleration of the end effector [rad/s²].
    pub max_angular_acceleration: f64,
    /// A joint that is further than this from where it is commanded to be ends the motion [rad].
    pub max_tracking_error: f64,
    /// The robot's kinematics, for the joints of the task in the task's order.
    pub kinematics: Kinematics,
    /// The end effector: index of its link.
    pub link: usize,
    /// Where the model's root is in the frame that poses are given in.
    pub root: Place,
    /// The base whose axes twists are along, in the frame of the model's root: quaternion x, y, z, w.
    pub base: [f64; 4],
}

/// A frame in another.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Place {
    /// x, y, z [m].
    pub position: [f64; 3],
    /// Quaternion x, y, z, w.
    pub orientation: [f64; 4],
}

/// The quaternion of no rotation.
pub const NO_ROTATION: [f64; 4] = [0.0, 0.0, 0.0, 1.0];

impl Place {
    /// The same frame.
    pub const SAME: Self = Self { position: [0.0; 3], orientation: NO_ROTATION };
}

impl CartesianParams {
    /// The defaults for a robot without anything around it.
    pub fn new(kinematics: Kinematics, link: usize) -> Self {
        Self {
            timeout: 0.3,
            max_linear_velocity: 0.25,
            max_angular_velocity: 1.0,
            max_linear_acceleration: 1.0,
            max_angular_acceleration: 4.0,
            max_tracking_error: 0.1745,
            kinematics,
            link,
            root: Place::SAME,
            base: NO_ROTATION,
        }
    }

    /// Says what of it cannot be worked with, for a task of so many joints.
    pub fn check(&self, joints: usize) -> Result<(), String> {
        let rates = [
            self.max_linear_velocity,
            self.max_angular_velocity,
            self.max_linear_acceleration,
            self.max_angular_acceleration,
            self.max_tracking_error,
        ];
        let turned = |q: &[f64; 4]| (0.9..1.1).contains(&q.iter().map(|v| v * v).sum::<f64>());
        match () {
            () if self.kinematics.dof() != joints => Err("its kinematics have other joints".to_owned()),
            () if self.link >= self.kinematics.links() => Err("its end effector does not exist".to_owned()),
            () if !rates.iter().all(|rate| *rate > 0.0) => Err("its limits leave no room to move".to_owned()),
            () if !turned(&self.base) || !turned(&self.root.orientation) => Err("a frame is not one".to_owned()),
            () => Ok(()),
        }
    }
}

//! What a coordinator is made from: arms, tasks and their parameters, resolved to indices and SI units.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::joint::{ControlMode, JointLimits};

/// A step of a command further than this from the one before it is refused [rad].
pub const JUMP: f64 = 0.2;
/// Commands stay this far inside the position limits [rad].
pub const POSITION_MARGIN: f64 = 0.01;
/// How long an arm only holds after it was enabled.
pub const ACTIVATION_RAMP: Duration = Duration::from_millis(200);

/// Everything a coordinator knows beforehand.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CoordinatorConfig {
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
    /// A state older than this is stale.
    pub state_timeout: Duration,
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
}

impl TaskKind {
    /// The name used in blueprints.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Trajectory(_) => "trajectory",
            Self::Servo(_) => "servo",
            Self::Velocity(_) => "velocity",
        }
    }
}

/// Parameters of a trajectory task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrajectoryParams {
    /// How far the first point may be from the arm [rad].
    pub start_position_tolerance: f64,
    /// How far the arm may be from the path while it moves [rad]; 0 = not checked.
    pub path_tolerance: f64,
    /// How near the arm must come to the goal [rad].
    pub goal_tolerance: f64,
    /// How long it may take to arrive after the trajectory's end [s].
    pub goal_time: f64,
}

impl Default for TrajectoryParams {
    fn default() -> Self {
        Self { start_position_tolerance: 0.05, path_tolerance: 0.2, goal_tolerance: 0.01, goal_time: 2.0 }
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

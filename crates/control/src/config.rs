//! What a coordinator is made from: arms and tasks, resolved to indices and SI units.

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_core::arm::{EffortLimits, GripperInfo, Impedance, Supervision};
use dimos_core::joint::{ControlMode, JointLimits};
use dimos_robot::dynamics::Dynamics;

pub use super::task_config::{TaskConfig, TaskKind};
pub use super::task_leader::LeaderJoint;
pub use super::task_robot::{FramePose, NO_ROTATION, TaskKinematics};
pub use super::tasks::cartesian::CartesianParams;
pub use super::tasks::chunk::ChunkParams;
pub use super::tasks::follow::FollowParams;
pub use super::tasks::servo::ServoParams;
pub use super::tasks::trajectory::TrajectoryParams;
pub use super::tasks::velocity::VelocityParams;
pub use super::tool_limit::ToolLimit;

/// A step of a command further than this from the one before it is refused [rad].
pub const JUMP: f64 = 0.2;
/// How long an arm only holds after it was enabled.
pub const ACTIVATION_RAMP: Duration = Duration::from_millis(200);

/// Config version: of the form of [`CoordinatorConfig`] and of the rules of the tick. The same configuration, states
/// and requests give the same commands only under the same version. Increase it with every change of either.
pub const CONFIG_VERSION: u32 = 9;

/// Config version of logs that have none.
pub const FIRST_CONFIG_VERSION: u32 = 1;

fn first_version() -> u32 {
    FIRST_CONFIG_VERSION
}

/// Configuration of a coordinator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CoordinatorConfig {
    /// [`CONFIG_VERSION`] of the program that made it.
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
    /// Units and ranges of that gripper.
    #[serde(default)]
    pub gripper_info: GripperInfo,
    /// Its own velocity limits, before the blueprint narrows them [rad/s]; empty: `limits` are its own.
    #[serde(default)]
    pub own_velocity: Vec<f64>,
    /// Period of the device's states, as the device thread reads them.
    #[serde(default)]
    pub read_period: Duration,
    /// Longest regular time between two setpoints on the wire; the tick's period where that is longer.
    #[serde(default)]
    pub write_period: Duration,
    /// Figures with which its measurements and its motion are checked.
    #[serde(default)]
    pub supervision: Supervision,
    /// The speed limit of its tool, if it has one and a model of the arm is known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tool: Option<Box<ToolLimit>>,
    /// What it is commanded beside positions; `None`: nothing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effort: Option<Box<EffortConfig>>,
}

/// What an arm is commanded beside positions.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EffortConfig {
    /// Limits of efforts.
    pub limits: EffortLimits,
    /// What is fed forward.
    #[serde(default)]
    pub feed_forward: FeedForward,
    /// What that is computed with: the arm with all that it carries, its gravity, and its joints in their order.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub dynamics: Option<Dynamics>,
    /// How it is held in impedance mode, if it has that.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub impedance: Option<Impedance>,
}

/// Efforts that an arm is given before its own control finds them from an error.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum FeedForward {
    /// None.
    #[default]
    None,
    /// Those that hold the arm against gravity.
    Gravity,
    /// Those of its motion: also inertia, centrifugal and Coriolis forces.
    Dynamics,
}

impl ArmConfig {
    /// An arm of two joints from -3 to 3 rad, with states and setpoints every 10 ms.
    #[cfg(test)]
    pub(super) fn of_two_joints(velocity: f64) -> Self {
        let period = Duration::from_millis(10);
        Self {
            name: "arm".into(),
            dof: 2,
            limits: JointLimits::uniform(2, 3.0, velocity).with_defaults(),
            modes: vec![ControlMode::ServoPosition, ControlMode::Velocity],
            gripper: false,
            gripper_info: GripperInfo::default(),
            own_velocity: Vec::new(),
            read_period: period,
            write_period: period,
            supervision: Supervision::default(),
            tool: None,
            effort: None,
        }
    }

    /// The mode in which positions are streamed to it.
    pub fn position_mode(&self) -> Option<ControlMode> {
        [ControlMode::ServoPosition, ControlMode::Position].into_iter().find(|m| self.modes.contains(m))
    }
}

//! The reply to `state`: joints and poses.

use nalgebra::Isometry3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_core::pose::{tcp_name, to_xyz_rpy};

/// Reply to `state`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StateReport {
    /// Index of the tick.
    pub tick: u64,
    /// Wall-clock time of the tick [s since the Unix epoch].
    pub stamp: f64,
    /// The arms, in the blueprint's order.
    pub arms: Vec<ArmStateReport>,
}

/// One arm in `state`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct ArmStateReport {
    /// Its `hardware_id` in the blueprint.
    pub hardware_id: String,
    /// Whether an emulator replaces it.
    pub simulated: bool,
    /// Age of its latest state [ms]; absent before the first.
    pub age_ms: Option<f64>,
    /// Fraction of its speed at which its controller runs motions at present (a speed slider, a safety function), 0–1;
    /// absent if it reports none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub speed_fraction: Option<f64>,
    /// Where its efforts come from: `measured` by sensors, `from_current` of the motors; absent if it does not say.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub effort_kind: Option<String>,
    /// Its joints, in order.
    pub joints: Vec<JointReport>,
    /// Gripper position [`gripper_unit`].
    pub gripper: Option<f64>,
    /// Unit of the gripper's position: `m` of opening, or `rad` of a rotary jaw; absent without a gripper.
    #[serde(default)]
    pub gripper_unit: Option<String>,
    /// Measured force of the gripper [`gripper_force_unit`]; absent if it measures none.
    #[serde(default)]
    pub gripper_force: Option<f64>,
    /// Unit of the gripper's force: `N`, `Nm` or `%`; absent without a gripper.
    #[serde(default)]
    pub gripper_force_unit: Option<String>,
    /// Pose of its tool centre point in `map`, computed from the measured joints; absent if the run has no model of it.
    pub pose: Option<PoseReport>,
    /// Pose of the flange in the arm's base, by the arm's own controller: the tool and base offsets that are set there
    /// are taken out. Absent if it reports no pose, or not these offsets: see `device_pose_missing`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device_pose: Option<PoseReport>,
    /// Pose of the controller's own tool centre point in its own reference frame, as its panel shows it; absent if it
    /// reports none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device_tool_pose: Option<PoseReport>,
    /// The offset that the controller does not report, so that its flange is not known: `tool offset`, `base offset`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub device_pose_missing: Option<String>,
    /// Force and torque [N, N, N, Nm, Nm, Nm].
    pub wrench: Option<[f64; 6]>,
}

/// One joint in `state`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct JointReport {
    /// Its name.
    pub name: String,
    /// Position [rad, or m for a linear joint]; absent before the first state, and while its motor does not answer.
    pub position: Option<f64>,
    /// Velocity [rad/s or m/s].
    pub velocity: Option<f64>,
    /// Source of the velocity: `measured`, `estimated`, `absent`.
    pub velocity_source: String,
    /// Effort [Nm, or N for a linear joint]; absent if the arm does not report it.
    pub effort: Option<f64>,
    /// Commanded value [rad, m, rad/s or m/s, by the arm's mode].
    pub command: Option<f64>,
    /// Effort that is commanded beside the arm's own control [Nm or N]; absent if none is.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub commanded_effort: Option<f64>,
}

/// A pose: of what, in which frame.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct PoseReport {
    /// The link of the model; in a device's own poses `flange` or `tool`.
    #[serde(default)]
    pub link: String,
    /// Tool on the link, whose centre point has the pose; absent: the link itself has it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tool: Option<ToolReport>,
    /// Reference frame: `map`; in a device's own poses `base` (the arm's) or `controller` (that of its controller).
    #[serde(default)]
    pub frame: String,
    /// x, y, z [m].
    pub xyz: [f64; 3],
    /// roll, pitch, yaw [rad], fixed axes.
    pub rpy: [f64; 3],
}

impl PoseReport {
    /// Returns whose pose it is, and in which frame: `link_tcp in map`.
    pub fn label(&self) -> String {
        format!("{} in {}", tcp_name(&self.link, self.tool.is_some()), self.frame)
    }
}

/// Pose of a tool centre point in the frame of its link.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct ToolReport {
    /// x, y, z [m].
    pub xyz: [f64; 3],
    /// roll, pitch, yaw [rad], fixed axes.
    pub rpy: [f64; 3],
}

impl From<&Isometry3<f64>> for ToolReport {
    fn from(tool: &Isometry3<f64>) -> Self {
        let (xyz, rpy) = to_xyz_rpy(tool);
        Self { xyz, rpy }
    }
}

/// The point whose pose is an arm's.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TcpReport {
    /// The end-effector link of the model.
    pub link: String,
    /// The tool on it; absent: the point is the link's origin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tool: Option<ToolReport>,
}

impl TcpReport {
    /// Returns the point's name: `link_tcp`, or `the tool on link_tcp`.
    pub fn name(&self) -> String {
        tcp_name(&self.link, self.tool.is_some())
    }
}

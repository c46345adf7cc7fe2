//! The robot whose end effector a task moves: its parameters in the blueprint, and its kinematics for the tick.

use std::collections::BTreeMap;

use glamx::{DAffine3, DQuat, DVec3};
use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use dimos_robot::kinematics::Kinematics;
use dimos_yaml::Text;

/// The parameters that name a task's robot, read from among all its parameters. A type with `robot: true` has keys of
/// these names and forms.
#[derive(Debug, Clone, PartialEq, Default, Deserialize)]
#[serde(default)]
pub struct RobotParams {
    /// The robot's `.urdf` or `.xacro` file, or `builtin:NAME`.
    pub model_path: Option<String>,
    /// Folders of `package://NAME`, by name.
    pub package_paths: BTreeMap<String, String>,
    /// Arguments of the xacro file.
    pub xacro_args: BTreeMap<String, Text>,
    /// The link that the task moves.
    pub end_effector_link: Option<String>,
    /// The coordinator's joint `{joint_prefix}{joint}` is the model's `{joint}`.
    pub joint_prefix: Option<String>,
    /// The coordinator's joint names and the model's.
    pub joint_name_mapping: BTreeMap<String, String>,
    /// Positions of joints that the task does not move, by the model's names [rad or m].
    pub fixed_joints: BTreeMap<String, f64>,
}

/// The kinematics of the robot whose end effector a task moves.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TaskKinematics {
    /// The robot's kinematics, for the joints of the task in the task's order.
    pub kinematics: Kinematics,
    /// The end effector: index of its link.
    pub link: usize,
    /// Pose of the model's root in the frame of the task's poses.
    pub root: FramePose,
    /// Orientation of the base, along whose axes twists are given, in the frame of the model's root: quaternion x, y,
    /// z, w.
    pub base: [f64; 4],
    /// Pose of the tool centre point, which the task moves, in the frame of the link.
    #[serde(default = "same")]
    pub tool: FramePose,
}

fn same() -> FramePose {
    FramePose::SAME
}

/// Pose of a frame in another frame.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FramePose {
    /// x, y, z [m].
    pub position: [f64; 3],
    /// Quaternion x, y, z, w.
    pub orientation: [f64; 4],
}

/// The quaternion of no rotation.
pub const NO_ROTATION: [f64; 4] = [0.0, 0.0, 0.0, 1.0];

impl FramePose {
    /// Identity.
    pub const SAME: Self = Self { position: [0.0; 3], orientation: NO_ROTATION };

    /// Returns whether it is finite and its quaternion has length 1.
    pub fn is_valid(&self) -> bool {
        let length = self.orientation.iter().map(|v| v * v).sum::<f64>();
        self.position.iter().all(|v| v.is_finite()) && (0.98..1.02).contains(&length)
    }

    /// Returns it as a rotation matrix and translation.
    pub fn frame(&self) -> DAffine3 {
        let turn = DQuat::from_array(self.orientation).normalize();
        DAffine3::from_rotation_translation(turn, DVec3::from_array(self.position))
    }
}

impl From<&Isometry3<f64>> for FramePose {
    fn from(pose: &Isometry3<f64>) -> Self {
        Self { position: pose.translation.vector.into(), orientation: pose.rotation.coords.into() }
    }
}

impl TaskKinematics {
    /// Creates the kinematics of a robot whose poses and twists are in the frame of its root.
    pub fn new(kinematics: Kinematics, link: usize) -> Self {
        Self { kinematics, link, root: FramePose::SAME, base: NO_ROTATION, tool: FramePose::SAME }
    }

    /// Checks that a task with this number of joints can use it. The error names the problem.
    pub fn check(&self, joints: usize) -> Result<(), String> {
        let turned = |q: &[f64; 4]| (0.9..1.1).contains(&q.iter().map(|v| v * v).sum::<f64>());
        match () {
            () if self.kinematics.dof() != joints => Err("its kinematics have a different number of joints".to_owned()),
            () if self.link >= self.kinematics.links() => Err("its end effector does not exist".to_owned()),
            () if !turned(&self.base) || !turned(&self.root.orientation) => {
                Err("the quaternion of a frame does not have length 1".to_owned())
            }
            () if !self.tool.is_valid() => Err("its tool is not a pose".to_owned()),
            () => Ok(()),
        }
    }
}

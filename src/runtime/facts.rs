//! What a run is made of. It is resolved at the start and does not change.

use std::ops::Range;
use std::path::PathBuf;
use std::time::Duration;

use crate::blueprint::Blueprint;
use dimos_control::config::CoordinatorConfig;
use dimos_core::arm::GripperInfo;
use dimos_core::clock::WallOffset;
use dimos_core::telemetry::describe::Names;
use dimos_hardware::device::Connected;
use dimos_rpc::api::TextLines;
use dimos_rpc::{Code, RpcError};
use dimos_rt::host::Grant;

/// What a run is made of.
pub struct Facts {
    /// Its name.
    pub run: String,
    /// Its blueprint, with the dimensions of the connected arms.
    pub blueprint: Blueprint,
    /// The coordinator's configuration, with the effective limits.
    pub config: CoordinatorConfig,
    /// Names of arms, joints and tasks.
    pub names: Names,
    /// Per arm, what it said when it was connected.
    pub connected: Vec<Connected>,
    /// Per arm, what is to be said of its factory kinematics.
    pub kinematics: Vec<Option<String>>,
    /// Per arm, whether only a program on this computer can be at its address.
    pub local: Vec<bool>,
    /// The permissions of the process.
    pub grants: Vec<Grant>,
    /// From the clock of the tick to the time of day.
    pub wall: WallOffset,
    /// The log, if the run is recorded.
    pub log: Option<PathBuf>,
    /// What the run prints, if it is kept.
    pub text: Option<TextLines>,
}

impl Facts {
    /// Returns the period of the tick.
    pub fn period(&self) -> Duration {
        self.config.period()
    }

    /// Returns the index of an arm.
    pub fn arm_index(&self, id: &str) -> Result<u16, RpcError> {
        let ids: Vec<&str> = self.config.arms.iter().map(|a| a.name.as_str()).collect();
        match ids.iter().position(|a| *a == id) {
            Some(i) => Ok(i as u16),
            None => Err(RpcError::unknown(Code::UnknownArm, "arm", id, &ids)),
        }
    }

    /// Returns the index of a task.
    pub fn task_index(&self, name: &str) -> Result<u16, RpcError> {
        match self.names.tasks.iter().position(|t| t == name) {
            Some(i) => Ok(i as u16),
            None => Err(RpcError::unknown(Code::UnknownTask, "task", name, &self.names.tasks)),
        }
    }

    /// Returns the indices of an arm's joints over all arms.
    pub fn joints_of_arm(&self, arm: u16) -> Range<u16> {
        let dofs = || self.config.arms.iter().map(|a| a.dof as u16);
        let first = dofs().take(arm as usize).sum();
        first..first + dofs().nth(arm as usize).unwrap_or(0)
    }

    /// Returns the indices of joints over all arms' joints.
    pub fn joints_named(&self, names: &[String]) -> Result<Vec<u16>, RpcError> {
        let all: Vec<&String> = self.names.arms.iter().flat_map(|a| &a.joints).collect();
        let index = |name: &String| match all.iter().position(|joint| *joint == name) {
            Some(joint) => Ok(joint as u16),
            None => Err(RpcError::unknown(Code::InvalidTrajectory, "joint", name, &all)),
        };
        names.iter().map(index).collect()
    }

    /// Returns the arm of a joint, and the joint's index in the arm.
    pub fn locate(&self, joint: u16) -> Option<(usize, usize)> {
        let mut left = joint as usize;
        for (i, arm) in self.config.arms.iter().enumerate() {
            if left < arm.dof {
                return Some((i, left));
            }
            left -= arm.dof;
        }
        None
    }

    /// Returns the limits of a joint [rad].
    pub fn range(&self, joint: u16) -> Option<[f64; 2]> {
        let (arm, j) = self.locate(joint)?;
        let limits = &self.config.arms.get(arm)?.limits;
        Some([*limits.position_lower.get(j)?, *limits.position_upper.get(j)?])
    }

    /// Returns units and ranges of an arm's gripper; `None` without one.
    pub fn gripper_info(&self, arm: usize) -> Option<GripperInfo> {
        self.connected.get(arm).and_then(|connected| connected.gripper)
    }
}

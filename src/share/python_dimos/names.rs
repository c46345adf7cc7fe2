//! Names of joints: those of the run, and those that Python dimos uses (`arm_joint1`, `arm/joint1`).

use std::collections::BTreeMap;

use crate::rpc::report::{StateReport, StatusReport};

/// Name of the one trajectory task that Python dimos knows.
pub const TRAJECTORY_TASK: &str = "joint_trajectory";
/// End of the name of an arm's gripper task.
const GRIPPER_SUFFIX: &str = "_gripper";

/// A gripper.
#[derive(Debug, Clone, PartialEq)]
pub struct Gripper {
    /// Its arm.
    pub arm: String,
    /// Closed and open position [m or rad]; `None`: the adapter does not report it.
    pub range: Option<[f64; 2]>,
}

/// The joints, arms and tasks of a run, with the names of Python dimos.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Names {
    /// The joints in the run's order: name in the run, and for Python dimos.
    pub(super) joints: Vec<(String, String)>,
    /// The arms.
    pub arms: Vec<String>,
    /// The arms' grippers.
    pub grippers: Vec<Gripper>,
    /// The run's trajectory tasks; to Python dimos they are one.
    pub trajectory_tasks: Vec<String>,
}

impl Names {
    /// Returns the names of a run. `map`: names that are not to be formed by the rule, by joint.
    pub fn of(status: &StatusReport, state: &StateReport, map: &BTreeMap<String, String>) -> Result<Self, String> {
        let mut names = Self::default();
        for arm in &state.arms {
            names.arms.push(arm.hardware_id.clone());
            for joint in &arm.joints {
                let theirs = match map.get(&joint.name) {
                    Some(name) => name.clone(),
                    None => of_joint(&joint.name, &arm.hardware_id),
                };
                names.joints.push((joint.name.clone(), theirs));
            }
            if arm.gripper_unit.is_some() {
                let of_arm = status.arms.iter().find(|report| report.hardware_id == arm.hardware_id);
                let range = of_arm.and_then(|report| report.gripper_range);
                names.grippers.push(Gripper { arm: arm.hardware_id.clone(), range });
            }
        }
        let of_trajectories = status.tasks.iter().filter(|task| task.takes("execute"));
        names.trajectory_tasks = of_trajectories.map(|task| task.name.clone()).collect();
        names.check(map)?;
        Ok(names)
    }

    fn check(&self, map: &BTreeMap<String, String>) -> Result<(), String> {
        if let Some(unknown) = map.keys().find(|name| self.theirs(name).is_none()) {
            return Err(format!("share.python_dimos.joints: no joint of the run is named `{unknown}`"));
        }
        for (at, (ours, theirs)) in self.joints.iter().enumerate() {
            if let Some((other, _)) = self.joints.iter().take(at).find(|(_, name)| name == theirs) {
                return Err(format!("share.python_dimos.joints: {other} and {ours} would both be `{theirs}`"));
            }
        }
        Ok(())
    }

    /// Returns the names of all joints for Python dimos.
    pub fn joints(&self) -> impl Iterator<Item = &str> {
        self.joints.iter().map(|(_, theirs)| theirs.as_str())
    }

    /// Returns the name for Python dimos of a joint of the run.
    pub fn theirs(&self, ours: &str) -> Option<&str> {
        self.joints.iter().find(|(name, _)| name == ours).map(|(_, theirs)| theirs.as_str())
    }

    /// Returns the name in the run of a joint of Python dimos.
    pub fn ours(&self, theirs: &str) -> Option<&str> {
        self.joints.iter().find(|(_, name)| name == theirs).map(|(ours, _)| ours.as_str())
    }

    /// Returns the names of all tasks.
    pub fn tasks(&self) -> Vec<String> {
        let trajectory = (!self.trajectory_tasks.is_empty()).then(|| TRAJECTORY_TASK.to_owned());
        trajectory.into_iter().chain(self.gripper_tasks()).collect()
    }

    /// Returns the names of the gripper tasks.
    pub fn gripper_tasks(&self) -> impl Iterator<Item = String> {
        self.grippers.iter().map(|gripper| format!("{}{GRIPPER_SUFFIX}", gripper.arm))
    }

    /// Returns the gripper of a gripper task.
    pub fn gripper(&self, task: &str) -> Option<&Gripper> {
        let arm = task.strip_suffix(GRIPPER_SUFFIX)?;
        self.grippers.iter().find(|gripper| gripper.arm == arm)
    }
}

/// Returns the name of a joint by the rule: `PREFIX_jointN` is `PREFIX/jointN`; any other name is below that of its
/// arm.
pub fn of_joint(joint: &str, arm: &str) -> String {
    let numbered = |at: usize| {
        let number = &joint[at + "_joint".len()..];
        at > 0 && !number.is_empty() && number.bytes().all(|b| b.is_ascii_digit())
    };
    match joint.rfind("_joint").filter(|at| numbered(*at)) {
        Some(at) => format!("{}/{}", &joint[..at], &joint[at + 1..]),
        None => format!("{arm}/{joint}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::rpc::report::{ArmReport, ArmStateReport, JointReport, TaskReport};

    fn of(joints: &[&str], map: &[(&str, &str)]) -> Result<Names, String> {
        let joints = joints.iter().map(|name| JointReport { name: (*name).into(), ..JointReport::default() }).collect();
        let arm = ArmStateReport {
            hardware_id: "arm".into(),
            joints,
            gripper_unit: Some("m".into()),
            ..ArmStateReport::default()
        };
        let state = StateReport { arms: vec![arm], ..StateReport::default() };
        let arm = ArmReport { hardware_id: "arm".into(), gripper_range: Some([0.0, 0.08]), ..ArmReport::default() };
        let task = TaskReport { name: "traj".into(), takes: vec!["execute".into()], ..TaskReport::default() };
        let status = StatusReport { arms: vec![arm], tasks: vec![task], ..StatusReport::default() };
        Names::of(&status, &state, &map.iter().map(|(a, b)| ((*a).to_owned(), (*b).to_owned())).collect())
    }

    #[test]
    fn joints_have_the_names_of_python_dimos_by_rule_or_by_map() {
        let names =
            of(&["arm_joint1", "left_arm_joint12", "elbow", "_joint1", "a_jointx"], &[("elbow", "arm/e")]).unwrap();
        let theirs: Vec<&str> = names.joints().collect();
        assert_eq!(theirs, ["arm/joint1", "left_arm/joint12", "arm/e", "arm/_joint1", "arm/a_jointx"]);
        assert_eq!((names.ours("arm/e"), names.theirs("elbow")), (Some("elbow"), Some("arm/e")));
        assert_eq!(names.ours("elbow"), None);
        assert_eq!(names.tasks(), ["joint_trajectory", "arm_gripper"]);
        assert_eq!(names.gripper("arm_gripper").unwrap().range, Some([0.0, 0.08]));
        assert_eq!(names.gripper("left_gripper"), None);
    }

    #[test]
    fn a_map_names_joints_of_the_run_and_no_name_twice() {
        assert!(of(&["elbow"], &[("wrist", "arm/w")]).unwrap_err().contains("no joint of the run is named `wrist`"));
        let twice = of(&["arm_joint1", "elbow"], &[("elbow", "arm/joint1")]).unwrap_err();
        assert!(twice.contains("arm_joint1 and elbow would both be `arm/joint1`"), "{twice}");
    }
}

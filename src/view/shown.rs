//! What a page shows: the arms and robots of a run, by their names.

use nalgebra::Isometry3;

use crate::blueprint::{Blueprint, TaskRobot};
use dimos_control::config::CoordinatorConfig;
use dimos_core::joint::JointLimits;
use dimos_planner::planning::scene::config::{GripperJoint, RobotConfig};
use dimos_robot::Source;
use dimos_rpc::report::{ArmReport, StateReport, StatusReport};

/// The arms and robots that a page shows.
#[derive(Debug, Clone, Default)]
pub struct Shown {
    /// Name of the run.
    pub name: String,
    /// Whether any arm is an emulator, or an ideal arm in memory.
    pub simulated: bool,
    /// Whether the run has a planner.
    pub planner: bool,
    /// The robots with a model.
    pub robots: Vec<ShownRobot>,
    /// All arms.
    pub arms: Vec<ShownArm>,
}

/// A robot with a model.
#[derive(Debug, Clone)]
pub struct ShownRobot {
    /// Name of the planner's robot, or of the arm whose end effector a task moves.
    pub name: String,
    /// Its description, which is read when a page asks for it.
    pub source: Source,
    /// The link that `base_pose` places; `None`: the root.
    pub base_link: Option<String>,
    /// Pose of that link in `map`.
    pub base_pose: Isometry3<f64>,
    /// The link whose pose is the robot's.
    pub tip: String,
    /// Names of its joints in the coordinator and in the model, from the base.
    pub joints: Vec<(String, String)>,
    /// Joints that other arms move, in the same form.
    pub moved_by_others: Vec<(String, String)>,
    /// Joints that stay where they are, by the model's names [rad or m].
    pub fixed: Vec<(String, f64)>,
    /// Named poses: one position for each of `joints` [rad]. Those of an SRDF are added when it is read.
    pub poses: Vec<(String, Vec<f64>)>,
    /// The joint of the model that the arm's gripper drives.
    pub gripper: Option<GripperJoint>,
}

/// An arm of the run.
#[derive(Debug, Clone)]
pub struct ShownArm {
    /// Its `hardware_id`.
    pub name: String,
    /// Its adapter's name.
    pub adapter: String,
    /// Address of its device.
    pub address: String,
    /// Whether it is an emulator, or an ideal arm in memory.
    pub simulated: bool,
    /// Names of its joints.
    pub joints: Vec<String>,
    /// Limits, one entry per joint.
    pub limits: JointLimits,
    /// Its gripper.
    pub gripper: Option<ShownGripper>,
}

/// The gripper of an arm.
#[derive(Debug, Clone)]
pub struct ShownGripper {
    /// Position when closed and when open, if known [`unit`](Self::unit).
    pub range: Option<(f64, f64)>,
    /// Unit of its positions: `m` or `rad`.
    pub unit: String,
}

impl Shown {
    /// Returns what a page shows of a run.
    pub fn of_run(name: &str, blueprint: &Blueprint, config: &CoordinatorConfig) -> Self {
        let arms = blueprint.arms.iter().zip(&config.arms).map(|(arm, config)| ShownArm {
            name: arm.hardware_id.clone(),
            adapter: arm.adapter_type.clone(),
            address: arm.address.clone(),
            simulated: !arm.is_real(),
            joints: arm.joints.clone(),
            limits: config.limits.clone(),
            gripper: config.gripper.then(|| {
                let info = &config.gripper_info;
                ShownGripper { range: info.range, unit: info.unit.name().to_owned() }
            }),
        });
        Self {
            name: name.to_owned(),
            simulated: blueprint.arms.iter().any(|arm| !arm.is_real()),
            planner: blueprint.planner.is_some(),
            robots: robots(blueprint),
            arms: arms.collect(),
        }
    }

    /// Returns what a page shows of a run that a planner with this blueprint is attached to.
    pub fn of_attached(blueprint: &Blueprint, status: &StatusReport, state: &StateReport) -> Self {
        let arm = |arm: &ArmReport| {
            let joints = state.arms.iter().find(|state| state.hardware_id == arm.hardware_id);
            let own = blueprint.arms.iter().find(|own| own.hardware_id == arm.hardware_id);
            let limit = |end: usize| arm.position_limits.iter().filter_map(move |limits| limits.get(end)).copied();
            ShownArm {
                name: arm.hardware_id.clone(),
                adapter: arm.adapter.clone(),
                address: arm.address.clone(),
                simulated: arm.simulated,
                joints: joints.iter().flat_map(|arm| &arm.joints).map(|joint| joint.name.clone()).collect(),
                limits: JointLimits {
                    position_lower: limit(0).collect(),
                    position_upper: limit(1).collect(),
                    velocity_max: own.map(|own| own.own_limits.velocity_max.clone()).unwrap_or_default(),
                    ..JointLimits::default()
                },
                gripper: arm
                    .gripper_unit
                    .clone()
                    .map(|unit| ShownGripper { range: arm.gripper_range.map(|[closed, open]| (closed, open)), unit }),
            }
        };
        Self {
            name: status.run.clone(),
            simulated: status.simulated,
            planner: true,
            robots: robots(blueprint),
            arms: status.arms.iter().map(arm).collect(),
        }
    }
}

/// Returns the planner's robots, and those of tasks whose joints no planned robot has.
pub(crate) fn robots(blueprint: &Blueprint) -> Vec<ShownRobot> {
    let mut robots: Vec<ShownRobot> =
        blueprint.planner.iter().flat_map(|planner| &planner.robots).map(of_planner).collect();
    let names = blueprint.joint_names();
    for task in &blueprint.tasks {
        let joints = task.joints.iter().filter_map(|joint| names.get(*joint)).map(|name| (*name).to_owned());
        let arm = task.arms.first().and_then(|arm| blueprint.arms.get(*arm)).map_or("", |arm| &arm.hardware_id);
        let Some(robot) = task.robot.as_ref().map(|robot| of_task(arm, robot, joints.collect())) else {
            continue;
        };
        let shown = |(joint, _): &(String, String)| robots.iter().any(|r| r.joints.iter().any(|(j, _)| j == joint));
        if !robot.joints.iter().any(shown) {
            robots.push(robot);
        }
    }
    robots
}

fn of_planner(robot: &RobotConfig) -> ShownRobot {
    ShownRobot {
        name: robot.name.clone(),
        source: robot.source(),
        base_link: Some(robot.base_link.clone()),
        base_pose: robot.base_pose,
        tip: robot.end_effector_link.clone(),
        joints: robot.coordinator_joints.iter().cloned().zip(robot.joints.iter().cloned()).collect(),
        moved_by_others: { robot.moved_by_others() }.map(|(model, ours)| (ours.to_owned(), model.to_owned())).collect(),
        fixed: { robot.fixed_joints() }.map(|(name, position)| (name.to_owned(), position)).collect(),
        poses: robot.named_poses.clone().into_iter().collect(),
        gripper: robot.gripper_joint.clone(),
    }
}

fn of_task(name: &str, robot: &TaskRobot, joints: Vec<String>) -> ShownRobot {
    ShownRobot {
        name: name.to_owned(),
        source: robot.source.clone(),
        base_link: None,
        base_pose: Isometry3::identity(),
        tip: robot.link.clone(),
        joints: joints.into_iter().zip(robot.joints.iter().cloned()).collect(),
        moved_by_others: Vec::new(),
        fixed: robot.fixed.clone().into_iter().collect(),
        poses: Vec::new(),
        gripper: None,
    }
}

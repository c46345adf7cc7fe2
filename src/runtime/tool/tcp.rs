//! Tool centre points: the pose of each arm, computed from its measured joints. The model is that of the planner's
//! robot, in this process or attached; without one, that of a task that moves the arm's end effector, whose root is
//! then `map`.

use std::collections::BTreeMap;
use std::sync::Arc;

use glamx::DAffine3;
use nalgebra::Isometry3;

use crate::runtime::Service;
use crate::runtime::plan::planner_port::{isometry, spec};
use dimos_core::sync::lock;
use dimos_log::tcp_log::TcpChain;
use dimos_planner::planning::scene::planning_scene::PlannedRobot;
use dimos_robot::kinematics::{Kinematics, frame, pose};
use dimos_rpc::api::{RegisteredFlange, RegisteredModel, RegisteredRobot};
use dimos_rpc::report::{PoseReport, TcpReport, ToolReport};

/// The reference frame of all poses.
pub(in crate::runtime) const MAP: &str = "map";

/// The model of an arm's tool centre point.
#[derive(Debug, Clone)]
pub(in crate::runtime) struct TcpModel {
    /// Name of the planner's robot; `None`: the model is a task's.
    pub robot: Option<String>,
    /// Names of its joints in the coordinator.
    joints: Vec<String>,
    kinematics: Arc<Kinematics>,
    /// With the joints that other arms move: all joints, and kinematics in which they move, too.
    with_others: Option<(Vec<String>, Arc<Kinematics>)>,
    /// Index of the end-effector link in the kinematics.
    index: usize,
    /// Pose of the model's root in `map`.
    pub root: DAffine3,
    /// Name of the end-effector link.
    pub link: String,
    /// Pose of the tool centre point in the link's frame.
    pub tool: Option<Isometry3<f64>>,
    /// The flange, and the controller's base; `None` if the model does not name its flange.
    pub flange: Option<Flange>,
    /// Whether planned motions are made although the model does not fit the arm.
    pub allows_mismatch: bool,
}

/// Where the flange and the base of an arm's controller are in its model.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::runtime) struct Flange {
    /// Index of the flange's link in the kinematics.
    link: usize,
    /// Index of the link that carries the controller's base.
    base_link: usize,
    /// Pose of the controller's base in that link's frame.
    base: Isometry3<f64>,
}

impl TcpModel {
    /// Returns the model of a planning robot.
    pub fn of(robot: &PlannedRobot) -> Self {
        Self {
            robot: Some(robot.config.name.clone()),
            joints: robot.config.coordinator_joints.clone(),
            kinematics: robot.body.kinematics.clone(),
            with_others: robot.kinematics_with_others().map(|kinematics| {
                let others = robot.moved_by_others().map(|(_, name)| name.to_owned());
                (robot.config.coordinator_joints.iter().cloned().chain(others).collect(), Arc::new(kinematics))
            }),
            index: robot.end_effector,
            root: robot.body.base,
            link: robot.config.end_effector_link.clone(),
            tool: robot.config.tool,
            flange: Self::flange_of(robot),
            allows_mismatch: robot.config.allows_mismatch,
        }
    }

    fn flange_of(robot: &PlannedRobot) -> Option<Flange> {
        let link = robot.model.link_index(robot.config.flange_link.as_ref()?)?;
        let own = || Some((robot.model.link_index(&robot.config.base_link)?, Isometry3::identity()));
        let (base_link, base) = match &robot.config.controller_base {
            Some((name, base)) => (robot.model.link_index(name)?, *base),
            None => own()?,
        };
        Some(Flange { link, base_link, base })
    }

    /// Returns the model of an attached planner's robot, if it registered one. The error names what is wrong with it.
    pub fn registered(robot: &RegisteredRobot) -> Result<Option<Self>, String> {
        let Some(RegisteredModel { kinematics, index, root, tcp, flange, allows_mismatch }) = &robot.model else {
            return Ok(None);
        };
        let read = serde_json::from_value::<Kinematics>(kinematics.clone());
        let kinematics = read.map_err(|e| format!("the kinematics of {}: {e}", robot.name))?;
        if kinematics.dof() != robot.joints.len() || *index >= kinematics.links() {
            return Err(format!("the kinematics of {} have other joints or links than the robot", robot.name));
        }
        let flange = flange.as_ref().map(|flange| {
            let RegisteredFlange { link, base_link, base } = flange;
            Flange { link: *link, base_link: *base_link, base: isometry(base) }
        });
        if flange.is_some_and(|flange| flange.link.max(flange.base_link) >= kinematics.links()) {
            return Err(format!("the kinematics of {} have no such flange", robot.name));
        }
        Ok(Some(Self {
            robot: Some(robot.name.clone()),
            joints: robot.joints.clone(),
            kinematics: Arc::new(kinematics),
            with_others: None,
            index: *index,
            root: frame(&isometry(root)),
            link: tcp.link.clone(),
            tool: tcp.tool.map(|tool| dimos_core::pose::from_xyz_rpy(tool.xyz, tool.rpy)),
            flange,
            allows_mismatch: *allows_mismatch,
        }))
    }

    /// Returns it for the registration of an attached planner.
    pub fn to_register(&self) -> RegisteredModel {
        let (kinematics, root) = (serde_json::to_value(&*self.kinematics).unwrap_or_default(), spec(&pose(&self.root)));
        let flange = self.flange.map(|flange| RegisteredFlange {
            link: flange.link,
            base_link: flange.base_link,
            base: spec(&flange.base),
        });
        let allows_mismatch = self.allows_mismatch;
        RegisteredModel { kinematics, index: self.index, root, tcp: self.report(), flange, allows_mismatch }
    }

    /// Returns the point's report.
    pub fn report(&self) -> TcpReport {
        TcpReport { link: self.link.clone(), tool: self.tool.as_ref().map(ToolReport::from) }
    }

    /// Returns the number of its joints.
    pub fn dof(&self) -> usize {
        self.joints.len()
    }

    /// Returns whether the robot has one of these joints.
    pub fn moves(&self, joints: &[String]) -> bool {
        self.joints.iter().any(|joint| joints.contains(joint))
    }

    /// Returns the pose of the flange in the frame of the controller's base, at positions of the arm's joints [rad],
    /// which must be those of the model; `None` if the model does not name its flange, or has other joints.
    pub(in crate::runtime) fn flange_in_controller(&self, positions: &[f64]) -> Option<Isometry3<f64>> {
        let flange = self.flange.filter(|_| positions.len() == self.joints.len())?;
        let mut frames = self.kinematics.frames();
        self.kinematics.forward_from(&self.root, positions, &mut frames);
        let link = |index: usize| pose(&self.kinematics.link_frame(index, &frames));
        Some((link(flange.base_link) * flange.base).inverse() * link(flange.link))
    }

    /// Returns the point's pose in `map` at these positions [rad]; `None` if one is missing.
    fn pose(&self, positions: &BTreeMap<String, f64>) -> Option<PoseReport> {
        let q: Vec<f64> = self.joints.iter().map(|joint| positions.get(joint).copied()).collect::<Option<_>>()?;
        let mut frames = self.kinematics.frames();
        self.kinematics.forward_from(&self.root, &q, &mut frames);
        let link = pose(&self.kinematics.link_frame(self.index, &frames));
        let (xyz, rpy) = dimos_core::pose::to_xyz_rpy(&(link * self.tool.unwrap_or_default()));
        let TcpReport { link, tool } = self.report();
        Some(PoseReport { link, tool, frame: MAP.to_owned(), xyz, rpy })
    }
}

impl Service {
    /// Returns the model of each arm's tool centre point.
    pub(in crate::runtime) fn tcp_models(&self) -> Vec<Option<TcpModel>> {
        let planned = self.plans.models();
        let model = |joints: &Vec<String>| {
            planned.iter().find(|model| model.moves(joints)).cloned().or_else(|| self.tcp_of_task(joints))
        };
        self.facts.names.arms.iter().map(|arm| model(&arm.joints)).collect()
    }

    /// Passes the models to the recorder.
    pub(in crate::runtime) fn log_tcps(&self) {
        let all: Vec<&String> = self.facts.names.arms.iter().flat_map(|arm| &arm.joints).collect();
        let index = |joint: &String| all.iter().position(|name| *name == joint);
        let chain = |model: TcpModel| {
            let TcpModel { joints, kinematics, with_others, index: link, root, tool, .. } = model;
            let (joints, kinematics) = with_others.unwrap_or((joints, kinematics));
            let joints = joints.iter().map(index).collect::<Option<_>>()?;
            Some(TcpChain { joints, kinematics, link, root, tool })
        };
        let chains = self.tcp_models().into_iter().map(|model| chain(model?)).collect();
        self.journal.set_tcps(chains);
    }

    /// Returns the model of the first task that moves the end effector of an arm with these joints.
    fn tcp_of_task(&self, joints: &[String]) -> Option<TcpModel> {
        let tools = lock(&self.tools.of_tasks);
        let tasks = self.facts.config.tasks.iter().zip(&self.facts.blueprint.tasks).zip(tools.iter());
        { tasks }.find_map(|((config, task), tool)| {
            let (robot, about) = (config.kind.robot.as_ref()?, task.robot.as_ref()?);
            let model = TcpModel {
                robot: None,
                joints: config.joints.iter().map(|joint| self.facts.names.joint(*joint)).collect(),
                kinematics: Arc::new(robot.kinematics.clone()),
                with_others: None,
                index: robot.link,
                root: robot.root.frame(),
                link: about.link.clone(),
                tool: *tool,
                flange: None,
                allows_mismatch: false,
            };
            model.moves(joints).then_some(model)
        })
    }

    /// Returns the pose of each arm's tool centre point at the measured positions.
    pub(in crate::runtime) fn tcp_poses(&self) -> Vec<Option<PoseReport>> {
        let mut measured = BTreeMap::new();
        for (index, arm) in self.facts.names.arms.iter().enumerate() {
            let Some(view) = self.tick.arm_view(index).filter(|view| view.state.seq > 0) else { continue };
            measured.extend(arm.joints.iter().cloned().zip(view.state.position));
        }
        self.tcp_models().iter().map(|model| model.as_ref()?.pose(&measured)).collect()
    }
}

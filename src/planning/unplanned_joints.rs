//! Joints of a model that are not planned, at their measured positions: a gripper's joint (`gripper_joint`) from the
//! gripper's opening, others by their names in the run. A gripper without a measurement is taken as fully open; all
//! other joints are at zero.

use std::collections::{BTreeMap, HashMap};

use super::config::RobotConfig;
use super::planning_scene::{PlannedRobot, PlanningScene};
use crate::collision::world::Robot;
use crate::robot::model::RobotModel;

/// Changes below this are measurement noise [rad or m].
const NOISE: f64 = 2e-4;

/// Measurements besides the planned joints.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Measured {
    /// Joint positions by the coordinator's name [rad or m].
    pub positions: BTreeMap<String, f64>,
    /// Opening of an arm's gripper, 0–1, by each of the arm's joints.
    pub grippers: BTreeMap<String, f64>,
}

impl PlanningScene {
    /// Returns the scene with the joints that are not planned at their measured positions; `None` if nothing changed.
    pub fn with_idle_joints(&self, measured: &Measured) -> Option<Self> {
        let mut now: Option<Self> = None;
        for (index, robot) in self.robots.iter().enumerate() {
            let rest = robot.model.positions(&idle(&robot.config, &robot.model, &robot.joints, measured));
            if rest.iter().zip(&robot.rest).all(|(a, b)| (a - b).abs() <= NOISE) {
                continue;
            }
            let Ok(kinematics) = robot.compiled(&robot.model, &rest) else { continue };
            let now = now.get_or_insert_with(|| self.clone());
            let body = Robot { kinematics: kinematics.into(), ..robot.body.clone() };
            now.robots[index] = PlannedRobot { body, rest, ..robot.clone() };
        }
        now
    }
}

impl PlannedRobot {
    /// Returns gripper joints without a measurement, with the fully open position that is assumed [rad or m].
    pub fn taken_as_open(&self) -> Vec<(String, f64)> {
        let known = |name: &String| self.config.gripper_joint.as_ref().is_some_and(|gripper| gripper.joint == *name);
        let unplanned = self.model.independent_joints().into_iter().filter(|joint| !self.joints.contains(joint));
        let grippers = unplanned.filter(|joint| is_of_gripper(&self.model, &self.joints, *joint));
        let named = grippers.filter_map(|joint| Some((self.model.joints.get(joint)?.name.clone(), joint)));
        named.filter(|(name, _)| !known(name)).map(|(name, joint)| (name, widest(&self.model, joint))).collect()
    }

    /// Returns the links that no planned joint moves relative to `link`, such as the fingers on a flange: no plan
    /// brings them closer to an object that it holds.
    pub fn moved_together_with(&self, link: &str) -> Vec<String> {
        let carrier = |link: usize| {
            let carriers = std::iter::successors(link.checked_sub(1), |joint| {
                self.model.joints.get(*joint).and_then(|joint| joint.parent.checked_sub(1))
            });
            carriers.into_iter().find(|joint| self.joints.contains(joint))
        };
        let Some(own) = self.model.link_index(link).map(carrier) else { return Vec::new() };
        let links = self.model.links.iter().enumerate().filter(|(index, _)| carrier(*index) == own);
        links.map(|(_, link)| link.name.clone()).collect()
    }
}

/// Returns the positions of the independent joints that are not planned, by the model's names.
pub(super) fn idle(
    config: &RobotConfig,
    model: &RobotModel,
    planned: &[usize],
    measured: &Measured,
) -> HashMap<String, f64> {
    let mut positions = HashMap::new();
    for index in model.independent_joints().into_iter().filter(|joint| !planned.contains(joint)) {
        let Some(joint) = model.joints.get(index) else { continue };
        let gripper = config.gripper_joint.as_ref().filter(|gripper| gripper.joint == joint.name);
        let names = [format!("{}{}", config.joint_prefix, joint.name), joint.name.clone()];
        let is_at = names.iter().find_map(|name| measured.positions.get(name));
        let position = match (gripper, is_at) {
            (Some(gripper), _) => {
                let part = config.coordinator_joints.first().and_then(|joint| measured.grippers.get(joint));
                gripper.closed + (gripper.open - gripper.closed) * part.copied().unwrap_or(1.0)
            }
            (None, Some(is_at)) => *is_at,
            (None, None) if is_of_gripper(model, planned, index) => widest(model, index),
            (None, None) => 0.0,
        };
        positions.insert(joint.name.clone(), position);
    }
    positions
}

/// Returns whether a joint moves only links carried by the planned joints.
fn is_of_gripper(model: &RobotModel, planned: &[usize], joint: usize) -> bool {
    let above = |joint: usize| {
        std::iter::successors(model.joints.get(joint), |j| model.parent_joint(j.parent)).map(|joint| joint.child)
    };
    let carries = |upper: usize, lower: usize| above(lower).any(|child| child == upper + 1);
    planned.iter().any(|p| carries(*p, joint)) && !planned.iter().any(|p| carries(joint, *p))
}

/// Returns the end of a joint's range at which the links it moves are farthest apart from each other and from their
/// parent.
fn widest(model: &RobotModel, joint: usize) -> f64 {
    let Some(own) = model.joints.get(joint) else { return 0.0 };
    if !own.limits.lower.is_finite() || !own.limits.upper.is_finite() {
        return 0.0;
    }
    let moves =
        |j: usize| j == joint || model.joints.get(j).is_some_and(|o| o.mimic.is_some_and(|m| m.leader == joint));
    let fingers: Vec<usize> = (0..model.joints.len()).filter(|j| moves(*j)).collect();
    let spread = |position: f64| {
        let named = HashMap::from([(own.name.clone(), position)]);
        let poses = model.link_poses(&model.positions(&named));
        // Centres of the shapes; a link without shapes counts with its frame.
        let middle = |link: usize| {
            let pose = poses.get(link).copied().unwrap_or_default();
            let shapes = model.links.get(link).map(|link| link.collisions.as_slice()).unwrap_or_default();
            let sum: nalgebra::Vector3<f64> = shapes.iter().map(|shape| shape.origin.translation.vector).sum();
            pose * nalgebra::Point3::from(sum / (shapes.len().max(1) as f64))
        };
        let mut middles: Vec<_> = fingers.iter().map(|j| middle(j + 1)).collect();
        middles.push(middle(own.parent));
        let pairs = middles.iter().enumerate().flat_map(|(i, a)| middles.iter().take(i).map(move |b| (a - b).norm()));
        pairs.sum::<f64>()
    };
    let (lower, upper) = (own.limits.lower, own.limits.upper);
    if spread(lower) > spread(upper) + 1e-9 { lower } else { upper }
}

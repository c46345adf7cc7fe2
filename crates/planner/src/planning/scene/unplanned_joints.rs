//! Joints of a model that are not planned: a gripper's joint (`gripper_joint`) from the gripper's opening, others where
//! an arm of the run measures them, or where the blueprint says they stay (`fixed_joints`). An unknown joint
//! counts at its widest pose, a gripper without a measurement as fully open.

use std::collections::{BTreeMap, HashMap};
use std::f64::consts::PI;

use super::config::{RobotConfig, Unplanned};
use super::planning_scene::{PlannedRobot, PlanningScene, compiled};
use crate::collision::world::Robot;
use dimos_robot::kinematics::Kinematics;
use dimos_robot::model::{Joint, RobotModel};

/// Changes below this are measurement noise [rad or m].
const NOISE: f64 = 2e-4;
/// Positions of a joint's range among which the widest is sought.
const SAMPLES: u32 = 16;

/// Measurements besides the planned joints.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Measured {
    /// Joint positions by the coordinator's name [rad or m].
    pub positions: BTreeMap<String, f64>,
    /// Opening of an arm's gripper, 0–1, by each of the arm's joints.
    pub grippers: BTreeMap<String, f64>,
    /// How far an arm is from its model, by each of the arm's joints [m].
    pub paddings: BTreeMap<String, f64>,
}

impl PlanningScene {
    /// Returns the scene with the joints that are not planned at their measured positions, and robots that are off
    /// their models with that distance; `None` if nothing changed.
    pub fn with_idle_joints(&self, measured: &Measured) -> Option<Self> {
        let mut now: Option<Self> = None;
        for (index, robot) in self.robots.iter().enumerate() {
            let rest = robot.model.positions(&idle(&robot.config, &robot.model, &robot.joints, measured, &robot.rest));
            let pads = robot.config.coordinator_joints.iter().filter_map(|joint| measured.paddings.get(joint));
            let apart = pads.copied().fold(0.0, f64::max);
            let is_padded = (apart - robot.body.apart).abs() <= NOISE;
            if is_padded && rest.iter().zip(&robot.rest).all(|(a, b)| (a - b).abs() <= NOISE) {
                continue;
            }
            let Ok(kinematics) = robot.compiled(&robot.model, &rest) else { continue };
            let now = now.get_or_insert_with(|| self.clone());
            let body = Robot { kinematics: kinematics.into(), apart, ..robot.body.clone() };
            now.robots[index] = PlannedRobot { body, rest, ..robot.clone() };
        }
        now
    }
}

impl PlannedRobot {
    /// Returns the joints that nothing is known of, with the position that is assumed [rad or m].
    pub fn assumed(&self) -> Vec<(String, f64)> {
        let gripper = self.config.gripper_joint.as_ref().map(|gripper| &gripper.joint);
        let known = |name: &String| self.config.unplanned.contains_key(name) || gripper == Some(name);
        let unplanned = self.model.independent_joints().into_iter().filter(|joint| !self.joints.contains(joint));
        let named = unplanned.filter_map(|joint| Some((self.model.joints.get(joint)?.name.clone(), joint)));
        let at = |joint: usize| self.rest.get(joint).copied().unwrap_or_default();
        named.filter(|(name, _)| !known(name)).map(|(name, joint)| (name, at(joint))).collect()
    }

    /// Returns the coordinator's names of the joints that others move: where these are must be known, too.
    pub fn moved_by_others(&self) -> impl Iterator<Item = (&str, &str)> {
        self.config.moved_by_others()
    }

    /// Returns the model with the joints fixed that the blueprint fixes.
    pub fn model_with_fixed(&self) -> RobotModel {
        let fixed = self.config.fixed_joints().filter_map(|(name, _)| self.model.joint_index(name));
        let mut model = (*self.model).clone();
        model.fix(fixed, &self.rest);
        model
    }

    /// Returns the kinematics in which the joints that others move move as well, after the planned ones; `None` if
    /// others move none.
    pub fn kinematics_with_others(&self) -> Option<Kinematics> {
        let others: Vec<usize> = self.moved_by_others().filter_map(|(name, _)| self.model.joint_index(name)).collect();
        let joints = [self.joints.as_slice(), &others].concat();
        let kinematics = compiled(&self.model, &joints, &self.rest, self.end_effector, self.config.tool.as_ref());
        kinematics.ok().filter(|_| !others.is_empty())
    }

    /// Returns the links that no planned joint moves relative to `link`, such as the fingers on a flange: no plan
    /// brings them closer to an object that it holds.
    pub fn moved_together_with(&self, link: &str) -> Vec<String> {
        let carrier = |link: usize| link.checked_sub(1).and_then(|joint| carrier(&self.model, &self.joints, joint));
        let Some(own) = self.model.link_index(link).map(carrier) else { return Vec::new() };
        let links = self.model.links.iter().enumerate().filter(|(index, _)| carrier(*index) == own);
        links.map(|(_, link)| link.name.clone()).collect()
    }
}

/// Returns the place of the planned joint that carries a joint: the nearest one above it, or itself.
fn carrier(model: &RobotModel, planned: &[usize], joint: usize) -> Option<usize> {
    let above = |joint: &usize| model.joints.get(*joint).and_then(|joint| joint.parent.checked_sub(1));
    std::iter::successors(Some(joint), above).find_map(|joint| planned.iter().position(|own| *own == joint))
}

/// Returns the positions of the independent joints that are not planned, by the model's names. A joint without a
/// measurement keeps its `last` position, one for each joint of the model; empty before the first.
pub(in crate::planning) fn idle(
    config: &RobotConfig,
    model: &RobotModel,
    planned: &[usize],
    measured: &Measured,
    last: &[f64],
) -> HashMap<String, f64> {
    let mut positions = HashMap::new();
    for index in model.independent_joints().into_iter().filter(|joint| !planned.contains(joint)) {
        let Some(joint) = model.joints.get(index) else { continue };
        let last = last.get(index).copied();
        let gripper = config.gripper_joint.as_ref().filter(|gripper| gripper.joint == joint.name);
        let position = match (gripper, config.unplanned.get(&joint.name)) {
            (Some(gripper), _) => {
                // That of the arm that carries it: a robot may span several.
                let own = config.coordinator_joints.get(carrier(model, planned, index).unwrap_or(0));
                let part = own.and_then(|joint| measured.grippers.get(joint)).copied().unwrap_or(1.0);
                gripper.closed + (gripper.open - gripper.closed) * part
            }
            (None, Some(Unplanned::Measured(ours))) => {
                // Before the first measurement nothing is planned; the guard has no better place for it.
                let before = || last.unwrap_or_else(|| 0.0_f64.max(joint.limits.lower).min(joint.limits.upper));
                measured.positions.get(ours).copied().unwrap_or_else(before)
            }
            (None, Some(Unplanned::Fixed(position))) => *position,
            (None, None) => last.unwrap_or_else(|| widest(model, index)),
        };
        positions.insert(joint.name.clone(), position);
    }
    positions
}

/// Returns the position at which the links that a joint moves are farthest apart from each other and from their parent;
/// of a joint without limits within one turn.
fn widest(model: &RobotModel, joint: usize) -> f64 {
    let Some(own) = model.joints.get(joint) else { return 0.0 };
    let moves =
        |j: usize| j == joint || model.joints.get(j).is_some_and(|o| o.mimic.is_some_and(|m| m.leader == joint));
    // The joint that a link moves with: the nearest one above it that is not fixed.
    let mover = |link: usize| {
        let above = |joint: &usize| model.joints.get(*joint).and_then(|joint| joint.parent.checked_sub(1));
        let joints = std::iter::successors(link.checked_sub(1), above);
        { joints }.find(|joint| model.joints.get(*joint).is_some_and(Joint::is_movable))
    };
    let movers: Vec<Option<usize>> = (0..model.links.len()).map(mover).collect();
    let moved = (0..model.joints.len()).filter(|j| moves(*j)).map(|j| (Some(j), j + 1));
    let parts: Vec<_> = moved.chain([(mover(own.parent), own.parent)]).collect();
    let spread = |position: f64| {
        let named = HashMap::from([(own.name.clone(), position)]);
        let poses = model.link_poses(&model.positions(&named));
        let pose = |link: usize| poses.get(link).copied().unwrap_or_default();
        // Centres of the shapes that move as one; without shapes the frame counts.
        let middle = |(mover, frame): &(Option<usize>, usize)| {
            let links = model.links.iter().enumerate().filter(|(link, _)| movers.get(*link) == Some(mover));
            let shapes = links.flat_map(|(index, link)| {
                link.collisions.iter().map(move |shape| (pose(index) * shape.origin).translation.vector)
            });
            let (sum, count) = shapes.fold((nalgebra::Vector3::zeros(), 0.0), |(sum, n), at| (sum + at, n + 1.0));
            if count > 0.0 { sum / count } else { pose(*frame).translation.vector }
        };
        let middles: Vec<nalgebra::Vector3<f64>> = parts.iter().map(middle).collect();
        let pairs = middles.iter().enumerate().flat_map(|(i, a)| middles.iter().take(i).map(move |b| (a - b).norm()));
        pairs.sum::<f64>()
    };
    let bound = |limit: f64, else_at: f64| if limit.is_finite() { limit } else { else_at };
    let (lower, upper) = (bound(own.limits.lower, -PI), bound(own.limits.upper, PI));
    let part = |k: u32| lower + (upper - lower) * f64::from(k) / f64::from(SAMPLES);
    // An end, which is what a gripper opens to, unless the joint is clearly wider in between.
    let order = [SAMPLES, 0].into_iter().chain(1..SAMPLES);
    let mut best = (f64::NEG_INFINITY, 0.0);
    for (k, at) in order.map(|k| (k, part(k))) {
        let (spread, clearly) = (spread(at), if k % SAMPLES == 0 { 1.0 } else { 1.1 });
        if spread > clearly * best.0 + 1e-9 {
            best = (spread, at);
        }
    }
    best.1
}

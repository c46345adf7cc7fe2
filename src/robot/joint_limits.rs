//! MoveIt's `joint_limits.yaml`: limits that URDF cannot state, above all accelerations and jerks.
//!
//! ```yaml
//! joint_limits:
//!   joint1: {has_velocity_limits: true, max_velocity: 2.0, has_acceleration_limits: true, max_acceleration: 5.0}
//! ```
//! A limit applies unless its `has_…` flag is false. Positions can only be narrowed.

use crate::robot::model::RobotModel;
use crate::yaml::{Diag, NodeId, SourceId, Tree, did_you_mean};

/// Reads a file and applies its limits to the robot. Mistakes are reported.
pub fn apply(tree: &mut Tree, source: SourceId, robot: &mut RobotModel) {
    let Some(root) = tree.parse(source) else { return };
    let Some((_, joints)) = tree.entry(root, "joint_limits") else {
        let diag = Diag::error("the key `joint_limits` is missing").at(tree.label(root));
        return tree.report(diag);
    };
    for (key, limits) in tree.entries(joints).to_vec() {
        let name = tree.text(key).unwrap_or_default().to_owned();
        let Some(i) = robot.joint_index(&name) else {
            let known = robot.joints.iter().filter(|j| j.is_movable()).map(|j| j.name.as_str());
            let hint = did_you_mean(&name, known, "the joints are");
            let diag = Diag::warning(format!("this robot has no joint `{name}`")).at(tree.label(key));
            tree.report(diag.maybe_hint(hint));
            continue;
        };
        let read = Entry::read(tree, limits);
        let Some(joint) = robot.joints.get_mut(i) else { continue };
        let own = &mut joint.limits;
        own.velocity = read.velocity.unwrap_or(own.velocity);
        own.effort = read.effort.unwrap_or(own.effort);
        own.acceleration = read.acceleration.or(own.acceleration);
        own.jerk = read.jerk.or(own.jerk);
        own.lower = read.lower.map_or(own.lower, |lower| own.lower.max(lower));
        own.upper = read.upper.map_or(own.upper, |upper| own.upper.min(upper));
        if own.lower > own.upper {
            let what = format!("no position is left for the joint `{name}`: {} to {}", own.lower, own.upper);
            let diag = Diag::error(what).at(tree.label(limits));
            tree.report(diag.hint("positions here narrow those of the URDF; are they swapped?"));
        }
    }
}

/// Limits of one joint as written; `None` where absent or switched off.
#[derive(Debug, Default)]
struct Entry {
    lower: Option<f64>,
    upper: Option<f64>,
    velocity: Option<f64>,
    acceleration: Option<f64>,
    jerk: Option<f64>,
    effort: Option<f64>,
}

impl Entry {
    fn read(tree: &mut Tree, node: NodeId) -> Self {
        let on = |tree: &Tree, what: &str| {
            let flag = tree.get(node, &format!("has_{what}_limits")).and_then(|n| tree.text(n));
            !flag.is_some_and(|text| matches!(text.to_lowercase().as_str(), "false" | "no" | "off" | "0"))
        };
        let positive = |tree: &mut Tree, what: &str, key: &str| {
            let value = number(tree, node, key).filter(|_| on(tree, what))?;
            if value > 0.0 {
                return Some(value);
            }
            let at = tree.get(node, key).unwrap_or(node);
            let diag = Diag::error(format!("`{key}` is {value}: a limit must be above zero")).at(tree.label(at));
            tree.report(diag);
            None
        };
        let bounded = on(tree, "position");
        Self {
            lower: number(tree, node, "min_position").filter(|_| bounded),
            upper: number(tree, node, "max_position").filter(|_| bounded),
            velocity: positive(tree, "velocity", "max_velocity"),
            acceleration: positive(tree, "acceleration", "max_acceleration"),
            jerk: positive(tree, "jerk", "max_jerk"),
            effort: positive(tree, "effort", "max_effort"),
        }
    }
}

/// Returns a finite number; reports anything else.
fn number(tree: &mut Tree, node: NodeId, key: &str) -> Option<f64> {
    let value = tree.get(node, key)?;
    let number = tree.text(value).and_then(|text| text.trim().parse::<f64>().ok()).filter(|v| v.is_finite());
    if number.is_none() {
        let diag = Diag::error(format!("`{key}` is not a number")).at(tree.label(value));
        tree.report(diag);
    }
    number
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::urdf;

    fn robot() -> RobotModel {
        let text = "<robot name='t'><link name='a'/><link name='b'/><joint name='j1' type='revolute'><parent link='a'/>\
            <child link='b'/><limit lower='-2' upper='2' velocity='3' effort='4'/></joint></robot>";
        urdf::from_text("t", text).unwrap()
    }

    fn with(text: &str) -> (RobotModel, String) {
        let (mut tree, mut robot) = (Tree::new(), robot());
        let source = tree.add_source("joint_limits.yaml", text);
        apply(&mut tree, source, &mut robot);
        let text = tree.diags().iter().map(|d| crate::yaml::render(&tree, d, false)).collect();
        (robot, text)
    }

    #[test]
    fn limits_are_completed() {
        let (robot, text) = with(
            "default_velocity_scaling_factor: 0.1\njoint_limits:\n  j1:\n    has_velocity_limits: true\n    max_velocity: 1.5\n\
             \x20   has_acceleration_limits: true\n    max_acceleration: 5\n    has_jerk_limits: false\n    max_jerk: 9\n\
             \x20   min_position: -3\n    max_position: 1\n",
        );
        let limits = robot.joints[0].limits;
        assert!(text.is_empty(), "{text}");
        assert_eq!((limits.lower, limits.upper, limits.velocity), (-2.0, 1.0, 1.5));
        assert_eq!((limits.acceleration, limits.jerk, limits.effort), (Some(5.0), None, 4.0));
    }

    #[test]
    fn mistakes_are_found() {
        for (text, what) in [
            ("joints: {}", "the key `joint_limits` is missing"),
            ("joint_limits: {j2: {max_velocity: 1}}", "this robot has no joint `j2`"),
            ("joint_limits: {j1: {max_velocity: fast}}", "`max_velocity` is not a number"),
            ("joint_limits: {j1: {max_velocity: -1}}", "a limit must be above zero"),
            ("joint_limits: {j1: {min_position: 5}}", "no position is left"),
        ] {
            let (_, found) = with(text);
            assert!(found.contains(what), "{what}\n{found}");
        }
    }
}

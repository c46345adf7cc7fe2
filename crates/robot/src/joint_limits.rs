//! MoveIt's `joint_limits.yaml`: limits that URDF cannot state, above all accelerations and jerks.
//!
//! ```yaml
//! joint_limits:
//!   joint1: {has_velocity_limits: true, max_velocity: 2.0, has_acceleration_limits: true, max_acceleration: 5.0}
//! ```
//! A limit applies unless its `has_…` flag is false. Positions can only be narrowed, also by soft limits, and of
//! acceleration and deceleration the smaller one counts.

use crate::model::RobotModel;
use dimos_yaml::{Diag, NodeId, SourceId, Tree, closest, did_you_mean, quote};

/// The keys of a joint, of MoveIt and of ros2_control.
const KEYS: [&str; 19] = [
    "has_position_limits",
    "min_position",
    "max_position",
    "has_velocity_limits",
    "max_velocity",
    "has_acceleration_limits",
    "max_acceleration",
    "has_deceleration_limits",
    "max_deceleration",
    "has_jerk_limits",
    "max_jerk",
    "has_effort_limits",
    "max_effort",
    "has_soft_limits",
    "soft_lower_limit",
    "soft_upper_limit",
    "k_position",
    "k_velocity",
    "angle_wraparound",
];

/// Reads a file and applies its limits to the robot. Mistakes are reported.
pub fn apply(tree: &mut Tree, source: SourceId, robot: &mut RobotModel) {
    let Some(root) = tree.parse(source) else { return };
    let joints = tree.flattened(root).into_iter().find(|(key, _)| tree.text(*key) == Some("joint_limits"));
    let Some((_, joints)) = joints else {
        let diag = Diag::error("the key `joint_limits` is missing").at(tree.label(root));
        return tree.report(diag);
    };
    for (key, limits) in tree.flattened(joints) {
        let name = tree.text(key).unwrap_or_default().to_owned();
        let Some(i) = robot.joint_index(&name) else {
            let known = robot.joints.iter().filter(|j| j.is_movable()).map(|j| j.name.as_str());
            let hint = did_you_mean(&name, known, "the joints are");
            let diag = Diag::warning(format!("this robot has no joint `{name}`")).at(tree.label(key));
            tree.report(diag.maybe_hint(hint));
            continue;
        };
        let entries = tree.flattened(limits);
        let read = Reader { tree, entries: &entries }.limits();
        let Some(joint) = robot.joints.get_mut(i) else { continue };
        let own = &mut joint.limits;
        own.velocity = read.velocity.unwrap_or(own.velocity);
        own.effort = read.effort.unwrap_or(own.effort);
        own.acceleration =
            [read.acceleration.or(own.acceleration), read.deceleration].into_iter().flatten().reduce(f64::min);
        own.jerk = read.jerk.or(own.jerk);
        own.lower = read.lower.into_iter().fold(own.lower, f64::max);
        own.upper = read.upper.into_iter().fold(own.upper, f64::min);
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
    /// Lowest positions: hard and soft.
    lower: Vec<f64>,
    /// Highest positions: hard and soft.
    upper: Vec<f64>,
    velocity: Option<f64>,
    acceleration: Option<f64>,
    /// Without its sign: MoveIt writes it negative.
    deceleration: Option<f64>,
    jerk: Option<f64>,
    effort: Option<f64>,
}

/// Reader of the entries of one joint.
struct Reader<'t> {
    tree: &'t mut Tree,
    entries: &'t [(NodeId, NodeId)],
}

impl Reader<'_> {
    fn limits(&mut self) -> Entry {
        self.report_unknown_keys();
        let position = |reader: &mut Self, [hard, soft]: [&str; 2]| {
            let hard = reader.number(hard).filter(|_| reader.on("position"));
            let soft = reader.number(soft).filter(|_| reader.on("soft"));
            hard.into_iter().chain(soft).collect()
        };
        Entry {
            lower: position(self, ["min_position", "soft_lower_limit"]),
            upper: position(self, ["max_position", "soft_upper_limit"]),
            velocity: self.positive("velocity", "max_velocity"),
            acceleration: self.positive("acceleration", "max_acceleration"),
            deceleration: self.positive("deceleration", "max_deceleration"),
            jerk: self.positive("jerk", "max_jerk"),
            effort: self.positive("effort", "max_effort"),
        }
    }

    fn report_unknown_keys(&mut self) {
        for (key, _) in self.entries {
            let name = self.tree.text(*key).unwrap_or_default().to_owned();
            if !KEYS.contains(&name.as_str()) {
                let hint = closest(&name, KEYS).map(|near| format!("did you mean `{near}`?"));
                let diag = Diag::warning(format!("unknown key {}: it has no effect", quote(&name)));
                self.tree.report(diag.at(self.tree.label(*key)).maybe_hint(hint));
            }
        }
    }

    fn get(&self, key: &str) -> Option<NodeId> {
        self.entries.iter().find(|(known, _)| self.tree.text(*known) == Some(key)).map(|(_, value)| *value)
    }

    /// Returns whether limits are not switched off.
    fn on(&self, what: &str) -> bool {
        let flag = self.get(&format!("has_{what}_limits")).and_then(|value| self.tree.text(value));
        !flag.is_some_and(|text| matches!(text.to_lowercase().as_str(), "false" | "no" | "off" | "0"))
    }

    /// Returns a finite number; reports anything else.
    fn number(&mut self, key: &str) -> Option<f64> {
        let value = self.get(key)?;
        let number = self.tree.text(value).and_then(|text| text.trim().parse::<f64>().ok()).filter(|v| v.is_finite());
        if number.is_none() {
            let diag = Diag::error(format!("`{key}` is not a number")).at(self.tree.label(value));
            self.tree.report(diag);
        }
        number
    }

    /// Returns a limit above zero that is not switched off; reports another one. A deceleration may have a minus.
    fn positive(&mut self, what: &str, key: &str) -> Option<f64> {
        let value = self.number(key).filter(|_| self.on(what))?;
        let value = if what == "deceleration" { value.abs() } else { value };
        if value > 0.0 {
            return Some(value);
        }
        let at = self.get(key)?;
        let diag = Diag::error(format!("`{key}` is {value}: a limit must be above zero")).at(self.tree.label(at));
        self.tree.report(diag);
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::urdf;

    fn robot() -> RobotModel {
        let text = "<robot name='t'><link name='a'/><link name='b'/><joint name='j1' type='revolute'><parent link='a'/>\
            <child link='b'/><limit lower='-2' upper='2' velocity='3' effort='4'/></joint></robot>";
        urdf::from_text("t", text).unwrap()
    }

    fn with(text: &str) -> (RobotModel, String) {
        let (mut tree, mut robot) = (Tree::new(), robot());
        let source = tree.add_source("joint_limits.yaml", text);
        apply(&mut tree, source, &mut robot);
        let text = tree.diags().iter().map(|d| dimos_yaml::render(&tree, d, false)).collect();
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
    fn the_keys_of_moveit_and_ros2_control_are_known() {
        let (robot, text) = with(
            "joint_limits: {j1: {has_position_limits: yes, has_effort_limits: true, angle_wraparound: false, \
             k_position: 1, k_velocity: 2, has_soft_limits: true, soft_lower_limit: -1, soft_upper_limit: 9, \
             has_deceleration_limits: true, max_deceleration: -3, max_acceleration: 5, max_effort: 2}}",
        );
        let limits = robot.joints[0].limits;
        assert!(text.is_empty(), "{text}");
        assert_eq!((limits.lower, limits.upper, limits.effort, limits.acceleration), (-1.0, 2.0, 2.0, Some(3.0)));
    }

    #[test]
    fn mistakes_are_found() {
        for (text, what) in [
            ("joints: {}", "the key `joint_limits` is missing"),
            ("joint_limits: {j2: {max_velocity: 1}}", "this robot has no joint `j2`"),
            ("joint_limits: {j1: {max_velocity: fast}}", "`max_velocity` is not a number"),
            ("joint_limits: {j1: {max_velocity: -1}}", "a limit must be above zero"),
            ("joint_limits: {j1: {min_position: 5}}", "no position is left"),
            ("joint_limits: {j1: {soft_upper_limit: -3}}", "no position is left"),
            ("joint_limits: {j1: {max_deceleration: 0}}", "a limit must be above zero"),
            ("joint_limits: {j1: {max_velocty: 1}}", "did you mean `max_velocity`?"),
            ("joint_limits: {j1: {<<: 3}}", "`<<` takes a group or a list of groups"),
            ("joint_limits: {j1: {<<: [{max_velocity: 1}, 3]}}", "`<<` takes a group or a list of groups"),
        ] {
            let (_, found) = with(text);
            assert!(found.contains(what), "{what}\n{found}");
        }
    }
}

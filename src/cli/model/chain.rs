//! Links and joints of `fk` and `ik`: which frames, and which joints lie between them.

use crate::cli::exit::{Failure, Result};
use dimos_robot::srdf::Semantics;
use dimos_robot::{Joint, RobotModel};
use dimos_yaml::did_you_mean;

/// Checks that there is a position for every joint of a link or robot.
pub(super) fn check_count(of: &str, joints: &[&str], positions: &[f64]) -> Result<()> {
    if joints.len() == positions.len() {
        return Ok(());
    }
    let what = format!("`{of}` takes {} positions, found {}", joints.len(), positions.len());
    Err(Failure::usage(what).hint(format!("the joints are: {}", joints.join(" "))))
}

/// Two links and the independent joints between them.
pub(super) struct Chain<'r> {
    robot: &'r RobotModel,
    /// Reference link of poses.
    pub base: usize,
    /// The other link.
    pub link: usize,
    /// The joints between them, in order from the base; leaders of mimic joints included.
    pub joints: Vec<usize>,
}

impl<'r> Chain<'r> {
    /// Returns the chain between two links by name; default: from the root to the end of the arm.
    pub fn between(robot: &'r RobotModel, base: Option<&str>, link: Option<&str>) -> Result<Self> {
        let base = base.map_or(Ok(0), |name| index(robot, name))?;
        let link = link.map_or_else(|| Ok(end_of_arm(robot)), |name| index(robot, name))?;
        Ok(Self { robot, base, link, joints: robot.independent_of(&robot.path(base, link)) })
    }

    /// Returns the joints of an SRDF group, and the link at their end unless one is named.
    pub fn of_group(
        robot: &'r RobotModel,
        semantics: &Semantics,
        group: &str,
        base: Option<&str>,
        link: Option<&str>,
    ) -> Result<Self> {
        let base = base.map_or(Ok(0), |name| index(robot, name))?;
        let joints = group_joints(robot, semantics, group)?;
        let tip = semantics.groups.iter().find(|own| own.name == group).and_then(|own| own.chains.first());
        let last = joints.last().map_or(0, |joint| joint + 1);
        let link = match (link, tip) {
            (Some(name), _) => index(robot, name)?,
            (None, Some((_, tip))) => robot.link_index(tip).unwrap_or(last),
            (None, None) => last,
        };
        Ok(Self { robot, base, link, joints })
    }

    /// Returns the name of a link.
    pub fn name(&self, link: usize) -> &'r str {
        self.robot.links.get(link).map_or("?", |link| link.name.as_str())
    }

    /// Returns the joints.
    pub fn all(&self) -> impl Iterator<Item = &'r Joint> + use<'_, 'r> {
        self.joints.iter().filter_map(|joint| self.robot.joints.get(*joint))
    }

    /// Returns the names of the joints.
    pub fn names(&self) -> Vec<&'r str> {
        self.all().map(|joint| joint.name.as_str()).collect()
    }

    /// Returns a warning for each position [rad or m] outside its limits.
    pub fn outside(&self, positions: &[f64]) -> Vec<String> {
        let outside = |(joint, q): (&Joint, &f64)| {
            let (name, unit, limits) = (&joint.name, joint.kind.unit(), joint.limits);
            (!(limits.lower..=limits.upper).contains(q)).then(|| {
                let (lower, upper) = (limits.lower, limits.upper);
                format!("warning: {name} at {q} {unit} is outside its limits {lower:.4} to {upper:.4} {unit}")
            })
        };
        self.all().zip(positions).filter_map(outside).collect()
    }
}

/// Returns the index of a link by name.
pub(super) fn index(robot: &RobotModel, name: &str) -> Result<usize> {
    robot.link_index(name).ok_or_else(|| {
        let hint = did_you_mean(name, robot.links.iter().map(|l| l.name.as_str()), "the links are");
        Failure { hint, ..Failure::usage(format!("{} has no link `{name}`", robot.name)) }
    })
}

/// Returns the independent joints of an SRDF group.
pub(super) fn group_joints(robot: &RobotModel, semantics: &Semantics, group: &str) -> Result<Vec<usize>> {
    if semantics.groups.is_empty() {
        return Err(Failure::usage(format!("unknown group `{group}`")).hint("groups are in an SRDF: --srdf FILE"));
    }
    let joints = semantics.group_joints(robot, group).ok_or_else(|| {
        let groups = semantics.groups.iter().map(|group| group.name.as_str());
        let hint = did_you_mean(group, groups, "the groups are");
        Failure { hint, ..Failure::usage(format!("unknown group `{group}`")) }
    })?;
    if joints.is_empty() {
        return Err(Failure::usage(format!("the group `{group}` has no independent joints")));
    }
    Ok(joints)
}

/// Returns the first link at the end of the longest chain of joints that passes no finger of a gripper.
pub(in crate::cli) fn end_of_arm(robot: &RobotModel) -> usize {
    let mut depths: Vec<Option<usize>> = vec![None; robot.links.len()];
    if let Some(root) = depths.first_mut() {
        *root = Some(0);
    }
    for (number, joint) in robot.joints.iter().enumerate() {
        let depth = depths.get(joint.parent).copied().flatten().filter(|_| !is_finger(robot, number));
        if let Some(own) = depths.get_mut(joint.child) {
            *own = depth.map(|depth| depth + 1);
        }
    }
    let most = depths.iter().flatten().max().copied().unwrap_or(0);
    depths.iter().position(|depth| *depth == Some(most)).unwrap_or(0)
}

/// Returns whether a joint moves a finger: the last of its branch that mimics or leads another, or is beside another
/// moving joint of the same link.
fn is_finger(robot: &RobotModel, number: usize) -> bool {
    let Some(joint) = robot.joints.get(number).filter(|joint| joint.is_movable()) else { return false };
    let leads = robot.joints.iter().any(|other| other.mimic.is_some_and(|mimic| mimic.leader == number));
    let others = || robot.joints.iter().enumerate().filter(|(other, own)| *other != number && own.is_movable());
    let beside = others().any(|(_, other)| other.parent == joint.parent);
    let below = |other: &Joint| other.is_independent() && robot.chain(joint.child, other.child).is_some();
    let last = !others().any(|(_, other)| below(other));
    last && (joint.mimic.is_some() || leads || beside)
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_robot::{Source, load};

    #[test]
    fn the_end_of_an_arm_is_its_last_link_before_the_fingers() {
        for (name, end) in [
            ("yourarm", "flange"),
            ("yourarm_gripper", "tcp"),
            ("xarm6", "link_eef"),
            ("xarm6_gripper", "link_tcp"),
            ("piper_gripper", "tcp"),
        ] {
            let robot = load(&Source::new(format!("builtin:{name}"))).into_model().unwrap();
            assert_eq!(robot.links[end_of_arm(&robot)].name, end, "{name}");
        }
    }
}

//! Pairs of links that are not checked against each other, and why: every plan says which.

use super::planning_scene::{PlannedRobot, PlanningScene};
use crate::collision::scene::{Unchecked, unchecked};
use crate::collision::world::World;

/// A pair of links that is not checked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IgnoredPair {
    /// Their names, as in contacts: with the robot's name, if it has one.
    pub links: [String; 2],
    /// Why, for people.
    pub reason: String,
}

impl PlanningScene {
    /// Returns the pairs that are not checked while these robots move, by index: those of their own links, and of what
    /// they hold with links that may touch it.
    pub fn ignored_pairs(&self, world: &World, robots: &[usize]) -> Vec<IgnoredPair> {
        let mut pairs: Vec<IgnoredPair> =
            robots.iter().filter_map(|robot| self.ignored.get(*robot)).flat_map(|own| own.iter().cloned()).collect();
        for object in world.held().iter().filter(|object| robots.contains(&object.robot)) {
            let Some(robot) = self.robots.get(object.robot) else { continue };
            for link in std::iter::once(&object.link).chain(&object.touch_links) {
                let links = [full(robot, link), full(robot, &object.name)];
                pairs.push(IgnoredPair { links, reason: "held".to_owned() });
            }
        }
        pairs
    }
}

/// Returns the pairs of a robot's links that are not checked; `always` are those that touch in every configuration,
/// `disabled` those of the SRDF with its reasons.
pub(in crate::planning) fn of_robot(
    robot: &PlannedRobot,
    always: &[[String; 2]],
    disabled: &[([String; 2], String)],
) -> Vec<IgnoredPair> {
    let body = &robot.body;
    let has_shape = |link: &usize| body.solids.get(*link).is_some_and(|solids| !solids.is_empty());
    let links: Vec<usize> = (0..body.solids.len()).filter(has_shape).collect();
    let link = |index: usize| body.model.links.get(index).map_or("", |link| link.name.as_str());
    let mut pairs = Vec::new();
    for (number, b) in links.iter().enumerate() {
        for a in links.iter().take(number) {
            let own = [link(*a), link(*b)];
            let is = |[x, y]: &[String; 2]| own == [x, y] || own == [y, x];
            let reason = match unchecked(body, *a, *b) {
                None => continue,
                Some(Unchecked::Fixed) => "fixed to each other".to_owned(),
                Some(Unchecked::Neighbours) => "neighbours".to_owned(),
                // A bound, not the distance itself.
                Some(Unchecked::Apart(distance)) => format!("proven apart: at least {:.2} mm", distance * 1e3),
                Some(Unchecked::Allowed) => match disabled.iter().find(|(pair, _)| is(pair)) {
                    Some((_, reason)) => format!("SRDF: {reason}"),
                    None if always.iter().any(is) => "touch in every configuration".to_owned(),
                    None => "collision_exclusion_pairs of the blueprint".to_owned(),
                },
            };
            pairs.push(IgnoredPair { links: own.map(|link| full(robot, link)), reason });
        }
    }
    pairs
}

fn full(robot: &PlannedRobot, link: &str) -> String {
    let name = &robot.config.name;
    if name.is_empty() { link.to_owned() } else { format!("{name}/{link}") }
}

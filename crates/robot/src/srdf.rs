//! SRDF: groups, named poses, end effectors, passive joints, allowed collision pairs.
//!
//! An SRDF is often shared by variants of a robot: unknown links and joints are warnings.

mod checks;

use std::collections::BTreeSet;

use crate::model::{Joint, RobotModel};
use crate::xml::{Attribute, Calls, Element, SourcePos};
use dimos_yaml::{Diag, Tree, did_you_mean};

/// Contents of an SRDF.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Semantics {
    /// Groups of joints.
    pub groups: Vec<Group>,
    /// Named poses.
    pub poses: Vec<NamedPose>,
    /// End effectors.
    pub end_effectors: Vec<EndEffector>,
    /// Joints without a motor: they belong to no group.
    pub passive: Vec<String>,
    /// Allowed collision pairs.
    pub disabled: Vec<DisabledPair>,
}

/// A group of joints and links.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Group {
    /// Name of the group.
    pub name: String,
    /// Joints, each with its child link.
    pub joints: Vec<String>,
    /// Links, each with the joint that carries it.
    pub links: Vec<String>,
    /// Base and tip of chains.
    pub chains: Vec<(String, String)>,
    /// Names of its subgroups.
    pub groups: Vec<String>,
}

/// A named pose of a group.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedPose {
    /// Name of the pose.
    pub name: String,
    /// The group.
    pub group: String,
    /// Joints and their positions [rad or m].
    pub positions: Vec<(String, f64)>,
    /// Position of its name in the SRDF.
    pub at: SourcePos,
}

impl NamedPose {
    /// Returns the first joint outside its limits, and its position [rad or m].
    pub fn outside<'r>(&self, robot: &'r RobotModel) -> Option<(&'r Joint, f64)> {
        let joint = |name: &str| robot.joint_index(name).and_then(|index| robot.joints.get(index));
        let mut all = self.positions.iter().filter_map(|(name, q)| Some((joint(name)?, *q)));
        all.find(|(joint, q)| !(joint.limits.lower - 1e-9..=joint.limits.upper + 1e-9).contains(q))
    }
}

/// An end effector.
#[derive(Debug, Clone, PartialEq)]
pub struct EndEffector {
    /// Name of the end effector.
    pub name: String,
    /// The group of its own joints and links.
    pub group: String,
    /// The link it is mounted on.
    pub parent_link: String,
    /// The group that carries it, if given.
    pub parent_group: Option<String>,
}

/// An allowed collision pair (`disable_collisions`).
#[derive(Debug, Clone, PartialEq)]
pub struct DisabledPair {
    /// One link.
    pub a: String,
    /// The other.
    pub b: String,
    /// The reason: `Adjacent`, `Never` …
    pub reason: String,
}

impl Semantics {
    /// Returns the indices of the independent joints of a group, in tree order, without passive ones; `None` for an
    /// unknown group.
    pub fn group_joints(&self, robot: &RobotModel, group: &str) -> Option<Vec<usize>> {
        let mut joints = BTreeSet::new();
        let mut open = vec![group];
        let mut seen = BTreeSet::new();
        self.groups.iter().find(|g| g.name == group)?;
        while let Some(name) = open.pop() {
            let Some(group) = self.groups.iter().find(|g| g.name == name) else { continue };
            if !seen.insert(name) {
                continue;
            }
            joints.extend(group.joints.iter().filter_map(|j| robot.joint_index(j)));
            let carrier = |link: &String| robot.link_index(link).and_then(|l| l.checked_sub(1));
            joints.extend(group.links.iter().filter_map(carrier));
            for (base, tip) in &group.chains {
                let ends = robot.link_index(base).zip(robot.link_index(tip));
                joints.extend(ends.and_then(|(base, tip)| robot.chain(base, tip)).unwrap_or_default());
            }
            open.extend(group.groups.iter().map(String::as_str));
        }
        let passive = |name: &String| self.passive.contains(name);
        let own = |i: &usize| robot.joints.get(*i).is_some_and(|j| j.is_independent() && !passive(&j.name));
        Some(joints.into_iter().filter(own).collect())
    }

    /// Returns the named poses that cover all these joints, in their order. Of two with the same name, the first one
    /// wins.
    pub fn poses_of(&self, joints: &[String]) -> Vec<(&str, Vec<f64>)> {
        let mut poses: Vec<(&str, Vec<f64>)> = Vec::new();
        for pose in &self.poses {
            let position = |joint: &String| pose.positions.iter().find(|(name, _)| name == joint).map(|(_, q)| *q);
            let positions: Option<Vec<f64>> = joints.iter().map(position).collect();
            let known = poses.iter().any(|(name, _)| *name == pose.name);
            poses.extend(positions.filter(|_| !known && !joints.is_empty()).map(|q| (pose.name.as_str(), q)));
        }
        poses
    }

    /// Returns the allowed collision pairs, by name.
    pub fn disabled_pairs(&self) -> impl Iterator<Item = (String, String)> + '_ {
        self.disabled.iter().map(|pair| (pair.a.clone(), pair.b.clone()))
    }
}

/// Reads an SRDF for a robot.
pub fn read(root: &Element, robot: &RobotModel, tree: &mut Tree, calls: &Calls) -> Option<Semantics> {
    let mut reader = Reader { robot, tree, calls, missing: Vec::new() };
    if root.name != "robot" {
        let what = format!("the root element is `{}`, not `robot`", root.name);
        reader.tree.report(Diag::error(what).at(root.at.label()).hint("an SRDF starts with <robot name=\"…\">"));
        return None;
    }
    let mut out = Semantics::default();
    // As in MoveIt: links without default checks, pairs of theirs that are checked all the same.
    let (mut unchecked, mut enabled) = (Vec::new(), Vec::new());
    for element in root.elements() {
        match element.name.as_str() {
            "group" => out.groups.extend(reader.group(element)),
            "group_state" => out.poses.extend(reader.pose(element)),
            "end_effector" => out.end_effectors.extend(reader.end_effector(element)),
            "passive_joint" => out.passive.extend(reader.named(element, "name", true)),
            "disable_collisions" => out.disabled.extend(reader.pair(element)),
            "disable_default_collisions" => unchecked.extend(reader.named(element, "link", false)),
            "enable_collisions" => enabled.extend(reader.pair(element)),
            _ => {}
        }
    }
    out.disabled.extend(disabled_by_default(robot, &unchecked, &enabled, &out.disabled));
    reader.check_name(root);
    reader.check_elements(root);
    reader.check_groups(root, &out);
    reader.check_duplicates(root);
    reader.check_cycles(root, &out);
    if let [first, rest @ ..] = &reader.missing[..] {
        let (count, pairs) = (rest.len() + 1, if rest.is_empty() { "pair" } else { "pairs" });
        let what = format!("{count} {pairs} of `disable_collisions` with links that this robot lacks");
        let diag = Diag::warning(what).at(first.label());
        reader.tree.report(if rest.is_empty() { diag } else { diag.note("this is the first of them") });
    }
    Some(out)
}

/// Returns the pairs of links that `disable_default_collisions` allows, without those enabled again.
fn disabled_by_default(
    robot: &RobotModel,
    unchecked: &[String],
    enabled: &[DisabledPair],
    disabled: &[DisabledPair],
) -> Vec<DisabledPair> {
    let is = |pair: &DisabledPair, a: &str, b: &str| (pair.a == a && pair.b == b) || (pair.a == b && pair.b == a);
    let mut pairs: Vec<DisabledPair> = Vec::new();
    for a in unchecked {
        for b in robot.links.iter().map(|link| &link.name).filter(|b| *b != a) {
            if !enabled.iter().chain(disabled).chain(&pairs).any(|pair| is(pair, a, b)) {
                pairs.push(DisabledPair { a: a.clone(), b: b.clone(), reason: "Default".to_owned() });
            }
        }
    }
    pairs
}

struct Reader<'t> {
    robot: &'t RobotModel,
    tree: &'t mut Tree,
    calls: &'t Calls,
    /// Positions of pairs of links that the robot lacks.
    missing: Vec<SourcePos>,
}

impl Reader<'_> {
    fn needed<'e>(&mut self, element: &'e Element, name: &str) -> Option<&'e Attribute> {
        let found = element.attribute(name).filter(|a| !a.value.is_empty());
        if found.is_none() {
            let what = format!("this `{}` has no `{name}`", element.name);
            let diag = self.calls.explain(Diag::error(what).at(element.at.label()), element.at);
            self.tree.report(diag);
        }
        found
    }

    /// Returns a name that the robot should have.
    fn named(&mut self, element: &Element, attribute: &str, joint: bool) -> Option<String> {
        let found = self.needed(element, attribute)?;
        let (what, known): (_, Vec<&str>) = match joint {
            true => ("joint", self.robot.joints.iter().map(|j| j.name.as_str()).collect()),
            false => ("link", self.robot.links.iter().map(|l| l.name.as_str()).collect()),
        };
        if !known.contains(&found.value.as_str()) {
            let hint = did_you_mean(&found.value, known, &format!("the {what}s are"));
            let diag = Diag::warning(format!("this robot has no {what} `{}`", found.value)).at(found.at.label());
            let diag = self.calls.explain(diag.maybe_hint(hint), found.at);
            self.tree.report(diag);
            return None;
        }
        Some(found.value.clone())
    }

    fn group(&mut self, element: &Element) -> Option<Group> {
        let mut group = Group { name: self.needed(element, "name")?.value.clone(), ..Group::default() };
        for part in element.elements() {
            match part.name.as_str() {
                "joint" => group.joints.extend(self.named(part, "name", true)),
                "link" => group.links.extend(self.named(part, "name", false)),
                "chain" => {
                    let (base, tip) = (self.named(part, "base_link", false), self.named(part, "tip_link", false));
                    let Some((base, tip)) = base.zip(tip) else { continue };
                    let ends = self.robot.link_index(&base).zip(self.robot.link_index(&tip));
                    if ends.and_then(|(b, t)| self.robot.chain(b, t)).is_none() {
                        let what = format!("`{tip}` is not below `{base}`: this is not a chain");
                        self.tree.report(Diag::error(what).at(part.at.label()));
                    }
                    group.chains.push((base, tip));
                }
                "group" => group.groups.extend(self.needed(part, "name").map(|a| a.value.clone())),
                _ => {}
            }
        }
        Some(group)
    }

    fn pose(&mut self, element: &Element) -> Option<NamedPose> {
        let Attribute { value: name, at, .. } = self.needed(element, "name")?.clone();
        let group = self.needed(element, "group")?.value.clone();
        let mut positions = Vec::new();
        for joint in element.named("joint") {
            let Some(name) = self.named(joint, "name", true) else { continue };
            let Some(value) = self.needed(joint, "value") else { continue };
            match value.value.trim().parse::<f64>() {
                Ok(position) if position.is_finite() => positions.push((name, position)),
                _ => {
                    let what = format!("`{}` is not a joint position", value.value);
                    self.tree.report(Diag::error(what).at(value.at.label()));
                }
            }
        }
        Some(NamedPose { name, group, positions, at })
    }

    fn end_effector(&mut self, element: &Element) -> Option<EndEffector> {
        Some(EndEffector {
            name: self.needed(element, "name")?.value.clone(),
            group: self.needed(element, "group")?.value.clone(),
            parent_link: self.named(element, "parent_link", false)?,
            parent_group: element.attribute("parent_group").map(|a| a.value.clone()),
        })
    }

    fn pair(&mut self, element: &Element) -> Option<DisabledPair> {
        let a = self.needed(element, "link1")?.value.clone();
        let b = self.needed(element, "link2")?.value.clone();
        if self.robot.link_index(&a).is_none() || self.robot.link_index(&b).is_none() {
            self.missing.push(element.at);
            return None;
        }
        let reason = element.attribute("reason").map(|r| r.value.clone()).unwrap_or_default();
        Some(DisabledPair { a, b, reason })
    }

    /// Checks that subgroups exist.
    fn check_groups(&mut self, root: &Element, out: &Semantics) {
        let known: Vec<&str> = out.groups.iter().map(|g| g.name.as_str()).collect();
        let inner = root.named("group").flat_map(|g| g.named("group")).filter_map(|g| g.attribute("name"));
        let states = root.named("group_state").filter_map(|s| s.attribute("group"));
        let effectors = root.named("end_effector").filter_map(|e| e.attribute("group"));
        for name in inner.chain(states).chain(effectors).filter(|name| !known.contains(&name.value.as_str())) {
            let hint = did_you_mean(&name.value, known.iter().copied(), "the groups are");
            let diag = Diag::error(format!("unknown group `{}`", name.value)).at(name.at.label());
            self.tree.report(diag.maybe_hint(hint));
        }
    }
}

#[cfg(test)]
mod tests;

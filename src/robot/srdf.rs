//! SRDF: groups, named poses, end effectors, allowed collision pairs.
//!
//! An SRDF is often shared by variants of a robot: unknown links and joints are warnings.

use std::collections::BTreeSet;

use crate::robot::model::RobotModel;
use crate::robot::xml::{Attribute, Calls, Element};
use crate::yaml::{Diag, Tree, did_you_mean};

/// Contents of an SRDF.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Semantics {
    /// Groups of joints.
    pub groups: Vec<Group>,
    /// Named poses.
    pub poses: Vec<NamedPose>,
    /// End effectors.
    pub end_effectors: Vec<EndEffector>,
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
    /// Returns the indices of the independent joints of a group, in tree order; `None` for an unknown group.
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
        let own = |i: &usize| robot.joints.get(*i).is_some_and(|j| j.is_independent());
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
    let mut reader = Reader { robot, tree, calls, missing: 0 };
    if root.name != "robot" {
        let what = format!("the root element is `{}`, not `robot`", root.name);
        reader.tree.report(Diag::error(what).at(root.at.label()).hint("an SRDF starts with <robot name=\"…\">"));
        return None;
    }
    let mut out = Semantics::default();
    for element in root.elements() {
        match element.name.as_str() {
            "group" => out.groups.extend(reader.group(element)),
            "group_state" => out.poses.extend(reader.pose(element)),
            "end_effector" => out.end_effectors.extend(reader.end_effector(element)),
            "disable_collisions" => out.disabled.extend(reader.pair(element)),
            _ => {}
        }
    }
    reader.check_groups(root, &out);
    if reader.missing > 0 {
        let pairs = if reader.missing == 1 { "pair" } else { "pairs" };
        let what = format!("{} {pairs} of `disable_collisions` with links that this robot lacks", reader.missing);
        reader.tree.report(Diag::warning(what).at(root.at.label()));
    }
    Some(out)
}

struct Reader<'t> {
    robot: &'t RobotModel,
    tree: &'t mut Tree,
    calls: &'t Calls,
    /// Pairs of links that the robot lacks.
    missing: usize,
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
        let name = self.needed(element, "name")?.value.clone();
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
        Some(NamedPose { name, group, positions })
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
            self.missing += 1;
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
mod tests {
    use super::*;
    use crate::robot::{urdf, xml};

    fn robot() -> RobotModel {
        let joint = |n: usize| {
            format!(
                "<joint name='j{n}' type='revolute'><parent link='l{}'/><child link='l{n}'/>\
                 <limit lower='-1' upper='1' velocity='1'/></joint>",
                n - 1
            )
        };
        let links: String = (0..5).map(|n| format!("<link name='l{n}'/>")).collect();
        let joints: String = (1..5).map(joint).collect();
        urdf::from_text("t", &format!("<robot name='t'>{links}{joints}</robot>")).unwrap()
    }

    fn semantics(body: &str) -> (Option<Semantics>, String) {
        let mut tree = Tree::new();
        let source = tree.add_source("t.srdf", format!("<robot name='t'>{body}</robot>"));
        let document = xml::parse(&mut tree, source).unwrap();
        let out = read(&document.root, &robot(), &mut tree, &Calls::default());
        let text = tree.diags().iter().map(|d| crate::yaml::render(&tree, d, false) + "\n").collect();
        (out, text)
    }

    #[test]
    fn groups_poses_and_pairs_are_read() {
        let (out, text) = semantics(
            "<group name='arm'><chain base_link='l0' tip_link='l2'/></group>\
             <group name='hand'><joint name='j4'/><link name='l3'/></group>\
             <group name='all'><group name='arm'/><group name='hand'/><group name='all'/></group>\
             <group_state name='home' group='arm'><joint name='j1' value='0.5'/><joint name='j2' value='-0.25'/></group_state>\
             <end_effector name='tool' group='hand' parent_link='l2'/>\
             <virtual_joint name='v' type='fixed' parent_frame='w' child_link='l0'/>\
             <disable_collisions link1='l0' link2='l1' reason='Adjacent'/><disable_collisions link1='l0' link2='x'/>",
        );
        let out = out.unwrap();
        assert_eq!(out.group_joints(&robot(), "arm"), Some(vec![0, 1]));
        assert_eq!(out.group_joints(&robot(), "hand"), Some(vec![2, 3]));
        assert_eq!(out.group_joints(&robot(), "all"), Some(vec![0, 1, 2, 3]));
        assert_eq!(out.group_joints(&robot(), "none"), None);
        assert_eq!(out.poses[0].positions, [("j1".to_owned(), 0.5), ("j2".to_owned(), -0.25)]);
        let of = |joints: &[&str]| joints.iter().map(|j| (*j).to_owned()).collect::<Vec<_>>();
        assert_eq!(out.poses_of(&of(&["j2", "j1"])), [("home", vec![-0.25, 0.5])]);
        assert_eq!((out.poses_of(&of(&["j1", "j3"])), out.poses_of(&[])), (vec![], vec![]));
        assert_eq!((out.end_effectors.len(), out.disabled.len()), (1, 1));
        assert!(text.contains("1 pair of") && !text.contains("error"), "{text}");
    }

    #[test]
    fn wrong_names_are_found() {
        for (body, what) in [
            ("<group name='a'><joint name='j9'/></group>", "this robot has no joint `j9`"),
            ("<group name='a'><chain base_link='l2' tip_link='l0'/></group>", "is not below"),
            ("<group_state name='h' group='b'/>", "unknown group `b`"),
            (
                "<group name='a'/><group_state name='h' group='a'><joint name='j1' value='x'/></group_state>",
                "is not a joint position",
            ),
            ("<group/>", "this `group` has no `name`"),
        ] {
            let (_, text) = semantics(body);
            assert!(text.contains(what), "{what}\n{text}");
        }
    }
}

//! Links and joints → one tree, parents first; mimic joints → their leaders.

use std::collections::HashMap;

use super::{RawJoint, Reader};
use crate::model::{Joint, Link, Mimic, RobotModel};
use crate::xml::SourcePos;
use dimos_yaml::{Diag, did_you_mean};

impl Reader<'_> {
    /// Assembles the robot. Reports what keeps it from being one tree.
    pub(super) fn assemble(
        &mut self,
        name: String,
        links: Vec<(Link, SourcePos)>,
        joints: Vec<RawJoint>,
    ) -> Option<RobotModel> {
        let link_at = self.unique("links", links.iter().map(|(link, at)| (link.name.as_str(), *at)));
        let joint_at = self.unique("joints", joints.iter().map(|j| (j.joint.name.as_str(), j.at)));
        let carriers = self.carriers(&joints, &link_at, &links);
        if self.errors > 0 {
            // Missing elements would look like gaps in the tree.
            return None;
        }
        let root = self.root(&links, &carriers)?;
        let order = self.order(root, &links, &joints, &link_at)?;
        let place_of: HashMap<usize, usize> = order.iter().enumerate().map(|(i, (_, joint))| (*joint, i)).collect();
        let mut link_index = HashMap::from([(root, 0)]);
        let mut out = Vec::with_capacity(order.len());
        for (i, (link, joint)) in order.iter().enumerate() {
            link_index.insert(*link, i + 1);
            let raw = joints.get(*joint)?;
            let parent = link_at.get(raw.parent.0.as_str()).and_then(|l| link_index.get(l)).copied()?;
            out.push(Joint { parent, child: i + 1, ..raw.joint.clone() });
        }
        for (i, (_, joint)) in order.iter().enumerate() {
            let mimic = self.leader(*joint, &joints, &joint_at);
            if let Some(joint) = out.get_mut(i) {
                joint.mimic = mimic.and_then(|m| Some(Mimic { leader: *place_of.get(&m.leader)?, ..m }));
            }
        }
        let mut links: Vec<Option<Link>> = links.into_iter().map(|(link, _)| Some(link)).collect();
        let in_order = std::iter::once(root).chain(order.iter().map(|(link, _)| *link));
        let links = in_order.filter_map(|i| links.get_mut(i)?.take()).collect();
        (self.errors == 0).then_some(RobotModel { name, links, joints: out })
    }

    /// Returns indices by name; reports duplicate names.
    fn unique<'n>(&mut self, what: &str, names: impl Iterator<Item = (&'n str, SourcePos)>) -> HashMap<&'n str, usize> {
        let mut seen: HashMap<&str, (usize, SourcePos)> = HashMap::new();
        for (i, (name, at)) in names.enumerate() {
            match seen.get(name) {
                Some((_, first)) => {
                    let first = first.label().with_text("the first one");
                    self.report(at, Diag::error(format!("two {what} are named `{name}`")).also(first));
                }
                None => {
                    seen.insert(name, (i, at));
                }
            }
        }
        seen.into_iter().map(|(name, (i, _))| (name, i)).collect()
    }

    /// Returns the joint that carries each link. Reports unknown links and links with two parents.
    fn carriers(
        &mut self,
        joints: &[RawJoint],
        link_at: &HashMap<&str, usize>,
        links: &[(Link, SourcePos)],
    ) -> HashMap<usize, usize> {
        let mut carriers: HashMap<usize, usize> = HashMap::new();
        for (i, raw) in joints.iter().enumerate() {
            for (end, (name, at)) in [("parent", &raw.parent), ("child", &raw.child)] {
                if !link_at.contains_key(name.as_str()) {
                    let hint = did_you_mean(name, links.iter().map(|(link, _)| link.name.as_str()), "the links are");
                    self.report(*at, Diag::error(format!("the {end} link `{name}` does not exist")).maybe_hint(hint));
                }
            }
            let Some(child) = link_at.get(raw.child.0.as_str()) else { continue };
            match carriers.get(child).and_then(|first| joints.get(*first)) {
                Some(first) => {
                    let what = format!("the link `{}` has two parents", raw.child.0);
                    let label = first.child.1.label().with_text(format!("joint `{}` carries it", first.joint.name));
                    self.report(raw.child.1, Diag::error(what).also(label));
                }
                None => {
                    carriers.insert(*child, i);
                }
            }
        }
        carriers
    }

    /// Returns the one link that no joint carries.
    fn root(&mut self, links: &[(Link, SourcePos)], carriers: &HashMap<usize, usize>) -> Option<usize> {
        let roots: Vec<usize> = (0..links.len()).filter(|link| !carriers.contains_key(link)).collect();
        let named = |i: usize| links.get(i).map(|(link, at)| (link.name.clone(), *at));
        match roots[..] {
            [root] => Some(root),
            [] => {
                let (name, at) = named(0)?;
                self.error(at, format!("every link has a parent: the joints form a loop through `{name}`"));
                None
            }
            [first, ..] => {
                let (first_name, first_at) = named(first)?;
                for (name, at) in roots.iter().skip(1).filter_map(|i| named(*i)) {
                    let diag = Diag::error(format!("the links `{name}` and `{first_name}` both have no parent"));
                    let diag = diag.also(first_at.label().with_text("the other root"));
                    self.report(at, diag.hint("a robot is one tree: join them with a fixed joint, or remove one"));
                }
                None
            }
        }
    }

    /// Returns the links below the root with the joints that carry them, depth first, in file order.
    fn order(
        &mut self,
        root: usize,
        links: &[(Link, SourcePos)],
        joints: &[RawJoint],
        link_at: &HashMap<&str, usize>,
    ) -> Option<Vec<(usize, usize)>> {
        let mut below: HashMap<usize, Vec<(usize, usize)>> = HashMap::new();
        for (i, raw) in joints.iter().enumerate().rev() {
            let ends = [&raw.parent.0, &raw.child.0].map(|name| link_at.get(name.as_str()).copied());
            let [Some(parent), Some(child)] = ends else { continue };
            below.entry(parent).or_default().push((child, i));
        }
        let mut order = Vec::with_capacity(joints.len());
        let mut open = below.remove(&root).unwrap_or_default();
        while let Some((link, joint)) = open.pop() {
            order.push((link, joint));
            open.extend(below.remove(&link).unwrap_or_default());
        }
        // Links not reached have parents, but no path to the root.
        if let Some((_, i)) = below.values().flatten().min_by_key(|(_, i)| *i) {
            let raw = joints.get(*i)?;
            let at = raw.parent.1;
            let root = links.get(root).map(|(link, _)| link.name.clone()).unwrap_or_default();
            let what =
                format!("joint `{}` is part of a loop that is not connected to the root `{root}`", raw.joint.name);
            self.error(at, what);
            return None;
        }
        Some(order)
    }

    /// Returns the independent joint that a mimic joint follows; resolves chains.
    fn leader(&mut self, joint: usize, joints: &[RawJoint], joint_at: &HashMap<&str, usize>) -> Option<Mimic> {
        let first = joints.get(joint)?.mimic.as_ref()?;
        let mut mimic: Mimic = (first, 0).into();
        let mut raw = first;
        for _ in 0..=joints.len() {
            let Some(next) = joint_at.get(raw.leader.as_str()).copied() else {
                let hint = did_you_mean(&raw.leader, joints.iter().map(|j| j.joint.name.as_str()), "the joints are");
                let diag = Diag::error(format!("the mimic leader `{}` does not exist", raw.leader));
                self.report(raw.at, diag.maybe_hint(hint));
                return None;
            };
            mimic.leader = next;
            let leader = joints.get(next)?;
            if !leader.joint.is_movable() {
                self.error(raw.at, format!("the mimic leader `{}` is fixed", raw.leader));
                return None;
            }
            let Some(further) = &leader.mimic else { return Some(mimic) };
            mimic.offset += mimic.multiplier * further.offset;
            mimic.multiplier *= further.multiplier;
            raw = further;
        }
        self.error(first.at, "these joints mimic each other in a circle");
        None
    }
}

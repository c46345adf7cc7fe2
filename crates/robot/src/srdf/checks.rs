//! Warnings of an SRDF: contents that are legal XML but mean something else than intended, or nothing.

use std::collections::{BTreeMap, BTreeSet};

use super::{Reader, Semantics};
use crate::xml::{Element, SourcePos};
use dimos_yaml::{Diag, closest};

/// Elements of an SRDF. Those without meaning for planning are accepted.
const KNOWN: &[&str] = &[
    "group",
    "group_state",
    "end_effector",
    "virtual_joint",
    "passive_joint",
    "joint_property",
    "disable_collisions",
    "disable_default_collisions",
    "enable_collisions",
    "link_sphere_approximation",
];
/// Elements of a group.
const IN_GROUP: &[&str] = &["joint", "link", "chain", "group"];

impl Reader<'_> {
    fn warn(&mut self, at: SourcePos, diag: Diag) {
        let diag = self.calls.explain(diag.at(at.label()), at);
        self.tree.report(diag);
    }

    /// Warns of an SRDF for a robot with another name.
    pub(super) fn check_name(&mut self, root: &Element) {
        let own = self.robot.name.as_str();
        if let Some(name) = root.attribute("name").filter(|name| name.value != own) {
            let what = format!("this SRDF is for the robot `{}`; the description is of `{own}`", name.value);
            self.warn(name.at, Diag::warning(what));
        }
    }

    /// Warns of elements that no SRDF has.
    pub(super) fn check_elements(&mut self, root: &Element) {
        let groups = root.named("group").flat_map(Element::elements).map(|element| (element, IN_GROUP));
        for (element, known) in root.elements().map(|element| (element, KNOWN)).chain(groups) {
            if known.contains(&element.name.as_str()) {
                continue;
            }
            let hint = closest(&element.name, known.iter().copied()).map(|near| format!("did you mean `{near}`?"));
            let diag = Diag::warning(format!("the element `{}` is unknown and has no effect", element.name));
            self.warn(element.at, diag.maybe_hint(hint));
        }
    }

    /// Warns of two groups, or two poses of a group, with the same name.
    pub(super) fn check_duplicates(&mut self, root: &Element) {
        let mut seen: BTreeMap<(bool, &str, &str), SourcePos> = BTreeMap::new();
        for element in root.elements().filter(|e| matches!(e.name.as_str(), "group" | "group_state")) {
            let Some(name) = element.attribute("name") else { continue };
            let pose = element.name == "group_state";
            let of = element.attribute("group").filter(|_| pose).map_or("", |group| group.value.as_str());
            let Some(first) = seen.get(&(pose, of, name.value.as_str())).copied() else {
                seen.insert((pose, of, name.value.as_str()), name.at);
                continue;
            };
            let what = match pose {
                true => format!("two poses of the group `{of}` are named `{}`: the first one counts", name.value),
                false => format!("two groups are named `{}`: the first one counts", name.value),
            };
            self.warn(name.at, Diag::warning(what).also(first.label().with_text("the first one")));
        }
    }

    /// Warns of groups that contain themselves, directly or through others.
    pub(super) fn check_cycles(&mut self, root: &Element, out: &Semantics) {
        let inner = |name: &str| out.groups.iter().find(|g| g.name == name).map(|g| g.groups.as_slice());
        for element in root.named("group") {
            let Some(own) = element.attribute("name") else { continue };
            for part in element.named("group").filter_map(|part| part.attribute("name")) {
                let (mut open, mut seen) = (vec![part.value.as_str()], BTreeSet::new());
                while let Some(name) = open.pop() {
                    if seen.insert(name) {
                        open.extend(inner(name).unwrap_or_default().iter().map(String::as_str));
                    }
                }
                if seen.contains(own.value.as_str()) {
                    let what = format!("the group `{}` contains itself", own.value);
                    let through = format!("its subgroup `{}` leads back to it", part.value);
                    let diag =
                        if part.value == own.value { Diag::warning(what) } else { Diag::warning(what).note(through) };
                    self.warn(part.at, diag);
                }
            }
        }
    }
}

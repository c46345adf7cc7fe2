//! URDF → [`RobotModel`]. Reports all mistakes at once, each with its position; ignores tags of other tools (`gazebo`,
//! `transmission`, `ros2_control` …).
//!
//! Uses our own XML tree rather than a URDF crate, so that mistakes have positions: docs/decisions/0023.

mod limits;
mod numbers;
mod shapes;
mod tree;
mod version;

use std::collections::{HashMap, HashSet};
use std::path::PathBuf;

use nalgebra::{Unit, Vector3};

use crate::model::{Joint, JointKind, Limits, Link, Mimic, RobotModel};
use crate::xml::{Calls, Element, SourcePos};
use dimos_yaml::{Diag, Tree, did_you_mean, quote};

pub use shapes::VISUAL_NOT_FOUND;
pub use version::version;

/// Maximum number of links.
pub const MAX_LINKS: usize = 512;

/// Handling of mesh files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Meshes {
    /// Look for each: a missing collision mesh is an error, a missing visual mesh a warning.
    #[default]
    Find,
    /// Look for each: a missing one is a warning, for uses that show what is there.
    Mark,
    /// Do not look for files: for uses that need no shapes.
    Ignore,
}

/// Resolves a URI to a file, or returns why not.
pub type Resolve<'a> = dyn Fn(&str) -> Result<PathBuf, String> + 'a;

/// Reads a robot from the root element of a description.
pub fn read(
    root: &Element,
    tree: &mut Tree,
    calls: &Calls,
    meshes: Meshes,
    resolve: &Resolve<'_>,
) -> Option<RobotModel> {
    let mut reader = Reader {
        tree,
        calls,
        meshes,
        resolve,
        version: 0,
        materials: HashMap::new(),
        carried: HashSet::new(),
        narrowed: Vec::new(),
        quaternions: Vec::new(),
        errors: 0,
    };
    let model = reader.robot(root);
    model.filter(|_| reader.errors == 0)
}

/// Reads a robot from a text without looking for meshes; returns the mistakes as text. For tests and built-in robots.
pub fn from_text(name: &str, text: &str) -> Result<RobotModel, String> {
    let mut tree = Tree::new();
    let source = tree.add_source(name, text);
    let calls = Calls::default();
    let model = crate::xml::parse(&mut tree, source)
        .and_then(|document| read(&document.root, &mut tree, &calls, Meshes::Ignore, &|uri| Err(uri.to_owned())));
    let lines = || tree.diags().iter().map(|d| dimos_yaml::render(&tree, d, false)).collect::<Vec<_>>().join("\n");
    model.ok_or_else(lines)
}

/// Reader of one description.
struct Reader<'t> {
    tree: &'t mut Tree,
    calls: &'t Calls,
    meshes: Meshes,
    resolve: &'t Resolve<'t>,
    /// Minor number of the description's version, 1.0 to 1.2.
    version: u32,
    /// Colours by material name.
    materials: HashMap<String, [f64; 4]>,
    /// Links that a joint carries.
    carried: HashSet<String>,
    /// Joints with soft limits that are narrower than their limits: where these are, and the range that is left.
    narrowed: Vec<(SourcePos, String)>,
    /// Quaternions that do not count in this version.
    quaternions: Vec<SourcePos>,
    errors: usize,
}

/// A joint as written, before links are resolved.
struct RawJoint {
    joint: Joint,
    at: SourcePos,
    parent: (String, SourcePos),
    child: (String, SourcePos),
    mimic: Option<RawMimic>,
}

/// A `mimic` as written.
struct RawMimic {
    leader: String,
    at: SourcePos,
    multiplier: f64,
    offset: f64,
}

impl Reader<'_> {
    fn error(&mut self, at: SourcePos, what: impl Into<String>) {
        self.report(at, Diag::error(what));
    }

    fn report(&mut self, at: SourcePos, diag: Diag) {
        self.errors += usize::from(diag.severity == dimos_yaml::Severity::Error);
        let diag = self.calls.explain(diag.at(at.label()), at);
        self.tree.report(diag);
    }

    fn warn(&mut self, at: SourcePos, what: impl Into<String>) {
        self.report(at, Diag::warning(what));
    }

    /// Returns a required attribute that is not empty.
    fn needed<'e>(&mut self, element: &'e Element, name: &str) -> Option<(&'e str, SourcePos)> {
        match element.attribute(name) {
            Some(a) if !a.value.trim().is_empty() => Some((a.value.as_str(), a.at)),
            Some(a) => {
                self.error(a.at, format!("`{name}` of this `{}` is empty", element.name));
                None
            }
            None => {
                self.error(element.at, format!("this `{}` has no `{name}`", element.name));
                None
            }
        }
    }

    fn robot(&mut self, root: &Element) -> Option<RobotModel> {
        if root.name != "robot" {
            let diag = Diag::error(format!("the root element is `{}`, not `robot`", root.name));
            self.report(root.at, diag.hint("a URDF starts with <robot name=\"…\">"));
            return None;
        }
        let name = self.needed(root, "name").map(|(name, _)| name.to_owned());
        match version(root) {
            Ok(minor) => self.version = minor,
            Err(what) => {
                let diag = Diag::error(what).hint("the versions are 1.0, 1.1 and 1.2; without one it is 1.0");
                self.report(root.attribute("version").map_or(root.at, |a| a.at), diag);
            }
        }
        self.collect_materials(root);
        let children = root.named("joint").filter_map(|joint| joint.child("child")?.attribute("link"));
        self.carried = children.map(|link| link.value.clone()).collect();
        let mut links = Vec::new();
        let mut joints = Vec::new();
        for element in root.elements() {
            match element.name.as_str() {
                "link" if links.len() < MAX_LINKS => links.extend(self.link(element)),
                "link" => {
                    self.error(element.at, format!("a robot may have at most {MAX_LINKS} links"));
                    return None;
                }
                "joint" if joints.len() < MAX_LINKS => joints.extend(self.joint(element)),
                "joint" => {
                    self.error(element.at, format!("a robot may have at most {} joints", MAX_LINKS - 1));
                    return None;
                }
                _ => {}
            }
        }
        self.report_what_differs();
        if links.is_empty() {
            self.error(root.at, "the robot has no links");
            return None;
        }
        self.assemble(name?, links, joints)
    }

    fn link(&mut self, element: &Element) -> Option<(Link, SourcePos)> {
        let (name, at) = self.needed(element, "name")?;
        let visuals = element.named("visual").filter_map(|e| self.shape(e, false)).collect();
        let collisions = element.named("collision").filter_map(|e| self.shape(e, true)).collect();
        let inertial = element.child("inertial").and_then(|e| self.inertial(e));
        Some((Link { name: name.to_owned(), visuals, collisions, inertial }, at))
    }

    fn joint(&mut self, element: &Element) -> Option<RawJoint> {
        let name = self.needed(element, "name");
        let kind = self.kind(element);
        let end = |reader: &mut Self, which: &str| match element.child(which) {
            Some(end) => reader.needed(end, "link").map(|(link, at)| (link.to_owned(), at)),
            None => {
                reader.error(element.at, format!("this joint has no `{which}`"));
                None
            }
        };
        let (parent, child) = (end(self, "parent"), end(self, "child"));
        let origin = self.origin(element);
        let moves = kind.is_some_and(|k| k != JointKind::Fixed);
        let axis = if moves { self.axis(element) } else { Some(Vector3::x_axis()) };
        let limits = kind.and_then(|kind| self.limits(element, kind));
        let mimic = element.child("mimic").filter(|_| moves).map(|e| self.mimic(e));
        let (name, at) = name?;
        // Defaults replace values that were reported: the joint's position in the tree is checked all the same.
        let joint = Joint {
            name: name.to_owned(),
            kind: kind.unwrap_or(JointKind::Fixed),
            parent: 0,
            child: 0,
            origin: origin.unwrap_or_default(),
            axis: axis.unwrap_or(Vector3::x_axis()),
            limits: limits.unwrap_or(Limits::NONE),
            mimic: None,
        };
        Some(RawJoint { joint, at, parent: parent?, child: child?, mimic: mimic.flatten() })
    }

    fn kind(&mut self, element: &Element) -> Option<JointKind> {
        let (word, at) = self.needed(element, "type")?;
        match word {
            "fixed" => Some(JointKind::Fixed),
            "revolute" => Some(JointKind::Revolute),
            "continuous" => Some(JointKind::Continuous),
            "prismatic" => Some(JointKind::Prismatic),
            "floating" | "planar" if self.is_at_root(element) => {
                let diag = Diag::warning(format!("this {word} joint at the root counts as fixed"));
                self.report(at, diag.hint("an arm's base does not move; a planner's `base_pose` places it"));
                Some(JointKind::Fixed)
            }
            "floating" | "planar" | "spherical" => {
                let diag = Diag::error(format!("joints of type `{word}` are not supported"));
                self.report(at, diag.hint("an arm's joints are revolute, continuous, prismatic or fixed"));
                None
            }
            other => {
                let hint = did_you_mean(other, ["fixed", "revolute", "continuous", "prismatic"], "the types are");
                self.report(at, Diag::error(format!("unknown joint type {}", quote(other))).maybe_hint(hint));
                None
            }
        }
    }

    /// Returns whether a joint's parent is a link that no joint carries.
    fn is_at_root(&self, joint: &Element) -> bool {
        let parent = joint.child("parent").and_then(|parent| parent.attribute("link"));
        parent.is_some_and(|link| !self.carried.contains(&link.value))
    }

    fn axis(&mut self, element: &Element) -> Option<Unit<Vector3<f64>>> {
        let Some(xyz) = element.child("axis") else { return Some(Vector3::x_axis()) };
        let (_, at) = self.needed(xyz, "xyz")?;
        let vector: Vector3<f64> = self.vector(xyz, "xyz")?.into();
        let axis = Unit::try_new(vector, 1e-9);
        if axis.is_none() {
            self.report(at, Diag::error("this axis is zero").hint("an axis is a direction, such as 0 0 1"));
        }
        axis
    }

    fn mimic(&mut self, element: &Element) -> Option<RawMimic> {
        let (leader, at) = self.needed(element, "joint")?;
        let multiplier = self.number_or(element, "multiplier", 1.0)?;
        let offset = self.number_or(element, "offset", 0.0)?;
        Some(RawMimic { leader: leader.to_owned(), at, multiplier, offset })
    }
}

/// A mimic joint that is not resolved yet.
impl From<(&RawMimic, usize)> for Mimic {
    fn from((raw, leader): (&RawMimic, usize)) -> Self {
        Self { leader, multiplier: raw.multiplier, offset: raw.offset }
    }
}

#[cfg(test)]
mod tests;

//! `/scene.json`: what does not change during the run. Robot descriptions are read and expanded for it, and their
//! meshes numbered: a page can ask for these files only. The hash of a mesh is in its address: browsers keep it.

use std::collections::{BTreeMap, HashMap};
use std::hash::{DefaultHasher, Hasher};
use std::path::PathBuf;

use nalgebra::Isometry3;
use serde::{Serialize, Serializer};

use super::{Shown, ShownArm, ShownRobot, page_urdf};
use dimos_core::bounded;
use dimos_robot as robot;
use dimos_robot::urdf::Meshes;
use dimos_robot::xml::{Element, Node};

/// Version of the form of the scene.
const VERSION: u32 = 1;

/// The scene of a page.
#[derive(Debug, Default)]
pub struct Scene {
    /// The scene as JSON.
    pub json: String,
    /// The mesh files by number.
    pub meshes: Vec<MeshFile>,
}

/// A mesh file.
#[derive(Debug)]
pub enum MeshFile {
    /// A file.
    At(PathBuf),
    /// The contents of a file with this name.
    Inside(String, Vec<u8>),
    /// Why there is none.
    Missing(String),
}

impl MeshFile {
    /// Returns the address of the mesh with this number.
    pub fn address(&self, number: usize) -> String {
        let hash = match self {
            Self::At(path) => bounded::read(path, bounded::LARGE).ok().map(|bytes| hash(&bytes)),
            Self::Inside(_, bytes) => Some(hash(bytes)),
            Self::Missing(_) => None,
        };
        hash.map_or_else(|| format!("/mesh/{number}"), |hash| format!("/mesh/{number}-{hash}"))
    }
}

/// Returns the hash of a mesh file in its address.
pub fn hash(bytes: &[u8]) -> String {
    let mut hasher = DefaultHasher::new();
    hasher.write(bytes);
    format!("{:016x}", hasher.finish())
}

#[derive(Serialize)]
struct Document<'a> {
    version: u32,
    kind: &'static str,
    name: &'a str,
    simulated: bool,
    address: String,
    planner: bool,
    robots: Vec<Robot<'a>>,
    arms: Vec<Arm<'a>>,
}

#[derive(Serialize)]
struct Robot<'a> {
    name: &'a str,
    base: Pose,
    urdf: String,
    tip: &'a str,
    root: String,
    /// The coordinator's joint names and the model's, from the base.
    #[serde(serialize_with = "in_order")]
    joints: &'a [(String, String)],
    /// Joints that other arms move, in the same form.
    #[serde(serialize_with = "in_order")]
    moved_by_others: &'a [(String, String)],
    /// Positions of joints that stay where they are [rad or m].
    #[serde(serialize_with = "in_order")]
    fixed: &'a [(String, f64)],
    groups: BTreeMap<String, Vec<f64>>,
    #[serde(serialize_with = "in_order")]
    limits: Vec<(String, Limits)>,
}

/// A pose in `map`.
#[derive(Serialize)]
struct Pose {
    xyz: [f64; 3],
    quat: [f64; 4],
}

/// Limits of a joint; none where it is null.
#[derive(Clone, Serialize)]
struct Limits {
    lower: f64,
    upper: f64,
    velocity: f64,
    acceleration: f64,
}

#[derive(Serialize)]
struct Arm<'a> {
    name: &'a str,
    r#type: &'a str,
    address: &'a str,
    simulated: bool,
    dof: usize,
    joints: &'a [String],
    gripper: Option<Gripper<'a>>,
}

#[derive(Serialize)]
struct Gripper<'a> {
    /// The model's joint that it drives, with its positions when closed and open.
    joint: Option<&'a str>,
    closed: Option<f64>,
    open: Option<f64>,
    /// Its position when closed and open, as `state` reports it.
    min: Option<f64>,
    max: Option<f64>,
    unit: &'a str,
}

fn in_order<T: Serialize, S: Serializer>(pairs: impl AsRef<[(String, T)]>, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.collect_map(pairs.as_ref().iter().map(|(name, value)| (name, value)))
}

impl Scene {
    /// Reads the descriptions of the robots. One that cannot be read is left out, with a warning.
    pub fn read(shown: &Shown, kind: &'static str) -> Self {
        let mut meshes = Vec::new();
        let robots: Vec<Robot<'_>> = shown.robots.iter().filter_map(|robot| read(robot, shown, &mut meshes)).collect();
        let address: Vec<&str> = shown.arms.iter().map(|arm| arm.address.as_str()).collect();
        let document = Document {
            version: VERSION,
            kind,
            name: &shown.name,
            simulated: shown.simulated,
            address: address.join(", "),
            planner: shown.planner,
            robots,
            arms: shown.arms.iter().map(|arm| arm_of(arm, &shown.robots)).collect(),
        };
        // Plain structs with string keys always encode.
        Self { json: serde_json::to_string(&document).unwrap_or_default(), meshes }
    }

    /// Adds what only this kind of scene has.
    pub fn with(mut self, name: &str, value: &serde_json::Value) -> Self {
        self.json.truncate(self.json.len().saturating_sub(1));
        self.json += &format!(",\"{name}\":{value}}}");
        self
    }
}

fn read<'a>(robot: &'a ShownRobot, shown: &Shown, meshes: &mut Vec<MeshFile>) -> Option<Robot<'a>> {
    let source = robot::Source { meshes: Meshes::Mark, ..robot.source.clone() };
    let mut loaded = robot::load(&source);
    let semantics = std::mem::take(&mut loaded.semantics);
    let mut document = loaded.document.take();
    let model = loaded.into_model().inspect_err(|e| tracing::warn!("the live view lacks {}: {e}", robot.name)).ok()?;
    let document = document.as_mut()?;
    let mut numbers = HashMap::new();
    for mesh in model.meshes() {
        numbers.entry(mesh.uri.as_str()).or_insert_with(|| {
            let file = mesh.path.clone().map(MeshFile::At);
            let file = file.unwrap_or_else(|| MeshFile::Missing(format!("{}: file not found", mesh.uri)));
            let address = file.address(meshes.len());
            meshes.push(file);
            address
        });
    }
    number_meshes(&mut document.root, &numbers);
    page_urdf::simplify(&mut document.root);
    let base_in_model = robot.base_link.as_deref().and_then(|link| model.link_index(link)).and_then(|link| {
        let poses = model.link_poses(&model.positions(&robot.fixed.iter().cloned().collect()));
        poses.get(link).copied()
    });
    let base = robot.base_pose * base_in_model.unwrap_or_default().inverse();
    let mut groups: BTreeMap<String, Vec<f64>> = robot.poses.iter().cloned().collect();
    let names: Vec<String> = robot.joints.iter().map(|(_, name)| name.clone()).collect();
    for (name, pose) in semantics.poses_of(&names) {
        groups.entry(name.to_owned()).or_insert(pose);
    }
    let limits = robot.joints.iter().filter_map(|(joint, _)| Some((joint.clone(), limits_of(joint, &shown.arms)?)));
    Some(Robot {
        name: &robot.name,
        base: pose(&base),
        urdf: document.to_text(),
        tip: &robot.tip,
        root: model.links.first().map(|link| link.name.clone()).unwrap_or_default(),
        joints: &robot.joints,
        moved_by_others: &robot.moved_by_others,
        fixed: &robot.fixed,
        groups,
        limits: limits.collect(),
    })
}

/// Replaces the names of mesh files by their addresses.
fn number_meshes(element: &mut Element, numbers: &HashMap<&str, String>) {
    if element.name == "mesh" {
        let filename = element.attributes.iter_mut().find(|attribute| attribute.name == "filename");
        if let Some(filename) = filename
            && let Some(address) = numbers.get(filename.value.as_str())
        {
            filename.value.clone_from(address);
        }
    }
    for node in &mut element.children {
        if let Node::Element(child) = node {
            number_meshes(child, numbers);
        }
    }
}

fn limits_of(joint: &str, arms: &[ShownArm]) -> Option<Limits> {
    let (arm, index) = arms.iter().find_map(|arm| Some((arm, arm.joints.iter().position(|name| name == joint)?)))?;
    // Infinite ones become null.
    let of = |list: &[f64]| list.get(index).copied().unwrap_or(f64::INFINITY);
    let limits = &arm.limits;
    Some(Limits {
        lower: of(&limits.position_lower),
        upper: of(&limits.position_upper),
        velocity: of(&limits.velocity_max),
        acceleration: of(&limits.acceleration_max),
    })
}

fn arm_of<'a>(arm: &'a ShownArm, robots: &'a [ShownRobot]) -> Arm<'a> {
    let has = |robot: &&ShownRobot| robot.joints.iter().any(|(joint, _)| arm.joints.contains(joint));
    let driven = robots.iter().filter(has).find_map(|robot| robot.gripper.as_ref());
    let ShownArm { name, adapter, address, simulated, joints, gripper, .. } = arm;
    let gripper = gripper.as_ref().map(|gripper| Gripper {
        joint: driven.map(|driven| driven.joint.as_str()),
        closed: driven.map(|driven| driven.closed),
        open: driven.map(|driven| driven.open),
        min: gripper.range.map(|(closed, _)| closed),
        max: gripper.range.map(|(_, open)| open),
        unit: &gripper.unit,
    });
    Arm { name, r#type: adapter, address, simulated: *simulated, dof: joints.len(), joints, gripper }
}

fn pose(pose: &Isometry3<f64>) -> Pose {
    let q = pose.rotation.coords;
    Pose { xyz: pose.translation.vector.into(), quat: [q.x, q.y, q.z, q.w] }
}

//! What a planner is made from: names and files, as a blueprint resolves them. Plain data.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use nalgebra::Isometry3;

use crate::collision::body::MeshMode;
use crate::robot::Source;

/// A planner.
#[derive(Debug, Clone, Default)]
pub struct PlannerConfig {
    /// The longest time that one request may search.
    pub timeout: Duration,
    /// Distance that plans keep from obstacles and other arms [m].
    pub padding: f64,
    /// The robots that are planned for.
    pub robots: Vec<RobotConfig>,
    /// What is in the world from the start.
    pub objects: Vec<ObjectConfig>,
}

/// A robot that is planned for.
#[derive(Debug, Clone)]
pub struct RobotConfig {
    /// Its name, unique in the planner.
    pub name: String,
    /// Its `.urdf` or `.xacro` file, or `builtin:NAME`.
    pub model_path: PathBuf,
    /// Folders that `package://NAME` stands for.
    pub packages: BTreeMap<String, PathBuf>,
    /// Arguments of the xacro file.
    pub xacro_args: BTreeMap<String, String>,
    /// Its SRDF: its named poses and its pairs of links that may touch are added to those here.
    pub srdf: Option<PathBuf>,
    /// Its `joint_limits.yaml`.
    pub joint_limits: Option<PathBuf>,
    /// How the collision meshes of a link, by its name, are checked; as their hulls, where nothing is said.
    pub shapes: BTreeMap<String, MeshMode>,
    /// Whether collision meshes may be Collada files, which are converted to triangles as they are read.
    pub convert_meshes: bool,
    /// Where its base link stands in the frame `map`.
    pub base_pose: Isometry3<f64>,
    /// The link that stands there.
    pub base_link: String,
    /// The link that pose goals are for.
    pub end_effector_link: String,
    /// The joints that are planned for, as the model names them, base first.
    pub joints: Vec<String>,
    /// The coordinator's names of the same joints.
    pub coordinator_joints: Vec<String>,
    /// What comes before a joint's name in the model to make the coordinator's name of one that is not planned.
    pub joint_prefix: String,
    /// The joint of the model that the arm's gripper moves.
    pub gripper_joint: Option<GripperJoint>,
    /// The trajectory task that executes its motions.
    pub task: Option<String>,
    /// Pairs of links that may touch.
    pub exclusions: Vec<(String, String)>,
    /// Highest joint speed, on top of the model's limits [rad/s].
    pub max_velocity: f64,
    /// Highest joint acceleration, on top of the model's limits [rad/s²].
    pub max_acceleration: f64,
    /// Highest joint jerk, on top of the model's and the arm's limits [rad/s³].
    pub max_jerk: Option<f64>,
    /// Poses with a name: a position for each of `joints` [rad].
    pub named_poses: BTreeMap<String, Vec<f64>>,
}

/// The joint of a model that a gripper moves; others follow it by `mimic`.
#[derive(Debug, Clone, PartialEq)]
pub struct GripperJoint {
    /// Its name in the model.
    pub joint: String,
    /// Its position when the gripper is closed [rad or m].
    pub closed: f64,
    /// Its position when the gripper is open [rad or m].
    pub open: f64,
}

impl RobotConfig {
    /// The files of its description.
    pub fn source(&self) -> Source {
        Source {
            path: self.model_path.clone(),
            packages: self.packages.clone(),
            xacro_args: self.xacro_args.clone(),
            srdf: self.srdf.clone(),
            joint_limits: self.joint_limits.clone(),
            ..Source::default()
        }
    }
}

/// How far and how fast those who execute a motion let one joint go.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointBounds {
    /// Lowest and highest position [rad].
    pub position: [f64; 2],
    /// Highest speed [rad/s].
    pub velocity: f64,
    /// Highest acceleration [rad/s²].
    pub acceleration: f64,
    /// Highest jerk [rad/s³].
    pub jerk: f64,
}

/// An object in the world.
#[derive(Debug, Clone)]
pub struct ObjectConfig {
    /// Its name, unique in the world.
    pub name: String,
    /// What it is.
    pub shape: ObjectShape,
    /// Where it is, in the frame `map`.
    pub pose: Isometry3<f64>,
    /// How much it is thickened all around [m].
    pub padding: f64,
}

/// What an object is. Every shape's frame is at its middle; a cylinder stands along z.
#[derive(Debug, Clone, PartialEq)]
pub enum ObjectShape {
    /// Edge lengths [m].
    Box([f64; 3]),
    /// Radius [m].
    Sphere(f64),
    /// Radius and length [m].
    Cylinder([f64; 2]),
    /// A mesh file: STL, OBJ, DAE; triangle by triangle.
    Mesh(PathBuf),
    /// A point cloud file: PLY. Each point is a ball of the radius [`CLOUD_RADIUS`].
    Cloud(PathBuf),
}

/// How thick the points of a cloud are [m].
pub const CLOUD_RADIUS: f64 = 0.01;

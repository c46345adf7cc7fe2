//! Configuration of a planner: plain data, resolved from a blueprint.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Duration;

use nalgebra::Isometry3;

use crate::collision::body::MeshMode;
use dimos_core::pose::tcp_name;
use dimos_robot::Source;
use dimos_robot::calibrated::Places;

/// Maximum number of objects in the world: each one costs time in every plan and check.
pub const MAX_OBJECTS: usize = 1000;

/// A planner.
#[derive(Debug, Clone, Default)]
pub struct PlannerConfig {
    /// Default and maximum duration of a request.
    pub timeout: Duration,
    /// Distance that plans keep from obstacles and other arms [m].
    pub padding: f64,
    /// The planned robots.
    pub robots: Vec<RobotConfig>,
    /// Objects in the world at the start.
    pub objects: Vec<ObjectConfig>,
    /// Folder of proofs that pairs of links stay apart; without one they are made at every start.
    pub proofs: Option<PathBuf>,
}

/// A planned robot.
#[derive(Debug, Clone)]
pub struct RobotConfig {
    /// Name, unique in the planner.
    pub name: String,
    /// `.urdf` or `.xacro` file, or `builtin:NAME`.
    pub model_path: PathBuf,
    /// Folders of `package://NAME` URIs.
    pub packages: BTreeMap<String, PathBuf>,
    /// Arguments of the xacro file.
    pub xacro_args: BTreeMap<String, String>,
    /// SRDF file: its named poses and allowed collision pairs are added to those given here.
    pub srdf: Option<PathBuf>,
    /// `joint_limits.yaml` file.
    pub joint_limits: Option<PathBuf>,
    /// Frames of joints that replace those of the description: of an arm whose own dimensions are known.
    pub places: Places,
    /// Collision geometry per link name; convex hulls for links not listed.
    pub shapes: BTreeMap<String, MeshMode>,
    /// Whether Collada collision meshes are accepted; they are converted to triangles when read.
    pub convert_meshes: bool,
    /// Pose of the base link in the frame `map`.
    pub base_pose: Isometry3<f64>,
    /// The link that `base_pose` places.
    pub base_link: String,
    /// The link that pose goals refer to.
    pub end_effector_link: String,
    /// Pose of the tool centre point in the frame of that link; `None`: the link itself.
    pub tool: Option<Isometry3<f64>>,
    /// The link of the arm's flange, where a load is measured from.
    pub flange_link: Option<String>,
    /// The base in whose frame the arm's controller states poses: a link, and the base's pose in the link's frame;
    /// `None`: `base_link`.
    pub controller_base: Option<(String, Isometry3<f64>)>,
    /// Whether motions are planned although the model does not fit the arm.
    pub allows_mismatch: bool,
    /// Planned joints by their names in the model, from the base.
    pub joints: Vec<String>,
    /// Names of the same joints in the coordinator.
    pub coordinator_joints: Vec<String>,
    /// Where the joints are that are not planned, by their names in the model. Nothing is known of those not listed:
    /// they count at their widest pose.
    pub unplanned: BTreeMap<String, Unplanned>,
    /// The joint of the model that the arm's gripper drives.
    pub gripper_joint: Option<GripperJoint>,
    /// The trajectory task that executes its motions.
    pub task: Option<String>,
    /// Allowed collision pairs of links.
    pub exclusions: Vec<(String, String)>,
    /// Cap on joint speed, besides the model's limits [rad/s].
    pub max_velocity: f64,
    /// Cap on joint acceleration, besides the model's limits [rad/s²].
    pub max_acceleration: f64,
    /// Cap on joint jerk, besides the limits of the model and the arm [rad/s³].
    pub max_jerk: Option<f64>,
    /// Named poses: one position for each of `joints` [rad].
    pub named_poses: BTreeMap<String, Vec<f64>>,
}

/// Where a joint is that is not planned.
#[derive(Debug, Clone, PartialEq)]
pub enum Unplanned {
    /// Where the run measures this joint of the coordinator.
    Measured(String),
    /// Always here [rad or m].
    Fixed(f64),
}

/// The joint of a model that a gripper drives; other joints may follow by `mimic`.
#[derive(Debug, Clone, PartialEq)]
pub struct GripperJoint {
    /// Name in the model.
    pub joint: String,
    /// Position when the gripper is closed [rad or m].
    pub closed: f64,
    /// Position when the gripper is open [rad or m].
    pub open: f64,
}

impl RobotConfig {
    /// Returns the name of the point whose pose is the robot's: its end-effector link, or the tool on it.
    pub fn tcp_name(&self) -> String {
        tcp_name(&self.end_effector_link, self.tool.is_some())
    }

    /// Returns the joints that stay where they are, with their positions [rad or m].
    pub fn fixed_joints(&self) -> impl Iterator<Item = (&str, f64)> {
        self.unplanned.iter().filter_map(|(name, unplanned)| match unplanned {
            Unplanned::Fixed(at) => Some((name.as_str(), *at)),
            Unplanned::Measured(_) => None,
        })
    }

    /// Returns the joints that others move: the model's names and the coordinator's.
    pub fn moved_by_others(&self) -> impl Iterator<Item = (&str, &str)> {
        self.unplanned.iter().filter_map(|(model, unplanned)| match unplanned {
            Unplanned::Measured(ours) => Some((model.as_str(), ours.as_str())),
            Unplanned::Fixed(_) => None,
        })
    }

    /// Returns the files of its description.
    pub fn source(&self) -> Source {
        Source {
            path: self.model_path.clone(),
            packages: self.packages.clone(),
            xacro_args: self.xacro_args.clone(),
            srdf: self.srdf.clone(),
            joint_limits: self.joint_limits.clone(),
            places: self.places.clone(),
            ..Source::default()
        }
    }
}

impl RobotConfig {
    /// Creates a robot at the origin from a description, a file or `builtin:NAME`. `joints`: those that are planned, by
    /// their names in the model, from the base; in trajectories they have the robot's name in front. Moves at up to
    /// 1 rad/s and 2 rad/s².
    pub fn new(name: &str, model_path: impl Into<PathBuf>, end_effector_link: &str, joints: Vec<String>) -> Self {
        Self {
            name: name.into(),
            model_path: model_path.into(),
            packages: BTreeMap::new(),
            xacro_args: BTreeMap::new(),
            srdf: None,
            joint_limits: None,
            places: Places::new(),
            shapes: BTreeMap::new(),
            convert_meshes: true,
            base_pose: Isometry3::identity(),
            base_link: "base_link".into(),
            end_effector_link: end_effector_link.into(),
            tool: None,
            flange_link: Some(end_effector_link.into()),
            controller_base: None,
            allows_mismatch: false,
            coordinator_joints: joints.iter().map(|joint| format!("{name}_{joint}")).collect(),
            joints,
            unplanned: BTreeMap::new(),
            gripper_joint: None,
            task: None,
            exclusions: Vec::new(),
            max_velocity: 1.0,
            max_acceleration: 2.0,
            max_jerk: None,
            named_poses: BTreeMap::new(),
        }
    }

    /// Returns the built-in robot `yourarm` at the origin, for examples and tests.
    pub fn yourarm() -> Self {
        Self::new("arm", "builtin:yourarm", "flange", (1..=6).map(|k| format!("joint{k}")).collect())
    }
}

/// An object in the world.
#[derive(Debug, Clone)]
pub struct ObjectConfig {
    /// Name, unique in the world.
    pub name: String,
    /// Geometry.
    pub shape: ObjectShape,
    /// Pose in the frame `map`.
    pub pose: Isometry3<f64>,
    /// Padding added on all sides [m].
    pub padding: f64,
}

/// Geometry of an object, centred on its frame; a cylinder's axis is z.
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
    /// A point cloud file: PLY. Each point is a ball of radius [`CLOUD_RADIUS`].
    Cloud(PathBuf),
}

/// Radius of a cloud's points [m].
pub const CLOUD_RADIUS: f64 = 0.01;

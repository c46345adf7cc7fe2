//! The sections `planner` and `view` as written.

use std::collections::BTreeMap;
use std::fmt;
use std::net::{IpAddr, Ipv4Addr};

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::value::MapAccessDeserializer;
use serde::de::{Deserializer, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Serialize};

use crate::blueprint::endpoints::FoxgloveConfig;
use dimos_core::written::ShapeSpec;
use dimos_planner::collision::body::MeshMode;
use dimos_yaml::range::{maybe_positive, non_negative, positive};
use dimos_yaml::{Keyed, Located, Text};

/// Default distance that plans keep from obstacles and other arms [m].
const PADDING: f64 = 0.003;

/// Motion planning.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PlannerEntry {
    /// Maximum duration of a planning request [s].
    #[serde(deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub planning_timeout: f64,
    /// Distance that plans keep from obstacles and other arms [m]; 0: plans only avoid contact. Reduced near a start or
    /// goal that is closer; every such plan reports it.
    #[serde(deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub padding: f64,
    /// Planning robots: the arms as the planner models them.
    pub robots: Vec<Located<RobotEntry>>,
    /// Initial obstacles, by name: `table: {shape: {box: [1, 1, 0.02]}, pose: {xyz: [0.5, 0, 0]}}`.
    pub world: Keyed<Located<ObjectEntry>>,
    /// Same as the section `view`; give only one of the two.
    pub visualization: Option<Located<ViewConfig>>,
}

impl Default for PlannerEntry {
    fn default() -> Self {
        Self {
            planning_timeout: 10.0,
            padding: PADDING,
            robots: Vec::new(),
            world: Keyed::default(),
            visualization: None,
        }
    }
}

/// A planning robot: an arm as the planner models it.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RobotEntry {
    /// Unique name of the robot: letters, digits, `_` and `-`.
    pub name: Located<String>,
    /// The robot's `.urdf` or `.xacro` file, relative to this file; `builtin:NAME`, a built-in description; or
    /// `asset:NAME/path`, a file of an asset.
    pub model_path: Located<String>,
    /// Folders of `package://NAME`, by name; `asset:NAME` or `asset:NAME/path` for those of an asset.
    #[serde(default)]
    pub package_paths: BTreeMap<String, String>,
    /// Arguments of the xacro file.
    #[serde(default)]
    pub xacro_args: BTreeMap<String, Text>,
    /// The robot's SRDF, relative to this file: groups of joints, named poses, allowed collision pairs.
    #[serde(default)]
    pub srdf_path: Option<Located<String>>,
    /// The robot's `joint_limits.yaml` in MoveIt's format, relative to this file: accelerations, jerks, narrower
    /// limits.
    #[serde(default)]
    pub joint_limits_path: Option<Located<String>>,
    /// Pose of the base link in the frame `map`.
    #[serde(default)]
    pub base_pose: Located<PoseEntry>,
    /// The link that `base_pose` places.
    #[serde(default = "base_link")]
    pub base_link: String,
    /// The link whose pose is that of the arm, with `tool`.
    pub end_effector_link: Located<String>,
    /// Pose of the tool centre point in the frame of `end_effector_link`; default: the link itself. Every pose of the
    /// arm is that of this point. `dimos arm tool` changes it in a run.
    #[serde(default)]
    pub tool: Option<Located<PoseEntry>>,
    /// The link whose frame is that of the arm's flange, in which the controller takes the centre of a load. Needed for
    /// `attach` with a mass, and to compare the model with the arm.
    #[serde(default)]
    pub flange_link: Option<Located<String>>,
    /// What happens if the arm's controller has its flange more than 30 mm or 5° from where the model has it: planned
    /// motions are refused (`refuse`), or made with that distance as additional padding (`allow`).
    #[serde(default)]
    pub model_mismatch: ModelMismatch,
    /// The planned joints by their names in the model, from the base; or `{group: NAME}`: a `group` of the SRDF.
    pub joint_names: Located<RobotJoints>,
    /// Shorthand for `joint_name_mapping`: the coordinator's joint `{joint_prefix}{joint}` is the model's `{joint}`.
    #[serde(default)]
    pub joint_prefix: Option<Located<String>>,
    /// The coordinator's joint names and the model's: `{arm_joint1: joint1}`, also of joints that are not planned but
    /// measured by another arm of the run. Default: they are the same, or those that `joint_prefix` makes.
    #[serde(default)]
    pub joint_name_mapping: Keyed<Located<String>>,
    /// Positions of joints that nothing plans or measures, by the model's names: `{yaw: 0.3}` [rad or m].
    #[serde(default)]
    pub fixed_joints: Keyed<Located<f64>>,
    /// The joint of the model that the arm's gripper drives: `{joint: finger, closed: 0, open: 0.04}`. Without it,
    /// plans assume a fully open gripper.
    #[serde(default)]
    pub gripper_joint: Option<Located<GripperJointEntry>>,
    /// The trajectory task that executes the robot's motions.
    #[serde(default)]
    pub coordinator_task_name: Option<Located<String>>,
    /// Allowed collision pairs of links: `[[finger_left, finger_right]]`.
    #[serde(default)]
    pub collision_exclusion_pairs: Vec<(String, String)>,
    /// Collision geometry of links with meshes, by link name: `{left_finger: hull}`. `mesh` (default) is the mesh: its
    /// convex hull first, triangles where only the hull touches. `hull` is one convex hull, which fills cavities;
    /// `decomposition` is several convex parts; `triangles` is the mesh without the hull, which is slow.
    #[serde(default)]
    pub collision_shapes: Keyed<Located<MeshMode>>,
    /// Whether Collada collision meshes are accepted; they are converted to triangles when read. STL and OBJ are always
    /// accepted.
    #[serde(default = "yes")]
    pub auto_convert_meshes: bool,
    /// Cap on joint speed, besides the model's limits [rad/s].
    #[serde(default = "max_velocity", deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub max_velocity: f64,
    /// Cap on joint acceleration, besides the model's limits [rad/s²].
    #[serde(default = "max_acceleration", deserialize_with = "positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub max_acceleration: f64,
    /// Cap on joint jerk, besides the limits of the model and the arm [rad/s³].
    #[serde(default, deserialize_with = "maybe_positive")]
    #[schemars(extend("exclusiveMinimum" = 0.0))]
    pub max_jerk: Option<f64>,
    /// Named poses: one position for each of `joint_names` [rad].
    #[serde(default)]
    pub named_poses: Keyed<Located<Vec<f64>>>,
}

/// What happens if a model does not fit its arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ModelMismatch {
    /// Planned motions are refused.
    #[default]
    Refuse,
    /// Motions are planned with additional padding.
    Allow,
}

/// The joint of a model that a gripper drives; other joints may follow by `mimic`.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GripperJointEntry {
    /// Name in the model.
    pub joint: Located<String>,
    /// Position when the gripper is closed [rad or m].
    pub closed: f64,
    /// Position when the gripper is open [rad or m]; in between, it is proportional to the opening.
    pub open: f64,
}

/// The planned joints of a robot.
#[derive(Debug, Clone)]
pub enum RobotJoints {
    /// Their names.
    Names(Vec<Located<String>>),
    /// Those of a group.
    Group(GroupJoints),
}

/// The joints of a group.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct GroupJoints {
    /// The group's name in the robot's SRDF.
    pub group: Located<String>,
}

impl<'de> Deserialize<'de> for RobotJoints {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(RobotJointsVisitor)
    }
}

struct RobotJointsVisitor;

impl<'de> Visitor<'de> for RobotJointsVisitor {
    type Value = RobotJoints;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list of joint names or {group: NAME}")
    }

    fn visit_unit<E>(self) -> Result<RobotJoints, E> {
        Ok(RobotJoints::Names(Vec::new()))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<RobotJoints, A::Error> {
        let mut names = Vec::new();
        while let Some(name) = seq.next_element()? {
            names.push(name);
        }
        Ok(RobotJoints::Names(names))
    }

    fn visit_map<A: MapAccess<'de>>(self, map: A) -> Result<RobotJoints, A::Error> {
        GroupJoints::deserialize(MapAccessDeserializer::new(map)).map(RobotJoints::Group)
    }
}

impl JsonSchema for RobotJoints {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "RobotJoints".into()
    }

    fn json_schema(generator: &mut SchemaGenerator) -> Schema {
        let group = generator.subschema_for::<GroupJoints>();
        json_schema!({ "anyOf": [{ "type": "array", "items": { "type": "string" }, "minItems": 1 }, group] })
    }
}

fn yes() -> bool {
    true
}

fn base_link() -> String {
    "base_link".to_owned()
}

fn max_velocity() -> f64 {
    1.0
}

fn max_acceleration() -> f64 {
    2.0
}

/// An obstacle.
#[derive(Debug, Clone, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ObjectEntry {
    /// Geometry: `box: [x, y, z]`, `sphere: radius`, `cylinder: [radius, length]` [m], `mesh: FILE`, `cloud: FILE`.
    pub shape: Located<ShapeSpec>,
    /// Pose in the frame `map`.
    #[serde(default)]
    pub pose: Located<PoseEntry>,
    /// Padding added on all sides [m].
    #[serde(default, deserialize_with = "non_negative")]
    #[schemars(range(min = 0.0))]
    pub padding: f64,
}

/// A pose.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PoseEntry {
    /// x, y, z [m].
    pub xyz: [f64; 3],
    /// Roll, pitch, yaw about fixed axes [rad].
    pub rpy: Option<[f64; 3]>,
    /// A quaternion x, y, z, w, in place of `rpy`.
    pub quat: Option<[f64; 4]>,
}

/// The live view: a page in the browser that shows the arms and commands them. `dimos view` prints its URL. Without
/// this section a run with a robot model serves it; `--no-view` does without. See `docs/view.md`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ViewConfig {
    /// Backend of the view.
    pub backend: ViewBackend,
    /// IP address that it is served at. `127.0.0.1` is this computer only; with any other one, all who reach the
    /// computer can try, and the connection is not encrypted.
    pub host: IpAddr,
    /// First port that is tried; if others have it, the next free one of 100. 0 = any free port.
    pub port: u16,
    /// Foxglove's WebSocket, at the same address.
    pub foxglove: FoxgloveConfig,
}

impl Default for ViewConfig {
    fn default() -> Self {
        Self {
            backend: ViewBackend::Meshcat,
            host: Ipv4Addr::LOCALHOST.into(),
            port: 7000,
            foxglove: FoxgloveConfig::default(),
        }
    }
}

/// Backend of the view.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ViewBackend {
    /// The page of dimos, in the browser. The name is that of Drake's viewer, whose place it takes.
    #[default]
    Meshcat,
    /// None.
    None,
}

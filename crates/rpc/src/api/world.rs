//! Parameters and replies of the methods that read and change the planner's world.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::parts::LoadReport;
use crate::api::planner::PoseSpec;
use dimos_core::joint::{LONGEST_NAME, may_be_in_name};
use dimos_core::written;
pub use dimos_core::written::ShapeSpec;

/// An object of the world.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WorldObject {
    /// Its name: letters a to z, digits, `_` and `-`, at most 64.
    pub name: String,
    /// Its shape.
    pub shape: ShapeSpec,
    /// Its pose in `map`; for an attached object, in the frame of the link that holds it.
    #[serde(default)]
    pub pose: PoseSpec,
    /// Padding on all sides [m].
    #[serde(default)]
    pub padding: f64,
    /// The robot and the link that hold it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub held_by: Option<[String; 2]>,
}

/// Parameters of `world_add`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct WorldAdd(pub WorldObject);

impl WorldAdd {
    /// Returns what is wrong with the object, if anything.
    pub fn valid(&self) -> Result<(), String> {
        let Self(object) = self;
        if object.held_by.is_some() {
            return Err("`held_by` is set by `attach` only".into());
        }
        // As in a blueprint, which a saved world can become a part of.
        let name = &object.name;
        if !name.chars().all(may_be_in_name) || name.starts_with('-') {
            return Err(format!("name is {name:?}, must be of letters a to z, digits, _ and -, and not begin with -"));
        }
        if name.is_empty() || name.len() > LONGEST_NAME {
            return Err(format!("name has {} characters, must have 1 to {LONGEST_NAME}", name.len()));
        }
        written::padding(object.padding)?;
        object.shape.valid()?;
        object.pose.valid("pose")
    }
}

impl WorldObject {
    /// Returns a doubt about the unit of its lengths, if they are far for an arm's cell.
    pub fn doubt(&self) -> Option<String> {
        written::doubt(&[&self.pose.xyz, self.shape.sizes()].concat()).map(|doubt| format!("{}: {doubt}", self.name))
    }
}

/// An object as written under its name, in a blueprint's `planner.world` and in files.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WorldEntry {
    /// Its shape.
    pub shape: ShapeSpec,
    /// Its pose in `map`.
    #[serde(default)]
    pub pose: PoseSpec,
    /// Padding on all sides [m].
    #[serde(default)]
    pub padding: f64,
}

impl WorldEntry {
    /// Returns the object with this name.
    pub fn named(self, name: String) -> WorldObject {
        WorldObject { name, shape: self.shape, pose: self.pose, padding: self.padding, held_by: None }
    }
}

/// Parameters of `world`: none.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct World {}

/// Reply to `world`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct WorldReport {
    /// Its objects, by name.
    pub objects: Vec<WorldObject>,
}

/// Parameters of `world_move`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WorldMove {
    /// The object's name.
    pub name: String,
    /// Its new pose in `map`.
    pub pose: PoseSpec,
}

impl WorldMove {
    pub(crate) fn valid(&self) -> Result<(), String> {
        self.pose.valid("pose")
    }
}

/// Parameters of `world_remove`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct WorldRemove {
    /// The object's name; default: all objects that are not attached.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
}

/// Parameters of `attach`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Attach {
    /// The object's name.
    pub name: String,
    /// The robot that holds it.
    pub robot: String,
    /// The link that holds it; default: the end-effector link.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub link: Option<String>,
    /// Links that may touch it, besides those that no planned joint moves relative to `link`.
    #[serde(default)]
    pub touch_links: Vec<String>,
    /// Its mass [kg]: the arm's controller is set to carry it, if it takes a payload. The centre of mass and the
    /// inertia are those of a solid body of the object's shape; of a mesh or cloud, a point mass at its origin.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mass: Option<f64>,
    /// Largest distance of its surface from the tool centre point [m]: a farther one is refused, as it is not what the
    /// gripper holds; default: any distance.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub within: Option<f64>,
}

/// `within` of an object that a gripper has just closed on [m]: the length of a large gripper, for robots whose tool
/// centre point is left at the flange.
pub const GRASP_REACH: f64 = 0.2;

impl Attach {
    pub(crate) fn valid(&self) -> Result<(), String> {
        match (self.mass, self.within) {
            (Some(mass), _) if !(mass > 0.0 && mass <= 1000.0) => {
                Err(format!("mass is {mass} kg, must be above 0, at most 1000"))
            }
            (_, Some(within)) if within < 0.0 => Err(format!("within is {within} m, must be 0 or more")),
            (_, within) => within.map_or(Ok(()), written::length).map_err(|wrong| format!("within: {wrong}")),
        }
    }
}

/// Reply to `attach`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct AttachReply {
    /// The object as a load in the flange frame (that of the robot's end-effector link); absent without a mass.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub load: Option<LoadReport>,
    /// The load that the arm's controller now reports; absent without a mass, or if it takes no payload.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub payload: Option<LoadReport>,
}

/// Parameters of `detach`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Detach {
    /// The object's name.
    pub name: String,
}

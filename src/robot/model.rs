//! A robot as plain data: links, joints, shapes, limits. Frames and units as in URDF: metres, radians, seconds.
//!
//! The links stand in the order of the tree, parents before children, and joint `i` carries link `i + 1`:
//!
//! ```text
//!  links   [0] base ── [1] link1 ── [2] link2 …
//!  joints        [0]          [1]
//! ```

use std::collections::HashMap;
use std::path::PathBuf;

use nalgebra::{Isometry3, Matrix3, Unit, Vector3};
use serde::{Deserialize, Serialize};

use crate::named::named;

/// A robot: a tree of links. Links are `0..n`, joints are `0..n-1`, both in an order where parents come first;
/// joint `i` moves link `i + 1`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RobotModel {
    /// The robot's name.
    pub name: String,
    /// The links; `links[0]` is the root.
    pub links: Vec<Link>,
    /// The joints; `joints[i]` carries `links[i + 1]`.
    pub joints: Vec<Joint>,
}

/// A rigid body with its own frame: that of the joint which carries it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Link {
    /// Its name, unique in the robot.
    pub name: String,
    /// What it looks like.
    pub visuals: Vec<Shape>,
    /// What must not touch anything.
    pub collisions: Vec<Shape>,
    /// Mass and inertia, where stated.
    pub inertial: Option<Inertial>,
}

/// A shape on a link.
#[derive(Debug, Clone, PartialEq)]
pub struct Shape {
    /// Its name, where it has one.
    pub name: Option<String>,
    /// The shape's frame in the link's frame.
    pub origin: Isometry3<f64>,
    /// What it is.
    pub geometry: Geometry,
    /// Red, green, blue, opacity, each 0–1; `None` for collision shapes and where nothing is stated.
    pub color: Option<[f64; 4]>,
}

/// A geometry in the frame of its shape, centred at the origin. All lengths in metres.
#[derive(Debug, Clone, PartialEq)]
pub enum Geometry {
    /// A box with these full extents along x, y, z [m].
    Box {
        /// Full extents [m].
        size: Vector3<f64>,
    },
    /// A sphere.
    Sphere {
        /// Radius [m].
        radius: f64,
    },
    /// A cylinder along z.
    Cylinder {
        /// Radius [m].
        radius: f64,
        /// Full length along z [m].
        length: f64,
    },
    /// A cylinder along z with a half sphere on each end.
    Capsule {
        /// Radius of cylinder and half spheres [m].
        radius: f64,
        /// Length of the cylinder alone [m].
        length: f64,
    },
    /// A triangle mesh from a file.
    Mesh(MeshFile),
}

/// A mesh that a shape names.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshFile {
    /// As the description names it: `package://arm/meshes/base.stl`, `file:///…`, a relative path.
    pub uri: String,
    /// Where it is; `None` when the file was not found, or not looked for.
    pub path: Option<PathBuf>,
    /// Factors along x, y, z; a negative one mirrors.
    pub scale: Vector3<f64>,
}

impl MeshFile {
    /// Whether it is a Collada file: a scene that must be converted to triangles.
    pub fn is_collada(&self) -> bool {
        self.uri.to_ascii_lowercase().ends_with(".dae")
    }
}

/// Mass and inertia.
#[derive(Debug, Clone, PartialEq)]
pub struct Inertial {
    /// The frame of centre of mass and inertia, in the link's frame.
    pub origin: Isometry3<f64>,
    /// Mass [kg].
    pub mass: f64,
    /// Inertia about the centre of mass [kg·m²].
    pub inertia: Matrix3<f64>,
}

named! {
    /// What a joint lets its link do.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "lowercase")]
    pub enum JointKind {
        /// Nothing.
        Fixed = "fixed",
        /// Turn about the axis, between limits [rad].
        Revolute = "revolute",
        /// Turn about the axis without end [rad].
        Continuous = "continuous",
        /// Slide along the axis, between limits [m].
        Prismatic = "prismatic",
    }
}

impl JointKind {
    /// The unit of its position.
    pub fn unit(self) -> &'static str {
        if self == Self::Prismatic { "m" } else { "rad" }
    }

    /// Whether its position is an angle [rad] and not a length [m].
    pub fn is_angle(self) -> bool {
        matches!(self, Self::Revolute | Self::Continuous)
    }
}

/// A joint: where it sits on its parent, and how its child moves.
///
/// The child's frame in the parent's frame at position `q` is `origin · motion(q)`, where the motion turns about
/// `axis` (revolute, continuous) or slides along it (prismatic).
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// Its name, unique in the robot.
    pub name: String,
    /// What it lets its child do.
    pub kind: JointKind,
    /// Index of the parent link.
    pub parent: usize,
    /// Index of the child link: always the joint's own index + 1.
    pub child: usize,
    /// The joint's frame in the parent link's frame.
    pub origin: Isometry3<f64>,
    /// Direction of the axis in the joint's frame. Of no meaning for fixed joints.
    pub axis: Unit<Vector3<f64>>,
    /// Its limits.
    pub limits: Limits,
    /// The joint that it follows, if it does not move on its own.
    pub mimic: Option<Mimic>,
}

impl Joint {
    /// Whether it can move, on its own or by following another.
    pub fn is_movable(&self) -> bool {
        self.kind != JointKind::Fixed
    }

    /// Whether it has a position of its own: it moves, and does not follow another.
    pub fn is_independent(&self) -> bool {
        self.is_movable() && self.mimic.is_none()
    }

    /// The child's frame in the parent's frame at a position [rad or m].
    pub fn transform(&self, position: f64) -> Isometry3<f64> {
        match self.kind {
            JointKind::Fixed => self.origin,
            JointKind::Revolute | JointKind::Continuous => {
                self.origin * nalgebra::UnitQuaternion::from_axis_angle(&self.axis, position)
            }
            JointKind::Prismatic => self.origin * nalgebra::Translation3::from(self.axis.into_inner() * position),
        }
    }
}

/// Limits of a joint; for prismatic joints in metres instead of radians. What is not stated is infinite or `None`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Lowest position [rad or m]; -∞ for continuous joints.
    pub lower: f64,
    /// Highest position [rad or m]; ∞ for continuous joints.
    pub upper: f64,
    /// Highest speed [rad/s or m/s]; ∞ where none is stated.
    pub velocity: f64,
    /// Highest torque or force [N·m or N]; ∞ where none is stated.
    pub effort: f64,
    /// Highest acceleration [rad/s² or m/s²]; URDF states none, `joint_limits.yaml` may.
    pub acceleration: Option<f64>,
    /// Highest jerk [rad/s³ or m/s³]; URDF states none, `joint_limits.yaml` may.
    pub jerk: Option<f64>,
}

impl Limits {
    /// No limits at all.
    pub const NONE: Self = Self {
        lower: f64::NEG_INFINITY,
        upper: f64::INFINITY,
        velocity: f64::INFINITY,
        effort: f64::INFINITY,
        acceleration: None,
        jerk: None,
    };
}

/// A joint that follows another: `position = multiplier · leader + offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mimic {
    /// Index of the joint that leads: always an independent one, chains are resolved.
    pub leader: usize,
    /// Factor.
    pub multiplier: f64,
    /// Position when the leader stands at zero [rad or m].
    pub offset: f64,
}

impl RobotModel {
    /// Index of a link by name.
    pub fn link_index(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|link| link.name == name)
    }

    /// Index of a joint by name.
    pub fn joint_index(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|joint| joint.name == name)
    }

    /// The joint that carries a link; `None` for the root.
    pub fn parent_joint(&self, link: usize) -> Option<&Joint> {
        link.checked_sub(1).and_then(|i| self.joints.get(i))
    }

    /// Indices of the joints that have a position of their own, in the order of the tree: the robot's configuration.
    pub fn independent_joints(&self) -> Vec<usize> {
        (0..self.joints.len()).filter(|i| self.joints[*i].is_independent()).collect()
    }

    /// Indices of the joints from one link down to another, in that order; `None` when `tip` does not hang below
    /// `base`.
    pub fn chain(&self, base: usize, tip: usize) -> Option<Vec<usize>> {
        let mut joints = Vec::new();
        let mut link = tip;
        while link != base {
            let joint = self.parent_joint(link)?;
            joints.push(link - 1);
            link = joint.parent;
        }
        joints.reverse();
        Some(joints)
    }

    /// Positions of all joints from those of independent ones by name; joints that are not named stand at zero, and
    /// followers follow.
    pub fn positions(&self, named: &HashMap<String, f64>) -> Vec<f64> {
        let own = |joint: &Joint| named.get(&joint.name).copied().unwrap_or(0.0);
        let position = |joint: &Joint| match joint.mimic {
            Some(mimic) => mimic.multiplier * self.joints.get(mimic.leader).map_or(0.0, own) + mimic.offset,
            None => own(joint),
        };
        self.joints.iter().map(position).collect()
    }

    /// The frame of every link in the root's frame, from positions of all joints (see [`RobotModel::positions`]).
    pub fn link_poses(&self, positions: &[f64]) -> Vec<Isometry3<f64>> {
        let mut poses = vec![Isometry3::identity(); self.links.len()];
        for (i, joint) in self.joints.iter().enumerate() {
            poses[joint.child] = poses[joint.parent] * joint.transform(positions.get(i).copied().unwrap_or(0.0));
        }
        poses
    }

    /// The first link that collides by a Collada file, and the file.
    pub fn collada_collision(&self) -> Option<(&Link, &MeshFile)> {
        let mesh = |shape| match shape {
            &Shape { geometry: Geometry::Mesh(ref mesh), .. } if mesh.is_collada() => Some(mesh),
            _ => None,
        };
        self.links.iter().find_map(|link| Some((link, link.collisions.iter().find_map(mesh)?)))
    }

    /// Mesh files of all shapes.
    pub fn meshes(&self) -> impl Iterator<Item = &MeshFile> {
        let shapes = self.links.iter().flat_map(|link| link.visuals.iter().chain(&link.collisions));
        shapes.filter_map(|shape| match &shape.geometry {
            Geometry::Mesh(mesh) => Some(mesh),
            _ => None,
        })
    }
}

/// A pose from a position [m] and URDF's fixed-axis roll, pitch, yaw [rad].
pub fn pose(xyz: [f64; 3], rpy: [f64; 3]) -> Isometry3<f64> {
    Isometry3::from_parts(xyz.into(), nalgebra::UnitQuaternion::from_euler_angles(rpy[0], rpy[1], rpy[2]))
}

//! A robot as plain data: links, joints, shapes, limits. Frames and units as in URDF: metres, radians, seconds.
//!
//! Links are in tree order, parents before children, and joint `i` carries link `i + 1`:
//!
//! ```text
//!  links   [0] base ── [1] link1 ── [2] link2 …
//!  joints        [0]          [1]
//! ```

use std::collections::HashMap;
use std::path::PathBuf;

use nalgebra::{Isometry3, Matrix3, Unit, Vector3};
use serde::{Deserialize, Serialize};

use dimos_core::named::named;

/// A robot: a tree of links. Links are `0..n`, joints are `0..n-1`, both with parents first; joint `i` moves link `i +
/// 1`.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct RobotModel {
    /// Name of the robot.
    pub name: String,
    /// The links; `links[0]` is the root.
    pub links: Vec<Link>,
    /// The joints; `joints[i]` carries `links[i + 1]`.
    pub joints: Vec<Joint>,
}

/// A rigid body with its own frame: that of the joint that carries it.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Link {
    /// Name, unique in the robot.
    pub name: String,
    /// Visual shapes.
    pub visuals: Vec<Shape>,
    /// Collision shapes.
    pub collisions: Vec<Shape>,
    /// Mass and inertia, if given.
    pub inertial: Option<Inertial>,
}

/// A shape on a link.
#[derive(Debug, Clone, PartialEq)]
pub struct Shape {
    /// Name, if given.
    pub name: Option<String>,
    /// The shape's frame in the link's frame.
    pub origin: Isometry3<f64>,
    /// Geometry.
    pub geometry: Geometry,
    /// Red, green, blue, opacity, each 0–1; `None` for collision shapes and where not given.
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

/// A mesh file of a shape.
#[derive(Debug, Clone, PartialEq)]
pub struct MeshFile {
    /// URI in the description: `package://arm/meshes/base.stl`, `file:///…`, a relative path.
    pub uri: String,
    /// Its path; `None` if the file was not found, or not looked for.
    pub path: Option<PathBuf>,
    /// Factors along x, y, z; a negative one mirrors.
    pub scale: Vector3<f64>,
}

impl MeshFile {
    /// Returns whether it is a Collada file: a scene that must be converted to triangles.
    pub fn is_collada(&self) -> bool {
        self.uri.to_ascii_lowercase().ends_with(".dae")
    }
}

/// Mass and inertia.
#[derive(Debug, Clone, PartialEq)]
pub struct Inertial {
    /// Frame of centre of mass and inertia, in the link's frame.
    pub origin: Isometry3<f64>,
    /// Mass [kg].
    pub mass: f64,
    /// Inertia about the centre of mass [kg·m²].
    pub inertia: Matrix3<f64>,
}

named! {
    /// Kind of a joint.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
    #[serde(rename_all = "lowercase")]
    pub enum JointKind {
        /// No motion.
        Fixed = "fixed",
        /// Rotation about the axis, between limits [rad].
        Revolute = "revolute",
        /// Rotation about the axis without limits [rad].
        Continuous = "continuous",
        /// Translation along the axis, between limits [m].
        Prismatic = "prismatic",
    }
}

impl JointKind {
    /// Returns the unit of its position.
    pub fn unit(self) -> &'static str {
        if self == Self::Prismatic { "m" } else { "rad" }
    }

    /// Returns whether its position is an angle [rad] rather than a length [m].
    pub fn is_angle(self) -> bool {
        matches!(self, Self::Revolute | Self::Continuous)
    }
}

/// A joint: its frame on the parent link, and the motion of the child link.
///
/// The child's frame in the parent's frame at position `q` is `origin · motion(q)`; the motion rotates about `axis`
/// (revolute, continuous) or translates along it (prismatic).
#[derive(Debug, Clone, PartialEq)]
pub struct Joint {
    /// Name, unique in the robot.
    pub name: String,
    /// Kind.
    pub kind: JointKind,
    /// Index of the parent link.
    pub parent: usize,
    /// Index of the child link: always the joint's own index + 1.
    pub child: usize,
    /// The joint's frame in the parent link's frame.
    pub origin: Isometry3<f64>,
    /// Direction of the axis in the joint's frame. Unused for fixed joints.
    pub axis: Unit<Vector3<f64>>,
    /// Limits.
    pub limits: Limits,
    /// The joint that it mimics, if any.
    pub mimic: Option<Mimic>,
}

impl Joint {
    /// Returns whether it can move, independently or as a mimic joint.
    pub fn is_movable(&self) -> bool {
        self.kind != JointKind::Fixed
    }

    /// Returns whether it has a position of its own: it moves, and is not a mimic joint.
    pub fn is_independent(&self) -> bool {
        self.is_movable() && self.mimic.is_none()
    }

    /// Returns the child's frame in the parent's frame at a position [rad or m].
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

/// Limits of a joint; for prismatic joints in metres instead of radians. Absent limits are infinite or `None`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Lowest position [rad or m]; -∞ for continuous joints.
    pub lower: f64,
    /// Highest position [rad or m]; ∞ for continuous joints.
    pub upper: f64,
    /// Maximum speed [rad/s or m/s]; ∞ if not given.
    pub velocity: f64,
    /// Maximum torque or force [N·m or N]; ∞ if not given.
    pub effort: f64,
    /// Maximum acceleration [rad/s² or m/s²]; not in URDF, optional in `joint_limits.yaml`.
    pub acceleration: Option<f64>,
    /// Maximum jerk [rad/s³ or m/s³]; not in URDF, optional in `joint_limits.yaml`.
    pub jerk: Option<f64>,
}

impl Limits {
    /// No limits.
    pub const NONE: Self = Self {
        lower: f64::NEG_INFINITY,
        upper: f64::INFINITY,
        velocity: f64::INFINITY,
        effort: f64::INFINITY,
        acceleration: None,
        jerk: None,
    };
}

/// A mimic relation: `position = multiplier · leader + offset`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Mimic {
    /// Index of the leader: always an independent joint, chains are resolved.
    pub leader: usize,
    /// Factor.
    pub multiplier: f64,
    /// Position when the leader is at zero [rad or m].
    pub offset: f64,
}

impl RobotModel {
    /// Returns the index of a link by name.
    pub fn link_index(&self, name: &str) -> Option<usize> {
        self.links.iter().position(|link| link.name == name)
    }

    /// Returns the index of a joint by name.
    pub fn joint_index(&self, name: &str) -> Option<usize> {
        self.joints.iter().position(|joint| joint.name == name)
    }

    /// Returns the joint that carries a link; `None` for the root.
    pub fn parent_joint(&self, link: usize) -> Option<&Joint> {
        link.checked_sub(1).and_then(|i| self.joints.get(i))
    }

    /// Returns the indices of the independent joints, in tree order: the robot's configuration.
    pub fn independent_joints(&self) -> Vec<usize> {
        (0..self.joints.len()).filter(|i| self.joints[*i].is_independent()).collect()
    }

    /// Returns the indices of the joints from one link down to another, in that order; `None` if `tip` is not below
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

    /// Returns the indices of the joints on the way from one link to another: up to the link that carries both, then
    /// down.
    pub fn path(&self, from: usize, to: usize) -> Vec<usize> {
        let to_root = |mut link: usize| {
            let mut joints = Vec::new();
            while let Some(joint) = self.parent_joint(link) {
                joints.push(link - 1);
                link = joint.parent;
            }
            joints
        };
        let (mut up, mut down) = (to_root(from), to_root(to));
        while up.last().is_some_and(|last| down.last() == Some(last)) {
            up.pop();
            down.pop();
        }
        up.extend(down.into_iter().rev());
        up
    }

    /// Returns the independent joints that move some joints: themselves, or the leaders of mimic joints, each once.
    pub fn independent_of(&self, joints: &[usize]) -> Vec<usize> {
        let mut independent = Vec::new();
        for joint in joints {
            let Some(own) = self.joints.get(*joint).filter(|own| own.is_movable()) else { continue };
            let leader = own.mimic.map_or(*joint, |mimic| mimic.leader);
            if !independent.contains(&leader) {
                independent.push(leader);
            }
        }
        independent
    }

    /// Returns the positions of all joints from those of independent ones by name; joints not named are at zero, mimic
    /// joints follow.
    pub fn positions(&self, named: &HashMap<String, f64>) -> Vec<f64> {
        let own = |joint: &Joint| named.get(&joint.name).copied().unwrap_or(0.0);
        let position = |joint: &Joint| match joint.mimic {
            Some(mimic) => mimic.multiplier * self.joints.get(mimic.leader).map_or(0.0, own) + mimic.offset,
            None => own(joint),
        };
        self.joints.iter().map(position).collect()
    }

    /// Makes joints fixed ones where they are, and those that mimic them; `positions` are of all joints (see
    /// [`RobotModel::positions`]) [rad or m].
    pub fn fix(&mut self, joints: impl IntoIterator<Item = usize>, positions: &[f64]) {
        for fixed in joints {
            for (index, joint) in self.joints.iter_mut().enumerate() {
                if index == fixed || joint.mimic.is_some_and(|mimic| mimic.leader == fixed) {
                    joint.origin = joint.transform(positions.get(index).copied().unwrap_or_default());
                    (joint.kind, joint.mimic) = (JointKind::Fixed, None);
                }
            }
        }
    }

    /// Returns the frame of every link in the root's frame, from positions of all joints (see
    /// [`RobotModel::positions`]).
    pub fn link_poses(&self, positions: &[f64]) -> Vec<Isometry3<f64>> {
        let mut poses = vec![Isometry3::identity(); self.links.len()];
        for (i, joint) in self.joints.iter().enumerate() {
            poses[joint.child] = poses[joint.parent] * joint.transform(positions.get(i).copied().unwrap_or(0.0));
        }
        poses
    }

    /// Returns the first link with a Collada file as collision mesh, and the file.
    pub fn collada_collision(&self) -> Option<(&Link, &MeshFile)> {
        let mesh = |shape| match shape {
            &Shape { geometry: Geometry::Mesh(ref mesh), .. } if mesh.is_collada() => Some(mesh),
            _ => None,
        };
        self.links.iter().find_map(|link| Some((link, link.collisions.iter().find_map(mesh)?)))
    }

    /// Returns the mesh files of all shapes.
    pub fn meshes(&self) -> impl Iterator<Item = &MeshFile> {
        let shapes = self.links.iter().flat_map(|link| link.visuals.iter().chain(&link.collisions));
        shapes.filter_map(|shape| match &shape.geometry {
            Geometry::Mesh(mesh) => Some(mesh),
            _ => None,
        })
    }
}

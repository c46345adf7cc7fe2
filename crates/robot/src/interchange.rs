//! Converts a robot to and from [`urdf_rs::Robot`], which other Rust programs (openrr, k …) use.

use nalgebra::{Isometry3, Vector3};
use urdf_rs::{Axis, Collision, Color, JointLimit, JointType, LinkName, Mass, Material, Pose, Vec3, Vec4, Visual};

use super::model::{Geometry, Inertial, Joint, JointKind, Limits, Link, RobotModel, Shape};
use super::urdf;

/// Below this cosine of the pitch, roll and yaw turn about the same axis.
const GIMBAL_LOCK: f64 = 1e-9;

/// All mistakes that prevent reading a description.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{0}")]
pub struct NoRobot(String);

impl TryFrom<&urdf_rs::Robot> for RobotModel {
    type Error = NoRobot;

    /// Reads the robot by the same rules as a file. Meshes are not located. An inertial of zeros counts as absent:
    /// `urdf_rs` uses zeros for a link without one.
    fn try_from(robot: &urdf_rs::Robot) -> Result<Self, NoRobot> {
        let text = urdf_rs::write_to_string(robot).map_err(|e| NoRobot(e.to_string()))?;
        let mut model = urdf::from_text(&robot.name, &text).map_err(NoRobot)?;
        for link in &mut model.links {
            link.inertial = link.inertial.take().filter(|i| i.mass != 0.0 || i.inertia.amax() != 0.0);
        }
        Ok(model)
    }
}

impl From<&RobotModel> for urdf_rs::Robot {
    fn from(model: &RobotModel) -> Self {
        let joint = |joint: &Joint| joint_of(joint, model);
        Self {
            name: model.name.clone(),
            version: None,
            links: model.links.iter().map(link_of).collect(),
            joints: model.joints.iter().map(joint).collect(),
            materials: Vec::new(),
        }
    }
}

fn link_of(link: &Link) -> urdf_rs::Link {
    let visual = |shape: &Shape| Visual {
        name: shape.name.clone(),
        origin: pose_of(&shape.origin),
        geometry: geometry_of(&shape.geometry),
        material: shape.color.map(material_of),
    };
    let collision = |shape: &Shape| Collision {
        name: shape.name.clone(),
        origin: pose_of(&shape.origin),
        geometry: geometry_of(&shape.geometry),
    };
    urdf_rs::Link {
        name: link.name.clone(),
        inertial: link.inertial.as_ref().map(inertial_of).unwrap_or_default(),
        visual: link.visuals.iter().map(visual).collect(),
        collision: link.collisions.iter().map(collision).collect(),
    }
}

fn joint_of(joint: &Joint, model: &RobotModel) -> urdf_rs::Joint {
    let link = |index: usize| LinkName { link: model.links.get(index).map(|l| l.name.clone()).unwrap_or_default() };
    let mimic = joint.mimic.and_then(|mimic| {
        let leader = model.joints.get(mimic.leader)?.name.clone();
        Some(urdf_rs::Mimic { joint: leader, multiplier: Some(mimic.multiplier), offset: Some(mimic.offset) })
    });
    urdf_rs::Joint {
        name: joint.name.clone(),
        joint_type: match joint.kind {
            JointKind::Fixed => JointType::Fixed,
            JointKind::Revolute => JointType::Revolute,
            JointKind::Continuous => JointType::Continuous,
            JointKind::Prismatic => JointType::Prismatic,
        },
        origin: pose_of(&joint.origin),
        parent: link(joint.parent),
        child: link(joint.child),
        axis: Axis { xyz: vector_of(&joint.axis) },
        limit: limit_of(&joint.limits),
        calibration: None,
        dynamics: None,
        mimic,
        safety_controller: None,
    }
}

/// What is not stated is zero for speed and effort, as exporters write it, and infinite for the rest.
fn limit_of(limits: &Limits) -> JointLimit {
    let stated = |value: f64| if value.is_finite() { value } else { 0.0 };
    let acceleration = limits.acceleration.unwrap_or(f64::INFINITY);
    JointLimit {
        lower: limits.lower,
        upper: limits.upper,
        effort: stated(limits.effort),
        velocity: stated(limits.velocity),
        acceleration,
        deceleration: acceleration,
        jerk: limits.jerk.unwrap_or(f64::INFINITY),
    }
}

fn geometry_of(geometry: &Geometry) -> urdf_rs::Geometry {
    match geometry {
        Geometry::Box { size } => urdf_rs::Geometry::Box { size: vector_of(size) },
        Geometry::Sphere { radius } => urdf_rs::Geometry::Sphere { radius: *radius },
        Geometry::Cylinder { radius, length } => urdf_rs::Geometry::Cylinder { radius: *radius, length: *length },
        Geometry::Capsule { radius, length } => urdf_rs::Geometry::Capsule { radius: *radius, length: *length },
        Geometry::Mesh(mesh) => {
            urdf_rs::Geometry::Mesh { filename: mesh.uri.clone(), scale: Some(vector_of(&mesh.scale)) }
        }
    }
}

/// A colour has a name in URDF: the same for the same colour.
fn material_of(rgba: [f64; 4]) -> Material {
    let [r, g, b, a] = rgba;
    Material { name: format!("rgba_{r}_{g}_{b}_{a}"), color: Some(Color { rgba: Vec4(rgba) }), texture: None }
}

fn inertial_of(inertial: &Inertial) -> urdf_rs::Inertial {
    let m = &inertial.inertia;
    urdf_rs::Inertial {
        origin: pose_of(&inertial.origin),
        mass: Mass { value: inertial.mass },
        inertia: urdf_rs::Inertia { ixx: m.m11, ixy: m.m12, ixz: m.m13, iyy: m.m22, iyz: m.m23, izz: m.m33 },
    }
}

fn vector_of(vector: &Vector3<f64>) -> Vec3 {
    Vec3((*vector).into())
}

/// A pose as URDF writes it: position and fixed-axis roll, pitch, yaw. The pitch comes from a tangent, which keeps its
/// digits near a right angle.
fn pose_of(pose: &Isometry3<f64>) -> Pose {
    let m = pose.rotation.to_rotation_matrix().into_inner();
    let cosine = m.m11.hypot(m.m21);
    let pitch = (-m.m31).atan2(cosine);
    let rpy = if cosine > GIMBAL_LOCK {
        [m.m32.atan2(m.m33), pitch, m.m21.atan2(m.m11)]
    } else {
        [(-m.m23).atan2(m.m22), pitch, 0.0]
    };
    Pose { xyz: vector_of(&pose.translation.vector), rpy: Vec3(rpy) }
}

//! Forward kinematics, Jacobians and one damped step, for a selection of joints, without allocation.
//!
//! A model is compiled once: links welded by fixed joints become one *body*, joints outside the selection are fixed at
//! a given position, mimic joints follow, and each body's frame is oriented so that its joint moves about or along z. A
//! query then computes one frame per moving joint; links are constant offsets from bodies.
//!
//! All frames are in the frame of the model's root link.

pub mod jacobian;
pub mod step;
mod stored;
pub mod tool_speed;

use std::f64::consts::TAU;

use dimos_kernels::chain;
use glamx::{DAffine3, DMat3, DQuat, DVec3};
use nalgebra::Isometry3;
use serde::{Deserialize, Serialize};

use crate::model::{Joint, JointKind, Limits, RobotModel};

/// Motion of a body relative to its parent.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Motion {
    /// Rotation about z.
    Turn,
    /// Translation along z.
    Slide,
}

/// Links that move as one.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Body {
    /// Index of the body that it moves relative to.
    pub(crate) parent: usize,
    /// Frame at joint position zero, in the parent body's frame; its z is the joint's axis.
    pub(crate) origin: DAffine3,
    pub(crate) motion: Motion,
    /// `position = multiplier · q[variable] + offset`.
    pub(crate) variable: usize,
    pub(crate) multiplier: f64,
    pub(crate) offset: f64,
}

/// Why kinematics cannot be built from a model.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum KinematicsError {
    /// The joint has no position of its own.
    #[error("joint {0:?} cannot be selected: it is {1}")]
    NotIndependent(String, &'static str),
    /// The joint is selected twice.
    #[error("joint {0:?} is selected twice")]
    Twice(String),
    /// The joint does not exist.
    #[error("the robot has no joint with index {0}")]
    NoJoint(usize),
}

/// Kinematics of selected joints of a robot; all others are fixed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "stored::Stored", into = "stored::Stored")]
pub struct Kinematics {
    names: Vec<String>,
    limits: Vec<Limits>,
    kinds: Vec<JointKind>,
    /// `bodies[0]` is the root and has no joint; only its frame is used.
    pub(crate) bodies: Vec<Body>,
    /// For every link of the model: its body, and its frame in the body's frame.
    pub(crate) links: Vec<(usize, DAffine3)>,
}

impl Kinematics {
    /// Compiles a model for the independent joints `joints` (indices in the model, in the order of the configuration
    /// `q`); all others are fixed at `rest` (positions of all joints, see [`RobotModel::positions`]).
    pub fn new(model: &RobotModel, joints: &[usize], rest: &[f64]) -> Result<Self, KinematicsError> {
        for (i, &j) in joints.iter().enumerate() {
            let joint = model.joints.get(j).ok_or(KinematicsError::NoJoint(j))?;
            if !joint.is_independent() {
                let why = if joint.is_movable() { "a mimic joint" } else { "fixed" };
                return Err(KinematicsError::NotIndependent(joint.name.clone(), why));
            }
            if joints[..i].contains(&j) {
                return Err(KinematicsError::Twice(joint.name.clone()));
            }
        }
        let mut made = Self {
            names: joints.iter().map(|&j| model.joints[j].name.clone()).collect(),
            limits: joints.iter().map(|&j| model.joints[j].limits).collect(),
            kinds: joints.iter().map(|&j| model.joints[j].kind).collect(),
            bodies: vec![Body {
                parent: 0,
                origin: DAffine3::IDENTITY,
                motion: Motion::Turn,
                variable: 0,
                multiplier: 0.0,
                offset: 0.0,
            }],
            links: vec![(0, DAffine3::IDENTITY)],
        };
        for (j, joint) in model.joints.iter().enumerate() {
            made.add(j, joint, joints, rest.get(j).copied().unwrap_or(0.0));
        }
        Ok(made)
    }

    /// Compiles a model for all its independent joints.
    pub fn whole(model: &RobotModel) -> Result<Self, KinematicsError> {
        Self::new(model, &model.independent_joints(), &[])
    }

    fn add(&mut self, j: usize, joint: &Joint, joints: &[usize], rest: f64) {
        let (parent, place) = self.links[joint.parent];
        let (leader, multiplier, offset) = joint.mimic.map_or((j, 1.0, 0.0), |m| (m.leader, m.multiplier, m.offset));
        let variable = joints.iter().position(|&chosen| chosen == leader);
        let Some(variable) = variable.filter(|_| joint.is_movable()) else {
            self.links.push((parent, place * frame(&joint.transform(rest))));
            return;
        };
        let axis = DVec3::new(joint.axis.x, joint.axis.y, joint.axis.z);
        let turned = DAffine3::from_quat(DQuat::from_rotation_arc(DVec3::Z, axis));
        let motion = if joint.kind.is_angle() { Motion::Turn } else { Motion::Slide };
        let origin = place * frame(&joint.origin) * turned;
        self.bodies.push(Body { parent, origin, motion, variable, multiplier, offset });
        self.links.push((self.bodies.len() - 1, DAffine3::from_mat3(turned.matrix3.transpose())));
    }

    /// Returns the number of joints in a configuration.
    pub fn dof(&self) -> usize {
        self.names.len()
    }

    /// Returns the names of the joints, in the order of a configuration.
    pub fn names(&self) -> &[String] {
        &self.names
    }

    /// Returns the limits of the joints.
    pub fn limits(&self) -> &[Limits] {
        &self.limits
    }

    /// Returns the kinds of the joints.
    pub fn kinds(&self) -> &[JointKind] {
        &self.kinds
    }

    /// Returns whether a whole turn of a joint changes no link's pose, mimic joints included.
    fn is_periodic(&self, variable: usize) -> bool {
        let round = |b: &Body| b.motion == Motion::Turn && b.multiplier.fract() == 0.0;
        self.bodies.iter().skip(1).filter(|b| b.variable == variable).all(round)
    }

    /// Returns which joints are continuous: periodic and without limits.
    pub fn turns(&self) -> Vec<bool> {
        let endless = |l: &Limits| l.lower == f64::NEG_INFINITY && l.upper == f64::INFINITY;
        self.limits.iter().enumerate().map(|(v, l)| endless(l) && self.is_periodic(v)).collect()
    }

    /// Shifts joints of some kinds by whole turns towards `near`, as far as their limits allow: every link keeps its
    /// pose. A joint that is already nearest keeps its exact value.
    pub fn unwind(&self, q: &mut [f64], near: &[f64], of: impl Fn(JointKind) -> bool) {
        let joints =
            self.kinds.iter().zip(&self.limits).enumerate().filter(|(v, (k, _))| of(**k) && self.is_periodic(*v));
        for (v, (_, limits)) in joints {
            let (Some(q), Some(near)) = (q.get_mut(v), near.get(v)) else { continue };
            // Where limits interfere, the last whole turn within them is nearest.
            let (most, least) = (((limits.upper - *q) / TAU).floor(), ((limits.lower - *q) / TAU).ceil());
            let whole = ((near - *q) / TAU).round().min(most).max(least);
            if whole != 0.0 && (limits.lower..=limits.upper).contains(&(*q + whole * TAU)) {
                *q += whole * TAU;
            }
        }
    }

    /// Returns the number of bodies including the root: the length of a buffer of frames.
    pub fn bodies(&self) -> usize {
        self.bodies.len()
    }

    /// Returns the number of links of the model.
    pub fn links(&self) -> usize {
        self.links.len()
    }

    /// Returns a buffer for [`Kinematics::forward`].
    pub fn frames(&self) -> Vec<DAffine3> {
        vec![DAffine3::IDENTITY; self.bodies.len()]
    }

    /// Computes the frame of every body at configuration `q` [rad or m], with the root at `base`.
    pub fn forward_from(&self, base: &DAffine3, q: &[f64], frames: &mut [DAffine3]) {
        if let Some(root) = frames.first_mut() {
            *root = *base;
        }
        for (b, body) in self.bodies.iter().enumerate().skip(1) {
            let at = body.multiplier * q.get(body.variable).copied().unwrap_or(0.0) + body.offset;
            let Some(parent) = frames.get(body.parent).copied() else { return };
            let Some(frame) = frames.get_mut(b) else { return };
            let turn = parent.matrix3 * body.origin.matrix3;
            let place = parent.matrix3 * body.origin.translation + parent.translation;
            *frame = match body.motion {
                Motion::Turn => {
                    let (sin, cos) = at.sin_cos();
                    let (x, y) = (turn.x_axis, turn.y_axis);
                    let matrix3 = DMat3::from_cols(x * cos + y * sin, y * cos - x * sin, turn.z_axis);
                    DAffine3 { matrix3, translation: place }
                }
                Motion::Slide => DAffine3 { matrix3: turn, translation: place + turn.z_axis * at },
            };
        }
    }

    /// Computes the frame of every body at configuration `q` [rad or m].
    pub fn forward(&self, q: &[f64], frames: &mut [DAffine3]) {
        self.forward_from(&DAffine3::IDENTITY, q, frames);
    }

    /// Returns the frame of a link, from frames of bodies.
    pub fn link_frame(&self, link: usize, frames: &[DAffine3]) -> DAffine3 {
        let (body, offset) = self.links.get(link).copied().unwrap_or((0, DAffine3::IDENTITY));
        frames.get(body).copied().unwrap_or(DAffine3::IDENTITY) * offset
    }

    /// Adds a frame that is fixed to a link, as one more link; returns its index. `offset`: its pose in the link's
    /// frame.
    pub fn attach_frame(&mut self, link: usize, offset: &DAffine3) -> usize {
        self.links.push((self.body_of(link), self.offset_of(link) * *offset));
        self.links.len() - 1
    }

    /// Moves a frame that [`attach_frame`](Self::attach_frame) added. Does not allocate.
    pub fn move_frame(&mut self, frame: usize, link: usize, offset: &DAffine3) {
        let (body, place) = (self.body_of(link), self.offset_of(link) * *offset);
        if let Some(moved) = self.links.get_mut(frame) {
            *moved = (body, place);
        }
    }

    /// Returns the body of a link.
    pub fn body_of(&self, link: usize) -> usize {
        self.links.get(link).map_or(0, |l| l.0)
    }

    /// Returns a link's frame in the frame of its body.
    pub fn offset_of(&self, link: usize) -> DAffine3 {
        self.links.get(link).map_or(DAffine3::IDENTITY, |l| l.1)
    }

    /// Returns the bodies from a body up to the root, without the root.
    pub fn ancestors(&self, body: usize) -> impl Iterator<Item = usize> + '_ {
        let up = |b: &usize| self.bodies.get(*b).map(|body| body.parent).filter(|p| *p != 0);
        std::iter::successors(Some(body).filter(|b| *b != 0), up)
    }

    /// Returns how a body depends on the configuration: the joint's index in `q` and the mimic factor.
    pub fn drive(&self, body: usize) -> Option<(usize, f64)> {
        self.bodies.get(body).filter(|_| body != 0).map(|b| (b.variable, b.multiplier))
    }

    /// Returns the joints that move a link, from the root, and the link's frame in that of the last one.
    pub fn chain(&self, link: usize) -> (Vec<chain::Joint>, DAffine3) {
        let mut bodies: Vec<usize> = self.ancestors(self.body_of(link)).collect();
        bodies.reverse();
        (bodies.iter().filter_map(|b| self.joint(*b)).map(|(_, joint)| joint).collect(), self.offset_of(link))
    }

    /// Returns the parent of a body and the joint that moves it; `None` for the root.
    pub fn joint(&self, body: usize) -> Option<(usize, chain::Joint)> {
        let body = self.bodies.get(body).filter(|_| body != 0)?;
        let origin = chain::Frame {
            rotation: body.origin.matrix3.to_cols_array_2d(),
            translation: body.origin.translation.to_array(),
        };
        let slides = body.motion == Motion::Slide;
        let (variable, multiplier, offset) = (body.variable, body.multiplier, body.offset);
        Some((body.parent, chain::Joint { origin, slides, variable, multiplier, offset }))
    }

    /// Returns upper bounds of a point's motion per unit of joint motion; `reach` is the distance of the point from the
    /// body's origin [m]. They hold at every configuration within the limits. One entry per body towards the root:
    /// (body, factor), in metres per radian or metres per metre.
    pub fn levers(&self, body: usize, reach: f64) -> Vec<(usize, f64)> {
        let mut levers = Vec::new();
        let mut radius = reach;
        let mut next: Option<DVec3> = None;
        for b in self.ancestors(body) {
            let own = &self.bodies[b];
            // About its own axis a point moves by its distance from that axis, not from the origin on it.
            let across = next.map_or(radius, |p| (p.x * p.x + p.y * p.y).sqrt() + radius);
            levers.push((b, if own.motion == Motion::Turn { across } else { 1.0 }));
            let along = next.map_or(0.0, |p| p.length());
            let slide = if own.motion == Motion::Slide { self.travel(own) } else { 0.0 };
            radius += along + slide;
            next = Some(own.origin.translation);
        }
        levers
    }

    /// Returns the maximum distance of a sliding body from its origin, within its limits.
    fn travel(&self, body: &Body) -> f64 {
        let limits = &self.limits[body.variable];
        let at = |q: f64| (body.multiplier * q + body.offset).abs();
        at(limits.lower).max(at(limits.upper))
    }
}

/// Converts a pose to a rotation matrix and translation.
pub fn frame(pose: &Isometry3<f64>) -> DAffine3 {
    let (t, r) = (pose.translation.vector, pose.rotation.to_rotation_matrix());
    let column = |c: usize| DVec3::new(r[(0, c)], r[(1, c)], r[(2, c)]);
    DAffine3 { matrix3: DMat3::from_cols(column(0), column(1), column(2)), translation: DVec3::new(t.x, t.y, t.z) }
}

/// Converts a rotation matrix and translation to a pose.
pub fn pose(frame: &DAffine3) -> Isometry3<f64> {
    let (m, t) = (&frame.matrix3, frame.translation);
    let column = |v: DVec3| nalgebra::Vector3::new(v.x, v.y, v.z);
    let basis = [column(m.x_axis), column(m.y_axis), column(m.z_axis)];
    let rotation = nalgebra::Rotation3::from_basis_unchecked(&basis);
    Isometry3::from_parts(column(t).into(), nalgebra::UnitQuaternion::from_rotation_matrix(&rotation))
}

#[cfg(test)]
mod tests;

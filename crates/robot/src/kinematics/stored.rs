//! Kinematics as stored in a log, so that a run can be replayed without its robot description.

use glamx::{DAffine3, DMat3, DVec3};
use serde::{Deserialize, Serialize};

use super::{Body, Kinematics, Motion};
use crate::model::{JointKind, Limits};
use dimos_core::joint::MAX_DOF;

/// The columns of a rotation matrix, then the translation [m].
type StoredFrame = [f64; 12];

/// Stored form of [`Kinematics`].
#[derive(Debug, Clone, Serialize, Deserialize)]
pub(super) struct Stored {
    joints: Vec<StoredJoint>,
    bodies: Vec<StoredBody>,
    links: Vec<(usize, StoredFrame)>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct StoredJoint {
    name: String,
    kind: JointKind,
    /// Limits as in [`Limits`]; JSON has no infinities, they are left out.
    lower: Option<f64>,
    upper: Option<f64>,
    velocity: Option<f64>,
    effort: Option<f64>,
    acceleration: Option<f64>,
    jerk: Option<f64>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
struct StoredBody {
    parent: usize,
    origin: StoredFrame,
    slides: bool,
    variable: usize,
    multiplier: f64,
    offset: f64,
}

fn put(frame: &DAffine3) -> StoredFrame {
    let mut all = [0.0; 12];
    let columns = [frame.matrix3.x_axis, frame.matrix3.y_axis, frame.matrix3.z_axis, frame.translation];
    for (to, from) in all.iter_mut().zip(columns.iter().flat_map(|c| c.to_array())) {
        *to = from;
    }
    all
}

fn get(frame: &StoredFrame) -> Result<DAffine3, String> {
    if frame.iter().any(|v| !v.is_finite()) {
        return Err("a frame is not finite".to_owned());
    }
    let [a, b, c, d, e, f, g, h, i, x, y, z] = *frame;
    let matrix3 = DMat3::from_cols(DVec3::new(a, b, c), DVec3::new(d, e, f), DVec3::new(g, h, i));
    Ok(DAffine3 { matrix3, translation: DVec3::new(x, y, z) })
}

impl From<Kinematics> for Stored {
    fn from(from: Kinematics) -> Self {
        let finite = |v: f64| v.is_finite().then_some(v);
        let joints = from.names.into_iter().zip(from.kinds).zip(from.limits);
        let bodies = from.bodies.into_iter().map(|b| StoredBody {
            parent: b.parent,
            origin: put(&b.origin),
            slides: b.motion == Motion::Slide,
            variable: b.variable,
            multiplier: b.multiplier,
            offset: b.offset,
        });
        Self {
            joints: joints
                .map(|((name, kind), l)| StoredJoint {
                    name,
                    kind,
                    lower: finite(l.lower),
                    upper: finite(l.upper),
                    velocity: finite(l.velocity),
                    effort: finite(l.effort),
                    acceleration: l.acceleration,
                    jerk: l.jerk,
                })
                .collect(),
            bodies: bodies.collect(),
            links: from.links.into_iter().map(|(body, frame)| (body, put(&frame))).collect(),
        }
    }
}

impl TryFrom<Stored> for Kinematics {
    type Error = String;

    /// A file may contain anything: indices must exist, and every body must come after its parent.
    fn try_from(from: Stored) -> Result<Self, String> {
        let (dof, count) = (from.joints.len(), from.bodies.len());
        if dof > MAX_DOF || count == 0 {
            return Err(format!("{dof} joints and {count} bodies are not valid kinematics"));
        }
        let mut bodies = Vec::with_capacity(count);
        for (b, body) in from.bodies.iter().enumerate() {
            let fits = b == 0 || (body.parent < b && body.variable < dof);
            if !fits || !body.multiplier.is_finite() || !body.offset.is_finite() {
                return Err(format!("body {b} is not well formed"));
            }
            let motion = if body.slides { Motion::Slide } else { Motion::Turn };
            let (parent, variable) = if b == 0 { (0, 0) } else { (body.parent, body.variable) };
            let (multiplier, offset) = (body.multiplier, body.offset);
            bodies.push(Body { parent, origin: get(&body.origin)?, motion, variable, multiplier, offset });
        }
        let mut links = Vec::with_capacity(from.links.len());
        for (body, frame) in &from.links {
            if *body >= count {
                return Err(format!("a link belongs to body {body} of {count}"));
            }
            links.push((*body, get(frame)?));
        }
        let limits = from.joints.iter().map(|j| Limits {
            lower: j.lower.unwrap_or(f64::NEG_INFINITY),
            upper: j.upper.unwrap_or(f64::INFINITY),
            velocity: j.velocity.unwrap_or(f64::INFINITY),
            effort: j.effort.unwrap_or(f64::INFINITY),
            acceleration: j.acceleration,
            jerk: j.jerk,
        });
        Ok(Self {
            limits: limits.collect(),
            kinds: from.joints.iter().map(|j| j.kind).collect(),
            names: from.joints.into_iter().map(|j| j.name).collect(),
            bodies,
            links,
        })
    }
}

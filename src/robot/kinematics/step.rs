//! One step of damped least squares: the joints' motion for a small motion of a link. Bounded in time, allocates
//! nothing: made for a control loop.

use glamx::{DAffine3, DMat3, DQuat, DVec3};

use super::Kinematics;
use super::jacobian::{Column, cholesky, gram, smallest_singular_value, solve};

/// Most joints that a step handles.
pub const MAX_JOINTS: usize = 16;

/// How a step treats singular configurations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepSettings {
    /// One radian counts as this many metres [m].
    pub length: f64,
    /// Smallest singular value below which motion is damped and slowed down [m/rad].
    pub threshold: f64,
    /// Damping at a singularity [m/rad].
    pub damping: f64,
}

impl Default for StepSettings {
    fn default() -> Self {
        Self { length: 0.3, threshold: 0.03, damping: 0.03 }
    }
}

/// Why a step is smaller than asked.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Bound {
    /// It is not.
    #[default]
    None,
    /// This joint would exceed its speed.
    Velocity(usize),
    /// This joint would leave its range; what remains of the motion was shortened.
    Position(usize),
    /// The arm is close to a singularity.
    Singularity,
    /// The request, the configuration or the model cannot be computed with.
    Invalid,
}

/// What a step came to.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Step {
    /// The part of the asked motion that the joints were given, 0–1.
    pub scale: f64,
    /// What bounded it most.
    pub bound: Bound,
    /// Smallest singular value [m/rad].
    pub singular_value: f64,
}

/// Makes steps for one link; keeps its buffers.
#[derive(Debug, Clone)]
pub struct Stepper {
    link: usize,
    settings: StepSettings,
    frames: Vec<DAffine3>,
    columns: [Column; MAX_JOINTS],
}

impl Stepper {
    /// Steps of `link` (index in the model).
    pub fn new(kinematics: &Kinematics, link: usize, settings: StepSettings) -> Self {
        Self { link, settings, frames: kinematics.frames(), columns: [[0.0; 6]; MAX_JOINTS] }
    }

    /// The link's frame at a configuration, in the root's frame.
    pub fn pose(&mut self, kinematics: &Kinematics, q: &[f64]) -> DAffine3 {
        kinematics.forward(q, &mut self.frames);
        kinematics.link_frame(self.link, &self.frames)
    }

    /// Moves `q` [rad or m] so that the link moves by `linear` [m] and turns by the rotation vector `angular` [rad],
    /// both in the root's frame, within `dt` [s]. Speeds stay within `velocity` [rad/s or m/s] and the model's, and
    /// positions within the model's limits, by shortening the whole step, so that the direction is kept; a joint that
    /// stands at its limit and would go farther is left where it is. `q` is left alone when nothing can be computed.
    pub fn step(
        &mut self,
        kinematics: &Kinematics,
        q: &mut [f64],
        linear: DVec3,
        angular: DVec3,
        velocity: &[f64],
        dt: f64,
    ) -> Step {
        let n = kinematics.dof();
        let finite = linear.is_finite() && angular.is_finite() && dt > 0.0 && q.iter().all(|x| x.is_finite());
        if !finite || q.len() != n || n > MAX_JOINTS || n == 0 {
            return Step { bound: Bound::Invalid, ..Step::default() };
        }
        kinematics.forward(q, &mut self.frames);
        let columns = self.columns.get_mut(..n).unwrap_or_default();
        kinematics.jacobian(self.link, &self.frames, columns);
        let l = self.settings.length;
        let value = smallest_singular_value(columns, l);
        let near = (1.0 - value / self.settings.threshold).clamp(0.0, 1.0);
        // At a singularity the way out must stay open: motion is slowed down to a tenth, never to nothing.
        let slow = 1.0 - 0.9 * near;
        for column in columns.iter_mut() {
            column[3..].iter_mut().for_each(|x| *x *= l);
        }
        let (v, w) = (linear * slow, angular * (l * slow));
        let wanted = [v.x, v.y, v.z, w.x, w.y, w.z];
        let damping = 1e-10 + (self.settings.damping * near).powi(2);
        let mut motion = [0.0; MAX_JOINTS];
        if !unblocked_motion(kinematics, q, columns, &wanted, damping, &mut motion) {
            return Step { bound: Bound::Invalid, singular_value: value, scale: 0.0 };
        }
        let mut step = Step { scale: slow, bound: Bound::None, singular_value: value };
        if near > 0.0 {
            step.bound = Bound::Singularity;
        }
        let (part, bound) = shorten(kinematics, q, &motion, velocity, dt);
        if part < 1.0 {
            step.scale *= part;
            step.bound = bound;
        }
        for ((x, m), limits) in q.iter_mut().zip(&motion).zip(kinematics.limits()) {
            let next = *x + m * part;
            // A joint that starts outside its range may only come back.
            let (low, high) = (limits.lower.min(*x), limits.upper.max(*x));
            *x = if next.is_finite() { next.max(low).min(high) } else { *x };
        }
        step
    }
}

/// The joints' motion for a wanted motion of the link; joints that stand at a limit and would go farther are left out,
/// one after the other.
fn unblocked_motion(
    kinematics: &Kinematics,
    q: &[f64],
    columns: &mut [Column],
    wanted: &Column,
    damping: f64,
    motion: &mut [f64; MAX_JOINTS],
) -> bool {
    for _ in 0..=columns.len() {
        let Some(l) = cholesky(&gram(columns, damping)) else { return false };
        let x = solve(&l, wanted);
        let mut blocked = None;
        for (j, column) in columns.iter().enumerate() {
            let m: f64 = column.iter().zip(&x).map(|(a, b)| a * b).sum();
            let (Some(to), Some(limits), Some(&at)) = (motion.get_mut(j), kinematics.limits().get(j), q.get(j)) else {
                return false;
            };
            *to = m;
            let margin = 1e-9;
            if (m > 1e-12 && at >= limits.upper - margin) || (m < -1e-12 && at <= limits.lower + margin) {
                blocked.get_or_insert(j);
            }
        }
        match blocked.and_then(|j| columns.get_mut(j)) {
            Some(column) => *column = [0.0; 6],
            None => return true,
        }
    }
    false
}

/// The part of a motion that stays within speeds and positions, and what bounds it.
fn shorten(kinematics: &Kinematics, q: &[f64], motion: &[f64], velocity: &[f64], dt: f64) -> (f64, Bound) {
    let (mut part, mut bound) = (1.0, Bound::None);
    for (j, ((&m, &at), limits)) in motion.iter().zip(q).zip(kinematics.limits()).enumerate() {
        let fastest = velocity.get(j).copied().unwrap_or(f64::INFINITY).min(limits.velocity) * dt;
        if m.abs() * part > fastest {
            (part, bound) = ((fastest / m.abs()).max(0.0), Bound::Velocity(j));
        }
        let room = if m > 0.0 { limits.upper - at } else { at - limits.lower };
        if m.abs() * part > room.max(0.0) && m.abs() > 1e-12 {
            (part, bound) = (room.max(0.0) / m.abs(), Bound::Position(j));
        }
    }
    (part, bound)
}

/// The rotation vector [rad] that turns one orientation into another, in the frame both are given in.
pub fn rotation_between(from: &DMat3, to: &DMat3) -> DVec3 {
    let turn = DQuat::from_mat3(&(*to * from.transpose()));
    let turn = if turn.w < 0.0 { -turn } else { turn };
    let vector = DVec3::new(turn.x, turn.y, turn.z);
    let sin = vector.length();
    if sin < 1e-12 { vector * 2.0 } else { vector * (2.0 * sin.atan2(turn.w) / sin) }
}

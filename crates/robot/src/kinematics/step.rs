//! Differential kinematics for a control loop: the joint motion of one tick for a desired link velocity, within all
//! limits. Bounded in time, does not allocate.
//!
//! Joint speeds come from damped least squares. If a joint would exceed its speed or its range, *all* joints are slowed
//! by the same factor, early enough to decelerate, so that the link keeps its direction.

use glamx::{DAffine3, DMat3, DQuat, DVec3};

use super::Kinematics;
use super::jacobian::{Column, cholesky, gram, smallest_singular_value, solve};
use dimos_core::joint::{JointBounds, Joints, MAX_DOF, braking_speed};

/// Distance from a limit at which a joint counts as being at it [rad or m].
const LIMIT_TOLERANCE: f64 = 1e-5;
/// Part of the acceleration limit used to plan the deceleration: the path to the stop is curved, which needs some as
/// well.
const DECELERATION_RATIO: f64 = 0.8;
/// Maximum deviation from the desired direction while joints are at their limits, relative to the motion.
const MAX_DEVIATION: f64 = 0.1;

/// Settings for singular configurations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StepSettings {
    /// Length that one radian is weighted with [m].
    pub length: f64,
    /// Smallest singular value below which motion is damped and slowed [m/rad].
    pub threshold: f64,
    /// Damping at a singularity [m/rad].
    pub damping: f64,
}

impl Default for StepSettings {
    fn default() -> Self {
        Self { length: 0.3, threshold: 0.03, damping: 0.03 }
    }
}

/// Position and velocity of the joints; entries past the last joint are zero.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct JointMotion {
    /// Positions [rad or m].
    pub position: Joints,
    /// Velocities [rad/s or m/s].
    pub velocity: Joints,
}

/// Desired motion of a link, in the root's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TargetTwist {
    /// Velocity of its origin [m/s].
    pub linear: DVec3,
    /// Angular velocity [rad/s].
    pub angular: DVec3,
    /// The link decelerates to rest after moving like this for this long [s]; ∞: no planned end.
    pub horizon: f64,
}

impl TargetTwist {
    /// Rest.
    pub const REST: Self = Self { linear: DVec3::ZERO, angular: DVec3::ZERO, horizon: f64::INFINITY };
}

/// What limits the motion of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Bound {
    /// Nothing.
    #[default]
    None,
    /// The velocity limit of this joint.
    Velocity(usize),
    /// A position limit of this joint.
    Position(usize),
    /// A singularity nearby.
    Singularity,
    /// The target or the configuration is not finite.
    Invalid,
}

/// Result of a step.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Step {
    /// Part of the desired speed that is commanded, 0–1.
    pub pace: f64,
    /// The strongest limit.
    pub bound: Bound,
    /// Smallest singular value [m/rad].
    pub singular_value: f64,
    /// Part of the speed change that the acceleration limits allowed, 0–1.
    pub share: f64,
}

/// Computes steps of one link; reuses its buffers.
#[derive(Debug, Clone)]
pub struct Stepper {
    kinematics: Kinematics,
    link: usize,
    settings: StepSettings,
    frames: Vec<DAffine3>,
    columns: [Column; MAX_DOF],
}

impl Stepper {
    /// Creates a stepper of `link` (index in the model).
    pub fn new(kinematics: Kinematics, link: usize, settings: StepSettings) -> Self {
        Self { link, settings, frames: kinematics.frames(), columns: [[0.0; 6]; MAX_DOF], kinematics }
    }

    /// Moves the frame whose steps are computed, added by [`Kinematics::attach_frame`], to `offset` in the frame of
    /// `link`. Does not allocate.
    pub fn move_frame(&mut self, link: usize, offset: &DAffine3) {
        self.kinematics.move_frame(self.link, link, offset);
    }

    /// Returns the kinematics.
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }

    /// Returns the link's frame at a configuration, in the root's frame.
    pub fn pose(&mut self, q: &[f64]) -> DAffine3 {
        self.kinematics.forward(q, &mut self.frames);
        self.kinematics.link_frame(self.link, &self.frames)
    }

    /// Moves the joints for `dt` [s] so that the link follows `wish` as far as `bounds` (one entry per joint) allow. If
    /// the input is not finite, the joints decelerate. A joint outside its range may stay or move back in.
    pub fn step(&mut self, joints: &mut JointMotion, wish: &TargetTwist, bounds: &[JointBounds], dt: f64) -> Step {
        let n = self.kinematics.dof().min(MAX_DOF);
        let (mut step, speeds) = match self.speeds(&joints.position, wish, bounds, n) {
            Some((speeds, found)) => (self.pace(&joints.position, &speeds, found, wish, bounds, dt), speeds),
            None => (Step { bound: Bound::Invalid, ..Step::default() }, [0.0; MAX_DOF]),
        };
        // All joints change speed in proportion, limited by the slowest.
        let mut share: f64 = 1.0;
        for ((speed, v), b) in speeds.iter().zip(&joints.velocity).zip(bounds).take(n) {
            let change = (speed * step.pace - v).abs();
            if change * share > b.acceleration * dt {
                share = b.acceleration * dt / change;
            }
        }
        step.share = share;
        let each = joints.position.iter_mut().zip(&mut joints.velocity).zip(&speeds).zip(bounds).take(n);
        for (((q, v), speed), b) in each {
            let aimed = speed * step.pace;
            *v = if share < 1.0 { *v + (aimed - *v) * share } else { aimed };
            let (lower, upper) = (b.lower.min(*q), b.upper.max(*q));
            let next = *q + *v * dt;
            if next > upper || next < lower {
                let at = next.min(upper).max(lower);
                (*v, *q) = ((at - *q) / dt, at);
            } else if next.is_finite() {
                *q = next;
            } else {
                *v = 0.0;
            }
        }
        step
    }

    /// Returns the joint speeds for the target, limited only by joints at the ends of their ranges, and the singularity
    /// figures; `None` if the input is not finite.
    fn speeds(&mut self, q: &Joints, wish: &TargetTwist, bounds: &[JointBounds], n: usize) -> Option<(Joints, Step)> {
        let finite = wish.linear.is_finite() && wish.angular.is_finite() && q.iter().all(|x| x.is_finite());
        if !finite || n == 0 || bounds.len() < n || self.kinematics.dof() > MAX_DOF {
            return None;
        }
        let q = q.get(..n)?;
        self.kinematics.forward(q, &mut self.frames);
        let columns = self.columns.get_mut(..n)?;
        self.kinematics.jacobian(self.link, &self.frames, columns);
        let l = self.settings.length;
        let value = smallest_singular_value(columns, l);
        let near = (1.0 - value / self.settings.threshold).clamp(0.0, 1.0);
        for column in columns.iter_mut() {
            column[3..].iter_mut().for_each(|x| *x *= l);
        }
        let (v, w) = (wish.linear, wish.angular * l);
        let wanted = [v.x, v.y, v.z, w.x, w.y, w.z];
        let damping = 1e-10 + (self.settings.damping * near).powi(2);
        let mut speeds = [0.0; MAX_DOF];
        let blocked = unblocked(columns, q, bounds, &wanted, damping, &mut speeds)?;
        // At a singularity, motion away from it must remain possible: speed is reduced to a tenth, never to zero.
        let bound = if near > 0.0 { Bound::Singularity } else { Bound::None };
        let mut found = Step { pace: 1.0 - 0.9 * near, bound, singular_value: value, share: 1.0 };
        if let Some(joint) = blocked
            && deviates(columns, &speeds, &wanted)
        {
            found = Step { pace: 0.0, bound: Bound::Position(joint), ..found };
        }
        Some((speeds, found))
    }

    /// Returns the part of the speeds that all joints can follow and decelerate from in time.
    fn pace(
        &self,
        q: &Joints,
        speeds: &Joints,
        found: Step,
        wish: &TargetTwist,
        bounds: &[JointBounds],
        dt: f64,
    ) -> Step {
        let moving = || speeds.iter().zip(q).zip(bounds).enumerate().filter(|(_, ((s, _), _))| s.abs() > 1e-12);
        // Maximum rate at which the part itself may fall [1/s].
        let slowest = moving().map(|(_, ((s, _), b))| b.acceleration / s.abs()).fold(f64::INFINITY, f64::min);
        let braking = |seconds: f64| match slowest.is_finite() && seconds.is_finite() {
            true => braking_speed(seconds.max(0.0), DECELERATION_RATIO * slowest, dt),
            false => f64::INFINITY,
        };
        let mut step = found;
        for (j, ((s, at), b)) in moving() {
            let by_speed = b.velocity / s.abs();
            if by_speed < step.pace {
                (step.pace, step.bound) = (by_speed.max(0.0), Bound::Velocity(j));
            }
            let room = if *s > 0.0 { b.upper - at } else { at - b.lower };
            let by_room = braking(room / s.abs());
            if by_room < step.pace {
                (step.pace, step.bound) = (by_room, Bound::Position(j));
            }
        }
        step.pace = step.pace.min(braking(wish.horizon));
        step
    }
}

/// Computes the joint speeds for the desired link motion; fixes joints that are at a limit and would move beyond it,
/// one after the other. Returns the first of those; `None` if there is no solution.
fn unblocked(
    columns: &mut [Column],
    q: &[f64],
    bounds: &[JointBounds],
    wanted: &Column,
    damping: f64,
    speeds: &mut Joints,
) -> Option<Option<usize>> {
    let mut first = None;
    for _ in 0..=columns.len() {
        let x = solve(&cholesky(&gram(columns, damping))?, wanted);
        let mut blocked = None;
        for (j, ((column, speed), (at, b))) in
            columns.iter().zip(speeds.iter_mut()).zip(q.iter().zip(bounds)).enumerate()
        {
            let s: f64 = column.iter().zip(&x).map(|(a, b)| a * b).sum();
            *speed = s;
            let out = (s > 1e-9 && *at >= b.upper - LIMIT_TOLERANCE) || (s < -1e-9 && *at <= b.lower + LIMIT_TOLERANCE);
            if out && blocked.is_none() {
                blocked = Some(j);
            }
        }
        match blocked.and_then(|j| columns.get_mut(j)) {
            Some(column) => *column = [0.0; 6],
            None => return Some(first),
        }
        first = first.or(blocked);
    }
    None
}

/// Returns whether the link would leave the desired direction rather than just move more slowly.
fn deviates(columns: &[Column], speeds: &Joints, wanted: &Column) -> bool {
    let mut done = [0.0; 6];
    for (column, s) in columns.iter().zip(speeds) {
        done.iter_mut().zip(column).for_each(|(d, c)| *d += c * s);
    }
    let dot = |a: &Column, b: &Column| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let length = dot(wanted, wanted);
    let part = dot(&done, wanted) / length;
    let mut across = done;
    across.iter_mut().zip(wanted).for_each(|(a, w)| *a -= part * w);
    part.is_nan() || part < 0.5 || dot(&across, &across) > MAX_DEVIATION * MAX_DEVIATION * length * part * part
}

/// Returns the rotation vector [rad] that rotates one orientation into another, in their common frame.
pub fn rotation_between(from: &DMat3, to: &DMat3) -> DVec3 {
    let turn = DQuat::from_mat3(&(*to * from.transpose()));
    let turn = if turn.w < 0.0 { -turn } else { turn };
    let vector = DVec3::new(turn.x, turn.y, turn.z);
    let sin = vector.length();
    if sin < 1e-12 { vector * 2.0 } else { vector * (2.0 * sin.atan2(turn.w) / sin) }
}

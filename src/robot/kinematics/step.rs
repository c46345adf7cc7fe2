//! One step of a link's motion: the joints' motion for a velocity of the link, within everything that bounds it.
//! Bounded in time, allocates nothing: made for a control loop.
//!
//! Speeds of joints come from damped least squares. What is too fast for a joint, or goes on past the end of its range,
//! slows down *all* joints by the same factor, early enough to brake, so that the link keeps its direction.

use glamx::{DAffine3, DMat3, DQuat, DVec3};

use super::Kinematics;
use super::jacobian::{Column, cholesky, gram, smallest_singular_value, solve};
use crate::joint::{Joints, MAX_DOF, braking_speed};

/// A joint this near to the end of its range stands there [rad or m].
const AT_THE_END: f64 = 1e-5;
/// Part of the joints' acceleration that braking is planned with: the way to a stop is curved, which needs some, too.
const BRAKING: f64 = 0.8;
/// With joints at the end of their ranges, motion may go so far off its direction, as a part of itself.
const ASTRAY: f64 = 0.1;

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

/// What one joint may do.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct JointBounds {
    /// Lowest position [rad or m].
    pub lower: f64,
    /// Highest position [rad or m].
    pub upper: f64,
    /// Highest speed [rad/s or m/s].
    pub velocity: f64,
    /// Highest acceleration [rad/s² or m/s²].
    pub acceleration: f64,
}

/// Where the joints are and how they move; entries past the last joint are zero.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct JointMotion {
    /// Positions [rad or m].
    pub position: Joints,
    /// Velocities [rad/s or m/s].
    pub velocity: Joints,
}

/// How a link shall move, in the root's frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wish {
    /// Velocity of its origin [m/s].
    pub linear: DVec3,
    /// Angular velocity [rad/s].
    pub angular: DVec3,
    /// It shall stand still when it has moved like that for so long [s]; ∞ = it goes on.
    pub horizon: f64,
}

impl Wish {
    /// To stand still.
    pub const REST: Self = Self { linear: DVec3::ZERO, angular: DVec3::ZERO, horizon: f64::INFINITY };
}

/// Why a link moves less than was wished.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Bound {
    /// It does not.
    #[default]
    None,
    /// This joint would exceed its speed.
    Velocity(usize),
    /// This joint comes to the end of its range.
    Position(usize),
    /// The arm is close to a singularity.
    Singularity,
    /// The wish or the configuration is nothing to compute with.
    Invalid,
}

/// What a step came to.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Step {
    /// The part of the wished speed that is aimed at, 0–1.
    pub pace: f64,
    /// What bounds it most.
    pub bound: Bound,
    /// Smallest singular value [m/rad].
    pub singular_value: f64,
    /// The part of the change of the joints' speeds that their accelerations allowed, 0–1.
    pub share: f64,
}

/// Makes steps for one link; keeps its buffers.
#[derive(Debug, Clone)]
pub struct Stepper {
    kinematics: Kinematics,
    link: usize,
    settings: StepSettings,
    frames: Vec<DAffine3>,
    columns: [Column; MAX_DOF],
}

impl Stepper {
    /// Steps of `link` (index in the model).
    pub fn new(kinematics: Kinematics, link: usize, settings: StepSettings) -> Self {
        Self { link, settings, frames: kinematics.frames(), columns: [[0.0; 6]; MAX_DOF], kinematics }
    }

    /// The kinematics of its steps.
    pub fn kinematics(&self) -> &Kinematics {
        &self.kinematics
    }

    /// The link's frame at a configuration, in the root's frame.
    pub fn pose(&mut self, q: &[f64]) -> DAffine3 {
        self.kinematics.forward(q, &mut self.frames);
        self.kinematics.link_frame(self.link, &self.frames)
    }

    /// Moves the joints for `dt` [s] so that the link does what is wished, as well as `bounds` (one entry per joint)
    /// allow. With nothing to compute with the joints slow down. A joint outside its range may stay or come in.
    pub fn step(&mut self, joints: &mut JointMotion, wish: &Wish, bounds: &[JointBounds], dt: f64) -> Step {
        let n = self.kinematics.dof().min(MAX_DOF);
        let (mut step, speeds) = match self.speeds(&joints.position, wish, bounds, n) {
            Some((speeds, found)) => (self.pace(&joints.position, &speeds, found, wish, bounds, dt), speeds),
            None => (Step { bound: Bound::Invalid, ..Step::default() }, [0.0; MAX_DOF]),
        };
        // Joints change their speeds in proportion, as far as the one that needs most for it can.
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

    /// The speeds of the joints for the wish, without any bound but that joints at the end of their ranges stay there;
    /// and what is known of the configuration. `None`: nothing to compute with.
    fn speeds(&mut self, q: &Joints, wish: &Wish, bounds: &[JointBounds], n: usize) -> Option<(Joints, Step)> {
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
        // At a singularity the way out must stay open: motion is slowed down to a tenth, never to nothing.
        let bound = if near > 0.0 { Bound::Singularity } else { Bound::None };
        let mut found = Step { pace: 1.0 - 0.9 * near, bound, singular_value: value, share: 1.0 };
        if let Some(joint) = blocked
            && goes_astray(columns, &speeds, &wanted)
        {
            found = Step { pace: 0.0, bound: Bound::Position(joint), ..found };
        }
        Some((speeds, found))
    }

    /// The part of the speeds that all joints can do, and from which all can brake in time.
    fn pace(&self, q: &Joints, speeds: &Joints, found: Step, wish: &Wish, bounds: &[JointBounds], dt: f64) -> Step {
        let moving = || speeds.iter().zip(q).zip(bounds).enumerate().filter(|(_, ((s, _), _))| s.abs() > 1e-12);
        // How fast the pace itself may fall [1/s].
        let slowest = moving().map(|(_, ((s, _), b))| b.acceleration / s.abs()).fold(f64::INFINITY, f64::min);
        let braking = |seconds: f64| match slowest.is_finite() && seconds.is_finite() {
            true => braking_speed(seconds.max(0.0), BRAKING * slowest, dt),
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

/// Fills in the joints' speeds for what is wanted of the link; joints that stand at the end of their range and would go
/// farther are left out, one after the other. Answers the first of those. `None`: it cannot be computed.
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
            let out = (s > 1e-9 && *at >= b.upper - AT_THE_END) || (s < -1e-9 && *at <= b.lower + AT_THE_END);
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

/// Whether the link would go elsewhere than is wanted, not just more slowly.
fn goes_astray(columns: &[Column], speeds: &Joints, wanted: &Column) -> bool {
    let mut done = [0.0; 6];
    for (column, s) in columns.iter().zip(speeds) {
        done.iter_mut().zip(column).for_each(|(d, c)| *d += c * s);
    }
    let dot = |a: &Column, b: &Column| a.iter().zip(b).map(|(a, b)| a * b).sum::<f64>();
    let length = dot(wanted, wanted);
    let part = dot(&done, wanted) / length;
    let mut across = done;
    across.iter_mut().zip(wanted).for_each(|(a, w)| *a -= part * w);
    part.is_nan() || part < 0.5 || dot(&across, &across) > ASTRAY * ASTRAY * length * part * part
}

/// The rotation vector [rad] that turns one orientation into another, in the frame both are given in.
pub fn rotation_between(from: &DMat3, to: &DMat3) -> DVec3 {
    let turn = DQuat::from_mat3(&(*to * from.transpose()));
    let turn = if turn.w < 0.0 { -turn } else { turn };
    let vector = DVec3::new(turn.x, turn.y, turn.z);
    let sin = vector.length();
    if sin < 1e-12 { vector * 2.0 } else { vector * (2.0 * sin.atan2(turn.w) / sin) }
}

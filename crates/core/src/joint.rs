//! The vocabulary that every layer shares: joints, control modes, limits. SI units only.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::named::named;

/// The most joints one arm may have. Arrays of this size cross between threads without allocation.
pub const MAX_DOF: usize = 16;

/// Most characters of a name.
pub const LONGEST_NAME: usize = 64;

/// Returns whether names of arms, joints, tasks and objects may contain a character. None begins with a dash.
pub fn may_be_in_name(c: char) -> bool {
    c.is_ascii_alphanumeric() || matches!(c, '_' | '-')
}

/// One value per joint of an arm; entries past the arm's dof are zero.
pub type Joints = [f64; MAX_DOF];

/// Acceleration limit where neither the arm nor the blueprint gives one [rad/s²].
pub const DEFAULT_ACCELERATION: f64 = 2.0;
/// Jerk limit where neither the arm nor the blueprint gives one [rad/s³].
pub const DEFAULT_JERK: f64 = 20.0;

/// Standstill velocity: a slower joint is at rest, given the noise of measured velocities [rad/s].
pub const STANDSTILL: f64 = 0.02;
/// Standstill velocity in the tick. A single reading decides there, and it may be estimated from two positions: it is
/// noisier, so the threshold is higher [rad/s].
pub const TICK_STANDSTILL: f64 = 0.05;

/// Copies a slice to a fixed array. Drops values beyond [`MAX_DOF`]; missing ones are 0.
pub fn joints_of(values: &[f64]) -> Joints {
    let mut out = [0.0; MAX_DOF];
    for (o, v) in out.iter_mut().zip(values) {
        *o = *v;
    }
    out
}

/// Lowest fraction of the speed that a motion can be given.
pub const LOWEST_SPEED: f64 = 0.01;

/// Returns the highest speed [rad/s] of a step of `dt` [s] that ends within `distance` [rad] when the steps after it
/// decelerate by `acceleration` [rad/s²] each. Exact in discrete time: with n more steps before the last one,
/// distance / dt = (n + 1) v − c n (n + 1) / 2, where c is the change of velocity per step.
pub fn braking_speed(distance: f64, acceleration: f64, dt: f64) -> f64 {
    let change = acceleration * dt;
    let steps = distance / dt;
    let n = ((((1.0 + 8.0 * steps / change).sqrt() - 3.0) / 2.0).ceil()).max(0.0);
    steps / (n + 1.0) + change * n / 2.0
}

/// `prefix_joint1 … prefix_jointN`: the guide's `make_joints`.
pub fn make_joints(prefix: &str, count: usize) -> Vec<String> {
    (1..=count).map(|i| format!("{prefix}_joint{i}")).collect()
}

named! {
    /// How an arm interprets what is written to it.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
    #[serde(rename_all = "snake_case")]
    pub enum ControlMode {
        /// Joint positions; the arm plans its own way there.
        #[default]
        Position = "position",
        /// Joint positions streamed at the control rate; the arm follows each at once.
        ServoPosition = "servo_position",
        /// Joint velocities.
        Velocity = "velocity",
        /// Joint torques.
        Torque = "torque",
        /// End-effector poses; the arm plans its own way there.
        Cartesian = "cartesian",
        /// End-effector twists.
        CartesianVelocity = "cartesian_velocity",
        /// Joint positions with a stiffness.
        Impedance = "impedance",
    }
}

impl ControlMode {
    /// Whether commands in this mode are joint positions.
    pub fn is_position(self) -> bool {
        matches!(self, Self::Position | Self::ServoPosition | Self::Impedance)
    }
}

/// Distance that commands keep from the ends of a joint's range [rad].
pub const POSITION_MARGIN: f64 = 0.01;

/// Limits of one joint, each a number: infinite where there is none. What a description leaves open is resolved before
/// (`model::Limits` of `dimos-robot`, [`JointLimits::joint`]).
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointBounds {
    /// Lowest position [rad or m].
    pub lower: f64,
    /// Highest position [rad or m].
    pub upper: f64,
    /// Highest speed [rad/s or m/s].
    pub velocity: f64,
    /// Highest acceleration [rad/s² or m/s²].
    pub acceleration: f64,
    /// Highest jerk [rad/s³ or m/s³].
    pub jerk: f64,
}

impl JointBounds {
    /// No limits.
    pub const NONE: Self = Self {
        lower: f64::NEG_INFINITY,
        upper: f64::INFINITY,
        velocity: f64::INFINITY,
        acceleration: f64::INFINITY,
        jerk: f64::INFINITY,
    };

    /// Creates the bounds of commands: the range [rad] is reduced by [`POSITION_MARGIN`], a narrow one by less; the
    /// jerk has no limit.
    pub fn inside(lower: f64, upper: f64, velocity: f64, acceleration: f64) -> Self {
        let margin = POSITION_MARGIN.min((upper - lower) / 10.0);
        Self { lower: lower + margin, upper: upper - margin, velocity, acceleration, ..Self::NONE }
    }

    /// Returns how far a position is outside the range [rad or m]; 0 inside.
    pub fn excess(&self, position: f64) -> f64 {
        (self.lower - position).max(position - self.upper).max(0.0)
    }
}

/// Limits of the commands to a joint.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct CommandLimits {
    /// Lowest and highest position [rad]: the arm's own limits, narrowed by the blueprint, 0.01 rad inside.
    pub position: [f64; 2],
    /// Highest speed [rad/s].
    pub velocity: f64,
    /// Highest acceleration [rad/s²].
    pub acceleration: f64,
    /// Highest jerk [rad/s³].
    pub jerk: f64,
    /// Highest speed of the tool of the joint's arm [m/s]; absent without a limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tcp_velocity: Option<f64>,
}

/// Limits of an arm's joints, one entry per joint.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
pub struct JointLimits {
    /// Lowest positions [rad].
    pub position_lower: Vec<f64>,
    /// Highest positions [rad].
    pub position_upper: Vec<f64>,
    /// Highest speeds [rad/s].
    pub velocity_max: Vec<f64>,
    /// Highest accelerations [rad/s²]; empty where the arm states none.
    #[serde(default)]
    pub acceleration_max: Vec<f64>,
    /// Highest jerks [rad/s³]; empty where the arm states none.
    #[serde(default)]
    pub jerk_max: Vec<f64>,
}

impl JointLimits {
    /// The same symmetric limits for every joint; acceleration and jerk left to the defaults.
    pub fn uniform(dof: usize, position: f64, velocity: f64) -> Self {
        Self {
            position_lower: vec![-position; dof],
            position_upper: vec![position; dof],
            velocity_max: vec![velocity; dof],
            acceleration_max: Vec::new(),
            jerk_max: Vec::new(),
        }
    }

    /// Limits as a data sheet has them: lowest and highest position [deg] and top speed [deg/s] of each joint.
    pub fn of_degrees(sheet: &[(f64, f64, f64)]) -> Self {
        let radians = |part: fn(&(f64, f64, f64)) -> f64| sheet.iter().map(|joint| part(joint).to_radians()).collect();
        Self {
            position_lower: radians(|joint| joint.0),
            position_upper: radians(|joint| joint.1),
            velocity_max: radians(|joint| joint.2),
            acceleration_max: Vec::new(),
            jerk_max: Vec::new(),
        }
    }

    /// Returns the limits of a joint, with the defaults in place of what the arm does not state; `None` if there is no
    /// such joint.
    pub fn joint(&self, joint: usize) -> Option<JointBounds> {
        let of = |limits: &[f64]| limits.get(joint).copied();
        Some(JointBounds {
            lower: of(&self.position_lower)?,
            upper: of(&self.position_upper)?,
            velocity: of(&self.velocity_max)?,
            acceleration: of(&self.acceleration_max).unwrap_or(DEFAULT_ACCELERATION),
            jerk: of(&self.jerk_max).unwrap_or(DEFAULT_JERK),
        })
    }

    /// The same limits with the defaults in place of what the arm does not state.
    pub fn with_defaults(mut self) -> Self {
        let dof = self.position_lower.len();
        if self.acceleration_max.len() != dof {
            self.acceleration_max = vec![DEFAULT_ACCELERATION; dof];
        }
        if self.jerk_max.len() != dof {
            self.jerk_max = vec![DEFAULT_JERK; dof];
        }
        self
    }
}

//! Moves an end effector by moving joints: what the Cartesian tasks have in common. Integrates joint positions from the
//! last *commanded* ones, so that an arm that sags below its commands does not creep.

use glamx::{DAffine3, DVec3};

use super::params::CartesianParams;
use crate::control::task_body::{Claim, Context};
use crate::control::task_robot::TaskKinematics;
use crate::joint::MAX_DOF;
use crate::robot::kinematics::step::{Bound as Bounded, JointBounds, JointMotion, StepSettings, Stepper, TargetTwist};
use crate::telemetry::Bound;

/// A velocity of the end effector, in the frame of the model's root.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Velocity {
    /// Of its origin [m/s].
    pub linear: DVec3,
    /// Angular [rad/s].
    pub angular: DVec3,
}

/// How long a change takes at least [s], where both its parts keep to their rates.
pub fn seconds(change: &Velocity, linear: f64, angular: f64) -> f64 {
    (change.linear.length() / linear).max(change.angular.length() / angular)
}

/// An end effector that is moved.
#[derive(Debug)]
pub struct EndEffector {
    params: CartesianParams,
    robot: TaskKinematics,
    stepper: Stepper,
    joints: JointMotion,
    bounds: [JointBounds; MAX_DOF],
    /// Its velocity as far as its own acceleration limits let it change.
    velocity: Velocity,
    bound: Bound,
}

impl EndEffector {
    /// An end effector that was not moved yet.
    pub fn new(params: CartesianParams, robot: TaskKinematics) -> Self {
        Self {
            stepper: Stepper::new(robot.kinematics.clone(), robot.link, StepSettings::default()),
            params,
            robot,
            joints: JointMotion::default(),
            bounds: [JointBounds::default(); MAX_DOF],
            velocity: Velocity::default(),
            bound: Bound::None,
        }
    }

    /// Its parameters.
    pub fn params(&self) -> &CartesianParams {
        &self.params
    }

    /// Its robot.
    pub fn robot(&self) -> &TaskKinematics {
        &self.robot
    }

    /// What holds it back just now.
    pub fn bound(&self) -> Bound {
        self.bound
    }

    /// Begins where the joints are commanded to be, as fast as they are commanded to move.
    pub fn rebase(&mut self, cx: &Context<'_>) {
        self.velocity = Velocity::default();
        let motion = self.joints.position.iter_mut().zip(&mut self.joints.velocity);
        for ((q, v), &joint) in motion.zip(cx.joints) {
            let view = cx.joint(joint);
            (*q, *v) = (view.commanded, view.commanded_velocity);
        }
    }

    /// The first joint that is measured too far from where it is commanded to be, and how far [rad].
    pub fn strayed(&self, cx: &Context<'_>) -> Option<(u16, f64)> {
        cx.joints.iter().find_map(|&joint| {
            let view = cx.joint(joint);
            let error = view.tracking_error;
            (error.is_nan() || error.abs() > self.params.max_tracking_error).then_some((joint, error))
        })
    }

    /// Where it is commanded to be, in the frame of the model's root.
    pub fn pose(&mut self) -> DAffine3 {
        self.stepper.pose(&self.joints.position)
    }

    /// Whether neither it nor a joint of it is to move.
    pub fn at_rest(&self) -> bool {
        self.velocity == Velocity::default() && self.joints.velocity.iter().all(|v| *v == 0.0)
    }

    /// Moves on by one tick towards a velocity and claims the joints. `way`: what is left to a goal, where it must
    /// stop.
    pub fn advance(&mut self, cx: &Context<'_>, wanted: &Velocity, way: Option<&Velocity>, claims: &mut Vec<Claim>) {
        let before = self.velocity;
        self.approach(wanted, cx.dt);
        let Velocity { linear, angular } = self.velocity;
        let horizon = way.map_or(f64::INFINITY, |way| {
            let l = StepSettings::default().length;
            let size = |v: &Velocity| v.linear.length().hypot(v.angular.length() * l);
            let speed = size(&self.velocity);
            if speed > 0.0 { size(way) / speed } else { f64::INFINITY }
        });
        let (joints, model) = (cx.joints, self.robot.kinematics.limits());
        for ((bounds, own), &joint) in self.bounds.iter_mut().zip(model).zip(joints) {
            let view = cx.joint(joint);
            *bounds = JointBounds {
                lower: own.lower.max(view.lower),
                upper: own.upper.min(view.upper),
                velocity: own.velocity.min(view.velocity_limit),
                acceleration: own.acceleration.unwrap_or(f64::INFINITY).min(view.acceleration),
            };
        }
        let step = self.stepper.step(&mut self.joints, &TargetTwist { linear, angular, horizon }, &self.bounds, cx.dt);
        // It changes its velocity no faster than the joints can follow, so that it keeps its direction.
        if step.share < 1.0 {
            self.velocity.linear = before.linear + (linear - before.linear) * step.share;
            self.velocity.angular = before.angular + (angular - before.angular) * step.share;
        }
        let index = |j: usize| joints.get(j).copied().unwrap_or_default();
        self.bound = match step.bound {
            Bounded::None => Bound::None,
            Bounded::Velocity(j) => Bound::Velocity(index(j)),
            Bounded::Position(j) => Bound::Position(index(j)),
            Bounded::Singularity => Bound::Singularity,
            Bounded::Invalid => Bound::Invalid,
        };
        claims.extend(joints.iter().zip(&self.joints.position).map(|(&joint, &value)| Claim { joint, value }));
    }

    /// Changes the velocity towards the wanted one, both its parts by the same share, as fast as they may change.
    fn approach(&mut self, wanted: &Velocity, dt: f64) {
        if !(wanted.linear.is_finite() && wanted.angular.is_finite()) {
            return self.approach(&Velocity::default(), dt);
        }
        let p = &self.params;
        let change =
            Velocity { linear: wanted.linear - self.velocity.linear, angular: wanted.angular - self.velocity.angular };
        let needed = seconds(&change, p.max_linear_acceleration, p.max_angular_acceleration);
        if needed <= dt {
            self.velocity = *wanted;
        } else {
            self.velocity.linear += change.linear * (dt / needed);
            self.velocity.angular += change.angular * (dt / needed);
        }
    }
}

//! Moves an end effector: the common part of the Cartesian tasks. Integrates joint positions from the last *commanded*
//! ones, so that an arm that sags below its commands does not creep.

use dimos_core::joint::{JointBounds, MAX_DOF};
use glamx::{DAffine3, DVec3};

use super::params::CartesianParams;
use crate::task_body::{Claim, Context};
use crate::task_robot::{FramePose, TaskKinematics};
use dimos_core::telemetry::Bound;
use dimos_robot::kinematics::step::{Bound as Bounded, JointMotion, StepSettings, Stepper, TargetTwist};

/// Twist of the end effector, in the frame of the model's root.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Velocity {
    /// Velocity of its origin [m/s].
    pub linear: DVec3,
    /// Angular velocity [rad/s].
    pub angular: DVec3,
}

/// Returns the minimum duration of a change [s] within the limits of both parts.
pub fn seconds(change: &Velocity, linear: f64, angular: f64) -> f64 {
    (change.linear.length() / linear).max(change.angular.length() / angular)
}

/// An end effector in motion.
#[derive(Debug)]
pub struct EndEffector {
    params: CartesianParams,
    robot: TaskKinematics,
    stepper: Stepper,
    joints: JointMotion,
    bounds: [JointBounds; MAX_DOF],
    /// Its twist, limited by its own accelerations.
    velocity: Velocity,
    bound: Bound,
}

impl EndEffector {
    /// Creates an end effector at rest.
    pub fn new(params: CartesianParams, robot: TaskKinematics) -> Self {
        let mut kinematics = robot.kinematics.clone();
        let tcp = kinematics.attach_frame(robot.link, &robot.tool.frame());
        Self {
            stepper: Stepper::new(kinematics, tcp, StepSettings::default()),
            params,
            robot,
            joints: JointMotion::default(),
            bounds: [JointBounds::NONE; MAX_DOF],
            velocity: Velocity::default(),
            bound: Bound::None,
        }
    }

    /// Returns its parameters.
    pub fn params(&self) -> &CartesianParams {
        &self.params
    }

    /// Returns its robot.
    pub fn robot(&self) -> &TaskKinematics {
        &self.robot
    }

    /// Replaces its tool.
    pub fn set_tool(&mut self, tool: &FramePose) {
        self.robot.tool = *tool;
        self.stepper.move_frame(self.robot.link, &tool.frame());
    }

    /// Returns the limit that slows it at present.
    pub fn bound(&self) -> Bound {
        self.bound
    }

    /// Starts from the last commanded positions and velocities of the joints.
    pub fn rebase(&mut self, cx: &Context<'_>) {
        self.velocity = Velocity::default();
        let motion = self.joints.position.iter_mut().zip(&mut self.joints.velocity);
        for ((q, v), &joint) in motion.zip(cx.joints) {
            let view = cx.joint(joint);
            (*q, *v) = (view.commanded, view.commanded_velocity);
        }
    }

    /// Returns the first joint whose measured position is too far from its command, and the error [rad].
    pub fn strayed(&self, cx: &Context<'_>) -> Option<(u16, f64)> {
        cx.joints.iter().find_map(|&joint| {
            let view = cx.joint(joint);
            let error = view.tracking_error;
            (error.is_nan() || error.abs() > self.params.max_tracking_error).then_some((joint, error))
        })
    }

    /// Returns the commanded pose of its tool centre point, in the frame of the model's root.
    pub fn pose(&mut self) -> DAffine3 {
        self.stepper.pose(&self.joints.position)
    }

    /// Returns whether it and all its joints are commanded to rest.
    pub fn at_rest(&self) -> bool {
        self.velocity == Velocity::default() && self.joints.velocity.iter().all(|v| *v == 0.0)
    }

    /// Advances by one tick towards a twist and claims the joints. `way`: remaining way to a goal, at which it must
    /// stop.
    pub fn advance(&mut self, cx: &Context<'_>, wanted: &Velocity, way: Option<&Velocity>, claims: &mut Vec<Claim>) {
        self.take_limits(cx);
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
        let own = self.bounds.iter_mut().zip(model).zip(&self.joints.velocity);
        for (((bounds, own), speed), &joint) in own.zip(joints) {
            let view = cx.joint(joint);
            let acceleration = own.acceleration.unwrap_or(f64::INFINITY).min(view.acceleration);
            // The speed override slows a joint no faster than it can decelerate.
            let velocity = own.velocity.min(view.velocity_limit);
            let slowed = (velocity * cx.pace).max(speed.abs() - 0.9 * acceleration * cx.dt).min(velocity);
            *bounds = JointBounds {
                lower: own.lower.max(view.lower),
                upper: own.upper.min(view.upper),
                velocity: slowed,
                acceleration,
                jerk: f64::INFINITY,
            };
        }
        let step = self.stepper.step(&mut self.joints, &TargetTwist { linear, angular, horizon }, &self.bounds, cx.dt);
        // Its twist changes no faster than the joints can follow, so that it keeps its direction.
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

    /// Continues from what was commanded where a limit of the arm changed it: what is behind would be made up for after
    /// the stream has ended.
    fn take_limits(&mut self, cx: &Context<'_>) {
        let motion = self.joints.position.iter_mut().zip(&mut self.joints.velocity);
        for ((q, v), &joint) in motion.zip(cx.joints) {
            let view = cx.joint(joint);
            if *q != view.commanded {
                (*q, *v) = (view.commanded, view.commanded_velocity);
            }
        }
    }

    /// Changes the twist towards the requested one, both parts by the same fraction, as fast as their limits allow.
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

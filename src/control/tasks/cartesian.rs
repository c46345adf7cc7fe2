//! Takes an end effector to poses, or moves it with given velocities: a stream of either. When the stream stops, the
//! end effector comes to rest and the joints are let go.

use glamx::{DAffine3, DMat3, DQuat, DVec3};

use super::end_effector::{EndEffector, Velocity, seconds};
use crate::clock::Mono;
use crate::control::config::CartesianParams;
use crate::control::task::{Claim, Context};
use crate::joint::braking_speed;
use crate::robot::kinematics::step::rotation_between;
use crate::telemetry::{Bound, Reason, TaskState};

/// Part of the acceleration that a goal is approached with; the rest is for what a joint needs besides.
const APPROACH: f64 = 0.8;
/// How far the length of a quaternion may be from 1.
const QUATERNION_SLACK: f64 = 0.01;
/// Nearer than this is there [m, rad].
const THERE: f64 = 1e-9;

/// Where an end effector shall be, or how it shall move, as it is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Goal {
    /// A pose, in the frame that poses of the task are given in.
    Pose {
        /// x, y, z [m].
        position: [f64; 3],
        /// Quaternion x, y, z, w.
        orientation: [f64; 4],
    },
    /// A velocity.
    Twist {
        /// Of the origin [m/s].
        linear: [f64; 3],
        /// Angular [rad/s].
        angular: [f64; 3],
        /// Along the axes of the end effector itself, not of the base.
        tool: bool,
    },
}

/// The same, ready to be followed; in the frame of the model's root.
#[derive(Debug, Clone, Copy)]
enum Target {
    Pose(DAffine3),
    Twist(Velocity),
    ToolTwist(Velocity),
}

/// State of a Cartesian task.
#[derive(Debug)]
pub struct CartesianTask {
    effector: EndEffector,
    poses: bool,
    target: Option<(Target, Mono)>,
    slowing: bool,
    timed_out: bool,
}

impl CartesianTask {
    /// A task without a target that follows poses or, if not `poses`, velocities.
    pub fn new(params: CartesianParams, poses: bool) -> Self {
        Self { effector: EndEffector::new(params), poses, target: None, slowing: false, timed_out: false }
    }

    /// Whether it follows such goals at all.
    pub fn follows(&self, goal: &Goal) -> bool {
        self.poses == matches!(goal, Goal::Pose { .. })
    }

    /// The first joint that is too far from where it is commanded to be for a start, and how far [rad].
    pub fn strayed(&self, cx: &Context<'_>, joints: &[u16]) -> Option<(u16, f64)> {
        self.effector.strayed(cx, joints)
    }

    /// A new goal. `false`: it is none, and the one before it stands no more.
    pub fn set_goal(&mut self, cx: &Context<'_>, goal: &Goal) -> bool {
        let target = target(self.effector.params(), goal);
        self.target = target.map(|target| (target, cx.now));
        if target.is_some() {
            (self.slowing, self.timed_out) = (false, false);
        }
        target.is_some()
    }

    /// Forgets the target.
    pub fn drop_target(&mut self) {
        (self.target, self.slowing, self.timed_out) = (None, false, false);
    }

    /// From now on come to rest.
    pub fn slow_down(&mut self) {
        self.slowing = true;
    }

    /// Whether the stream has stopped and the end effector comes to rest.
    pub fn timed_out(&self) -> bool {
        self.timed_out
    }

    /// What holds the end effector back just now.
    pub fn bound(&self) -> Bound {
        self.effector.bound()
    }

    /// Fills in the claims of this tick, or says how it ended. `granted`: the claims of the last tick went out.
    pub fn compute(
        &mut self,
        cx: &Context<'_>,
        joints: &[u16],
        granted: bool,
        claims: &mut Vec<Claim>,
    ) -> Option<(TaskState, Reason)> {
        let timeout = self.effector.params().timeout;
        let fresh = |at: &Mono| timeout <= 0.0 || cx.now.seconds_since(*at) <= timeout;
        let target = self.target.filter(|(_, at)| fresh(at)).map(|(target, _)| target);
        self.timed_out = target.is_none();
        let ended = || match self.slowing {
            true => Some((TaskState::Aborted, Reason::Cancelled)),
            false => Some((TaskState::Idle, Reason::Timeout)),
        };
        let ending = self.slowing || self.timed_out;
        if !granted {
            // Nothing of it goes out: there is nothing to slow down.
            if ending {
                return ended();
            }
            self.effector.rebase(cx, joints);
        } else if let Some((joint, error)) = self.effector.strayed(cx, joints) {
            return Some((TaskState::Aborted, Reason::TrackingError(joint, error)));
        } else if ending && self.effector.at_rest() {
            return ended();
        }
        let (wanted, way) = match target.filter(|_| !self.slowing) {
            None => (Velocity::default(), None),
            Some(Target::Twist(twist)) => (twist, None),
            Some(Target::ToolTwist(Velocity { linear, angular })) => {
                let turn = self.effector.pose().matrix3;
                (Velocity { linear: turn * linear, angular: turn * angular }, None)
            }
            Some(Target::Pose(pose)) => {
                let from = self.effector.pose();
                let way = Velocity {
                    linear: pose.translation - from.translation,
                    angular: rotation_between(&from.matrix3, &pose.matrix3),
                };
                (towards(self.effector.params(), &way, cx.dt), Some(way))
            }
        };
        self.effector.advance(cx, joints, &wanted, way.as_ref(), claims);
        None
    }
}

/// The velocity with which to go the rest of a way, so that both its parts end together and at rest.
fn towards(p: &CartesianParams, way: &Velocity, dt: f64) -> Velocity {
    let (far, turned) = (way.linear.length(), way.angular.length());
    // How much of the way per second.
    let rate = |length: f64, fastest: f64, acceleration: f64| match length > THERE {
        true => braking_speed(length, APPROACH * acceleration, dt).min(fastest) / length,
        false => f64::INFINITY,
    };
    let rate = rate(far, p.max_linear_velocity, p.max_linear_acceleration).min(rate(
        turned,
        p.max_angular_velocity,
        p.max_angular_acceleration,
    ));
    if !rate.is_finite() {
        return Velocity::default();
    }
    Velocity { linear: way.linear * rate, angular: way.angular * rate }
}

/// A goal as a target; `None` where it is not finite, or no orientation.
fn target(p: &CartesianParams, goal: &Goal) -> Option<Target> {
    match *goal {
        Goal::Pose { position, orientation } => {
            let turn = DQuat::from_array(orientation);
            let good = (turn.length() - 1.0).abs() <= QUATERNION_SLACK && DVec3::from_array(position).is_finite();
            let root = DAffine3::from_rotation_translation(
                DQuat::from_array(p.root.orientation).normalize(),
                DVec3::from_array(p.root.position),
            );
            let pose = DAffine3::from_rotation_translation(turn.normalize(), DVec3::from_array(position));
            good.then(|| Target::Pose(root.inverse() * pose))
        }
        Goal::Twist { linear, angular, tool } => {
            let (linear, angular) = (DVec3::from_array(linear), DVec3::from_array(angular));
            if !(linear.is_finite() && angular.is_finite()) {
                return None;
            }
            // What is too fast is slowed down as a whole: it keeps its direction.
            let asked = Velocity { linear, angular };
            let over = seconds(&asked, p.max_linear_velocity, p.max_angular_velocity).max(1.0);
            let base = if tool { DMat3::IDENTITY } else { DMat3::from_quat(DQuat::from_array(p.base).normalize()) };
            let twist = Velocity { linear: base * linear / over, angular: base * angular / over };
            Some(if tool { Target::ToolTwist(twist) } else { Target::Twist(twist) })
        }
    }
}

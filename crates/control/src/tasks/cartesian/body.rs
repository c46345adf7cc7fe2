//! Follows a stream of poses or twists of an end effector. When the stream stops, the end effector decelerates to rest
//! and the joints are released.

use glamx::{DAffine3, DMat3, DQuat, DVec3};

use super::end_effector::{EndEffector, Velocity, seconds};
use super::params::CartesianParams;
use crate::request::Goal;
use crate::task_body::{Claim, Context, OnCancel, Step, Target, TaskBody};
use crate::task_robot::{FramePose, TaskKinematics};
use dimos_core::clock::Mono;
use dimos_core::joint::braking_speed;
use dimos_core::telemetry::{Outcome, Reason, TaskState, TaskView};
use dimos_robot::kinematics::step::rotation_between;

/// Fraction of the acceleration limit for approaching a goal; the remainder is for the joints' own limits.
const APPROACH: f64 = 0.8;
/// Maximum deviation of a quaternion's length from 1.
const QUATERNION_SLACK: f64 = 0.01;
/// Tolerance of the goal [m, rad].
const GOAL_TOLERANCE: f64 = 1e-9;

/// A goal in the frame of the model's root.
#[derive(Debug, Clone, Copy)]
enum Tracked {
    Pose(DAffine3),
    Twist(Velocity),
    ToolTwist(Velocity),
}

/// State of a Cartesian task.
#[derive(Debug)]
pub struct CartesianTask {
    effector: EndEffector,
    target: Option<(Tracked, Mono)>,
    slowing: bool,
    timed_out: bool,
}

impl CartesianTask {
    /// Creates a task without a target, for the end effector of a robot.
    pub fn new(params: CartesianParams, robot: TaskKinematics) -> Self {
        Self { effector: EndEffector::new(params, robot), target: None, slowing: false, timed_out: false }
    }
}

impl TaskBody for CartesianTask {
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        let Target::EndEffector(goal) = target else { return Err(Outcome::WrongTask(cx.task)) };
        if let Some((joint, error)) = self.effector.strayed(cx).filter(|_| !cx.active) {
            return Err(Outcome::StartStateMismatch(joint, error.abs()));
        }
        // A goal that cannot be followed also ends the previous one.
        let tracked = tracked(&self.effector, goal);
        self.target = tracked.map(|target| (target, cx.now));
        if tracked.is_none() {
            return Err(Outcome::InvalidTarget(cx.task));
        }
        (self.slowing, self.timed_out) = (false, false);
        Ok(())
    }

    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step {
        let timeout = self.effector.params().timeout;
        let fresh = |at: &Mono| timeout <= 0.0 || cx.now.seconds_since(*at) <= timeout;
        let target = self.target.filter(|(_, at)| fresh(at)).map(|(target, _)| target);
        self.timed_out = target.is_none();
        let ended = || match self.slowing {
            true => Step::End(TaskState::Idle, Reason::Cancelled),
            false => Step::End(TaskState::Idle, Reason::Timeout),
        };
        let ending = self.slowing || self.timed_out;
        if !cx.granted {
            // Nothing was commanded: there is nothing to decelerate.
            if ending {
                return ended();
            }
            self.effector.rebase(cx);
        } else if let Some((joint, error)) = self.effector.strayed(cx) {
            return Step::End(TaskState::Aborted, Reason::TrackingError(joint, error));
        } else if ending && self.effector.at_rest() {
            return ended();
        }
        let (wanted, way) = match target.filter(|_| !self.slowing) {
            None => (Velocity::default(), None),
            Some(Tracked::Twist(twist)) => (slowed(self.effector.params(), twist, cx.pace), None),
            Some(Tracked::ToolTwist(twist)) => {
                let Velocity { linear, angular } = slowed(self.effector.params(), twist, cx.pace);
                let turn = self.effector.pose().matrix3;
                (Velocity { linear: turn * linear, angular: turn * angular }, None)
            }
            Some(Tracked::Pose(pose)) => {
                let from = self.effector.pose();
                let way = Velocity {
                    linear: pose.translation - from.translation,
                    angular: rotation_between(&from.matrix3, &pose.matrix3),
                };
                (towards(self.effector.params(), &way, cx.pace, cx.dt), Some(way))
            }
        };
        self.effector.advance(cx, &wanted, way.as_ref(), claims);
        if self.timed_out { Step::ContinueFor(Reason::Timeout) } else { Step::Continue }
    }

    fn end(&mut self) {
        (self.target, self.slowing, self.timed_out) = (None, false, false);
    }

    fn cancel(&mut self) -> OnCancel {
        self.slowing = true;
        OnCancel::Decelerate
    }

    fn applies_speed(&self) -> bool {
        true
    }

    fn set_tool(&mut self, tool: &FramePose) -> bool {
        self.effector.set_tool(tool);
        true
    }

    fn describe(&self, view: &mut TaskView) {
        if matches!(view.state, TaskState::Executing | TaskState::Cancelling) {
            view.bound = self.effector.bound();
        }
    }
}

/// Returns a twist within this fraction of its limits. One that is too fast is scaled as a whole: it keeps its
/// direction.
fn slowed(p: &CartesianParams, twist: Velocity, pace: f64) -> Velocity {
    let over = seconds(&twist, p.max_linear_velocity, p.max_angular_velocity);
    if pace >= 1.0 || over <= pace {
        return twist;
    }
    let share = pace / over;
    Velocity { linear: twist.linear * share, angular: twist.angular * share }
}

/// Returns the twist for the remaining way, so that translation and rotation end together and at rest. `pace`: fraction
/// of the velocity limits.
fn towards(p: &CartesianParams, way: &Velocity, pace: f64, dt: f64) -> Velocity {
    let (far, turned) = (way.linear.length(), way.angular.length());
    // Fraction of the way per second.
    let rate = |length: f64, fastest: f64, acceleration: f64| match length > GOAL_TOLERANCE {
        true => braking_speed(length, APPROACH * acceleration, dt).min(fastest) / length,
        false => f64::INFINITY,
    };
    let rate = rate(far, pace * p.max_linear_velocity, p.max_linear_acceleration).min(rate(
        turned,
        pace * p.max_angular_velocity,
        p.max_angular_acceleration,
    ));
    if !rate.is_finite() {
        return Velocity::default();
    }
    Velocity { linear: way.linear * rate, angular: way.angular * rate }
}

/// Converts a goal to the frame of the model's root; `None` if it is not finite or has no valid orientation.
fn tracked(effector: &EndEffector, goal: &Goal) -> Option<Tracked> {
    let (p, robot) = (effector.params(), effector.robot());
    match *goal {
        Goal::Pose { position, orientation } => {
            let turn = DQuat::from_array(orientation);
            let good = (turn.length() - 1.0).abs() <= QUATERNION_SLACK && DVec3::from_array(position).is_finite();
            let root = robot.root.frame();
            let pose = DAffine3::from_rotation_translation(turn.normalize(), DVec3::from_array(position));
            good.then(|| Tracked::Pose(root.inverse() * pose))
        }
        Goal::Twist { linear, angular, tool } => {
            let (linear, angular) = (DVec3::from_array(linear), DVec3::from_array(angular));
            if !(linear.is_finite() && angular.is_finite()) {
                return None;
            }
            // A twist that is too fast is scaled as a whole, to keep its direction.
            let asked = Velocity { linear, angular };
            let over = seconds(&asked, p.max_linear_velocity, p.max_angular_velocity).max(1.0);
            let base = if tool { DMat3::IDENTITY } else { DMat3::from_quat(DQuat::from_array(robot.base).normalize()) };
            let twist = Velocity { linear: base * linear / over, angular: base * angular / over };
            Some(if tool { Tracked::ToolTwist(twist) } else { Tracked::Twist(twist) })
        }
    }
}

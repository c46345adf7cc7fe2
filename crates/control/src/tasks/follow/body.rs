//! Follows the measured joints of a leader. It approaches the leader slowly, all joints at a time; in step with it, the
//! limits rise to those of the arm. A leader that is lost, jumps or is far away after a pause is approached again.

use super::estimate::Estimate;
use super::params::FollowParams;
use super::pursuit::{Caps, Pursuit, Room, within};
use crate::config::JUMP;
use crate::task_body::{Claim, Context, JointView, Step, Target, TaskBody};
use crate::task_leader::LeaderJoint;
use dimos_core::clock::Mono;
use dimos_core::joint::MAX_DOF;
use dimos_core::telemetry::{Bound, Cause, Outcome, Reason, TaskState, TaskView};

/// In step: every joint is this near to its target [rad].
const IN_STEP: f64 = 0.02;
/// Time in which the limits then rise to those of the arm [s].
const ENGAGING: f64 = 0.5;
/// A leader may be this far outside the range of the joint that follows: the joint goes to the end of its range [rad].
const TOLERATED: f64 = 0.05;
/// How far a claim is outside a range at whose end the joint waits [rad]: the limiter reports it.
const BEYOND: f64 = 1e-3;
/// A joint this near to the end of its range is there [rad].
const NEAR: f64 = 1e-6;
/// Factor of the limits that leaves room for rounding.
const ROUNDING: f64 = 0.98;
/// Share of the acceleration with which a joint brakes to its target.
const BRAKING: f64 = 0.9;
/// On the way to the leader: acceleration, also for braking [rad/s²], jerk [rad/s³], speed per distance [1/s].
const APPROACH: (f64, f64, f64, f64) = (1.0, 0.3, 5.0, 2.0);
/// In step with it: speed per distance [1/s].
const GAIN: f64 = 15.0;
/// Joints that are nearer to their targets than this share of the furthest one are as fast as if they were this far.
const LEAST_SHARE: f64 = 0.05;

/// A joint that follows.
#[derive(Debug, Clone, Copy, Default)]
struct Joint {
    motion: Pursuit,
    leader: Estimate,
    /// Target now: inside the range [rad], and its velocity [rad/s].
    target: (f64, f64),
    /// How far the leader is outside the range, signed [rad].
    outside: f64,
}

/// What the arm does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    /// Waits at rest: paused, or without a leader.
    Waiting,
    /// On its way to the leader.
    Approaching,
    /// Follows.
    InStep,
}

/// State of a follow task.
#[derive(Debug)]
pub struct FollowTask {
    params: FollowParams,
    leader: Vec<LeaderJoint>,
    joints: [Joint; MAX_DOF],
    stage: Stage,
    /// How far the limits have risen, 0 to 1.
    engaged: f64,
    /// Whether the estimates have a sample.
    sampled: bool,
    /// When the leader was lost, and the reason.
    lost: Option<(Mono, Reason)>,
    /// Largest distance of a joint from the leader's [rad].
    distance: Option<f64>,
    bound: Bound,
}

impl FollowTask {
    /// Creates a task that follows these joints, in the order of its own.
    pub fn new(params: FollowParams, leader: &[LeaderJoint]) -> Self {
        Self {
            params,
            leader: leader.to_vec(),
            joints: [Joint::default(); MAX_DOF],
            stage: Stage::Waiting,
            engaged: 0.0,
            sampled: false,
            lost: None,
            distance: None,
            bound: Bound::None,
        }
    }

    /// Returns what each joint follows: the joint, its view, its leader's, and the target [rad].
    fn pairs<'a>(&'a self, cx: &'a Context<'_>) -> impl Iterator<Item = (u16, JointView, JointView, f64)> + 'a {
        cx.joints.iter().zip(&self.leader).map(|(&joint, leader)| {
            let (own, view) = (cx.joint(joint), cx.joint(leader.joint));
            (joint, own, view, leader.target_near(view.position, own.position))
        })
    }

    /// Returns the joint that is too far from its leader to approach it, and the distance [rad].
    fn too_far(&self, cx: &Context<'_>) -> Option<(u16, f64)> {
        let most = self.params.max_approach;
        let mut away = self.pairs(cx).map(|(joint, view, _, target)| (joint, (target - view.position).abs()));
        away.find(|(_, distance)| distance.is_nan() || *distance > most)
    }

    /// Takes the leader's newest samples; returns whether one jumped.
    fn sample(&mut self, cx: &Context<'_>) -> bool {
        let mut jumped = false;
        for ((joint, leader), &index) in self.joints.iter_mut().zip(&self.leader).zip(cx.joints) {
            let view = cx.joint(leader.joint);
            let before = if self.sampled { joint.leader.sample() } else { cx.joint(index).position };
            let target = leader.target_near(view.position, before);
            if !self.sampled {
                joint.leader.start(target, view.stamp);
                continue;
            }
            let (step, time) = joint.leader.take(target, view.stamp);
            let fastest = 1.5 * view.velocity_limit * leader.scale.abs();
            if step.abs() > (JUMP * leader.scale.abs()).max(fastest * time) {
                joint.leader.start(target, view.stamp);
                jumped = true;
            }
        }
        self.sampled = true;
        jumped
    }

    /// Sets the targets of this tick. Returns the largest distance of a command from its target [rad].
    fn aim(&mut self, cx: &Context<'_>) -> f64 {
        let (mut furthest, mut distance, mut bound) = (0.0f64, 0.0f64, Bound::None);
        for (joint, &index) in self.joints.iter_mut().zip(cx.joints) {
            let view = cx.joint(index);
            let room = room(&view, joint.motion.position);
            let (position, velocity) = joint.leader.at(cx.now);
            let inside = position.max(room.lower).min(room.upper);
            joint.outside = position - inside;
            joint.target = (inside, if joint.outside == 0.0 { velocity } else { 0.0 });
            if joint.outside != 0.0 {
                bound = Bound::Position(index);
            } else if velocity.abs() > view.velocity_limit && bound == Bound::None {
                bound = Bound::Velocity(index);
            }
            furthest = furthest.max((inside - joint.motion.position).abs());
            distance = distance.max((joint.leader.sample() - view.position).abs());
        }
        (self.distance, self.bound) = (Some(distance), bound);
        furthest
    }

    /// Moves the joints for a tick. `furthest`: the largest distance from a target [rad]; `None`: to rest.
    fn advance(&mut self, cx: &Context<'_>, furthest: Option<f64>) {
        let risen = self.engaged;
        let between = |from: f64, to: f64| from + (to - from) * risen;
        let (acceleration, braking, jerk, gain) = APPROACH;
        for (joint, &index) in self.joints.iter_mut().zip(cx.joints) {
            let view = cx.joint(index);
            let room = room(&view, joint.motion.position);
            // All joints arrive at the same time: each moves by its share of the way of the furthest one.
            let way = (joint.target.0 - joint.motion.position).abs();
            let share = furthest.filter(|furthest| *furthest > 0.0).map_or(1.0, |furthest| way / furthest);
            let share = share.max(LEAST_SHARE);
            let full = room.acceleration;
            let slow = |most: f64| share * most.min(full);
            let velocity = ROUNDING * view.velocity_limit;
            let caps = Caps {
                velocity: cx.pace * between(share * self.params.approach_speed.min(velocity), velocity),
                acceleration: between(slow(acceleration), full),
                braking: between(slow(braking), BRAKING * full),
                jerk: between(share * jerk.min(view.jerk), 2.0 * full / cx.dt),
                gain: between(gain, GAIN),
            };
            joint.motion.advance(furthest.map(|_| joint.target), &caps, &room, cx.dt);
        }
    }

    /// Returns the reason to report, or the end of the task without its leader.
    fn await_leader(&mut self, cx: &Context<'_>, view: &JointView) -> Step {
        if view.fault.stops_followers() {
            // Who stops the leader expects that what follows it stops, too.
            return Step::End(TaskState::Aborted, Reason::ArmHeld(view.arm, view.fault));
        }
        let (since, reason) = *self.lost.get_or_insert((cx.now, Reason::LeaderLost(view.arm, view.fault)));
        if cx.now.seconds_since(since) >= self.params.leader_timeout {
            return Step::End(TaskState::Aborted, reason);
        }
        (self.stage, self.engaged, self.sampled, self.distance) = (Stage::Waiting, 0.0, false, None);
        self.bound = Bound::None;
        self.advance(cx, None);
        Step::ContinueFor(reason)
    }

    /// Follows the leader for a tick.
    fn follow(&mut self, cx: &Context<'_>) -> Step {
        self.lost = None;
        if self.sample(cx) {
            (self.stage, self.engaged) = (Stage::Waiting, 0.0);
        }
        if cx.speed == 0.0 {
            // Paused: what the leader does meanwhile is not made up for at full speed.
            (self.stage, self.engaged) = (Stage::Waiting, 0.0);
        } else if self.stage == Stage::Waiting {
            if let Some((joint, distance)) = self.too_far(cx) {
                return Step::End(TaskState::Aborted, Reason::LeaderAway(joint, distance));
            }
            self.stage = Stage::Approaching;
        }
        let furthest = self.aim(cx);
        if self.stage == Stage::InStep && !cx.granted && furthest > IN_STEP {
            // What the leader did while nothing went out is not made up for at full speed.
            (self.stage, self.engaged) = (Stage::Approaching, 0.0);
        }
        if self.stage == Stage::Approaching {
            let near = furthest <= IN_STEP && cx.granted;
            let change = if near { cx.dt } else { -cx.dt };
            self.engaged = (self.engaged + change / ENGAGING).clamp(0.0, 1.0);
            if self.engaged >= 1.0 {
                self.stage = Stage::InStep;
            }
        }
        self.advance(cx, Some(furthest));
        match self.stage {
            Stage::InStep => Step::ContinueFor(Reason::InStep),
            _ => Step::ContinueFor(Reason::Approaching),
        }
    }
}

/// Returns the range of a joint: one that is outside its limits may stay or move in.
fn room(view: &JointView, at: f64) -> Room {
    Room { lower: view.lower.min(at), upper: view.upper.max(at), acceleration: ROUNDING * view.acceleration }
}

impl TaskBody for FollowTask {
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        match target {
            Target::Start if cx.active => return Err(Outcome::AlreadyExecuting(cx.task)),
            Target::Start => {}
            _ => return Err(Outcome::WrongTask(cx.task)),
        }
        for (joint, view, leader, target) in self.pairs(cx) {
            if leader.fault.stops_followers() {
                return Err(Outcome::ArmLatched(leader.arm, leader.fault));
            }
            if leader.fault != Cause::None {
                return Err(Outcome::StartStateUnavailable(leader.arm));
            }
            let outside = (view.lower - target).max(target - view.upper);
            if outside.is_nan() || outside > TOLERATED {
                return Err(Outcome::OutOfLimits(joint, outside));
            }
        }
        match self.too_far(cx) {
            Some((joint, distance)) => Err(Outcome::StartStateMismatch(joint, distance)),
            None => Ok(()),
        }
    }

    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step {
        if !cx.granted {
            // Nothing of the last tick went out, or there was none.
            for (joint, &index) in self.joints.iter_mut().zip(cx.joints) {
                let view = cx.joint(index);
                joint.motion.rebase(view.commanded, view.commanded_velocity);
            }
        }
        let fault = self.pairs(cx).map(|(.., leader, _)| leader).find(|leader| leader.fault != Cause::None);
        let step = match fault {
            Some(leader) => self.await_leader(cx, &leader),
            None => self.follow(cx),
        };
        for (joint, &index) in self.joints.iter().zip(cx.joints) {
            let (motion, view) = (&joint.motion, cx.joint(index));
            // At the end of its range: asks for more, as the leader does, so that the limit is reported.
            let waits = (motion.position - view.lower).min(view.upper - motion.position) <= NEAR;
            let beyond = if waits { within(joint.outside, BEYOND) } else { 0.0 };
            claims.push(Claim { joint: index, value: motion.position + beyond });
        }
        step
    }

    fn end(&mut self) {
        (self.stage, self.engaged, self.sampled) = (Stage::Waiting, 0.0, false);
        (self.lost, self.distance, self.bound) = (None, None, Bound::None);
    }

    fn applies_speed(&self) -> bool {
        true
    }

    fn follows_gripper(&self) -> bool {
        self.params.gripper && self.stage == Stage::InStep
    }

    fn first_target(&self) -> Option<Target<'static>> {
        Some(Target::Start)
    }

    fn describe(&self, view: &mut TaskView) {
        (view.distance, view.bound) = (self.distance, self.bound);
    }
}

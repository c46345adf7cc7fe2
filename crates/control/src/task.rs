//! A task of the coordinator: claims joints and commands them. The behaviour of its type is in its body.

use std::time::Duration;

use super::arm_control::effective;
use super::config::TaskConfig;
use super::request::Motion;
use super::speed_override::SpeedOverride;
use super::task_body::{
    Claim, Compliance, Context, Demand, JointView, OnCancel, OnLoss, Step, Target, TargetKind, TaskBody,
};
use super::task_leader::LeaderJoint;
use super::task_robot::FramePose;
use super::task_spec::TaskSpec;
use dimos_core::clock::Mono;
use dimos_core::telemetry::{Outcome, Reason, TaskState, TaskView};
use dimos_core::until::Sensed;

/// Shortest time between two commands to a gripper that follows another one.
const GRIPPER_PERIOD: Duration = Duration::from_millis(50);

/// What all tasks are given in a tick.
#[derive(Debug, Clone, Copy)]
pub struct Tick<'a> {
    /// The tick's time.
    pub now: Mono,
    /// Length of the control step [s].
    pub dt: f64,
    /// The speed override.
    pub speed: SpeedOverride,
    /// All joints of all arms.
    pub views: &'a [JointView],
    /// What each arm feels.
    pub sensed: &'a [Sensed],
}

/// A task of a coordinator.
#[derive(Debug)]
pub struct Task {
    /// Its joints: indices over all arms' joints.
    pub joints: Vec<u16>,
    /// The higher priority wins a joint.
    pub priority: i32,
    /// Current state.
    pub state: TaskState,
    /// Reason for the state.
    pub reason: Reason,
    /// Meaning of the claims.
    pub demand: Demand,
    /// Claims of this tick.
    pub claims: Vec<Claim>,
    /// Whether all claims of the last tick were commanded.
    pub granted: bool,
    /// Its path moves arms of which one is slowed by its controller more than another: all keep the same time.
    pub shares_time: bool,
    /// The client of its latest target.
    pub client: u64,
    leader: Vec<LeaderJoint>,
    /// When the gripper of its leader was read last.
    gripper_at: Mono,
    index: u16,
    auto_start: bool,
    takes: &'static [TargetKind],
    /// Demand of its type while it is active.
    demands: Demand,
    motion: Option<Box<Motion>>,
    /// It has ended because an arm is held, and decelerates along its path.
    braking: bool,
    body: Box<dyn TaskBody>,
}

impl Task {
    /// Creates an idle task with this index among those of its coordinator.
    pub fn new(index: u16, config: &TaskConfig, spec: &TaskSpec, body: Box<dyn TaskBody>) -> Self {
        Self {
            joints: config.joints.clone(),
            priority: config.priority,
            state: TaskState::Idle,
            reason: Reason::None,
            demand: Demand::Nothing,
            claims: Vec::with_capacity(config.joints.len()),
            granted: false,
            shares_time: false,
            client: 0,
            leader: config.kind.leader.clone(),
            gripper_at: Mono::ZERO,
            index,
            auto_start: config.auto_start,
            takes: spec.takes,
            demands: spec.demand,
            motion: None,
            braking: false,
            body,
        }
    }

    /// Returns the joints that it moves now: those of its motion, else all of its joints.
    pub fn moving_joints(&self) -> &[u16] {
        self.motion.as_ref().map_or(&self.joints, |motion| &motion.joints)
    }

    /// Returns the number of its motion, if it executes one.
    pub fn motion_id(&self) -> Option<u64> {
        self.motion.as_ref().map(|motion| motion.id)
    }

    /// Returns whether it follows this joint.
    pub fn is_led_by(&self, joint: u16) -> bool {
        self.leader.iter().any(|leader| leader.joint == joint)
    }

    /// Returns a joint of its own and one of its leader's, whose arms' grippers are to move alike, at most every 50 ms.
    pub fn led_gripper(&mut self, now: Mono) -> Option<(u16, u16)> {
        let due = now.since(self.gripper_at) >= GRIPPER_PERIOD && self.is_active() && self.body.follows_gripper();
        let pair = self.joints.first().zip(self.leader.first()).filter(|_| due)?;
        self.gripper_at = now;
        Some((*pair.0, pair.1.joint))
    }

    /// Returns whether it takes this kind of target.
    pub fn takes(&self, kind: TargetKind) -> bool {
        self.takes.contains(&kind)
    }

    /// Returns how a joint that it has claimed yields; `None`: its demand is another one.
    pub fn compliance(&self, joint: u16) -> Option<Compliance> {
        (self.demand == Demand::Impedance).then(|| self.body.compliance(joint))
    }

    /// Returns whether it applies the speed override itself.
    pub fn applies_speed(&self) -> bool {
        self.body.applies_speed()
    }

    /// Returns whether it executes or decelerates.
    pub fn is_active(&self) -> bool {
        matches!(self.state, TaskState::Executing | TaskState::Cancelling)
    }

    /// Returns the target with which it starts automatically, if any.
    pub fn first_target(&self) -> Option<Target<'static>> {
        if self.auto_start { self.body.first_target() } else { None }
    }

    /// Rejects a target that no task of this kind can take.
    pub fn check(&self, target: &Target<'_>) -> Result<(), Outcome> {
        match target {
            Target::Trajectory(motion) => {
                let own = motion.joints.iter().all(|j| self.joints.contains(j));
                let whole = motion.joints.len() == motion.spline.joints();
                if !(own && whole && self.takes(TargetKind::Trajectory)) {
                    return Err(Outcome::WrongTask(self.index));
                }
                if self.is_active() { Err(Outcome::AlreadyExecuting(self.index)) } else { Ok(()) }
            }
            Target::Positions(values) | Target::Velocities(values) => {
                let odd = self.joints.iter().zip(values).find(|(_, v)| !v.is_finite());
                odd.map_or(Ok(()), |(&joint, _)| Err(Outcome::NonFinite(joint)))
            }
            Target::Chunk(motion, _) if motion.joints != self.joints => Err(Outcome::WrongTask(self.index)),
            Target::Chunk(..) | Target::EndEffector(_) | Target::Start => Ok(()),
        }
    }

    /// Rejects a trajectory that does not begin where the arm is.
    pub fn check_start(&mut self, tick: &Tick<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        let Target::Trajectory(motion) = target else { return Ok(()) };
        let (cx, body, _) = self.parts(tick);
        body.check_start(&cx, motion)
    }

    /// Passes a target to the body. Returns whether the task becomes active with it.
    pub fn accept(&mut self, tick: &Tick<'_>, target: &Target<'_>) -> Result<bool, Outcome> {
        if !self.takes(target.kind()) {
            return Err(Outcome::WrongTask(self.index));
        }
        if self.braking {
            return Err(Outcome::AlreadyExecuting(self.index));
        }
        let (cx, body, _) = self.parts(tick);
        body.accept(&cx, target)?;
        // A target during the deceleration after a cancel: continues from the present motion.
        let begins = self.state != TaskState::Executing;
        self.state = TaskState::Executing;
        self.reason = Reason::None;
        Ok(begins)
    }

    /// Keeps the motion of an accepted trajectory. Returns the previous one, to be freed on another thread.
    pub fn keep(&mut self, motion: Box<Motion>) -> Option<Box<Motion>> {
        self.motion.replace(motion)
    }

    /// Returns the smallest and the largest fraction of their speeds at which the controllers of its arms run motions.
    fn own_speeds(&self, views: &[JointView]) -> (f64, f64) {
        let of = |joint: &u16| effective(views.get(usize::from(*joint)).and_then(|view| view.speed_fraction));
        let mut speeds = self.moving_joints().iter().map(of);
        let first = speeds.next().unwrap_or(1.0);
        speeds.fold((first, first), |(low, high), speed| (low.min(speed), high.max(speed)))
    }

    fn parts<'a>(&'a mut self, tick: &Tick<'a>) -> (Context<'a>, &'a mut dyn TaskBody, &'a mut Vec<Claim>) {
        let (slowest, fastest) = self.own_speeds(tick.views);
        let on_path = self.takes(TargetKind::Trajectory);
        // One clock for all arms of a path: that of the slowest, approached within the limits of the others.
        self.shares_time = on_path && slowest != fastest;
        let alone = on_path && !self.shares_time;
        let cx = Context {
            now: tick.now,
            dt: if alone { tick.dt * slowest } else { tick.dt },
            speed: if alone && slowest > 0.0 { tick.speed.target() } else { tick.speed.target() * slowest },
            pace: tick.speed.of_streams() * slowest,
            task: self.index,
            joints: &self.joints,
            active: self.braking || matches!(self.state, TaskState::Executing | TaskState::Cancelling),
            granted: self.granted,
            motion: self.motion.as_deref(),
            views: tick.views,
            sensed: tick.sensed,
        };
        (cx, self.body.as_mut(), &mut self.claims)
    }

    /// Fills in the claims of this tick. Returns a finished motion, to be freed on another thread.
    pub fn compute(&mut self, tick: &Tick<'_>) -> Option<Box<Motion>> {
        self.claims.clear();
        self.demand = Demand::Nothing;
        if !self.is_active() && !self.braking {
            return None;
        }
        self.demand = self.demands;
        let (cx, body, claims) = self.parts(tick);
        match body.compute(&cx, claims) {
            Step::Continue => None,
            Step::End(..) if self.braking => self.end(self.state, self.reason),
            Step::ContinueFor(reason) => {
                if self.state == TaskState::Executing {
                    self.reason = reason;
                }
                None
            }
            // Why it decelerated is known here only.
            Step::End(state, Reason::Cancelled) if self.state == TaskState::Cancelling => self.end(state, self.reason),
            Step::End(state, reason) => self.end(state, reason),
        }
    }

    /// Ends the task for its client because an arm is held. A motion along a path decelerates along it first. Returns a
    /// motion that is over, to be freed on another thread.
    pub fn brake(&mut self, state: TaskState, reason: Reason) -> Option<Box<Motion>> {
        if !self.granted || self.body.cancel() != OnCancel::Decelerate {
            return self.end(state, reason);
        }
        (self.state, self.reason, self.braking) = (state, reason, true);
        None
    }

    /// A gap in the setpoints of an arm has ended, and the arm rests where its joints are commanded: continues from the
    /// nearest point of the path since the tick of `at`. An error has the joint that is farther than `tolerance` [rad]
    /// from the path, and its distance.
    pub fn rejoin(&mut self, tick: &Tick<'_>, at: Mono, tolerance: f64) -> Result<(), (u16, f64)> {
        self.granted = false;
        let (cx, body, _) = self.parts(tick);
        body.rejoin(&cx, at, tolerance)
    }

    /// No command reached an arm since the tick of `at`: continues from the command of that tick, from rest.
    pub fn rewind(&mut self, at: Mono, now: Mono) {
        self.granted = false;
        self.body.rewind(at, now);
    }

    /// Ends the task: the limiter decelerates its joints to rest. Returns its motion, to be freed on another thread.
    pub fn end(&mut self, state: TaskState, reason: Reason) -> Option<Box<Motion>> {
        self.state = state;
        self.reason = reason;
        self.demand = Demand::Nothing;
        self.claims.clear();
        (self.granted, self.braking) = (false, false);
        self.body.end();
        self.motion.take()
    }

    /// Another task took a joint.
    pub fn lose(&mut self, winner: u16, joint: u16) -> Option<Box<Motion>> {
        match self.body.lose(&self.joints, joint) {
            OnLoss::End => self.end(TaskState::Aborted, Reason::Preempted(winner, joint)),
            OnLoss::Continue => {
                self.claims.retain(|c| c.joint != joint);
                None
            }
        }
    }

    /// Cancels the task for a reason. Returns the motion that ended with it, to be freed on another thread; `None` if
    /// the task was not active.
    pub fn cancel(&mut self, reason: Reason) -> Option<Option<Box<Motion>>> {
        match self.state {
            TaskState::Cancelling => Some(None),
            TaskState::Executing => Some(match self.body.cancel() {
                OnCancel::Decelerate => {
                    self.state = TaskState::Cancelling;
                    self.reason = reason;
                    None
                }
                OnCancel::End => self.end(TaskState::Idle, Reason::StreamEnded),
            }),
            _ => None,
        }
    }

    /// Replaces the tool of its end effector, or rejects it with the outcome for the client.
    pub fn set_tool(&mut self, tool: &FramePose) -> Result<(), Outcome> {
        match () {
            () if !tool.is_valid() => Err(Outcome::InvalidTarget(self.index)),
            () if self.is_active() => Err(Outcome::AlreadyExecuting(self.index)),
            () if self.body.set_tool(tool) => Ok(()),
            () => Err(Outcome::WrongTask(self.index)),
        }
    }

    /// Returns what the status shows.
    pub fn view(&self) -> TaskView {
        let mut view = TaskView { state: self.state, reason: self.reason, ..TaskView::default() };
        self.body.describe(&mut view);
        view
    }
}

//! A task: something that wants joints to move. Each tick it may claim joints with a position or a velocity each.

use super::config::{TaskConfig, TaskKind};
use super::request::Motion;
use super::tasks::cartesian::CartesianTask;
use super::tasks::servo::ServoTask;
use super::tasks::trajectory::TrajectoryTask;
use super::tasks::velocity::VelocityTask;
use crate::clock::Mono;
use crate::telemetry::{Reason, TaskState, TaskView};

/// What a task sees of a joint.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct JointView {
    /// Measured position [rad].
    pub position: f64,
    /// Measured or estimated velocity [rad/s].
    pub velocity: f64,
    /// Last commanded position [rad].
    pub commanded: f64,
    /// Last commanded velocity [rad/s].
    pub commanded_velocity: f64,
    /// Lowest position that is commanded [rad].
    pub lower: f64,
    /// Highest position that is commanded [rad].
    pub upper: f64,
    /// Acceleration limit [rad/s²].
    pub acceleration: f64,
    /// Velocity limit [rad/s].
    pub velocity_limit: f64,
    /// Jerk limit [rad/s³].
    pub jerk: f64,
    /// How far the joint is outside the range of its set points of the last `lag` seconds [rad].
    pub tracking_error: f64,
}

/// What a task sees when it computes.
#[derive(Debug, Clone, Copy)]
pub struct Context<'a> {
    /// The tick's time.
    pub now: Mono,
    /// Length of the control step [s].
    pub dt: f64,
    /// All joints of all arms.
    pub joints: &'a [JointView],
}

impl Context<'_> {
    /// A joint's view; zeros for an index that does not exist.
    pub fn joint(&self, joint: u16) -> JointView {
        self.joints.get(joint as usize).copied().unwrap_or_default()
    }
}

/// How a task's values are meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Demand {
    /// It claims nothing.
    #[default]
    Nothing,
    /// Joint positions [rad].
    Positions,
    /// Joint velocities [rad/s].
    Velocities,
}

/// One joint that a task wants, and what it should do.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Claim {
    /// Index over all arms' joints.
    pub joint: u16,
    /// [rad] or [rad/s], by the task's demand.
    pub value: f64,
}

/// What is different between the types of tasks.
#[derive(Debug)]
pub enum Body {
    /// See [`TrajectoryTask`].
    Trajectory(Box<TrajectoryTask>),
    /// See [`ServoTask`].
    Servo(ServoTask),
    /// See [`VelocityTask`].
    Velocity(VelocityTask),
    /// See [`CartesianTask`].
    Cartesian(Box<CartesianTask>),
}

/// A task of a coordinator.
#[derive(Debug)]
pub struct Task {
    /// Its joints: indices over all arms' joints.
    pub joints: Vec<u16>,
    /// The higher one wins.
    pub priority: i32,
    /// What it does just now.
    pub state: TaskState,
    /// Why.
    pub reason: Reason,
    /// How the claims are meant.
    pub demand: Demand,
    /// What it wants in this tick.
    pub claims: Vec<Claim>,
    /// Whether all it wanted in the last tick went out to the arms.
    pub granted: bool,
    /// What is special about it.
    pub body: Body,
}

impl Task {
    /// A task at rest.
    pub fn new(config: &TaskConfig) -> Self {
        let width = config.joints.len();
        let body = match &config.kind {
            TaskKind::Trajectory(p) => Body::Trajectory(Box::new(TrajectoryTask::new(p.clone(), width))),
            TaskKind::Servo(p) => Body::Servo(ServoTask::new(p.clone())),
            TaskKind::Velocity(p) => Body::Velocity(VelocityTask::new(p.clone())),
            TaskKind::CartesianIk(p) => Body::Cartesian(Box::new(CartesianTask::new(*p.clone(), true))),
            TaskKind::EefTwist(p) => Body::Cartesian(Box::new(CartesianTask::new(*p.clone(), false))),
        };
        Self {
            joints: config.joints.clone(),
            priority: config.priority,
            state: TaskState::Idle,
            reason: Reason::None,
            demand: Demand::Nothing,
            claims: Vec::with_capacity(width),
            granted: false,
            body,
        }
    }

    /// Whether it does something.
    pub fn is_active(&self) -> bool {
        matches!(self.state, TaskState::Executing | TaskState::Cancelling)
    }

    /// Fills in the claims of this tick. Answers a finished motion, to be freed elsewhere.
    pub fn compute(&mut self, cx: &Context<'_>) -> Option<Box<Motion>> {
        self.claims.clear();
        self.demand = Demand::Nothing;
        if !self.is_active() {
            return None;
        }
        match &mut self.body {
            Body::Trajectory(t) => {
                self.demand = Demand::Positions;
                match t.compute(cx, self.granted, &mut self.claims) {
                    None => None,
                    Some((state, reason)) => self.end(state, reason),
                }
            }
            Body::Servo(t) => {
                self.demand = Demand::Positions;
                match t.compute(cx, &self.joints, &mut self.claims) {
                    true => None,
                    false => self.end(TaskState::Idle, Reason::Timeout),
                }
            }
            Body::Velocity(t) => {
                self.demand = Demand::Velocities;
                match t.compute(cx, &self.joints, &mut self.claims) {
                    true => {
                        if t.timed_out() {
                            self.reason = Reason::Timeout;
                        }
                        None
                    }
                    false => self.end(TaskState::Idle, Reason::Timeout),
                }
            }
            Body::Cartesian(t) => {
                self.demand = Demand::Positions;
                match t.compute(cx, &self.joints, self.granted, &mut self.claims) {
                    None => {
                        if t.timed_out() && self.state == TaskState::Executing {
                            self.reason = Reason::Timeout;
                        }
                        None
                    }
                    Some((state, reason)) => self.end(state, reason),
                }
            }
        }
    }

    /// Nothing reached an arm since the tick of `at`: it goes on from what was commanded then, from rest.
    pub fn rewind(&mut self, at: Mono, now: Mono) {
        self.granted = false;
        if let Body::Trajectory(t) = &mut self.body {
            t.rewind(at, now);
        }
    }

    /// Ends what it does: its joints come to rest by themselves. Answers its motion, to be freed elsewhere.
    pub fn end(&mut self, state: TaskState, reason: Reason) -> Option<Box<Motion>> {
        self.state = state;
        self.reason = reason;
        self.demand = Demand::Nothing;
        self.claims.clear();
        self.granted = false;
        match &mut self.body {
            Body::Trajectory(t) => t.take(),
            Body::Servo(t) => {
                t.drop_target();
                None
            }
            Body::Velocity(t) => {
                t.drop_target();
                None
            }
            Body::Cartesian(t) => {
                t.drop_target();
                None
            }
        }
    }

    /// Another task took a joint. A trajectory is all or nothing, as is an end effector's motion; a stream of joint values
    /// loses the joint until its next target.
    pub fn lose(&mut self, winner: u16, joint: u16) -> Option<Box<Motion>> {
        match &mut self.body {
            Body::Trajectory(_) | Body::Cartesian(_) => {
                return self.end(TaskState::Aborted, Reason::Preempted(winner, joint));
            }
            Body::Servo(t) => t.mute(&self.joints, joint),
            Body::Velocity(t) => t.mute(&self.joints, joint),
        }
        self.claims.retain(|c| c.joint != joint);
        None
    }

    /// A cancel: a trajectory slows down along its path, an end effector in its direction; of a stream of joint values it
    /// is the ordinary end. `false`: there was nothing to cancel.
    pub fn cancel(&mut self) -> bool {
        match (&self.body, self.state) {
            (_, TaskState::Cancelling) => true,
            (Body::Trajectory(_) | Body::Cartesian(_), TaskState::Executing) => {
                match &mut self.body {
                    Body::Trajectory(t) => t.slow_down(),
                    Body::Cartesian(t) => t.slow_down(),
                    _ => {}
                }
                self.state = TaskState::Cancelling;
                self.reason = Reason::Cancelled;
                true
            }
            (_, TaskState::Executing) => {
                // Streams hold no motion, so there is nothing to free.
                let _ = self.end(TaskState::Idle, Reason::StreamEnded);
                true
            }
            _ => false,
        }
    }

    /// What is told of it.
    pub fn view(&self) -> TaskView {
        let mut view = TaskView { state: self.state, reason: self.reason, ..TaskView::default() };
        match &self.body {
            Body::Trajectory(t) => t.describe(&mut view),
            Body::Cartesian(t) if self.is_active() => view.bound = t.bound(),
            _ => {}
        }
        view
    }
}

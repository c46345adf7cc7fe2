//! The action of a trajectory task: goals, their states, cancellation, results. The protocol of ROS 2 actions, which
//! are three services and two topics.

use std::collections::VecDeque;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::Receiver;
use std::sync::{Arc, Mutex, Weak};

use super::follow::{Watcher, Way, follow};
use super::goal::{Code, Goal, Outcome, Values};
use super::node::{Latched, Node, Request, Topic};
use super::types;
use crate::blueprint::share::Distro;
use dimos_core::clock::wall_now;
use dimos_core::sync::lock;
use dimos_log::cdr::Encoder;
use dimos_log::display_messages::JointTrajectoryPoint;
use dimos_log::messages::{Header, Time};
use dimos_log::node_messages::{
    CancelRequest, CancelResponse, Feedback, FeedbackRest, FollowResult, GoalInfo, GoalStatus, GoalStatusArray,
    ResultRequest, ResultResponse, SendGoalRequest, SendGoalResponse, Uuid,
};
use dimos_log::wire::Field;

/// Goals of an action that may be under way: one moves, and others are being refused by the run.
const MAX_LIVE: usize = 4;
/// Goals that are remembered after their end.
const MAX_ENDED: usize = 32;
/// Requests that may wait for the result of a goal.
const MAX_WAITING: usize = 16;
/// States of a goal.
const EXECUTING: i8 = 2;
const CANCELING: i8 = 3;
const SUCCEEDED: i8 = 4;
const CANCELED: i8 = 5;
const ABORTED: i8 = 6;
/// Return codes of a cancellation.
const UNKNOWN_GOAL: i8 = 2;
const GOAL_TERMINATED: i8 = 3;

/// A service of an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Service {
    /// Takes a goal.
    SendGoal,
    /// Cancels goals.
    CancelGoal,
    /// Answers when a goal has ended.
    GetResult,
}

/// Services of an action: name below that of the action, and type.
pub const SERVICES: [(&str, Service, types::Type); 3] = [
    ("send_goal", Service::SendGoal, types::SEND_GOAL),
    ("cancel_goal", Service::CancelGoal, types::CANCEL_GOAL),
    ("get_result", Service::GetResult, types::GET_RESULT),
];

/// A service of one of the actions: its index, and which.
pub type OfAction = (usize, Service);

/// The action of a trajectory task.
pub struct Action {
    way: Way,
    /// Whether goals are accepted.
    command: bool,
    distro: Distro,
    status: Latched,
    feedback: Topic,
    goals: Mutex<Goals>,
    has_ended: AtomicBool,
}

#[derive(Default)]
struct Goals {
    live: Vec<Live>,
    ended: VecDeque<(GoalInfo, ResultResponse)>,
}

/// A goal under way.
struct Live {
    info: GoalInfo,
    cancel: Arc<AtomicBool>,
    waiting: Vec<Request<OfAction>>,
}

/// Returns the name of the action of a task, below the namespace.
pub fn name(task: &str) -> String {
    format!("{task}/follow_joint_trajectory")
}

impl Action {
    /// Creates the topics of an action.
    pub fn new(node: &Node, way: Way, command: bool, distro: Distro) -> zenoh::Result<Self> {
        let part = |part: &str| format!("{}/_action/{part}", name(&way.task));
        let status = node.latched(&part("status"), types::GOAL_STATUS)?;
        let feedback = node.topic(&part("feedback"), types::feedback(distro))?;
        let (goals, has_ended) = (Mutex::default(), AtomicBool::new(false));
        Ok(Self { way, command, distro, status, feedback, goals, has_ended })
    }

    /// Lets go of all goals: their connections end, and the run does with their motions what `on_lost` says.
    pub fn end(&self) {
        self.has_ended.store(true, Ordering::Release);
    }

    /// Answers a request, at once or later.
    pub fn answer(self: &Arc<Self>, request: Request<OfAction>) {
        let service = request.of.1;
        let read = match service {
            Service::SendGoal => request.read().map(|asked| self.take(asked, request)),
            Service::CancelGoal => request.read().map(|asked| self.cancel(&asked, request)),
            Service::GetResult => request.read().map(|asked| self.answer_result(&asked, request)),
        };
        if let Err(error) = read {
            tracing::debug!("share: ros: {service:?} of {}: {error}", self.way.task);
        }
    }

    fn take(self: &Arc<Self>, asked: SendGoalRequest, request: Request<OfAction>) {
        let stamp = Time::of(wall_now());
        let accepted = self.accept(asked, stamp.clone());
        request.reply(&SendGoalResponse { accepted: accepted.is_some(), stamp });
        let Some((goal, id, cancel)) = accepted else { return };
        self.publish_states();
        let watcher = OneGoal { action: self.clone(), id: id.clone(), cancel, joints: Vec::new() };
        let spawned = std::thread::Builder::new().name("ros-goal".into()).spawn(move || watcher.run(goal));
        if let Err(error) = spawned {
            self.finish(&id, Outcome::new(Code::InvalidGoal, error.to_string()));
        }
    }

    /// Accepts a goal; `None`: it is refused. Why a trajectory is not valid is said in its result.
    fn accept(&self, asked: SendGoalRequest, stamp: Time) -> Option<(Result<Goal, Outcome>, Uuid, Arc<AtomicBool>)> {
        if !self.command {
            let hint = "set `share.ros.command: true`, or start `dimos share --ros --command`";
            tracing::warn!("share: ros: a goal for {} was rejected: ROS may not move the arms ({hint})", self.way.task);
            return None;
        }
        let mut goals = lock(&self.goals);
        let id = asked.goal_id;
        let known = goals.live.iter().map(|live| &live.info).chain(goals.ended.iter().map(|(info, _)| info));
        if goals.live.len() >= MAX_LIVE || known.into_iter().any(|info| info.goal_id == id) {
            return None;
        }
        let cancel = Arc::new(AtomicBool::new(false));
        let info = GoalInfo { goal_id: id.clone(), stamp };
        goals.live.push(Live { info, cancel: cancel.clone(), waiting: Vec::new() });
        Some((Goal::read(asked.goal), id, cancel))
    }

    fn cancel(&self, asked: &CancelRequest, request: Request<OfAction>) {
        let response = self.cancelled(&asked.goal_info);
        request.reply(&response);
        if !response.goals_canceling.is_empty() {
            self.publish_states();
        }
    }

    /// Asks goals to end. As `rcl` reads it: without a goal and a time all, with a time those until then, and the goal.
    fn cancelled(&self, asked: &GoalInfo) -> CancelResponse {
        let (no_goal, no_time) = (asked.goal_id == Uuid::default(), asked.stamp == Time::default());
        let until = (asked.stamp.sec, asked.stamp.nanosec);
        let goals = lock(&self.goals);
        let asked_for = |info: &GoalInfo| {
            (no_goal && no_time)
                || info.goal_id == asked.goal_id
                || (!no_time && (info.stamp.sec, info.stamp.nanosec) <= until)
        };
        let mut goals_canceling = Vec::new();
        for live in goals.live.iter().filter(|live| asked_for(&live.info)) {
            live.cancel.store(true, Ordering::Release);
            goals_canceling.push(live.info.clone());
        }
        let return_code = match goals_canceling.is_empty() && !no_goal {
            false => 0,
            true if goals.ended.iter().any(|(info, _)| info.goal_id == asked.goal_id) => GOAL_TERMINATED,
            true => UNKNOWN_GOAL,
        };
        CancelResponse { return_code, goals_canceling }
    }

    /// Answers when the goal has ended; of an unknown one at once, with the state 0.
    fn answer_result(&self, asked: &ResultRequest, request: Request<OfAction>) {
        let mut goals = lock(&self.goals);
        if let Some(live) = goals.live.iter_mut().find(|live| live.info.goal_id == asked.goal_id) {
            if live.waiting.len() < MAX_WAITING {
                live.waiting.push(request);
            }
            return;
        }
        let ended = goals.ended.iter().find(|(info, _)| info.goal_id == asked.goal_id);
        let response = ended.map(|(_, response)| response.clone()).unwrap_or_default();
        drop(goals);
        request.reply(&response);
    }

    /// Ends a goal: its state, and its result for all who wait.
    fn finish(&self, id: &Uuid, outcome: Outcome) {
        let status = match outcome.code {
            _ if outcome.cancelled => CANCELED,
            Code::Successful => SUCCEEDED,
            _ => ABORTED,
        };
        let result: FollowResult = outcome.message();
        let response = ResultResponse { status, result };
        let mut goals = lock(&self.goals);
        let Some(at) = goals.live.iter().position(|live| live.info.goal_id == *id) else { return };
        let live = goals.live.remove(at);
        if goals.ended.len() == MAX_ENDED {
            goals.ended.pop_front();
        }
        goals.ended.push_back((live.info, response.clone()));
        drop(goals);
        self.publish_states();
        live.waiting.into_iter().for_each(|request| request.reply(&response));
    }

    fn publish_states(&self) {
        let goals = lock(&self.goals);
        let state = |live: &Live| match live.cancel.load(Ordering::Acquire) {
            true => CANCELING,
            false => EXECUTING,
        };
        let live = goals.live.iter().map(|live| (&live.info, state(live)));
        let ended = goals.ended.iter().map(|(info, response)| (info, response.status));
        let list = ended.chain(live).map(|(info, status)| GoalStatus { goal_info: info.clone(), status });
        let message = GoalStatusArray { status_list: list.collect() };
        self.status.publish(&message);
    }
}

/// A goal on its way.
struct OneGoal {
    action: Arc<Action>,
    id: Uuid,
    cancel: Arc<AtomicBool>,
    joints: Vec<String>,
}

impl OneGoal {
    fn run(mut self, goal: Result<Goal, Outcome>) {
        let outcome = match goal {
            Ok(goal) => {
                self.joints.clone_from(&goal.joints);
                follow(&self.action.way, goal, &self)
            }
            Err(outcome) => outcome,
        };
        if outcome.code != Code::Successful {
            tracing::warn!("share: ros: a goal for {} was aborted: {}", self.action.way.task, outcome.text);
        }
        self.action.finish(&self.id, outcome);
    }
}

impl Watcher for OneGoal {
    fn feedback(&self, index: i32, desired: &Values, actual: &Values) {
        let point = |values: &Values| JointTrajectoryPoint {
            positions: values.positions.clone(),
            velocities: values.velocities.clone(),
            ..JointTrajectoryPoint::default()
        };
        let less = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(a, b)| a - b).collect();
        let error = Values {
            positions: less(&desired.positions, &actual.positions),
            velocities: less(&desired.velocities, &actual.velocities),
        };
        let header = Header { stamp: Time::of(wall_now()), frame_id: String::new() };
        let feedback = Feedback {
            goal_id: self.id.clone(),
            header,
            joint_names: self.joints.clone(),
            desired: point(desired),
            actual: point(actual),
            error: point(&error),
        };
        self.action.feedback.publish_bytes(encoded_feedback(&feedback, index, self.action.distro));
    }

    fn is_cancelled(&self) -> bool {
        self.cancel.load(Ordering::Acquire)
    }

    fn has_ended(&self) -> bool {
        self.action.has_ended.load(Ordering::Acquire)
    }
}

/// Returns the bytes of a feedback. `index`: that of the point from which the motion comes.
fn encoded_feedback(feedback: &Feedback, index: i32, distro: Distro) -> Vec<u8> {
    let mut encoder = Encoder::default();
    // Since control_msgs 6.3.
    let put_index = |encoder: &mut Encoder, index: i32| match distro {
        Distro::Jazzy => {}
        Distro::Kilted | Distro::Lyrical => index.put(encoder),
    };
    feedback.put(&mut encoder);
    put_index(&mut encoder, index);
    FeedbackRest::default().put(&mut encoder);
    put_index(&mut encoder, 0);
    encoder.bytes().to_vec()
}

/// Answers the requests of actions, one after the other.
pub fn serve(actions: &[Weak<Action>], requests: Receiver<Request<OfAction>>) {
    for request in requests {
        if let Some(action) = actions.get(request.of.0).and_then(Weak::upgrade) {
            action.answer(request);
        }
    }
}

//! The streams that a run publishes, and the requests to subscribe to them.
//!
//! Each message is encoded once, by the publisher, and kept in a ring of fixed length. Every subscriber reads the ring
//! at its own pace: a slow subscriber loses its oldest messages, receives their number, and delays no other. The last
//! minutes are kept for those who subscribe later: a page that is opened after a fault shows how it came about.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tokio::sync::broadcast;

use crate::api::Method;
use dimos_core::clock::Mono;
use dimos_core::named::named;
use dimos_core::sync::lock;

/// Joint states buffered for slow readers.
const STATES_KEPT: usize = 256;
/// Events buffered for slow readers.
const EVENTS_KEPT: usize = 1024;
/// Time between joint states kept for later subscribers.
const PAST_PERIOD: Duration = Duration::from_millis(200);
/// Joint states kept for later subscribers: of 3 minutes.
const PAST_STATES: usize = 900;
/// Events kept for later subscribers.
const PAST_EVENTS: usize = 200;

named! {
    /// The streams of a run.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
    #[serde(rename_all = "snake_case")]
    pub enum Stream {
        /// One [`JointState`] per tick.
        CoordinatorJointState = "coordinator_joint_state",
        /// One [`EventReport`] per event.
        Events = "events",
    }
}

/// Parameters of `subscribe`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Subscribe {
    /// The stream.
    pub stream: Stream,
    /// Maximum rate of messages [Hz]; without it, all of them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rate: Option<f64>,
    /// First send what was published before: joint states of the last 3 minutes at 5 Hz, the last 200 events. These
    /// messages have `"past": true`.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub past: bool,
}

impl Subscribe {
    /// Subscribes to all further messages of a stream.
    pub fn to(stream: Stream) -> Self {
        Self { stream, rate: None, past: false }
    }
}

/// Reply to `subscribe`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SubscribeReply {
    /// The subscription's number on this connection.
    pub subscription: u64,
}

/// Parameters of `unsubscribe`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Unsubscribe {
    /// The subscription's number.
    pub subscription: u64,
}

impl Method for Subscribe {
    const NAME: &'static str = "subscribe";
    type Reply = SubscribeReply;

    fn check(&self) -> Result<(), String> {
        match self.rate {
            Some(rate) if !(rate.is_finite() && (0.01..=10_000.0).contains(&rate)) => {
                Err(format!("rate is {rate}, must be within 0.01–10000 Hz"))
            }
            _ => Ok(()),
        }
    }
}

impl Method for Unsubscribe {
    const NAME: &'static str = "unsubscribe";
    type Reply = crate::api::Done;
}

/// The joints of all arms after a tick: `coordinator_joint_state` of the Python dimos.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct JointState {
    /// Index of the tick.
    pub tick: u64,
    /// Wall-clock time of the tick [s since the Unix epoch].
    pub stamp: f64,
    /// The blueprint's `joint_state_frame_id`.
    pub frame_id: String,
    /// Names of the joints, in the order of the values.
    pub name: Vec<String>,
    /// Positions [rad]; null before an arm's first state.
    pub position: Vec<Option<f64>>,
    /// Velocities [rad/s]; null where unknown.
    pub velocity: Vec<Option<f64>>,
    /// Torques [Nm]; null where the arm reports none.
    pub effort: Vec<Option<f64>>,
}

/// An event of the run.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct EventReport {
    /// Index of the tick in which it happened.
    pub tick: u64,
    /// Wall-clock time of the tick [s since the Unix epoch].
    pub stamp: f64,
    /// Its severity.
    pub level: Level,
    /// Its kind, for programs: `request`, `task`, `preempted`, `mode_conflict`, `arm`, `limited`, `overrun`, `speed`,
    /// `degraded`, `guard`, `stop`, `share`.
    pub kind: String,
    /// The arm that it concerns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
    /// The task that it concerns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub task: Option<String>,
    /// The joint that it concerns.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joint: Option<String>,
    /// Description for people, without full stop.
    pub text: String,
    /// Who asked for it: `dimos stop (pid 4242, user ana)`; absent if it is not the effect of a request.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
}

/// Severity of an event.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Level {
    /// Normal operation.
    #[default]
    Info,
    /// Unexpected, but nothing ended.
    Warning,
    /// Something ended unexpectedly.
    Error,
}

/// Publishes the streams of a run. Cheap to clone; never waits for a reader.
#[derive(Debug, Clone)]
pub struct Streams {
    joint_state: Published,
    events: Published,
    /// When the next joint state is kept for later subscribers.
    due: Arc<Mutex<Mono>>,
}

impl Default for Streams {
    fn default() -> Self {
        Self {
            joint_state: Published::new(STATES_KEPT, PAST_STATES),
            events: Published::new(EVENTS_KEPT, PAST_EVENTS),
            due: Arc::default(),
        }
    }
}

impl Streams {
    /// Publishes the state of a tick; keeps it for later subscribers if [`Self::is_state_due`]. Allocates: not for the
    /// tick thread.
    pub fn publish_joint_state(&self, now: Mono, state: &JointState) {
        let keep = self.is_state_due(now);
        if keep {
            *lock(&self.due) = now.after(PAST_PERIOD);
        }
        self.joint_state.send(state, keep);
    }

    /// Returns whether the joint state has subscribers.
    pub fn has_joint_state_readers(&self) -> bool {
        self.joint_state.sender.receiver_count() > 0
    }

    /// Returns whether a joint state is to be kept for later subscribers.
    pub fn is_state_due(&self, now: Mono) -> bool {
        now >= *lock(&self.due)
    }

    /// Publishes an event, and keeps it for later subscribers. Allocates: not for the tick thread.
    pub fn publish_event(&self, event: &EventReport) {
        self.events.send(event, true);
    }

    /// Subscribes to a stream. Also returns what was published before, the oldest first: with the messages of the
    /// receiver nothing is missing, and nothing is there twice.
    pub(crate) fn reader(&self, stream: Stream) -> (Vec<Arc<str>>, broadcast::Receiver<Arc<str>>) {
        match stream {
            Stream::CoordinatorJointState => self.joint_state.reader(),
            Stream::Events => self.events.reader(),
        }
    }
}

/// One stream: its subscribers, and its past.
#[derive(Debug, Clone)]
struct Published {
    sender: broadcast::Sender<Arc<str>>,
    past: Arc<Mutex<VecDeque<Arc<str>>>>,
    /// Maximum number of messages in `past`.
    most: usize,
}

impl Published {
    fn new(kept: usize, most: usize) -> Self {
        Self { sender: broadcast::Sender::new(kept), past: Arc::default(), most }
    }

    fn send<T: Serialize>(&self, message: &T, keep: bool) {
        // These types have string keys only, so encoding cannot fail.
        let Ok(text) = serde_json::to_string(message) else { return };
        let text: Arc<str> = text.into();
        let mut past = lock(&self.past);
        if keep {
            if past.len() == self.most {
                past.pop_front();
            }
            past.push_back(text.clone());
        }
        // Fails if there is no subscriber.
        let _ = self.sender.send(text);
    }

    fn reader(&self) -> (Vec<Arc<str>>, broadcast::Receiver<Arc<str>>) {
        let past = lock(&self.past);
        (past.iter().cloned().collect(), self.sender.subscribe())
    }
}

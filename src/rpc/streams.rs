//! The streams that a run publishes, and the requests to subscribe to them.
//!
//! Each message is encoded once, by the publisher, and kept in a ring of fixed length. Every subscriber reads the ring
//! at its own pace: a slow subscriber loses its oldest messages, receives their number, and delays no other.

use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use tokio::sync::broadcast;

use super::api::Method;
use crate::named::named;

/// Joint states buffered for slow readers.
const STATES_KEPT: usize = 256;
/// Events buffered for slow readers.
const EVENTS_KEPT: usize = 1024;

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
    type Reply = super::api::Done;
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
    joint_state: broadcast::Sender<Arc<str>>,
    events: broadcast::Sender<Arc<str>>,
}

impl Default for Streams {
    fn default() -> Self {
        Self { joint_state: broadcast::Sender::new(STATES_KEPT), events: broadcast::Sender::new(EVENTS_KEPT) }
    }
}

impl Streams {
    /// Publishes the state of a tick. Calls `build` only if there are subscribers. Allocates: not for the tick thread.
    pub fn publish_joint_state(&self, build: impl FnOnce() -> JointState) {
        publish(&self.joint_state, build);
    }

    /// Returns whether the joint state has subscribers.
    pub fn has_joint_state_readers(&self) -> bool {
        self.joint_state.receiver_count() > 0
    }

    /// Publishes an event. Calls `build` only if there are subscribers. Allocates: not for the tick thread.
    pub fn publish_event(&self, build: impl FnOnce() -> EventReport) {
        publish(&self.events, build);
    }

    /// Subscribes to a stream.
    pub(super) fn reader(&self, stream: Stream) -> broadcast::Receiver<Arc<str>> {
        match stream {
            Stream::CoordinatorJointState => self.joint_state.subscribe(),
            Stream::Events => self.events.subscribe(),
        }
    }
}

fn publish<T: Serialize>(to: &broadcast::Sender<Arc<str>>, build: impl FnOnce() -> T) {
    if to.receiver_count() == 0 {
        return;
    }
    // These types have string keys only, so encoding cannot fail. Sending fails if the last subscriber has just left.
    if let Ok(text) = serde_json::to_string(&build()) {
        let _ = to.send(text.into());
    }
}

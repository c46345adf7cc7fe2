//! The run's end of the line to a planner in another process: requests go out over its connection, answers come back by
//! number. Nothing here waits longer than it says, however the process behaves: it may hang, send nonsense, or be gone.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard};
use std::time::Duration;

use serde_json::{Value, json};
use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;

use super::api::{Moment, PLANNER_REQUESTS, PlannerAnswer, PlannerRequest};
use super::error::{Code, RpcError};
use super::wire;
use crate::sync::lock;

/// Requests that may wait for the planner at once.
const WAITING: usize = 32;

type Answer = Result<Value, RpcError>;

/// The line to a planner that registered.
#[derive(Debug)]
pub struct PlannerLine {
    /// The process at the other end, if the system knows it.
    pid: Option<i32>,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    /// To the connection's writer; bounded. `None`: the connection has ended.
    queue: Option<mpsc::Sender<String>>,
    next: u64,
    waiting: HashMap<u64, oneshot::Sender<Answer>>,
}

impl PlannerLine {
    pub(super) fn new(queue: mpsc::Sender<String>, pid: Option<i32>) -> Self {
        Self { pid, state: Mutex::new(State { queue: Some(queue), next: 1, waiting: HashMap::new() }) }
    }

    /// Returns the process at the other end, if the system knows it.
    pub fn pid(&self) -> Option<i32> {
        self.pid
    }

    /// Whether the connection has ended.
    pub fn is_closed(&self) -> bool {
        self.lock().queue.is_none()
    }

    /// Sends a request to the planner and waits for its answer, at most `limit`.
    pub async fn ask(&self, method: &str, params: Value, moment: Moment, limit: Duration) -> Answer {
        let (sender, receiver) = oneshot::channel();
        let (queue, request) = {
            let mut state = self.lock();
            let Some(queue) = state.queue.clone() else { return Err(gone()) };
            if state.waiting.len() >= WAITING {
                return Err(self.silent(format!("{WAITING} requests wait for the planner already")));
            }
            let request = state.next;
            state.next += 1;
            state.waiting.insert(request, sender);
            (queue, request)
        };
        let _waiting = Waiting { line: self, request };
        let asked = PlannerRequest { request, method: method.to_owned(), params, moment };
        // A number for a subscription, which this is not.
        let line = wire::message(PLANNER_REQUESTS, 0, 0, &json!(asked).to_string());
        match queue.try_send(line) {
            Ok(()) => {}
            Err(mpsc::error::TrySendError::Full(_)) => {
                return Err(self.silent("the planner does not read what it is sent".into()));
            }
            Err(mpsc::error::TrySendError::Closed(_)) => return Err(gone()),
        }
        match timeout(limit, receiver).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(_)) => Err(gone()),
            Err(_) => Err(self.silent(format!("the planner did not answer within {:.1} s", limit.as_secs_f64()))),
        }
    }

    fn silent(&self, what: String) -> RpcError {
        let process = self.pid.map(|pid| format!(" (pid {pid})")).unwrap_or_default();
        let error = RpcError::new(Code::NoAnswer, what);
        error.hint(format!("its process{process} is live but hangs: end it, and start the planner again"))
    }

    /// Delivers the reply to the pending request; drops it if that request has timed out.
    pub(super) fn answered(&self, answer: PlannerAnswer) {
        let sender = self.lock().waiting.remove(&answer.request);
        let result = match answer.error {
            Some(error) => Err(error),
            None => Ok(answer.result.unwrap_or_default()),
        };
        if let Some(sender) = sender {
            let _ = sender.send(result);
        }
    }

    /// The connection has ended: so has all waiting.
    pub(super) fn close(&self) {
        let mut state = self.lock();
        state.queue = None;
        state.waiting.clear();
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }
}

/// A place among those who wait; given back however the waiting ends.
struct Waiting<'a> {
    line: &'a PlannerLine,
    request: u64,
}

impl Drop for Waiting<'_> {
    fn drop(&mut self) {
        self.line.lock().waiting.remove(&self.request);
    }
}

/// The planner's process has ended. A run that never had one refuses without `data`: who relied on a planner must not
/// be moved without one because it crashed.
pub fn gone() -> RpcError {
    RpcError::new(Code::NoPlanner, "the planner that was attached to this run has gone")
        .hint("start it again: `dimos run` its blueprint beside this run; `dimos move … --direct` needs none")
        .data(json!({"planner": "gone"}))
}

//! The run's side of the connection to a planner in another process: sends numbered requests and receives the answers.
//! Every wait has a timeout: the process may hang, send invalid data, or exit.

use std::collections::HashMap;
use std::sync::{Mutex, MutexGuard};
use std::time::Duration;

use serde_json::{Value, json};
use tokio::sync::{mpsc, oneshot};
use tokio::time::timeout;

use crate::api::{Moment, PLANNER_REQUESTS, PlannerAnswer, PlannerRequest};
use crate::error::{Code, RpcError};
use crate::wire;
use dimos_core::sync::lock;

/// Maximum number of pending requests.
const MAX_PENDING: usize = 32;

type Answer = Result<Value, RpcError>;

/// A registered planner in another process.
#[derive(Debug)]
pub struct PlannerProxy {
    /// The planner's process, if the system reports it.
    pid: Option<i32>,
    state: Mutex<State>,
}

#[derive(Debug)]
struct State {
    /// Bounded queue of the connection's writer; `None` after the connection has ended.
    queue: Option<mpsc::Sender<String>>,
    next: u64,
    pending: HashMap<u64, oneshot::Sender<Answer>>,
}

impl PlannerProxy {
    pub(crate) fn new(queue: mpsc::Sender<String>, pid: Option<i32>) -> Self {
        Self { pid, state: Mutex::new(State { queue: Some(queue), next: 1, pending: HashMap::new() }) }
    }

    /// Returns the planner's process, if the system reports it.
    pub fn pid(&self) -> Option<i32> {
        self.pid
    }

    /// Returns whether the connection has ended.
    pub fn is_closed(&self) -> bool {
        self.lock().queue.is_none()
    }

    /// Sends a request to the planner and waits for its answer, at most `limit`.
    pub async fn ask(&self, method: &str, params: Value, moment: Moment, limit: Duration) -> Answer {
        let (sender, receiver) = oneshot::channel();
        let (queue, request) = {
            let mut state = self.lock();
            let Some(queue) = state.queue.clone() else { return Err(gone()) };
            if state.pending.len() >= MAX_PENDING {
                return Err(self.no_answer(format!("the planner has {MAX_PENDING} pending requests already")));
            }
            let request = state.next;
            state.next += 1;
            state.pending.insert(request, sender);
            (queue, request)
        };
        let _pending = Pending { proxy: self, request };
        let asked = PlannerRequest { request, method: method.to_owned(), params, moment };
        // Not a subscription: its number and the count of lost messages are 0.
        let line = wire::message(PLANNER_REQUESTS, 0, 0, &json!(asked).to_string());
        match queue.try_send(line) {
            Ok(()) => {}
            Err(mpsc::error::TrySendError::Full(_)) => {
                return Err(self.no_answer("the planner does not read its requests".into()));
            }
            Err(mpsc::error::TrySendError::Closed(_)) => return Err(gone()),
        }
        match timeout(limit, receiver).await {
            Ok(Ok(answer)) => answer,
            Ok(Err(_)) => Err(gone()),
            Err(_) => Err(self.no_answer(format!("the planner did not answer within {:.1} s", limit.as_secs_f64()))),
        }
    }

    fn no_answer(&self, what: String) -> RpcError {
        let process = self.pid.map(|pid| format!(" (pid {pid})")).unwrap_or_default();
        let error = RpcError::new(Code::NoAnswer, what);
        error.hint(format!("its process{process} is live but hangs: end it, and start the planner again"))
    }

    /// Delivers an answer to its pending request; drops it if that request has timed out.
    pub(crate) fn deliver(&self, answer: PlannerAnswer) {
        let sender = self.lock().pending.remove(&answer.request);
        let result = match answer.error {
            Some(error) => Err(error),
            None => Ok(answer.result.unwrap_or_default()),
        };
        if let Some(sender) = sender {
            let _ = sender.send(result);
        }
    }

    /// Ends all pending requests: the connection has ended.
    pub(crate) fn close(&self) {
        let mut state = self.lock();
        state.queue = None;
        state.pending.clear();
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        lock(&self.state)
    }
}

/// A pending request; removed when dropped, also if the caller stops waiting.
struct Pending<'a> {
    proxy: &'a PlannerProxy,
    request: u64,
}

impl Drop for Pending<'_> {
    fn drop(&mut self) {
        self.proxy.lock().pending.remove(&self.request);
    }
}

/// Returns the error after the planner's process has ended. It has `data`, unlike that of a run without a planner: a
/// client that relies on planning must not fall back to direct motion because the planner crashed.
pub fn gone() -> RpcError {
    RpcError::new(Code::NoPlanner, "the planner that was attached to this run has gone")
        .hint("start it again: `dimos run` its blueprint beside this run; `dimos move … --direct` needs none")
        .data(json!({"planner": "gone"}))
}

//! Sends requests to the tick and receives their outcomes: requests are put into its ring and logged; the outcome
//! thread delivers outcomes, frees finished motions and publishes the joint state.

use std::collections::{BTreeMap, HashMap};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::{Value, json};
use tokio::sync::oneshot;

use super::asker::asker;
use super::curb::unless_ended;
use dimos_control::request::{Envelope, Goal, Motion, Request};
use dimos_control::task_robot::FramePose;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::sync::lock;
use dimos_core::telemetry::describe::Severity;
use dimos_core::telemetry::{Origin, Outcome, Who};
use dimos_core::trajectory::JointTrajectory;
use dimos_log::notes::{Note, Notes};
use dimos_rt::host;
use dimos_rt::wake::Wake;

/// Capacity of the ring of requests.
pub const REQUEST_RING: usize = 256;
/// Part of it that is reserved for requests that end motion.
const RESERVED: usize = 32;
/// Timeout for an outcome.
const ANSWER_LIMIT: Duration = Duration::from_secs(3);
/// Maximum time between two checks for finished motions.
const SWEEP: Duration = Duration::from_millis(100);

/// Sends requests to the tick. Never used by a real-time thread.
pub struct Dispatcher {
    requests: Mutex<rtrb::Producer<Envelope>>,
    waiting: Mutex<HashMap<u64, oneshot::Sender<Outcome>>>,
    next_id: AtomicU64,
    notes: Notes,
    /// Who stopped all arms (`None`), or an arm since.
    stopped_by: Mutex<BTreeMap<Option<u16>, Arc<Who>>>,
}

/// Why a request got no outcome.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum SendError {
    /// Too many requests are waiting.
    #[error("too many requests at once")]
    Full,
    /// The tick did not answer.
    #[error("the coordinator did not answer")]
    NoAnswer,
    /// What it is a part of was ended before.
    #[error("it was ended before this")]
    Ended,
}

impl Dispatcher {
    /// Creates a dispatcher for a ring.
    pub fn new(requests: rtrb::Producer<Envelope>, notes: Notes) -> Self {
        let (waiting, next_id, stopped_by) = (Mutex::default(), AtomicU64::new(1), Mutex::default());
        Self { requests: Mutex::new(requests), waiting, next_id, notes, stopped_by }
    }

    /// Returns a unique number for a motion or a request.
    pub fn next_id(&self) -> u64 {
        self.next_id.fetch_add(1, Ordering::Relaxed)
    }

    /// Sends a request; the answer comes with the tick that handles it. `log` is its log entry.
    pub fn send(&self, request: Request, log: Value) -> Result<oneshot::Receiver<Outcome>, SendError> {
        self.send_from(request, None, log)
    }

    /// Sends a request that a client made, when and by whom; `None`: it moves nothing, or later than it was requested
    /// on purpose.
    pub fn send_from(
        &self,
        request: Request,
        origin: Option<Origin>,
        log: Value,
    ) -> Result<oneshot::Receiver<Outcome>, SendError> {
        self.push(request, origin, |id, stamp| Note::Request { id, stamp, origin, json: log.to_string() })
    }

    /// Sends a motion along a trajectory to a task, and waits for its outcome.
    pub async fn execute(
        &self,
        task: u16,
        motion: Box<Motion>,
        origin: Option<Origin>,
        trajectory: Arc<JointTrajectory>,
    ) -> Result<Outcome, SendError> {
        let (number, until) = (motion.id, motion.until);
        let note = |id, stamp| Note::Execute { id, stamp, origin, task, motion: number, trajectory, until };
        answer(self.push(Request::Execute { task, motion }, origin, note)?).await
    }

    fn push(
        &self,
        request: Request,
        origin: Option<Origin>,
        note: impl FnOnce(u64, Mono) -> Note,
    ) -> Result<oneshot::Receiver<Outcome>, SendError> {
        let ends_motion = matches!(
            request,
            Request::Stop { .. }
                | Request::Cancel { .. }
                | Request::WayBlocked { .. }
                | Request::EndNative { .. }
                | Request::LeaseEnded { .. }
                | Request::Pause { on: true }
                | Request::Shutdown
        );
        let id = self.next_id();
        let who = asker();
        if let Request::Stop { arm } = request {
            self.note_stop(arm, who.clone());
        }
        let (sender, receiver) = oneshot::channel();
        // Made before the lock: a stop never waits for the text of another request.
        let note = note(id, MonotonicClock.now());
        let envelope = Envelope { id, origin, request };
        match ends_motion {
            true => self.put(envelope, sender, note, who, 0)?,
            false => unless_ended(|| self.put(envelope, sender, note, who, RESERVED)).ok_or(SendError::Ended)??,
        }
        Ok(receiver)
    }

    /// Puts a request into the ring if that has more than `least` free slots.
    fn put(
        &self,
        envelope: Envelope,
        sender: oneshot::Sender<Outcome>,
        note: Note,
        who: Option<Arc<Who>>,
        least: usize,
    ) -> Result<(), SendError> {
        let id = envelope.id;
        let mut ring = lock(&self.requests);
        if ring.slots() <= least {
            return Err(SendError::Full);
        }
        lock(&self.waiting).insert(id, sender);
        // The recorder counts notes that do not fit; without a recorder the run is shutting down.
        if let Some(who) = who {
            let _ = self.notes.send(Note::Asked { id, who });
        }
        let _ = self.notes.send(note);
        if ring.push(envelope).is_err() {
            lock(&self.waiting).remove(&id);
            return Err(SendError::Full);
        }
        Ok(())
    }

    fn note_stop(&self, arm: Option<u16>, who: Option<Arc<Who>>) {
        let mut stopped_by = lock(&self.stopped_by);
        match arm {
            Some(_) => drop(stopped_by.remove(&arm)),
            None => stopped_by.clear(),
        }
        stopped_by.extend(who.map(|who| (arm, who)));
    }

    /// Returns who stopped an arm last; `None`: this program.
    pub fn stopped_by(&self, arm: u16) -> Option<Arc<Who>> {
        let stopped_by = lock(&self.stopped_by);
        stopped_by.get(&Some(arm)).or_else(|| stopped_by.get(&None)).cloned()
    }

    /// Sends a request and waits for its outcome.
    pub async fn ask(&self, request: Request, origin: Option<Origin>, log: Value) -> Result<Outcome, SendError> {
        answer(self.send_from(request, origin, log)?).await
    }

    /// Puts a line of text into the log.
    pub fn log(&self, severity: Severity, text: String) {
        let _ = self.notes.send(Note::Log { severity, stamp: MonotonicClock.now(), text });
    }

    /// Sends a note to the recorder.
    pub fn note(&self, note: Note) {
        // The recorder counts notes that do not fit; without a recorder the run is shutting down.
        let _ = self.notes.send(note);
    }

    fn answered(&self, id: u64, outcome: Outcome) {
        if let Some(sender) = lock(&self.waiting).remove(&id) {
            // The client may have disconnected.
            let _ = sender.send(outcome);
        }
    }
}

async fn answer(answer: oneshot::Receiver<Outcome>) -> Result<Outcome, SendError> {
    match tokio::time::timeout(ANSWER_LIMIT, answer).await {
        Ok(Ok(outcome)) => Ok(outcome),
        _ => Err(SendError::NoAnswer),
    }
}

/// Returns the log entry of a request without a trajectory.
pub fn log_of(request: &Request) -> Value {
    match request {
        Request::Execute { task, motion } => json!({"execute": {"task": task, "motion": motion.id}}),
        Request::Cancel { task } => json!({"cancel": {"task": task}}),
        Request::WayBlocked { task, motion, in_time } => {
            json!({"way_blocked": {"task": task, "motion": motion, "in_time": in_time}})
        }
        Request::Servo { task, target } => json!({"servo": {"task": task, "target": target}}),
        Request::Velocity { task, target } => json!({"velocity": {"task": task, "target": target}}),
        Request::Chunk { task, start, .. } => json!({"chunk": {"task": task, "start": start.0}}),
        Request::CartesianTarget { task, goal: Goal::Pose { position, orientation } } => {
            json!({"pose": {"task": task, "position": position, "orientation": orientation}})
        }
        Request::CartesianTarget { task, goal: Goal::Twist { linear, angular, tool } } => {
            json!({"twist": {"task": task, "linear": linear, "angular": angular, "tool": tool}})
        }
        Request::Tool { task, tool: FramePose { position, orientation } } => {
            json!({"tool": {"task": task, "position": position, "orientation": orientation}})
        }
        Request::ArmTool { arm, tool: FramePose { position, orientation } } => {
            json!({"arm_tool": {"arm": arm, "position": position, "orientation": orientation}})
        }
        Request::Start { task } => json!({"start": {"task": task}}),
        Request::Stop { arm } => json!({"stop": {"arm": arm}}),
        Request::Reset { arm } => json!({"reset": {"arm": arm}}),
        // Logs of earlier versions lack `outside`.
        Request::Enabled { arm, outside: false } => json!({"ready": {"arm": arm}}),
        Request::Enabled { arm, outside } => json!({"ready": {"arm": arm, "outside": outside}}),
        Request::PrepareDisable { arm } => json!({"park": {"arm": arm}}),
        Request::EndNative { arm } => json!({"end_native": {"arm": arm}}),
        Request::Lead { arm, by } => json!({"lead": {"arm": arm, "by": by}}),
        Request::Gripper { arm, opening, force, speed } => {
            let mut order = json!({"arm": arm, "opening": opening});
            for (key, value) in [("force", force), ("speed", speed)] {
                if value.is_some() {
                    order[key] = json!(value);
                }
            }
            json!({"gripper": order})
        }
        Request::Speed { fraction } => json!({"speed": {"fraction": fraction}}),
        Request::Pause { on } => json!({"pause": {"on": on}}),
        Request::LeaseTaken { arm, client } => json!({"lease_taken": {"arm": arm, "client": client}}),
        Request::LeaseEnded { arm, client } => json!({"lease_ended": {"arm": arm, "client": client}}),
        Request::Shutdown => json!({"shutdown": {}}),
    }
}

/// The thread that receives outcomes. Ends when dropped.
pub struct OutcomeThread {
    stop: Arc<AtomicBool>,
    wake: Wake,
    thread: Option<JoinHandle<()>>,
}

impl OutcomeThread {
    /// Starts the thread `outcomes`. `publish` is called after every wake-up by a tick (`true`), and at least every 100
    /// ms.
    pub fn start(
        dispatcher: Arc<Dispatcher>,
        wake: Wake,
        mut replies: rtrb::Consumer<(u64, Outcome)>,
        mut retired: rtrb::Consumer<Box<Motion>>,
        mut publish: impl FnMut(bool) + Send + 'static,
    ) -> std::io::Result<Self> {
        let stop = Arc::new(AtomicBool::new(false));
        let (stopping, waiting) = (stop.clone(), wake.clone());
        let thread = std::thread::Builder::new().name("outcomes".into()).spawn(move || {
            // It confirms operators' stops. Without this right it has normal priority.
            let _ = host::set_fifo(host::STOP_PRIORITY);
            while !stopping.load(Ordering::Acquire) {
                let woken = waiting.wait(SWEEP);
                while let Ok((id, outcome)) = replies.pop() {
                    dispatcher.answered(id, outcome);
                }
                while retired.pop().is_ok() {}
                publish(woken);
            }
        })?;
        Ok(Self { stop, wake, thread: Some(thread) })
    }
}

impl Drop for OutcomeThread {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        self.wake.raise();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

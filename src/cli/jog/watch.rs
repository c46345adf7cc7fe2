//! What the run tells while jog drives: read on a connection and a thread of its own, so that nothing of it ever
//! delays a command.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::Context;
use serde_json::Value;

use crate::cli::exit::{Failure, Result};
use crate::rpc::api::{State, Status};
use crate::rpc::client::{Client, ClientError};
use crate::rpc::place::RunFolder;
use crate::rpc::report::{ArmReport, ArmStateReport, TaskReport};
use crate::rpc::streams::{Stream, Subscribe};
use crate::sync::lock;

/// How often the joints are read.
const STATE: Duration = Duration::from_millis(50);
/// How many readings of the joints come to one of the status.
const PER_STATUS: u32 = 5;
/// What limited a motion is shown for so long.
const RECENT: Duration = Duration::from_millis(1500);

/// What was seen of the arm last.
#[derive(Debug, Clone, Default)]
pub struct Seen {
    /// Its joints and pose.
    pub state: Option<ArmStateReport>,
    /// When those came.
    pub at: Option<Instant>,
    /// What it is ready for.
    pub arm: Option<ArmReport>,
    /// All tasks of the run.
    pub tasks: Vec<TaskReport>,
    /// What bounded the motion lately, in words.
    pub bound: Option<(String, Instant)>,
    /// Why nothing comes any more.
    pub lost: Option<Failure>,
}

/// Reads the run until it is dropped.
pub struct Watch {
    seen: Arc<Mutex<Seen>>,
    ending: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Watch {
    /// Begins to read an arm of a run.
    pub fn start(run: &str, arm: &str) -> Result<Self> {
        let mut client = Client::find(&RunFolder::standard(), Some(run))?;
        let seen = Arc::new(Mutex::new(Seen::default()));
        let ending = Arc::new(AtomicBool::new(false));
        let (arm, to, end) = (arm.to_owned(), seen.clone(), ending.clone());
        let reading = move || {
            if let Err(error) = read(&mut client, &arm, &to, &end) {
                lock(&to).lost = Some(error.into());
            }
        };
        let thread = std::thread::Builder::new().name("jog-watch".into()).spawn(reading);
        let thread = thread.context("no thread to read the run")?;
        Ok(Self { seen, ending, thread: Some(thread) })
    }

    /// What was seen last.
    pub fn seen(&self) -> Seen {
        let mut seen = lock(&self.seen);
        if seen.bound.as_ref().is_some_and(|(_, at)| at.elapsed() > RECENT) {
            seen.bound = None;
        }
        seen.clone()
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::Relaxed);
        // Only a thread that is done already is waited for: the other may wait for a run that does not answer.
        if let Some(thread) = self.thread.take().filter(JoinHandle::is_finished) {
            let _ = thread.join();
        }
    }
}

fn read(client: &mut Client, arm: &str, to: &Mutex<Seen>, ending: &AtomicBool) -> std::result::Result<(), ClientError> {
    client.call(Subscribe { stream: Stream::Events, rate: None })?;
    let mut next = Instant::now();
    for round in 0_u32.. {
        if ending.load(Ordering::Relaxed) {
            break;
        }
        let state = client.call(State {})?.arms.into_iter().find(|a| a.hardware_id == arm);
        {
            let mut seen = lock(to);
            (seen.state, seen.at) = (state, Some(Instant::now()));
        }
        if round % PER_STATUS == 0 {
            let status = client.call(Status {})?;
            let mut seen = lock(to);
            seen.arm = status.arms.into_iter().find(|a| a.hardware_id == arm);
            seen.tasks = status.tasks;
        }
        while let Some(message) = client.kept_message() {
            let mut seen = lock(to);
            if let Some(text) = bound(&message.data, &seen) {
                seen.bound = Some((text, Instant::now()));
            }
        }
        next = (next + STATE).max(Instant::now());
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
    Ok(())
}

/// What an event says about a bound of the arm's motion.
fn bound(event: &Value, seen: &Seen) -> Option<String> {
    let of = |field: &str| event.get(field).and_then(Value::as_str);
    let joint = of("joint")?;
    let ours = seen.state.as_ref().is_some_and(|state| state.joints.iter().any(|j| j.name == joint));
    (of("kind") == Some("limited") && ours).then(|| of("text").unwrap_or("limited").to_owned())
}

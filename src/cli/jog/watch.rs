//! Reads the run while jog drives, on its own connection and thread, so that it never delays a command.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use anyhow::Context;
use serde_json::Value;

use super::link;
use crate::cli::arguments;
use crate::cli::exit::{Failure, Result};
use crate::cli::lasting;
use dimos_core::sync::lock;
use dimos_rpc::api::{State, Status};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::{ArmReport, ArmStateReport, TaskReport};
use dimos_rpc::server::streams::{Stream, Subscribe};

/// Period of reading the joints.
const STATE_PERIOD: Duration = Duration::from_millis(50);
/// Readings of the joints per reading of the status.
const PER_STATUS: u32 = 5;
/// Time for which a limit is shown.
const LIMIT_DISPLAY_TIME: Duration = Duration::from_millis(1500);

/// Latest data of the arm.
#[derive(Debug, Clone, Default)]
pub struct ArmSnapshot {
    /// Its joints and pose.
    pub state: Option<ArmStateReport>,
    /// Time of their arrival.
    pub at: Option<Instant>,
    /// Its status.
    pub arm: Option<ArmReport>,
    /// All tasks of the run.
    pub tasks: Vec<TaskReport>,
    /// The latest limit of the motion, as text.
    pub bound: Option<(String, Instant)>,
    /// Why reading has ended.
    pub lost: Option<Failure>,
    /// Why nothing is read from another computer at present.
    pub away: Option<Failure>,
}

/// Reads a run until dropped.
pub struct Watch {
    seen: Arc<Mutex<ArmSnapshot>>,
    ending: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Watch {
    /// Starts reading an arm of a run.
    pub fn start(run: &str, arm: &str) -> Result<Self> {
        let mut client = arguments::connect(Some(run))?;
        let seen = Arc::new(Mutex::new(ArmSnapshot::default()));
        let ending = Arc::new(AtomicBool::new(false));
        let (arm, to, end) = (arm.to_owned(), seen.clone(), ending.clone());
        let reading = move || {
            while let Err(error) = read(&mut client, &arm, &to, &end) {
                if !lasting::is_lost(&error) {
                    lock(&to).lost = Some(error.into());
                    return;
                }
                lock(&to).away = Some(link::lost(error));
                let run = client.run().to_owned();
                let Some(back) = link::attempts(&run, || !end.load(Ordering::Relaxed)) else { return };
                client = back;
                lock(&to).away = None;
            }
        };
        let thread = std::thread::Builder::new().name("jog-watch".into()).spawn(reading);
        let thread = thread.context("no thread to read the run")?;
        Ok(Self { seen, ending, thread: Some(thread) })
    }

    /// Returns the latest data.
    pub fn seen(&self) -> ArmSnapshot {
        let mut seen = lock(&self.seen);
        if seen.bound.as_ref().is_some_and(|(_, at)| at.elapsed() > LIMIT_DISPLAY_TIME) {
            seen.bound = None;
        }
        seen.clone()
    }
}

impl Drop for Watch {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::Relaxed);
        // Joins the thread only if it has finished: it may be waiting for a run that does not answer.
        if let Some(thread) = self.thread.take().filter(JoinHandle::is_finished) {
            let _ = thread.join();
        }
    }
}

fn read(
    client: &mut Client,
    arm: &str,
    to: &Mutex<ArmSnapshot>,
    ending: &AtomicBool,
) -> std::result::Result<(), ClientError> {
    client.call(Subscribe::to(Stream::Events))?;
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
        while let Some(message) = client.buffered_message() {
            let mut seen = lock(to);
            if let Some(text) = bound(&message.data, &seen) {
                seen.bound = Some((text, Instant::now()));
            }
        }
        next = (next + STATE_PERIOD).max(Instant::now());
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
    Ok(())
}

/// Returns the limit of the arm's motion in an event.
fn bound(event: &Value, seen: &ArmSnapshot) -> Option<String> {
    let of = |field: &str| event.get(field).and_then(Value::as_str);
    let joint = of("joint")?;
    let ours = seen.state.as_ref().is_some_and(|state| state.joints.iter().any(|j| j.name == joint));
    (of("kind") == Some("limited") && ours).then(|| of("text").unwrap_or("limited").to_owned())
}

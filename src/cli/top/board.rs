//! What is known of the runs: a thread lists them, and one for each reads it, so that a run that does not answer delays
//! no other.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use anyhow::Context;

use crate::cli::arguments::{Target, connect_to, place};
use crate::cli::exit::Result;
use crate::cli::run_record::RunRecord;
use dimos_core::sync::lock;
use dimos_rpc::api::{Motion, State, Status};
use dimos_rpc::client::{Client, ClientError};
use dimos_rpc::report::{MotionReport, StateReport, StatusReport};
use dimos_rpc::run_dir::LiveRun;

/// Time between two listings of the runs.
const LIST_PERIOD: Duration = Duration::from_millis(500);
/// Runs that have ended and are still shown.
const MAX_ENDED: usize = 8;

/// What was read of a run at one time.
#[derive(Debug, Clone)]
pub struct Reading {
    /// Arms, tasks, timing.
    pub status: StatusReport,
    /// Joints.
    pub state: StateReport,
    /// The motions that tasks execute.
    pub motions: Vec<MotionReport>,
    /// When it was read.
    pub at: Instant,
}

/// A run.
#[derive(Debug, Clone)]
pub struct Seen {
    /// Its name, process and socket.
    pub run: LiveRun,
    /// The latest reading.
    pub reading: Option<Reading>,
    /// Why it is not read at present.
    pub trouble: Option<String>,
    /// When it was no longer listed, and how it ended.
    pub ended: Option<(Instant, String)>,
}

type Shared = Arc<Mutex<Seen>>;

/// The runs, read until it is dropped.
pub struct Board {
    runs: Arc<Mutex<Vec<Shared>>>,
    ending: Arc<AtomicBool>,
}

impl Board {
    /// Starts to read the runs. The error: there is none of the name that is given.
    pub fn watch(target: &Target, period: Duration) -> Result<Self> {
        let board = Self { runs: Arc::default(), ending: Arc::default() };
        update(&mut lock(&board.runs), target.named_or_all()?, period, &board.ending);
        let (runs, ending, only) = (board.runs.clone(), board.ending.clone(), target.run.clone());
        let listing = move || {
            while !ending.load(Ordering::Relaxed) {
                std::thread::sleep(LIST_PERIOD);
                // A place that does not answer ends no run there.
                let Ok(mut live) = Target::default().named_or_all() else { continue };
                live.retain(|run| only.as_ref().is_none_or(|name| run.name == *name));
                update(&mut lock(&runs), live, period, &ending);
            }
        };
        let thread = std::thread::Builder::new().name("top-list".into()).spawn(listing);
        thread.context("cannot start the thread that lists the runs")?;
        Ok(board)
    }

    /// Returns the runs: the live ones first, each by name.
    pub fn runs(&self) -> Vec<Seen> {
        let mut runs: Vec<Seen> = lock(&self.runs).iter().map(|run| lock(run).clone()).collect();
        runs.sort_by_key(|seen| (seen.ended.is_some(), seen.run.name.clone()));
        runs
    }

    /// Returns whether every run has been read, or why not is known.
    pub fn is_complete(&self) -> bool {
        self.runs().iter().all(|seen| seen.reading.is_some() || seen.trouble.is_some() || seen.ended.is_some())
    }
}

impl Drop for Board {
    fn drop(&mut self) {
        self.ending.store(true, Ordering::Relaxed);
    }
}

/// Adds the runs that are new, and marks those that are no longer live.
fn update(runs: &mut Vec<Shared>, live: Vec<LiveRun>, period: Duration, ending: &Arc<AtomicBool>) {
    let is_same = |a: &LiveRun, b: &LiveRun| a.name == b.name && a.pid == b.pid;
    for shared in runs.iter() {
        let mut seen = lock(shared);
        if !live.iter().any(|run| is_same(run, &seen.run)) {
            let since = seen.ended.as_ref().map_or_else(Instant::now, |(since, _)| *since);
            seen.ended = Some((since, end_of(&seen.run)));
        }
    }
    for run in live {
        // A run that is started again takes the place of the earlier one.
        let is_known = |shared: &Shared| {
            let seen = lock(shared);
            seen.ended.is_none() && is_same(&seen.run, &run)
        };
        if !runs.iter().any(is_known) {
            runs.retain(|shared| lock(shared).run.name != run.name);
            let shared = Arc::new(Mutex::new(Seen { run, reading: None, trouble: None, ended: None }));
            let (to, ending) = (shared.clone(), ending.clone());
            let reading = move || read(&to, period, &ending);
            if let Err(error) = std::thread::Builder::new().name("top-read".into()).spawn(reading) {
                lock(&shared).trouble = Some(format!("no thread to read it: {error}"));
            }
            runs.push(shared);
        }
    }
    let ended = runs.iter().filter(|shared| lock(shared).ended.is_some()).count();
    let mut spare = ended.saturating_sub(MAX_ENDED);
    runs.retain(|shared| {
        let removed = spare > 0 && lock(shared).ended.is_some();
        spare -= usize::from(removed);
        !removed
    });
}

/// Describes how a run ended, as far as this computer has a record of it.
fn end_of(run: &LiveRun) -> String {
    let record = RunRecord::of(&run.name).filter(|record| place().is_none() && record.pid == run.pid);
    record.and_then(|record| record.describe_end()).unwrap_or_else(|| format!("{} is not live any longer", run.name))
}

/// Reads a run until it has ended; connects again after an error.
fn read(to: &Mutex<Seen>, period: Duration, ending: &AtomicBool) {
    let run = lock(to).run.clone();
    let is_over = || ending.load(Ordering::Relaxed) || lock(to).ended.is_some();
    while !is_over() {
        let Err(error) = connect_to(&run).and_then(|mut client| {
            while !is_over() {
                let reading = once(&mut client)?;
                let mut seen = lock(to);
                (seen.reading, seen.trouble) = (Some(reading), None);
                drop(seen);
                std::thread::sleep(period);
            }
            Ok(())
        }) else {
            return;
        };
        lock(to).trouble = Some(error.to_string());
        std::thread::sleep(period);
    }
}

fn once(client: &mut Client) -> std::result::Result<Reading, ClientError> {
    let status = client.call(Status {})?;
    let state = client.call(State {})?;
    let moving = status.tasks.iter().filter(|task| task.progress.is_some() && task.state != "IDLE");
    let mut motions = Vec::new();
    for motion in moving.filter_map(|task| task.motion) {
        match client.call(Motion { motion }) {
            Ok(report) if report.done => {}
            Ok(report) => motions.push(report),
            // A run keeps the reports of its latest motions only.
            Err(ClientError::Refused(_)) => {}
            Err(error) => return Err(error),
        }
    }
    Ok(Reading { status, state, motions, at: Instant::now() })
}

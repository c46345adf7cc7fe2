//! What clients stream to the tasks of a run.

use std::sync::atomic::Ordering::{AcqRel, Relaxed, Release};
use std::sync::atomic::{AtomicBool, AtomicU64};

use dimos_rpc::report::StreamCounts;

/// The streams of clients, per task.
pub(in crate::runtime) struct Streams(Vec<Stream>);

#[derive(Debug, Default)]
struct Stream {
    /// Whether a client has sent a target since the stream was last ended for a motion.
    runs: AtomicBool,
    /// Whether anything was counted.
    counted: AtomicBool,
    actions: AtomicU64,
    late: AtomicU64,
    gripper_targets: AtomicU64,
    gripper_late: AtomicU64,
}

impl Streams {
    pub fn new(tasks: usize) -> Self {
        Self((0..tasks).map(|_| Stream::default()).collect())
    }

    fn of(&self, task: u16) -> Option<&Stream> {
        self.0.get(usize::from(task))
    }

    /// Returns the number of tasks.
    pub fn tasks(&self) -> u16 {
        self.0.len() as u16
    }

    /// Remembers that a client streams to a task.
    pub fn begin(&self, task: u16) {
        if let Some(stream) = self.of(task) {
            stream.runs.store(true, Release);
        }
    }

    /// Forgets a stream. Returns whether there was one.
    pub fn end(&self, task: u16) -> bool {
        self.of(task).is_some_and(|stream| stream.runs.swap(false, AcqRel))
    }

    /// Counts the actions of a chunk, of which some were late.
    pub fn count_actions(&self, task: u16, actions: usize, late: usize) {
        if let Some(stream) = self.of(task) {
            stream.counted.store(true, Relaxed);
            stream.actions.fetch_add(actions as u64, Relaxed);
            stream.late.fetch_add(late as u64, Relaxed);
        }
    }

    /// Counts gripper targets, of which some were late.
    pub fn count_gripper_targets(&self, task: u16, targets: usize, late: usize) {
        if let Some(stream) = self.of(task) {
            stream.counted.store(true, Relaxed);
            stream.gripper_targets.fetch_add(targets as u64, Relaxed);
            stream.gripper_late.fetch_add(late as u64, Relaxed);
        }
    }

    /// Returns the counts of a task; `None` if nothing was counted yet.
    pub fn counts(&self, task: u16) -> Option<StreamCounts> {
        let stream = self.of(task).filter(|stream| stream.counted.load(Relaxed))?;
        Some(StreamCounts {
            actions: stream.actions.load(Relaxed),
            late_actions: stream.late.load(Relaxed),
            gripper_targets: stream.gripper_targets.load(Relaxed),
            late_gripper_targets: stream.gripper_late.load(Relaxed),
        })
    }
}

//! What other threads than the tick want in the log, on its way to the recorder: in order, and bounded. Nobody waits
//! for the recorder; what it has no room for is lost and counted.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender};

use crate::clock::Mono;
use crate::telemetry::describe::Severity;
use crate::trajectory::JointTrajectory;

/// Most memory for notes that the recorder has not taken yet [bytes]: minutes of requests, dozens of the longest
/// trajectories.
const MAX_WAITING: usize = 64 << 20;
/// What a note takes besides its text [bytes].
const NOTE: usize = 128;

/// What other threads want in the log.
#[derive(Debug, Clone, PartialEq)]
pub enum Note {
    /// A request, sent before it is told to the tick.
    Request {
        /// The id that the tick answers with.
        id: u64,
        /// When it came.
        stamp: Mono,
        /// The request as it was told to the tick.
        json: String,
    },
    /// A request to follow a trajectory, sent before it is told to the tick. Logged with the tick's answer: where that
    /// is a refusal, without the points that the tick did not look at.
    Execute {
        /// The id that the tick answers with.
        id: u64,
        /// When it came.
        stamp: Mono,
        /// Index of the task.
        task: u16,
        /// The motion's number.
        motion: u64,
        /// What is to be followed.
        trajectory: Arc<JointTrajectory>,
    },
    /// A line of text.
    Log {
        /// How much it matters.
        severity: Severity,
        /// When.
        stamp: Mono,
        /// The line.
        text: String,
    },
    /// What an arm says about its present error.
    ArmText {
        /// Index of the arm.
        arm: u16,
        /// The text.
        text: String,
    },
}

impl Note {
    /// Roughly what it takes [bytes].
    fn size(&self) -> usize {
        NOTE + match self {
            Self::Request { json: text, .. } | Self::Log { text, .. } | Self::ArmText { text, .. } => text.len(),
            Self::Execute { trajectory, .. } => {
                let values = trajectory
                    .points
                    .iter()
                    .map(|p| size_of_val(p) + 8 * (p.positions.len() + p.velocities.len() + p.accelerations.len()));
                values.sum()
            }
        }
    }
}

/// Why a note is not in the log.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NoteLost {
    /// The recorder is too far behind.
    #[error("the recorder is too far behind")]
    Full,
    /// There is no recorder any more.
    #[error("the recorder has ended")]
    Ended,
}

#[derive(Debug, Default)]
struct Shared {
    waiting: AtomicUsize,
    lost: AtomicU64,
}

/// The way to the recorder. Clones lead to the same one.
#[derive(Debug, Clone)]
pub struct Notes {
    sender: Sender<Note>,
    shared: Arc<Shared>,
}

/// The recorder's end.
#[derive(Debug)]
pub struct Noted {
    receiver: Receiver<Note>,
    shared: Arc<Shared>,
}

/// A way to the recorder, and its end.
pub fn channel() -> (Notes, Noted) {
    let (sender, receiver) = std::sync::mpsc::channel();
    let shared = Arc::<Shared>::default();
    (Notes { sender, shared: shared.clone() }, Noted { receiver, shared })
}

impl Notes {
    /// Sends a note. Never waits.
    pub fn send(&self, note: Note) -> Result<(), NoteLost> {
        let size = note.size();
        if self.shared.waiting.fetch_add(size, Ordering::Relaxed) + size > MAX_WAITING {
            self.shared.waiting.fetch_sub(size, Ordering::Relaxed);
            self.shared.lost.fetch_add(1, Ordering::Relaxed);
            return Err(NoteLost::Full);
        }
        self.sender.send(note).map_err(|_| NoteLost::Ended)
    }
}

impl Noted {
    /// All that there is.
    pub(super) fn take(&self) -> Vec<Note> {
        let notes: Vec<Note> = self.receiver.try_iter().collect();
        let size = notes.iter().map(Note::size).sum();
        self.shared.waiting.fetch_sub(size, Ordering::Relaxed);
        notes
    }

    /// Notes lost since this was asked last.
    pub(super) fn lost(&self) -> u64 {
        self.shared.lost.swap(0, Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_recorder_that_takes_nothing_costs_bounded_memory_and_what_is_lost_is_counted() {
        let (notes, noted) = channel();
        let line = || Note::Log { severity: Severity::Info, stamp: Mono::ZERO, text: "x".repeat(1 << 20) };
        let sent = (0..200).filter(|_| notes.send(line()).is_ok()).count();
        assert!((32..64).contains(&sent), "{sent}");
        assert_eq!(notes.send(line()), Err(NoteLost::Full));
        assert_eq!((noted.take().len(), noted.lost(), noted.lost()), (sent, 201 - sent as u64, 0));
        notes.send(line()).unwrap();
        drop(noted);
        assert_eq!(notes.send(line()), Err(NoteLost::Ended));
    }
}

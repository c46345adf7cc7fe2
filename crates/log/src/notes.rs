//! Bounded queue of notes from other threads than the tick to the recorder. Senders never block; notes that do not fit
//! are dropped and counted.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::sync::mpsc::{Receiver, Sender};

use super::display_messages::MarkerArray;
use super::robots::LoggedRobots;
use dimos_core::arm::{IoInfo, IoState, JointStatus, Load};
use dimos_core::clock::Mono;
use dimos_core::joint::MAX_DOF;
use dimos_core::telemetry::describe::Severity;
use dimos_core::telemetry::{Origin, Who};
use dimos_core::trajectory::JointTrajectory;
use dimos_core::until::Until;

/// Maximum memory of queued notes [bytes]: minutes of requests, dozens of the longest trajectories.
const MAX_QUEUED: usize = 64 << 20;
/// Memory of a note besides its text [bytes].
const NOTE_OVERHEAD: usize = 128;

/// An entry for the log from another thread than the tick.
#[derive(Debug, Clone, PartialEq)]
pub enum Note {
    /// A request; noted before it is passed to the tick.
    Request {
        /// Id of the request.
        id: u64,
        /// Time of arrival.
        stamp: Mono,
        /// When and by whom it was requested, if the tick compares that.
        origin: Option<Origin>,
        /// The request as passed to the tick.
        json: String,
    },
    /// Who made the request that is noted next.
    Asked {
        /// Id of the request.
        id: u64,
        /// Who.
        who: Arc<Who>,
    },
    /// A trajectory request; noted before it is passed to the tick. Logged with the tick's answer: if that is a
    /// rejection, without the points that the tick did not check.
    Execute {
        /// Id of the request.
        id: u64,
        /// Time of arrival.
        stamp: Mono,
        /// As for other requests.
        origin: Option<Origin>,
        /// Index of the task.
        task: u16,
        /// Id of the motion.
        motion: u64,
        /// The trajectory.
        trajectory: Arc<JointTrajectory>,
        /// What ends it before its goal.
        until: Option<Until>,
    },
    /// A line of text.
    Log {
        /// Severity.
        severity: Severity,
        /// Time.
        stamp: Mono,
        /// The line.
        text: String,
    },
    /// Levels of an arm's inputs and outputs.
    Io {
        /// Index of the arm.
        arm: u16,
        /// When they were read.
        stamp: Mono,
        /// The channels.
        info: IoInfo,
        /// Their levels.
        state: IoState,
    },
    /// Condition of an arm's joints.
    JointStatus {
        /// Index of the arm.
        arm: u16,
        /// When it was read.
        stamp: Mono,
        /// One entry per joint.
        joints: Box<[JointStatus; MAX_DOF]>,
    },
    /// Load at an arm's flange that its controller calculates with.
    Payload {
        /// Index of the arm.
        arm: u16,
        /// When it was read.
        stamp: Mono,
        /// The load.
        load: Load,
    },
    /// The robots of the run, before its first tick.
    Robots {
        /// Time.
        stamp: Mono,
        /// The robots.
        robots: Arc<LoggedRobots>,
        /// Their description: URDF.
        description: String,
    },
    /// Objects of the world that were added, changed or removed.
    Markers {
        /// Time.
        stamp: Mono,
        /// The objects.
        markers: MarkerArray,
    },
    /// An arm's text for its current error.
    ArmText {
        /// Index of the arm.
        arm: u16,
        /// The text.
        text: String,
    },
}

impl Note {
    /// Returns its time; that of a text for an arm's error, and of who asked, is unknown.
    pub(super) fn stamp(&self) -> Mono {
        match self {
            Self::Request { stamp, .. }
            | Self::Execute { stamp, .. }
            | Self::Log { stamp, .. }
            | Self::Io { stamp, .. }
            | Self::JointStatus { stamp, .. }
            | Self::Payload { stamp, .. }
            | Self::Robots { stamp, .. }
            | Self::Markers { stamp, .. } => *stamp,
            Self::ArmText { .. } | Self::Asked { .. } => Mono::ZERO,
        }
    }

    /// Returns the id of a request.
    pub(super) fn request(&self) -> Option<u64> {
        match self {
            Self::Request { id, .. } | Self::Execute { id, .. } => Some(*id),
            _ => None,
        }
    }

    /// Returns its approximate size [bytes].
    pub(super) fn size(&self) -> usize {
        NOTE_OVERHEAD
            + match self {
                Self::Request { json: text, .. } | Self::Log { text, .. } | Self::ArmText { text, .. } => text.len(),
                Self::Asked { .. } => 0,
                Self::Robots { description, .. } => description.len(),
                Self::Markers { markers, .. } => size_of_val(markers.markers.as_slice()),
                Self::Io { .. } => size_of::<IoState>(),
                Self::Payload { .. } => size_of::<Load>(),
                Self::JointStatus { joints, .. } => size_of_val(&**joints),
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

/// Why a note was dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NoteError {
    /// The queue is full.
    #[error("the recorder is too far behind")]
    Full,
    /// The recorder has ended.
    #[error("the recorder has ended")]
    Ended,
}

#[derive(Debug, Default)]
struct Shared {
    waiting: AtomicUsize,
    lost: AtomicU64,
}

/// Sender of notes to the recorder. Clones share one queue.
#[derive(Debug, Clone)]
pub struct Notes {
    sender: Sender<Note>,
    shared: Arc<Shared>,
}

/// Receiver of the recorder.
#[derive(Debug)]
pub struct NoteReceiver {
    receiver: Receiver<Note>,
    shared: Arc<Shared>,
}

/// Creates a queue.
pub fn channel() -> (Notes, NoteReceiver) {
    let (sender, receiver) = std::sync::mpsc::channel();
    let shared = Arc::<Shared>::default();
    (Notes { sender, shared: shared.clone() }, NoteReceiver { receiver, shared })
}

impl Notes {
    /// Sends a note. Never blocks.
    pub fn send(&self, note: Note) -> Result<(), NoteError> {
        let size = note.size();
        if self.shared.waiting.fetch_add(size, Ordering::Relaxed) + size > MAX_QUEUED {
            self.shared.waiting.fetch_sub(size, Ordering::Relaxed);
            self.shared.lost.fetch_add(1, Ordering::Relaxed);
            return Err(NoteError::Full);
        }
        self.sender.send(note).map_err(|_| NoteError::Ended)
    }
}

impl NoteReceiver {
    /// Takes all queued notes.
    pub(super) fn take(&self) -> Vec<Note> {
        let notes: Vec<Note> = self.receiver.try_iter().collect();
        let size = notes.iter().map(Note::size).sum();
        self.shared.waiting.fetch_sub(size, Ordering::Relaxed);
        notes
    }

    /// Returns the number of notes dropped since the last call.
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
        assert_eq!(notes.send(line()), Err(NoteError::Full));
        assert_eq!((noted.take().len(), noted.lost(), noted.lost()), (sent, 201 - sent as u64, 0));
        notes.send(line()).unwrap();
        drop(noted);
        assert_eq!(notes.send(line()), Err(NoteError::Ended));
    }
}

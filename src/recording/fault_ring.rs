//! The last 30 s of a run that is not recorded: samples of the tick and notes as they came, until a fault makes a log
//! of them. Nothing is encoded before, so that a run without a log costs no more than it did.

use std::collections::VecDeque;
use std::mem::size_of;
use std::time::Duration;

use super::notes::Note;
use crate::clock::Mono;
use crate::telemetry::{Event, Sample};

/// What is kept before a fault.
pub const BEFORE: Duration = Duration::from_secs(30);
/// What is logged after the latest fault.
pub const AFTER: Duration = Duration::from_secs(5);
/// Maximum memory [bytes], and the part of it for notes.
const MEMORY: (usize, usize) = (64 << 20, 8 << 20);
/// Places for events.
const EVENTS: usize = 1024;

/// Returns the number of samples to keep: 30 s of them, as far as they fit into 64 MiB.
pub fn capacity(rate: f64, arms: usize) -> usize {
    let wanted = (BEFORE.as_secs_f64() * rate).ceil() as usize * (arms + 1) + EVENTS;
    wanted.min((MEMORY.0 - MEMORY.1) / size_of::<Sample>())
}

/// Samples and notes, the oldest first.
#[derive(Debug)]
pub(super) struct FaultRing {
    samples: VecDeque<Sample>,
    capacity: usize,
    notes: VecDeque<Note>,
    noted: usize,
    /// Whether it has everything since the start of the run.
    pub whole: bool,
}

impl FaultRing {
    /// Allocates the memory of the samples.
    pub fn new(capacity: usize) -> Self {
        let samples = VecDeque::with_capacity(capacity);
        Self { samples, capacity, notes: VecDeque::new(), noted: 0, whole: true }
    }

    /// Takes a note.
    pub fn note(&mut self, note: Note) {
        self.noted += note.size();
        self.notes.push_back(note);
        while self.noted > MEMORY.1 {
            self.forget_note();
        }
    }

    fn forget_note(&mut self) {
        self.noted -= self.notes.pop_front().map_or(self.noted, |note| note.size());
    }

    /// Takes a sample; the oldest is forgotten, and with a tick the notes before it.
    pub fn sample(&mut self, sample: Sample) {
        if self.samples.len() >= self.capacity.max(1) {
            self.whole = false;
            if let Some(Sample::Tick(tick)) = self.samples.pop_front() {
                while self.notes.front().is_some_and(|note| note.stamp() < tick.deadline) {
                    self.forget_note();
                }
            }
        }
        self.samples.push_back(sample);
    }

    /// Forgets the samples of a tick that is not whole. Returns the deadline of the first tick.
    pub fn begin(&mut self) -> Option<Mono> {
        if !self.whole {
            let end = self.samples.iter().position(|sample| matches!(sample, Sample::Tick(_)))?;
            self.samples.drain(..=end);
        }
        self.samples.iter().find_map(|sample| if let Sample::Tick(tick) = sample { Some(tick.deadline) } else { None })
    }

    /// Takes the next sample out, and the notes that precede it: those up to the end of the tick, and those up to the
    /// request that an event answers.
    pub fn next(&mut self) -> Option<(Vec<Note>, Sample)> {
        let sample = self.samples.pop_front()?;
        let before = match &sample {
            Sample::Tick(tick) => self.notes.iter().take_while(|note| note.stamp() <= tick.deadline).count(),
            Sample::Event(_, Event::Request(id, _)) => {
                self.notes.iter().position(|note| note.request() == Some(*id)).map_or(0, |at| at + 1)
            }
            _ => 0,
        };
        let notes: Vec<Note> = self.notes.drain(..before).collect();
        self.noted -= notes.iter().map(Note::size).sum::<usize>();
        Some((notes, sample))
    }

    /// Takes out the notes after the last sample.
    pub fn rest(&mut self) -> Vec<Note> {
        self.noted = 0;
        self.notes.drain(..).collect()
    }

    /// Forgets everything: what comes next is not the start of the run.
    pub fn clear(&mut self) {
        self.samples.clear();
        self.notes.clear();
        (self.noted, self.whole) = (0, false);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::telemetry::TickSample;
    use crate::telemetry::describe::Severity;

    #[test]
    fn thirty_seconds_of_four_arms_at_400_hz_fit_and_nothing_exceeds_64_mib() {
        assert_eq!(capacity(100.0, 1), 3000 * 2 + EVENTS);
        assert_eq!(capacity(400.0, 4), 12_000 * 5 + EVENTS);
        assert!(capacity(2000.0, 16) * size_of::<Sample>() + MEMORY.1 <= 64 << 20);
    }

    #[test]
    fn the_oldest_is_forgotten_and_the_memory_stays() {
        let mut ring = FaultRing::new(10);
        let memory = ring.samples.capacity();
        for tick in 0..100 {
            let stamp = Mono(tick * 10);
            ring.note(Note::Log { severity: Severity::Info, stamp, text: "x".repeat(1 << 20) });
            ring.sample(Sample::Tick(TickSample { tick, deadline: stamp, ..TickSample::default() }));
        }
        assert_eq!((ring.samples.capacity(), ring.samples.len()), (memory, 10));
        assert!(!ring.whole && ring.noted <= MEMORY.1 && ring.notes.len() <= 8, "{}", ring.noted);
        assert_eq!(ring.begin(), Some(Mono(910)), "the first may not be whole");
        let all: Vec<_> = std::iter::from_fn(|| ring.next()).collect();
        assert_eq!(all.len(), 9);
        assert_eq!((ring.noted, ring.rest().len()), (0, 0));
    }
}

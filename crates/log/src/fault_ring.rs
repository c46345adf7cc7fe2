//! The last 30 s of a run that is not recorded: samples of the tick and notes as they came, until a fault makes a log
//! of them. Messages are not encoded before; the samples are packed, so that 30 s of many joints at 1 kHz fit.

use std::collections::VecDeque;
use std::mem::size_of;
use std::time::Duration;

use super::notes::Note;
use super::packed_samples::Block;
use dimos_core::clock::Mono;
use dimos_core::telemetry::{Event, Sample};

/// What is kept before a fault.
pub const BEFORE: Duration = Duration::from_secs(30);
/// What is logged after the latest fault.
pub const AFTER: Duration = Duration::from_secs(5);
/// Maximum memory [bytes], and the part of it for notes.
const MEMORY: (usize, usize) = (64 << 20, 8 << 20);
/// Ticks are packed together once they have this many samples.
const TOGETHER: usize = 256;

/// Samples and notes, the oldest first.
#[derive(Debug)]
pub(super) struct FaultRing {
    /// Whole ticks.
    blocks: VecDeque<Block>,
    /// Memory of the blocks [bytes].
    packed: usize,
    /// The newest samples, not yet packed.
    newest: VecDeque<Sample>,
    /// The oldest samples, as they are taken out.
    unpacked: VecDeque<Sample>,
    notes: VecDeque<Note>,
    noted: usize,
    /// The samples up to the end of a tick belong to one that is not whole.
    partial: bool,
    /// Whether it has everything since the start of the run.
    pub whole: bool,
}

impl FaultRing {
    /// Creates an empty ring, at the start of a run.
    pub fn new() -> Self {
        Self {
            blocks: VecDeque::new(),
            packed: 0,
            newest: VecDeque::new(),
            unpacked: VecDeque::new(),
            notes: VecDeque::new(),
            noted: 0,
            partial: false,
            whole: true,
        }
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

    /// Takes a sample. Ticks that are 30 s older than the newest are forgotten, or older ones where the memory ends,
    /// and with them the notes before their end.
    pub fn sample(&mut self, sample: Sample) {
        let tick = if let Sample::Tick(tick) = &sample { Some(tick.deadline) } else { None };
        if self.partial {
            self.partial = tick.is_none();
            return;
        }
        self.newest.push_back(sample);
        let Some(now) = tick else { return };
        if self.newest.len() >= TOGETHER {
            let block = Block::pack(self.newest.drain(..));
            self.packed += block.size();
            self.blocks.push_back(block);
        }
        let most = MEMORY.0 - MEMORY.1 - 2 * TOGETHER * size_of::<Sample>();
        while let Some(oldest) = self.blocks.front().map(Block::end)
            && (self.packed > most || now.since(oldest) > BEFORE)
        {
            self.forget_block();
        }
    }

    fn forget_block(&mut self) {
        let Some(block) = self.blocks.pop_front() else { return };
        self.whole = false;
        self.packed -= block.size();
        while self.notes.front().is_some_and(|note| note.stamp() < block.end()) {
            self.forget_note();
        }
    }

    /// Returns the deadline of the first tick.
    pub fn begin(&self) -> Option<Mono> {
        let first = |sample: &Sample| if let Sample::Tick(tick) = sample { Some(tick.deadline) } else { None };
        self.blocks.front().map(Block::begin).or_else(|| self.newest.iter().find_map(first))
    }

    /// Takes the next sample out, and the notes that precede it: those up to the end of the tick, and those up to the
    /// request that an event answers.
    pub fn next(&mut self) -> Option<(Vec<Note>, Sample)> {
        if self.unpacked.is_empty() {
            match self.blocks.pop_front() {
                Some(block) => self.unpacked.extend(block.unpack()),
                None => self.unpacked.append(&mut self.newest),
            }
        }
        let sample = self.unpacked.pop_front()?;
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

    /// Forgets everything: what comes next is not the start of the run, and may be in the middle of a tick.
    pub fn clear(&mut self) {
        *self = Self { partial: true, whole: false, ..Self::new() };
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::packed_samples::tests::tick;
    use dimos_core::telemetry::TickSample;
    use dimos_core::telemetry::describe::Severity;

    /// Returns how much of 40 s it keeps [s], and its memory [MiB].
    fn kept(rate: u64, arms: u16) -> (f64, f64) {
        let mut ring = FaultRing::new();
        let (period, mut most) = (1_000_000_000 / rate, 0);
        for k in 0..40 * rate {
            tick(k, Mono(k * period), arms).into_iter().for_each(|sample| ring.sample(sample));
            most = most.max(ring.packed + ring.newest.capacity() * size_of::<Sample>());
        }
        let begin = ring.begin().unwrap_or_default();
        (Mono((40 * rate - 1) * period).since(begin).as_secs_f64(), most as f64 / f64::from(1 << 20))
    }

    #[test]
    fn thirty_seconds_of_four_arms_at_1_khz_fit_and_nothing_exceeds_the_memory() {
        let (seconds, memory) = kept(100, 1);
        assert!((30.0..32.6).contains(&seconds) && memory < 4.0, "{seconds} s, {memory} MiB");
        let (seconds, memory) = kept(1000, 4);
        assert!((30.0..30.3).contains(&seconds) && memory < 40.0, "{seconds} s, {memory} MiB");
        let (seconds, memory) = kept(1000, 16);
        assert!(seconds > 5.0 && memory < 60.0, "{seconds} s, {memory} MiB");
    }

    #[test]
    fn the_oldest_ticks_are_forgotten_with_the_notes_before_their_end() {
        let mut ring = FaultRing::new();
        let second = |tick: u64| Mono(tick * 1_000_000_000);
        for tick in 0..1000 {
            ring.note(Note::Log { severity: Severity::Info, stamp: second(tick), text: "x".repeat(1 << 20) });
            ring.sample(Sample::Tick(TickSample { tick, deadline: second(tick), ..TickSample::default() }));
        }
        assert!(!ring.whole && ring.noted <= MEMORY.1 && ring.notes.len() <= 8, "{}", ring.noted);
        // Ticks 0 to 255, 256 to 511 and 512 to 767 are whole blocks, all older than 30 s.
        assert_eq!(ring.begin(), Some(second(768)));
        let all: Vec<_> = std::iter::from_fn(|| ring.next()).collect();
        assert_eq!(all.len(), 232);
        assert_eq!((ring.noted, ring.rest().len()), (0, 0));
    }

    #[test]
    fn after_it_was_cleared_it_begins_with_a_whole_tick() {
        let mut ring = FaultRing::new();
        assert!(ring.whole);
        ring.clear();
        for k in 0..3 {
            tick(k, Mono(k), 2).into_iter().for_each(|sample| ring.sample(sample));
        }
        assert_eq!((ring.whole, ring.begin()), (false, Some(Mono(1))));
        assert_eq!(std::iter::from_fn(|| ring.next()).count(), 6);
    }
}

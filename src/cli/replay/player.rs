//! Passes the messages of a log to a view, each at its time.

use std::time::Duration;

use super::view::View;
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::recording::replay::{LogReader, Payload, ReplayError, Selection};

/// Part of a log to play, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Topics; empty for all.
    pub topics: Vec<String>,
    /// First Unix time [ns].
    pub from: u64,
    /// Last Unix time, inclusive [ns].
    pub to: u64,
    /// Speed factor.
    pub rate: f64,
    /// Repeat from the start.
    pub looping: bool,
}

/// How it ended.
#[derive(Debug, Default)]
pub struct End {
    /// The cut, if the log is truncated.
    pub cut: Option<ReplayError>,
    /// Samples lost by the recorder.
    pub lost: u64,
    /// Messages that do not match their schema.
    pub damaged: u64,
}

/// A clock that can be waited on.
pub trait Waiting: Clock {
    /// Waits until that time; returns at once if it is past.
    fn wait_until(&mut self, time: Mono);
}

/// Real time.
#[derive(Debug, Clone, Copy)]
pub struct RealTime;

impl Clock for RealTime {
    fn now(&self) -> Mono {
        MonotonicClock.now()
    }
}

impl Waiting for RealTime {
    fn wait_until(&mut self, time: Mono) {
        std::thread::sleep(time.since(self.now()));
    }
}

/// Plays a part of a log.
pub fn play(log: &mut LogReader, part: &Part, view: &mut dyn View, time: &mut dyn Waiting) -> anyhow::Result<End> {
    // A cut after the selected part does not matter.
    let reaches_end = log.info().span.is_none_or(|(_, end)| part.to >= end);
    loop {
        let mut end = End::default();
        log.select(Selection { topics: part.topics.clone(), from: part.from, to: part.to })?;
        let begun = time.now();
        let due = |log_time: u64| {
            begun.after(Duration::from_secs_f64(log_time.saturating_sub(part.from) as f64 * 1e-9 / part.rate))
        };
        let mut any = false;
        loop {
            match log.next_entry() {
                Ok(Some(entry)) => {
                    time.wait_until(due(entry.log_time));
                    end.damaged += u64::from(matches!(entry.data, Payload::Damaged { .. }));
                    view.show(&entry, time.now())?;
                    any = true;
                }
                Ok(None) => break,
                Err(cut @ ReplayError::Cut { .. }) => {
                    end.cut = Some(cut).filter(|_| reaches_end);
                    break;
                }
                Err(e) => return Err(e.into()),
            }
        }
        end.lost = log.lost();
        view.end()?;
        if !(part.looping && any) {
            return Ok(end);
        }
        // A pass takes at least the duration of its part, otherwise a short one would loop at full speed.
        time.wait_until(due(part.to));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::VirtualClock;
    use crate::recording::log_writer::LogWriter;
    use crate::recording::messages::Text;
    use crate::recording::replay::Entry;
    use std::collections::BTreeMap;
    use std::io;

    impl Waiting for VirtualClock {
        fn wait_until(&mut self, time: Mono) {
            self.advance(time.since(self.now()));
        }
    }

    /// Records what is shown and when [ms]; stops after a number of messages.
    struct Notes {
        seen: Vec<(String, u64)>,
        room: usize,
    }

    impl View for Notes {
        fn show(&mut self, entry: &Entry, now: Mono) -> io::Result<()> {
            let Payload::Text(text) = &entry.data else { panic!("{entry:?}") };
            self.seen.push((text.data.clone(), now.0 / 1_000_000));
            if self.seen.len() < self.room { Ok(()) } else { Err(io::ErrorKind::BrokenPipe.into()) }
        }
        fn end(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn a_cut_is_reported_if_the_part_reaches_it() {
        let folder = tempfile::tempdir().unwrap();
        drop(log(&folder));
        let path = folder.path().join("a.mcap");
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
        let mut log = LogReader::open(&path).unwrap();
        for (to, cut) in [(450, false), (900, true)] {
            let mut notes = Notes { seen: Vec::new(), room: 99 };
            let end = play(&mut log, &part(0, to), &mut notes, &mut VirtualClock::default()).unwrap();
            assert_eq!(end.cut.is_some(), cut, "up to {to} ms");
            assert_eq!(notes.seen.len() as u64, to / 100 + 1);
        }
    }

    /// A log with a message every 100 ms: 0, 1, … 9.
    fn log(folder: &tempfile::TempDir) -> LogReader {
        let path = folder.path().join("a.mcap");
        let mut log = LogWriter::create(std::fs::File::create(&path).unwrap(), 0, &[], BTreeMap::new()).unwrap();
        for i in 0..10 {
            log.publish("/a", 5_000_000_000 + i * 100_000_000, &Text { data: i.to_string() }).unwrap();
        }
        log.finish().unwrap();
        LogReader::open(&path).unwrap()
    }

    fn played(part: Part, room: usize) -> Vec<(String, u64)> {
        let folder = tempfile::tempdir().unwrap();
        let mut notes = Notes { seen: Vec::new(), room };
        let mut clock = VirtualClock::default();
        let end = play(&mut log(&folder), &part, &mut notes, &mut clock);
        assert_eq!(end.is_ok(), notes.seen.len() < room);
        notes.seen
    }

    fn part(from_ms: u64, to_ms: u64) -> Part {
        let ns = |ms| 5_000_000_000 + ms * 1_000_000;
        Part { topics: Vec::new(), from: ns(from_ms), to: ns(to_ms), rate: 1.0, looping: false }
    }

    #[test]
    fn messages_come_at_their_time() {
        let seen = played(part(0, 900), 99);
        assert_eq!(seen.len(), 10);
        assert_eq!(seen[9], ("9".into(), 900));
    }

    #[test]
    fn an_offset_begins_at_once_and_a_duration_ends_early() {
        assert_eq!(played(part(250, 450), 99), [("3".into(), 50), ("4".into(), 150)]);
    }

    #[test]
    fn a_rate_scales_time() {
        assert_eq!(played(Part { rate: 2.0, ..part(0, 200) }, 99).last(), Some(&("2".into(), 100)));
    }

    #[test]
    fn a_loop_begins_again() {
        let seen = played(Part { looping: true, ..part(800, 900) }, 5);
        assert_eq!(seen, [("8", 0), ("9", 100), ("8", 100), ("9", 200), ("8", 200)].map(|(t, at)| (t.into(), at)));
    }
}

//! Passes the messages of a log to a view, each at its time.

use std::io;
use std::time::Duration;

use super::view::View;
use crate::cli::output;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_log::replay::{LogReader, ReplayError, Selection};

/// A longer gap between two messages is not waited for: a clock was set [ns].
const MAX_WAIT: u64 = 3600 * 1_000_000_000;

/// Part of a log to play, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct Part {
    /// Topics; empty for all.
    pub topics: Vec<String>,
    /// First Unix time [ns].
    pub from: u64,
    /// Last Unix time, inclusive [ns].
    pub to: u64,
    /// Repeat from the start.
    pub looping: bool,
}

/// How it ended.
#[derive(Debug, Default)]
pub struct End {
    /// What the part of the log lacks.
    pub loss: Option<String>,
    /// Samples lost by the recorder.
    pub lost: u64,
    /// Whether Ctrl-C ended it.
    pub interrupted: bool,
}

/// A clock that can be waited on.
pub trait Waiting {
    /// Returns the time.
    fn time(&self) -> Mono;
    /// Waits for a key, at most until that time; returns at once if it is past.
    fn wait(&mut self, until: Option<Mono>) -> Option<Key>;
}

/// Real time.
#[derive(Debug, Clone, Copy)]
pub struct RealTime;

impl Waiting for RealTime {
    fn time(&self) -> Mono {
        MonotonicClock.now()
    }

    fn wait(&mut self, until: Option<Mono>) -> Option<Key> {
        std::thread::sleep(until.map_or(Duration::ZERO, |until| until.since(self.time())));
        None
    }
}

/// What a key asks for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Key {
    /// Pause, or continue.
    Pause,
    /// Play the next tick.
    Next,
    /// Play faster or, with `false`, slower.
    Faster(bool),
    /// End.
    End {
        /// Whether by Ctrl-C.
        interrupted: bool,
    },
}

/// How fast time passes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Pace {
    /// Factor.
    pub rate: f64,
    /// Whether it is paused.
    pub paused: bool,
    /// A time and the Unix time of the log then [ns].
    from: (Mono, u64),
}

impl Pace {
    /// Creates one that begins with the log.
    pub fn new(rate: f64, paused: bool) -> Self {
        Self { rate, paused, from: (Mono::ZERO, 0) }
    }

    /// Returns when a time of the log is due.
    fn due(&self, log_time: u64) -> Mono {
        let (from, began) = self.from;
        from.after(Duration::from_secs_f64(log_time.saturating_sub(began) as f64 * 1e-9 / self.rate))
    }

    /// Returns the time of the log now.
    fn at(&self, now: Mono) -> u64 {
        let passed = if self.paused { 0.0 } else { now.since(self.from.0).as_secs_f64() * self.rate };
        self.from.1 + (passed * 1e9) as u64
    }

    /// Waits until a time of the log. Returns `None` to continue, and otherwise whether it was
    /// interrupted.
    fn wait(&mut self, log_time: u64, view: &mut dyn View, time: &mut dyn Waiting) -> io::Result<Option<bool>> {
        loop {
            let due = (!self.paused).then(|| self.due(log_time));
            let Some(key) = time.wait(due) else { return Ok(None) };
            let now = time.time();
            self.from = (now, self.at(now).min(log_time));
            match key {
                Key::Pause => self.paused = !self.paused,
                Key::Next => {
                    self.from.1 = log_time;
                    return Ok(None);
                }
                Key::Faster(faster) => self.rate = (self.rate * if faster { 1.1 } else { 1.0 / 1.1 }).clamp(1e-3, 1e6),
                Key::End { interrupted } => return Ok(Some(interrupted)),
            }
            view.pace(self)?;
        }
    }
}

/// Waits before a log plays. Returns `None` to play, and otherwise whether it was interrupted.
pub fn delay(by: Duration, time: &mut dyn Waiting) -> Option<bool> {
    let until = time.time().after(by);
    loop {
        match time.wait(Some(until)) {
            None => return None,
            Some(Key::End { interrupted }) => return Some(interrupted),
            // There is nothing to pause yet.
            Some(_) => {}
        }
    }
}

/// Plays a part of a log.
pub fn play(
    log: &mut LogReader,
    part: &Part,
    mut pace: Pace,
    view: &mut dyn View,
    time: &mut dyn Waiting,
) -> anyhow::Result<End> {
    view.pace(&pace)?;
    loop {
        let mut end = End::default();
        log.select(Selection { topics: part.topics.clone(), from: part.from, to: part.to })?;
        pace.from = (time.time(), part.from);
        // Messages of one time are one step.
        let mut shown = None;
        loop {
            match log.next_entry() {
                Ok(Some(entry)) => {
                    let gap = entry.log_time.saturating_sub(shown.unwrap_or(part.from));
                    if gap > MAX_WAIT {
                        let hours = gap as f64 / 3.6e12;
                        output::note(format_args!(
                            "note: the log has nothing for {hours:.0} h: that is not waited for"
                        ));
                        pace.from = (time.time(), entry.log_time);
                    }
                    if shown != Some(entry.log_time)
                        && let Some(interrupted) = pace.wait(entry.log_time, view, time)?
                    {
                        view.end()?;
                        return Ok(End { interrupted, ..End::default() });
                    }
                    view.show(&entry, time.time())?;
                    shown = Some(entry.log_time);
                }
                Ok(None) => break,
                // It is in the loss.
                Err(ReplayError::Cut { .. } | ReplayError::Damaged { .. }) => {}
                Err(e) => return Err(e.into()),
            }
        }
        (end.lost, end.loss) = (log.lost(), log.loss().text());
        view.end()?;
        if !(part.looping && shown.is_some()) {
            return Ok(end);
        }
        // A pass takes at least the duration of its part, otherwise a short one would loop at full speed.
        if let Some(interrupted) = pace.wait(part.to, view, time)? {
            return Ok(End { interrupted, ..end });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::clock::VirtualClock;
    use dimos_log::log_writer::LogWriter;
    use dimos_log::messages::Text;
    use dimos_log::replay::{Entry, Payload};
    use std::collections::BTreeMap;

    impl Waiting for VirtualClock {
        fn time(&self) -> Mono {
            self.now()
        }

        fn wait(&mut self, until: Option<Mono>) -> Option<Key> {
            self.advance(until.map_or(Duration::ZERO, |until| until.since(self.now())));
            None
        }
    }

    /// Keys, each after a time [ms].
    struct Typed {
        clock: VirtualClock,
        keys: Vec<(u64, Key)>,
    }

    impl Waiting for Typed {
        fn time(&self) -> Mono {
            self.clock.now()
        }

        fn wait(&mut self, until: Option<Mono>) -> Option<Key> {
            let next = self.keys.first().map(|(at, key)| (Mono(at * 1_000_000), *key));
            match (until, next) {
                (Some(until), Some((at, _))) if until < at => self.clock.wait(Some(until)),
                (Some(until), None) => self.clock.wait(Some(until)),
                (None, None) => panic!("waits forever"),
                (_, Some((at, key))) => {
                    self.clock.wait(Some(at));
                    self.keys.remove(0);
                    Some(key)
                }
            }
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
            let end =
                play(&mut log, &part(0, to), Pace::new(1.0, false), &mut notes, &mut VirtualClock::default()).unwrap();
            assert_eq!(end.loss.is_some(), cut, "up to {to} ms");
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
        played_at(1.0, part, room)
    }

    fn played_at(rate: f64, part: Part, room: usize) -> Vec<(String, u64)> {
        let folder = tempfile::tempdir().unwrap();
        let mut notes = Notes { seen: Vec::new(), room };
        let mut clock = VirtualClock::default();
        let end = play(&mut log(&folder), &part, Pace::new(rate, false), &mut notes, &mut clock);
        assert_eq!(end.is_ok(), notes.seen.len() < room);
        notes.seen
    }

    fn part(from_ms: u64, to_ms: u64) -> Part {
        let ns = |ms| 5_000_000_000 + ms * 1_000_000;
        Part { topics: Vec::new(), from: ns(from_ms), to: ns(to_ms), looping: false }
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
        assert_eq!(played_at(2.0, part(0, 200), 99).last(), Some(&("2".into(), 100)));
    }

    fn typed(paused: bool, keys: &[(u64, Key)]) -> (Vec<(String, u64)>, End) {
        let folder = tempfile::tempdir().unwrap();
        let mut notes = Notes { seen: Vec::new(), room: 99 };
        let mut time = Typed { clock: VirtualClock::default(), keys: keys.to_vec() };
        let end = play(&mut log(&folder), &part(0, 300), Pace::new(1.0, paused), &mut notes, &mut time).unwrap();
        (notes.seen, end)
    }

    #[test]
    fn keys_pause_step_and_change_the_rate() {
        let at = |all: &[(&str, u64)]| all.iter().map(|(t, at)| ((*t).to_owned(), *at)).collect::<Vec<_>>();
        // A pause of a second in the middle of a wait.
        let (seen, _) = typed(false, &[(150, Key::Pause), (1150, Key::Pause)]);
        assert_eq!(seen, at(&[("0", 0), ("1", 100), ("2", 1200), ("3", 1300)]));
        // Started paused: one step, another one, then on.
        let (seen, _) = typed(true, &[(500, Key::Next), (700, Key::Next), (900, Key::Pause)]);
        assert_eq!(seen, at(&[("0", 500), ("1", 700), ("2", 1000), ("3", 1100)]));
        let (seen, _) = typed(false, &[(100, Key::Faster(true)), (100, Key::Faster(false)), (100, Key::Faster(true))]);
        assert_eq!(seen.iter().map(|(_, at)| *at).collect::<Vec<_>>(), [0, 100, 190, 281]);
        let (seen, end) = typed(true, &[(20, Key::End { interrupted: true })]);
        assert!(seen.is_empty() && end.interrupted);
    }

    #[test]
    fn a_delay_is_waited_for_unless_a_key_ends_it() {
        let delayed = |keys: &[(u64, Key)]| {
            let mut time = Typed { clock: VirtualClock::default(), keys: keys.to_vec() };
            (delay(Duration::from_millis(500), &mut time), time.clock.now().0 / 1_000_000)
        };
        assert_eq!(delayed(&[(100, Key::Pause), (200, Key::Faster(true))]), (None, 500));
        assert_eq!(delayed(&[(300, Key::End { interrupted: true })]), (Some(true), 300));
    }

    #[test]
    fn a_loop_begins_again() {
        let seen = played(Part { looping: true, ..part(800, 900) }, 5);
        assert_eq!(seen, [("8", 0), ("9", 100), ("8", 100), ("9", 200), ("8", 200)].map(|(t, at)| (t.into(), at)));
    }
}

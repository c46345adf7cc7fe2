//! Random access to the messages of a log by time: for viewers, which show a window of a long log at once, with few
//! messages of each topic. Only the chunks that are shown are read.

use std::collections::HashMap;
use std::path::Path;

use super::records::ReplayError;
use super::scan::{Item, LogChannel, RawMessage, Scan};

/// A log, with the index of its chunks in memory.
pub struct LogWindows {
    scan: Scan,
}

impl LogWindows {
    /// Opens a log. Uses the index of a closed one; of another one it reads everything once, up to a cut.
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        let mut scan = Scan::open(path)?;
        scan.learn_all()?;
        Ok(Self { scan })
    }

    /// Takes note of what a live run has written since then; returns whether it was live.
    pub fn refresh(&mut self) -> Result<bool, ReplayError> {
        let was_live = self.scan.source.refresh()?;
        if was_live {
            self.scan.describe()?;
            self.scan.learn_all()?;
        }
        Ok(was_live)
    }

    /// Returns the Unix times of its first and last message [ns]; `None` without messages.
    pub fn span(&self) -> Option<(u64, u64)> {
        self.scan.source.span()
    }

    /// Returns whether a live run was writing it when it was read last.
    pub fn is_live(&self) -> bool {
        self.scan.is_live()
    }

    /// Returns what it lacks, as far as it was read; `None` if it is whole or live.
    pub fn loss(&self) -> Option<String> {
        self.scan.loss_of((0, u64::MAX)).text()
    }

    /// Returns its topics.
    pub fn topics(&self) -> impl Iterator<Item = &str> {
        self.scan.channels.values().map(|channel| channel.topic.as_str())
    }

    /// Reads the messages of topics between two Unix times [ns], until `take` returns `false`. The window is divided
    /// into `points` sections of equal length; only the first message of each topic is read in each. 0: all messages.
    pub fn read(
        &mut self,
        topics: &[&str],
        (from, to): (u64, u64),
        points: u64,
        mut take: impl FnMut(&RawMessage, &LogChannel, &[u8]) -> bool,
    ) -> Result<(), ReplayError> {
        let step = to.saturating_sub(from).checked_div(points).unwrap_or(0);
        let wanted = self.scan.channels.iter().filter(|(_, channel)| topics.contains(&channel.topic.as_str()));
        // When the next message of each channel is due.
        let mut due: HashMap<u16, u64> = wanted.map(|(id, _)| (*id, from)).collect();
        self.scan.restart((from, to));
        loop {
            self.scan.skip(|scan, block| {
                let channels = block.channels.as_deref().unwrap_or_default().iter();
                let mut ids = channels.filter_map(|id| Some(scan.channel_of(block.file, *id)?.0));
                !ids.any(|id| due.get(&id).is_some_and(|due| *due <= block.end))
            });
            // What is damaged is noted, and read as far as possible.
            let Some(item) = self.scan.next_item()? else { return Ok(()) };
            let Item::Messages = item else { continue };
            for (message, channel, bytes) in self.scan.messages() {
                let Some(due) = due.get_mut(&message.channel).filter(|due| **due <= message.time) else { continue };
                if message.time > to {
                    continue;
                }
                if let Some(passed) = (message.time - from).checked_div(step) {
                    *due = from.saturating_add((passed + 1).saturating_mul(step));
                }
                if !take(message, channel, bytes) {
                    return Ok(());
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs::File;

    use super::*;
    use crate::PART;
    use crate::files::{mark_as_being_written, part as part_of};
    use crate::log_writer::LogWriter;
    use crate::messages::Text;

    const SECOND: u64 = 1_000_000_000;

    fn text(log: &mut LogWriter<File>, topic: &str, time: u64) {
        log.publish(topic, time, &Text { data: time.to_string() }).unwrap();
    }

    /// A log of 100 s with ten messages a second on `/fast`, and one on `/rare` after 42 s; every chunk is a second.
    fn write(path: &Path) -> LogWriter<File> {
        let mut log = LogWriter::create(File::create(path).unwrap(), 0, &[], BTreeMap::new()).unwrap();
        for i in 0..1000 {
            text(&mut log, "/fast", SECOND + i * SECOND / 10);
            if i == 420 {
                text(&mut log, "/rare", SECOND + i * SECOND / 10);
            }
            log.flush_if_due(dimos_core::clock::Mono(i * SECOND / 10)).unwrap();
        }
        log
    }

    fn times(log: &mut LogWindows, topic: &str, window: (u64, u64), points: u64) -> Vec<u64> {
        let mut times = Vec::new();
        let take = |message: &RawMessage, channel: &LogChannel, _: &[u8]| {
            assert_eq!(channel.topic, topic);
            times.push(message.time);
            true
        };
        log.read(&[topic], window, points, take).unwrap();
        times
    }

    fn check(log: &mut LogWindows) {
        assert_eq!(log.span(), Some((SECOND, SECOND + 999 * SECOND / 10)));
        let (from, to) = (20 * SECOND, 30 * SECOND);
        let all = times(log, "/fast", (from, to), 0);
        assert_eq!((all.len(), all[0], all[100]), (101, from, to));
        let few = times(log, "/fast", (from, to), 5);
        assert_eq!(few, [20, 22, 24, 26, 28, 30].map(|s| s * SECOND));
        assert_eq!(times(log, "/rare", (0, u64::MAX), 7), [43 * SECOND]);
        assert_eq!(times(log, "/fast", (200 * SECOND, 300 * SECOND), 5), [0_u64; 0]);
        assert_eq!(times(log, "/unknown", (0, u64::MAX), 0), [0_u64; 0]);
        let mut taken = 0;
        let stop_at_three = |_: &RawMessage, _: &LogChannel, _: &[u8]| {
            taken += 1;
            taken < 3
        };
        log.read(&["/fast"], (0, u64::MAX), 0, stop_at_three).unwrap();
        assert_eq!(taken, 3);
    }

    #[test]
    fn a_window_of_a_closed_log_has_evenly_spaced_messages() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mcap");
        write(&path).finish().unwrap();
        let mut log = LogWindows::open(&path).unwrap();
        check(&mut log);
        assert!(log.scan.source.blocks.len() > 100, "{}", log.scan.source.blocks.len());
        assert!(log.loss().is_none() && !log.is_live());
        // Windows that end at the end of the log, read everything, or nothing are no measure of it.
        for (window, points) in [((0, u64::MAX), 3), ((90 * SECOND, u64::MAX), 0), ((0, u64::MAX), 0), ((5, 6), 0)] {
            times(&mut log, "/fast", window, points);
            assert_eq!(log.loss(), None, "{window:?} {points}");
        }
    }

    #[test]
    fn a_cut_log_is_read_up_to_the_cut() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mcap");
        write(&path).finish().unwrap();
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..bytes.len() - 1]).unwrap();
        check(&mut LogWindows::open(&path).unwrap());
        std::fs::write(&path, &bytes[..bytes.len() / 3]).unwrap();
        let log = LogWindows::open(&path).unwrap();
        let (start, end) = log.span().unwrap();
        assert!(start == SECOND && end < 90 * SECOND && log.loss().is_some(), "{end} {:?}", log.loss());
    }

    #[test]
    fn the_log_of_a_live_run_grows() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mcap");
        let mut writer = write(&path);
        let lock = File::options().append(true).open(&path).unwrap();
        mark_as_being_written(&lock);
        let mut log = LogWindows::open(&path).unwrap();
        let before = log.span().unwrap().1;
        assert!(log.is_live() && log.loss().is_none());
        text(&mut writer, "/fast", 200 * SECOND);
        writer.flush_soon();
        writer.flush_if_due(dimos_core::clock::Mono(500 * SECOND)).unwrap();
        assert!(log.refresh().unwrap() && before < 200 * SECOND);
        assert_eq!(log.span().unwrap().1, 200 * SECOND);
        assert_eq!(times(&mut log, "/fast", (150 * SECOND, u64::MAX), 0), [200 * SECOND]);
    }

    #[test]
    fn the_log_of_a_live_run_continues_in_another_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.mcap");
        let about = |part: Option<u32>| {
            let run = BTreeMap::from([("run".to_owned(), "r".to_owned())]);
            run.into_iter().chain(part.map(|part| (PART.to_owned(), part.to_string()))).collect::<BTreeMap<_, _>>()
        };
        let begin = |path: &Path, part| {
            let file = File::create(path).unwrap();
            mark_as_being_written(&file);
            LogWriter::create(file, 0, &[], about(part)).unwrap()
        };
        let mut writer = begin(&path, None);
        text(&mut writer, "/fast", SECOND);
        writer.flush_soon();
        writer.flush_if_due(dimos_core::clock::Mono(SECOND)).unwrap();
        let mut log = LogWindows::open(&path).unwrap();
        for part in 1..4 {
            let next = part_of(&path, part);
            writer.continues_in(next.file_name().unwrap().to_str().unwrap().to_owned()).unwrap();
            drop(writer.finish().unwrap());
            writer = begin(&next, Some(part));
            text(&mut writer, "/fast", (1 + u64::from(part)) * SECOND);
            writer.flush_soon();
            writer.flush_if_due(dimos_core::clock::Mono(SECOND)).unwrap();
            assert!(log.refresh().unwrap() && log.is_live() && log.loss().is_none(), "{part}: {:?}", log.loss());
            assert_eq!(times(&mut log, "/fast", (0, u64::MAX), 0).len(), 1 + part as usize);
        }
        drop(writer.finish().unwrap());
        assert!(log.refresh().unwrap() && !log.is_live());
        assert!(!log.refresh().unwrap() && log.loss().is_none(), "{:?}", log.loss());
    }
}

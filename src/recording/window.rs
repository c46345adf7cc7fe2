//! Random access to the messages of a log by time: for viewers, which show a window of a long log at once, with few
//! messages of each topic. Only the chunks that are shown are read.

use std::collections::HashMap;
use std::path::{Path, PathBuf};

use mcap::parse_record;
use mcap::records::{Record, op};

use super::entries::message;
use super::records::{RecordReader, ReplayError, chunk_header, unpack_chunk};
use super::scan::{Item, LogChannel, RawMessage, Scan};

/// A log, with the index of its chunks in memory.
pub struct LogWindows {
    path: PathBuf,
    scan: Scan,
    /// In order of their first message.
    chunks: Vec<Chunk>,
    /// Where the part without an index that was not read yet begins [bytes]; `None`: the file has an index.
    next: Option<u64>,
    cut: Option<String>,
}

struct Chunk {
    start: u64,
    end: u64,
    at: u64,
    channels: Box<[u16]>,
}

impl LogWindows {
    /// Opens a log. Uses the index of a closed one; of another one it reads everything once, up to a cut.
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        let mut scan = Scan::open(path)?;
        let mut chunks = Vec::new();
        if let Some(start) = scan.records.summary_start()? {
            scan.records.go_to(start)?;
            while let Ok(Some(record)) = scan.records.next_record() {
                scan.learn(record.opcode, &record.body);
                if let Ok(Record::ChunkIndex(index)) = parse_record(record.opcode, &record.body) {
                    let channels: Box<[u16]> = index.message_index_offsets.keys().copied().collect();
                    let (start, end) = (index.message_start_time, index.message_end_time);
                    chunks.push(Chunk { start, end, at: index.chunk_start_offset, channels });
                }
            }
        }
        let mut log = Self { path: path.to_owned(), scan, chunks, next: None, cut: None };
        if log.chunks.is_empty() || log.chunks.iter().any(|chunk| chunk.channels.is_empty() && chunk.end > 0) {
            log.chunks.clear();
            log.scan.records.rewind()?;
            log.index()?;
        }
        log.sort();
        Ok(log)
    }

    /// Takes note of what a live run has written since then; returns whether it was live.
    pub fn refresh(&mut self) -> Result<bool, ReplayError> {
        let (Some(next), true) = (self.next, self.scan.is_live()) else { return Ok(false) };
        self.scan.records = RecordReader::open(&self.path)?.with_attachments();
        self.scan.records.go_to(next)?;
        self.index()?;
        self.sort();
        Ok(true)
    }

    fn sort(&mut self) {
        // One without messages has no times.
        self.chunks.retain(|chunk| !chunk.channels.is_empty());
        self.chunks.sort_by_key(|chunk| chunk.start);
    }

    /// Reads on to the end of the file, and notes the chunks.
    fn index(&mut self) -> Result<(), ReplayError> {
        self.cut = None;
        loop {
            let record = match self.scan.records.next_record() {
                Ok(Some(record)) => record,
                Ok(None) => break,
                Err(ReplayError::Cut { at, reason, .. }) => {
                    self.cut = Some(format!("it ends at byte {at}: {reason}"));
                    break;
                }
                Err(e) => return Err(e),
            };
            if record.opcode != op::CHUNK {
                self.scan.learn(record.opcode, &record.body);
                continue;
            }
            let mut channels = Vec::new();
            let scan = &mut self.scan;
            let unpacked = unpack_chunk(&record.body, |opcode, body| match message(opcode, body) {
                Some((header, _)) if !channels.contains(&header.channel_id) => channels.push(header.channel_id),
                Some(_) => {}
                None => scan.learn(opcode, body),
            });
            match chunk_header(&record.body) {
                Ok(header) if unpacked.is_ok() => self.chunks.push(Chunk {
                    start: header.message_start_time,
                    end: header.message_end_time,
                    at: record.at,
                    channels: channels.into(),
                }),
                _ => self.cut = Some(format!("it is damaged at byte {}", record.at)),
            }
        }
        self.next = Some(self.scan.position().0);
        Ok(())
    }

    /// Returns the Unix times of its first and last message [ns]; `None` without messages.
    pub fn span(&self) -> Option<(u64, u64)> {
        Some((self.chunks.first()?.start, self.chunks.iter().map(|chunk| chunk.end).max()?))
    }

    /// Returns whether a live run was writing it when it was read last.
    pub fn is_live(&self) -> bool {
        self.next.is_some() && self.scan.is_live()
    }

    /// Returns what it lacks; `None` if it is whole or live.
    pub fn loss(&self) -> Option<&str> {
        self.cut.as_deref().filter(|_| !self.scan.is_live())
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
        self.scan.part = (from, to);
        self.scan.damage.clear();
        for chunk in &self.chunks {
            let any = chunk.channels.iter().any(|id| due.get(id).is_some_and(|due| *due <= chunk.end));
            if !any || chunk.start > to {
                continue;
            }
            // One that is damaged has no messages.
            self.scan.chunks = Some([chunk.at].into());
            while let Some(item) = self.scan.next_item()? {
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
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs::File;

    use super::*;
    use crate::recording::files::mark_as_being_written;
    use crate::recording::log_writer::LogWriter;
    use crate::recording::messages::Text;

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
            log.flush_if_due(crate::clock::Mono(i * SECOND / 10)).unwrap();
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
        assert!(log.next.is_none() && log.chunks.len() > 100, "the index of the file is used");
        assert!(log.loss().is_none() && !log.is_live());
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
        writer.flush_if_due(crate::clock::Mono(500 * SECOND)).unwrap();
        assert!(log.refresh().unwrap() && before < 200 * SECOND);
        assert_eq!(log.span().unwrap().1, 200 * SECOND);
        assert_eq!(times(&mut log, "/fast", (150 * SECOND, u64::MAX), 0), [200 * SECOND]);
    }
}

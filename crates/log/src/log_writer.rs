//! Writes typed messages to an MCAP file, with the profile that strict readers expect.
//!
//! The file only grows at its end: whatever was flushed remains readable.

use std::collections::{BTreeMap, HashMap};
use std::io::{Seek, Write};
use std::path::Path;
use std::time::Duration;

use mcap::records::{MessageHeader, Metadata};
use mcap::{Attachment, Compression, McapResult, WriteOptions};

use super::CONTINUES;
use super::cdr::Encoder;
use super::long_log::LongLog;
use super::wire::Message;
use dimos_core::clock::Mono;

/// Maximum time that messages are buffered.
pub const FLUSH_EVERY: Duration = Duration::from_millis(100);
/// A chunk of this length is closed before the next flush is due [bytes].
const CHUNK_SIZE: u64 = 768 * 1024;

/// QoS of every channel, as written by rosbag2: keep last 10, reliable, volatile. `ros2 bag play` offers this.
const QOS: &str = "- history: 1
  depth: 10
  reliability: 1
  durability: 2
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 9223372036
    nsec: 854775807
  liveliness: 1
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false
";

/// Topics whose last message every late reader gets: `ros2 bag play` offers them as transient local.
const LATCHED: [&str; 2] = ["/robot_description", "/tf_static"];

/// A file attached to a log, such as the blueprint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LogAttachment {
    /// File name.
    pub name: String,
    /// Media type, e.g. `application/yaml`.
    pub media_type: String,
    /// Contents.
    pub data: Vec<u8>,
}

/// An open log. Dropping it closes it like `finish`, but ignores errors.
pub struct LogWriter<W: Write + Seek> {
    mcap: LongLog<W>,
    channels: HashMap<String, Channel>,
    topics: Topics,
    encoder: Encoder,
    flush: FlushTimer,
    written: u64,
}

/// Topics in the order of their channels, each with name and text of its schema.
pub(super) type Topics = Vec<(String, &'static str, fn() -> String)>;

struct Channel {
    id: u16,
    sequence: u32,
}

impl<W: Write + Seek> LogWriter<W> {
    /// Creates a log. Header, attachments and metadata (named `dimos`) come first, so that they survive a crash. `now`
    /// is in Unix time [ns].
    pub fn create(
        sink: W,
        now: u64,
        attachments: &[LogAttachment],
        metadata: BTreeMap<String, String>,
    ) -> McapResult<Self> {
        Self::create_with(sink, now, attachments, metadata, true)
    }

    /// The same with or without compression.
    pub fn create_with(
        sink: W,
        now: u64,
        attachments: &[LogAttachment],
        metadata: BTreeMap<String, String>,
        compress: bool,
    ) -> McapResult<Self> {
        let options = WriteOptions::new()
            .profile("ros2")
            .library(concat!("dimos/", env!("CARGO_PKG_VERSION")))
            .chunk_size(Some(CHUNK_SIZE))
            .compression(compress.then_some(Compression::Zstd))
            // Chunks of 100 ms are too short for higher compression levels to help.
            .compression_level(1)
            // Worker threads would compete with the tick; seeking back would leave half a chunk after a crash.
            .compression_threads(0)
            .disable_seeking(true);
        let mut mcap = LongLog::create(options, sink)?;
        for a in attachments {
            mcap.attach(&Attachment {
                log_time: now,
                create_time: now,
                name: a.name.clone(),
                media_type: a.media_type.clone(),
                data: a.data.as_slice().into(),
            })?;
        }
        mcap.write_metadata(&Metadata { name: "dimos".into(), metadata })?;
        mcap.flush()?;
        Ok(Self {
            mcap,
            channels: HashMap::new(),
            topics: Topics::new(),
            encoder: Encoder::default(),
            flush: FlushTimer::default(),
            written: 0,
        })
    }

    /// Keeps the indexes of a long log in this folder, in a file without a name; otherwise they stay in memory.
    pub fn keep_indexes_in(&mut self, folder: &Path) {
        self.mcap.keep_indexes_in(folder);
    }

    /// Declares a topic, so that it is listed even without messages.
    pub fn announce<M: Message>(&mut self, topic: &str) -> McapResult<()> {
        self.add(topic, M::SCHEMA, M::schema_text)
    }

    /// Declares the topics of an earlier file of the same log: they have the same channels in all files.
    pub(super) fn announce_all(&mut self, topics: &Topics) -> McapResult<()> {
        topics.iter().try_for_each(|(topic, name, text)| self.add(topic, name, *text))
    }

    /// Returns the topics so far.
    pub(super) fn topics(&self) -> &Topics {
        &self.topics
    }

    fn add(&mut self, topic: &str, name: &'static str, text: fn() -> String) -> McapResult<()> {
        if !self.channels.contains_key(topic) {
            let schema = self.mcap.add_schema(name, text().as_bytes())?;
            let durability = if LATCHED.contains(&topic) { "durability: 1" } else { "durability: 2" };
            let qos = QOS.replace("durability: 2", durability);
            let metadata = BTreeMap::from([("offered_qos_profiles".to_owned(), qos)]);
            let id = self.mcap.add_channel(schema, topic, metadata)?;
            self.channels.insert(topic.to_owned(), Channel { id, sequence: 0 });
            self.topics.push((topic.to_owned(), name, text));
        }
        Ok(())
    }

    /// Writes a message at a Unix time [ns].
    pub fn publish<M: Message>(&mut self, topic: &str, time: u64, message: &M) -> McapResult<()> {
        self.announce::<M>(topic)?;
        let Some(channel) = self.channels.get_mut(topic) else { return Ok(()) };
        self.encoder.restart();
        message.put(&mut self.encoder);
        let header =
            MessageHeader { channel_id: channel.id, sequence: channel.sequence, log_time: time, publish_time: time };
        // The first message on a topic is flushed at once.
        self.flush.urgent |= channel.sequence == 0;
        channel.sequence = channel.sequence.wrapping_add(1);
        self.mcap.write(&header, self.encoder.bytes())?;
        self.written += 1;
        self.flush.pending = true;
        Ok(())
    }

    /// Passes everything to the operating system if a flush is due, so that it survives the end of this process.
    /// Returns whether it flushed.
    pub fn flush_if_due(&mut self, now: Mono) -> McapResult<bool> {
        let due = self.flush.due(now);
        if due {
            self.mcap.flush()?;
        }
        Ok(due)
    }

    /// Makes the next `flush_if_due` flush: the current messages are important.
    pub fn flush_soon(&mut self) {
        self.flush.urgent = true;
    }

    /// Returns the number of messages written.
    pub fn written(&self) -> u64 {
        self.written
    }

    /// Notes the name of the file that continues the log: without that file, readers know what is missing.
    pub(super) fn continues_in(&mut self, name: String) -> McapResult<()> {
        let metadata = BTreeMap::from([(CONTINUES.to_owned(), name)]);
        self.mcap.write_metadata(&Metadata { name: CONTINUES.to_owned(), metadata })
    }

    /// Closes the log: indexes, statistics, summary. Returns the sink.
    pub fn finish(self) -> McapResult<W> {
        self.mcap.finish()
    }
}

/// Decides when to flush: at once if urgent, otherwise every [`FLUSH_EVERY`], and only if there is something to flush.
#[derive(Debug, Default)]
struct FlushTimer {
    last: Mono,
    pending: bool,
    urgent: bool,
}

impl FlushTimer {
    fn due(&mut self, now: Mono) -> bool {
        let due = self.pending && (self.urgent || now.since(self.last) >= FLUSH_EVERY);
        if due {
            *self = Self { last: now, pending: false, urgent: false };
        }
        due
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::messages::Text;
    use std::io::Cursor;
    use std::sync::{Arc, Mutex};

    /// A sink that remains visible while the writer owns it: what the operating system would hold after a crash.
    #[derive(Clone, Default)]
    struct Shared(Arc<Mutex<Cursor<Vec<u8>>>>);

    impl Write for Shared {
        fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
            self.0.lock().unwrap().write(bytes)
        }
        fn flush(&mut self) -> std::io::Result<()> {
            Ok(())
        }
    }

    impl Seek for Shared {
        fn seek(&mut self, to: std::io::SeekFrom) -> std::io::Result<u64> {
            self.0.lock().unwrap().seek(to)
        }
    }

    fn readable(sink: &Shared) -> usize {
        let bytes = sink.0.lock().unwrap().get_ref().clone();
        mcap::MessageStream::new(&bytes).unwrap().take_while(Result::is_ok).count()
    }

    #[test]
    fn the_first_message_of_a_topic_is_on_disk_at_once_and_the_others_after_100_ms() {
        let sink = Shared::default();
        let mut log = LogWriter::create(sink.clone(), 0, &[], BTreeMap::new()).unwrap();
        let say = |log: &mut LogWriter<Shared>, topic| log.publish(topic, 1, &Text { data: "x".into() }).unwrap();
        let at = |ms: u64| Mono(ms * 1_000_000);
        assert!(!log.flush_if_due(at(1005)).unwrap(), "nothing to flush yet");
        say(&mut log, "/a");
        assert!(log.flush_if_due(at(1010)).unwrap());
        assert_eq!(readable(&sink), 1);
        say(&mut log, "/a");
        assert!(!log.flush_if_due(at(1109)).unwrap());
        assert!(log.flush_if_due(at(1110)).unwrap());
        assert_eq!(readable(&sink), 2);
        say(&mut log, "/b");
        assert!(log.flush_if_due(at(1111)).unwrap());
        say(&mut log, "/b");
        assert!(!log.flush_if_due(at(1112)).unwrap());
        log.flush_soon();
        assert!(log.flush_if_due(at(1113)).unwrap());
        assert_eq!(readable(&sink), 4);
        assert!(!log.flush_if_due(at(5000)).unwrap(), "nothing new");
    }

    #[test]
    fn a_part_of_a_log_without_a_summary_is_read_without_unpacking_the_rest() {
        use crate::records::{RecordReader, ReplayError};
        use crate::replay::{LogReader, Selection};
        let (folder, sink) = (tempfile::tempdir().unwrap(), Shared::default());
        let mut log = LogWriter::create(sink.clone(), 0, &[], BTreeMap::new()).unwrap();
        for time in 1..=5 {
            log.publish("/a", time, &Text { data: "x".into() }).unwrap();
            log.flush_soon();
            log.flush_if_due(Mono(time)).unwrap();
        }
        let path = folder.path().join("log.mcap");
        let mut bytes = sink.0.lock().unwrap().get_ref().clone();
        std::fs::write(&path, &bytes).unwrap();
        let mut records = RecordReader::open(&path).unwrap();
        let all = std::iter::from_fn(|| records.next_record().ok().flatten());
        let chunks: Vec<_> = all.filter(|record| record.opcode == mcap::records::op::CHUNK).collect();
        // Damage in the third of five chunks shows whether it is unpacked.
        bytes[chunks[2].at as usize + 9 + chunks[2].body.len() - 3] ^= 0xff;
        std::fs::write(&path, &bytes).unwrap();
        // The span is that of the heads.
        assert_eq!(LogReader::open(&path).unwrap().info().span, Some((1, 5)));
        let mut end = LogReader::open_for(&path, &["/a"]).unwrap();
        assert_eq!(end.info().span, Some((1, 5)));
        end.select(Selection { from: 4, ..Selection::default() }).unwrap();
        let times: Vec<_> =
            std::iter::from_fn(|| end.next_entry().map(|e| e.map(|e| e.log_time)).transpose()).collect();
        assert!(matches!(times[..], [Ok(4), Ok(5), Err(ReplayError::Cut { .. })]), "{times:?}");
    }

    /// One writer after the other in one file: what is read is what one of them would have written.
    #[test]
    fn a_long_log_is_indexed_as_a_short_one() {
        use crate::replay::{LogReader, Selection};
        const MESSAGES: u64 = 9000;
        let folder = tempfile::tempdir().unwrap();
        let files = [None, Some(folder.path())].map(|indexes| {
            let path = folder.path().join(if indexes.is_some() { "long.mcap" } else { "plain.mcap" });
            let attachment = LogAttachment { name: "b".into(), media_type: "text/plain".into(), data: b"x".to_vec() };
            let sink = std::fs::File::create(&path).unwrap();
            let mut log = LogWriter::create(sink, 7, &[attachment], BTreeMap::new()).unwrap();
            indexes.into_iter().for_each(|folder| log.keep_indexes_in(folder));
            for time in 1..=MESSAGES {
                let topic = if time % 3 == 0 { "/b" } else { "/a" };
                log.publish(topic, time, &Text { data: time.to_string() }).unwrap();
                if time == 5000 {
                    log.announce::<Text>("/later").unwrap();
                }
                log.flush_soon();
                log.flush_if_due(Mono(time)).unwrap();
            }
            log.finish().unwrap();
            path
        });
        let [plain, long] = files.each_ref().map(|path| std::fs::read(path).unwrap());
        let summaries = [&plain, &long].map(|bytes| mcap::Summary::read(bytes).unwrap().unwrap());
        let [whole, joined] = summaries.each_ref();
        assert_eq!(joined.stats, whole.stats);
        assert_eq!((&joined.channels, &joined.schemas), (&whole.channels, &whole.schemas));
        assert_eq!((joined.chunk_indexes.len(), joined.attachment_indexes.len()), (9000, 1));
        let found = mcap::read::attachment(&long, &joined.attachment_indexes[0]).unwrap();
        assert_eq!(found.name, "b");
        let every = |bytes: &[u8]| {
            let all = mcap::MessageStream::new(bytes).unwrap().map(Result::unwrap);
            all.map(|m| (m.channel.topic.clone(), m.sequence, m.log_time, m.data.to_vec())).collect::<Vec<_>>()
        };
        assert_eq!(every(&long), every(&plain));
        for index in &joined.chunk_indexes {
            assert_eq!(joined.stream_chunk(&long, index).unwrap().filter(Result::is_ok).count(), 1);
        }
        let mut log = LogReader::open(&files[1]).unwrap();
        log.select(Selection { from: 8999, topics: vec!["/a".into()], ..Selection::default() }).unwrap();
        assert_eq!(log.next_entry().unwrap().map(|entry| entry.log_time), Some(8999));
    }

    #[test]
    fn a_finished_log_has_profile_statistics_metadata_and_attachment() {
        let blueprint =
            LogAttachment { name: "b.yaml".into(), media_type: "application/yaml".into(), data: b"name: x".to_vec() };
        let metadata = BTreeMap::from([("run".to_owned(), "x".to_owned())]);
        let mut log = LogWriter::create(Cursor::new(Vec::new()), 7, &[blueprint], metadata).unwrap();
        log.publish("/a", 9, &Text { data: "x".into() }).unwrap();
        log.announce::<Text>("/b").unwrap();
        let bytes = log.finish().unwrap().into_inner();
        let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
        let stats = summary.stats.as_ref().unwrap();
        assert_eq!((stats.message_count, stats.channel_count, stats.schema_count), (1, 2, 1));
        assert_eq!((stats.message_start_time, stats.message_end_time), (9, 9));
        let found = mcap::read::attachment(&bytes, &summary.attachment_indexes[0]).unwrap();
        assert_eq!((found.name.as_str(), &found.data[..]), ("b.yaml", &b"name: x"[..]));
        let metadata = mcap::read::metadata(&bytes, &summary.metadata_indexes[0]).unwrap();
        assert_eq!(metadata.metadata["run"], "x");
        let mut records = mcap::read::LinearReader::new(&bytes).unwrap();
        let Some(Ok(mcap::records::Record::Header(header))) = records.next() else { panic!("no header") };
        assert_eq!(header.profile, "ros2");
    }
}

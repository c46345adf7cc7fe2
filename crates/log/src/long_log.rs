//! An MCAP file of any length in constant memory.
//!
//! The library's writer keeps the index of every chunk until it closes the file: 0.5 kB for each, ten times a second,
//! 0.4 GB a day. Every [`CHUNKS`] chunks another writer takes its place in the same file. What the one before would
//! write at the end is kept: the indexes of its chunks in a file without a name, the rest in memory.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use mcap::records::{MessageHeader, Metadata, Statistics, op};
use mcap::{Attachment, MAGIC, McapResult, WriteOptions, Writer};
use rustix::fs::{self, Mode, OFlags};

use super::chunk::walk;
use dimos_core::sync::lock;

/// Chunks of one writer: two minutes of a log.
const CHUNKS: u32 = 1024;
/// Length of the body of the last record [bytes].
const FOOTER: u64 = 20;

/// Writes an MCAP file.
pub(super) struct LongLog<W: Write + Seek> {
    mcap: Writer<Tap<W>>,
    tap: Tap<W>,
    options: WriteOptions,
    schemas: Vec<(String, Vec<u8>)>,
    channels: Vec<(u16, String, BTreeMap<String, String>)>,
    /// Chunks of this writer, about.
    chunks: u32,
    /// The folder for what is kept; without one, the indexes stay in memory.
    folder: Option<PathBuf>,
    earlier: Option<Earlier>,
}

impl<W: Write + Seek> LongLog<W> {
    pub fn create(options: WriteOptions, sink: W) -> McapResult<Self> {
        let tap = Tap(Arc::new(Mutex::new(Tapped { sink, caught: None })));
        let mcap = options.clone().create(tap.clone())?;
        let (schemas, channels) = (Vec::new(), Vec::new());
        Ok(Self { mcap, tap, options, schemas, channels, chunks: 0, folder: None, earlier: None })
    }

    /// Keeps the indexes of chunks in this folder, in a file without a name.
    pub fn keep_indexes_in(&mut self, folder: &Path) {
        self.folder = Some(folder.to_owned());
    }

    pub fn add_schema(&mut self, name: &str, text: &[u8]) -> McapResult<u16> {
        let id = self.mcap.add_schema(name, "ros2msg", text)?;
        if usize::from(id) > self.schemas.len() {
            self.schemas.push((name.to_owned(), text.to_owned()));
        }
        Ok(id)
    }

    /// Adds a channel that is not there yet.
    pub fn add_channel(&mut self, schema: u16, topic: &str, metadata: BTreeMap<String, String>) -> McapResult<u16> {
        let id = self.mcap.add_channel(schema, topic, "cdr", &metadata)?;
        self.channels.push((schema, topic.to_owned(), metadata));
        Ok(id)
    }

    pub fn attach(&mut self, attachment: &Attachment<'_>) -> McapResult<()> {
        self.mcap.attach(attachment)
    }

    pub fn write_metadata(&mut self, metadata: &Metadata) -> McapResult<()> {
        self.mcap.write_metadata(metadata)
    }

    pub fn write(&mut self, header: &MessageHeader, data: &[u8]) -> McapResult<()> {
        self.mcap.write_to_known_channel(header, data)
    }

    /// Ends the chunk and passes everything to the sink.
    pub fn flush(&mut self) -> McapResult<()> {
        self.mcap.flush()?;
        self.chunks += 1;
        match &self.folder {
            Some(folder) if self.chunks >= CHUNKS => {
                self.chunks = 0;
                if self.earlier.is_none() {
                    // Without a file for them the indexes stay in memory; the next attempt is in two minutes.
                    self.earlier = Earlier::create(folder).ok();
                }
                if self.earlier.is_some() { self.replace_writer() } else { Ok(()) }
            }
            _ => Ok(()),
        }
    }

    /// Lets another writer continue the file. No chunk is open.
    fn replace_writer(&mut self) -> McapResult<()> {
        self.tap.catch();
        let next = self.next_writer();
        // Its beginning is in the file already.
        self.tap.catch();
        let ended = next.and_then(|next| std::mem::replace(&mut self.mcap, next).finish());
        let caught = self.tap.release();
        let stats = ended?.stats.unwrap_or_default();
        self.earlier.as_mut().map_or(Ok(()), |earlier| Ok(earlier.add(&caught, &stats)?))
    }

    fn next_writer(&self) -> McapResult<Writer<Tap<W>>> {
        let mut next = self.options.clone().create(self.tap.clone())?;
        // In the same order they get the same ids.
        for (name, text) in &self.schemas {
            next.add_schema(name, "ros2msg", text)?;
        }
        for (schema, topic, metadata) in &self.channels {
            next.add_channel(*schema, topic, "cdr", metadata)?;
        }
        Ok(next)
    }

    /// Closes the file: indexes, statistics, summary. Returns the sink.
    pub fn finish(mut self) -> McapResult<W> {
        if let Some(mut earlier) = self.earlier.take() {
            self.mcap.flush()?;
            self.tap.catch();
            let ended = self.mcap.finish();
            let caught = self.tap.release();
            earlier.add(&caught, &ended?.stats.unwrap_or_default())?;
            earlier.write(&mut lock(&self.tap.0).sink)?;
        } else {
            self.mcap.finish()?;
        }
        drop(self.mcap.into_inner());
        let tapped = Arc::into_inner(self.tap.0).map(Mutex::into_inner);
        let tapped = tapped.ok_or_else(|| io::Error::other("the log is still being written"))?;
        let mut sink = tapped.unwrap_or_else(std::sync::PoisonError::into_inner).sink;
        sink.flush()?;
        Ok(sink)
    }
}

/// A sink of several writers. What is written while it catches does not reach the file.
struct Tap<W>(Arc<Mutex<Tapped<W>>>);

struct Tapped<W> {
    sink: W,
    caught: Option<Vec<u8>>,
}

impl<W> Clone for Tap<W> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<W> Tap<W> {
    /// Catches from now on.
    fn catch(&self) {
        lock(&self.0).caught = Some(Vec::new());
    }

    /// Returns what was caught; the rest reaches the file.
    fn release(&self) -> Vec<u8> {
        lock(&self.0).caught.take().unwrap_or_default()
    }
}

impl<W: Write> Write for Tap<W> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let Tapped { sink, caught } = &mut *lock(&self.0);
        match caught {
            Some(caught) => caught.write(bytes),
            None => sink.write(bytes),
        }
    }

    fn flush(&mut self) -> io::Result<()> {
        lock(&self.0).sink.flush()
    }
}

impl<W: Seek> Seek for Tap<W> {
    fn seek(&mut self, to: SeekFrom) -> io::Result<u64> {
        lock(&self.0).sink.seek(to)
    }
}

/// What the writers so far would have written at the end.
struct Earlier {
    stats: Statistics,
    /// Records by opcode. Each writer has all schemas and channels.
    records: BTreeMap<u8, Vec<u8>>,
    chunk_indexes: BufWriter<File>,
}

impl Earlier {
    fn create(folder: &Path) -> io::Result<Self> {
        let folder = if folder.as_os_str().is_empty() { Path::new(".") } else { folder };
        let flags = OFlags::TMPFILE | OFlags::RDWR | OFlags::CLOEXEC;
        let chunk_indexes = BufWriter::new(File::from(fs::open(folder, flags, Mode::RUSR | Mode::WUSR)?));
        Ok(Self { stats: Statistics::default(), records: BTreeMap::new(), chunk_indexes })
    }

    /// Takes what a writer has written at its end.
    fn add(&mut self, caught: &[u8], stats: &Statistics) -> io::Result<()> {
        self.records.retain(|opcode, _| !matches!(*opcode, op::SCHEMA | op::CHANNEL));
        let mut kept = Ok(());
        // Its own records: they do not break off.
        let _ = walk(caught.strip_suffix(MAGIC).unwrap_or(caught), |opcode, body| match opcode {
            op::CHUNK_INDEX if kept.is_ok() => kept = self.chunk_indexes.write_all(&record(opcode, body)),
            op::SCHEMA | op::CHANNEL | op::ATTACHMENT_INDEX | op::METADATA_INDEX => {
                self.records.entry(opcode).or_default().extend(record(opcode, body));
            }
            _ => {}
        });
        kept?;
        let all = &mut self.stats;
        let span = |s: &Statistics| (s.message_count > 0).then_some((s.message_start_time, s.message_end_time));
        let spans = span(all).into_iter().chain(span(stats));
        let span = spans.reduce(|(a, b), (from, to)| (a.min(from), b.max(to)));
        (all.message_start_time, all.message_end_time) = span.unwrap_or_default();
        all.message_count += stats.message_count;
        (all.schema_count, all.channel_count) = (stats.schema_count, stats.channel_count);
        all.attachment_count += stats.attachment_count;
        all.metadata_count += stats.metadata_count;
        all.chunk_count += stats.chunk_count;
        for (channel, count) in &stats.channel_message_counts {
            *all.channel_message_counts.entry(*channel).or_default() += count;
        }
        Ok(())
    }

    /// Ends the file.
    fn write(mut self, sink: &mut (impl Write + Seek)) -> McapResult<()> {
        // No checksum of all data: each chunk and attachment has its own.
        sink.write_all(&record(op::DATA_END, &0_u32.to_le_bytes()))?;
        let start = sink.stream_position()?;
        let (mut at, mut crc) = (start, crc32fast::Hasher::new());
        let mut offsets: Vec<u8> = Vec::new();
        self.records.insert(op::STATISTICS, record(op::STATISTICS, &bytes(&self.stats)));
        for opcode in
            [op::SCHEMA, op::CHANNEL, op::STATISTICS, op::CHUNK_INDEX, op::ATTACHMENT_INDEX, op::METADATA_INDEX]
        {
            let begin = at;
            let mut put = |bytes: &[u8]| {
                crc.update(bytes);
                at += bytes.len() as u64;
                sink.write_all(bytes)
            };
            match opcode {
                op::CHUNK_INDEX => copy(&mut self.chunk_indexes, &mut put)?,
                _ => put(self.records.get(&opcode).map_or(&[][..], Vec::as_slice))?,
            }
            if at > begin {
                let group = [&[opcode][..], &begin.to_le_bytes(), &(at - begin).to_le_bytes()].concat();
                offsets.extend(record(op::SUMMARY_OFFSET, &group));
            }
        }
        let footer = [&[op::FOOTER][..], &FOOTER.to_le_bytes(), &start.to_le_bytes(), &at.to_le_bytes()].concat();
        crc.update(&offsets);
        crc.update(&footer);
        for part in [&offsets, &footer, &crc.finalize().to_le_bytes()[..], MAGIC] {
            sink.write_all(part)?;
        }
        Ok(())
    }
}

fn record(opcode: u8, body: &[u8]) -> Vec<u8> {
    [&[opcode][..], &(body.len() as u64).to_le_bytes(), body].concat()
}

fn bytes(stats: &Statistics) -> Vec<u8> {
    let counts = &stats.channel_message_counts;
    let counts: Vec<u8> =
        counts.iter().flat_map(|(id, n)| { id.to_le_bytes() }.into_iter().chain(n.to_le_bytes())).collect();
    let mut all = stats.message_count.to_le_bytes().to_vec();
    all.extend(stats.schema_count.to_le_bytes());
    for count in [stats.channel_count, stats.attachment_count, stats.metadata_count, stats.chunk_count] {
        all.extend(count.to_le_bytes());
    }
    all.extend(stats.message_start_time.to_le_bytes());
    all.extend(stats.message_end_time.to_le_bytes());
    all.extend((counts.len() as u32).to_le_bytes());
    all.extend(counts);
    all
}

/// Passes on all of a file.
fn copy(file: &mut BufWriter<File>, put: &mut impl FnMut(&[u8]) -> io::Result<()>) -> io::Result<()> {
    file.flush()?;
    let mut from = BufReader::new(file.get_ref());
    from.seek(SeekFrom::Start(0))?;
    let mut buffer = vec![0; 1 << 16];
    loop {
        match from.read(&mut buffer)? {
            0 => return Ok(()),
            length => put(&buffer[..length])?,
        }
    }
}

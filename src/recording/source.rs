//! All files of a log, and where their messages are in order of time.
//!
//! The heads of all records are the index: it is complete whatever a writer left out of its own. That of the file only
//! shows which chunks need not be unpacked, and where reading continues after damage.

use std::collections::BTreeMap;
use std::path::Path;

use mcap::parse_record;
use mcap::records::{Record, op};

use super::chunk::Chunk;
use super::records::{Damage, Head, RawRecord, RecordReader, ReplayError};
use super::source_files;

/// Consecutive messages outside of chunks are read together up to this length [bytes].
const PIECE: u64 = 256 * 1024;

/// A chunk, or messages outside of chunks.
pub struct Block {
    /// Index of its file.
    pub file: usize,
    /// Where it is in the file [bytes].
    pub at: u64,
    until: u64,
    /// Unix times of its first and last message [ns].
    pub start: u64,
    /// See `start`.
    pub end: u64,
    /// Channels of its messages; `None`: not known until it is read.
    pub channels: Option<Box<[u16]>>,
    in_chunk: bool,
}

impl Block {
    /// Returns its length in the file [bytes].
    pub fn length(&self) -> u64 {
        self.until - self.at
    }

    /// Returns whether it may have messages: an empty chunk has no times.
    pub fn has_times(&self) -> bool {
        !self.in_chunk || self.end > 0
    }
}

/// Chunks by their position in a file, with the times and channels that its own index gives. The last entry, where the
/// summary begins, has none.
type Index = BTreeMap<u64, Option<((u64, u64), Box<[u16]>)>>;

/// A file, and how far its heads were read.
struct File {
    records: RecordReader,
    at: u64,
    closed: bool,
}

/// The files of a log.
pub struct Source {
    files: Vec<File>,
    /// In order of their first messages.
    pub blocks: Vec<Block>,
    /// File, position and kind of attachments and metadata.
    pub others: Vec<(usize, u64, u8)>,
    /// Records outside of chunks that describe messages: file, kind, contents.
    pub outside: Vec<(usize, u8, Vec<u8>)>,
    /// Damage between the records.
    pub damage: Vec<Damage>,
    /// Why a file ends early.
    pub cut: Option<(Box<Path>, u64, String)>,
}

impl Source {
    /// Opens a log: a file with those that continue it, or a folder.
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        let found = source_files::of(path)?;
        let mut log = Self {
            files: Vec::new(),
            blocks: Vec::new(),
            others: Vec::new(),
            outside: Vec::new(),
            damage: found.missing.into_iter().map(missing).collect(),
            cut: None,
        };
        for path in found.files {
            let records = RecordReader::open(&path)?.with_attachments();
            log.files.push(File { at: records.position().0, records, closed: false });
            log.walk(log.files.len() - 1)?;
        }
        log.sort();
        Ok(log)
    }

    /// Reads on what a live run has written since then; returns whether it was live.
    pub fn refresh(&mut self) -> Result<bool, ReplayError> {
        let (true, Some(last)) = (self.is_live(), self.files.last_mut()) else { return Ok(false) };
        last.records = RecordReader::open(last.records.path())?.with_attachments();
        self.cut = None;
        self.walk(self.files.len() - 1)?;
        self.sort();
        Ok(true)
    }

    fn sort(&mut self) {
        self.blocks.sort_by_key(|block| (block.start, block.file, block.at));
    }

    /// Reads the heads of a file.
    fn walk(&mut self, file: usize) -> Result<(), ReplayError> {
        let Some(of) = self.files.get_mut(file) else { return Ok(()) };
        let records = &mut of.records;
        let index = index(records)?;
        records.go_to(of.at)?;
        let path = records.path().to_owned();
        loop {
            let mut damaged = |at: u64, span, reason: &str| {
                let path = path.clone();
                self.damage.push(Damage { path, at, span, reason: reason.to_owned(), kept: false });
            };
            let head = match records.next_head() {
                Ok(Some(head)) => head,
                Ok(None) => break,
                Err(ReplayError::Cut { at, reason, path }) => {
                    let Some((next, _)) = index.range(at + 1..).next() else {
                        self.cut = Some((path.into(), at, reason));
                        break;
                    };
                    damaged(at, index.get(&at).and_then(|chunk| Some(chunk.as_ref()?.0)), &reason);
                    records.go_to(*next)?;
                    continue;
                }
                Err(e) => return Err(e),
            };
            // A record that covers the beginning of another one has a wrong length.
            if index.range(head.at + 1..head.end).next().is_some() {
                if let Some(next) = covered(records, &index, &head)? {
                    damaged(head.at, head.span(), "the length of the record is wrong");
                    records.go_to(next)?;
                    continue;
                }
                records.go_to(head.end)?;
            }
            match head.opcode {
                op::CHUNK | op::MESSAGE => {
                    let own = index.get(&head.at).and_then(Option::as_ref);
                    let own = own.filter(|(span, channels)| Some(*span) == head.span() && !channels.is_empty());
                    add(&mut self.blocks, file, &head, own.map(|(_, channels)| channels.clone()));
                }
                op::ATTACHMENT | op::METADATA => self.others.push((file, head.at, head.opcode)),
                op::HEADER | op::SCHEMA | op::CHANNEL | op::STATISTICS => {
                    records.go_to(head.at)?;
                    if let Some(record) = records.next_record()? {
                        self.outside.push((file, record.opcode, record.body));
                    }
                }
                op::FOOTER => {
                    of.closed = true;
                    break;
                }
                _ => {}
            }
            of.at = head.end;
        }
        Ok(())
    }

    /// Returns whether all files were closed properly.
    pub fn is_complete(&self) -> bool {
        self.files.iter().all(|file| file.closed)
    }

    /// Returns whether a live run was writing the last file when it was read last.
    pub fn is_live(&self) -> bool {
        self.files.last().is_some_and(|file| file.records.is_live())
    }

    /// Returns the Unix times of the first and last message [ns]; `None` without messages.
    pub fn span(&self) -> Option<(u64, u64)> {
        let blocks = || self.blocks.iter().filter(|block| block.has_times());
        Some((blocks().map(|block| block.start).min()?, blocks().map(|block| block.end).max()?))
    }

    /// Returns whether the blocks of each file are in order of time: channels are then described before their messages.
    pub fn is_in_order(&self) -> bool {
        self.blocks.is_sorted_by_key(|block| (block.file, block.at))
    }

    /// Reads a block: passes on the records in it. Returns its damage.
    pub fn read(
        &mut self,
        index: usize,
        mut each: impl FnMut(usize, u8, &[u8]),
    ) -> Result<Option<Damage>, ReplayError> {
        let Some(block) = self.blocks.get(index) else { return Ok(None) };
        let Some(File { records, .. }) = self.files.get_mut(block.file) else { return Ok(None) };
        records.go_to(block.at)?;
        while records.position().0 < block.until {
            let Some(record) = records.next_record()? else { break };
            if record.opcode != op::CHUNK {
                each(block.file, record.opcode, &record.body);
                continue;
            }
            let (mut chunk, mut kept) = (Chunk::open(&record.body), false);
            chunk.each(|opcode, body| {
                kept = true;
                each(block.file, opcode, body);
            });
            let (path, at) = (records.path().to_owned(), record.at);
            let span = Some((block.start, block.end)).filter(|_| block.has_times());
            return Ok(chunk.damage.map(|reason| Damage { path, at, span, reason, kept }));
        }
        Ok(None)
    }

    /// Reads blocks whose channels are not known, and notes them, until `enough`. Passes on what is in them.
    pub fn learn(
        &mut self,
        mut each: impl FnMut(usize, u8, &[u8]) -> bool,
        known: impl Fn(&Block) -> bool,
    ) -> Result<(), ReplayError> {
        // In the order of the files: channels are described before their messages.
        let mut order: Vec<usize> = (0..self.blocks.len()).collect();
        order.sort_by_key(|index| self.blocks.get(*index).map(|block| (block.file, block.at)));
        for index in order {
            if self.blocks.get(index).is_some_and(&known) {
                continue;
            }
            let (mut channels, mut enough) = (Vec::new(), false);
            self.read(index, |file, opcode, body| {
                if let (op::MESSAGE, Some(id)) = (opcode, body.first_chunk::<2>()) {
                    let id = u16::from_le_bytes(*id);
                    if !channels.contains(&id) {
                        channels.push(id);
                    }
                }
                enough |= each(file, opcode, body);
            })?;
            if let Some(block) = self.blocks.get_mut(index) {
                block.channels = Some(channels.into());
            }
            if enough {
                break;
            }
        }
        Ok(())
    }

    /// Reads an attachment or metadata.
    pub fn other(&mut self, (file, at, _): (usize, u64, u8)) -> Result<Option<RawRecord>, ReplayError> {
        let Some(File { records, .. }) = self.files.get_mut(file) else { return Ok(None) };
        records.go_to(at)?;
        records.next_record()
    }

    /// Returns the path of a file.
    pub fn path(&self, file: usize) -> &Path {
        self.files.get(file).map_or(Path::new(""), |file| file.records.path())
    }

    /// Returns the length of all files [bytes].
    pub fn length(&self) -> u64 {
        self.files.iter().map(|file| file.records.position().1).sum()
    }
}

fn missing(path: std::path::PathBuf) -> Damage {
    let reason = format!("{}, which metadata.yaml names, is missing", path.display());
    Damage { path, at: 0, span: None, reason, kept: false }
}

/// Adds a chunk, or a message outside of chunks.
fn add(blocks: &mut Vec<Block>, file: usize, head: &Head, channels: Option<Box<[u16]>>) {
    let Some((start, end)) = head.span() else { return };
    // A file may claim anything.
    let (start, end) = (start.min(end), start.max(end));
    let in_chunk = head.opcode == op::CHUNK;
    if let Some(last) = blocks.last_mut().filter(|last| !in_chunk && !last.in_chunk && last.file == file)
        && head.end - last.at <= PIECE
    {
        (last.until, last.start, last.end) = (head.end, last.start.min(start), last.end.max(end));
        return;
    }
    blocks.push(Block { file, at: head.at, until: head.end, start, end, channels, in_chunk });
}

/// Reads where the chunks of a closed file are by its own index.
fn index(records: &mut RecordReader) -> Result<Index, ReplayError> {
    let mut index = Index::new();
    let Some(start) = records.summary_start()? else { return Ok(index) };
    records.go_to(start)?;
    while let Ok(Some(record)) = records.next_record() {
        if let Ok(Record::ChunkIndex(chunk)) = parse_record(record.opcode, &record.body) {
            let channels = chunk.message_index_offsets.keys().copied().collect();
            let span = (chunk.message_start_time, chunk.message_end_time);
            index.insert(chunk.chunk_start_offset, Some((span, channels)));
        }
    }
    if !index.is_empty() {
        index.insert(start, None);
    }
    Ok(index)
}

/// Returns the beginning of the first chunk, or of the summary, inside of a record.
fn covered(records: &mut RecordReader, index: &Index, head: &Head) -> Result<Option<u64>, ReplayError> {
    for (at, chunk) in index.range(head.at + 1..head.end) {
        records.go_to(*at)?;
        // An index may claim anything: there must be this chunk.
        let found = records.next_head().ok().flatten();
        let is_it = |found: &Head| match chunk {
            Some((span, _)) => found.opcode == op::CHUNK && found.span() == Some(*span),
            None => matches!(found.opcode, op::SCHEMA | op::CHANNEL | op::STATISTICS | op::CHUNK_INDEX),
        };
        if found.as_ref().is_some_and(is_it) {
            return Ok(Some(*at));
        }
    }
    Ok(None)
}

//! All files of a log, and where their messages are in order of time.
//!
//! The heads of all records are the index: it is complete whatever a writer left out of its own. That of the file only
//! shows which chunks need not be unpacked, and where reading continues after damage.

use std::path::{Path, PathBuf};
use std::time::Duration;

use mcap::parse_record;
use mcap::records::{Record, op};

use super::chunk::Chunk;
use super::chunk_index::{MessageIndexes, covered, index};
use super::files;
use super::open_files::OpenFiles;
use super::records::{Damage, Head, Kept, RawRecord, RecordReader, ReplayError};
use super::source_files::{self, LogFile};

/// Consecutive messages outside of chunks are read together up to this length [bytes].
const PIECE: u64 = 256 * 1024;
/// Longest wait for the next file of a live run, which has just closed the one before: this often, this long.
const NEXT_FILE: (u32, Duration) = (20, Duration::from_millis(10));

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
    /// Number of its messages, if they are indexed.
    pub indexed: Option<u64>,
    /// Whether it is a chunk.
    pub in_chunk: bool,
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

/// A file, and how far its heads were read.
struct File {
    path: PathBuf,
    length: u64,
    live: bool,
    at: u64,
    closed: bool,
}

/// The files of a log.
pub struct Source {
    path: PathBuf,
    files: Vec<File>,
    open: OpenFiles,
    /// In order of their first messages.
    pub blocks: Vec<Block>,
    /// File, position and kind of attachments and metadata.
    pub others: Vec<(usize, u64, u8)>,
    /// Records outside of chunks that describe messages: file, kind, contents.
    pub outside: Vec<(usize, u8, Vec<u8>)>,
    /// Damage between the records, and files that are missing.
    pub damage: Vec<Damage>,
    /// Why the last file ends early.
    pub cut: Option<(Box<Path>, u64, String)>,
    /// Damage that lasts until the first message of the next file.
    holes: Vec<usize>,
}

impl Source {
    /// Opens a log: a file with those that continue it, or a folder.
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        let mut log = Self {
            path: path.to_owned(),
            files: Vec::new(),
            open: OpenFiles::default(),
            blocks: Vec::new(),
            others: Vec::new(),
            outside: Vec::new(),
            damage: Vec::new(),
            cut: None,
            holes: Vec::new(),
        };
        for file in source_files::of(path)? {
            log.add_file(file)?;
        }
        log.sort();
        Ok(log)
    }

    /// Adds a file, or what is missing in its place.
    fn add_file(&mut self, file: LogFile) -> Result<(), ReplayError> {
        if let Some((path, at, reason)) = self.cut.take() {
            self.add_hole(path.into_path_buf(), at, reason);
        }
        if let Some(reason) = file.wrong {
            self.add_hole(file.path, 0, reason);
            return Ok(());
        }
        let before = self.blocks.len();
        let records = RecordReader::open(&file.path)?.with_attachments();
        let (at, length) = records.position();
        self.files.push(File { path: file.path, length, live: records.is_live(), at, closed: false });
        self.open.keep(self.files.len() - 1, records);
        self.walk(self.files.len() - 1)?;
        let new = self.blocks.get(before..).unwrap_or_default().iter().filter(|block| block.has_times());
        if let Some(start) = new.map(|block| block.start).min() {
            for hole in self.holes.drain(..) {
                let Some(Damage { span, .. }) = self.damage.get_mut(hole) else { continue };
                let (end, _) = span.unwrap_or((start, start));
                *span = Some((end.min(start), end.max(start)));
            }
        }
        Ok(())
    }

    /// Notes that all is missing from here to the next file.
    fn add_hole(&mut self, path: PathBuf, at: u64, reason: String) {
        self.holes.push(self.damage.len());
        let span = self.span().map(|(_, end)| (end, end));
        self.damage.push(Damage { path, at, span, reason, kept: Kept::None });
    }

    /// Reads on what a live run has written since then, also in further files; returns whether there may be more.
    pub fn refresh(&mut self) -> Result<bool, ReplayError> {
        let last = self.files.len().saturating_sub(1);
        let was_live = self.is_live();
        if let Some(file) = self.files.get_mut(last).filter(|_| was_live) {
            let records = RecordReader::open(&file.path)?.with_attachments();
            (file.length, file.live) = (records.position().1, records.is_live());
            drop(self.open.take(last, &file.path));
            self.open.keep(last, records);
            self.cut = None;
            self.walk(last)?;
        }
        let more = self.further_files(was_live)?;
        let is_more = !more.is_empty();
        more.into_iter().try_for_each(|file| self.add_file(file))?;
        if was_live || is_more {
            self.sort();
        }
        Ok(was_live || is_more)
    }

    /// Returns the files that a live run has begun since then.
    fn further_files(&self, was_live: bool) -> Result<Vec<LogFile>, ReplayError> {
        let known = |path: &Path| self.files.iter().any(|file| file.path == path);
        let is_new = || files::numbered_parts(&self.path).iter().any(|(_, path)| !known(path));
        if let Some(last) = self.files.last().filter(|last| was_live && last.closed) {
            let number = files::number_of(&last.path).filter(|_| self.files.len() > 1).unwrap_or(0);
            let next = source_files::next_of(&last.path, number + 1);
            let (times, pause) = NEXT_FILE;
            (0..times).take_while(|_| next.as_ref().is_some_and(|next| !next.exists())).for_each(|_| {
                std::thread::sleep(pause);
            });
        }
        if self.path.is_dir() || !is_new() {
            return Ok(Vec::new());
        }
        let all = source_files::of(&self.path)?.into_iter();
        Ok(all.filter(|file| file.wrong.is_none() && !known(&file.path)).collect())
    }

    fn sort(&mut self) {
        self.blocks.sort_by_key(|block| (block.start, block.file, block.at));
    }

    /// Reads the heads of a file.
    fn walk(&mut self, file: usize) -> Result<(), ReplayError> {
        let Some(of) = self.files.get_mut(file) else { return Ok(()) };
        let mut records = self.open.take(file, &of.path)?;
        let index = index(&mut records)?;
        records.go_to(of.at)?;
        let path = of.path.clone();
        let mut indexes = MessageIndexes::from(self.blocks.len());
        // Where the index said that reading can continue, which may be behind the end: each place is tried once.
        let mut tried = 0;
        loop {
            let mut damaged = |at: u64, span, reason: &str| {
                let path = path.clone();
                self.damage.push(Damage { path, at, span, reason: reason.to_owned(), kept: Kept::None });
            };
            let head = match records.next_head() {
                Ok(Some(head)) => head,
                Ok(None) => break,
                Err(ReplayError::Cut { at, reason, path }) => {
                    let Some((next, _)) = index.range(at.max(tried) + 1..).next() else {
                        self.cut = Some((path.into(), at, reason));
                        break;
                    };
                    damaged(at, index.get(&at).and_then(|chunk| Some(chunk.as_ref()?.span)), &reason);
                    tried = *next;
                    records.go_to(*next)?;
                    continue;
                }
                Err(e) => return Err(e),
            };
            // A record that covers the beginning of another one has a wrong length.
            if index.range(head.at + 1..head.end).next().is_some() {
                if let Some(next) = covered(&mut records, &index, &head)? {
                    damaged(head.at, head.span(), "the length of the record is wrong");
                    records.go_to(next)?;
                    continue;
                }
                records.go_to(head.end)?;
            }
            match head.opcode {
                op::CHUNK | op::MESSAGE => {
                    indexes.end(&mut self.blocks);
                    let own = index.get(&head.at).and_then(Option::as_ref);
                    add(&mut self.blocks, file, &head);
                    indexes.begin(own.filter(|own| Some(own.span) == head.span()));
                }
                op::MESSAGE_INDEX => indexes.add(&head),
                op::ATTACHMENT | op::METADATA => self.others.push((file, head.at, head.opcode)),
                op::HEADER | op::SCHEMA | op::CHANNEL | op::STATISTICS => {
                    records.go_to(head.at)?;
                    if let Some(record) = records.next_record()? {
                        if let Ok(Record::Statistics(counted)) = parse_record(record.opcode, &record.body) {
                            indexes.counted = Some(counted.message_count);
                        }
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
        indexes.finish(&mut self.blocks);
        self.open.keep(file, records);
        Ok(())
    }

    /// Returns whether all files were closed properly.
    pub fn is_complete(&self) -> bool {
        self.files.iter().all(|file| file.closed)
    }

    /// Returns whether a live run was writing the last file when it was read last.
    pub fn is_live(&self) -> bool {
        self.files.last().is_some_and(|file| file.live)
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
        let Some(of) = self.files.get(block.file) else { return Ok(None) };
        let mut records = self.open.take(block.file, &of.path)?;
        records.go_to(block.at)?;
        let mut damage = None;
        while records.position().0 < block.until {
            let Some(record) = records.next_record()? else { break };
            if record.opcode != op::CHUNK {
                each(block.file, record.opcode, &record.body);
                continue;
            }
            let (mut chunk, mut count) = (Chunk::open(&record.body), 0);
            chunk.each(|opcode, body| {
                count += u64::from(opcode == op::MESSAGE);
                each(block.file, opcode, body);
            });
            let kept = match count {
                0 => Kept::None,
                _ if chunk.is_cut || block.indexed.is_some_and(|indexed| count < indexed) => Kept::Some,
                _ => Kept::All,
            };
            let (path, at) = (of.path.clone(), record.at);
            let span = Some((block.start, block.end)).filter(|_| block.has_times());
            damage = chunk.damage.map(|reason| Damage { path, at, span, reason, kept });
            break;
        }
        let file = block.file;
        self.open.keep(file, records);
        Ok(damage)
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
        let Some(of) = self.files.get(file) else { return Ok(None) };
        let mut records = self.open.take(file, &of.path)?;
        records.go_to(at)?;
        let record = records.next_record()?;
        self.open.keep(file, records);
        Ok(record)
    }

    /// Returns the path of a file.
    pub fn path(&self, file: usize) -> &Path {
        self.files.get(file).map_or(Path::new(""), |file| &file.path)
    }

    /// Returns the length of all files [bytes].
    pub fn length(&self) -> u64 {
        self.files.iter().map(|file| file.length).sum()
    }
}

/// Adds a chunk, or a message outside of chunks.
fn add(blocks: &mut Vec<Block>, file: usize, head: &Head) {
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
    let (channels, indexed) = (None, None);
    blocks.push(Block { file, at: head.at, until: head.end, start, end, channels, indexed, in_chunk });
}

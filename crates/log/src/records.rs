//! Reads the records of an MCAP file in order, or only their heads; a truncated file is read up to the cut, that of a
//! live run up to its newest chunk.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::records::op;
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError};
use thiserror::Error;

use super::files;

/// At most this much of a file is checked at a time [bytes].
const PIECE: usize = 1024 * 1024;
/// Bytes of a [`Head`] at most: the times of a message, and what precedes the data of a chunk.
const HEAD: u64 = 40;
/// Opcode and length before each record.
const PREFIX: usize = 9;
/// Footer record and closing magic at the end of every complete file.
const TAIL: u64 = (PREFIX + 20 + MAGIC.len()) as u64;

/// Why a log cannot be read, or not to its end.
#[derive(Debug, Error)]
pub enum ReplayError {
    /// The file cannot be opened or read.
    #[error("cannot read the log {path}: {source}\nhint: `dimos replay --last` plays the newest log")]
    Io {
        /// The log file.
        path: PathBuf,
        /// The error.
        source: std::io::Error,
    },
    /// Not an MCAP file.
    #[error("{path} is not an MCAP file\nhint: logs of a run end in .mcap")]
    NotMcap {
        /// The file.
        path: PathBuf,
    },
    /// The file is truncated or damaged. Everything before was read.
    #[error(
        "the log {path} ends at byte {at}: {reason}\nhint: everything before was read; this happens if the run was killed"
    )]
    Cut {
        /// The log file.
        path: PathBuf,
        /// Start of the first unreadable record [bytes from the start].
        at: u64,
        /// The problem.
        reason: String,
    },
    /// A part of it is damaged. Reading continues after it.
    #[error("the log {path}: {damage}\nhint: `dimos log doctor` checks all of it", path = damage.path.display())]
    Damaged {
        /// The damage.
        damage: Damage,
    },
    /// The files of a folder are not one log.
    #[error("{path} holds {what}\nhint: name one of its files")]
    NotOneLog {
        /// The folder.
        path: PathBuf,
        /// What it holds.
        what: String,
    },
}

/// Damage of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Damage {
    /// The file.
    pub path: PathBuf,
    /// Start of the damaged record [bytes from the start]; 0: the file is missing, or no log.
    pub at: u64,
    /// Unix times of the first and last message in it [ns], where they are known.
    pub span: Option<(u64, u64)>,
    /// What is wrong.
    pub reason: String,
    /// What was read of its messages all the same.
    pub kept: Kept,
}

/// Which messages of a damaged part were read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kept {
    /// All of them.
    All,
    /// Some of them.
    Some,
    /// None of them.
    None,
}

impl std::fmt::Display for Damage {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let end = match self.kept {
            Kept::All => "its messages are kept, and may be wrong",
            Kept::Some => "some of its messages are left out, the others may be wrong",
            Kept::None => "its messages are left out",
        };
        if self.at > 0 {
            write!(f, "damaged at byte {}: ", self.at)?;
        }
        write!(f, "{}; {end}", self.reason)
    }
}

/// A record: kind and contents. Contents of kinds that are not used are empty.
pub struct RawRecord {
    /// Kind: one of `mcap::records::op`.
    pub opcode: u8,
    /// Position of its start [bytes from the start of the file].
    pub at: u64,
    /// Contents.
    pub body: Vec<u8>,
}

/// The head of a record.
pub struct Head {
    /// Kind: one of `mcap::records::op`.
    pub opcode: u8,
    /// Position of its start [bytes from the start of the file].
    pub at: u64,
    /// Position of its end.
    pub end: u64,
    /// The first bytes of its contents.
    pub first: Vec<u8>,
}

impl Head {
    /// Returns the Unix times of a message, or of the first and last one of a chunk [ns].
    pub fn span(&self) -> Option<(u64, u64)> {
        let number = |at: usize| self.first.get(at..at + 8)?.try_into().ok().map(u64::from_le_bytes);
        match self.opcode {
            op::MESSAGE => number(6).map(|time| (time, time)),
            op::CHUNK => Some((number(0)?, number(8)?)),
            _ => None,
        }
    }

    /// Returns the channel of a message index, and how many messages it has.
    pub fn indexed(&self) -> Option<(u16, u64)> {
        let (channel, rest) = self.first.split_first_chunk::<2>().filter(|_| self.opcode == op::MESSAGE_INDEX)?;
        let length = u32::from_le_bytes(*rest.first_chunk::<4>()?);
        // An entry is a time and a position.
        Some((u16::from_le_bytes(*channel), u64::from(length) / 16))
    }
}

/// Reads an MCAP file record by record.
pub struct RecordReader {
    path: PathBuf,
    file: BufReader<File>,
    length: u64,
    at: u64,
    ended: bool,
    attachments: bool,
    live: bool,
}

impl RecordReader {
    /// Opens a file and checks its MCAP magic.
    pub fn open(path: &Path) -> Result<Self, ReplayError> {
        let io = |source| ReplayError::Io { path: path.to_owned(), source };
        // Opening a pipe would wait for its writer.
        if !std::fs::metadata(path).map_err(io)?.is_file() {
            return Err(ReplayError::NotMcap { path: path.to_owned() });
        }
        let file = File::open(path).map_err(io)?;
        // Before the length: a run that ends in between has written at least this much.
        let live = files::is_being_written(&file);
        let length = file.metadata().map_err(io)?.len();
        let mut file = BufReader::with_capacity(64 * 1024, file);
        let mut magic = Vec::new();
        file.by_ref().take(MAGIC.len() as u64).read_to_end(&mut magic).map_err(io)?;
        // A run that has just created its file has yet to write to it.
        if magic != MAGIC && !(live && MAGIC.starts_with(&magic)) {
            return Err(ReplayError::NotMcap { path: path.to_owned() });
        }
        let at = MAGIC.len() as u64;
        let length = length.max(at);
        let mut records = Self { path: path.to_owned(), file, length, at, ended: false, attachments: false, live };
        // A log that has its end is closed; its last sync to a slow disk may keep the lock for a while.
        records.live = live && records.summary_start()?.is_none();
        records.rewind()?;
        Ok(records)
    }

    /// Returns the path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns whether a live run was writing the file when it was opened.
    pub fn is_live(&self) -> bool {
        self.live
    }

    /// Returns the position of the next record, and the length of the file [bytes].
    pub fn position(&self) -> (u64, u64) {
        (self.at, self.length)
    }

    /// Also reads attachments; by default they are skipped.
    pub fn with_attachments(mut self) -> Self {
        self.attachments = true;
        self
    }

    /// Returns the position of the summary; `None` if the file is truncated or has none.
    pub fn summary_start(&mut self) -> Result<Option<u64>, ReplayError> {
        if self.length < TAIL + MAGIC.len() as u64 {
            return Ok(None);
        }
        self.go_to(self.length - TAIL)?;
        let tail: [u8; TAIL as usize] = self.read()?;
        let start = tail.get(PREFIX..PREFIX + 8).and_then(|b| b.try_into().ok()).map_or(0, u64::from_le_bytes);
        let complete = tail.first() == Some(&op::FOOTER) && tail.ends_with(MAGIC);
        Ok((complete && start >= MAGIC.len() as u64 && start < self.length).then_some(start))
    }

    /// Moves to the start of a record, at most to the end of the file.
    pub fn go_to(&mut self, at: u64) -> Result<(), ReplayError> {
        // An index may claim anything.
        let at = at.min(self.length);
        self.file.seek(SeekFrom::Start(at)).map_err(|e| self.io(e))?;
        self.at = at;
        self.ended = false;
        Ok(())
    }

    /// Moves to the first record.
    pub fn rewind(&mut self) -> Result<(), ReplayError> {
        self.go_to(MAGIC.len() as u64)
    }

    /// Returns the next record; `None` after the footer of a complete file, after the last complete record of a live
    /// one, and after an error.
    pub fn next_record(&mut self) -> Result<Option<RawRecord>, ReplayError> {
        if self.ended {
            return Ok(None);
        }
        let record = self.read_record();
        self.ended = record.as_ref().map_or(true, |r| r.as_ref().is_none_or(|r| r.opcode == op::FOOTER));
        record
    }

    /// Returns the cut of a file that is too short; a live one continues there.
    fn too_short(&mut self, at: u64, reason: &str) -> Result<(), ReplayError> {
        if self.live { Ok(()) } else { Err(self.cut(at, reason)) }
    }

    fn read_record(&mut self) -> Result<Option<RawRecord>, ReplayError> {
        let Some((opcode, at)) = self.begin()? else { return Ok(None) };
        let length = self.at - at - PREFIX as u64;
        let body = match opcode {
            op::ATTACHMENT if self.attachments => self.body(length)?,
            op::ATTACHMENT | op::MESSAGE_INDEX | op::ATTACHMENT_INDEX | op::SUMMARY_OFFSET => {
                self.skip(length)?;
                Vec::new()
            }
            _ => self.body(length)?,
        };
        Ok(self.finish(opcode, at)?.then_some(RawRecord { opcode, at, body }))
    }

    /// Returns the head of the next record, and skips the rest of it; ends as [`Self::next_record`] does.
    pub fn next_head(&mut self) -> Result<Option<Head>, ReplayError> {
        if self.ended {
            return Ok(None);
        }
        let head = self.read_head();
        self.ended = head.as_ref().map_or(true, |h| h.as_ref().is_none_or(|h| h.opcode == op::FOOTER));
        head
    }

    fn read_head(&mut self) -> Result<Option<Head>, ReplayError> {
        let Some((opcode, at)) = self.begin()? else { return Ok(None) };
        let length = self.at - at - PREFIX as u64;
        let kept = length.min(HEAD);
        let first = self.body(kept)?;
        self.skip(length - kept)?;
        Ok(self.finish(opcode, at)?.then_some(Head { opcode, at, end: self.at, first }))
    }

    /// Reads the prefix of a record, and moves `at` to its end. Returns its kind and its start.
    fn begin(&mut self) -> Result<Option<(u8, u64)>, ReplayError> {
        let at = self.at;
        if self.length - at < PREFIX as u64 {
            self.too_short(at, "no valid footer")?;
            return Ok(None);
        }
        let prefix: [u8; PREFIX] = self.read()?;
        let [opcode, length @ ..] = prefix;
        let length = u64::from_le_bytes(length);
        if opcode == 0 {
            return Err(self.cut(at, "no record at this position"));
        }
        if length > self.length - at - PREFIX as u64 {
            self.too_short(at, "the file ends inside a record")?;
            return Ok(None);
        }
        self.at = at + PREFIX as u64 + length;
        Ok(Some((opcode, at)))
    }

    /// Checks the end of a file after its footer; `false` where a live one continues.
    fn finish(&mut self, opcode: u8, at: u64) -> Result<bool, ReplayError> {
        if opcode == op::FOOTER {
            if self.length - self.at < MAGIC.len() as u64 {
                self.too_short(at, "no valid footer")?;
                return Ok(false);
            }
            if self.read::<{ MAGIC.len() }>()? != *MAGIC {
                return Err(self.cut(at, "no valid footer"));
            }
        }
        Ok(true)
    }

    fn skip(&mut self, length: u64) -> Result<(), ReplayError> {
        self.file.seek_relative(length as i64).map_err(|e| self.io(e))
    }

    fn body(&mut self, length: u64) -> Result<Vec<u8>, ReplayError> {
        // Grows with what is read: the length is that of the file at most.
        let mut body = Vec::new();
        let read = self.file.by_ref().take(length).read_to_end(&mut body).map_err(|e| self.io(e))?;
        if (read as u64) < length {
            return Err(self.io(std::io::ErrorKind::UnexpectedEof.into()));
        }
        Ok(body)
    }

    fn read<const N: usize>(&mut self) -> Result<[u8; N], ReplayError> {
        let mut bytes = [0; N];
        self.file.read_exact(&mut bytes).map_err(|e| self.io(e))?;
        Ok(bytes)
    }

    fn io(&self, source: std::io::Error) -> ReplayError {
        ReplayError::Io { path: self.path.clone(), source }
    }

    /// Returns the error of an unreadable record. Reading ends there.
    pub fn cut(&mut self, at: u64, reason: impl ToString) -> ReplayError {
        self.ended = true;
        ReplayError::Cut { path: self.path.clone(), at, reason: reason.to_string() }
    }
}

/// Checks the checksums of the two sections of a closed file: all its data, and its summary. Returns what is wrong.
pub fn check_sections(path: &Path) -> Result<Option<McapError>, ReplayError> {
    let io = |source| ReplayError::Io { path: path.to_owned(), source };
    let mut file = File::open(path).map_err(io)?;
    let length = file.metadata().map_err(io)?.len();
    let mut reader = LinearReader::new_with_options(
        LinearReaderOptions::default()
            .with_emit_chunks(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            // No record is longer than the file.
            .with_record_length_limit(usize::try_from(length).unwrap_or(usize::MAX)),
    );
    while let Some(event) = reader.next_event() {
        match event {
            Ok(LinearReadEvent::ReadRequest(wanted)) => {
                let read = file.read(reader.insert(wanted.min(PIECE))).map_err(io)?;
                reader.notify_read(read);
            }
            Ok(LinearReadEvent::Record { .. }) => {}
            Err(e @ (McapError::BadDataCrc { .. } | McapError::BadSummaryCrc { .. })) => return Ok(Some(e)),
            // The records themselves are checked where they are used.
            Err(_) => return Ok(None),
        }
    }
    Ok(None)
}

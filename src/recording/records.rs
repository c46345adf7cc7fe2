//! Reads the records of an MCAP file in order and in bounded memory: at most [`LIMIT`] bytes at a time, whatever the
//! file contains; a truncated file is read up to the cut, that of a live run up to its newest chunk.

use std::fs::File;
use std::io::{BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use mcap::records::{ChunkHeader, Record, op};
use mcap::sans_io::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError, parse_record};
use thiserror::Error;

use super::files;

/// Maximum length of a record, and of a chunk's contents [bytes]. Attachments may be longer.
pub const LIMIT: usize = 16 * 1024 * 1024;
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
        if magic != MAGIC {
            return Err(ReplayError::NotMcap { path: path.to_owned() });
        }
        let at = magic.len() as u64;
        let mut records = Self { path: path.to_owned(), file, length, at, ended: false, attachments: false, live };
        // A log that has its end is closed; its last sync to a slow disk may keep the lock for a while.
        records.live = live && records.summary_start()?.is_none();
        records.rewind()?;
        Ok(records)
    }

    /// Returns whether a live run was writing the file when it was opened.
    pub fn is_live(&self) -> bool {
        self.live
    }

    /// Returns the position of the next record, and the length of the file [bytes].
    pub fn position(&self) -> (u64, u64) {
        (self.at, self.length)
    }

    /// Also reads attachments, up to [`LIMIT`]; by default they are skipped.
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

    /// Returns the end of a file that is too short: a live one continues there.
    fn too_short(&mut self, at: u64, reason: &str) -> Result<Option<RawRecord>, ReplayError> {
        if self.live { Ok(None) } else { Err(self.cut(at, reason)) }
    }

    fn read_record(&mut self) -> Result<Option<RawRecord>, ReplayError> {
        let at = self.at;
        if self.length - at < PREFIX as u64 {
            return self.too_short(at, "no valid footer");
        }
        let prefix: [u8; PREFIX] = self.read()?;
        let [opcode, length @ ..] = prefix;
        let length = u64::from_le_bytes(length);
        if opcode == 0 {
            return Err(self.cut(at, "no record at this position"));
        }
        if length > self.length - at - PREFIX as u64 {
            return self.too_short(at, "the file ends inside a record");
        }
        self.at = at + PREFIX as u64 + length;
        let body = match opcode {
            op::ATTACHMENT if self.attachments && length <= LIMIT as u64 => self.body(length)?,
            op::ATTACHMENT | op::MESSAGE_INDEX | op::ATTACHMENT_INDEX | op::METADATA_INDEX | op::SUMMARY_OFFSET => {
                self.file.seek_relative(length as i64).map_err(|e| self.io(e))?;
                Vec::new()
            }
            _ if length > LIMIT as u64 => return Err(self.cut(at, "a record exceeds 16 MiB")),
            _ => self.body(length)?,
        };
        if opcode == op::FOOTER {
            if self.length - self.at < MAGIC.len() as u64 {
                return self.too_short(at, "no valid footer");
            }
            if self.read::<{ MAGIC.len() }>()? != *MAGIC {
                return Err(self.cut(at, "no valid footer"));
            }
        }
        Ok(Some(RawRecord { opcode, at, body }))
    }

    fn body(&mut self, length: u64) -> Result<Vec<u8>, ReplayError> {
        let mut body = vec![0; length as usize];
        self.file.read_exact(&mut body).map_err(|e| self.io(e))?;
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
                let read = file.read(reader.insert(wanted.min(LIMIT))).map_err(io)?;
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

/// Returns the header of a chunk record: time range, sizes, compression.
pub fn chunk_header(body: &[u8]) -> Result<ChunkHeader, McapError> {
    match parse_record(op::CHUNK, body)? {
        Record::Chunk { header, .. } => Ok(header),
        _ => Err(McapError::UnexpectedEoc),
    }
}

/// Unpacks a chunk record and passes its records on in order. Verifies its checksum first.
pub fn unpack_chunk(body: &[u8], mut each: impl FnMut(u8, &[u8])) -> Result<(), McapError> {
    let Record::Chunk { header, data } = parse_record(op::CHUNK, body)? else { return Err(McapError::UnexpectedEoc) };
    if header.uncompressed_size > LIMIT as u64 {
        return Err(McapError::ChunkTooLarge(header.uncompressed_size));
    }
    match header.compression.as_str() {
        "" => walk(&data, each),
        "zstd" => {
            // The library's reader unpacks the chunk as a file with a single record.
            let mut reader = LinearReader::new_with_options(
                LinearReaderOptions::default()
                    .with_skip_start_magic(true)
                    .with_skip_end_magic(true)
                    .with_prevalidate_chunk_crcs(true)
                    .with_record_length_limit(LIMIT),
            );
            let prefix = [&[op::CHUNK], &(body.len() as u64).to_le_bytes()[..]].concat();
            let mut rest = prefix.chain(body);
            while let Some(event) = reader.next_event() {
                match event? {
                    LinearReadEvent::ReadRequest(wanted) => {
                        let wanted = wanted.min(PREFIX + body.len());
                        let read = rest.read(reader.insert(wanted))?;
                        reader.notify_read(read);
                    }
                    LinearReadEvent::Record { data, opcode } => each(opcode, data),
                }
            }
            Ok(())
        }
        other => Err(McapError::UnsupportedCompression(other.to_owned())),
    }
}

/// Passes on the records of an uncompressed chunk.
fn walk(mut rest: &[u8], mut each: impl FnMut(u8, &[u8])) -> Result<(), McapError> {
    while let Some((&opcode, after)) = rest.split_first() {
        let (length, after) = after.split_first_chunk().ok_or(McapError::UnexpectedEoc)?;
        let length = usize::try_from(u64::from_le_bytes(*length)).unwrap_or(usize::MAX);
        let (body, after) = after.split_at_checked(length).ok_or(McapError::UnexpectedEoc)?;
        each(opcode, body);
        rest = after;
    }
    Ok(())
}

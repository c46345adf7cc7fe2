//! The report of a first day: one file, which a user can send.
//!
//! It is compressed with zstd; inside are lines of JSON. The first one is the [`Report`], each other one a captured
//! chunk: `[time in µs, index of the connection, ">" to the arm or "<" from it, bytes in hex]`. It has no addresses,
//! and no serial number: where one was, also inside the chunks, there are zeros of the same length.

use std::io::{BufRead, BufReader, BufWriter, Write};
use std::path::Path;

use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::Made;
use crate::transport::capture::Chunk;

/// First field of a report.
const FORMAT: &str = "dimos first day";
/// Version of the form.
const VERSION: u32 = 1;
/// Longest line that is read [bytes].
const LONGEST: u64 = 64 << 20;
/// Largest report without compression [bytes]: what a file of a stranger may take of memory.
const LARGEST: u64 = 1 << 30;

/// The report, without what was captured.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// `dimos first day`.
    pub format: String,
    /// Version of the form.
    pub version: u32,
    /// Version of the program that measured.
    pub dimos: String,
    /// When, in UTC.
    pub when: String,
    /// The adapter's name.
    pub adapter: String,
    /// Whether an emulator stood in for the arm.
    pub simulated: bool,
    /// Vendor.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Number of joints.
    pub dof: usize,
    /// Firmware, if the arm reports it.
    pub firmware: Option<String>,
    /// The adapter's options, without paths.
    pub options: Value,
    /// Where the joints were at the start [rad].
    pub pose: Vec<f64>,
    /// The steps.
    pub steps: Vec<Made>,
    /// The connections.
    pub connections: Vec<Line>,
    /// Whether there was too much to keep all of it.
    pub cut: bool,
}

/// A connection of a report.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Line {
    /// Its name in the adapter's protocol.
    pub name: String,
    /// Whether each chunk is a whole message.
    pub datagrams: bool,
    /// This side's port, where the arm is given it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub port: Option<u16>,
}

impl Report {
    /// Returns the first fields. `dimos`: version of the program.
    pub fn marks(dimos: &str) -> (String, u32, String) {
        (FORMAT.to_owned(), VERSION, dimos.to_owned())
    }

    /// Writes the report and what was captured.
    pub fn write(&self, chunks: &[Chunk], path: &Path) -> std::io::Result<()> {
        let mut out = BufWriter::new(zstd::Encoder::new(std::fs::File::create(path)?, 3)?);
        serde_json::to_writer(&mut out, self)?;
        for Chunk { at, connection, sent, bytes } in chunks {
            let direction = if *sent { ">" } else { "<" };
            write!(out, "\n[{at},{connection},\"{direction}\",\"")?;
            for byte in bytes {
                write!(out, "{byte:02x}")?;
            }
            write!(out, "\"]")?;
        }
        writeln!(out)?;
        out.into_inner().map_err(std::io::IntoInnerError::into_error)?.finish()?.sync_all()
    }

    /// Reads only the report; an error says what the file is not.
    pub fn read_head(path: &Path) -> Result<Self, String> {
        Ok(Self::open(path)?.0)
    }

    /// Reads a report and what was captured.
    pub fn read(path: &Path) -> Result<(Self, Vec<Chunk>), String> {
        let (report, lines) = Self::open(path)?;
        let mut chunks = Vec::new();
        for (i, text) in lines.lines().enumerate() {
            let text = text.map_err(|e| e.to_string())?;
            chunks.push(chunk(&text, report.connections.len()).ok_or_else(|| format!("line {} is no chunk", i + 2))?);
        }
        Ok((report, chunks))
    }

    fn open(path: &Path) -> Result<(Self, impl BufRead), String> {
        let said = |e: std::io::Error| e.to_string();
        let file = zstd::Decoder::new(std::fs::File::open(path).map_err(said)?).map_err(said)?;
        let mut lines = BufReader::new(std::io::Read::take(file, LARGEST));
        let mut head = String::new();
        std::io::Read::take(&mut lines, LONGEST)
            .read_line(&mut head)
            .map_err(|_| "it is no report of a first day".to_owned())?;
        let report: Self = serde_json::from_str(&head).map_err(|e| format!("it is no report of a first day: {e}"))?;
        match (report.format == FORMAT, report.version) {
            (true, VERSION) => Ok((report, lines)),
            (true, version) => Err(format!("it has version {version}; this program reads {VERSION}")),
            _ => Err("it is no report of a first day".to_owned()),
        }
    }
}

fn chunk(text: &str, connections: usize) -> Option<Chunk> {
    let (at, connection, direction, hex): (u64, usize, String, String) = serde_json::from_str(text).ok()?;
    let (pairs, []) = hex.as_bytes().as_chunks::<2>() else { return None };
    let byte = |pair: &[u8; 2]| u8::from_str_radix(std::str::from_utf8(pair).ok()?, 16).ok();
    let bytes = pairs.iter().map(byte).collect::<Option<Vec<u8>>>()?;
    (connection < connections).then_some(Chunk { at, connection, sent: direction == ">", bytes })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_written_is_read_again() {
        let (format, version, dimos) = Report::marks("test");
        let line = Line { name: "arm".into(), datagrams: false, port: None };
        let report = Report {
            format,
            version,
            dimos,
            when: "2026-01-01T00:00:00Z".into(),
            adapter: "yourarm".into(),
            simulated: true,
            vendor: "YourArm".into(),
            model: "YA6".into(),
            dof: 6,
            firmware: None,
            options: Value::Null,
            pose: vec![0.5],
            steps: Vec::new(),
            connections: vec![line],
            cut: false,
        };
        let chunks = [
            Chunk { at: 5, connection: 0, sent: true, bytes: vec![0, 255, 16] },
            Chunk { at: 6, connection: 0, sent: false, bytes: vec![1] },
        ];
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("report");
        report.write(&chunks, &path).unwrap();
        assert_eq!(Report::read(&path).unwrap(), (report.clone(), chunks.to_vec()));
        assert_eq!(Report::read_head(&path).unwrap(), report);
        for wrong in ["", "[1,0,\">\",\"0\"]", "[1,1,\">\",\"00\"]", "[1,0,\">\",\"0x\"]"] {
            assert_eq!(chunk(wrong, 1), None, "{wrong}");
        }
        std::fs::write(&path, "no report").unwrap();
        assert!(Report::read(&path).is_err());
    }
}

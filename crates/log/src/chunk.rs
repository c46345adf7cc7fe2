//! The contents of a chunk: uncompressed, zstd or lz4.

use std::borrow::Cow;
use std::io::Read;

use mcap::records::{ChunkHeader, Record, op};
use mcap::{McapError, parse_record};

/// Largest contents of a chunk that are unpacked [bytes].
const MAX_CONTENTS: u64 = 1 << 30;

/// An unpacked chunk.
pub struct Chunk<'a> {
    plain: Cow<'a, [u8]>,
    /// Whether a part of its contents is missing.
    pub is_cut: bool,
    /// What is wrong with it. What could be unpacked is there all the same.
    pub damage: Option<String>,
}

impl<'a> Chunk<'a> {
    /// Unpacks a chunk record and verifies its checksum.
    pub fn open(body: &'a [u8]) -> Self {
        let nothing = |why: String| Self { plain: Cow::Borrowed(&[]), is_cut: true, damage: Some(why) };
        let (header, data) = match parse_record(op::CHUNK, body) {
            Ok(Record::Chunk { header, data: Cow::Borrowed(data) }) => (header, data),
            Ok(_) => return nothing(McapError::UnexpectedEoc.to_string()),
            Err(e) => return nothing(e.to_string()),
        };
        match unpacked(&header, data) {
            Ok(plain) => {
                let is_cut = plain.len() as u64 != header.uncompressed_size;
                Self { damage: wrong(&header, &plain), is_cut, plain }
            }
            Err(why) => nothing(why),
        }
    }

    /// Passes on its records in order; notes where they break off.
    pub fn each(&mut self, each: impl FnMut(u8, &[u8])) {
        if walk(&self.plain, each).is_none() {
            self.is_cut = true;
            self.damage.get_or_insert_with(|| "a record in the chunk is longer than the chunk".to_owned());
        }
    }
}

/// Unpacks a chunk record and passes its records on in order, if it is not damaged at all.
pub fn each_checked(body: &[u8], each: impl FnMut(u8, &[u8])) -> Result<(), String> {
    let mut chunk = Chunk::open(body);
    if chunk.damage.is_none() {
        chunk.each(each);
    }
    chunk.damage.map_or(Ok(()), Err)
}

fn unpacked<'a>(header: &ChunkHeader, data: &'a [u8]) -> Result<Cow<'a, [u8]>, String> {
    let size = header.uncompressed_size;
    if size > MAX_CONTENTS {
        return Err(format!("the chunk has {size} bytes unpacked; at most 1 GiB is read"));
    }
    let mut plain = Vec::new();
    // One byte more shows contents that are longer than they should be.
    let read = match header.compression.as_str() {
        "" => return Ok(Cow::Borrowed(data)),
        "zstd" => zstd::Decoder::new(data).and_then(|unpack| unpack.take(size + 1).read_to_end(&mut plain)),
        "lz4" => lz4_flex::frame::FrameDecoder::new(data).take(size + 1).read_to_end(&mut plain),
        other => return Err(McapError::UnsupportedCompression(other.to_owned()).to_string()),
    };
    read.map(|_| Cow::Owned(plain)).map_err(|e| format!("the chunk cannot be unpacked: {e}"))
}

fn wrong(header: &ChunkHeader, plain: &[u8]) -> Option<String> {
    let (size, saved) = (header.uncompressed_size, header.uncompressed_crc);
    let calculated = crc32fast::hash(plain);
    if plain.len() as u64 != size {
        return Some(format!("the chunk has {} bytes unpacked instead of {size}", plain.len()));
    }
    (saved != 0 && saved != calculated).then(|| McapError::BadChunkCrc { saved, calculated }.to_string())
}

/// Passes on records that follow each other, as in an unpacked chunk; `None` if they break off.
pub(super) fn walk(mut rest: &[u8], mut each: impl FnMut(u8, &[u8])) -> Option<()> {
    while let Some((&opcode, after)) = rest.split_first() {
        let (length, after) = after.split_first_chunk()?;
        let length = usize::try_from(u64::from_le_bytes(*length)).ok()?;
        let (body, after) = after.split_at_checked(length)?;
        each(opcode, body);
        rest = after;
    }
    Some(())
}

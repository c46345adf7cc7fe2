//! What a file says of its own chunks: where they are, when, and which channels are in them.

use std::collections::BTreeMap;

use mcap::parse_record;
use mcap::records::{Record, op};

use super::records::{Head, RecordReader, ReplayError};
use super::source::Block;

/// Chunks by their position in a file, with what its own index says of them. The last entry, where the summary begins,
/// has none.
pub type Index = BTreeMap<u64, Option<Indexed>>;

/// What the index of a file says of a chunk.
pub struct Indexed {
    /// Times of its first and last message [ns].
    pub span: (u64, u64),
    /// Where the message indexes of its channels are.
    offsets: BTreeMap<u16, u64>,
}

/// Reads where the chunks of a closed file are by its own index.
pub fn index(records: &mut RecordReader) -> Result<Index, ReplayError> {
    let mut index = Index::new();
    let Some(start) = records.summary_start()? else { return Ok(index) };
    records.go_to(start)?;
    while let Ok(Some(record)) = records.next_record() {
        if let Ok(Record::ChunkIndex(chunk)) = parse_record(record.opcode, &record.body) {
            let span = (chunk.message_start_time, chunk.message_end_time);
            let indexed = Indexed { span, offsets: chunk.message_index_offsets };
            index.insert(chunk.chunk_start_offset, Some(indexed));
        }
    }
    if !index.is_empty() {
        index.insert(start, None);
    }
    Ok(index)
}

/// Returns the beginning of the first chunk, or of the summary, inside of a record.
pub fn covered(records: &mut RecordReader, index: &Index, head: &Head) -> Result<Option<u64>, ReplayError> {
    for (at, chunk) in index.range(head.at + 1..head.end) {
        records.go_to(*at)?;
        // An index may claim anything: there must be this chunk.
        let found = records.next_head().ok().flatten();
        let is_it = |found: &Head| match chunk {
            Some(chunk) => found.opcode == op::CHUNK && found.span() == Some(chunk.span),
            None => matches!(found.opcode, op::SCHEMA | op::CHANNEL | op::STATISTICS | op::CHUNK_INDEX),
        };
        if found.as_ref().is_some_and(is_it) {
            return Ok(Some(*at));
        }
    }
    Ok(None)
}

/// The message indexes of a file, which follow each chunk. The channels of a chunk are known only where these agree
/// with the index of chunks, and with the number of all messages: each may lack something.
#[derive(Default)]
pub struct MessageIndexes<'a> {
    /// The file's first block.
    first: usize,
    /// What the index says of the latest chunk.
    own: Option<&'a Indexed>,
    /// Channels after the latest chunk, and where their indexes are.
    seen: BTreeMap<u16, u64>,
    /// Whether one of them has two.
    is_doubled: bool,
    /// Messages of the latest chunk, and of all.
    count: u64,
    all: u64,
    /// Messages that the statistics count.
    pub counted: Option<u64>,
}

impl<'a> MessageIndexes<'a> {
    /// Creates one for a file whose first block has this index.
    pub fn from(first: usize) -> Self {
        Self { first, ..Self::default() }
    }

    /// Begins a chunk or message.
    pub fn begin(&mut self, own: Option<&'a Indexed>) {
        (self.own, self.count, self.is_doubled) = (own, 0, false);
        self.seen.clear();
    }

    /// Takes a message index.
    pub fn add(&mut self, head: &Head) {
        if let Some((channel, count)) = head.indexed() {
            self.count += count;
            self.is_doubled |= self.seen.insert(channel, head.at).is_some();
        }
    }

    /// Notes what is known of the latest chunk.
    pub fn end(&mut self, blocks: &mut [Block]) {
        self.all += self.count;
        let Some(block) = blocks.last_mut().filter(|block| block.in_chunk && !self.seen.is_empty()) else { return };
        block.indexed = Some(self.count);
        let agrees = self.own.is_some_and(|own| own.offsets == self.seen && !self.is_doubled);
        block.channels = agrees.then(|| self.seen.keys().copied().collect());
        self.begin(None);
    }

    /// Ends the file.
    pub fn finish(mut self, blocks: &mut [Block]) {
        self.end(blocks);
        if self.counted.is_some_and(|counted| counted != self.all) {
            blocks.iter_mut().skip(self.first).for_each(|block| block.channels = None);
        }
    }
}

//! CDR, the wire format of ROS 2 messages: little-endian, each number aligned to its own size, counted from the
//! byte after the 4-byte header.

use thiserror::Error;

/// Header of plain little-endian CDR; alignment is counted from its end.
const HEADER: [u8; 4] = [0, 1, 0, 0];

/// Why bytes are not a valid message.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum CdrError {
    /// The message ends inside a field.
    #[error("the message ends inside a field, at byte {0}")]
    Short(usize),
    /// Not little-endian CDR.
    #[error("the message is not little-endian CDR")]
    Header,
    /// A string is not UTF-8.
    #[error("a string is not UTF-8, at byte {0}")]
    Text(usize),
}

/// Encodes messages one at a time; reuses its buffer.
#[derive(Debug, Clone)]
pub struct Encoder {
    buffer: Vec<u8>,
}

impl Default for Encoder {
    fn default() -> Self {
        Self { buffer: HEADER.to_vec() }
    }
}

impl Encoder {
    /// Begins a new message.
    pub fn restart(&mut self) {
        self.buffer.truncate(HEADER.len());
    }

    /// Returns the message so far.
    pub fn bytes(&self) -> &[u8] {
        &self.buffer
    }

    /// Appends a number as its little-endian bytes, aligned to its size.
    pub fn number<const N: usize>(&mut self, bytes: [u8; N]) {
        while !(self.buffer.len() - HEADER.len()).is_multiple_of(N) {
            self.buffer.push(0);
        }
        self.buffer.extend_from_slice(&bytes);
    }

    /// Appends the length of a sequence. No logged message comes near 4 GiB.
    pub fn length(&mut self, length: usize) {
        self.number((length as u32).to_le_bytes());
    }

    /// Appends a string with its closing zero.
    pub fn text(&mut self, text: &str) {
        self.length(text.len() + 1);
        self.buffer.extend_from_slice(text.as_bytes());
        self.buffer.push(0);
    }
}

/// Decodes one message. For any input it neither panics nor allocates more than the message's length.
#[derive(Debug, Clone)]
pub struct Decoder<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Decoder<'a> {
    /// Creates a decoder and checks the header.
    pub fn new(bytes: &'a [u8]) -> Result<Self, CdrError> {
        // The last two header bytes are options, unused in plain CDR.
        if bytes.len() < HEADER.len() || !bytes.starts_with(&HEADER[..2]) {
            return Err(CdrError::Header);
        }
        Ok(Self { bytes: &bytes[HEADER.len()..], at: 0 })
    }

    /// Skips bytes.
    pub fn skip(&mut self, bytes: usize) -> Result<(), CdrError> {
        self.at = self.at.saturating_add(bytes).min(self.bytes.len());
        if self.at == self.bytes.len() { Err(self.short()) } else { Ok(()) }
    }

    /// Reads the little-endian bytes of a number, aligned to its size.
    pub fn number<const N: usize>(&mut self) -> Result<[u8; N], CdrError> {
        self.at = self.at.next_multiple_of(N);
        let found = self.bytes.get(self.at..).and_then(|rest| rest.first_chunk()).copied();
        let number = found.ok_or_else(|| self.short())?;
        self.at += N;
        Ok(number)
    }

    /// Reads the length of a sequence of elements of at least `element` bytes each.
    pub fn length(&mut self, element: usize) -> Result<usize, CdrError> {
        let length = u32::from_le_bytes(self.number()?) as usize;
        let left = self.bytes.len() - self.at;
        if length.saturating_mul(element) > left { Err(self.short()) } else { Ok(length) }
    }

    /// Reads a string without its closing zero.
    pub fn text(&mut self) -> Result<&'a str, CdrError> {
        let length = self.length(1)?;
        let bytes = self.bytes.get(self.at..self.at + length).ok_or_else(|| self.short())?;
        let text = std::str::from_utf8(bytes.strip_suffix(&[0]).unwrap_or(bytes));
        let text = text.map_err(|_| CdrError::Text(self.at + HEADER.len()))?;
        self.at += length;
        Ok(text)
    }

    fn short(&self) -> CdrError {
        CdrError::Short(self.at.min(self.bytes.len()) + HEADER.len())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_aligned_from_the_end_of_the_header() {
        let mut e = Encoder::default();
        e.number([7]);
        e.number(1.5f64.to_le_bytes());
        e.number([9]);
        e.number(3u32.to_le_bytes());
        assert_eq!(e.bytes().len(), 4 + 8 + 8 + 4 + 4);
        let mut d = Decoder::new(e.bytes()).unwrap();
        assert_eq!(d.number(), Ok([7]));
        assert_eq!(d.number().map(f64::from_le_bytes), Ok(1.5));
        assert_eq!(d.number(), Ok([9]));
        assert_eq!(d.number().map(u32::from_le_bytes), Ok(3));
        assert_eq!(d.number::<1>(), Err(CdrError::Short(28)));
    }

    #[test]
    fn a_restarted_encoder_begins_a_new_message() {
        let mut e = Encoder::default();
        e.text("left over");
        e.restart();
        e.text("é");
        assert_eq!(e.bytes(), [0, 1, 0, 0, 3, 0, 0, 0, 0xc3, 0xa9, 0]);
    }

    #[test]
    fn lengths_beyond_the_message_are_rejected_before_anything_is_allocated() {
        let bytes = [0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff, 1, 2];
        assert_eq!(Decoder::new(&bytes).unwrap().length(8), Err(CdrError::Short(8)));
        assert_eq!(Decoder::new(&bytes).unwrap().text(), Err(CdrError::Short(8)));
        assert_eq!(Decoder::new(&[0, 0, 0, 0]).unwrap_err(), CdrError::Header);
        assert_eq!(Decoder::new(&[]).unwrap_err(), CdrError::Header);
    }
}

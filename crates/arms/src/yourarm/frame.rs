//! The frame around every command and reply (§2 of `docs/yourarm-protocol.md`):
//! "YA" | version | opcode | sequence u16 | length u16 | payload | CRC-16; all little-endian.

use dimos_hardware::transport::tcp::Scan;

/// The two bytes that every frame begins with.
const MAGIC: [u8; 2] = *b"YA";
/// The protocol version that follows them.
const VERSION: u8 = 1;
/// Bytes before the payload.
const HEADER: usize = 8;
/// Bytes after the payload.
const CRC: usize = 2;
/// Longest payload.
const MAX_PAYLOAD: usize = 256;
/// Longest frame; the size of a frame buffer.
pub const MAX_FRAME: usize = HEADER + MAX_PAYLOAD + CRC;
/// Set in the opcode of a reply.
pub const REPLY: u8 = 0x80;

/// CRC-16/CCITT-FALSE: polynomial 0x1021, start value 0xFFFF, not reflected. Of "123456789" it is 0x29B1.
fn crc16(bytes: &[u8]) -> u16 {
    bytes.iter().fold(0xFFFF, |crc, byte| {
        (0..8).fold(
            crc ^ (u16::from(*byte) << 8),
            |crc, _| {
                if crc & 0x8000 != 0 { (crc << 1) ^ 0x1021 } else { crc << 1 }
            },
        )
    })
}

/// A whole reply with a good checksum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reply<'a> {
    /// What the controller made of the command.
    pub status: Status,
    /// What follows the status.
    pub data: &'a [u8],
}

/// What the controller made of a command.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Status {
    /// Done, or begun.
    Ok,
    /// Refused, with the number of the reason; [`status_text`] explains it.
    Refused(u8),
}

/// A whole frame with a good checksum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame<'a> {
    /// Opcode; of a reply with [`REPLY`].
    pub opcode: u8,
    /// Sequence number.
    pub sequence: u16,
    /// What is between header and checksum.
    pub payload: &'a [u8],
}

/// Finds the next frame at the front of `bytes`. Noise and damaged frames are skipped.
pub fn any(bytes: &[u8]) -> Scan<Frame<'_>> {
    // A frame can only begin where the magic is; a lone first byte of it may still become one.
    let begins = |at: &[u8]| at.starts_with(&MAGIC) || at == &MAGIC[..1];
    let noise = (0..bytes.len()).take_while(|i| !bytes.get(*i..).is_some_and(begins)).count();
    if noise > 0 {
        return Scan::Skip(noise);
    }
    let Some([_, _, version, opcode, s0, s1, l0, l1]) = bytes.first_chunk::<HEADER>() else { return Scan::More };
    let length = usize::from(u16::from_le_bytes([*l0, *l1]));
    if *version != VERSION || length > MAX_PAYLOAD {
        return Scan::Skip(1);
    }
    let Some(frame) = bytes.get(..HEADER + length + CRC) else { return Scan::More };
    let Some((body, checksum)) = frame.split_last_chunk::<CRC>() else { return Scan::More };
    if crc16(body) != u16::from_le_bytes(*checksum) {
        return Scan::Skip(1);
    }
    let (sequence, payload) = (u16::from_le_bytes([*s0, *s1]), body.get(HEADER..).unwrap_or_default());
    Scan::Take(frame.len(), Frame { opcode: *opcode, sequence, payload })
}

/// Finds the reply to the command with this opcode and sequence number at the front of `bytes`. Noise, damaged
/// frames and replies to other commands are skipped.
pub fn scan<'a>(bytes: &'a [u8], opcode: u8, sequence: u16) -> Scan<Reply<'a>> {
    let (length, frame) = match any(bytes) {
        Scan::Take(length, frame) => (length, frame),
        Scan::Skip(n) => return Scan::Skip(n),
        Scan::More => return Scan::More,
    };
    let answers = frame.opcode == opcode | REPLY && frame.sequence == sequence;
    match frame.payload.split_first() {
        Some((status, data)) if answers => {
            let status = if *status == 0 { Status::Ok } else { Status::Refused(*status) };
            Scan::Take(length, Reply { status, data })
        }
        _ => Scan::Skip(length),
    }
}

/// Makes the checksum of a frame right again, after its payload was changed.
pub fn seal(frame: &mut [u8]) {
    if let Some((body, checksum)) = frame.split_last_chunk_mut::<CRC>() {
        *checksum = crc16(body).to_le_bytes();
    }
}

/// Puts bytes one after the other into a frame; what does not fit is left out.
pub struct Writer<'a> {
    frame: &'a mut [u8; MAX_FRAME],
    at: usize,
}

impl<'a> Writer<'a> {
    /// Begins a payload.
    pub fn new(frame: &'a mut [u8; MAX_FRAME]) -> Self {
        Self { frame, at: HEADER }
    }

    /// Puts the header before the payload and the checksum after it; the answer is the whole frame.
    pub fn finish(mut self, opcode: u8, sequence: u16) -> &'a [u8] {
        let end = self.at;
        let length = (end - HEADER) as u16;
        self.at = 0;
        self.put(&MAGIC);
        self.put(&[VERSION, opcode]);
        self.put(&sequence.to_le_bytes());
        self.put(&length.to_le_bytes());
        let checksum = crc16(self.frame.get(..end).unwrap_or_default());
        self.at = end;
        self.put(&checksum.to_le_bytes());
        self.frame.get(..end + CRC).unwrap_or_default()
    }

    /// Adds bytes.
    pub fn put(&mut self, bytes: &[u8]) {
        if let Some(to) = self.frame.get_mut(self.at..self.at + bytes.len()) {
            to.copy_from_slice(bytes);
            self.at += bytes.len();
        }
    }

    /// Adds numbers as f32.
    pub fn floats(&mut self, values: &[f64]) {
        values.iter().for_each(|value| self.put(&(*value as f32).to_le_bytes()));
    }
}

/// Takes bytes one after the other from a payload; `None` when there are not enough.
pub struct Reader<'a>(&'a [u8]);

impl<'a> Reader<'a> {
    /// Reads from the beginning of a payload.
    pub fn new(payload: &'a [u8]) -> Self {
        Self(payload)
    }

    /// Whether all has been taken.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Takes N bytes.
    pub fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (taken, rest) = self.0.split_first_chunk::<N>()?;
        self.0 = rest;
        Some(*taken)
    }

    /// An f32, which must be finite.
    pub fn float(&mut self) -> Option<f64> {
        let value = f32::from_le_bytes(self.take()?);
        value.is_finite().then_some(f64::from(value))
    }

    /// Takes N finite f32 values.
    pub fn floats<const N: usize>(&mut self) -> Option<[f64; N]> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.float()?;
        }
        Some(values)
    }

    /// 16 bytes of ASCII, padded with NUL.
    pub fn text(&mut self) -> Option<String> {
        let bytes: [u8; 16] = self.take()?;
        let text: Vec<u8> = bytes.into_iter().take_while(|byte| *byte != 0).collect();
        String::from_utf8(text).ok().filter(|text| text.is_ascii())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_checksum_is_the_one_of_the_sheet() {
        assert_eq!(crc16(b"123456789"), 0x29B1);
    }
}

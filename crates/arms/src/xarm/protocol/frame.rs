//! The frame around every request and response on the control port:
//! transaction u16 | protocol u16 | length u16 of what follows | register u8 | payload; all three big-endian.
//! The payload of a response begins with a state byte.

use dimos_hardware::transport::tcp::Scan;

/// The private protocol.
pub const PRIVATE: u16 = 2;
/// The private protocol with a heartbeat of the client.
pub const WATCHED: u16 = 3;
/// Bytes before the register.
const HEADER: usize = 6;
/// Longest request; the size of a frame buffer.
pub const MAX_REQUEST: usize = 64;
/// Longest response that is believed.
const MAX_RESPONSE: usize = 512;
/// Most bytes of a response that are kept.
const KEPT: usize = 80;
/// In place of the register: unsolicited feedback about a task.
const FEEDBACK: u8 = 0xFF;

/// What the controller says of itself in every response.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Status(pub u8);

impl Status {
    /// The request had no valid result.
    pub fn invalid(self) -> bool {
        self.0 & 0x08 != 0
    }

    /// The arm is not able to move.
    pub fn not_ready(self) -> bool {
        self.0 & 0x10 != 0
    }

    /// There is a warning.
    pub fn warning(self) -> bool {
        self.0 & 0x20 != 0
    }

    /// There is an error.
    pub fn error(self) -> bool {
        self.0 & 0x40 != 0
    }
}

/// A response.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Response {
    /// The number of its request.
    pub transaction: u16,
    /// The register of its request.
    pub register: u8,
    /// The state byte.
    pub status: Status,
    data: [u8; KEPT],
    length: usize,
}

impl Response {
    /// What follows the state byte.
    pub fn data(&self) -> &[u8] {
        self.data.get(..self.length).unwrap_or_default()
    }
}

/// The front of the received bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Arrived {
    /// A response to a request that was made.
    Response(Response),
    /// A whole frame that answers nothing that was asked.
    Stray,
}

/// Finds the next frame at the front of `bytes`. `asked` says whether a request with this number to this register is
/// unanswered: only such a response is waited for, so that noise that looks like a header costs nothing.
pub fn scan(bytes: &[u8], protocol: u16, asked: impl Fn(u16, u8) -> bool) -> Scan<Arrived> {
    let Some([t0, t1, p0, p1, l0, l1]) = bytes.first_chunk::<HEADER>() else { return Scan::More };
    let (transaction, length) = (u16::from_be_bytes([*t0, *t1]), usize::from(u16::from_be_bytes([*l0, *l1])));
    let theirs = u16::from_be_bytes([*p0, *p1]);
    // A response to the request that changed the protocol may still carry the old one.
    if (theirs != protocol && theirs != PRIVATE) || !(2..=MAX_RESPONSE).contains(&length) {
        return Scan::Skip(1);
    }
    let Some(register) = bytes.get(HEADER) else { return Scan::More };
    let awaited = asked(transaction, *register);
    let frame = match bytes.get(HEADER..HEADER + length) {
        Some(frame) => frame,
        None if awaited || *register == FEEDBACK => return Scan::More,
        None => return Scan::Skip(1),
    };
    let total = HEADER + length;
    match frame {
        [_, status, data @ ..] if awaited => {
            let mut kept = [0; KEPT];
            kept.iter_mut().zip(data).for_each(|(to, from)| *to = *from);
            let (register, status, length) = (*register, Status(*status), data.len().min(KEPT));
            Scan::Take(total, Arrived::Response(Response { transaction, register, status, data: kept, length }))
        }
        _ => Scan::Take(total, Arrived::Stray),
    }
}

/// Puts a request into a buffer, byte after byte; what does not fit is left out.
pub struct Writer<'a> {
    frame: &'a mut [u8; MAX_REQUEST],
    at: usize,
}

impl<'a> Writer<'a> {
    /// Begins the payload.
    pub fn new(frame: &'a mut [u8; MAX_REQUEST]) -> Self {
        Self { frame, at: HEADER + 1 }
    }

    /// Puts the header before the payload; the answer is the whole frame.
    pub fn finish(mut self, register: u8, transaction: u16, protocol: u16) -> &'a [u8] {
        let end = self.at;
        self.at = 0;
        self.put(&transaction.to_be_bytes());
        self.put(&protocol.to_be_bytes());
        self.put(&((end - HEADER) as u16).to_be_bytes());
        self.put(&[register]);
        self.frame.get(..end).unwrap_or_default()
    }

    /// Adds bytes.
    pub fn put(&mut self, bytes: &[u8]) {
        if let Some(to) = self.frame.get_mut(self.at..self.at + bytes.len()) {
            to.copy_from_slice(bytes);
            self.at += bytes.len();
        }
    }

    /// Adds numbers as f32, little-endian.
    pub fn floats(&mut self, values: &[f64]) {
        values.iter().for_each(|value| self.put(&(*value as f32).to_le_bytes()));
    }
}

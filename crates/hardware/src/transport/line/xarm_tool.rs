//! The RS-485 line at the tool flange of an xArm as a byte stream. Register 241 of the control box passes bytes on
//! unchanged, and its response has what came back from the tool within the box's own timeout (register 240).
//!
//! Bytes that the device sends without being asked, or later than that timeout, do not arrive.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use crate::adapter::{AdapterError, AdapterResult};
use crate::transport::Scan;
use crate::transport::request_reply::ByteLink;
use crate::transport::tcp::{Endpoint, TcpLink};

/// Port of the control box for devices at its lines.
pub const PORT: u16 = 503;
/// Registers: bytes for the line, and a value of the tool board.
const PASS_ON: u8 = 241;
const READ_BOARD: u8 = 128;
/// Register of the tool board that has the index of the line's rate.
const BAUD_REGISTER: u16 = 0x0A0B;
/// The number of the tool flange among the devices behind the controller.
const TOOL: u8 = 9;
/// The private protocol.
const PROTOCOL: u16 = 2;
/// Bytes before the register, and before the payload of a response.
const HEADER: usize = 6;
const BEFORE_DATA: usize = 8;
/// Most bytes at once: the longest telegram of Modbus RTU.
const MOST: usize = 256;
/// The state byte's bit "no valid result".
const INVALID: u8 = 0x08;
/// Rates of the line [bit/s], by the index that the tool board has.
const RATES: [u32; 13] =
    [4800, 9600, 19200, 38400, 57600, 115_200, 230_400, 460_800, 921_600, 1_000_000, 1_500_000, 2_000_000, 2_500_000];

/// The line at the tool of a connected control box.
#[derive(Debug)]
pub struct ToolLine {
    link: TcpLink,
    number: u16,
    /// Requests without a response.
    unanswered: VecDeque<u16>,
    /// Bytes from the tool, and how many of those to come are skipped.
    received: Vec<u8>,
    skip: usize,
}

impl ToolLine {
    /// Connects to the control box and checks that its line runs at `baud` [bit/s]. `device` names the device in
    /// messages. Whether one is there shows only when it answers.
    pub fn connect(device: &str, endpoint: &Endpoint, baud: u32, timeout: Duration) -> AdapterResult<Self> {
        let link = TcpLink::connect(device, endpoint, timeout)?;
        let mut line = Self { link, number: 0, unanswered: VecDeque::new(), received: Vec::new(), skip: 0 };
        let [high, low] = BAUD_REGISTER.to_be_bytes();
        line.post(READ_BOARD, &[high, low])?;
        let (_, data) = line.response(READ_BOARD, Instant::now() + timeout)?;
        let index = match data[..] {
            [_, a, b, c, d] | [a, b, c, d] => i32::from_be_bytes([a, b, c, d]),
            _ => -1,
        };
        let rate = usize::try_from(index).ok().and_then(|index| RATES.get(index));
        if rate == Some(&baud) {
            return Ok(line);
        }
        let rate = rate.map_or("an unknown rate".to_owned(), |rate| format!("{rate} bit/s"));
        Err(AdapterError::Rejected(format!(
            "{}: the tool's line runs at {rate}, not {baud} bit/s\nhint: set it in the vendor's Studio, or end the \
             address with @ and the rate of the line",
            line.link.peer()
        )))
    }

    fn post(&mut self, register: u8, data: &[u8]) -> AdapterResult<()> {
        self.number = self.number % u16::MAX + 1;
        let mut frame = Vec::with_capacity(BEFORE_DATA + data.len());
        frame.extend(self.number.to_be_bytes());
        frame.extend(PROTOCOL.to_be_bytes());
        frame.extend((data.len() as u16 + 2).to_be_bytes());
        frame.extend([register, TOOL]);
        frame.extend(data);
        self.link.send(&frame)?;
        self.unanswered.push_back(self.number);
        Ok(())
    }

    /// Waits for the next response: its state byte, and what follows.
    fn response(&mut self, register: u8, until: Instant) -> AdapterResult<(u8, Vec<u8>)> {
        let unanswered = &self.unanswered;
        let scan = |bytes: &[u8]| {
            let Some(&[t0, t1, p0, p1, l0, l1]) = bytes.first_chunk::<HEADER>() else { return Scan::More };
            let (number, length) = (u16::from_be_bytes([t0, t1]), usize::from(u16::from_be_bytes([l0, l1])));
            if u16::from_be_bytes([p0, p1]) != PROTOCOL || !(2..=MOST + 3).contains(&length) {
                return Scan::Skip(1);
            }
            match bytes.get(HEADER..HEADER + length) {
                None => Scan::More,
                Some([found, status, data @ ..]) if *found == register && unanswered.contains(&number) => {
                    Scan::Take(HEADER + length, (number, *status, data.to_vec()))
                }
                Some(_) => Scan::Skip(HEADER + length),
            }
        };
        let (number, status, data) = self.link.receive(until.saturating_duration_since(Instant::now()), scan)?;
        self.unanswered.retain(|other| *other != number);
        if status & INVALID != 0 {
            let peer = self.link.peer();
            return Err(AdapterError::Rejected(format!(
                "{peer}: the control box has no result for register {register}"
            )));
        }
        Ok((status, data))
    }

    /// Returns the first frame that `scan` takes.
    fn next<T>(&mut self, scan: &mut impl FnMut(&[u8]) -> Scan<T>) -> Option<T> {
        loop {
            let skipped = self.skip.min(self.received.len());
            self.received.drain(..skipped);
            self.skip -= skipped;
            if self.received.is_empty() {
                return None;
            }
            let (used, frame) = match scan(&self.received) {
                Scan::More => return None,
                Scan::Skip(n) => (n, None),
                Scan::Take(n, frame) => (n, Some(frame)),
            };
            self.skip = used.max(1);
            if frame.is_some() {
                return frame;
            }
        }
    }
}

impl ByteLink for ToolLine {
    fn send(&mut self, bytes: &[u8]) -> AdapterResult<()> {
        if bytes.len() > MOST {
            return Err(AdapterError::Rejected(format!("more than {MOST} bytes at once do not fit the tool's line")));
        }
        self.post(PASS_ON, bytes)
    }

    fn receive<T>(&mut self, timeout: Duration, mut scan: impl FnMut(&[u8]) -> Scan<T>) -> AdapterResult<T> {
        let until = Instant::now() + timeout;
        loop {
            if let Some(frame) = self.next(&mut scan) {
                return Ok(frame);
            }
            if self.unanswered.is_empty() {
                let peer = self.link.peer();
                return Err(AdapterError::Timeout(format!("{peer}: nothing more came from the tool's line")));
            }
            if let [TOOL, data @ ..] = &self.response(PASS_ON, until)?.1[..] {
                self.received.extend(data);
            }
        }
    }

    fn drain(&mut self) -> AdapterResult<()> {
        self.unanswered.clear();
        self.received.clear();
        self.skip = 0;
        self.link.drain()
    }

    fn abort(self) {
        self.link.abort();
    }
}

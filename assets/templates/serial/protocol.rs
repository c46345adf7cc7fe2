//! The wire format: pure encoding and decoding, in the wire's own units (counts). No I/O here.
//!
//! YOUR ARM: this sheet is made up, in the way most servo buses speak. Write down the vendor's here, and then change
//! the code below to match it.
//!
//! ```text
//! request  A5 | servo | opcode | length | payload | sum     servo: from 1, 0 = all of them. Numbers big-endian
//! reply    5A | servo | error  | length | payload | sum     sum: u8, of all bytes before it
//!
//! 01 HELLO   one servo      → model u16, firmware major u8, minor u8
//! 02 STATE   all            → each in turn: flags u8 (1 motor on, 2 moving), position u16, velocity i16 [counts/s],
//!                             goal u16
//! 03 MOTORS  all: 0 off, 1 on (a servo then goes to its goal)                           no reply
//! 04 GOALS   all: for each servo position u16, top speed u16 [counts/s], 0 = none       no reply
//! 04 GOALS   one servo: position u16, top speed u16                                     no reply
//! 05 CLEAR   all: clears errors                                                         no reply
//!
//! error  bits: 1 overload, 2 too hot, 4 supply voltage
//! ```
//!
//! Replies do not say which request they answer: a late one looks like the next one. So the line forgets what has
//! arrived before each request, and what has no reply is read back where it matters.

use dimos_hardware::transport::Scan;

use super::SERVOS;

/// What the servos say their model is.
pub const MODEL: u16 = 1; // YOUR ARM

/// Bytes before the payload.
const HEADER: usize = 4;
/// Room for the longest request.
pub const MAX_REQUEST: usize = HEADER + 4 * SERVOS + 1;
/// Length of the data of the replies to HELLO and STATE.
pub const HELLO: usize = 4;
pub const STATE: usize = 7;

/// What servos can be asked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Request<'a> {
    /// Of this servo.
    Hello(u8),
    State,
    Motors(bool),
    /// Positions, and a top speed [counts/s] for all; 0 = none.
    Goals(&'a [i32; SERVOS], u16),
    /// The same for one servo (from 1), without a top speed.
    Goal(u8, i32),
    Clear,
}

/// Writes the frame of a request into `frame`; the answer is the part that was written.
pub fn encode<'a>(request: Request<'_>, frame: &'a mut [u8; MAX_REQUEST]) -> &'a [u8] {
    let mut at = HEADER;
    let mut put = |bytes: &[u8]| {
        if let Some(to) = frame.get_mut(at..at + bytes.len()) {
            to.copy_from_slice(bytes);
            at += bytes.len();
        }
    };
    let (servo, opcode) = match request {
        Request::Hello(servo) => (servo, 0x01),
        Request::State => (0, 0x02),
        Request::Motors(on) => {
            put(&[u8::from(on)]);
            (0, 0x03)
        }
        Request::Goals(goals, speed) => {
            for goal in goals {
                put(&(*goal as u16).to_be_bytes());
                put(&speed.to_be_bytes());
            }
            (0, 0x04)
        }
        Request::Goal(servo, goal) => {
            put(&(goal as u16).to_be_bytes());
            put(&[0, 0]);
            (servo, 0x04)
        }
        Request::Clear => (0, 0x05),
    };
    frame.iter_mut().zip([0xA5, servo, opcode, (at - HEADER) as u8]).for_each(|(to, byte)| *to = byte);
    let sum = sum(frame.get(..at).unwrap_or_default());
    frame.iter_mut().skip(at).take(1).for_each(|to| *to = sum);
    frame.get(..=at).unwrap_or_default()
}

/// The checksum.
fn sum(bytes: &[u8]) -> u8 {
    bytes.iter().fold(0, |sum, byte| sum.wrapping_add(*byte))
}

/// A servo's reply.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Reply<'a> {
    /// Its number.
    pub servo: u8,
    /// Its error bits; 0 = none.
    pub error: u8,
    pub data: &'a [u8],
}

/// Finds a reply with this much data at the front of `bytes`. Noise, damage and other replies are skipped.
///
/// YOUR ARM: where data is escaped (byte stuffing), let [`Reply::data`] be an array and copy the data there without the
/// escapes; the frame is then longer than its data.
pub fn scan(bytes: &[u8], length: usize) -> Scan<Reply<'_>> {
    let noise = bytes.iter().take_while(|byte| **byte != 0x5A).count();
    if noise > 0 {
        return Scan::Skip(noise);
    }
    let Some([_, servo, error, n]) = bytes.first_chunk::<HEADER>() else { return Scan::More };
    if usize::from(*n) != length {
        return Scan::Skip(1);
    }
    let Some(frame) = bytes.get(..HEADER + length + 1) else { return Scan::More };
    match frame.split_last() {
        Some((check, body)) if sum(body) == *check => Scan::Take(
            frame.len(),
            Reply { servo: *servo, error: *error, data: body.get(HEADER..).unwrap_or_default() },
        ),
        _ => Scan::Skip(1),
    }
}

/// What error bits mean. YOUR ARM: every bit of the manual, in the manual's words.
pub fn error_text(error: u8) -> &'static str {
    match error {
        0 => "",
        e if e & 1 != 0 => "overload",
        e if e & 2 != 0 => "too hot",
        e if e & 4 != 0 => "supply voltage out of range",
        _ => "an error that the sheet does not list",
    }
}

/// A servo's state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Servo {
    pub on: bool,
    pub moving: bool,
    /// [counts]
    pub position: i32,
    /// [counts/s]
    pub velocity: i32,
    /// [counts]
    pub goal: i32,
    /// Error bits; 0 = none.
    pub error: u8,
}

impl Servo {
    /// Decodes a reply to STATE.
    pub fn decode(reply: &Reply<'_>) -> Option<Self> {
        let [flags, p0, p1, v0, v1, g0, g1] = *<&[u8; STATE]>::try_from(reply.data).ok()?;
        Some(Self {
            on: flags & 1 != 0,
            moving: flags & 2 != 0,
            position: u16::from_be_bytes([p0, p1]).into(),
            velocity: i16::from_be_bytes([v0, v1]).into(),
            goal: u16::from_be_bytes([g0, g1]).into(),
            error: reply.error,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::super::golden::{self, bytes};
    use super::*;

    #[test]
    fn requests_are_the_golden_bytes() {
        let mut goals = [0; SERVOS];
        goals.iter_mut().zip(golden::GOALS).for_each(|(to, (goal, _))| *to = goal);
        let mut frame = [0; MAX_REQUEST];
        for (request, golden) in [
            (Request::Hello(3), bytes(golden::HELLO)),
            (Request::State, bytes(golden::STATE)),
            (Request::Motors(true), bytes(golden::MOTORS)),
            (Request::Clear, bytes(golden::CLEAR)),
            (Request::Goals(&goals, 500), golden::goals()),
            (Request::Goal(3, 2048), bytes(golden::GOAL)),
        ] {
            assert_eq!(encode(request, &mut frame), golden, "{request:?}");
        }
    }

    #[test]
    fn replies_are_read_from_the_golden_bytes() {
        let frame = bytes(golden::HELLO_REPLY);
        let data = &[0, 1, 2, 3][..];
        assert_eq!(scan(&frame, HELLO), Scan::Take(frame.len(), Reply { servo: 3, error: 0, data }));
        let frame = bytes(golden::STATE_REPLY);
        let Scan::Take(_, reply) = scan(&frame, STATE) else { panic!("no reply") };
        let servo = Servo { on: true, moving: true, position: 2048, velocity: -100, goal: 2000, error: 1 };
        assert_eq!((reply.servo, Servo::decode(&reply)), (2, Some(servo)));
    }

    #[test]
    fn noise_damage_and_foreign_replies_are_skipped() {
        let good = bytes(golden::STATE_REPLY);
        assert_eq!(scan(&good, HELLO), Scan::Skip(1), "the reply to another request");
        assert_eq!(scan(b"noise\x5a", STATE), Scan::Skip(5));
        for i in 0..good.len() {
            assert_eq!(scan(&good[..i], STATE), Scan::More, "{i} bytes of a frame");
            let mut damaged = good.clone();
            damaged[i] ^= 0x10;
            assert!(!matches!(scan(&damaged, STATE), Scan::Take(..)), "byte {i} damaged");
        }
    }
}

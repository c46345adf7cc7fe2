//! The primary interface: who the controller is, what its errors are, and why a program fails.

use super::Reader;
use crate::hardware::transport::Scan;

/// Types of packets, of messages and of parts of the state that are used here.
const STATE: u8 = 16;
const MESSAGE: u8 = 20;
const CONFIGURATION: u8 = 6;
const VERSION: u8 = 3;
const ERROR: u8 = 6;
const EXCEPTION: u8 = 10;
/// Shortest packet, the longest one that is decoded, and the longest one there may be.
const SHORTEST: usize = 5;
const DECODED: usize = 4096;
const LONGEST: usize = 1 << 20;
/// Types of packets are below this.
const KINDS: u8 = 64;
/// Levels of errors, from which on one is kept: 2 is a warning, which every protective stop has.
pub const WARNING: i32 = 2;
/// Added to the level of an error for the vendor's developers.
const DEVELOPER: i32 = 128;

/// What the configuration says.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Configuration {
    /// Lowest and highest position of each joint [rad].
    pub ranges: [(f64, f64); 6],
    /// Top speed of each joint [rad/s].
    pub speeds: [f64; 6],
    /// Type of the robot.
    pub kind: u32,
}

/// A packet that matters here. Only an exception allocates.
#[derive(Debug, Clone, PartialEq)]
pub enum Packet {
    /// Version of the controller's software: major, minor, bugfix.
    Version(u8, u8, i32),
    /// A state with a configuration.
    Configuration(Configuration),
    /// An error.
    Error {
        /// C code.
        code: i32,
        /// A argument.
        argument: i32,
        /// Level, from 0 (debug) to 5 (critical).
        level: i32,
    },
    /// A program failed at this line, counted from 1.
    Exception {
        /// Line.
        line: i32,
        /// What is wrong.
        text: String,
    },
    /// Anything else.
    Other,
}

/// Scans for the next packet.
pub fn scan(bytes: &[u8]) -> Scan<Packet> {
    let [a, b, c, d, kind, ..] = bytes else { return Scan::More };
    let size = i32::from_be_bytes([*a, *b, *c, *d]) as usize;
    if !(SHORTEST..=LONGEST).contains(&size) || *kind >= KINDS {
        return Scan::Skip(1);
    }
    if size > DECODED {
        return Scan::Skip(size);
    }
    match bytes.get(5..size) {
        None => Scan::More,
        Some(content) => Scan::Take(size, decode(*kind, content)),
    }
}

fn decode(kind: u8, content: &[u8]) -> Packet {
    match kind {
        STATE => configuration(content).map_or(Packet::Other, Packet::Configuration),
        MESSAGE => message(&mut Reader::new(content)).unwrap_or(Packet::Other),
        _ => Packet::Other,
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).trim_matches(['\0', ' ']).to_owned()
}

/// Decodes a message; `None` for one that is cut off or does not matter.
fn message(reader: &mut Reader<'_>) -> Option<Packet> {
    reader.take(9); // time and source
    let packet = match reader.u8() {
        VERSION => {
            let length = reader.u8();
            reader.take(length.into());
            Packet::Version(reader.u8(), reader.u8(), reader.i32())
        }
        ERROR => {
            let (code, argument, level) = (reader.i32(), reader.i32(), reader.i32());
            Packet::Error { code, argument, level: if level >= DEVELOPER { level - DEVELOPER } else { level } }
        }
        EXCEPTION => {
            let (line, _) = (reader.i32(), reader.i32());
            Packet::Exception { line, text: text(reader.rest()) }
        }
        _ => return None,
    };
    reader.ok.then_some(packet)
}

/// Finds the configuration among the parts of a state.
fn configuration(content: &[u8]) -> Option<Configuration> {
    let mut reader = Reader::new(content);
    loop {
        let (length, kind) = (reader.u32(), reader.u8());
        let body = reader.take((length as usize).checked_sub(5)?);
        if !reader.ok {
            return None;
        }
        if kind == CONFIGURATION {
            let mut body = Reader::new(body);
            let ranges = std::array::from_fn(|_| (body.f64(), body.f64()));
            let speeds = std::array::from_fn(|_| (body.f64(), body.f64()).0);
            body.take(5 * 8 + 4 * 6 * 8 + 2 * 4);
            let found = Configuration { ranges, speeds, kind: body.u32() };
            return body.ok.then_some(found);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(kind: u8, content: &[u8]) -> Vec<u8> {
        [&(5 + content.len() as i32).to_be_bytes()[..], &[kind], content].concat()
    }

    fn said(kind: u8, body: &[u8]) -> Packet {
        let bytes = packet(MESSAGE, &[&[0; 8][..], &[253, kind], body].concat());
        match scan(&bytes) {
            Scan::Take(size, found) if size == bytes.len() => found,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn messages() {
        let version = said(VERSION, b"\x09URControl\x05\x0b\0\0\0\x02\0\0\0\x0901-01-2022");
        assert_eq!(version, Packet::Version(5, 11, 2));
        let error = said(ERROR, b"\0\0\0\x99\0\0\0\x01\0\0\0\x82\0\0\0\0\0\0\0\0text");
        assert_eq!(error, Packet::Error { code: 153, argument: 1, level: 2 });
        let wrong = said(EXCEPTION, b"\0\0\0\x07\0\0\0\x02compile_error_name_not_found:x:");
        assert_eq!(wrong, Packet::Exception { line: 7, text: "compile_error_name_not_found:x:".into() });
        assert_eq!(said(0, b"text"), Packet::Other);
        assert_eq!(said(ERROR, b"\0\0"), Packet::Other, "cut off");
    }

    #[test]
    fn the_configuration_is_found_behind_other_parts() {
        let mut body = Vec::new();
        (0..6).for_each(|j| [-f64::from(j), f64::from(j)].iter().for_each(|v| body.extend(v.to_be_bytes())));
        (0..6).for_each(|j| [f64::from(j) / 2.0, 9.0].iter().for_each(|v| body.extend(v.to_be_bytes())));
        body.extend([0; 5 * 8 + 4 * 6 * 8 + 8]);
        body.extend([0, 0, 0, 7, 0, 0, 0, 1]);
        assert_eq!(body.len() + 5, 445, "the vendor's own size");
        let part = |kind: u8, body: &[u8]| [&(5 + body.len() as u32).to_be_bytes()[..], &[kind], body].concat();
        let state = packet(STATE, &[part(0, &[1; 42]), part(CONFIGURATION, &body), part(7, &[])].concat());
        let Scan::Take(_, Packet::Configuration(found)) = scan(&state) else { panic!("no configuration") };
        assert_eq!((found.kind, found.ranges[2], found.speeds[4]), (7, (-2.0, 2.0), 2.0));
        assert_eq!(scan(&packet(STATE, &part(0, &[1; 42]))), Scan::Take(52, Packet::Other));
        assert_eq!(scan(&packet(STATE, &[0, 0, 9, 9, 0])), Scan::Take(10, Packet::Other), "a part that is cut off");
    }

    #[test]
    fn long_packets_are_skipped_as_a_whole() {
        let bytes = packet(STATE, &[0; 9000]);
        assert_eq!(scan(&bytes[..100]), Scan::Skip(9005));
        let absurd = [&(1_i32 << 21).to_be_bytes()[..], &[STATE, 0]].concat();
        assert_eq!(scan(&absurd), Scan::Skip(1));
    }

    #[test]
    fn packets_come_in_pieces_and_among_noise() {
        let bytes = packet(25, &[1, 2, 3]);
        assert_eq!(scan(&bytes[..7]), Scan::More);
        assert_eq!(scan(&[0xFF, 0, 0, 0, 1, 2]), Scan::Skip(1));
        assert_eq!(scan(&bytes), Scan::Take(8, Packet::Other));
    }
}

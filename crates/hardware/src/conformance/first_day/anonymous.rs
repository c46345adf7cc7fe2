//! Removes a serial number from what was captured, and mends the checksums of the messages that had it.

use std::ops::Range;

use crate::transport::Scan;
use crate::transport::capture::Chunk;
use crate::wire::{Place, Wire};

use super::report::Line;

/// What a serial number becomes.
const NOTHING: u8 = b'0';
/// Shorter texts may be anywhere by chance.
const SHORTEST: usize = 4;

/// Replaces `serial` by zeros of the same length, wherever it is. Returns how often it was found.
pub fn remove(serial: &str, wire: Option<&Wire>, lines: &[Line], chunks: &mut [Chunk]) -> usize {
    let mut found = 0;
    if serial.len() < SHORTEST {
        return found;
    }
    for (index, line) in lines.iter().enumerate() {
        for sent in [true, false] {
            let place = Place { connection: &line.name, sent };
            let mut of: Vec<&mut Chunk> =
                chunks.iter_mut().filter(|chunk| chunk.connection == index && chunk.sent == sent).collect();
            if line.datagrams {
                for chunk in of {
                    let all = 0..chunk.bytes.len();
                    found += replace(&mut chunk.bytes, serial, wire, place, &[all]);
                }
                continue;
            }
            // A number may be in two chunks.
            let mut stream: Vec<u8> = of.iter().flat_map(|chunk| chunk.bytes.iter().copied()).collect();
            let places = occurrences(&stream, serial.as_bytes());
            if places.is_empty() {
                continue;
            }
            let messages = wire.map(|wire| messages(wire, place, &stream)).unwrap_or_default();
            found += replace(&mut stream, serial, wire, place, &messages);
            let mut rest = stream.into_iter();
            for chunk in &mut of {
                chunk.bytes.iter_mut().zip(&mut rest).for_each(|(to, byte)| *to = byte);
            }
        }
    }
    found
}

fn occurrences(bytes: &[u8], what: &[u8]) -> Vec<usize> {
    bytes.windows(what.len()).enumerate().filter(|(_, window)| *window == what).map(|(at, _)| at).collect()
}

fn replace(bytes: &mut [u8], serial: &str, wire: Option<&Wire>, place: Place<'_>, messages: &[Range<usize>]) -> usize {
    let places = occurrences(bytes, serial.as_bytes());
    for at in &places {
        bytes.iter_mut().skip(*at).take(serial.len()).for_each(|byte| *byte = NOTHING);
        let within = messages.iter().find(|message| message.contains(at));
        if let Some((wire, message)) = wire.zip(within.and_then(|message| bytes.get_mut(message.clone()))) {
            (wire.mend)(place, message);
        }
    }
    places.len()
}

/// Returns where the messages of a stream are.
fn messages(wire: &Wire, place: Place<'_>, stream: &[u8]) -> Vec<Range<usize>> {
    let (mut at, mut found) = (0, Vec::new());
    while let Some(rest) = stream.get(at..).filter(|rest| !rest.is_empty()) {
        match (wire.scan)(place, rest) {
            Scan::More => break,
            Scan::Skip(n) => at += n.max(1),
            Scan::Take(n, _) => {
                found.push(at..at + n);
                at += n.max(1);
            }
        }
    }
    found
}

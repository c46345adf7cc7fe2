//! RTDE packets: a length of two bytes, header included, a type, and the content.

use dimos_hardware::transport::Scan;

/// Types of packets.
pub mod kind {
    /// Asks for a version of the protocol.
    pub const PROTOCOL: u8 = b'V';
    /// Asks for the version of the controller's software.
    pub const SOFTWARE: u8 = b'v';
    /// A text for people.
    pub const TEXT: u8 = b'M';
    /// Names the values that the controller sends.
    pub const OUTPUTS: u8 = b'O';
    /// Names values that the client sends.
    pub const INPUTS: u8 = b'I';
    /// Starts the controller's data.
    pub const START: u8 = b'S';
    /// Values.
    pub const DATA: u8 = b'U';
}

/// Length of the header.
pub const HEADER: usize = 3;
/// The protocol's version that this adapter speaks.
pub const VERSION: u16 = 2;
/// Longest packet other than data that a controller sends: a text has at most two strings of 255 bytes.
const LONGEST: usize = 2048;

/// Returns a packet.
pub fn encode(kind: u8, content: &[u8]) -> Vec<u8> {
    let length = (HEADER + content.len()) as u16;
    [&length.to_be_bytes()[..], &[kind], content].concat()
}

/// Returns the request for output values at a rate [Hz], or for input values without one.
pub fn recipe(rate: Option<f64>, names: &str) -> Vec<u8> {
    match rate {
        Some(rate) => encode(kind::OUTPUTS, &[&rate.to_be_bytes()[..], names.as_bytes()].concat()),
        None => encode(kind::INPUTS, names.as_bytes()),
    }
}

/// Scans for the reply of one type. Other packets are skipped: a controller may send texts and, on a connection that
/// was started, data at any time.
pub fn reply<T>(bytes: &[u8], wanted: u8, decode: impl FnOnce(&[u8]) -> T) -> Scan<T> {
    let [high, low, kind, ..] = bytes else { return Scan::More };
    let length = usize::from(u16::from_be_bytes([*high, *low]));
    if !(HEADER..=LONGEST).contains(&length) {
        return Scan::Skip(1);
    }
    match bytes.get(HEADER..length) {
        None => Scan::More,
        Some(content) if *kind == wanted => Scan::Take(length, decode(content)),
        Some(_) => Scan::Skip(length),
    }
}

/// What arrives on a connection that was started.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Arrived<T> {
    /// Values.
    Data(T),
    /// Something else, such as a text.
    Other,
}

/// Scans for data of a recipe whose packets have `length` bytes; `decode` refuses content that no controller sends.
/// There is no checksum, so a packet counts only if another packet's header, or nothing yet, follows it: noise costs
/// packets, not the connection.
pub fn data<T>(bytes: &[u8], recipe: u8, length: usize, decode: impl FnOnce(&[u8]) -> Option<T>) -> Scan<Arrived<T>> {
    let [high, low, kind, ..] = bytes else { return Scan::More };
    let found = usize::from(u16::from_be_bytes([*high, *low]));
    match *kind {
        kind::DATA if found == length => match bytes.get(HEADER..length) {
            None => Scan::More,
            Some([id, content @ ..]) if *id == recipe && follows(bytes.get(length..).unwrap_or_default()) => {
                decode(content).map_or(Scan::Skip(1), |values| Scan::Take(length, Arrived::Data(values)))
            }
            Some(_) => Scan::Skip(1),
        },
        kind::TEXT if (HEADER..=LONGEST).contains(&found) => match bytes.get(HEADER..found) {
            None => Scan::More,
            Some(_) => Scan::Take(found, Arrived::Other),
        },
        _ => Scan::Skip(1),
    }
}

/// Returns whether these bytes may be the beginning of a packet.
fn follows(bytes: &[u8]) -> bool {
    match bytes {
        [high, low, kind, ..] => {
            let length = usize::from(u16::from_be_bytes([*high, *low]));
            matches!(*kind, kind::DATA | kind::TEXT) && (HEADER..=LONGEST).contains(&length)
        }
        _ => true,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reply_is_found_among_other_packets() {
        let text = encode(kind::TEXT, b"\x02hi\x01x\x03");
        let version = encode(kind::PROTOCOL, &[1]);
        let bytes = [&text[..], &version].concat();
        let scan = |bytes: &[u8]| reply(bytes, kind::PROTOCOL, <[u8]>::to_vec);
        assert_eq!(scan(&bytes), Scan::Skip(text.len()));
        assert_eq!(scan(&bytes[text.len()..]), Scan::Take(4, vec![1]));
        assert_eq!(scan(&version[..3]), Scan::More);
        assert_eq!(scan(&[0, 1, b'V']), Scan::Skip(1));
    }

    #[test]
    fn half_a_packet_costs_one_and_no_nonsense_is_taken() {
        let whole = encode(kind::DATA, &[7, 1, 2, 3, 4]);
        let scan = |bytes: &[u8]| data(bytes, 7, whole.len(), |content| Some(content.to_vec()));
        assert_eq!(scan(&whole), Scan::Take(8, Arrived::Data(vec![1, 2, 3, 4])));
        assert_eq!(scan(&[&whole[..], &whole[..2]].concat()), Scan::Take(8, Arrived::Data(vec![1, 2, 3, 4])));
        // The second half of the first one is missing.
        let cut = [&whole[..4], &whole[..], &whole[..]].concat();
        assert_eq!(scan(&cut), Scan::Skip(1));
        assert_eq!(scan(&cut[4..]), Scan::Take(8, Arrived::Data(vec![1, 2, 3, 4])));
        assert_eq!(data(&whole, 7, whole.len(), |_| None::<()>), Scan::Skip(1));
        assert_eq!(data(&whole, 8, whole.len(), |_| Some(())), Scan::Skip(1));
        let text = encode(kind::TEXT, b"\x02hi\x01x\x03");
        assert_eq!(scan(&text), Scan::Take(text.len(), Arrived::Other));
    }
}

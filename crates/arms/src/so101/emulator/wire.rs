//! The servos' side of the wire format: instructions in, statuses out.

use dimos_hardware::transport::Scan;

/// Number of all servos at once.
pub const ALL: u8 = 0xFE;

/// An instruction packet.
#[derive(Debug, Clone, PartialEq)]
pub struct Packet {
    /// The servo's number, or [`ALL`].
    pub id: u8,
    /// The instruction.
    pub instruction: u8,
    /// Its parameters.
    pub parameters: Vec<u8>,
}

/// Finds a packet at the front of the received bytes. Packets with a wrong checksum are skipped, as servos do.
pub fn packet(bytes: &[u8]) -> Scan<Packet> {
    let Some(at) =
        (0..bytes.len()).find(|i| bytes.get(*i) == Some(&0xFF) && bytes.get(i + 1).is_none_or(|b| *b == 0xFF))
    else {
        return Scan::Skip(bytes.len());
    };
    if at > 0 {
        return Scan::Skip(at);
    }
    match bytes {
        [0xFF, 0xFF, id, length, rest @ ..] if *id != 0xFF && *length >= 2 => {
            let length = usize::from(*length);
            let Some(body) = rest.get(..length) else { return Scan::More };
            let total = body.iter().fold(id.wrapping_add(length as u8), |sum, byte| sum.wrapping_add(*byte));
            match body {
                [instruction, parameters @ .., _] if total == 0xFF => {
                    let packet = Packet { id: *id, instruction: *instruction, parameters: parameters.to_vec() };
                    Scan::Take(4 + length, packet)
                }
                _ => Scan::Skip(2),
            }
        }
        [0xFF, 0xFF, _, _, ..] => Scan::Skip(1),
        _ => Scan::More,
    }
}

/// Appends a servo's status.
pub fn status(answer: &mut Vec<u8>, id: u8, error: u8, data: &[u8]) {
    let begin = answer.len() + 2;
    answer.extend([0xFF, 0xFF, id, data.len() as u8 + 2, error]);
    answer.extend_from_slice(data);
    let total = answer.iter().skip(begin).fold(0u8, |sum, byte| sum.wrapping_add(*byte));
    answer.push(!total);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packets_and_statuses_are_those_of_the_vendors_sdk() {
        let goal = [0xFF, 0xFF, 0x01, 0x05, 0x03, 0x2A, 0x00, 0x08, 0xC4];
        let wanted = Packet { id: 1, instruction: 3, parameters: vec![0x2A, 0x00, 0x08] };
        assert_eq!(packet(&goal), Scan::Take(9, wanted));
        assert_eq!(packet(&goal[..6]), Scan::More);
        assert_eq!(packet(&[7, 0xFF, 0xFF]), Scan::Skip(1));
        let mut damaged = goal;
        damaged[8] = 0;
        assert_eq!(packet(&damaged), Scan::Skip(2));
        let mut answer = Vec::new();
        status(&mut answer, 1, 0, &[0x09, 0x03]);
        assert_eq!(answer, [0xFF, 0xFF, 0x01, 0x04, 0x00, 0x09, 0x03, 0xEE]);
    }
}

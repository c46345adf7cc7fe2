//! What becomes of an answer or report on its way: the faults of the wire.

use std::time::Duration;

/// How an answer or report is delivered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Delivery {
    /// It is sent.
    Send,
    /// It is sent this much later, and with it all that was requested later over the same connection.
    Late(Duration),
    /// It is sent, and the connection ends.
    HangUp,
    /// It is sent this much later; no client is served until then.
    Stall(Duration),
    /// It is lost.
    Silent,
    /// The report before it is sent again; an answer is sent.
    Frozen,
    /// Noise goes before it.
    Garbage,
    /// One of its bytes is wrong.
    Corrupt,
    /// Only its first half is sent.
    Truncated,
    /// All connections end; a CAN interface in memory is down for this long.
    Disconnect(Duration),
    /// All connections end, and there is no power for this long.
    PowerLoss(Duration),
    /// The computer's CAN controller leaves the bus.
    BusOff,
    /// The CAN interface has no room for the frames of one command or, if `true`, for any while the fault lasts.
    NoBuffers(bool),
}

impl Delivery {
    /// Does to an answer what a fault of the wire does to its bytes: `noise` goes before it, the byte at `spot` is
    /// wrong, or its second half is missing.
    pub fn damage(self, answer: &mut Vec<u8>, noise: &[u8], spot: usize) {
        match self {
            Self::Garbage => drop(answer.splice(0..0, noise.iter().copied())),
            Self::Corrupt => answer.get_mut(spot).into_iter().for_each(|byte| *byte ^= 0x40),
            Self::Truncated => answer.truncate(answer.len() / 2),
            _ => {}
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn damage_adds_changes_or_removes_bytes() {
        let after = |delivery: Delivery| {
            let mut answer = vec![1, 2, 3, 4];
            delivery.damage(&mut answer, &[9, 9], 3);
            answer
        };
        assert_eq!(after(Delivery::Garbage), [9, 9, 1, 2, 3, 4]);
        assert_eq!(after(Delivery::Corrupt), [1, 2, 3, 0x44]);
        assert_eq!(after(Delivery::Truncated), [1, 2]);
        assert_eq!(after(Delivery::Send), [1, 2, 3, 4]);
    }
}

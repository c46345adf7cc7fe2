//! Delivery of responses and reports: faults of the wire.

use std::time::Duration;

/// Minimum duration of a fault that cuts the connection: longer than any adapter tolerates silence.
pub(super) const MIN_CUT: Duration = Duration::from_millis(800);

/// How a response or report is delivered.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Delivery {
    /// Sent normally.
    Send,
    /// Not known yet: the request is served again a little later, with all that follows it on the same connection.
    Pending,
    /// Sent after this delay, together with later responses on the same connection.
    Late(Duration),
    /// Sent, then the connection is closed.
    HangUp,
    /// Sent after this delay; no client is served meanwhile.
    Stall(Duration),
    /// Lost.
    Silent,
    /// The previous report is sent again; a response is sent normally.
    Frozen,
    /// Sent after noise.
    Garbage,
    /// Sent with one wrong byte.
    Corrupt,
    /// Only the first half is sent.
    Truncated,
    /// All connections are closed; a CAN interface in memory is down for this time.
    Disconnect(Duration),
    /// All connections are closed, and there is no power for this time.
    PowerLoss(Duration),
    /// The computer's CAN controller leaves the bus.
    BusOff,
    /// The CAN interface has no room for the frames of one command or, if `true`, for any while the fault lasts.
    NoBuffers(bool),
}

impl Delivery {
    /// Damages a response as this fault does: puts `noise` before it, changes the byte at `spot`, or drops its second
    /// half.
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

//! Frames that were sent and are not known to have been transmitted.
//!
//! A confirmation (the kernel's echo of a frame) removes its frame. Controllers with several mailboxes send frames with
//! lower identifiers first, so confirmations may be slightly out of order.

use std::collections::VecDeque;

use super::CanFrame;

/// Maximum number of tracked frames.
const CAPACITY: usize = 64;
/// A frame that this many later ones have overtaken will not be confirmed: its confirmation was lost.
const OVERTAKEN: usize = 8;

/// Frames in flight of one port, the oldest first.
#[derive(Debug)]
pub struct InFlight {
    frames: VecDeque<CanFrame>,
}

impl InFlight {
    /// Returns an empty list.
    pub fn new() -> Self {
        Self { frames: VecDeque::with_capacity(CAPACITY) }
    }

    /// Adds a frame that was sent.
    pub fn sent(&mut self, frame: CanFrame) {
        if self.frames.len() == CAPACITY {
            self.frames.pop_front();
        }
        self.frames.push_back(frame);
    }

    /// Removes a frame that was transmitted.
    pub fn confirmed(&mut self, frame: &CanFrame) {
        if let Some(at) = self.frames.iter().position(|waiting| waiting == frame) {
            self.frames.remove(at);
            self.frames.drain(..at.saturating_sub(OVERTAKEN - 1));
        }
    }

    /// Clears the list: confirmations were lost, or frames were taken back.
    pub fn clear(&mut self) {
        self.frames.clear();
    }

    /// Returns how many frames are not known to have been transmitted.
    pub fn len(&self) -> usize {
        self.frames.len()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(n: usize) -> CanFrame {
        CanFrame::new(0x155, &[n as u8])
    }

    #[test]
    fn what_is_confirmed_is_not_in_flight() {
        let mut frames = InFlight::new();
        (0..4).for_each(|n| frames.sent(frame(n)));
        frames.sent(frame(0));
        for (n, left) in [(1, 4), (0, 3), (9, 3), (3, 2), (2, 1), (2, 1), (0, 0)] {
            frames.confirmed(&frame(n));
            assert_eq!(frames.len(), left, "{n}");
        }
    }

    #[test]
    fn a_lost_confirmation_is_forgotten() {
        let mut frames = InFlight::new();
        (0..20).for_each(|n| frames.sent(frame(n)));
        (1..8).for_each(|n| frames.confirmed(&frame(n)));
        assert_eq!(frames.len(), 13, "the first may still come");
        frames.confirmed(&frame(15));
        assert_eq!(frames.len(), 11, "7 before it may still come");
        (0..200).for_each(|n| frames.sent(frame(n)));
        assert_eq!(frames.len(), CAPACITY);
        frames.clear();
        assert_eq!(frames.len(), 0);
    }
}

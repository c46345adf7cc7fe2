//! Assembles three consecutive frames of one burst into one set of six values.

use std::time::Duration;

use dimos_core::clock::Mono;

/// Frames of one burst arrive within less than a period of the arm.
const BURST: Duration = Duration::from_millis(4);

/// Three frames with two values each.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct FrameSet {
    parts: [[i32; 2]; 3],
    next: usize,
    began: Mono,
}

impl FrameSet {
    /// Adds a frame; returns the set that it completes.
    pub fn take(&mut self, part: usize, pair: [i32; 2], now: Mono) -> Option<[i32; 6]> {
        if part == 0 {
            self.began = now;
        } else if part != self.next || now.since(self.began) > BURST {
            self.next = 0;
            return None;
        }
        *self.parts.get_mut(part)? = pair;
        self.next = (part + 1) % 3;
        let [[a, b], [c, d], [e, f]] = self.parts;
        (self.next == 0).then_some([a, b, c, d, e, f])
    }
}

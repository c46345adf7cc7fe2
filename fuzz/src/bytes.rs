//! Numbers out of the bytes of an input.

/// What is left of an input.
#[derive(Debug, Clone, Copy)]
pub struct Bytes<'a>(pub &'a [u8]);

impl<'a> Bytes<'a> {
    /// Returns whether nothing is left.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// Takes a byte; 0 at the end.
    pub fn byte(&mut self) -> u8 {
        let (first, rest) = self.0.split_first().map_or((0, self.0), |(first, rest)| (*first, rest));
        self.0 = rest;
        first
    }

    /// Takes a number below `most`.
    pub fn below(&mut self, most: usize) -> usize {
        usize::from(self.byte()) % most.max(1)
    }

    /// Takes a number between two, in 65,536 steps.
    pub fn between(&mut self, low: f64, high: f64) -> f64 {
        let steps = u16::from_le_bytes([self.byte(), self.byte()]);
        low + (high - low) * f64::from(steps) / f64::from(u16::MAX)
    }

    /// Takes any number, with the odd ones: not finite, huge, tiny.
    pub fn number(&mut self) -> f64 {
        match self.byte() {
            0 => f64::NAN,
            1 => f64::INFINITY,
            2 => f64::NEG_INFINITY,
            3 => 1e300,
            4 => -1e-300,
            5 => 0.0,
            6 => -0.0,
            _ => self.between(-4.0, 4.0),
        }
    }

    /// Takes up to `most` bytes.
    pub fn take(&mut self, most: usize) -> &'a [u8] {
        let (first, rest) = self.0.split_at(most.min(self.0.len()));
        self.0 = rest;
        first
    }
}

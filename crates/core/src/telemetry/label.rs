//! Names of fixed size: the tick may not allocate.

use std::fmt;

/// Longest name that is kept whole [bytes].
const LENGTH: usize = 47;

/// A name of a link or an object, cut at 47 bytes.
#[derive(Clone, Copy, PartialEq, Eq)]
pub struct Label {
    length: u8,
    bytes: [u8; LENGTH],
}

impl Label {
    /// Copies a name; cuts it between two characters.
    pub fn new(name: &str) -> Self {
        let length = (0..=LENGTH.min(name.len())).rev().find(|end| name.is_char_boundary(*end)).unwrap_or(0);
        let mut bytes = [0; LENGTH];
        for (to, byte) in bytes.iter_mut().zip(name.bytes().take(length)) {
            *to = byte;
        }
        Self { length: length as u8, bytes }
    }

    /// Returns the name.
    pub fn as_str(&self) -> &str {
        let bytes = self.bytes.get(..usize::from(self.length)).unwrap_or_default();
        std::str::from_utf8(bytes).unwrap_or_default()
    }
}

impl Default for Label {
    fn default() -> Self {
        Self::new("")
    }
}

impl fmt::Debug for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self.as_str(), f)
    }
}

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn long_names_are_cut_between_characters() {
        assert_eq!(Label::new("left/link_7").as_str(), "left/link_7");
        assert_eq!(Label::new(&"x".repeat(60)).as_str(), "x".repeat(47));
        assert_eq!(Label::new(&format!("{}ä", "x".repeat(46))).as_str(), "x".repeat(46));
        assert_eq!(Label::default().as_str(), "");
    }
}

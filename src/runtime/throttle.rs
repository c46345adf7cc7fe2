//! Keeps the terminal readable: of each kind of event only so many a second are shown. The log has all of them.

use std::collections::HashMap;
use std::time::Duration;

use crate::clock::Mono;

/// Lines of one kind in one window.
const SHOWN: u32 = 3;
/// Length of a window.
const WINDOW: Duration = Duration::from_secs(1);

/// Counts what was shown of each kind.
#[derive(Debug, Default)]
pub struct Throttle(HashMap<&'static str, (Mono, u32)>);

impl Throttle {
    /// Whether an event is shown, and how many of its kind were not since the last that was.
    pub fn admit(&mut self, kind: &'static str, now: Mono) -> Option<u32> {
        let (since, count) = self.0.entry(kind).or_insert((now, 0));
        if now.since(*since) >= WINDOW {
            let unsaid = count.saturating_sub(SHOWN);
            (*since, *count) = (now, 1);
            return Some(unsaid);
        }
        *count += 1;
        (*count <= SHOWN).then_some(0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_flood_is_cut_short_and_counted() {
        let mut t = Throttle::default();
        let at = |ms: u64| Mono(1 + ms * 1_000_000);
        let shown = (0..100).filter(|k| t.admit("overrun", at(*k)).is_some()).count();
        assert_eq!(shown, SHOWN as usize);
        assert_eq!(t.admit("task", at(50)), Some(0));
        assert_eq!(t.admit("overrun", at(1500)), Some(97));
    }
}

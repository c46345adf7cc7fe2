//! Times in which the tick thread could not run. A state that could not be seen did not come late: the age of a state
//! counts without them.

use std::time::Duration;

use crate::clock::Mono;

/// Delays below this are ordinary wake-ups.
const SHORTEST: Duration = Duration::from_millis(1);
/// Delays that are remembered: each lasts at least [`SHORTEST`], and only the last tenths of a second matter.
const KEPT: usize = 16;

/// The latest delays of the tick.
#[derive(Debug, Clone, Copy, Default)]
pub struct Stalls {
    /// End and length of each.
    kept: [(Mono, Duration); KEPT],
    next: usize,
    /// End of the latest.
    latest: Mono,
}

impl Stalls {
    /// A tick woke at `woke`, this much after its deadline.
    pub fn note(&mut self, woke: Mono, late: Duration) {
        if late < SHORTEST {
            return;
        }
        if let Some(slot) = self.kept.get_mut(self.next) {
            *slot = (woke, late);
        }
        self.next = (self.next + 1) % KEPT;
        self.latest = self.latest.max(woke);
    }

    /// How much of the time from `from` to `until` was lost.
    pub fn between(&self, from: Mono, until: Mono) -> Duration {
        if self.latest <= from {
            return Duration::ZERO;
        }
        let overlap = |&(end, length): &(Mono, Duration)| end.min(until).since(end.before(length).max(from));
        self.kept.iter().map(overlap).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_part_in_the_interval_counts() {
        let ms = |t: u64| Mono(t * 1_000_000);
        let mut stalls = Stalls::default();
        stalls.note(ms(150), Duration::from_millis(40));
        stalls.note(ms(200), Duration::from_micros(900));
        stalls.note(ms(260), Duration::from_millis(5));
        let lost = |from, until| stalls.between(ms(from), ms(until)).as_millis();
        assert_eq!(lost(0, 300), 45);
        assert_eq!(lost(130, 300), 25);
        assert_eq!(lost(120, 140), 20);
        assert_eq!(lost(151, 200), 0);
    }
}

//! Times in which the tick thread could not run. They do not count as age of a state: a newer one may have arrived
//! meanwhile.

use std::time::Duration;

use dimos_core::clock::Mono;

/// Shorter delays are normal wake-up latency.
const SHORTEST: Duration = Duration::from_millis(1);
/// Number of delays kept: each is at least [`SHORTEST`], and only those of the last tenths of a second matter.
const KEPT: usize = 16;

/// The latest delays of the tick.
#[derive(Debug, Clone, Copy, Default)]
pub struct Stalls {
    /// End and length of each delay.
    kept: [(Mono, Duration); KEPT],
    next: usize,
    /// End of the latest delay.
    latest: Mono,
}

impl Stalls {
    /// Takes a wake-up: its time, and its delay after the deadline.
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

    /// Returns the time between `from` and `until` in which the tick thread could not run.
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

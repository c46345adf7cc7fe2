//! Lock-free histogram of durations, written by one thread and read by others: atomic counters, 16 buckets per power of
//! two, so that a percentile is at most 6 % too high.

use std::sync::atomic::{AtomicU64, Ordering};

/// Buckets per power of two.
const BUCKETS_PER_POWER: usize = 16;
/// Number of powers of two: up to 2^36 ns, about 69 s.
const POWERS: usize = 33;
/// Durations that [`Histogram::cumulative`] shows [ns].
const SHOWN: std::ops::RangeInclusive<u64> = 1 << 10..=1 << 30;

/// Counts of durations in nanoseconds.
#[derive(Debug)]
pub struct Histogram {
    buckets: Vec<AtomicU64>,
    highest: AtomicU64,
}

impl Default for Histogram {
    fn default() -> Self {
        Self {
            buckets: (0..POWERS * BUCKETS_PER_POWER).map(|_| AtomicU64::new(0)).collect(),
            highest: AtomicU64::new(0),
        }
    }
}

/// Percentiles of a histogram.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Figures {
    /// Number of durations.
    pub count: u64,
    /// Median [µs].
    pub p50: f64,
    /// 99th percentile [µs].
    pub p99: f64,
    /// 99.9th percentile [µs].
    pub p99_9: f64,
    /// Maximum [µs].
    pub max: f64,
}

impl Histogram {
    /// Counts a duration [ns]. Wait-free.
    pub fn record(&self, ns: u64) {
        if let Some(bucket) = self.buckets.get(index_of(ns)) {
            bucket.fetch_add(1, Ordering::Relaxed);
        }
        self.highest.fetch_max(ns, Ordering::Relaxed);
    }

    /// Returns the current percentiles.
    pub fn figures(&self) -> Figures {
        let counts: Vec<u64> = self.buckets.iter().map(|b| b.load(Ordering::Relaxed)).collect();
        let count: u64 = counts.iter().sum();
        let highest = self.highest.load(Ordering::Relaxed);
        let quantile = |q: f64| {
            let rank = ((count as f64 * q).ceil() as u64).max(1);
            let mut seen = 0;
            let bucket = counts.iter().position(|n| {
                seen += n;
                seen >= rank
            });
            bucket.map_or(0.0, |b| upper_end(b).min(highest) as f64 / 1e3)
        };
        Figures { count, p50: quantile(0.5), p99: quantile(0.99), p99_9: quantile(0.999), max: highest as f64 / 1e3 }
    }

    /// Returns how many durations are at most 1, 2, 4, … µs long (2^10, 2^11, … ns, less 1 ns) up to 1 s, and the
    /// number of all: `([(duration [ns], count)], count)`. No count is ever less than before.
    pub fn cumulative(&self) -> (Vec<(u64, u64)>, u64) {
        let (mut below, mut seen) = (Vec::new(), 0);
        for (index, bucket) in self.buckets.iter().enumerate() {
            seen += bucket.load(Ordering::Relaxed);
            let end = upper_end(index);
            if (end + 1).is_power_of_two() && SHOWN.contains(&(end + 1)) {
                below.push((end, seen));
            }
        }
        (below, seen)
    }
}

fn index_of(ns: u64) -> usize {
    if ns < BUCKETS_PER_POWER as u64 {
        return ns as usize;
    }
    let power = ns.ilog2() as usize;
    let fine = (ns >> (power - 4)) as usize & (BUCKETS_PER_POWER - 1);
    ((power - 3) * BUCKETS_PER_POWER + fine).min(POWERS * BUCKETS_PER_POWER - 1)
}

fn upper_end(bucket: usize) -> u64 {
    if bucket < BUCKETS_PER_POWER {
        return bucket as u64;
    }
    let (power, fine) = (bucket / BUCKETS_PER_POWER + 3, (bucket % BUCKETS_PER_POWER) as u64);
    ((BUCKETS_PER_POWER as u64 + fine + 1) << (power - 4)) - 1
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_are_right_to_six_percent() {
        let h = Histogram::default();
        (1..=100_000u64).for_each(|us| h.record(us * 1_000));
        let f = h.figures();
        for (got, right) in [(f.p50, 50_000.0), (f.p99, 99_000.0), (f.p99_9, 99_900.0)] {
            assert!(got >= right * 0.999 && got <= right * 1.0626, "{got} for {right}");
        }
        assert_eq!((f.count, f.max), (100_000, 100_000.0));
    }

    #[test]
    fn durations_up_to_powers_of_two_are_counted_exactly() {
        let h = Histogram::default();
        for ns in [0, 1023, 1024, 2047, 2048, (1 << 30) - 1, 1 << 30, u64::MAX] {
            h.record(ns);
        }
        let (below, all) = h.cumulative();
        assert_eq!((below.len(), all), (21, 8));
        assert_eq!((below[0], below[1], below[2]), ((1023, 2), (2047, 4), (4095, 5)));
        assert_eq!(below[20], ((1 << 30) - 1, 6));
    }

    #[test]
    fn every_duration_has_its_bucket_and_the_longest_do_not_overflow() {
        for ns in (0..4096).chain([u64::MAX, 1 << 36, (1 << 36) - 1]) {
            let b = index_of(ns);
            assert!(b < POWERS * BUCKETS_PER_POWER);
            assert!(ns > 1 << 35 || upper_end(b) >= ns, "{ns}");
        }
        assert_eq!(Histogram::default().figures(), Figures::default());
    }
}

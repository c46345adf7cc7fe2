//! How the requests of a planner have ended, counted since its start.

use std::time::Duration;

use super::Progress;

/// Durations that plans are counted by [ms].
const LIMITS: [u64; 11] = [1, 3, 10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000];

/// Ended requests.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Tally {
    /// Requests whose motion was found.
    pub found: u64,
    /// Requests without a motion.
    pub failed: u64,
    /// Requests that were cancelled.
    pub cancelled: u64,
    /// How many took longer than the limit before, and at most this one.
    within: [u64; LIMITS.len()],
}

impl Tally {
    /// Counts a request, if it has ended.
    pub(super) fn count(&mut self, progress: &Progress) {
        let (ends, took) = match progress {
            Progress::Planning(_) => return,
            Progress::Found(_, took) => (&mut self.found, took),
            Progress::Failed(failure, took) if failure.cancelled => (&mut self.cancelled, took),
            Progress::Failed(_, took) => (&mut self.failed, took),
        };
        *ends += 1;
        let limit = LIMITS.iter().position(|limit| *took <= Duration::from_millis(*limit));
        limit.and_then(|limit| self.within.get_mut(limit)).into_iter().for_each(|count| *count += 1);
    }

    /// Returns how many requests took at most this long [ns], and the number of all.
    pub fn durations(&self) -> (Vec<(u64, u64)>, u64) {
        let mut seen = 0;
        let below = LIMITS.iter().zip(&self.within).map(|(limit, count)| {
            seen += count;
            (limit * 1_000_000, seen)
        });
        (below.collect(), self.found + self.failed + self.cancelled)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::request::pipeline::PlanFailure;

    #[test]
    fn what_has_ended_is_counted_by_how_and_by_how_long_it_took() {
        let failed = |failure, ms| Progress::Failed(failure, Duration::from_millis(ms));
        let mut tally = Tally::default();
        tally.count(&Progress::Planning(std::time::Instant::now()));
        assert_eq!(tally, Tally::default());
        tally.count(&failed(PlanFailure::new("no way"), 10));
        tally.count(&failed(PlanFailure::new("no way"), 11));
        tally.count(&failed(PlanFailure::cancelled(), 200_000));
        assert_eq!((tally.found, tally.failed, tally.cancelled), (0, 2, 1));
        let (below, all) = tally.durations();
        assert_eq!((below[1], below[2], below[3]), ((3_000_000, 0), (10_000_000, 1), (30_000_000, 2)));
        assert_eq!((below[10].1, all), (2, 3));
    }
}

//! When a tick begins: on a grid of this computer's clock, or with each state that one arm streams.
//!
//! An arm whose controller sends its state in every cycle and expects a setpoint for it, in the same cycle, is the
//! clock of its run. The other arms follow. When it is silent, this computer's clock continues at the same rate, so
//! that they are still commanded and watched.

use std::time::Duration;

use super::coordinator::TickTime;
use dimos_core::arm::ArmState;
use dimos_core::clock::{Clock, Mono};
use dimos_rt::heartbeat::Heartbeat;
use dimos_rt::host;
use dimos_rt::slot::SlotReader;
use dimos_rt::wake::Wake;

/// What starts the ticks.
#[derive(Debug)]
pub enum Source {
    /// This computer's clock.
    Host,
    /// The states of an arm.
    Device {
        /// Index of the arm.
        arm: usize,
        /// Raised by its device thread with each new state.
        wake: Wake,
        /// Time between two of its states.
        cycle: Duration,
    },
}

/// The start of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Start {
    /// The times of the tick.
    pub time: TickTime,
    /// When the thread woke.
    pub woke: Mono,
    /// Whether the arm that clocks the ticks was silent.
    pub unprompted: bool,
}

/// Waits for the start of each tick. Two ticks begin at least half a period apart: there is never a burst.
#[derive(Debug)]
pub struct Pacer {
    source: Source,
    period: Duration,
    /// When the next tick is due.
    due: Mono,
    /// When the thread woke last.
    woke: Mono,
    /// With [`Source::Host`]: periods that the latest tick skipped, and its lateness [ns].
    skipped: (u32, u64),
    /// With [`Source::Device`]: number of the latest state that was considered.
    seq: u64,
    silent: bool,
}

impl Pacer {
    /// Creates a pacer whose first tick is due a period after `now`.
    pub fn new(source: Source, now: Mono, period: Duration) -> Self {
        let period = period.max(Duration::from_nanos(1));
        Self { source, period, due: now.after(period), woke: Mono::ZERO, skipped: (0, 0), seq: 0, silent: false }
    }

    /// Waits until the next tick begins. `beat` learns when the thread is due to wake.
    pub fn wait(&mut self, clock: &dyn Clock, beat: &Heartbeat, states: &mut [SlotReader<ArmState>]) -> Start {
        loop {
            let latest = self.latest();
            beat.sleep_until(latest);
            let state = match &self.source {
                Source::Host => {
                    host::sleep_until(latest);
                    None
                }
                Source::Device { arm, wake, .. } => {
                    wake.wait(latest.since(clock.now()));
                    states.get_mut(*arm).map(|slot| slot.read())
                }
            };
            beat.awake();
            if let Some(start) = self.begin(clock.now(), state.map(|state| (state.seq, state.stamp))) {
                return start;
            }
        }
    }

    /// Returns when the next tick begins at the latest. A state may be late by a third of a period, so that the one
    /// after it is not too early for a tick; an arm that has missed one is not waited for.
    fn latest(&self) -> Mono {
        match self.source {
            Source::Device { .. } if !self.silent => self.due.after(self.period / 3),
            _ => self.due,
        }
    }

    /// Returns the tick that begins now, if one does. `state`: number and time of the clocking arm's newest state.
    fn begin(&mut self, woke: Mono, state: Option<(u64, Mono)>) -> Option<Start> {
        let Source::Device { cycle, .. } = self.source else {
            return Some(self.on_the_grid(woke));
        };
        if let Some((seq, stamp)) = state.filter(|(seq, _)| *seq != self.seq) {
            self.seq = seq;
            let early = stamp.after(cycle / 2) < self.due || woke < self.woke.after(self.period / 2);
            if !early {
                return Some(self.prompted(woke, stamp.min(woke)));
            }
            if self.silent && stamp.after(self.period) > woke {
                // It sends again, in another phase: the next tick is that of its next state.
                (self.due, self.silent) = (stamp.min(woke).after(self.period), false);
            }
        }
        (woke >= self.latest()).then(|| self.unprompted(woke))
    }

    /// A tick for a state of the arm, measured at `stamp`.
    fn prompted(&mut self, woke: Mono, stamp: Mono) -> Start {
        let skipped = missed_periods(self.due, stamp.after(self.period / 2), self.period);
        let late_ns = woke.0.saturating_sub(stamp.0);
        let cause = if skipped > 0 { woke.0.saturating_sub(self.due.0) } else { late_ns };
        let next = stamp.after(self.period);
        let time = TickTime { now: stamp, next, skipped, late_ns: cause, woke_late_ns: late_ns };
        (self.due, self.woke, self.silent) = (next, woke, false);
        Start { time, woke, unprompted: false }
    }

    /// A tick without a state of the arm.
    fn unprompted(&mut self, woke: Mono) -> Start {
        // The wait for a state that did not come is no lateness of this computer, and does not move the grid.
        let latest = self.latest();
        let skipped = missed_periods(latest, woke, self.period);
        let now = latest.after(self.period * skipped);
        let late_ns = woke.0.saturating_sub(latest.0);
        let next = self.due.after(self.period * (skipped + 1));
        let time = TickTime { now, next, skipped, late_ns, woke_late_ns: late_ns };
        (self.due, self.woke, self.silent) = (next, woke, true);
        Start { time, woke, unprompted: true }
    }

    fn on_the_grid(&mut self, woke: Mono) -> Start {
        let late_ns = woke.0.saturating_sub(self.due.0);
        let missed = missed_periods(self.due, woke, self.period);
        let now = self.due.after(self.period * missed);
        let (next, skips_after) = next_deadline(now, woke, self.period);
        let (skipped_before, late_before) = self.skipped;
        // What was skipped before this tick is reported with the lateness that caused it.
        let cause = if skipped_before > 0 { late_ns.max(late_before) } else { late_ns };
        let time = TickTime { now, next, skipped: skipped_before + missed, late_ns: cause, woke_late_ns: late_ns };
        (self.due, self.woke, self.skipped) = (next, woke, (skips_after, late_ns));
        Start { time, woke, unprompted: false }
    }
}

/// Returns the number of whole periods lost by a late wake-up. The tick then uses the last deadline before it as "now".
pub fn missed_periods(deadline: Mono, woke: Mono, period: Duration) -> u32 {
    let period = (period.as_nanos() as u64).max(1);
    (woke.0.saturating_sub(deadline.0) / period).min(u32::MAX as u64) as u32
}

/// Returns the next deadline of the grid and the number of skipped ones: two ticks are at least half a period apart,
/// and there is never a burst.
pub fn next_deadline(deadline: Mono, woke: Mono, period: Duration) -> (Mono, u32) {
    let period = (period.as_nanos() as u64).max(1);
    let next = deadline.0.saturating_add(period);
    let earliest = woke.0.saturating_add(period / 2);
    let skipped = earliest.saturating_sub(next).div_ceil(period);
    (Mono(next.saturating_add(skipped * period)), skipped.min(u32::MAX as u64) as u32)
}

#[cfg(test)]
mod tests {
    use super::*;

    const P: Duration = Duration::from_millis(10);

    fn ms(ms: f64) -> Mono {
        Mono((ms * 1e6) as u64)
    }

    fn device(cycle: Duration) -> Pacer {
        let source = Source::Device { arm: 0, wake: Wake::new().unwrap(), cycle };
        Pacer::new(source, ms(90.0), P)
    }

    fn now_and_skipped(start: Option<Start>) -> Option<(Mono, u32, bool)> {
        start.map(|start| (start.time.now, start.time.skipped, start.unprompted))
    }

    #[test]
    fn f20_an_overrun_skips_whole_periods_and_never_bursts() {
        for (woke, next, skipped) in [
            (100.0, 110.0, 0),
            (104.9, 110.0, 0),
            (105.0, 110.0, 0),
            (105.1, 120.0, 1),
            (112.0, 120.0, 1),
            (119.0, 130.0, 2),
            (150.0, 160.0, 5),
            (1234.0, 1240.0, 113),
        ] {
            let missed = missed_periods(ms(100.0), ms(woke), P);
            let deadline = ms(100.0).after(P * missed);
            let (n, s) = next_deadline(deadline, ms(woke), P);
            assert_eq!((n, missed + s), (ms(next), skipped), "woke at {woke}");
            assert!(deadline <= ms(woke) && ms(woke).since(deadline) < P);
            assert!(n.since(ms(woke)) >= P / 2);
        }
    }

    #[test]
    fn each_state_begins_a_tick_at_its_own_time_whatever_its_rate() {
        // A controller whose clock is 1 % slow, with arrivals that are up to 0.4 ms late.
        let mut pacer = device(P);
        for k in 0..500u32 {
            let stamp = 100.3 + 10.1 * f64::from(k);
            let woke = ms(stamp + 0.1 * f64::from(k % 5));
            let start = pacer.begin(woke, Some((u64::from(k) + 1, ms(stamp)))).unwrap();
            assert_eq!((start.time.now, start.time.skipped, start.unprompted), (ms(stamp), 0, false), "state {k}");
            assert_eq!(start.time.woke_late_ns, woke.0 - ms(stamp).0);
            assert_eq!(start.time.late_ns, start.time.woke_late_ns);
            assert_eq!(start.time.next, ms(stamp).after(P));
        }
    }

    #[test]
    fn the_same_state_begins_one_tick() {
        let mut pacer = device(P);
        assert!(pacer.begin(ms(100.1), Some((1, ms(100.0)))).is_some());
        assert_eq!(pacer.begin(ms(106.0), Some((1, ms(100.0)))), None);
    }

    #[test]
    fn a_tick_takes_every_second_state_of_an_arm_that_is_twice_as_fast() {
        let mut pacer = device(P / 2);
        let mut begun = Vec::new();
        for k in 0..8u64 {
            let stamp = ms(100.0 + 5.0 * k as f64);
            begun.extend(pacer.begin(stamp, Some((k + 1, stamp))).map(|start| start.time.now));
        }
        assert_eq!(begun, [100.0, 110.0, 120.0, 130.0].map(ms));
    }

    #[test]
    fn a_silent_arm_is_waited_for_once_and_then_this_computers_clock_continues() {
        let mut pacer = device(P);
        assert!(pacer.begin(ms(100.0), Some((1, ms(100.0)))).is_some());
        let latest = ms(110.0).after(P / 3);
        assert_eq!(pacer.latest(), latest);
        assert_eq!(pacer.begin(ms(113.3), Some((1, ms(100.0)))), None);
        assert_eq!(now_and_skipped(pacer.begin(latest, Some((1, ms(100.0))))), Some((latest, 0, true)));
        for k in 0..4 {
            let at = ms(120.0 + 10.0 * f64::from(k));
            assert_eq!(pacer.latest(), at);
            assert_eq!(now_and_skipped(pacer.begin(at, Some((1, ms(100.0))))), Some((at, 0, true)));
        }
        // It sends again, in another phase: within half a period of the latest tick nothing begins.
        assert_eq!(pacer.begin(ms(154.0), Some((2, ms(154.0)))), None);
        assert_eq!(pacer.latest(), ms(164.0).after(P / 3));
        for k in 0..5u8 {
            let at = ms(164.0 + 10.0 * f64::from(k));
            assert_eq!(now_and_skipped(pacer.begin(at, Some((3 + u64::from(k), at)))), Some((at, 0, false)));
        }
    }

    #[test]
    fn a_state_that_is_late_by_more_than_a_period_does_not_move_the_grid() {
        let mut pacer = device(P);
        pacer.begin(ms(100.0), Some((1, ms(100.0))));
        assert!(pacer.begin(ms(113.4), Some((1, ms(100.0)))).is_some_and(|start| start.unprompted));
        for k in 0..5u8 {
            assert_eq!(pacer.begin(ms(114.0), Some((2 + u64::from(k), ms(101.0 + 0.5 * f64::from(k))))), None);
        }
        assert_eq!(now_and_skipped(pacer.begin(ms(120.0), Some((7, ms(103.5))))), Some((ms(120.0), 0, true)));
    }

    #[test]
    fn a_state_half_a_period_after_the_tick_without_one_begins_the_next() {
        let mut pacer = device(P);
        pacer.begin(ms(100.0), Some((1, ms(100.0))));
        assert!(pacer.begin(ms(113.4), Some((1, ms(100.0)))).is_some_and(|start| start.unprompted));
        assert_eq!(now_and_skipped(pacer.begin(ms(118.4), Some((2, ms(118.4))))), Some((ms(118.4), 0, false)));
    }

    #[test]
    fn after_one_lost_state_the_next_begins_a_tick_again() {
        let mut pacer = device(P);
        pacer.begin(ms(100.0), Some((1, ms(100.0))));
        let latest = pacer.latest();
        assert_eq!(now_and_skipped(pacer.begin(latest, Some((1, ms(100.0))))), Some((latest, 0, true)));
        let start = pacer.begin(ms(120.0), Some((3, ms(120.0))));
        assert_eq!(now_and_skipped(start), Some((ms(120.0), 0, false)));
    }

    #[test]
    fn lost_states_and_stalls_are_skipped_periods() {
        let mut pacer = device(P);
        pacer.begin(ms(100.0), Some((1, ms(100.0))));
        // This computer was stalled; the arm continued to send.
        let start = pacer.begin(ms(151.0), Some((6, ms(150.0)))).unwrap();
        assert_eq!(now_and_skipped(Some(start)), Some((ms(150.0), 4, false)));
        assert_eq!((start.time.late_ns, start.time.woke_late_ns), (41_000_000, 1_000_000));
        // It was stalled, and the arm silent.
        let start = pacer.begin(ms(196.0), Some((6, ms(150.0)))).unwrap();
        assert_eq!(now_and_skipped(Some(start)), Some((ms(160.0).after(P / 3).after(P * 3), 3, true)));
        assert_eq!(start.time.next, ms(200.0));
    }

    #[test]
    fn a_state_that_waited_for_a_long_tick_begins_no_second_one_at_once() {
        let mut pacer = device(P);
        pacer.begin(ms(104.0), Some((1, ms(100.0))));
        assert_eq!(pacer.begin(ms(108.9), Some((2, ms(106.0)))), None, "4.9 ms after the last");
        assert!(pacer.begin(ms(116.0), Some((3, ms(116.0)))).is_some());
    }

    #[test]
    fn a_stamp_in_the_future_is_taken_for_now() {
        let mut pacer = device(P);
        let start = pacer.begin(ms(100.0), Some((1, ms(400.0)))).unwrap();
        assert_eq!(start.time.now, ms(100.0));
    }

    #[test]
    fn on_the_grid_an_overrun_is_reported_with_the_lateness_that_caused_it() {
        let mut pacer = Pacer::new(Source::Host, ms(90.0), P);
        let mut at = |woke: f64| {
            let TickTime { now, next, skipped, late_ns, woke_late_ns } = pacer.begin(ms(woke), None).unwrap().time;
            (now, next, skipped, late_ns / 1_000_000, woke_late_ns / 1_000_000)
        };
        assert_eq!(at(100.0), (ms(100.0), ms(110.0), 0, 0, 0));
        // Late by more than half a period: the next deadline is skipped, and reported by the tick after it.
        assert_eq!(at(118.0), (ms(110.0), ms(130.0), 0, 8, 8));
        assert_eq!(at(131.0), (ms(130.0), ms(140.0), 1, 8, 1));
        // Late by two periods.
        assert_eq!(at(163.0), (ms(160.0), ms(170.0), 2, 23, 23));
        assert_eq!(at(170.0), (ms(170.0), ms(180.0), 0, 0, 0));
    }

    #[test]
    fn limits_of_what_is_too_early() {
        let mut pacer = device(P);
        pacer.begin(ms(100.0), Some((1, ms(100.0))));
        assert!(pacer.begin(ms(105.0), Some((2, ms(105.0)))).is_some(), "half a period after the last");
        // Its time may be that of half a cycle before the tick is due.
        assert!(pacer.begin(ms(112.0), Some((3, ms(110.0)))).is_some());
    }
}

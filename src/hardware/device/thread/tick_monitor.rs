//! Monitors the tick's heartbeat: without it, the device thread holds the arm.

use std::time::Duration;

use super::Worker;
use crate::clock::Mono;

/// Longest delay of this thread, or of a tick that got no processor, that is tolerated on top of the heartbeat's
/// timeout.
const MAX_DELAY: Duration = Duration::from_millis(100);

/// What this thread has seen since the tick's latest heartbeat.
#[derive(Debug, Default)]
pub(super) struct Seen {
    /// The heartbeat.
    beat: Option<Mono>,
    /// How late this thread has woken in total since then.
    late: Duration,
    /// Processor time of the tick when this thread first saw the heartbeat.
    cpu_time: Option<Duration>,
}

impl Worker {
    /// Returns how much longer the tick's heartbeat may be absent; `Duration::MAX` while no command moves the arm.
    pub(super) fn until_tick_timeout(&self, now: Mono) -> Duration {
        let Some(silence) = self.config.beat.silence(now).filter(|_| self.moving()) else { return Duration::MAX };
        let timeout = self.config.beat_timeout();
        let left = (timeout + self.tick.late).saturating_sub(silence);
        // A tick that got no processor does not hang: it is past its wake-up time, or waits in mid-computation. Up to
        // MAX_DELAY that is tolerated.
        let overdue = self.config.beat.overdue(now);
        if !overdue.is_zero() {
            left.max(MAX_DELAY.saturating_sub(overdue))
        } else if left.is_zero() && self.tick_waits() {
            (self.config.tick_period + MAX_DELAY).saturating_sub(silence)
        } else {
            left
        }
    }

    /// Returns whether the tick was without a processor for at least a third of the time since it had to wake: one that
    /// hangs in a loop uses nearly all of it.
    fn tick_waits(&self) -> bool {
        let hangs = self.config.beat_timeout().saturating_sub(self.config.tick_period) * 2 / 3;
        let used = self.config.beat.cpu_time().zip(self.tick.cpu_time);
        used.is_some_and(|(now, before)| now.saturating_sub(before) < hangs)
    }

    /// Notes the tick after a wake-up of this thread. A late wake-up adds to the tolerated silence: the computer was
    /// stalled, including the tick.
    pub(super) fn see_tick(&mut self, late: Duration) {
        let beat = self.config.beat.last();
        if self.tick.beat != beat {
            self.tick = Seen { beat, late: Duration::ZERO, cpu_time: self.config.beat.cpu_time() };
        }
        if (Duration::from_millis(1)..MAX_DELAY).contains(&late) {
            self.tick.late = (self.tick.late + late).min(MAX_DELAY);
        }
    }

    /// Holds the arm when the tick's heartbeat is missing for too long.
    pub(super) fn check_tick(&mut self) {
        if self.until_tick_timeout(self.config.clock.now()).is_zero() {
            self.state.self_held = true;
            self.stop_pending = true;
            let silence = self.config.beat.silence(self.config.clock.now()).unwrap_or_default().as_millis();
            let limit = self.config.beat_timeout().as_millis();
            self.trouble(&format!("no tick for {silence} ms (limit {limit} ms): held by the device thread"));
            self.states.write(&self.state);
        }
    }
}

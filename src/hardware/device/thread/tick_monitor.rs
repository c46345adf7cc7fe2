//! Monitors the tick's heartbeat: without it, the device thread holds the arm.

use std::time::Duration;

use super::Worker;
use crate::clock::Mono;

/// Longest delay of this thread, or of a tick that got no processor, that is tolerated on top of the heartbeat's
/// timeout.
const MAX_DELAY: Duration = Duration::from_millis(100);

impl Worker {
    /// Returns how much longer the tick's heartbeat may be absent; `Duration::MAX` while no command moves the arm.
    pub(super) fn until_tick_timeout(&self, now: Mono) -> Duration {
        let Some(silence) = self.config.beat.silence(now).filter(|_| self.moving()) else { return Duration::MAX };
        let timeout = self.config.beat_timeout();
        let left = (timeout + self.delay.1).saturating_sub(silence);
        // A tick that is past its wake-up time does not hang: it got no processor. Up to MAX_DELAY that is tolerated.
        let overdue = self.config.beat.overdue(now);
        if overdue.is_zero() { left } else { left.max(MAX_DELAY.saturating_sub(overdue)) }
    }

    /// Adds a late wake-up of this thread to the tolerated silence: the computer was stalled, including the tick.
    pub(super) fn add_delay(&mut self, late: Duration) {
        let beat = self.config.beat.last();
        if self.delay.0 != beat {
            self.delay = (beat, Duration::ZERO);
        }
        if (Duration::from_millis(1)..MAX_DELAY).contains(&late) {
            self.delay.1 = (self.delay.1 + late).min(MAX_DELAY);
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

//! Monitors the tick's heartbeat: without it, the device thread holds the arm.

#[cfg(test)]
mod tests;

use std::time::Duration;

use super::Worker;
use dimos_core::clock::Mono;

/// Longest delay of this thread, or of a tick that got no processor, that is tolerated on top of the heartbeat's
/// timeout.
pub(super) const MAX_DELAY: Duration = Duration::from_millis(100);
/// How long this thread observes the processor time of a silent tick to tell one that hangs from one that waits.
const OBSERVATION: Duration = Duration::from_millis(5);
/// This thread woke late if it was later than this: the computer was stalled, including the tick.
const LATE: Duration = Duration::from_millis(1);

/// What this thread has seen since the tick's latest heartbeat.
#[derive(Debug, Default)]
pub(super) struct Seen {
    /// The heartbeat.
    beat: Option<Mono>,
    /// How late this thread has woken in total since then.
    late: Duration,
    /// Processor time of the tick when this thread first saw the heartbeat.
    cpu_time: Option<Duration>,
    /// Start of the present observation, and the tick's processor time then.
    observed: Option<(Mono, Duration)>,
    /// The tick used the processor for most of the latest observation, and nearly all the time since it had to wake.
    hangs: bool,
}

impl Worker {
    /// Returns the longest time that this thread may wait without checking the tick; `Duration::MAX` while no command
    /// moves the arm.
    pub(super) fn until_tick_check(&self, now: Mono) -> Duration {
        let Some(silence) = self.config.beat.silence(now).filter(|_| self.moving()) else { return Duration::MAX };
        // Two observations before the timeout.
        let suspicious = (self.config.beat_timeout() + self.tick.late).saturating_sub(2 * OBSERVATION);
        suspicious.checked_sub(silence).filter(|left| !left.is_zero()).unwrap_or(OBSERVATION)
    }

    /// Notes the tick after a wake-up of this thread. A late wake-up adds to the tolerated silence: the computer was
    /// stalled, including the tick.
    pub(super) fn see_tick(&mut self, now: Mono, late: Duration) {
        let beat = self.config.beat.last();
        if self.tick.beat != beat {
            self.tick = Seen { beat, cpu_time: self.config.beat.cpu_time(), ..Seen::default() };
        }
        if (LATE..MAX_DELAY).contains(&late) {
            self.tick.late = (self.tick.late + late).min(MAX_DELAY);
        }
        self.observe_tick(now, late >= LATE);
    }

    /// Finds out whether a silent tick hangs in a loop: then it uses processor time all along. One that waits for a
    /// processor uses none. Linux may charge a pause of a virtual machine to it, but not all the time since it had to
    /// wake, and not the latest; a time in which this thread was `stalled` itself is not judged.
    fn observe_tick(&mut self, now: Mono, stalled: bool) {
        let silence = self.config.beat.silence(now).unwrap_or_default();
        if silence <= self.config.tick_period {
            return;
        }
        let Some(used) = self.config.beat.cpu_time() else {
            // The thread has ended.
            self.tick.hangs = true;
            return;
        };
        match self.tick.observed {
            Some((since, before)) if !stalled => {
                let time = now.since(since);
                if time < OBSERVATION {
                    return;
                }
                let since_beat = used.saturating_sub(self.tick.cpu_time.unwrap_or_default());
                let awake = self.config.beat_timeout().saturating_sub(self.config.tick_period);
                self.tick.hangs = used.saturating_sub(before) >= time * 2 / 3 && since_beat >= awake * 9 / 10;
            }
            _ => {}
        }
        self.tick.observed = Some((now, used));
    }

    /// Returns whether the tick's heartbeat has been missing for too long. A tick that gets no processor does not hang:
    /// it is past its wake-up time, or waits in mid-computation. Up to [`MAX_DELAY`] that is tolerated.
    fn tick_timed_out(&self, now: Mono) -> bool {
        let Some(silence) = self.config.beat.silence(now).filter(|_| self.moving()) else { return false };
        if silence < self.config.beat_timeout() + self.tick.late {
            return false;
        }
        let overdue = self.config.beat.overdue(now);
        if !overdue.is_zero() {
            return overdue >= MAX_DELAY;
        }
        self.tick.hangs || silence >= self.config.tick_period + MAX_DELAY
    }

    /// Holds the arm when the tick's heartbeat is missing for too long.
    pub(super) fn check_tick(&mut self) {
        let now = self.config.clock.now();
        if self.tick_timed_out(now) {
            self.state.self_held = true;
            self.stop_pending = true;
            let silence = self.config.beat.silence(now).unwrap_or_default().as_millis();
            let limit = self.config.beat_timeout().as_millis();
            self.trouble(&format!("no tick for {silence} ms (limit {limit} ms): held by the device thread"));
            self.states.write(&self.state);
        }
    }
}

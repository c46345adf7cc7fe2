//! Active motions: a motion is active only while its key is held.
//!
//! A terminal reports no key-up, but key repeats: 10 to 40 times a second, after an initial delay of a quarter to two
//! thirds of a second. So a motion continues for [`SUSTAIN`] after its last key event and has faded to zero at
//! [`FADED_AFTER`]: a tap is a short nudge, a held key a nudge followed by a motion. If the terminal does report
//! key-ups (kitty keyboard protocol), a motion lasts until then; a lost key-up costs [`KEY_TIMEOUT`].

use std::time::{Duration, Instant};

use super::keys::Motion;

/// Time after a key's last repeat during which its motion continues at full speed.
pub const SUSTAIN: Duration = Duration::from_millis(150);
/// Time after a key's last repeat at which its motion has faded to zero.
pub const FADED_AFTER: Duration = Duration::from_millis(250);
/// With key-ups: all motions end after this time without any key event. Longer than the usual delay before repeat.
pub const KEY_TIMEOUT: Duration = Duration::from_secs(1);

/// The active motions.
#[derive(Debug, Default)]
pub struct ActiveMotions {
    keys: Vec<(Motion, Instant)>,
    /// Whether the terminal reports key-ups: known from the first one.
    releases: bool,
    heard: Option<Instant>,
}

impl ActiveMotions {
    /// Handles a key press or repeat.
    pub fn press(&mut self, motion: Motion, now: Instant) {
        self.heard = Some(now);
        self.keys.retain(|(held, _)| *held != motion && *held != motion.opposite());
        self.keys.push((motion, now));
    }

    /// Handles a repeat. A key released in between, as at a stop, must be pressed again.
    pub fn repeat(&mut self, motion: Motion, now: Instant) {
        self.heard = Some(now);
        if let Some((_, last)) = self.keys.iter_mut().find(|(held, _)| *held == motion) {
            *last = now;
        }
    }

    /// Handles a key-up.
    pub fn release(&mut self, motion: Motion, now: Instant) {
        self.releases = true;
        self.heard = Some(now);
        self.keys.retain(|(held, _)| *held != motion);
    }

    /// Releases all keys.
    pub fn clear(&mut self) {
        self.keys.clear();
    }

    /// Returns whether the terminal reports key-ups.
    pub fn knows_releases(&self) -> bool {
        self.releases
    }

    /// Returns the active motions and their strength (0–1).
    pub fn alive(&mut self, now: Instant) -> Vec<(Motion, f64)> {
        let silent = self.heard.is_none_or(|at| now.saturating_duration_since(at) > KEY_TIMEOUT);
        let releases = self.releases;
        let strength = |last: &Instant| match now.saturating_duration_since(*last) {
            _ if releases => f64::from(!silent),
            age if age <= SUSTAIN => 1.0,
            age => 1.0 - ((age - SUSTAIN).as_secs_f64() / (FADED_AFTER - SUSTAIN).as_secs_f64()).min(1.0),
        };
        self.keys.retain(|(_, last)| strength(last) > 0.0);
        self.keys.iter().map(|(motion, last)| (*motion, strength(last))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const UP: Motion = Motion::Axis { axis: 0, up: true };
    const SIDE: Motion = Motion::Axis { axis: 1, up: true };

    fn ms(ms: u64) -> Duration {
        Duration::from_millis(ms)
    }

    #[test]
    fn a_motion_fades_after_its_last_key() {
        let (mut held, start) = (ActiveMotions::default(), Instant::now());
        held.press(UP, start);
        assert_eq!(held.alive(start + ms(150)), [(UP, 1.0)]);
        let half = held.alive(start + ms(200))[0].1;
        assert!((half - 0.5).abs() < 1e-9, "{half}");
        held.press(UP, start + ms(200));
        assert_eq!(held.alive(start + ms(340)), [(UP, 1.0)], "a repeat keeps it");
        assert_eq!(held.alive(start + ms(450)), []);
        held.repeat(UP, start + ms(460));
        assert_eq!(held.alive(start + ms(460)), [], "a repeat does not restart an ended motion");
    }

    #[test]
    fn the_opposite_key_takes_over_and_two_axes_add_up() {
        let (mut held, start) = (ActiveMotions::default(), Instant::now());
        held.press(UP, start);
        held.press(SIDE, start);
        assert_eq!(held.alive(start).len(), 2);
        held.press(UP.opposite(), start);
        assert_eq!(held.alive(start), [(SIDE, 1.0), (UP.opposite(), 1.0)]);
        held.clear();
        assert_eq!(held.alive(start), []);
    }

    #[test]
    fn with_key_ups_they_end_motions_and_a_timeout_ends_all() {
        let (mut held, start) = (ActiveMotions::default(), Instant::now());
        held.release(SIDE, start);
        assert!(held.knows_releases());
        held.press(UP, start);
        assert_eq!(held.alive(start + ms(900)), [(UP, 1.0)], "the delay before repeat does not end it");
        held.repeat(UP, start + ms(900));
        assert_eq!(held.alive(start + ms(1800)), [(UP, 1.0)]);
        assert_eq!(held.alive(start + ms(1901)), [], "a lost key-up");
        held.press(UP, start + ms(2000));
        held.release(UP, start + ms(2010));
        assert_eq!(held.alive(start + ms(2010)), []);
    }
}

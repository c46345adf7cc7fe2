//! Which motions are alive: a key that is held keeps its motion, and nothing else does.
//!
//! A terminal has no key-up. What it has is repeat: a held key comes again 10 to 40 times a second, after a first pause
//! of a quarter to two thirds of a second. So a motion lives for [`FULL`] after its last key, and has faded by [`GONE`]:
//! a tap is a nudge, a held key a nudge and then a motion. Where the terminal does tell that keys go up (the kitty
//! keyboard protocol), a motion lives until then; a key-up that gets lost costs [`SILENCE`].

use std::time::{Duration, Instant};

use super::keys::Motion;

/// After a key's last repeat its motion goes on as it was for so long.
pub const FULL: Duration = Duration::from_millis(150);
/// After a key's last repeat its motion has faded to nothing.
pub const GONE: Duration = Duration::from_millis(250);
/// Where key-ups are told: with no key at all for so long, all motions end. Longer than the usual pause before repeat.
pub const SILENCE: Duration = Duration::from_secs(1);

/// The motions that are alive.
#[derive(Debug, Default)]
pub struct Held {
    keys: Vec<(Motion, Instant)>,
    /// Whether the terminal tells when keys go up: known by the first that does.
    releases: bool,
    heard: Option<Instant>,
}

impl Held {
    /// A key came, first or again.
    pub fn press(&mut self, motion: Motion, now: Instant) {
        self.heard = Some(now);
        self.keys.retain(|(held, _)| *held != motion && *held != motion.opposite());
        self.keys.push((motion, now));
    }

    /// A key came again. One that was let go of in between, as at a stop, must be pressed anew.
    pub fn repeat(&mut self, motion: Motion, now: Instant) {
        self.heard = Some(now);
        if let Some((_, last)) = self.keys.iter_mut().find(|(held, _)| *held == motion) {
            *last = now;
        }
    }

    /// A key went up.
    pub fn release(&mut self, motion: Motion, now: Instant) {
        self.releases = true;
        self.heard = Some(now);
        self.keys.retain(|(held, _)| *held != motion);
    }

    /// Lets go of all keys.
    pub fn clear(&mut self) {
        self.keys.clear();
    }

    /// Whether the terminal tells when keys go up.
    pub fn knows_releases(&self) -> bool {
        self.releases
    }

    /// The motions that are alive, and how strong each is (0–1).
    pub fn alive(&mut self, now: Instant) -> Vec<(Motion, f64)> {
        let silent = self.heard.is_none_or(|at| now.saturating_duration_since(at) > SILENCE);
        let releases = self.releases;
        let strength = |last: &Instant| match now.saturating_duration_since(*last) {
            _ if releases => f64::from(!silent),
            age if age <= FULL => 1.0,
            age => 1.0 - ((age - FULL).as_secs_f64() / (GONE - FULL).as_secs_f64()).min(1.0),
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
        let (mut held, start) = (Held::default(), Instant::now());
        held.press(UP, start);
        assert_eq!(held.alive(start + ms(150)), [(UP, 1.0)]);
        let half = held.alive(start + ms(200))[0].1;
        assert!((half - 0.5).abs() < 1e-9, "{half}");
        held.press(UP, start + ms(200));
        assert_eq!(held.alive(start + ms(340)), [(UP, 1.0)], "a repeat keeps it");
        assert_eq!(held.alive(start + ms(450)), []);
        held.repeat(UP, start + ms(460));
        assert_eq!(held.alive(start + ms(460)), [], "what has ended begins with a press only");
    }

    #[test]
    fn the_opposite_key_takes_over_and_two_axes_add_up() {
        let (mut held, start) = (Held::default(), Instant::now());
        held.press(UP, start);
        held.press(SIDE, start);
        assert_eq!(held.alive(start).len(), 2);
        held.press(UP.opposite(), start);
        assert_eq!(held.alive(start), [(SIDE, 1.0), (UP.opposite(), 1.0)]);
        held.clear();
        assert_eq!(held.alive(start), []);
    }

    #[test]
    fn where_releases_are_told_they_count_and_silence_ends_all() {
        let (mut held, start) = (Held::default(), Instant::now());
        held.release(SIDE, start);
        assert!(held.knows_releases());
        held.press(UP, start);
        assert_eq!(held.alive(start + ms(900)), [(UP, 1.0)], "the pause before repeat is no end");
        held.repeat(UP, start + ms(900));
        assert_eq!(held.alive(start + ms(1800)), [(UP, 1.0)]);
        assert_eq!(held.alive(start + ms(1901)), [], "a key-up that got lost");
        held.press(UP, start + ms(2000));
        held.release(UP, start + ms(2010));
        assert_eq!(held.alive(start + ms(2010)), []);
    }
}

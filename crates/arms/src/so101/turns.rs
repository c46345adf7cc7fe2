//! Positions of a servo counted over the seam of its encoder, and what of them is believed.
//!
//! The encoder counts one turn, 0 to 4095. A reading is the position nearest to the last accepted one. It is accepted
//! when the velocities of the servo explain the way to it, or when readings agree on it for a while: that is a leap,
//! which the joint has not been seen to make.

use super::protocol::{Servo, TURN};
use dimos_core::clock::Mono;

/// Counts of a turn.
const COUNTS: i32 = TURN as i32;
/// What noise and rounding do to a position [counts].
const NOISE: f64 = 24.0;
/// Part of a way by which the velocities may miss it.
const MISSED: f64 = 0.5;
/// Largest sum of unexplained ways that one second forgets [counts, s], beyond a part of the explained ones.
const SLIP: f64 = 96.0;
const FORGOTTEN: f64 = 1.0;
/// A joint that was not read for longer than this may have moved unseen [s], this fast [counts/s].
const UNREAD: f64 = 0.05;
const FASTEST: f64 = 3000.0;
/// A joint that a hand turns is this fast [counts/s].
const BY_HAND: f64 = 6500.0;
/// Readings that agree for this long are accepted [s].
const AGREED: f64 = 0.05;
/// A joint that was seen to leave its goal by this much has left it [counts].
const LEFT: f64 = 40.0;

/// The turns of a servo.
#[derive(Debug, Clone, Copy, Default)]
pub struct Turns {
    /// The last accepted position [counts].
    at: i32,
    /// When the last reading was made; `None`: there is none.
    read: Option<Mono>,
    /// What the velocities explain since the last accepted reading, and since the last leap or change of the goal
    /// [counts].
    explained: f64,
    free: f64,
    /// Sum of unexplained and of explained ways, decaying [counts].
    slip: f64,
    way: f64,
    /// A reading that is not accepted, and since when the readings agree on it.
    doubted: Option<(i32, Mono)>,
    /// Sum of the leaps [counts]: those that cancel were readings that were wrong for a while.
    leapt: i32,
    /// Accepted readings in a row outside the turn in which the range is.
    outside: u32,
    goal: i32,
}

impl Turns {
    /// Takes a reading. Returns the position counted over the seam [counts].
    pub fn take(&mut self, servo: &Servo, now: Mono) -> i32 {
        let Servo { position: raw, velocity, goal, .. } = *servo;
        let Some(read) = self.read.replace(now) else {
            *self = Self { at: raw, read: Some(now), goal, ..Self::default() };
            return raw;
        };
        let dt = now.seconds_since(read);
        if goal != self.goal {
            (self.goal, self.free) = (goal, 0.0);
        }
        self.explained += f64::from(velocity) * dt;
        let near = self.at + around(raw - self.at);
        let step = f64::from(near - self.at);
        let kept = (-dt / FORGOTTEN).exp();
        let (slip, way) = (kept * self.slip + step - self.explained, kept * self.way + self.explained.abs());
        let unseen = if dt > UNREAD { FASTEST * dt } else { 0.0 };
        let missed = (step - self.explained).abs();
        let believed = missed <= NOISE + MISSED * self.explained.abs() + unseen;
        if believed && (slip.abs() <= SLIP + MISSED * way + unseen) {
            (self.slip, self.way) = (if unseen > 0.0 { 0.0 } else { slip }, way);
            self.free += self.explained;
            self.accept(near);
            return near;
        }
        let agrees = |(other, _): &(i32, Mono)| f64::from(around(raw - other)).abs() <= NOISE + BY_HAND * dt;
        let since = self.doubted.filter(agrees).map_or(now, |(_, since)| since);
        self.doubted = Some((raw, since));
        if now.seconds_since(since) >= AGREED {
            self.leapt += (step - self.explained) as i32;
            if f64::from(self.leapt).abs() <= 4.0 * NOISE {
                self.leapt = 0;
            }
            (self.slip, self.way, self.free) = (0.0, 0.0, 0.0);
            self.accept(near);
        }
        near
    }

    fn accept(&mut self, near: i32) {
        (self.at, self.explained, self.doubted) = (near, 0.0, None);
        self.outside = if self.turn() == 0 { 0 } else { self.outside.saturating_add(1) };
    }

    /// Returns the last accepted position [counts].
    pub fn at(&self) -> i32 {
        self.at
    }

    /// Returns whether the last reading is accepted.
    pub fn accepted(&self) -> bool {
        self.doubted.is_none()
    }

    /// Returns whether a leap led to the last accepted position.
    pub fn leapt(&self) -> bool {
        self.leapt != 0
    }

    /// Returns the turn that the joint is in: 0 is that of its range.
    pub fn turn(&self) -> i32 {
        self.at.div_euclid(COUNTS)
    }

    /// Returns whether the joint has crossed the seam: two readings say so, and it was seen to move there. Behind a
    /// leap it was seen to continue, away from its goal: a servo that has crossed drives on round the turn, one whose
    /// readings are wrong rests at its goal.
    pub fn crossed(&self) -> bool {
        let went_on = self.free * f64::from(self.turn().signum()) >= LEFT;
        self.outside >= 2 && (self.leapt == 0 || went_on)
    }
}

/// Returns the shortest way round the turn [counts].
pub fn around(counts: i32) -> i32 {
    (counts + COUNTS / 2).rem_euclid(COUNTS) - COUNTS / 2
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(n: u64) -> Mono {
        Mono(1_000_000_000 + n * 1_000_000)
    }

    /// Reads a joint every 10 ms; `None`: a moving servo reports its velocity.
    fn read(turns: &mut Turns, from: u64, positions: &[i32], velocity: Option<i32>) -> Vec<i32> {
        let mut before = turns.at;
        let each = positions.iter().zip(from..).map(|(&position, k)| {
            let moving = (position - before) * 100;
            before = position;
            let servo = Servo {
                goal: 4000,
                position: position.rem_euclid(4096),
                velocity: velocity.unwrap_or(moving),
                ..Servo::default()
            };
            turns.take(&servo, ms(10 * k))
        });
        each.collect()
    }

    #[test]
    fn a_joint_that_is_turned_by_hand_is_read_over_the_seam_and_back() {
        for speed in [3, 30, 60] {
            let mut turns = Turns::default();
            let there: Vec<i32> = (0..200).map(|k| 4000 + speed * k).collect();
            let back: Vec<i32> = there.iter().rev().copied().collect();
            assert_eq!(read(&mut turns, 0, &there, None), there);
            assert!(turns.crossed() && turns.turn() == (4000 + speed * 199) / 4096);
            assert_eq!(read(&mut turns, 200, &back, None), back);
            assert!(!turns.crossed() && turns.turn() == 0);
        }
    }

    #[test]
    fn readings_that_are_wrong_for_a_while_neither_cross_nor_lose_a_turn() {
        for by in [200, 900, 2000, -700, -1900] {
            for wrong in [1, 3, 10, 300] {
                let mut turns = Turns::default();
                read(&mut turns, 0, &[3990; 20], Some(0));
                let lies = vec![3990 + by; wrong];
                read(&mut turns, 20, &lies, Some(0));
                assert!(!turns.crossed(), "{by} {wrong}");
                let after = read(&mut turns, 20 + wrong as u64, &[3990; 20], Some(0));
                assert!(!turns.crossed() && after[19] == 3990, "{by} {wrong}: {after:?}");
            }
        }
    }

    #[test]
    fn a_creeping_lie_is_no_crossing() {
        let mut turns = Turns::default();
        let creeps: Vec<i32> = (0..100).map(|k| 3990 + 20 * k).collect();
        read(&mut turns, 0, &creeps, Some(0));
        assert!(!turns.crossed());
    }

    #[test]
    fn a_joint_that_was_knocked_over_the_seam_has_crossed_when_it_drives_on() {
        let mut turns = Turns::default();
        read(&mut turns, 0, &[4000; 20], Some(0));
        read(&mut turns, 20, &[4200; 7], Some(0));
        assert!(turns.turn() == 1 && !turns.crossed(), "two explanations");
        let on: Vec<i32> = (0..4).map(|k| 4200 + 30 * k).collect();
        read(&mut turns, 27, &on, None);
        assert!(turns.crossed());
    }
}

//! What a joint does that was pushed over the seam of its encoder while its motor is on.
//!
//! The goal of a servo is a position of one turn, and it never takes the short way over 4095 and 0. A joint behind the
//! seam would drive round the whole turn to a goal on the other side. So its goal becomes the end of its range on its
//! own side, at once, and its torque is low until it is back.

use super::DOF;
use super::adapter::So101Adapter;
use super::calibration::{NAMES, Range, SEAM_MARGIN};
use super::protocol::{SERVOS, Servo, TURN, register};
use super::turns::Turns;
use dimos_core::clock::Mono;
use dimos_hardware::adapter::AdapterResult;

/// Error code of a joint that crossed the seam of its encoder while its motor was on; the codes of the servos are bits
/// below it.
pub const SEAM_CROSSED: i32 = 512;
/// Torque limit of such a joint [0.1 %], and its top speed on the way back [counts/s].
pub const LOW_TORQUE: u16 = 200;
const SLOW: u16 = 200;

/// A joint that is this near to the end of its range is back [counts]: it rests beside its goal, under load.
const NEAR: i32 = SEAM_MARGIN * 3 / 4;

/// A servo whose joint is behind its seam sees its goal nearly a turn off, and does all it can [0.1 %]: less is a false
/// reading. One in overload has a fifth of its torque.
const FIGHTS: i32 = 100;

/// What a servo is to be given.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// This goal, with low torque.
    Yield(i32),
    /// Its own torque again.
    Release,
}

/// The seams of all servos.
#[derive(Debug, Clone, Copy, Default)]
pub struct Seams {
    turns: [Turns; SERVOS],
    /// Positions counted over the seam [counts].
    pub positions: [i32; SERVOS],
    /// Which joints are behind their seam, or were and are not back in their range.
    pub crossed: [bool; SERVOS],
}

impl Seams {
    /// Takes a reading of all servos.
    pub fn take(&mut self, servos: &[Servo; SERVOS], now: Mono) {
        for ((turns, position), servo) in self.turns.iter_mut().zip(&mut self.positions).zip(servos) {
            *position = turns.take(servo, now);
        }
    }

    /// Returns what joint `j` is to be given, if anything.
    pub fn order(&mut self, j: usize, servo: &Servo, range: Range) -> Option<Order> {
        let (turns, crossed) = (self.turns.get(j)?, self.crossed.get_mut(j)?);
        let fights = servo.load.abs() >= FIGHTS.min(i32::from(servo.torque_limit) / 2);
        if !servo.on || !(*crossed || (turns.crossed() && fights)) {
            *crossed &= servo.on;
            return None;
        }
        *crossed = true;
        let position = turns.at();
        let goal = match position.rem_euclid(TURN as i32) > TURN as i32 / 2 {
            true => range.high,
            false => range.low,
        };
        // Not before it is there: with its own torque it would be thrown there when a hand lets it go.
        if servo.goal == goal && (position - goal).abs() <= NEAR {
            *crossed = false;
            return Some(Order::Release);
        }
        (servo.goal != goal || servo.torque_limit > LOW_TORQUE).then_some(Order::Yield(goal))
    }

    /// Returns how the readings of servo `j` became its position.
    pub fn turns(&self, j: usize) -> Turns {
        self.turns.get(j).copied().unwrap_or_default()
    }

    /// Returns whether joint `j` is behind its seam.
    pub fn is_crossed(&self, j: usize) -> bool {
        self.crossed.get(j).copied().unwrap_or_default()
    }

    /// Returns the goal of joint `j` counted over the seam [counts].
    pub fn goal(&self, j: usize, servo: &Servo) -> i32 {
        let turn = self.turns.get(j).filter(|_| self.is_crossed(j)).map_or(0, Turns::turn);
        servo.goal + turn * TURN as i32
    }

    /// Returns code and text of the first joint behind its seam.
    pub fn error(&self, range: impl Fn(usize) -> Range) -> Option<(i32, String)> {
        let j = self.crossed.iter().position(|crossed| *crossed)?;
        let (name, position) = (NAMES.get(j)?, self.positions.get(j)?);
        let (back, _) = way_back(*position, range(j)).unwrap_or_default();
        let hint = "the joint is weak until then; afterwards: dimos arm reset";
        Some((SEAM_CROSSED, format!("{name} was turned across the seam of its encoder\nhint: {back}; {hint}")))
    }
}

/// Returns how a joint outside its range is turned back by hand, and by how much [counts]; `None` inside.
pub fn way_back(position: i32, range: Range) -> Option<(String, i32)> {
    let (by, towards) = match position {
        low if low < range.low => (range.low - low, "larger"),
        high if high > range.high => (high - range.high, "smaller"),
        _ => return None,
    };
    let degrees = f64::from(by) * 360.0 / TURN;
    Some((format!("turn it by {degrees:.1}° towards {towards} angles"), by))
}

impl So101Adapter {
    /// Gives joints behind their seam a goal on their own side.
    pub(super) fn guard_seams(&mut self, servos: &[Servo; SERVOS]) -> AdapterResult<()> {
        for (j, servo) in servos.iter().enumerate().take(DOF) {
            let range = self.range(j);
            let Some(order) = self.seams.order(j, servo, range) else { continue };
            let id = self.bus.first() + j as u8;
            if let Order::Yield(goal) = order {
                let words = [goal.max(0) as u16, 0, SLOW, LOW_TORQUE].map(u16::to_le_bytes);
                self.bus.write(id, register::GOAL, words.as_flattened())?;
            } else {
                self.restore_torque(id)?;
            }
        }
        Ok(())
    }

    /// Gives a servo its own torque limit, and no top speed.
    pub(super) fn restore_torque(&mut self, id: u8) -> AdapterResult<()> {
        let own = self.bus.read::<2>(id, register::MAX_TORQUE)?;
        self.bus.write(id, register::TOP_SPEED, [[0; 2], own].as_flattened())
    }
}

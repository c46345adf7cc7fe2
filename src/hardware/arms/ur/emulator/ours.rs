//! What the adapter's program does, one step of the controller at a time.

use super::controller::Registers;
use super::programs::{joints, servo, six};
use crate::hardware::arms::ur::DOF;
use crate::hardware::sim::arm::SimArm;

/// Time without a new order after which a velocity ends [s].
pub const VELOCITY_ENDS: f64 = 0.2;
/// Time without a new order after which the program ends [s].
pub const ENDS: f64 = 1.0;
/// Longest time over which a missed way is spread [s].
pub const SPREAD: f64 = 0.06;
/// Time over which the way to the first setpoint is spread [s].
pub const FIRST: f64 = 0.01;
/// A setpoint is farther away than a joint goes in this time at top speed [s]: the program ends.
pub const FAR: f64 = 0.2;
/// Ways shorter than this are none [rad].
const NONE: f64 = 1e-6;

/// The adapter's program.
#[derive(Debug, Clone)]
pub(super) struct Ours {
    number: i32,
    /// Deceleration of a stop [rad/s²], and top speeds [rad/s].
    deceleration: f64,
    fastest: [f64; DOF],
    count: Option<i32>,
    state: i32,
    silent: u32,
    /// Steps over which the way to the goal is spread, and those between the last two orders.
    left: f64,
    period: f64,
    goal: [f64; DOF],
    setpoint: [f64; DOF],
    last: Option<[f64; DOF]>,
    /// Velocities of a stopj under way: it blocks the program.
    braking: Option<[f64; DOF]>,
}

/// Numbers behind `before` in a program's text.
fn numbers(text: &str, before: &str) -> Vec<f64> {
    let line = text.lines().find_map(|line| line.trim().strip_prefix(before)).unwrap_or_default();
    line.split([',', '[', ']', ' ', ')']).filter_map(|word| word.parse().ok()).collect()
}

impl Ours {
    /// The program with the constants of its text.
    pub fn new(text: &str) -> Self {
        let first = |before: &str| numbers(text, before).first().copied();
        Self {
            number: first("number = ").unwrap_or_default() as i32,
            deceleration: first("stopj(").unwrap_or(1.0),
            fastest: numbers(text, "fastest = [").first_chunk().copied().unwrap_or([f64::INFINITY; DOF]),
            count: None,
            state: 1,
            silent: 0,
            left: 1.0,
            period: 1.0,
            goal: [0.0; DOF],
            setpoint: [0.0; DOF],
            last: None,
            braking: None,
        }
    }

    /// Returns the position that the last step gave to servoj, if it did.
    pub fn servoed(&self) -> Option<[f64; DOF]> {
        self.last.filter(|_| self.state == 2)
    }

    /// Makes one step; whether the program has ended.
    pub fn step(&mut self, arm: &mut SimArm, registers: &mut Registers, step: f64) -> bool {
        if self.brakes(arm, step) {
            return false;
        }
        if self.state >= 10 {
            return true;
        }
        let (now, before) = (registers.int_in[24], self.state);
        let count = *self.count.get_or_insert(now);
        if now == count {
            self.silent += 1;
            let time = f64::from(self.silent) * step;
            if time > ENDS {
                self.state = 11;
            } else if self.state == 3 && time > VELOCITY_ENDS {
                self.state = 1;
            }
        } else {
            self.take(registers, arm, step);
            (self.period, self.silent, self.count) = (f64::from(self.silent + 1), 0, Some(now));
        }
        registers.int_out[24] = self.count.unwrap_or(now);
        registers.int_out[25] = self.state;
        registers.int_out[26] = self.number;
        match self.state {
            2 => self.follow(arm, step),
            3 => drop(arm.velocity_for(&self.goal, None)),
            _ if before > 1 => {
                self.braking = arm.joints().1.first_chunk().copied();
                self.brakes(arm, step);
            }
            _ => {}
        }
        false
    }

    /// Takes an order.
    fn take(&mut self, registers: &Registers, arm: &SimArm, step: f64) {
        self.goal = six(&registers.double_in, 24);
        match registers.int_in[25] {
            1 => {
                if self.state != 2 {
                    (self.setpoint, self.last) = (joints(arm), None);
                    self.left = (FIRST / step).floor();
                } else {
                    self.left = self.left.max(f64::from(self.silent + 1)).min((SPREAD / step).floor());
                }
                let ways = self.goal.iter().zip(&self.setpoint).zip(&self.fastest);
                let far = ways.into_iter().any(|((goal, q), fastest)| (goal - q).abs() > FAR * fastest);
                self.state = if far { 12 } else { 2 };
            }
            2 => self.state = 3,
            3 => self.state = 10,
            _ => self.state = 1,
        }
    }

    /// Goes a step towards the last setpoint.
    fn follow(&mut self, arm: &mut SimArm, step: f64) {
        let mut rests = true;
        for ((q, goal), fastest) in self.setpoint.iter_mut().zip(&self.goal).zip(&self.fastest) {
            let way = ((goal - *q) / self.left).clamp(-fastest * step, fastest * step);
            *q += way;
            rests &= way.abs() <= NONE;
        }
        self.left = match self.left {
            left if rests || left < 2.0 => 1.0,
            left if left > self.period => left - 0.5,
            left => left - 1.0,
        };
        servo(arm, &mut self.last, &self.setpoint, step);
    }

    /// Continues a stopj: all joints decelerate together. `false` when there is none, or it is over.
    fn brakes(&mut self, arm: &mut SimArm, step: f64) -> bool {
        let Some(speeds) = &mut self.braking else { return false };
        let top = speeds.iter().fold(0.0, |top: f64, speed| top.max(speed.abs()));
        let next = (top - self.deceleration * step).max(0.0);
        if next > 0.0 {
            speeds.iter_mut().for_each(|speed| *speed *= next / top);
            let _ = arm.velocity_for(&*speeds, None);
            return true;
        }
        *speeds = [0.0; DOF];
        arm.stop();
        if !arm.moving() {
            self.braking = None;
        }
        self.braking.is_some()
    }
}

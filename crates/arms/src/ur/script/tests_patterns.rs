//! The text of `control.script`, carried out step by step on random patterns of orders and gaps: how far the velocity
//! changes from one point of servoj to the next, where the points are, and what the program says at its end.

use super::machine::{Controller, Machine};
use crate::ur::model::Model;
use crate::ur::{Options, program};
use dimos_core::joint::JointLimits;

pub(super) const HOLD: i32 = 0;
pub(super) const SERVO: i32 = 1;
pub(super) const SPEED: i32 = 2;
pub(super) const STOP: i32 = 3;

/// A controller that carries out a program and judges its points.
pub(super) struct Judge {
    pub machine: Machine,
    pub panel: Panel,
    limits: JointLimits,
    deceleration: f64,
    /// Last point, and the velocity that led to it.
    pub velocity: [f64; 6],
    /// Steps with a point so far, and all.
    steps: usize,
    pub ended: bool,
    /// Largest change of velocity, as a part of the deceleration.
    worst: f64,
}

/// The registers of a controller, and what the program did last.
pub(super) struct Panel {
    step: f64,
    start: [f64; 6],
    order: (i32, i32, [f64; 6]),
    pub out: [i32; 3],
    pub point: Option<[f64; 6]>,
    stopped: bool,
}

impl Controller for Panel {
    fn step_time(&self) -> f64 {
        self.step
    }

    fn target(&self) -> [f64; 6] {
        self.point.unwrap_or(self.start)
    }

    fn read_integer(&self, register: usize) -> i32 {
        if register == 24 { self.order.0 } else { self.order.1 }
    }

    fn read_float(&self, register: usize) -> f64 {
        self.order.2[register - 24]
    }

    fn write_integer(&mut self, register: usize, value: i32) {
        self.out[register - 24] = value;
    }

    fn servoj(&mut self, point: &[f64; 6], _lookahead: f64) {
        self.point = Some(*point);
    }

    fn stopj(&mut self, _deceleration: f64) {
        self.stopped = true;
    }
}

impl Judge {
    pub fn new(model: Model, deceleration: f64, start: [f64; 6]) -> Self {
        let options = Options { stop_deceleration: deceleration, ..Options::default() };
        let (limits, step) = (model.limits(), 1.0 / model.rate());
        let machine = Machine::new(&program::control(7, &options, &limits), "dimos_control").unwrap();
        let panel = Panel { step, start, order: (5, 0, [0.0; 6]), out: [0; 3], point: None, stopped: false };
        Self { machine, panel, limits, deceleration, velocity: [0.0; 6], steps: 0, ended: false, worst: 0.0 }
    }

    pub fn at(&self) -> [f64; 6] {
        self.panel.target()
    }

    pub fn state(&self) -> i32 {
        self.panel.out[1]
    }

    pub fn order(&mut self, order: i32, values: [f64; 6]) {
        self.panel.order = (self.panel.order.0.wrapping_add(1), order, values);
    }

    pub fn fastest(&self) -> f64 {
        self.velocity.iter().fold(0.0, |fastest: f64, v| fastest.max(v.abs()))
    }

    /// Makes a step, and judges it.
    pub fn step(&mut self) {
        let (before, step) = (self.at(), self.panel.step);
        if self.ended {
            return;
        }
        self.ended = !self.machine.step(&mut self.panel);
        self.steps += 1;
        for (i, (now, before)) in self.at().into_iter().zip(before).enumerate() {
            let v = (now - before) / step;
            let change = (v - self.velocity[i]).abs() / (self.deceleration * step);
            self.worst = self.worst.max(change);
            assert!(change <= 1.1, "step {}, joint {i}: {change:.2} times the deceleration", self.steps);
            assert!(v.abs() <= self.limits.velocity_max[i] + 1e-6, "step {}, joint {i}: {v} rad/s", self.steps);
            let (lower, upper) = (self.limits.position_lower[i], self.limits.position_upper[i]);
            let start = self.panel.start[i];
            let inside = (lower.min(start) - 1e-9..=upper.max(start) + 1e-9).contains(&now);
            assert!(inside, "step {}, joint {i}: {now} rad", self.steps);
            self.velocity[i] = v;
        }
        if self.ended {
            assert!(self.fastest() < 1e-6, "step {}: ended at {:?} rad/s", self.steps, self.velocity);
            assert!((10..=12).contains(&self.state()), "ended without a cause: {}", self.state());
            assert!(self.panel.stopped, "stopj at the end");
        }
    }

    pub fn steps(&mut self, seconds: f64) {
        (0..(seconds / self.panel.step).round() as usize).for_each(|_| self.step());
    }

    /// Sends positions along `velocity`, every `period` steps.
    pub fn stream(&mut self, velocity: [f64; 6], seconds: f64, period: usize) {
        let start = self.at();
        for k in 0..(seconds / self.panel.step).round() as usize {
            if k % period == 0 {
                let way = k as f64 * self.panel.step;
                self.order(SERVO, std::array::from_fn(|i| start[i] + velocity[i] * way));
            }
            self.step();
        }
    }
}

/// Random numbers.
struct Dice(u64);

impl Dice {
    /// From 0 to 1.
    fn part(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn below(&mut self, end: usize) -> usize {
        (self.part() * end as f64) as usize
    }

    fn within(&mut self, most: f64) -> f64 {
        most * (2.0 * self.part() - 1.0)
    }
}

/// Plays a random pattern; returns the largest change of velocity, as a part of the deceleration.
fn pattern(seed: u64) -> f64 {
    let mut dice = Dice(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1);
    (0..9).for_each(|_| _ = dice.part());
    let model = [Model::Ur5e, Model::Ur3e, Model::Ur20, Model::Ur10][dice.below(4)];
    let deceleration = [8.0, 8.0, 2.0, 5.5, 20.0][dice.below(5)];
    let range = [1.0, 6.2, 6.27][dice.below(3)];
    let start: [f64; 6] = std::array::from_fn(|_| if dice.below(3) == 0 { range } else { dice.within(range) });
    let mut judge = Judge::new(model, deceleration, start);
    // What the client makes its setpoints from.
    let (mut position, mut velocity) = (start, [0.0; 6]);
    for _ in 0..dice.below(8) + 2 {
        let kind = dice.below(14);
        let (period, wanted) = (dice.below(6) + 1, [0.2, 1.0, 3.0][dice.below(3)]);
        let goal: [f64; 6] = std::array::from_fn(|_| if dice.below(2) == 0 { dice.within(wanted) } else { 0.0 });
        match kind {
            // A client that continues from where it was, or from where the arm is, or elsewhere.
            0 => position = std::array::from_fn(|i| position[i] + dice.within(0.7)),
            1..=5 => position = judge.at(),
            _ => {}
        }
        if kind == 6 {
            velocity = goal;
        }
        for k in 0..dice.below(50) + 1 {
            for i in 0..6 {
                let change = (goal[i] - velocity[i]).clamp(-8.0 * judge.panel.step, 8.0 * judge.panel.step);
                velocity[i] += change;
                position[i] += velocity[i] * judge.panel.step;
            }
            let late = dice.below(4) == 0;
            match kind {
                0..=7 if k % period == 0 || late => judge.order(SERVO, position),
                8..=9 if k % period == 0 => judge.order(SPEED, goal),
                10 if k % period == 0 => judge.order(HOLD, [0.0; 6]),
                13 if k == 0 && dice.below(3) == 0 => judge.order(STOP, [0.0; 6]),
                _ => {} // a gap; the client's time continues
            }
            judge.step();
        }
    }
    // It ends by order or by silence, from any velocity.
    if dice.below(8) > 0 {
        judge.order(STOP, [0.0; 6]);
    }
    judge.steps(4.0);
    assert!(judge.ended, "no end");
    judge.worst
}

/// 10,000 patterns with `DIMOS_UR_PATTERNS=10000`, 1000 by default.
#[test]
fn no_pattern_of_orders_and_gaps_makes_the_target_jump() {
    let number: u64 = std::env::var("DIMOS_UR_PATTERNS").ok().and_then(|text| text.parse().ok()).unwrap_or(1000);
    let mut worst: f64 = 0.0;
    for seed in 1..=number {
        worst = worst.max(match std::panic::catch_unwind(|| pattern(seed)) {
            Ok(worst) => worst,
            Err(_) => panic!("seed {seed}"),
        });
    }
    println!("{number} patterns: the velocity changes by at most {worst:.3} times deceleration · step");
    assert!(worst > 1.0, "the patterns reach the bound");
}

//! The adapter's program: its own text, carried out one step of the controller at a time.

use super::controller::Registers;
use super::points::Points;
use super::programs::joints;
use crate::ur::DOF;
use crate::ur::script::Refused;
use crate::ur::script::machine::{Controller, Machine};
use dimos_hardware::sim::arm::SimArm;

/// Name of the adapter's program.
pub(super) const NAME: &str = "dimos_control";

/// The adapter's program.
#[derive(Debug, Clone)]
pub(super) struct Ours {
    machine: Machine,
    /// The points of servoj, and whether the last step had one.
    points: Points,
    servoed: bool,
}

impl Ours {
    /// Reads the text; an error is one that a controller would report.
    pub fn new(text: &str) -> Result<Self, Refused> {
        Ok(Self { machine: Machine::new(text, NAME)?, points: Points::default(), servoed: false })
    }

    /// Returns the position that the last step gave to servoj, if it did.
    pub fn servoed(&self) -> Option<[f64; DOF]> {
        self.points.last().filter(|_| self.servoed)
    }

    /// Returns the argument of the last point's error.
    pub fn argument(&self) -> i32 {
        self.points.argument
    }

    /// Makes one step; whether the program has ended.
    pub fn step(&mut self, arm: &mut SimArm, registers: &mut Registers, step: f64) -> bool {
        self.servoed = false;
        let Self { machine, points, servoed } = self;
        !machine.step(&mut Step { arm, registers, step, points, servoed })
    }
}

/// The controller in one step of the program.
struct Step<'a> {
    arm: &'a mut SimArm,
    registers: &'a mut Registers,
    step: f64,
    points: &'a mut Points,
    servoed: &'a mut bool,
}

impl Controller for Step<'_> {
    fn step_time(&self) -> f64 {
        self.step
    }

    fn target(&self) -> [f64; DOF] {
        self.points.last().unwrap_or_else(|| joints(self.arm))
    }

    fn read_integer(&self, register: usize) -> i32 {
        self.registers.int_in.get(register).copied().unwrap_or_default()
    }

    fn read_float(&self, register: usize) -> f64 {
        self.registers.double_in.get(register).copied().unwrap_or_default()
    }

    fn write_integer(&mut self, register: usize, value: i32) {
        self.registers.int_out.iter_mut().skip(register).take(1).for_each(|to| *to = value);
    }

    fn servoj(&mut self, point: &[f64; DOF], lookahead: f64) {
        self.points.take(self.arm, point, self.step, lookahead);
        *self.servoed = true;
    }

    fn stopj(&mut self, _deceleration: f64) {
        self.arm.stop();
    }
}

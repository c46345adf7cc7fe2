//! How an arm stops, what happens in gaps, and from where it starts again. Nothing else in the program decides
//! that. Setpoints continue from the last one that was written; a reading never is a place to go.

pub mod braking;
mod relief;
pub mod start_pose;
pub mod written;

use std::time::Duration;

use crate::config::ArmConfig;
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, Joints};
use dimos_core::telemetry::Cause;

pub use relief::{Move, Relief};
use written::{Issued, Written};

/// Maximum time for a lagging arm to settle at its last command before it is stopped [s].
pub const SETTLING_TIME: f64 = 0.3;
/// How long a held motion may decelerate along its path, beside twice the braking time of its joints [s].
pub const ALONG_PATH: f64 = 0.05;
/// How long an arm that has settled must have been read at rest.
pub const SETTLED: Duration = Duration::from_millis(30);
/// How long an arm may take to be at rest after a gap, beside its lag and twice its braking time [s].
const REST_AFTER_GAP: f64 = 0.6;

/// A start of commanded motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Start {
    /// None is under way.
    None,
    /// Its pose is being taken, since then, for this mode.
    Taking(Mono, ControlMode),
    /// It was taken; its first command has this number, and is not written yet.
    Writing(u64),
}

/// A gap: nothing was written for longer than the arm's controller bridges.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gap {
    /// Number of the first command that was made from what had been written.
    pub first: u64,
    /// When it was noticed.
    pub noticed: Mono,
    /// The time of the last written setpoint.
    pub last: Mono,
    /// The mode that the arm is commanded in.
    pub mode: ControlMode,
    /// When the arm must be at rest.
    pub until: Mono,
}

/// State of one arm's rest, gaps and starts.
#[derive(Debug)]
pub struct Rest {
    /// What was written.
    pub written: Written,
    /// Whether nothing else has moved the arm since: no hand, no gravity without motors, no other program.
    pub holds_written: bool,
    /// Whether it was commanded by velocities.
    pub by_velocity: bool,
    /// Whether an operator has seen a difference to what was written.
    pub acknowledged: bool,
    /// Whether the arm may be enabled farther outside its limits than its row says.
    pub outside: bool,
    /// The start under way.
    pub start: Start,
    /// The present gap.
    pub gap: Option<Gap>,
    /// Whether the arm's controller must still be ordered to stop.
    pub stop_pending: bool,
    /// Whether setpoints moved since the arm was held.
    pub moved: bool,
    /// Time left to decelerate along a path [s].
    pub along_path: f64,
    /// Taking a setpoint back towards a blocked joint.
    pub relief: Relief,
    was_held: bool,
    /// How long the commands have been at rest [s].
    pub still: f64,
}

impl Rest {
    /// Creates it for an arm to which nothing was written, for ticks of this period.
    pub fn new(config: &ArmConfig, period: Duration) -> Self {
        Self {
            written: Written::new(period, config.write_period, config.supervision.gap_tolerance),
            holds_written: false,
            by_velocity: false,
            acknowledged: false,
            outside: false,
            start: Start::None,
            gap: None,
            stop_pending: false,
            moved: false,
            along_path: 0.0,
            relief: Relief::None,
            was_held: false,
            still: 0.0,
        }
    }

    /// Takes this tick's phase: a new hold needs a stop. `braking`: braking time of the setpoints [s], 0 at rest.
    /// `foreign`: another program controls the arm.
    pub fn enter(&mut self, held: bool, cause: Cause, braking: f64, foreign: bool) {
        if held && !self.was_held {
            (self.start, self.moved) = (Start::None, braking > 0.0);
            self.along_path = 2.0 * braking + ALONG_PATH;
            self.stop_pending |= !foreign;
            self.relief = if matches!(cause, Cause::Tracking(..)) { Relief::Due } else { Relief::None };
        }
        if !held {
            self.relief = Relief::None;
        }
        self.was_held = held;
    }

    /// Returns the last written setpoint, if nothing else has moved the arm since.
    pub fn last_written(&self) -> Option<&Issued> {
        Some(self.written.last()).filter(|last| self.holds_written && last.seq != 0)
    }

    /// Begins a gap. `first`: number of the next command; `braking`: longest braking time of a joint [s]; `lag` [s].
    pub fn begin_gap(&mut self, now: Mono, first: u64, mode: ControlMode, braking: f64, lag: f64) {
        let limit = Duration::from_secs_f64((2.5 * braking + 2.0 * lag + REST_AFTER_GAP).clamp(0.0, 60.0));
        let last = self.written.last().at;
        self.gap.get_or_insert(Gap { first, noticed: now, last, mode, until: now.after(limit) });
    }

    /// Something else may have moved the arm: the next start does not continue what was written.
    pub fn forget_written(&mut self) {
        (self.holds_written, self.gap) = (false, None);
    }

    /// Returns the positions of the last written setpoint [rad].
    pub fn last_position(&self) -> &Joints {
        &self.written.last().position
    }
}

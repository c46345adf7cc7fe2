//! What planners ask about configurations and the motions between them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use crate::robot::model::Limits;

use super::report::{Contact, Pair};

/// When to give up: at a time, or when somebody asks. Asked about at every configuration that is checked.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    deadline: Option<Instant>,
    cancelled: Option<Arc<AtomicBool>>,
}

impl Stop {
    /// Never.
    pub fn never() -> Self {
        Self::default()
    }

    /// At a time, and as soon as the flag is set.
    pub fn new(deadline: Option<Instant>, cancelled: Option<Arc<AtomicBool>>) -> Self {
        Self { deadline, cancelled }
    }

    /// Whether somebody has asked to give up.
    pub fn is_cancelled(&self) -> bool {
        self.cancelled.as_ref().is_some_and(|flag| flag.load(Ordering::Relaxed))
    }

    /// Whether it is time to give up.
    pub fn is_over(&self) -> bool {
        self.is_cancelled() || self.deadline.is_some_and(|deadline| Instant::now() >= deadline)
    }
}

/// How finely motions are checked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Resolution {
    /// A motion is free when nothing touches anywhere on it; that may leave out of account what happens while no point
    /// of the robots moves by more than this [m].
    pub motion: f64,
}

impl Default for Resolution {
    fn default() -> Self {
        Self { motion: 1e-4 }
    }
}

/// Tells where a robot, or several, can be. A configuration holds the joints of all robots, one after the other.
pub trait CollisionChecker {
    /// Number of joints in a configuration.
    fn dof(&self) -> usize;

    /// Limits of the joints.
    fn limits(&self) -> &[Limits];

    /// Which joints turn without end: what is free at a position is free one turn farther.
    fn turns(&self) -> &[bool];

    /// How finely motions are checked.
    fn resolution(&self) -> Resolution;

    /// Whether nothing touches at configuration `q` [rad or m].
    fn is_free(&mut self, q: &[f64]) -> bool;

    /// Whether nothing touches on the straight line between two configurations, ends included, at the resolution.
    /// `false` when it was stopped.
    fn motion_is_free(&mut self, from: &[f64], to: &[f64], stop: &Stop) -> bool;

    /// What touches first, of those that are quickly found.
    fn first_contact(&mut self, q: &[f64]) -> Option<Pair>;

    /// The least distance between things that must not touch and that can move relative to each other, and the pair;
    /// `None` when there is nothing to touch.
    fn clearance(&mut self, q: &[f64]) -> Option<Contact>;

    /// Everything that touches at a configuration, the deepest first.
    fn contacts(&mut self, q: &[f64]) -> Vec<Contact>;

    /// Configurations that were looked at so far.
    fn looks(&self) -> u64;
}

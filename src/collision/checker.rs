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
    /// Largest distance between two configurations that are looked at, in the Euclidean norm of all joints [rad].
    pub step: f64,
    /// A proven motion may leave out of account what happens within this much motion of any point of the robot [m].
    pub proof: f64,
}

impl Default for Resolution {
    fn default() -> Self {
        Self { step: 1.0 / 32.0, proof: 1e-4 }
    }
}

/// What a checker finds at one configuration.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Verdict {
    /// Nothing touches, and nothing will within the margin that was asked for.
    Free,
    /// Nothing was found to touch, but something may within the margin.
    Close,
    /// These touch.
    Hit(Pair),
}

/// Tells where a robot, or several, can be. A configuration holds the joints of all robots, one after the other.
pub trait CollisionChecker {
    /// Number of joints in a configuration.
    fn dof(&self) -> usize;

    /// Limits of the joints.
    fn limits(&self) -> &[Limits];

    /// How finely motions are checked.
    fn resolution(&self) -> Resolution;

    /// Looks at configuration `q` [rad or m]. With a `margin` for each joint [rad or m], `Free` means that nothing
    /// touches at any configuration that differs by no more than these.
    fn look(&mut self, q: &[f64], margin: Option<&[f64]>) -> Verdict;

    /// An upper bound of how far any point of the robots moves, or moves relative to another link that it could
    /// touch, when each joint moves by this much [m].
    fn reach(&self, motion: &[f64]) -> f64;

    /// The least distance between things that must not touch, and the pair; `None` when there is nothing to touch.
    fn clearance(&mut self, q: &[f64]) -> Option<Contact>;

    /// Everything that touches at a configuration, the deepest first.
    fn contacts(&mut self, q: &[f64]) -> Vec<Contact>;

    /// Whether nothing touches at a configuration.
    fn is_free(&mut self, q: &[f64]) -> bool {
        self.look(q, None) == Verdict::Free
    }
}

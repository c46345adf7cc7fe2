//! Collision checks of configurations and of the motions between them.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use dimos_kernels::block::Lanes;

use dimos_robot::model::Limits;

use super::report::{Contact, Pair};

/// Stop condition of a computation: a deadline or a cancel flag, tested at every collision check.
#[derive(Debug, Clone, Default)]
pub struct Stop {
    deadline: Option<Instant>,
    cancelled: Option<Arc<AtomicBool>>,
}

impl Stop {
    /// Creates one that never stops.
    pub fn never() -> Self {
        Self::default()
    }

    /// Creates one that stops at a deadline, or when the flag is set.
    pub fn new(deadline: Option<Instant>, cancelled: Option<Arc<AtomicBool>>) -> Self {
        Self { deadline, cancelled }
    }

    /// Returns the same condition with a deadline that is no later than `at`.
    pub fn or_at(&self, at: Instant) -> Self {
        Self { deadline: Some(self.deadline.map_or(at, |own| own.min(at))), ..self.clone() }
    }

    /// Returns the same condition with half of the time that is left: what follows needs the rest.
    pub fn halfway(&self) -> Self {
        let now = Instant::now();
        self.deadline.map_or_else(|| self.clone(), |own| self.or_at(now + own.saturating_duration_since(now) / 2))
    }

    /// Returns whether the flag is set.
    pub fn is_cancelled(&self) -> bool {
        self.cancelled.as_ref().is_some_and(|flag| flag.load(Ordering::Relaxed))
    }

    /// Returns whether to stop.
    pub fn is_over(&self) -> bool {
        self.is_cancelled() || self.deadline.is_some_and(|deadline| Instant::now() >= deadline)
    }
}

/// A choice of the samples of a motion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Samples {
    /// All.
    All,
    /// Sixteen, spread over the motion: most motions that touch anything touch at one of these.
    First,
    /// All but the first.
    Rest,
}

/// Checks collisions of one or more robots. A configuration holds the joints of all robots, one after the other.
pub trait CollisionChecker {
    /// Returns the number of joints in a configuration.
    fn dof(&self) -> usize;

    /// Returns the limits of the joints.
    fn limits(&self) -> &[Limits];

    /// Returns which joints are continuous: a whole turn does not change what is free.
    fn turns(&self) -> &[bool];

    /// Returns whether nothing touches at configuration `q` [rad or m].
    fn is_free(&mut self, q: &[f64]) -> bool;

    /// Returns whether nothing touches on the straight line between two configurations, ends included, at the
    /// resolution; `false` if stopped.
    fn motion_is_free(&mut self, from: &[f64], to: &[f64], stop: &Stop) -> bool;

    /// Same within a budget of exact checks; `false` once it is spent, as on most motions along a surface. For edges
    /// that a path does not depend on. `looks_free`: whether the motion already passed [`Self::motion_looks_free`],
    /// which is then not repeated.
    fn certify_within_budget(&mut self, from: &[f64], to: &[f64], _looks_free: bool, stop: &Stop) -> bool {
        self.motion_is_free(from, to, stop)
    }

    /// Returns whether nothing touches at samples of the straight line between two configurations, the first of which
    /// is known to be free. A quick check with covers: it proves nothing between the samples, and counts some pairs
    /// that are a few millimetres apart as touching.
    fn motion_looks_free(&mut self, from: &[f64], to: &[f64]) -> bool {
        self.motion_is_free(from, to, &Stop::never())
    }

    /// Same at a subset of the samples: a motion looks free if it does at [`Samples::First`] and [`Samples::Rest`].
    fn motion_looks_free_at(&mut self, samples: Samples, from: &[f64], to: &[f64]) -> bool {
        samples == Samples::Rest || self.motion_looks_free(from, to)
    }

    /// Returns the lanes of `lanes` whose configurations are in contact according to covers: no motion that ends there
    /// looks free. A lane that is not returned is undecided. `q`: a block per joint [rad or m].
    fn any_contact_batch(&mut self, _q: &[Lanes], _lanes: u16) -> u16 {
        0
    }

    /// Returns the first contact found, in no particular order.
    fn first_contact(&mut self, q: &[f64]) -> Option<Pair>;

    /// Returns the smallest distance between two things that can collide and move relative to each other; `None` if
    /// there is no such pair.
    fn clearance(&mut self, q: &[f64]) -> Option<Contact>;

    /// Returns all contacts at a configuration, the deepest first.
    fn contacts(&mut self, q: &[f64]) -> Vec<Contact>;

    /// Returns the number of configurations checked so far.
    fn checks(&self) -> u64;
}

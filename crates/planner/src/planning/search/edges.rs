//! How the edges of a search are checked. Few edges become part of a path, so a search validates each edge by a quick
//! check, and confirms those of a path by a slower one.

use dimos_kernels::block::Lanes;

use crate::collision::checker::{CollisionChecker, Samples, Stop};

/// Validates the edges of a search.
pub trait EdgeValidator {
    /// Returns whether an edge may be added to a tree; its first configuration is known to be free.
    fn is_free(&mut self, from: &[f64], to: &[f64]) -> bool;

    /// Returns whether an edge of a tree may be part of a path.
    fn is_confirmed(&mut self, from: &[f64], to: &[f64]) -> bool;

    /// Returns the lanes of `lanes` whose configurations no edge can end at; a lane that is not returned is undecided.
    /// `q`: a block per joint.
    fn blocked(&mut self, q: &[Lanes], lanes: u16) -> u16;
}

/// Checks that an edge must pass.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EdgeCheck {
    /// Free at its first samples.
    Coarse,
    /// Free at its first samples; as part of a path, at all samples.
    Sampled,
    /// Free at its first samples; as part of a path, proven within a budget.
    Certified,
    /// Proven with solids, also where covers touch.
    Exact,
}

/// Checks edges with a collision checker.
#[derive(Debug)]
pub struct EdgeChecker<'a, C> {
    /// The checker.
    pub checker: &'a mut C,
    /// Checks that an edge must pass.
    pub edges: EdgeCheck,
    /// Ends a proof.
    pub stop: &'a Stop,
}

impl<C: CollisionChecker> EdgeValidator for EdgeChecker<'_, C> {
    fn is_free(&mut self, from: &[f64], to: &[f64]) -> bool {
        match self.edges {
            EdgeCheck::Exact => self.checker.motion_is_free(from, to, self.stop),
            _ => self.checker.motion_looks_free_at(Samples::First, from, to),
        }
    }

    fn is_confirmed(&mut self, from: &[f64], to: &[f64]) -> bool {
        let mut is_sampled = || self.checker.motion_looks_free_at(Samples::Rest, from, to);
        match self.edges {
            EdgeCheck::Sampled => is_sampled(),
            EdgeCheck::Certified => is_sampled() && self.checker.certify_within_budget(from, to, true, self.stop),
            EdgeCheck::Coarse | EdgeCheck::Exact => true,
        }
    }

    fn blocked(&mut self, q: &[Lanes], lanes: u16) -> u16 {
        match self.edges {
            // A proof may accept what covers refuse.
            EdgeCheck::Exact => 0,
            _ => self.checker.any_contact_batch(q, lanes),
        }
    }
}

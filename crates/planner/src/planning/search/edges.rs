//! How the edges of a search are checked.

use dimos_kernels::block::Lanes;

use crate::collision::checker::{CollisionChecker, Samples, Stop};

/// Checks the edges of a search.
pub trait EdgeCheck {
    /// Returns whether an edge may be used; its first configuration is known to be free.
    fn is_free(&mut self, from: &[f64], to: &[f64]) -> bool;

    /// Returns whether an edge that may be used may be part of a path: few become one, so what takes long is left to be
    /// checked here.
    fn is_confirmed(&mut self, from: &[f64], to: &[f64]) -> bool;

    /// Returns those of `lanes` that no edge can end at. `q`: a block per joint. A lane that is not returned says
    /// nothing.
    fn blocked(&mut self, q: &[Lanes], lanes: u16) -> u16;
}

/// Which edges may be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Edges {
    /// Those that look free at their first samples.
    Looking,
    /// Those that look free, once they are part of a path at all samples.
    Sampled,
    /// Those that look free and, once they are part of a path, are easily proven.
    Checked,
    /// Those that are proven, also where covers touch.
    Proven,
}

/// Checks edges with a collision checker.
#[derive(Debug)]
pub struct EdgeChecker<'a, C> {
    /// The checker.
    pub checker: &'a mut C,
    /// Which edges may be used.
    pub edges: Edges,
    /// Ends a proof.
    pub stop: &'a Stop,
}

impl<C: CollisionChecker> EdgeCheck for EdgeChecker<'_, C> {
    fn is_free(&mut self, from: &[f64], to: &[f64]) -> bool {
        let Self { checker, stop, .. } = self;
        match self.edges {
            Edges::Looking | Edges::Sampled | Edges::Checked => checker.motion_looks_free_at(Samples::First, from, to),
            Edges::Proven => checker.motion_is_free(from, to, stop),
        }
    }

    fn is_confirmed(&mut self, from: &[f64], to: &[f64]) -> bool {
        let Self { checker, stop, .. } = self;
        match self.edges {
            Edges::Sampled => checker.motion_looks_free_at(Samples::Rest, from, to),
            Edges::Checked => {
                checker.motion_looks_free_at(Samples::Rest, from, to)
                    && checker.motion_is_easily_free(from, to, true, stop)
            }
            Edges::Looking | Edges::Proven => true,
        }
    }

    fn blocked(&mut self, q: &[Lanes], lanes: u16) -> u16 {
        match self.edges {
            Edges::Looking | Edges::Sampled | Edges::Checked => self.checker.look_blocked(q, lanes),
            // What covers refuse may be proven.
            Edges::Proven => 0,
        }
    }
}

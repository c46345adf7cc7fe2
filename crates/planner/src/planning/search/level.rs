//! How thoroughly a plan's motions are checked.

use dimos_core::named::named;

named! {
    /// How motions are checked.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
    pub enum Level {
        /// At samples, with covers: quick. Nothing is proven, so such a plan is executed only if asked for.
        Fast = "fast",
        /// Searched at samples, then proven free with continuous checks; searched with proofs where that fails.
        #[default]
        Certified = "certified",
        /// Every edge of the search is proven, and the clearance is computed to 0.5 mm.
        Exact = "exact",
    }
}

impl Level {
    /// Returns whether plans of this level are proven.
    pub fn proves(self) -> bool {
        self != Self::Fast
    }
}

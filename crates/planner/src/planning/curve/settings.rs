//! Settings of curves and their clock. Values without a source are measured: `benches/planning`.

use dimos_kernels::path_clock::Barrier;

/// Settings of the clock of a curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClockSettings {
    /// Cells of the first search, whose result shows where time is spent.
    pub first_cells: usize,
    /// Shortest time from rest to the full acceleration of a joint [s], also of one without a jerk limit.
    pub ramp: f64,
    /// Length of a cell afterwards [s] …
    pub cell: f64,
    /// … but at least and at most this many cells.
    pub cells: [usize; 2],
    /// Weights of the barriers in the first search …
    pub rough: Barrier,
    /// … and in those that follow, which begin close to their result.
    pub fine: Barrier,
    /// Part of the best known clock with which the next search begins.
    pub start: f64,
    /// Searches after the first, each with lower limits where the trajectory of the one before exceeds them.
    pub corrections: usize,
    /// Use of a limit above which it is lowered.
    pub correction_ratio: f64,
    /// Part of a tool's speed limit that is used: between places of a cell it may be faster.
    pub tool_share: f64,
}

impl Default for ClockSettings {
    fn default() -> Self {
        Self {
            first_cells: 48,
            ramp: 0.03,
            cell: 0.016,
            cells: [48, 4000],
            rough: Barrier { weights: [0.1, 1e-2], ..Barrier::default() },
            fine: Barrier { weights: [1e-2, 1e-3], ..Barrier::default() },
            start: 0.95,
            corrections: 3,
            correction_ratio: 1.0005,
            tool_share: 0.998,
        }
    }
}

/// Settings of the smoothest curve through given configurations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FitSettings {
    /// Pieces of the spline per configuration …
    pub per_point: usize,
    /// … but at least and at most as many.
    pub pieces: [usize; 2],
    /// Part of the tolerance that is used: the curve is joined once more through the ends of its pieces.
    pub share: f64,
    /// Lowest and highest penalty.
    pub penalty: (f64, f64),
    /// Bisections of the penalty's logarithm.
    pub rounds: usize,
}

impl Default for FitSettings {
    fn default() -> Self {
        Self { per_point: 2, pieces: [32, 2000], share: 0.9, penalty: (1e-6, 1e8), rounds: 14 }
    }
}

/// Settings of several curves that become one.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JoinSettings {
    /// Configurations on a blend or a rounded corner.
    pub samples: usize,
    /// Largest distance of configurations on a straight line [rad].
    pub spacing: f64,
    /// Part of the blend's distance that is aimed at.
    pub share: f64,
    /// Bisections of a blend's length.
    pub rounds: usize,
    /// Blends that are tried, in parts of what was asked for, before the motion rests.
    pub parts: [f64; 3],
    /// Distance of the places on straight lines that a smooth curve passes [rad].
    pub fit_spacing: f64,
    /// Parts of the deviation from straight lines that are tried for a smooth curve along them.
    pub fit_shares: [f64; 3],
}

impl Default for JoinSettings {
    fn default() -> Self {
        Self {
            samples: 24,
            spacing: 0.1,
            share: 0.97,
            rounds: 24,
            parts: [1.0, 0.5, 0.25],
            fit_spacing: 0.02,
            fit_shares: [1.0, 0.5, 0.25],
        }
    }
}

/// Settings of curves.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CurveSettings {
    /// Rounds of refinement from which on the time along a planned path is refined, too.
    pub refine_rounds: u32,
    /// Their clock.
    pub clock: ClockSettings,
    /// Curves through recorded configurations.
    pub fit: FitSettings,
    /// Several curves that become one.
    pub join: JoinSettings,
}

impl Default for CurveSettings {
    fn default() -> Self {
        let (clock, fit, join) = (ClockSettings::default(), FitSettings::default(), JoinSettings::default());
        Self { refine_rounds: 16, clock, fit, join }
    }
}

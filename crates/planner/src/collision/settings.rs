//! Settings of collision checks. The checks are those of VAMP (Thomason, Kingston and Kavraki, "Motions in microseconds
//! via vectorized sampling-based planning", 2024) and continuous checks with motion bounds (Schwarzer, Saha and
//! Latombe, "Adaptive dynamic collision checking for single and multiple articulated robots", 2005). Values without a
//! source are measured: `benches/planning`.

/// Settings of a checker.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CheckSettings {
    /// Samples per length of a motion in a discrete check [1/rad], in the norm of all joints: VAMP's for most arms.
    pub samples_per_rad: f64,
    /// Continuous checks.
    pub certification: CertificationSettings,
    /// Clearance of a motion.
    pub clearance: ClearanceSettings,
}

impl Default for CheckSettings {
    fn default() -> Self {
        Self {
            samples_per_rad: 32.0,
            certification: CertificationSettings::default(),
            clearance: ClearanceSettings::default(),
        }
    }
}

/// Settings of the proof that a whole motion is free.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CertificationSettings {
    /// CheckSettings: a motion on which nothing moves farther is free if its middle is [m].
    pub resolution: f64,
    /// Exact checks of configurations that a motion is worth that need not be free.
    pub budget: u64,
    /// The same where triangles decide: each takes many times as long.
    pub mesh_budget: u64,
    /// Times that a motion is halved to be proven by swept covers.
    pub sweep_halvings: i32,
    /// Parts of a piece that is split for the next check with covers.
    pub parts: usize,
    /// Pieces on which nothing moves farther are checked with solids [m]: covers are no tighter.
    pub cover_size: f64,
    /// If covers prove less than half of more pieces than these, all are checked with solids: a shallow contact is
    /// found before the pieces are many.
    pub max_unproven: usize,
    /// Pieces whose middles are checked with solids before all are split.
    pub probes: usize,
}

impl Default for CertificationSettings {
    fn default() -> Self {
        Self {
            resolution: 1e-4,
            budget: 64,
            mesh_budget: 4,
            sweep_halvings: 3,
            parts: 4,
            cover_size: 0.004,
            max_unproven: 24,
            probes: 3,
        }
    }
}

/// Settings of the search for the distance that a motion is proven to keep.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClearanceSettings {
    /// Distances that are tried first, in order [m]: most motions are closest at a few of them. The last is the largest
    /// that is searched.
    pub tried: [f64; 6],
    /// Relative accuracy.
    pub relative: f64,
    /// Absolute accuracy [m].
    pub absolute: f64,
    /// Below this distance, the error of covers is a large part of it, so solids are checked [m].
    pub near: f64,
    /// Below this distance, the relative accuracy applies down to `finest` [m].
    pub fine: f64,
    /// Finest absolute accuracy [m].
    pub finest: f64,
    /// Exact checks of configurations per motion and distance.
    pub budget: u64,
    /// The same below `fine`: a motion along a surface needs most.
    pub fine_budget: u64,
}

impl Default for ClearanceSettings {
    fn default() -> Self {
        Self {
            tried: [0.002, 0.005, 0.0125, 0.03, 0.08, 0.2],
            relative: 0.1,
            absolute: 5e-4,
            near: 0.005,
            fine: 1e-3,
            finest: 1e-6,
            budget: 24,
            fine_budget: 65_536,
        }
    }
}

/// Settings of the collision guard's proofs, which must end within a tick, and of the margins between links of one
/// robot.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GuardSettings {
    /// Balls, or pairs of balls, that are split per pair at most.
    pub visits: usize,
    /// Deepest overlap that a search for a distance finds [m].
    pub deepest: f32,
    /// Scales of that search, each sixteen times as fine as the one before.
    pub scales: usize,
    /// Random poses in which the margins between links of one robot are measured.
    pub poses: usize,
    /// Deduction from the smallest distance measured [m]: other poses may have less.
    pub slack: f32,
}

impl Default for GuardSettings {
    fn default() -> Self {
        Self { visits: 500, deepest: 0.15, scales: 4, poses: 400, slack: 0.001 }
    }
}

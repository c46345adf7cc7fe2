//! Settings of the inverse kinematics: damped least squares (Wampler, 1986; Nakamura and Hanafusa, 1986) from random
//! starts. Values without a source are measured: `benches/planning`.

/// Settings of the search for solutions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct IkSettings {
    /// Position tolerance [m].
    pub position: f64,
    /// Orientation tolerance [rad].
    pub rotation: f64,
    /// Whether the orientation is free.
    pub position_only: bool,
    /// Maximum attempts to reach the pose at all, rounded up to whole blocks of 16: the first from the seed, the others
    /// from random configurations. A sixteenth of them, at least one block, to find further or valid solutions.
    pub attempts: usize,
    /// Maximum steps per attempt.
    pub steps: usize,
    /// Number of distinct solutions to look for, nearest first. One is whichever is found first, and takes the least
    /// time.
    pub solutions: usize,
    /// Solutions closer to each other than this are the same [rad, Euclidean over all joints].
    pub same: f64,
    /// Seed of all random numbers.
    pub seed: u64,
    /// The last steps, in double precision.
    pub descent: DescentSettings,
    /// The search for the solution closest to a seed.
    pub closest: ClosestSettings,
}

impl Default for IkSettings {
    fn default() -> Self {
        Self {
            position: 1e-6,
            rotation: 1e-6,
            position_only: false,
            attempts: 3200,
            steps: 60,
            solutions: 1,
            same: 1e-3,
            seed: 0,
            descent: DescentSettings::default(),
            closest: ClosestSettings::default(),
        }
    }
}

/// Settings of damped least squares: Δq = Jᵀ·(J·Jᵀ + λ)⁻¹·e, with λ = `damping`·|e|² + `min_damping`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DescentSettings {
    /// Damping per squared error: large far away …
    pub damping: f64,
    /// … and almost none close by, where the last digits converge quickly.
    pub min_damping: f64,
    /// Maximum step of a joint [rad or m].
    pub max_step: f64,
    /// A step makes progress if the squared error falls below this part of the least so far.
    pub progress: f64,
    /// Steps without progress after which an attempt ends.
    pub max_idle: u32,
}

impl Default for DescentSettings {
    fn default() -> Self {
        Self { damping: 0.02, min_damping: 1e-9, max_step: 0.7, progress: 0.9, max_idle: 6 }
    }
}

/// Settings of the search for the solution closest to a seed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ClosestSettings {
    /// Standard deviations of the starts around the seed [rad or m].
    pub spreads: [f64; 4],
    /// Maximum steps towards the seed in the null space of the pose.
    pub steps: usize,
    /// Maximum motion of a joint per step [rad or m].
    pub max_step: f64,
    /// Smallest part of a step that is tried.
    pub min_part: f64,
    /// A motion shorter than this makes no difference [rad or m].
    pub min_motion: f64,
    /// Solutions closer to each other than this count as one [rad].
    pub same: f64,
    /// The same for redundant arms: steps towards the seed from several starts end close to each other.
    pub same_branch: f64,
}

impl Default for ClosestSettings {
    fn default() -> Self {
        Self {
            spreads: [0.1, 0.3, 0.7, 1.5],
            steps: 40,
            max_step: 0.3,
            min_part: 1.0 / 64.0,
            min_motion: 1e-6,
            same: 0.01,
            same_branch: 0.3,
        }
    }
}

/// Settings for following a line or an arc.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineSettings {
    /// Distance between configurations [m].
    pub step: f64,
    /// Rotation between configurations [rad].
    pub turn: f64,
    /// Maximum position error of the link between configurations [m].
    pub deviation: f64,
    /// Maximum orientation error [rad].
    pub tilt: f64,
    /// Maximum step of a joint between configurations [rad or m]; a larger one counts as a jump.
    pub jump: f64,
    /// Smallest part of a step that is tried where the link leaves the line.
    pub min_part: f64,
    /// Tolerance of configurations on the line [m, rad]: small, because the third derivatives of the curve through them
    /// count.
    pub tolerance: f64,
    /// Maximum position error of the link on the smooth curve through the configurations [m].
    pub curve_deviation: f64,
    /// Maximum orientation error there [rad].
    pub curve_tilt: f64,
    /// How often the step is halved until the curve keeps to that.
    pub halvings: u32,
}

impl LineSettings {
    /// Returns the settings of the inverse kinematics along a line.
    pub fn ik(&self) -> IkSettings {
        IkSettings { position: self.tolerance, rotation: self.tolerance, ..IkSettings::default() }
    }
}

impl Default for LineSettings {
    fn default() -> Self {
        Self {
            step: 0.01,
            turn: 0.05,
            deviation: 1e-3,
            tilt: 0.01,
            jump: 0.35,
            min_part: 1.0 / 64.0,
            tolerance: 1e-9,
            curve_deviation: 1e-4,
            curve_tilt: 1e-3,
            halvings: 3,
        }
    }
}

/// Settings for a pose that a person drags: the answer is needed at once.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DragSettings {
    /// Tolerance [m, rad].
    pub tolerance: f64,
    /// Attempts if the configuration before does not lead to the pose.
    pub attempts: usize,
}

impl Default for DragSettings {
    fn default() -> Self {
        Self { tolerance: 1e-5, attempts: 320 }
    }
}

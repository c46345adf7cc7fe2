//! Settings of planning requests. Values without a source are chosen by hand.

/// Settings of goals: from a pose to configurations.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GoalSettings {
    /// IK solutions that are searched when a robot moves to a pose.
    pub solutions: usize,
    /// Attempts to find them.
    pub attempts: usize,
    /// Postures at the start's pose that are tried for a line that cannot be followed from the present one.
    pub postures: usize,
    /// Tolerance of a pose goal [m, rad].
    pub tolerance: f64,
    /// Largest violation of limits at which a robot may count as being at its goal [rad]: as for the start of a plan.
    pub limit_tolerance: f64,
    /// Distance from the goal within which such a robot counts as there [m].
    pub near_distance: f64,
    /// Rotation within which it does [rad].
    pub near_rotation: f64,
}

impl Default for GoalSettings {
    fn default() -> Self {
        Self {
            solutions: 8,
            attempts: 3200,
            postures: 16,
            tolerance: 1e-5,
            limit_tolerance: 0.02,
            near_distance: 5e-4,
            near_rotation: 1.7e-3,
        }
    }
}

/// Settings of the deviation at corners that a request determines.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlendSettings {
    /// Maximum deviation at the corners of a straight line or a given path [rad]: these are so flat that blending keeps
    /// to the path.
    pub line_deviation: f64,
    /// Maximum deviation at a waypoint [rad].
    pub max_deviation: f64,
    /// Shortest piece next to a waypoint that is blended [rad]: a shorter blend would take longer than a stop.
    pub min_piece: f64,
}

impl Default for BlendSettings {
    fn default() -> Self {
        Self { line_deviation: 1e-3, max_deviation: 0.5, min_piece: 0.01 }
    }
}

/// Settings of the check of a motion that was planned before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LookAheadSettings {
    /// Length of the time slices that are checked [s]; within one, the motion is almost straight.
    pub slice: f64,
    /// Largest deviation from the chord for slices to be checked as one straight line [rad].
    pub straight: f64,
    /// Collision checks along a blocked slice to find its contact.
    pub samples: u32,
}

impl Default for LookAheadSettings {
    fn default() -> Self {
        Self { slice: 0.02, straight: 5e-5, samples: 32 }
    }
}

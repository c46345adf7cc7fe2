//! Settings of the time parameterization. Values without a source are measured: `benches/planning`.

/// Settings of the time parameterization.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TimingSettings {
    /// Maximum deviation at corners [rad, Euclidean over all joints]; 0: the motion rests at every corner.
    pub deviation: f64,
    /// Part of the full speed, above 0 and at most 1: scales the motion in time.
    pub speed: f64,
    /// Blended corners.
    pub corners: CornerSettings,
    /// Grid intervals of a corner for TOPP-RA (Pham and Pham, 2018). A line is one interval: the bounds of the
    /// acceleration are the same all along it.
    pub corner_intervals: usize,
    /// Jerk limiting by averaging.
    pub jerk: JerkSettings,
}

impl Default for TimingSettings {
    fn default() -> Self {
        Self {
            deviation: 0.05,
            speed: 1.0,
            corners: CornerSettings::default(),
            corner_intervals: 8,
            jerk: JerkSettings::default(),
        }
    }
}

/// Settings of blended corners.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CornerSettings {
    /// Largest distance of a corner's curve from the straight pieces that are collision-checked in its place [rad].
    pub sagitta: f64,
    /// Straight pieces in whose place a corner of varying speed is collision-checked.
    pub pieces: usize,
    /// Factor of the deviation of a corner in collision …
    pub sharpening: f64,
    /// … down to this deviation [rad]; a sharper corner is not blended.
    pub min_deviation: f64,
    /// Rounds of sharpening, at most, of corners of varying speed.
    pub max_sharpenings: usize,
    /// Shortest time from zero to full acceleration of a joint without a jerk limit among joints that have one [s].
    pub min_ramp: f64,
    /// A corner counts as slowed down by the lines next to it below this part of its own speed.
    pub slowed: f64,
    /// Corners per slowed one: with fewer, a varying speed is worth its computing time.
    pub corners_per_slowed: usize,
    /// Corners that take longer than this many times the ramp to full acceleration gain from a varying speed.
    pub short: f64,
}

impl Default for CornerSettings {
    fn default() -> Self {
        Self {
            sagitta: 2e-4,
            pieces: 8,
            sharpening: 0.4,
            min_deviation: 2e-3,
            max_sharpenings: 8,
            min_ramp: 0.005,
            slowed: 0.9,
            corners_per_slowed: 8,
            short: 7.0,
        }
    }
}

impl CornerSettings {
    /// Returns the deviation to try for a corner that collides at `deviation` [rad]; 0: not blended.
    pub fn sharper(&self, deviation: f64) -> f64 {
        if deviation > self.min_deviation { deviation * self.sharpening } else { 0.0 }
    }
}

/// Settings of jerk limiting by averaging.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JerkSettings {
    /// Maximum rounds in which pieces that exceed limits get a lower pace.
    pub rounds: usize,
    /// Use of a limit above which a piece is corrected.
    pub correction_ratio: f64,
}

impl Default for JerkSettings {
    fn default() -> Self {
        Self { rounds: 5, correction_ratio: 1.01 }
    }
}

/// Settings of slowing a motion down where a tool is too fast.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ToolTimingSettings {
    /// Step of the rate [s].
    pub step: f64,
    /// Number of steps, at most.
    pub max_steps: usize,
    /// Longest time between points of a motion whose rate changes [s].
    pub point_interval: f64,
    /// Part of the tool's speed limit that is used: between steps it may be faster.
    pub share: f64,
    /// Windows that are tried, in times that the slowest joint needs to reach its speed.
    pub windows: [f64; 6],
}

impl Default for ToolTimingSettings {
    fn default() -> Self {
        Self {
            step: 0.002,
            max_steps: 100_000,
            point_interval: 0.01,
            share: 0.997,
            windows: [0.12, 0.25, 0.5, 1.0, 2.0, 4.0],
        }
    }
}

//! Settings of the planning scene. Values without a source are chosen by hand.

/// Settings of the padding of one request, and of its exceptions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PaddingSettings {
    /// Additional padding during the search [m]: between the points of its trajectory, a motion deviates slightly from
    /// the checked path and must still pass a later check.
    pub extra: f64,
    /// Part of the padding that a given path keeps: the arm has been there.
    pub path_ratio: f64,
    /// Candidate radii of an exception around a start or goal [rad]: the first that contains a configuration with the
    /// full padding is used.
    pub radii: [f64; 3],
    /// Configurations tried per candidate radius.
    pub tries: usize,
    /// Samples over all joints' ranges: a pair closer than the padding in every one of them counts as always closer.
    pub poses: usize,
    /// Part of its distance at the start or goal that a pair keeps around it while planning …
    pub distance_ratio: f64,
    /// … and when the plan is checked again.
    pub revalidation_ratio: f64,
}

impl Default for PaddingSettings {
    fn default() -> Self {
        Self {
            extra: 2e-4,
            path_ratio: 0.5,
            radii: [0.1, 0.3, 1.0],
            tries: 100,
            poses: 32,
            distance_ratio: 0.5,
            revalidation_ratio: 0.4,
        }
    }
}

//! Condition of a joint: what wears out, overheats or fails.

/// Condition of one joint's drive, as far as the device reports it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct JointStatus {
    /// Temperature of the motor, or of its driver if that is hotter [°C].
    pub temperature: Option<f64>,
    /// Motor current [A].
    pub current: Option<f64>,
    /// Supply voltage [V].
    pub voltage: Option<f64>,
    /// Load as a fraction of the rated torque, signed.
    pub load: Option<f64>,
    /// The drive's own error code; 0 = none.
    pub error: Option<i32>,
}

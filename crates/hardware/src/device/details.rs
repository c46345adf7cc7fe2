//! Values of an arm that change slowly: read a few times a second, for status and log. The tick does not read them.

use dimos_core::arm::{IoState, JointStatus, Load};
use dimos_core::clock::Mono;
use dimos_core::joint::MAX_DOF;

/// The latest readings.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Details {
    /// Counts the changes of `io`, and when it was read; 0 = not yet.
    pub io_seq: u64,
    /// When `io` was read.
    pub io_stamp: Mono,
    /// Levels of inputs and outputs; `None` before the first reading, after a failed one, and without any.
    pub io: Option<IoState>,
    /// Counts the readings of `joints`; 0 = none yet.
    pub joints_seq: u64,
    /// When `joints` was read.
    pub joints_stamp: Mono,
    /// Condition of the joints; `None` after a failed reading, and if the device reports none.
    pub joints: Option<[JointStatus; MAX_DOF]>,
    /// Counts the changes of `payload`; 0 = not read yet.
    pub payload_seq: u64,
    /// When `payload` was read.
    pub payload_stamp: Mono,
    /// Load that the controller calculates with, where it reports one.
    pub payload: Option<Load>,
}

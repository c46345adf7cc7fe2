//! The condition of the joints' drives.

use super::AdapterResult;
use dimos_core::arm::JointStatus;

/// Condition of the joints' drives. The adapter usually implements it itself, and
/// [`ManipulatorAdapter::joint_monitor`](super::ManipulatorAdapter::joint_monitor) returns `Some(self)`.
pub trait JointMonitor {
    /// Fills in the condition of the joints, one entry per joint; values that the device does not report stay `None`.
    /// Read about twice a second, so it may cost a round trip. Must not allocate.
    fn read_joint_status(&mut self, joints: &mut [JointStatus]) -> AdapterResult<()>;
    /// Fills in the offsets that the device's calibration subtracts from its encoders [rad], one per joint; `false` if
    /// it does not report them. Read once after `connect`.
    fn read_calibration_offsets(&mut self, _offsets: &mut [f64]) -> AdapterResult<bool> {
        Ok(false)
    }
}

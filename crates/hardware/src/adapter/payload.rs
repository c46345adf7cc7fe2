//! The load at the flange and the mounting of the base.

use super::{AdapterError, AdapterResult};
use dimos_core::arm::Load;

/// What the arm's controller must know of masses and of gravity. The adapter usually implements it itself, and
/// [`ManipulatorAdapter::payload`](super::ManipulatorAdapter::payload) returns `Some(self)`.
///
/// The device thread calls the writing methods at standstill only, and reads back what was written.
pub trait Payload {
    /// Returns the load that the controller calculates with; `None` if it does not report one. Its inertia is zero if
    /// the controller keeps none. Must not allocate.
    fn read_payload(&mut self) -> AdapterResult<Option<Load>>;
    /// Sets the load at the flange: tool and workpiece together. Moves nothing. `Rejected` for more than the arm
    /// carries.
    fn write_payload(&mut self, load: &Load) -> AdapterResult<()>;
    /// Returns whether setting the load resets the controller, so that the arm must be activated afterwards. The
    /// program then does that, with the arm in standby meanwhile.
    fn resets_controller(&self) -> bool {
        false
    }
    /// Returns the direction of gravity in the base frame that the controller calculates with, as a unit vector:
    /// 0, 0, −1 for an upright arm; `None` if it does not report one.
    fn read_mounting(&mut self) -> AdapterResult<Option<[f64; 3]>> {
        Ok(None)
    }
    /// Sets the mounting by the direction of gravity in the base frame, a unit vector. Moves nothing.
    fn write_mounting(&mut self, _gravity: [f64; 3]) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
}

//! Digital and analogue inputs and outputs.

use super::{AdapterError, AdapterResult};
use dimos_core::arm::{IoInfo, IoState};

/// The inputs and outputs of the arm's controller. The adapter usually implements it itself, and
/// [`ManipulatorAdapter::io`](super::ManipulatorAdapter::io) returns `Some(self)`.
///
/// Nothing here moves the arm. Outputs keep their values when the connection ends, unless the controller resets them.
pub trait Io {
    /// Returns the number of channels and their units, known once connected.
    fn get_io(&self) -> IoInfo;
    /// Fills in the levels of all channels, no older than the joint state that is read in the same cycle; an error if
    /// they are: a stop input must not seem closed because its report has ended. Must not allocate: with a stop input
    /// it is called in every cycle.
    fn read_io(&mut self, state: &mut IoState) -> AdapterResult<()>;
    /// Sets a digital output (number from 0). `Rejected` for one that the controller lacks.
    fn write_digital_output(&mut self, output: u8, high: bool) -> AdapterResult<()>;
    /// Sets an analogue output (number from 0) to a value in its unit. `Rejected` for one that the controller lacks,
    /// and for a value outside its range.
    fn write_analog_output(&mut self, _output: u8, _value: f64) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
}

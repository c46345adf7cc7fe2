//! Work on an arm outside a run, directly on its bus: find it, number its motors, calibrate it, write its settings. The
//! verbs `dimos arm find-port`, `setup-motors`, `calibrate` and `configure` do it, for every adapter whose row has a
//! [`service`](crate::registry::AdapterSpec::service).
//!
//! Nothing here moves an arm: motors are only ever switched off. Values are in the wire's own units.

use std::path::Path;

use serde::Serialize;

use crate::adapter::{AdapterError, AdapterResult};
use crate::registry::AdapterConfig;

/// Opens the bus of an arm. Reads and writes nothing yet.
pub type OpenService = fn(&AdapterConfig) -> AdapterResult<Box<dyn Service>>;

/// A motor of an arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Motor {
    /// Its name: that of its joint.
    pub name: &'static str,
    /// Its number on the bus.
    pub id: u8,
    /// Its range unless another one is recorded by hand, lowest and highest position: of a joint that may have no end
    /// stops.
    pub range: Option<(i32, i32)>,
}

/// A setting that a motor keeps without power, and that has another value than the adapter wants.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Setting {
    /// The motor.
    pub motor: &'static str,
    /// What it sets.
    pub name: &'static str,
    /// The motor's register that has it.
    pub register: u16,
    /// Its value.
    pub found: u16,
    /// The value that the adapter wants.
    pub wanted: u16,
}

/// A motor that is alone on the bus.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Single {
    /// Its number.
    pub id: u8,
    /// The rate at which it answers [bit/s].
    pub baud: u32,
}

/// The motors of an arm on their bus. What an arm lacks is `Unsupported`.
pub trait Service {
    /// Returns the motors, from the base.
    fn motors(&self) -> &'static [Motor];
    /// Reads which arm this is, in a few words; an error names a motor that is missing. Writes nothing.
    fn identify(&mut self) -> AdapterResult<String>;
    /// Returns the names of the motors that are on.
    fn powered(&mut self) -> AdapterResult<Vec<&'static str>>;
    /// Switches all motors off, and reads that they are. An arm without brakes drops.
    fn release(&mut self) -> AdapterResult<()>;

    // --- Calibration ---

    /// Returns the number of counts of one turn.
    fn counts_per_turn(&self) -> i32 {
        4096
    }
    /// Takes the present pose as the middle of each motor's turn. Writes nothing.
    fn take_middle(&mut self) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
    /// Returns the positions by the middle that was taken, one per motor.
    fn positions(&mut self) -> AdapterResult<Vec<i32>> {
        Err(AdapterError::Unsupported)
    }
    /// Returns the text of the calibration file with the middle that was taken and these ranges. Writes nothing.
    fn calibration(&self, _ranges: &[(i32, i32)]) -> AdapterResult<String> {
        Err(AdapterError::Unsupported)
    }
    /// Reads the calibration of the motors, and writes that of a file to those that have another one. Returns their
    /// names. The caller calls it again to see that the motors have kept it: then there are none. After a failure some
    /// motors may have the new one: the same call again writes the others.
    fn write_calibration(&mut self, _file: &Path) -> AdapterResult<Vec<&'static str>> {
        Err(AdapterError::Unsupported)
    }

    // --- Settings ---

    /// Returns the settings with another value than the adapter wants. Writes nothing.
    fn settings(&mut self) -> AdapterResult<Vec<Setting>> {
        Err(AdapterError::Unsupported)
    }
    /// Writes the settings with another value, and reads them back. `Rejected` while a motor is on.
    fn write_settings(&mut self) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }

    // --- Numbers ---

    /// Finds the only motor on the bus, at any rate. `Rejected` if there are several, `Timeout` if there is none.
    fn find_single(&mut self) -> AdapterResult<Single> {
        Err(AdapterError::Unsupported)
    }
    /// Gives the motor that [`Service::find_single`] found this number and the rate of the arm's address, and reads
    /// both back.
    fn assign(&mut self, _single: &Single, _motor: &Motor) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
}

//! A serial CAN adapter.

use super::CanFilter;
use super::bus::BusPort;
use crate::hardware::spec::{AdapterError, AdapterResult};

/// Opens a port on the serial CAN adapter at `path`.
pub fn open(device: &str, path: &str, _bit_rate: u32, _filters: &[CanFilter]) -> AdapterResult<BusPort> {
    Err(AdapterError::Io(format!("cannot open {path} for {device}: slcan is not in this build yet")))
}

//! Arms of the run: their devices, locks, states, leading by hand, parking, inputs and outputs, and whether models fit.

pub(in crate::runtime) mod arm_requests;
pub(in crate::runtime) mod arms;
pub(in crate::runtime) mod control_config;
pub(crate) mod device_lock;
pub(in crate::runtime) mod late_stops;
pub(in crate::runtime) mod lead_requests;
pub(in crate::runtime) mod model_check;
pub(in crate::runtime) mod park;
pub(in crate::runtime) mod part_requests;
pub(in crate::runtime) mod peripherals;
pub(in crate::runtime) mod serial_locks;
pub(in crate::runtime) mod wires;

use std::sync::atomic::{AtomicBool, AtomicU64};
use std::sync::{Arc, Mutex};

use super::internal;
use dimos_hardware::device::{Details, Device, PeripheralDevice};
use dimos_rpc::RpcError;
use late_stops::LateStops;
use model_check::Checked;
use peripherals::ArmPeripherals;
use serial_locks::SerialLocks;

/// The arms as requests see them: their devices, and what has been done to them. Lists are per arm.
pub(in crate::runtime) struct ArmLinks {
    devices: Vec<Arc<Device>>,
    peripherals: Vec<Arc<ArmPeripherals>>,
    serials: Arc<SerialLocks>,
    /// Number of stops that clients have ordered.
    stops: Vec<AtomicU64>,
    /// Whether its own controller moves it.
    natives: Vec<AtomicBool>,
    late_stops: LateStops,
    /// Numbers of the slowly changing values that were logged last.
    details_logged: Mutex<Vec<Details>>,
    /// Where model and controller have the flange.
    checks: Mutex<Vec<Checked>>,
}

impl ArmLinks {
    pub fn new(devices: Vec<Arc<Device>>, peripherals: Vec<Arc<ArmPeripherals>>, serials: Arc<SerialLocks>) -> Self {
        let arms = devices.len();
        Self {
            devices,
            peripherals,
            serials,
            stops: (0..arms).map(|_| AtomicU64::new(0)).collect(),
            natives: (0..arms).map(|_| AtomicBool::default()).collect(),
            late_stops: LateStops::default(),
            details_logged: Mutex::new(vec![Details::default(); arms]),
            checks: Mutex::new(vec![Checked::default(); arms]),
        }
    }

    /// Returns the device of an arm of the run.
    pub fn device(&self, arm: u16) -> Result<Arc<Device>, RpcError> {
        self.get(arm.into()).cloned().ok_or_else(internal)
    }

    /// Returns the device of an arm.
    pub fn get(&self, arm: usize) -> Option<&Arc<Device>> {
        self.devices.get(arm)
    }

    /// Returns an arm's gripper, if that has its own connection.
    pub fn gripper(&self, arm: usize) -> Option<&PeripheralDevice> {
        self.peripherals.get(arm)?.gripper()
    }

    /// Returns whether an arm's stop still waits for the connection.
    pub fn stop_is_pending(&self, arm: usize) -> bool {
        self.late_stops.is_waiting(arm)
    }
}

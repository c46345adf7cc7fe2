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
pub(in crate::runtime) mod serial_locks;
pub(in crate::runtime) mod wires;

//! What interrupts an arm, and when a motion was requested.

use serde::{Deserialize, Serialize};

use super::Cause;

/// Event after which an arm does nothing that was requested before it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Interruption {
    /// An operator's `stop`.
    Stopped,
    /// The arm was held, for this cause.
    Held(Cause),
    /// The arm was disabled, or it was no longer led.
    Disabled,
    /// The connection to the arm was lost.
    LinkLost,
    /// The motors were switched off.
    PowerLost,
    /// This client took the lease of the arm.
    LeaseTaken(u64),
    /// This client released the lease of the arm, or disconnected.
    LeaseEnded(u64),
}

/// When and by whom a motion was requested.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Origin {
    /// Number of interruptions of all arms before the request arrived.
    pub epoch: u64,
    /// Number of the client's connection; 0: the program that has started the run.
    pub client: u64,
}

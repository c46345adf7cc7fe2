//! Passes the changes of leases on to the tick.

use std::sync::Mutex;

use super::dispatch::{SendError, log_of};
use crate::runtime::service::Service;
use dimos_control::request::Request;
use dimos_core::sync::lock;
use dimos_rpc::RpcError;

/// Ends of leases that the ring of requests had no room for: arm and connection.
pub(in crate::runtime) type UnsentEnds = Mutex<Vec<(u16, u64)>>;

impl Service {
    /// Reports to the tick that a connection commands an arm from now on.
    pub(in crate::runtime) fn note_lease_taken(&self, arm: &str, client: u64) -> Result<(), RpcError> {
        let request = Request::LeaseTaken { arm: self.arm_index(arm)?, client };
        let log = log_of(&request);
        self.parts.dispatcher.send(request, log).map(drop).map_err(|e| self.not_sent(e))
    }

    /// Reports to the tick that a connection no longer commands an arm.
    pub(in crate::runtime) fn note_lease_ended(&self, arm: &str, client: u64) {
        let Ok(arm) = self.arm_index(arm) else { return };
        lock(&self.unsent_ends).push((arm, client));
        self.send_lease_ends();
    }

    /// Sends the ends of leases to the tick; those that do not fit are sent after the next tick.
    pub fn send_lease_ends(&self) {
        let send = |(arm, client): &(u16, u64)| {
            let request = Request::LeaseEnded { arm: *arm, client: *client };
            let log = log_of(&request);
            matches!(self.parts.dispatcher.send(request, log), Err(SendError::Full))
        };
        lock(&self.unsent_ends).retain(send);
    }
}

//! Passes the changes of leases on to the tick.

use std::sync::Mutex;

use super::dispatch::{Dispatcher, SendError, log_of};
use crate::runtime::Service;
use dimos_control::request::Request;
use dimos_core::sync::lock;
use dimos_rpc::RpcError;

/// Ends of leases that the ring of requests had no room for: arm and connection.
#[derive(Debug, Default)]
pub(in crate::runtime) struct UnsentEnds(Mutex<Vec<(u16, u64)>>);

impl UnsentEnds {
    /// Adds the end of a connection's lease of an arm.
    pub fn add(&self, arm: u16, client: u64) {
        lock(&self.0).push((arm, client));
    }

    /// Sends the ends of leases to the tick; those that do not fit are sent after the next tick.
    pub fn send(&self, dispatcher: &Dispatcher) {
        let send = |(arm, client): &(u16, u64)| {
            let request = Request::LeaseEnded { arm: *arm, client: *client };
            let log = log_of(&request);
            matches!(dispatcher.send(request, log), Err(SendError::Full))
        };
        lock(&self.0).retain(send);
    }
}

impl Service {
    /// Reports to the tick that a connection commands an arm from now on.
    pub(in crate::runtime) fn note_lease_taken(&self, arm: &str, client: u64) -> Result<(), RpcError> {
        let request = Request::LeaseTaken { arm: self.facts.arm_index(arm)?, client };
        let log = log_of(&request);
        self.tick.dispatcher().send(request, log).map(drop).map_err(|e| self.not_sent(e))
    }

    /// Reports to the tick that a connection no longer commands an arm.
    pub(in crate::runtime) fn note_lease_ended(&self, arm: &str, client: u64) {
        let Ok(arm) = self.facts.arm_index(arm) else { return };
        self.tick.lease_ended(arm, client);
    }
}

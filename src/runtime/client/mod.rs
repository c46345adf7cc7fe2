//! Clients: who asks, what waits for the tick, leases, and the gateway.

pub(in crate::runtime) mod asker;
pub(in crate::runtime) mod curb;
pub(in crate::runtime) mod dispatch;
pub(in crate::runtime) mod faces;
pub(in crate::runtime) mod in_process;
pub(in crate::runtime) mod lease_changes;
pub(in crate::runtime) mod refusals;
pub(in crate::runtime) mod tick_link;

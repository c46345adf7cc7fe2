//! Real-time primitives: latest-value slots, wake-ups, scheduling, memory. The only module with `unsafe`.

pub mod arrival;
pub mod counting;
pub mod due;
pub mod heartbeat;
pub mod histogram;
pub mod host;
pub mod slot;
pub mod wake;

//! Real-time primitives: latest-value slots, wake-ups, scheduling, memory; and names that the kernel keeps. The only
//! module with `unsafe`.

pub mod abstract_name;
pub mod arrival;
pub mod counting;
pub mod due;
pub mod heartbeat;
pub mod histogram;
pub mod host;
pub mod slot;
pub mod socket_list;
pub mod wake;

//! The real-time ground: latest-value slots, wake-ups, scheduling, memory. The only place with `unsafe`.

pub mod beat;
pub mod due;
pub mod histogram;
pub mod host;
pub mod slot;
pub mod wake;

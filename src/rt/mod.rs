//! The real-time ground: latest-value slots, wake-ups, scheduling, memory. The only place with `unsafe`.

pub mod beat;
pub mod histogram;
pub mod host;
pub mod slot;
pub mod wake;

/// The primitives that `slot` is built from; its model test swaps them for checked ones.
mod sync {
    pub use std::cell::UnsafeCell;
    pub use std::sync::Arc;
    pub use std::sync::atomic::{AtomicU8, Ordering};
}

//! The face of a run to Python dimos 0.0.15: to its programs the run is their `ControlCoordinator`.
//!
//! ```text
//!  their client, their planner ═ zenoh on `lo` ═▶ queryable: pickle → call ─┬─▶ what is known here
//!                                                                           ├─▶ lane `reads` ─▶ run's socket
//!                                                                           ├─▶ lane `moves` ─▶   "
//!                              ◀═ joint states, every tick ═ states ◀─ run  └─▶ lane `ends`  ─▶   "
//! ```
//!
//! Each lane is a connection with a thread: a cancellation waits for no trajectory that is being checked. Nothing that
//! comes from the network is executed: [`pickle_reader`] keeps names of classes as names.

mod arguments;
mod calls;
mod face;
#[cfg(test)]
mod fuzz;
mod gripper;
mod keys;
mod lanes;
mod lcm;
mod names;
mod pickle_node;
mod pickle_reader;
mod pickle_writer;
mod python_error;
mod results;
mod rival;
mod states;
mod trajectories;

pub(super) use face::{Face, report};
pub(super) use keys::{calls, calls_of, streams};

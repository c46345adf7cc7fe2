//! A run on the network: `dimos share` gives it to other computers, `--at` reaches it from there. Over
//! [zenoh](https://zenoh.io), because ROS 2 speaks it.
//!
//! ```text
//!  cell computer:  run ◀─ socket ─ gateway (its own process) ◀─ zenoh, TLS ─ line ◀─ any verb with --at :laptop
//! ```
//!
//! [`gateway`] is the end at the run: one more client of its socket. [`line`] is that of a client. Both speak the
//! methods of the socket; [`keys`] has their names on the network, [`class`] who may call them.

#[cfg(feature = "share")]
mod access;
#[cfg(feature = "share")]
mod certificates;
#[cfg(feature = "share")]
mod class;
#[cfg(feature = "share")]
mod connection;
#[cfg(feature = "share")]
mod ends;
#[cfg(feature = "share")]
mod gateway;
#[cfg(feature = "share")]
mod keys;
#[cfg(feature = "share")]
mod page;
#[cfg(feature = "share")]
mod place;
#[cfg(feature = "share")]
#[cfg(feature = "share")]
mod refusals;
#[cfg(feature = "share")]
mod relay;
#[cfg(feature = "share")]
mod remote;
#[cfg(feature = "share")]
mod remote_runs;
#[cfg(feature = "share")]
mod ros;
#[cfg(feature = "share")]
mod settings;
#[cfg(feature = "share")]
mod streams;
#[cfg(feature = "share")]
mod thinning;
#[cfg(not(feature = "share"))]
mod without_share;

#[cfg(feature = "share")]
pub use certificates::{check_gateway, check_places};
#[cfg(feature = "share")]
pub use gateway::Gateway;
#[cfg(feature = "share")]
pub use page::Page;
#[cfg(feature = "share")]
pub use place::Place;
#[cfg(feature = "share")]
pub use refusals::layer as refusals;
#[cfg(feature = "share")]
pub use relay::Relay;
#[cfg(feature = "share")]
pub use remote_runs::{connect, connect_again, page, runs};
#[cfg(feature = "share")]
pub use settings::THREADS;
#[cfg(not(feature = "share"))]
pub use without_share::{
    Gateway, Page, Relay, THREADS, check_gateway, check_places, connect, connect_again, page, refusals, runs,
};

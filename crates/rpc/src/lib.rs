//! Owns requests, reports and both ends of the socket of a run. Never decides. Used by the run, and by all its clients.
//!
//! The protocol of a run: one Unix socket per run, one JSON object per line in each direction.
//!
//! ```text
//! → {"id":1,"method":"move","params":{"arm":"arm","target":[0.3,-0.2,0.5,0,0.4,0]}}
//! ← {"id":1,"result":{"motion":7,"task":"traj_arm","duration":2.1,"start":[…],"target":[…]}}
//! → {"id":2,"method":"subscribe","params":{"stream":"coordinator_joint_state","rate":50}}
//! ← {"id":2,"result":{"subscription":1}}
//! ← {"stream":"coordinator_joint_state","subscription":1,"data":{…}}
//! ```
//!
//! Requests that move an arm need its lease, which one connection at a time can hold: `lease.rs`.
//!
//! [`api`] has the methods and their parameters, [`report`] the status reports, [`error`] the errors. [`run_dir`] finds
//! the sockets of live runs; [`server`] and [`client`] are the two sides of a connection.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable))]
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

pub mod api;
pub mod client;
pub mod error;
pub mod report;
pub mod run_dir;
pub mod server;
mod wire;

pub use api::{Backend, BoxFuture, Method, Reply, Request};
pub use error::{Code, RpcError};
pub use server::lease::{Claimant, Subject};

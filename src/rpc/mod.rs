//! Talking to a run: one Unix socket per run, one JSON object per line each way.
//!
//! ```text
//! → {"id":1,"method":"move","params":{"arm":"arm","target":[0.3,-0.2,0.5,0,0.4,0]}}
//! ← {"id":1,"result":{"motion":7,"task":"traj_arm","duration":2.1,"start":[…],"target":[…]}}
//! → {"id":2,"method":"subscribe","params":{"stream":"coordinator_joint_state","rate":50}}
//! ← {"id":2,"result":{"subscription":1}}
//! ← {"stream":"coordinator_joint_state","subscription":1,"data":{…}}
//! ```
//!
//! Requests that move an arm need its lease, which one connection has at a time: `lease.rs`.
//!
//! [`api`] says what may be asked, [`report`] what comes back, [`error`] how it is refused. [`place`] says where the
//! sockets are and which runs are live, [`server`] and [`client`] are the two ends.

pub mod api;
mod arm_api;
mod attach_api;
mod cartesian_api;
pub mod client;
mod connection;
pub mod error;
mod lease;
mod motion_api;
pub mod place;
mod planner_api;
pub mod planner_end;
pub mod planner_line;
pub mod report;
pub mod schema;
mod seats;
pub mod server;
pub mod streams;
mod subscription;
mod urgent;
mod wire;
mod world_api;

pub use api::{Backend, BoxFuture, Method, Reply, Request};
pub use error::{Code, RpcError};
pub use lease::Subject;

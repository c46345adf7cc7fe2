//! dimos runs robot arms: a real-time control coordinator, recording and replay, from a YAML blueprint, for any arm.
//!
//! ```text
//!  blueprint.yaml ─▶ blueprint (schema → resolve) ─▶ runtime: builds everything below, starts and stops threads
//!
//!  CLI ──rpc──▶ runtime::service ──requests──▶ coordinator (real-time thread)
//!                     └─▶ planning: robot model, obstacles (collision) ▶ a verified trajectory ──▲
//!                                              │ tick: read → compute → arbitrate → limit → route → write
//!                                              ▼
//!   tasks ─▶ arbitrate ─▶ limit ─▶ route ──(command slot)──▶ device thread ─▶ adapter ─▶ wire ─▶ arm | emulator
//!     ▲ state slot: latest joint state, time-stamped  ◀───────────┘   one per arm
//!     └──(ring, drop-counted)──▶ recorder ─▶ MCAP          └──▶ rpc: published joint state
//! ```
//!
//! Everything below the run is a crate of its own in `crates/`, which this one shows under the names of its modules.
//!
//! As a library: [`runtime::Run`] builds a run from a blueprint, [`hardware::registry`] makes adapters,
//! [`hardware::adapter::ManipulatorAdapter`] is what a new arm implements, [`testing`] has a mock for unit tests,
//! [`cli::Program`] is the whole program with more arms or task types. `docs/library.md` shows each.
//!
//! ```
//! use dimos::runtime::{Record, Run};
//!
//! let run = Run::from_name("coordinator-mock")?.name("doc-crate").record(Record::Off).start()?;
//! println!("{} is up at {} Hz", run.name(), run.status().tick_rate);
//! run.stop();
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

/// Version of this program, with the commit it was built from where that is known.
pub const VERSION: &str = env!("DIMOS_VERSION");

pub use dimos_arms as arms;
pub use dimos_control as control;
pub use dimos_core::{arm, clock, joint, message, pose, sync, telemetry, trajectory};
pub use dimos_hardware as hardware;
pub use dimos_hardware::testing;
pub use dimos_log as recording;
pub use dimos_planner::{collision, planning};
pub use dimos_robot as robot;
pub use dimos_rpc as rpc;
pub use dimos_rt as rt;
pub use dimos_yaml as yaml;
/// The type of robots from and for other programs: `RobotModel::try_from(&urdf_rs::Robot)`, and back.
pub use urdf_rs;

pub mod assets;
pub mod blueprint;
pub mod cli;
pub mod http;
pub mod metrics;
pub mod offline;
pub mod replay;
pub mod ros_messages;
pub mod runtime;
pub mod share;
pub mod view;

/// The examples of `docs/kit.md`, as tests.
#[cfg(doctest)]
#[doc = include_str!("../docs/kit.md")]
pub struct KitPage;

/// The examples of `docs/library.md`, as tests.
#[cfg(doctest)]
#[doc = include_str!("../docs/library.md")]
pub struct LibraryPage;

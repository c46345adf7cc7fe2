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
//! A module may use only those above it in this list; `tests/logic/layering.rs` checks that.
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

#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

/// Version of this program, with the commit it was built from where that is known.
pub const VERSION: &str = env!("DIMOS_VERSION");

pub mod arm;
mod bounded;
pub mod clock;
pub mod joint;
pub mod message;
mod named;
pub mod pose;
#[cfg(any(feature = "share", feature = "view"))]
mod random;
pub mod sync;
pub mod telemetry;
pub mod trajectory;
pub mod yaml;

pub mod rt;

pub mod robot;
/// The type of robots from and for other programs: `RobotModel::try_from(&urdf_rs::Robot)`, and back.
pub use urdf_rs;

pub mod assets;

pub mod collision;

pub mod hardware;

pub mod control;

pub mod planning;

pub mod rpc;

pub mod recording;

pub mod blueprint;

pub mod view;

pub mod share;

pub mod runtime;

pub mod replay;

pub mod cli;
pub mod testing;

/// The examples of `docs/kit.md`, as tests.
#[cfg(doctest)]
#[doc = include_str!("../docs/kit.md")]
pub struct KitPage;

/// The examples of `docs/library.md`, as tests.
#[cfg(doctest)]
#[doc = include_str!("../docs/library.md")]
pub struct LibraryPage;

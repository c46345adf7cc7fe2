//! The composition root: starts the threads of a resolved blueprint, and stops them in order. The only module that uses
//! all others.
//!
//! ```text
//! start: claim the name ─▶ lock the devices ─▶ emulators ─▶ connect all ─▶ tick, recorder ─▶ enable ─▶ rpc ─▶ view
//! stop:  park, where asked ─▶ decelerate ─▶ end the tick ─▶ release the arms ─▶ close rpc ─▶ close the log
//! ```
//!
//! [`Run`] owns the threads. [`Service`] answers their clients: one owner per thing, each in its folder, which alone
//! sees its state.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable))]

pub(crate) mod arm;
mod builder;
mod client;
mod facts;
mod gripper;
mod handle;
mod lifecycle;
mod log;
mod motion;
mod options;
mod plan;
mod run;
mod service;
mod service_manager;
mod start;
mod tick;
mod tick_source;
pub mod tool;
mod watchdog;

use std::sync::Weak;
use std::sync::mpsc::{Receiver, Sender};

pub use arm::device_lock::DeviceLockError;
pub use builder::Builder;
pub use client::dispatch::log_of;
pub use dimos_control::arm_control::effective as effective_speed;
pub use handle::Handle;
pub use log::metrics::bind as bind_metrics;
pub use options::{Ended, Ending, Options, Record, StartError};
pub use plan::attached::{AttachedPlanner, LinkEvent};
#[cfg(feature = "view")]
pub(crate) use plan::world_requests::typed as world_object;
pub use service_manager::ServiceManager;

use crate::metrics::Metrics;
use crate::view::View;
use arm::ArmLinks;
use arm::arms::Arms;
use client::dispatch::OutcomeThread;
use client::tick_link::TickLink;
use dimos_log::recorder::Recorder;
use dimos_rpc::server::Server;
use dimos_rt::host::LatencyHold;
use facts::Facts;
use gripper::Grippers;
use lifecycle::Lifecycle;
use log::Journal;
use motion::going::Goings;
use motion::motions::Motions;
use motion::streams::Streams;
use plan::Plans;
use service::internal;
use tick::Tick;
use tool::Tools;
use watchdog::Watchdog;

/// A live run. All requests are methods of its [`Handle`], and thus of the run itself.
///
/// ```
/// use dimos::runtime::{Record, Run};
///
/// let run = Run::from_name("coordinator-mock")?.name("doc-run").record(Record::Off).start()?;
/// let motion = run.move_arm("arm", &[0.1, -0.2, 0.3, 0.0, 0.2, 0.0, 0.0], 1.0)?;
/// assert_eq!(run.wait(motion.motion)?.state, "COMPLETED");
/// let ended = run.stop();
/// assert!(ended.troubles.is_empty());
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub struct Run {
    arms: Arms,
    tick: Tick,
    watchdog: Watchdog,
    outcomes: Option<OutcomeThread>,
    recorder: Option<Recorder>,
    view: Option<View>,
    metrics: Option<Metrics>,
    server: Option<Server>,
    handle: Handle,
    endings: (Sender<Ending>, Receiver<Ending>),
    manager: Option<ServiceManager>,
    _latency: Option<LatencyHold>,
}

/// The run, for its clients.
pub(in crate::runtime) struct Service {
    facts: Facts,
    tick: TickLink,
    arms: ArmLinks,
    grippers: Grippers,
    tools: Tools,
    motions: Motions,
    goings: Goings,
    streams: Streams,
    plans: Plans,
    journal: Journal,
    lifecycle: Lifecycle,
    me: Weak<Self>,
}

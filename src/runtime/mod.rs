//! The composition root: starts the threads of a resolved blueprint, and stops them in order. The only module that uses
//! all others.
//!
//! ```text
//! start: claim the name ─▶ lock the devices ─▶ emulators ─▶ connect all ─▶ tick, recorder ─▶ enable ─▶ rpc ─▶ view
//! stop:  park, where asked ─▶ decelerate ─▶ end the tick ─▶ release the arms ─▶ close rpc ─▶ close the log
//! ```

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable))]

pub(crate) mod arm;
mod builder;
mod client;
mod gripper;
mod handle;
mod log;
mod motion;
mod plan;
mod service;
mod service_manager;
mod start;
mod tick;
mod tick_source;
pub mod tool;
mod watchdog;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::time::{Duration, Instant};

pub use arm::device_lock::DeviceLockError;
pub use builder::Builder;
pub use client::dispatch::log_of;
pub use dimos_control::arm_control::effective as effective_speed;
pub use handle::Handle;
pub use plan::attached::{AttachedPlanner, LinkEvent};
#[cfg(feature = "view")]
pub(crate) use plan::world_requests::typed as world_object;
pub use service_manager::ServiceManager;

use crate::view::View;
use arm::arms::Arms;
use client::dispatch::{Dispatcher, OutcomeThread};
use dimos_control::config::CoordinatorConfig;
use dimos_control::request::Request;
use dimos_control::tick_loop::{Probe, Pulse};
use dimos_core::sync::lock;
use dimos_log::recorder::Recorder;
use dimos_planner::planning::request::planner_thread::Solver;
use dimos_rpc::api::TextLines;
use dimos_rpc::report::ArmReport;
use dimos_rpc::run_dir::RunDir;
use dimos_rpc::server::Server;
use dimos_rt::host::LatencyHold;
use tick::Tick;
use watchdog::Watchdog;

/// Timeout for moving arms to decelerate to rest.
const REST_LIMIT: Duration = Duration::from_secs(2);
/// An arm counts as at rest after this time at standstill: a reversal also has zero velocity for an instant.
const STILL_FOR: Duration = Duration::from_millis(50);

/// Destination of the log.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Record {
    /// As set in the blueprint.
    #[default]
    AsBlueprint,
    /// This file.
    To(PathBuf),
    /// No log but those of faults, as set in the blueprint.
    Faults,
    /// No log at all.
    Off,
}

/// Options of a run besides its blueprint.
pub struct Options {
    /// Name of the run; default: the blueprint's.
    pub name: Option<String>,
    /// Destination of the log.
    pub record: Record,
    /// Run directory, for the socket.
    pub folder: RunDir,
    /// Called at the start of each tick, for tests and benchmarks.
    pub probe: Option<Probe>,
    /// Answers planning requests instead of the built-in planner.
    pub solver: Option<Solver>,
    /// Whether deep idle states of the processor are disabled.
    pub hold_latency: bool,
    /// Receives start, heartbeat and end of the run, e.g. systemd.
    pub service_manager: Option<ServiceManager>,
    /// Whether the live view is served, as the blueprint says.
    pub view: bool,
    /// The lines that the program prints, for clients that ask for its text log.
    pub text: Option<TextLines>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            name: None,
            record: Record::AsBlueprint,
            folder: RunDir::standard(),
            probe: None,
            solver: None,
            hold_latency: true,
            service_manager: None,
            view: false,
            text: None,
        }
    }
}

/// Why a run did not start. Everything started before was stopped again.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// An arm cannot be reached, or differs from the blueprint.
    #[error("{arm}: {what}")]
    Hardware {
        /// The arm.
        arm: String,
        /// The problem.
        what: String,
        /// The hint.
        hint: String,
    },
    /// The blueprint has errors.
    #[error("{what}")]
    Blueprint {
        /// All of them as text, each with its location.
        what: String,
        /// The hint.
        hint: String,
    },
    /// Any other error.
    #[error("{what}")]
    Other {
        /// The problem.
        what: String,
        /// The hint.
        hint: String,
    },
}

impl StartError {
    /// Returns the hint.
    pub fn hint(&self) -> &str {
        match self {
            Self::Hardware { hint, .. } | Self::Blueprint { hint, .. } | Self::Other { hint, .. } => hint,
        }
    }

    fn other(what: impl ToString, hint: impl ToString) -> Self {
        Self::Other { what: what.to_string(), hint: hint.to_string() }
    }
}

/// Why a run ends.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Ending {
    /// A signal, with its number.
    Signal(i32),
    /// The duration was reached.
    Duration,
    /// A shutdown request over rpc.
    Asked,
    /// The log ended, with the reason.
    Log(String),
    /// A fault.
    Fault(String),
}

/// Result of a run that has ended.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Ended {
    /// Problems during the shutdown.
    pub troubles: Vec<String>,
    /// The arms that were parked ([`Run::park_and_stop`]).
    pub parked: Vec<String>,
    /// The arms that were not released in order; [`troubles`](Self::troubles) say why.
    pub unreleased: Vec<String>,
    /// The arms at rest, before they were released.
    pub arms: Vec<ArmReport>,
    /// The log, if one was written.
    pub log: Option<PathBuf>,
    /// Why the log ended before the run, if so.
    pub log_cut: Option<String>,
    /// The logs of faults, if the run was not recorded.
    pub fault_logs: Vec<PathBuf>,
}

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
    pulse: Arc<Pulse>,
    tick: Tick,
    watchdog: Watchdog,
    dispatcher: Arc<Dispatcher>,
    outcomes: Option<OutcomeThread>,
    recorder: Option<Recorder>,
    view: Option<View>,
    server: Option<Server>,
    handle: Handle,
    endings: (Sender<Ending>, Receiver<Ending>),
    /// Whether it ends by a fault, or because of its log: then nothing is parked.
    faulted: AtomicBool,
    manager: Option<ServiceManager>,
    _latency: Option<LatencyHold>,
}

impl std::ops::Deref for Run {
    type Target = Handle;

    fn deref(&self) -> &Handle {
        &self.handle
    }
}

impl Drop for Run {
    fn drop(&mut self) {
        for trouble in self.stop_in_order(false).troubles {
            tracing::warn!("{trouble}");
        }
    }
}

impl Run {
    /// Returns its socket, if it has one.
    pub fn socket(&self) -> Option<&std::path::Path> {
        self.server.as_ref().map(Server::socket)
    }

    /// Returns the URL of its live view, with the token, if it is served.
    pub fn view_url(&self) -> Option<&str> {
        self.view.as_ref().map(View::url)
    }

    /// Returns a handle for other threads.
    pub fn handle(&self) -> Handle {
        self.handle.clone()
    }

    /// Returns the coordinator's configuration, with the effective limits.
    pub fn config(&self) -> &CoordinatorConfig {
        &self.handle.service.parts.config
    }

    /// Returns a sender with which other threads can end the run.
    pub fn endings(&self) -> Sender<Ending> {
        self.endings.0.clone()
    }

    /// Waits for its end ([`endings`](Self::endings), `dimos down`, a fault), at most `limit`. The run stays up until
    /// [`stop`](Self::stop).
    pub fn wait_for_end(&self, limit: Option<Duration>) -> Ending {
        let received = match limit {
            Some(limit) => self.endings.1.recv_timeout(limit),
            None => self.endings.1.recv().map_err(|_| RecvTimeoutError::Disconnected),
        };
        let ending = received.unwrap_or(Ending::Duration);
        if matches!(ending, Ending::Fault(_) | Ending::Log(_)) {
            self.faulted.store(true, Ordering::Release);
        }
        ending
    }

    /// Shuts the run down in order. Continues after errors. Moves nothing: arms with `on_exit: park` are left as those
    /// without `on_exit`. Dropping a run does the same.
    pub fn stop(mut self) -> Ended {
        self.stop_in_order(false)
    }

    /// Moves arms with `on_exit: park` to their park pose, unless there was a fault, and shuts the run down. Until they
    /// have arrived, stop and cancel are accepted, and another ending ([`endings`](Self::endings)) ends the motion.
    pub fn park_and_stop(mut self) -> Ended {
        self.stop_in_order(true)
    }

    fn stop_in_order(&mut self, park: bool) -> Ended {
        // The remaining fields are dropped with the run, the arms before the server: when the run has disappeared, its
        // log is closed and its devices are free.
        let Some(recorder) = self.recorder.take() else { return Ended::default() };
        let mut ended = Ended { log: recorder.path().map(PathBuf::from), ..Ended::default() };
        if let Some(manager) = &self.manager {
            manager.stopping();
        }
        self.handle.service.close();
        if park {
            self.park(&mut ended);
        }
        self.come_to_rest(&mut ended);
        ended.arms = self.status().arms;
        self.handle.service.end_stops();
        self.watchdog.stand_down();
        if !self.tick.end() {
            ended.troubles.push("the tick thread does not end; it is left behind".to_owned());
        }
        let unreleased = self.arms.release();
        ended.parked.retain(|arm| !unreleased.iter().any(|(name, _)| name == arm));
        for (name, trouble) in unreleased {
            ended.unreleased.push(name);
            ended.troubles.push(trouble);
        }
        self.outcomes = None;
        if let Err(e) = recorder.finish() {
            ended.log_cut = e.to_string().lines().next().map(str::to_owned);
        }
        ended.fault_logs = std::mem::take(&mut lock(&self.handle.service.fault_logs));
        ended
    }

    fn come_to_rest(&self, ended: &mut Ended) {
        let sent = self.dispatcher.send(Request::Shutdown, log_of(&Request::Shutdown));
        let Ok(mut answer) = sent else { return ended.troubles.push("the coordinator accepts no requests".to_owned()) };
        if !self.rests(|| answer.try_recv().is_ok()) && self.tick.is_alive() {
            ended.troubles.push(format!("the arms were not at rest after {} s", REST_LIMIT.as_secs()));
        }
    }

    /// Waits until all arms are at rest, after `is_taken` returned true once. Returns whether they are.
    fn rests(&self, mut is_taken: impl FnMut() -> bool + Send) -> bool {
        let (service, tick, pulse) = (&self.handle.service, &self.tick, &self.pulse);
        let (mut taken, mut still_since) = (false, Instant::now());
        let look = || {
            taken = taken || is_taken();
            // Commands at rest are not enough: an arm that lags, or whose motors are off, may still move.
            let rests = pulse.at_rest.load(Ordering::Acquire) && service.at_standstill();
            // A client that has stopped an arm is answered before the run ends.
            if !(taken && rests && service.stops_are_sent()) {
                still_since = Instant::now();
            }
            let rests = still_since.elapsed() >= STILL_FOR.max(2 * service.period());
            (rests || !tick.is_alive()).then_some(rests)
        };
        client::in_process::wait_for(service.until(Instant::now() + REST_LIMIT, look)).flatten() == Some(true)
    }
}

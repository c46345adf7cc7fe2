//! The composition root: a resolved blueprint becomes threads, and they are stopped in order. The only place that
//! knows every module.
//!
//! ```text
//! start: claim the name ─▶ lock the devices ─▶ emulators ─▶ connect all ─▶ tick, recorder ─▶ enable ─▶ rpc
//! stop:  decelerate ─▶ end the tick ─▶ release the arms ─▶ close rpc ─▶ close the log
//! ```

mod arm_requests;
mod arms;
mod attached;
mod builder;
mod control_config;
pub(crate) mod device_lock;
mod dispatch;
mod handle;
mod in_process;
mod late_stops;
mod log_file;
mod motion_requests;
mod motions;
mod plan_requests;
mod planner_link;
mod planner_port;
mod recheck;
mod repeats;
mod replan;
mod reports;
mod service;
mod service_manager;
mod start;
mod stream_requests;
mod tick;
mod waiting;
mod watchdog;
mod wires;
mod world_requests;

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender};
use std::time::{Duration, Instant};

pub use attached::{AttachedPlanner, Turn};
pub use builder::Builder;
pub use device_lock::DeviceTaken;
pub use dispatch::log_of;
pub use handle::Handle;
pub use service_manager::ServiceManager;

use crate::control::config::CoordinatorConfig;
use crate::control::request::Request;
use crate::control::tick_loop::{Probe, Pulse};
use crate::planning::planner_thread::Solver;
use crate::recording::recorder::Recorder;
use crate::rpc::place::RunFolder;
use crate::rpc::server::Server;
use crate::rt::host::LatencyHold;
use arms::Arms;
use dispatch::{Courier, Dispatcher};
use tick::Tick;
use watchdog::Watchdog;

/// Timeout for moving arms to decelerate to rest.
const REST_LIMIT: Duration = Duration::from_secs(2);
/// An arm counts as at rest after this time at standstill: a reversal also has zero velocity for an instant.
const STILL_FOR: Duration = Duration::from_millis(50);

/// Where a run is logged.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum Record {
    /// As the blueprint says.
    #[default]
    AsBlueprint,
    /// To this file.
    To(PathBuf),
    /// Not at all.
    Off,
}

/// What a blueprint leaves open.
pub struct Options {
    /// Name of the run; without it the blueprint's.
    pub name: Option<String>,
    /// Where it is logged.
    pub record: Record,
    /// Where the socket is.
    pub folder: RunFolder,
    /// Called at each tick; for tests and benchmarks.
    pub probe: Option<Probe>,
    /// What answers the planner's requests in the place of this program's own planner.
    pub solver: Option<Solver>,
    /// Whether idle states of the processor are held off.
    pub hold_latency: bool,
    /// Receives start, heartbeat and end of the run: systemd, for a run that is a service.
    pub service_manager: Option<ServiceManager>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            name: None,
            record: Record::AsBlueprint,
            folder: RunFolder::standard(),
            probe: None,
            solver: None,
            hold_latency: true,
            service_manager: None,
        }
    }
}

/// Why a run did not start. Everything that had been started is stopped again.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// An arm cannot be reached, or is not what it should be.
    #[error("{arm}: {what}")]
    Hardware {
        /// The arm.
        arm: String,
        /// What is wrong.
        what: String,
        /// What to do.
        hint: String,
    },
    /// The blueprint has mistakes.
    #[error("{what}")]
    Blueprint {
        /// All of them, each at its place, for people.
        what: String,
        /// What to do.
        hint: String,
    },
    /// Something else is in the way.
    #[error("{what}")]
    Other {
        /// What is wrong.
        what: String,
        /// What to do.
        hint: String,
    },
}

impl StartError {
    /// What to do about it.
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
    /// A signal came: its number.
    Signal(i32),
    /// Its time is over.
    Duration,
    /// It was asked to, over rpc.
    Asked,
    /// Its log ended, and why.
    Log(String),
    /// Something broke.
    Fault(String),
}

/// What is to be said of a run that has ended.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Ended {
    /// What did not go as it should while stopping.
    pub troubles: Vec<String>,
    /// The log, if one was written.
    pub log: Option<PathBuf>,
    /// Why the log ended before the run, if it did.
    pub log_cut: Option<String>,
}

/// A run that is up. Everything it can be asked is a method of its [`Handle`], and so of the run itself.
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
    courier: Option<Courier>,
    recorder: Option<Recorder>,
    server: Option<Server>,
    handle: Handle,
    endings: (Sender<Ending>, Receiver<Ending>),
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
        for trouble in self.stop_in_order().troubles {
            tracing::warn!("{trouble}");
        }
    }
}

impl Run {
    /// Its socket, if it has one.
    pub fn socket(&self) -> Option<&std::path::Path> {
        self.server.as_ref().map(Server::socket)
    }

    /// A way to talk to it, for other threads.
    pub fn handle(&self) -> Handle {
        self.handle.clone()
    }

    /// What its coordinator was made from: effective limits among others.
    pub fn config(&self) -> &CoordinatorConfig {
        &self.handle.service.parts.config
    }

    /// Lets other threads end it.
    pub fn endings(&self) -> Sender<Ending> {
        self.endings.0.clone()
    }

    /// Waits until it is ended ([`endings`](Self::endings), `dimos down`, a fault), at most `limit`.
    /// It is still up then, until it is stopped.
    pub fn wait_for_end(&self, limit: Option<Duration>) -> Ending {
        let received = match limit {
            Some(limit) => self.endings.1.recv_timeout(limit),
            None => self.endings.1.recv().map_err(|_| RecvTimeoutError::Disconnected),
        };
        received.unwrap_or(Ending::Duration)
    }

    /// Stops it, in order: nothing is skipped, whatever breaks on the way. A run that is dropped is stopped as well.
    pub fn stop(mut self) -> Ended {
        self.stop_in_order()
    }

    fn stop_in_order(&mut self) -> Ended {
        // What is left in the fields goes when the run is dropped, the arms before the server: who sees that the run is
        // gone finds its log closed and its devices free.
        let Some(recorder) = self.recorder.take() else { return Ended::default() };
        let mut ended = Ended { log: recorder.path().map(PathBuf::from), ..Ended::default() };
        if let Some(manager) = &self.manager {
            manager.stopping();
        }
        self.handle.service.close();
        self.come_to_rest(&mut ended);
        self.watchdog.stand_down();
        if !self.tick.end() {
            ended.troubles.push("the tick thread does not end; it is left behind".to_owned());
        }
        ended.troubles.extend(self.arms.release());
        self.courier = None;
        if let Err(e) = recorder.finish() {
            ended.log_cut = e.to_string().lines().next().map(str::to_owned);
        }
        ended
    }

    fn come_to_rest(&self, ended: &mut Ended) {
        let told = self.dispatcher.send(Request::Shutdown, dispatch::log_of(&Request::Shutdown));
        let Ok(mut answer) = told else { return ended.troubles.push("the coordinator takes no requests".to_owned()) };
        let (service, tick, pulse) = (&self.handle.service, &self.tick, &self.pulse);
        let (mut taken, mut still_since) = (false, Instant::now());
        let look = || {
            taken = taken || answer.try_recv().is_ok();
            // That nothing is commanded to move is half of it: an arm that lags, or that was let go of, still moves.
            if !(taken && pulse.at_rest.load(Ordering::Acquire) && service.at_standstill()) {
                still_since = Instant::now();
            }
            let rests = still_since.elapsed() >= STILL_FOR.max(2 * service.period());
            (rests || !tick.is_alive()).then_some(())
        };
        let rested = in_process::wait_for(service.until(Instant::now() + REST_LIMIT, look)).flatten();
        if rested.is_none() && tick.is_alive() {
            ended.troubles.push(format!("the arms were not at rest after {} s", REST_LIMIT.as_secs()));
        }
    }
}

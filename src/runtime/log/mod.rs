//! What the run says of itself: reports, the log and its scene.

pub(in crate::runtime) mod events;
pub(in crate::runtime) mod log_file;
pub(in crate::runtime) mod log_throttle;
pub(in crate::runtime) mod logged_scene;
pub(in crate::runtime) mod reports;

use std::path::PathBuf;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, OnceLock};

use dimos_core::sync::lock;
use dimos_log::recorder::RecorderStats;
use dimos_log::tcp_log::{TcpChain, TcpChains};
use dimos_rpc::server::streams::Streams;
use log_throttle::LogThrottle;
use logged_scene::{Described, LoggedWorld};

/// What goes from a run to its log and its subscribers.
#[derive(Default)]
pub(in crate::runtime) struct Journal {
    subscribers: Streams,
    recorder: OnceLock<Arc<RecorderStats>>,
    /// The logs of faults, of a run that is not recorded.
    fault_logs: Mutex<Vec<PathBuf>>,
    /// The arms' tool centre points, for the log.
    tcps: TcpChains,
    /// The robots with their names in the run.
    described: OnceLock<Described>,
    /// The objects of the world, as logged.
    world: Mutex<LoggedWorld>,
    throttle: LogThrottle,
    /// Number of ticks when the joint state was last published.
    published: AtomicU64,
    /// Address of the live view.
    view: OnceLock<String>,
}

impl Journal {
    /// Returns the streams of subscribers.
    pub fn subscribers(&self) -> &Streams {
        &self.subscribers
    }

    /// Sets the recorder's statistics.
    pub fn set_recorder(&self, stats: Arc<RecorderStats>) {
        let _ = self.recorder.set(stats);
    }

    /// Sets the address of the live view.
    pub fn set_view(&self, address: &str) {
        let _ = self.view.set(address.to_owned());
    }

    /// Returns the arms' tool centre points, for the recorder.
    pub fn tcps(&self) -> TcpChains {
        self.tcps.clone()
    }

    /// Replaces the arms' tool centre points.
    pub fn set_tcps(&self, chains: Vec<Option<TcpChain>>) {
        *lock(&self.tcps) = chains;
    }

    /// Adds the log of a fault.
    pub fn add_fault_log(&self, path: PathBuf) {
        lock(&self.fault_logs).push(path);
    }

    /// Returns the logs of faults, and forgets them.
    pub fn take_fault_logs(&self) -> Vec<PathBuf> {
        std::mem::take(&mut lock(&self.fault_logs))
    }
}

//! A live run, and its end in order.

use std::path::PathBuf;
use std::sync::atomic::Ordering;
use std::sync::mpsc::{RecvTimeoutError, Sender};
use std::time::{Duration, Instant};

use super::client::dispatch::log_of;
use super::client::in_process;
use super::{Ended, Ending, Handle, Run};
use crate::view::View;
use dimos_control::config::CoordinatorConfig;
use dimos_control::request::Request;
use dimos_rpc::server::Server;

/// Timeout for moving arms to decelerate to rest.
const REST_LIMIT: Duration = Duration::from_secs(2);
/// An arm counts as at rest after this time at standstill: a reversal also has zero velocity for an instant.
const STILL_FOR: Duration = Duration::from_millis(50);

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
        &self.handle.service().facts.config
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
        self.handle.service().lifecycle.close();
        if park {
            self.park(&mut ended);
        }
        self.come_to_rest(&mut ended);
        ended.arms = self.status().arms;
        self.handle.service().lifecycle.end_stops();
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
        ended.fault_logs = self.handle.service().journal.take_fault_logs();
        ended
    }

    fn come_to_rest(&self, ended: &mut Ended) {
        let sent = self.handle.service().tick.dispatcher().send(Request::Shutdown, log_of(&Request::Shutdown));
        let Ok(mut answer) = sent else { return ended.troubles.push("the coordinator accepts no requests".to_owned()) };
        if !self.rests(|| answer.try_recv().is_ok()) && self.tick.is_alive() {
            ended.troubles.push(format!("the arms were not at rest after {} s", REST_LIMIT.as_secs()));
        }
    }

    /// Waits until all arms are at rest, after `is_taken` returned true once. Returns whether they are.
    pub(super) fn rests(&self, mut is_taken: impl FnMut() -> bool + Send) -> bool {
        let (service, tick) = (self.handle.service(), &self.tick);
        let (mut taken, mut still_since) = (false, Instant::now());
        let look = || {
            taken = taken || is_taken();
            // Commands at rest are not enough: an arm that lags, or whose motors are off, may still move.
            let rests = service.tick.pulse().at_rest.load(Ordering::Acquire) && service.tick.at_standstill();
            // A client that has stopped an arm is answered before the run ends.
            if !(taken && rests && service.stops_are_sent()) {
                still_since = Instant::now();
            }
            let rests = still_since.elapsed() >= STILL_FOR.max(2 * service.facts.period());
            (rests || !tick.is_alive()).then_some(rests)
        };
        in_process::wait_for(service.tick.until(Instant::now() + REST_LIMIT, look)).flatten() == Some(true)
    }
}

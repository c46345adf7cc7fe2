//! What ends a run from outside: signals, and the end of the process of `--end-with PID`, however it ended. The kernel
//! reports that on a pidfd: the process needs no handler, and none of its children keeps the run up.

use std::os::fd::OwnedFd;
use std::sync::mpsc::Sender;

use anyhow::Context;
use rustix::event::{PollFd, PollFlags, poll};
use rustix::io::Errno;
use rustix::process::{Pid, PidfdFlags, pidfd_open};
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use signal_hook::iterator::Signals;

use super::exit::{Exit, Failure, Result};
use crate::runtime::Ending;

/// What ends a run from outside.
pub(super) struct Causes {
    signals: Signals,
    /// The process of `--end-with`.
    partner: Option<OwnedFd>,
}

impl Causes {
    /// Catches signals from now on, and finds the process that the run ends with.
    pub fn of(end_with: Option<i32>) -> Result<Self> {
        let partner = end_with.map(find).transpose()?;
        Ok(Self { signals: Signals::new([SIGINT, SIGTERM, SIGHUP]).context("cannot watch signals")?, partner })
    }

    /// Returns the signals that have come so far.
    pub fn pending(&mut self) -> impl Iterator<Item = i32> {
        self.signals.pending()
    }

    /// Forwards them for the lifetime of the process: a second signal ends parking, and changes nothing else.
    pub fn watch(self, endings: Sender<Ending>) -> Result<()> {
        let Self { mut signals, partner } = self;
        if let Some(partner) = partner {
            let endings = endings.clone();
            let waiting = move || {
                while poll(&mut [PollFd::new(&partner, PollFlags::IN)], None).is_err_and(|e| e == Errno::INTR) {}
                let _ = endings.send(Ending::Orphaned);
            };
            let thread = std::thread::Builder::new().name("end-with".into()).spawn(waiting);
            thread.context("cannot start the thread of --end-with")?;
        }
        let watching = std::thread::Builder::new().name("signals".into()).spawn(move || {
            for signal in signals.forever() {
                let _ = endings.send(Ending::Signal(signal));
            }
        });
        watching.context("cannot start the thread of signals")?;
        Ok(())
    }
}

fn find(pid: i32) -> Result<OwnedFd> {
    let found = Pid::from_raw(pid).ok_or(Errno::SRCH).and_then(|pid| pidfd_open(pid, PidfdFlags::empty()));
    found.map_err(|error| match error {
        Errno::SRCH => Failure::usage(format!("--end-with: there is no process {pid}"))
            .hint("it may have ended already; without --end-with the run starts"),
        error => Failure::new(Exit::Failed, format!("--end-with: cannot watch process {pid}: {error}"))
            .hint("that needs Linux 5.3 or newer; omit --end-with, and end the run with `dimos down`"),
    })
}

//! Syncs the log to the disk in its own thread: a busy disk takes seconds for that, and the recorder must not wait for
//! it. The recorder's ring holds 5 s, and its notices tell clients that a motion has ended.

use std::fs::File;
use std::io;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, TryRecvError, channel, sync_channel};
use std::time::{Duration, Instant};

/// Syncs a file on request. When dropped, its thread syncs once more and ends.
#[derive(Debug)]
pub(super) struct DiskSync {
    requests: SyncSender<()>,
    results: Receiver<io::Result<()>>,
}

impl DiskSync {
    /// Starts the thread `log-sync`.
    ///
    /// # Errors
    /// The thread cannot be started.
    pub(super) fn start(file: File) -> io::Result<Self> {
        let (requests, requested) = sync_channel(1);
        let (result, results) = channel();
        std::thread::Builder::new().name("log-sync".into()).spawn(move || {
            for () in requested {
                let _ = result.send(file.sync_data());
            }
            let last = file.sync_data();
            // Closed before it is reported: until then the file is locked, and its run seems live.
            drop(file);
            let _ = result.send(last);
        })?;
        Ok(Self { requests, results })
    }

    /// Requests a sync, unless one is already waiting. Does not wait.
    ///
    /// # Errors
    /// An earlier sync failed.
    pub(super) fn request(&self) -> io::Result<()> {
        // Full: the waiting request includes what is in the file now. Disconnected: the thread cannot end before.
        let _ = self.requests.try_send(());
        loop {
            match self.results.try_recv() {
                Ok(result) => result?,
                Err(TryRecvError::Empty | TryRecvError::Disconnected) => return Ok(()),
            }
        }
    }

    /// Syncs for the last time and waits for that at most `longest`. Returns whether it is done; if not, the thread
    /// continues.
    ///
    /// # Errors
    /// This sync or an earlier one failed.
    pub(super) fn finish(self, longest: Duration) -> io::Result<bool> {
        let Self { requests, results } = self;
        drop(requests);
        let deadline = Instant::now() + longest;
        loop {
            match results.recv_timeout(deadline.saturating_duration_since(Instant::now())) {
                Ok(result) => result?,
                Err(RecvTimeoutError::Disconnected) => return Ok(true),
                Err(RecvTimeoutError::Timeout) => return Ok(false),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_is_synced_on_request_and_at_the_end() {
        let file = tempfile::tempfile().unwrap();
        let sync = DiskSync::start(file).unwrap();
        (0..3).for_each(|_| sync.request().unwrap());
        assert!(sync.finish(Duration::from_secs(30)).unwrap());
    }

    #[test]
    fn a_sync_that_fails_is_reported() {
        // A pipe has no disk.
        let (_reader, writer) = io::pipe().unwrap();
        let sync = DiskSync::start(File::from(std::os::fd::OwnedFd::from(writer))).unwrap();
        assert!(sync.finish(Duration::from_secs(30)).is_err());
    }
}

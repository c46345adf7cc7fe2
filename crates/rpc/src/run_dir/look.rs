//! The thread `rpc-look`: opens the socket of a run again if it was removed. A file system may hang, so no stop waits
//! for this thread, and neither does the end of the run.

use std::io;
use std::os::unix::net::UnixListener;
use std::sync::Arc;
use std::sync::mpsc::{RecvTimeoutError, Sender, channel};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use tokio::sync::watch;

use crate::run_dir::RunFiles;

/// Period of the look at the socket's path: a socket that was removed is open again within 1 s.
const PERIOD: Duration = Duration::from_millis(250);
/// Maximum time for the thread to end, and the period of the look at that.
const END_TIMEOUT: Duration = Duration::from_millis(500);
const POLL_PERIOD: Duration = Duration::from_millis(5);

/// The thread; it ends when dropped.
#[derive(Debug)]
pub(crate) struct Look {
    wanted: Option<Sender<()>>,
    thread: JoinHandle<()>,
}

impl Look {
    /// Starts the thread. It sends each socket that it opens.
    pub fn start(files: RunFiles, opened: watch::Sender<Arc<UnixListener>>) -> io::Result<Self> {
        let (wanted, unwanted) = channel::<()>();
        let thread = std::thread::Builder::new().name("rpc-look".into()).spawn(move || {
            while unwanted.recv_timeout(PERIOD) == Err(RecvTimeoutError::Timeout) {
                if let Some(listener) = files.restore() {
                    opened.send_replace(Arc::new(listener));
                }
            }
        })?;
        Ok(Self { wanted: Some(wanted), thread })
    }
}

impl Drop for Look {
    fn drop(&mut self) {
        self.wanted = None;
        let deadline = Instant::now() + END_TIMEOUT;
        while !self.thread.is_finished() && Instant::now() < deadline {
            std::thread::sleep(POLL_PERIOD);
        }
    }
}

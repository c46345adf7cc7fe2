//! The mark of a live run: an abstract socket with its name. Whatever happens to the run directory, the kernel lists
//! the mark, in every network namespace with a `/proc`, and gives no two processes the same one.

use std::io;
use std::os::fd::AsFd;
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::net::Shutdown;
use tokio::sync::mpsc::UnboundedSender;

use crate::rt::abstract_name::{self, Taken};
use crate::sync::lock;

/// Pause after a failed accept (no file descriptors left).
const PAUSE: Duration = Duration::from_millis(100);
/// Stack size of the thread [bytes].
const STACK: usize = 1 << 17;

/// Where connections to the mark go.
pub(super) type Way = Arc<Mutex<Option<UnboundedSender<UnixStream>>>>;

/// A mark that is held. A thread takes its connections: those of other users are closed at once, so that none of them
/// fills the queue or delays the thread that serves stops.
#[derive(Debug)]
pub(super) struct Mark {
    name: String,
    listener: Arc<UnixListener>,
    way: Way,
    ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Mark {
    /// Takes a mark, or returns who has it.
    pub fn take(name: String) -> Result<Self, Taken> {
        let listener = Arc::new(abstract_name::take(&name)?);
        let (way, ended) = (Way::default(), Arc::new(AtomicBool::new(false)));
        let accepting = { (listener.clone(), way.clone(), ended.clone()) };
        let thread = std::thread::Builder::new().name("rpc-far".into()).stack_size(STACK);
        let thread = thread.spawn(move || accept(&accepting.0, &accepting.1, &accepting.2)).map_err(Taken::Io)?;
        Ok(Self { name, listener, way, ended, thread: Some(thread) })
    }

    /// Returns its name in the kernel.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Returns where its connections go; nowhere at first, and with a receiver that is gone they are closed.
    pub fn way(&self) -> Way {
        self.way.clone()
    }
}

impl Drop for Mark {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Release);
        // Ends the thread's wait.
        let _ = rustix::net::shutdown(&self.listener, Shutdown::Both);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn accept(listener: &UnixListener, way: &Way, ended: &AtomicBool) {
    while !ended.load(Ordering::Acquire) {
        match listener.accept() {
            Ok((stream, _)) if is_owner_or_root(&stream) => {
                if let Some(to) = lock(way).as_ref() {
                    let _ = to.send(stream);
                }
            }
            Ok(_) => {}
            Err(error) if matches!(error.kind(), io::ErrorKind::Interrupted | io::ErrorKind::ConnectionAborted) => {}
            Err(_) => std::thread::sleep(PAUSE),
        }
    }
}

/// Returns whether the other end of a connection belongs to this user or to root.
pub(super) fn is_owner_or_root(stream: impl AsFd) -> bool {
    let us = rustix::process::geteuid().as_raw();
    abstract_name::peer(stream).is_ok_and(|peer| peer.uid == us || peer.uid == 0)
}

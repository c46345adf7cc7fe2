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

/// Connections that may wait until the run serves them.
const MAX_WAITING: usize = 64;

/// Where connections to the mark go. The mark is there before the server: who asks while the run starts waits.
#[derive(Debug, Clone, Default)]
pub(super) struct Way(Arc<Mutex<To>>);

#[derive(Debug)]
enum To {
    /// The run starts.
    Waiting(Vec<UnixStream>),
    /// They are served.
    Server(UnboundedSender<UnixStream>),
    /// Nothing serves them: each is closed.
    Closed,
}

impl Default for To {
    fn default() -> Self {
        Self::Waiting(Vec::new())
    }
}

impl Way {
    /// Leads to a server from now on, in place of the one before. What has waited comes first.
    pub fn lead_to(&self, server: UnboundedSender<UnixStream>) {
        let mut to = lock(&self.0);
        if let To::Waiting(streams) = &mut *to {
            // Fails only while the server shuts down.
            streams.drain(..).for_each(|stream| drop(server.send(stream)));
        }
        *to = To::Server(server);
    }

    /// Closes every connection, also those that wait.
    pub fn close(&self) {
        *lock(&self.0) = To::Closed;
    }

    fn pass(&self, stream: UnixStream) {
        match &mut *lock(&self.0) {
            To::Waiting(streams) if streams.len() < MAX_WAITING => streams.push(stream),
            To::Server(server) => drop(server.send(stream)),
            To::Waiting(_) | To::Closed => {}
        }
    }
}

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

    /// Returns where its connections go.
    pub fn way(&self) -> Way {
        self.way.clone()
    }
}

impl Drop for Mark {
    fn drop(&mut self) {
        self.ended.store(true, Ordering::Release);
        self.way.close();
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
            Ok((stream, _)) if is_owner_or_root(&stream) => way.pass(stream),
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

//! The mark of a live run: an abstract socket with its name. Whatever happens to the run directory, the kernel lists
//! the mark, in every network namespace with a `/proc`, and gives no two processes the same one.

use std::io::{self, Write};
use std::os::fd::AsFd;
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::net::Shutdown;

use crate::server::handover::Handover;
use dimos_core::sync::lock;
use dimos_rt::abstract_name::{self, Taken};

/// Pause after a failed accept (no file descriptors left).
const PAUSE: Duration = Duration::from_millis(100);
/// Maximum number of connections that wait until the run serves them, or for the thread that serves stops, and the
/// pause until there is room.
const MAX_WAITING: usize = 64;
const ROOM_PAUSE: Duration = Duration::from_millis(1);
/// Stack size of the thread [bytes].
const STACK: usize = 1 << 17;

/// Where connections to the mark go.
#[derive(Debug, Clone, Default)]
pub(crate) enum Way {
    /// The run starts or ends: they wait.
    #[default]
    Nowhere,
    /// To the thread that answers stops.
    To(Arc<Handover<UnixStream>>),
    /// They get this line.
    Refused(String),
}

/// A mark that is held. A thread takes its connections: those of other users are closed at once, so that none of them
/// fills the queue or delays the thread that serves stops.
#[derive(Debug)]
pub(crate) struct Mark {
    name: String,
    listener: Arc<UnixListener>,
    way: Arc<Mutex<(Way, Vec<UnixStream>)>>,
    ended: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Mark {
    /// Takes a mark, or returns who has it.
    pub fn take(name: String) -> Result<Self, Taken> {
        let listener = Arc::new(abstract_name::take(&name)?);
        let (way, ended) = (Arc::<Mutex<(Way, Vec<UnixStream>)>>::default(), Arc::new(AtomicBool::new(false)));
        let accepting = { (listener.clone(), way.clone(), ended.clone()) };
        let thread = std::thread::Builder::new().name("rpc-far".into()).stack_size(STACK);
        let thread = thread.spawn(move || accept(&accepting.0, &accepting.1, &accepting.2)).map_err(Taken::Io)?;
        Ok(Self { name, listener, way, ended, thread: Some(thread) })
    }

    /// Returns its name in the kernel.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Sets where its connections go, also those that wait; nowhere at first.
    pub fn lead(&self, way: Way) {
        let mut led = lock(&self.way);
        for stream in std::mem::take(&mut led.1) {
            way.pass(stream);
        }
        led.0 = way;
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

impl Way {
    fn pass(&self, stream: UnixStream) {
        match self {
            Self::Nowhere => {}
            Self::To(queue) => queue.put(stream),
            // Never blocks: a new socket's buffer is empty.
            Self::Refused(line) => drop((&stream).write_all(line.as_bytes())),
        }
    }
}

fn accept(listener: &UnixListener, way: &Mutex<(Way, Vec<UnixStream>)>, ended: &AtomicBool) {
    while !ended.load(Ordering::Acquire) {
        match listener.accept() {
            Ok((stream, _)) if is_owner_or_root(&stream) => {
                let way = match &mut *lock(way) {
                    // More are closed: their clients may try again.
                    (Way::Nowhere, waiting) if waiting.len() >= MAX_WAITING => continue,
                    (Way::Nowhere, waiting) => {
                        waiting.push(stream);
                        continue;
                    }
                    (way, _) => way.clone(),
                };
                while let Way::To(queue) = &way
                    && queue.len() >= MAX_WAITING
                    && !ended.load(Ordering::Acquire)
                {
                    // More wait in the kernel, which has a limit.
                    std::thread::sleep(ROOM_PAUSE);
                }
                way.pass(stream);
            }
            Ok(_) => {}
            Err(error) if matches!(error.kind(), io::ErrorKind::Interrupted | io::ErrorKind::ConnectionAborted) => {}
            Err(_) => std::thread::sleep(PAUSE),
        }
    }
}

/// Returns whether the other end of a connection belongs to this user or to root.
pub(crate) fn is_owner_or_root(stream: impl AsFd) -> bool {
    let us = rustix::process::geteuid().as_raw();
    abstract_name::peer(stream).is_ok_and(|peer| peer.uid == us || peer.uid == 0)
}

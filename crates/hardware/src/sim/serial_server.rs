//! An emulated controller on a pseudo-terminal, which adapters open like a serial port.

use std::io::{Read, Write};
use std::sync::Arc;
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::arm::HasArm;
use super::delivery::MIN_CUT;
use super::events::{self, SimEvent};
use super::faults::Fault;
use super::stream::{Controller, Ending, Shared};
use crate::adapter::{AdapterError, AdapterResult};
use crate::registry::{Emulator, EmulatorAddress, Truth};
use crate::transport::serial::Pty;
use dimos_core::clock::Mono;
use dimos_core::sync::lock;
use dimos_rt::host;

/// How often the thread checks whether the emulator ends, while nothing arrives.
const CHECK_PERIOD: Duration = Duration::from_millis(50);

/// A running emulator on a serial line. It ends when it is dropped, and the line with it.
pub struct SerialServer<C: Controller> {
    shared: Arc<Shared<C, ()>>,
    path: String,
    thread: Option<JoinHandle<()>>,
}

impl<C: Controller> SerialServer<C> {
    /// Starts a controller at `place`. `name` is for messages.
    pub fn start(name: &str, controller: C, place: &EmulatorAddress) -> AdapterResult<Self> {
        if !matches!(place, EmulatorAddress::InProcess | EmulatorAddress::Pty) {
            let what = format!("{name} has a serial line: its emulator is on a pseudo-terminal (--pty)");
            return Err(AdapterError::Rejected(what));
        }
        let pty = Pty::open()?;
        let path = pty.path().to_owned();
        let shared = Arc::new(Shared::new(controller));
        let for_thread = shared.clone();
        let builder = std::thread::Builder::new().name(format!("{name}-sim"));
        let thread = builder
            .spawn(move || run_controller(&for_thread, pty))
            .map_err(|e| AdapterError::Io(format!("{name} emulator: {e}")))?;
        Ok(Self { shared, path, thread: Some(thread) })
    }

    /// Returns the path for adapters: `/dev/pts/3`.
    pub fn path(&self) -> &str {
        &self.path
    }

    /// Calls `f` with the controller and the current time.
    pub fn with<T>(&self, f: impl FnOnce(&mut C, Mono) -> T) -> T {
        self.shared.with(f)
    }
}

impl<C: Controller + HasArm> Emulator for SerialServer<C> {
    fn address(&self) -> String {
        self.path.clone()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.with(|controller, now| controller.arm().inject(fault, now))
    }

    fn truth(&self) -> Truth {
        self.with(|controller, now| controller.truth(now))
    }
}

impl<C: Controller> Drop for SerialServer<C> {
    fn drop(&mut self) {
        lock(&self.shared.line).closing = true;
        self.shared.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// Serves clients until the emulator ends.
fn run_controller<C: Controller>(shared: &Shared<C, ()>, pty: Pty) {
    host::enter_realtime(host::EMULATOR_PRIORITY);
    let mut line = Line { pty, shared, client_seen: false };
    while !shared.closing() {
        let silence = match shared.serve(0, &mut line) {
            Ending::Closed => CHECK_PERIOD,
            // Starting takes time too.
            Ending::Cut(time) => time.max(MIN_CUT),
        };
        shared.with(|controller, now| controller.client_gone(now));
        lock(&shared.line).dark_until = Instant::now() + silence;
        shared.wait(|line| line.dark_until);
        // Bytes that arrived while nothing was served are lost.
        while line.pty.read(&mut [0; 1024], Duration::ZERO).is_ok_and(|n| n > 0) {}
    }
}

/// The line as a byte stream that ends with the emulator.
struct Line<'a, C> {
    pty: Pty,
    shared: &'a Shared<C, ()>,
    /// Whether a client has written to it.
    client_seen: bool,
}

impl<C: Controller> Read for Line<'_, C> {
    fn read(&mut self, room: &mut [u8]) -> std::io::Result<usize> {
        while !self.shared.closing() && !room.is_empty() {
            match self.pty.read(room, CHECK_PERIOD) {
                Ok(0) => {}
                Ok(n) => {
                    if !std::mem::replace(&mut self.client_seen, true) {
                        events::note(SimEvent::Connected);
                    }
                    return Ok(n);
                }
                Err(error) => return Err(std::io::Error::other(error.to_string())),
            }
        }
        Ok(0)
    }
}

impl<C> Write for Line<'_, C> {
    /// Bytes that no client reads are lost, as on a real line.
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.pty.write(bytes).map(|_| bytes.len()).map_err(|error| std::io::Error::other(error.to_string()))
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

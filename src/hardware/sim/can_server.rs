//! An emulated arm on a CAN bus: it hears commands, and sends by itself in a rhythm of its own.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::diary::{self, Happening};
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::registry::{Emulator, Place};
use crate::hardware::sim::arm::{Delivery, HasArm};
use crate::hardware::sim::faults::{Fault, FaultKind};
use crate::hardware::spec::{AdapterError, AdapterResult};
use crate::hardware::transport::can::bus::Bus;
use crate::hardware::transport::can::slcan_pty::SlcanPty;
use crate::hardware::transport::can::{self, CanAddress, CanEvent, CanFrame, CanPort};
use crate::joint::Joints;
use crate::rt::host;
use crate::rt::wake::Wake;

/// How long a fault that cuts the wire keeps it cut: longer than any adapter should believe in a silent arm.
const CUT: Duration = Duration::from_millis(800);

/// The faults that a `SimArm` can play on a bus whose frames hold integers: no byte is damaged there, nothing is NaN.
pub const PLAYABLE: &[FaultKind] = &[
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::Disconnect,
    FaultKind::ErrorCode,
    FaultKind::Estop,
    FaultKind::PowerLoss,
    FaultKind::ZeroState,
    FaultKind::Garbage,
    FaultKind::Truncated,
    FaultKind::WrongDof,
    FaultKind::Sag,
    FaultKind::Blocked,
];

/// The arm's side of a bus.
pub trait CanController: Send + 'static {
    /// Takes a frame. What it answers goes into `answers`, and out with the next [`CanController::tick`].
    fn hear(&mut self, frame: &CanFrame, now: Mono, answers: &mut Vec<CanFrame>);

    /// A period has passed: puts what the arm sends by itself into `frames`, and says how it is delivered.
    fn tick(&mut self, now: Mono, frames: &mut Vec<CanFrame>) -> Delivery;
}

/// An arm on a bus. It ends when it is dropped.
pub struct CanServer<C: CanController> {
    shared: Arc<Shared<C>>,
    address: CanAddress,
    /// The bus in memory, where it is one.
    bus: Option<Bus>,
    thread: Option<JoinHandle<()>>,
}

struct Shared<C> {
    controller: Mutex<C>,
    closing: AtomicBool,
    wake: Wake,
}

impl<C> Shared<C> {
    fn controller(&self) -> MutexGuard<'_, C> {
        self.controller.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl<C: CanController> CanServer<C> {
    /// An arm at `place` that sends every `period`. `name` is the arm's, for messages.
    pub fn start(name: &str, controller: C, place: &Place, period: Duration) -> AdapterResult<Self> {
        let (bus, address, port): (_, _, Box<dyn CanPort>) = match place {
            Place::InProcess => {
                let bus = Bus::new();
                let port = bus.attach()?;
                let address = bus.address();
                (Some(bus), address, Box::new(port))
            }
            Place::Can(interface) => {
                let address = CanAddress::Interface(interface.clone());
                let port = can::open(&format!("the {name} emulator"), &address, &[])?;
                (None, address, port)
            }
            Place::Pty => {
                let pty = SlcanPty::open()?;
                let address = pty.address();
                (None, address, Box::new(pty))
            }
            Place::Bind(_) => {
                let what = "is on a CAN bus: its emulator has an interface or a pseudo-terminal, no IP address";
                return Err(AdapterError::Rejected(format!("{name} {what}")));
            }
        };
        let failed = |e: std::io::Error| AdapterError::Io(format!("{name} emulator: {e}"));
        let wake = Wake::new().map_err(failed)?;
        let shared = Arc::new(Shared { controller: Mutex::new(controller), closing: AtomicBool::new(false), wake });
        let for_thread = shared.clone();
        let builder = std::thread::Builder::new().name(format!("{name}-sim"));
        let thread = builder.spawn(move || live(&for_thread, port, period)).map_err(failed)?;
        Ok(Self { shared, address, bus, thread: Some(thread) })
    }

    /// Where adapters find the bus.
    pub fn address(&self) -> &CanAddress {
        &self.address
    }

    /// The bus in memory, where it is one.
    pub fn bus(&self) -> Option<&Bus> {
        self.bus.as_ref()
    }

    /// Does something with the controller, now.
    pub fn with<T>(&self, f: impl FnOnce(&mut C, Mono) -> T) -> T {
        let mut controller = self.shared.controller();
        f(&mut controller, MonotonicClock.now())
    }
}

impl<C: CanController + HasArm> Emulator for CanServer<C> {
    fn address(&self) -> String {
        self.address.to_string()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.with(|controller, now| controller.arm().inject(fault, now))
    }

    fn true_positions(&self) -> Option<Joints> {
        Some(self.with(|controller, now| controller.arm().positions_at(now)))
    }
}

impl<C: CanController> Drop for CanServer<C> {
    fn drop(&mut self) {
        self.shared.closing.store(true, Ordering::Relaxed);
        self.shared.wake.raise();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The arm's thread: hears, and sends once a period; a period that was missed is left out. Ends with the bus.
fn live<C: CanController>(shared: &Shared<C>, mut port: Box<dyn CanPort>, period: Duration) {
    host::enter_realtime(host::EMULATOR_PRIORITY);
    let mut frames = Vec::with_capacity(64);
    let mut heard = false;
    let mut next = Instant::now();
    // Until then the arm neither hears nor sends.
    let mut deaf_until = next;
    while !shared.closing.load(Ordering::Relaxed) {
        loop {
            match port.receive() {
                Ok(Some(CanEvent::Frame(frame))) if Instant::now() >= deaf_until => {
                    if !std::mem::replace(&mut heard, true) {
                        diary::note(Happening::Came);
                    }
                    shared.controller().hear(&frame, MonotonicClock.now(), &mut frames);
                }
                Ok(Some(_)) => {}
                Ok(None) => break,
                Err(_) => return,
            }
        }
        let now = Instant::now();
        if now < next {
            shared.wake.wait_or_readable(port.fd(), next - now);
            continue;
        }
        next = (next + period).max(now);
        if now < deaf_until {
            frames.clear();
            continue;
        }
        let delivery = shared.controller().tick(MonotonicClock.now(), &mut frames);
        match delivery {
            Delivery::Send => {}
            Delivery::Silent => frames.clear(),
            Delivery::Stall(time) => {
                // What arrives meanwhile waits.
                let end = now + time;
                while !shared.closing.load(Ordering::Relaxed) && Instant::now() < end {
                    shared.wake.wait(end.saturating_duration_since(Instant::now()));
                }
            }
            Delivery::Garbage => frames.insert(0, CanFrame::new(0x7FF, b"garbage")),
            // A bus knows no damaged frames: they are repeated. It knows short ones.
            Delivery::Corrupt | Delivery::Truncated => {
                frames.iter_mut().for_each(|frame| {
                    *frame = CanFrame::new(frame.id, frame.bytes().split_at(frame.bytes().len() / 2).0)
                });
            }
            Delivery::Disconnect => deaf_until = now + CUT,
            // Starting takes its time, too.
            Delivery::PowerLoss(time) => deaf_until = now + time.max(CUT),
        }
        if now >= deaf_until && port.send(&frames).is_err() {
            return;
        }
        frames.clear();
    }
}

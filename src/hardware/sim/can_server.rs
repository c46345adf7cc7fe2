//! An emulated arm on a CAN bus: it takes commands, and sends its state in a rhythm of its own, whether anything
//! listens or not.

use std::io;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::Duration;

use super::arm::{Delivery, HasArm};
use super::can_connection::CanConnection;
use super::events::{self, SimEvent};
use super::faults::{Fault, FaultKind};
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::adapter::{AdapterError, AdapterResult};
use crate::hardware::registry::{Emulator, EmulatorAddress};
use crate::hardware::transport::can::{CanAddress, CanEvent, CanFilter, CanFrame};
use crate::joint::Joints;
use crate::rt::host;
use crate::rt::wake::Wake;
use crate::sync::lock;

/// How long a fault that cuts the wire keeps it cut at least: longer than any adapter should believe in a silent arm.
const CUT: Duration = Duration::from_millis(800);
/// Missed periods that are made up for at most, after the computer has stalled.
const MAKES_UP: u32 = 10;

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
    /// Takes a frame. What the arm answers at once goes into `answers`.
    fn on_frame(&mut self, frame: &CanFrame, now: Mono, answers: &mut Vec<CanFrame>);

    /// A period has passed: puts what the arm sends by itself into `frames`, and says how it is delivered.
    fn tick(&mut self, now: Mono, frames: &mut Vec<CanFrame>) -> Delivery;

    /// The frames that the arm hears; all of them without filters.
    fn filters(&self) -> &'static [CanFilter] {
        &[]
    }

    /// Frames that no client knows, for the fault `garbage`: identifiers and bytes.
    fn noise(&self) -> &'static [(u16, &'static [u8])] {
        &[(0x7FF, b"garbage")]
    }

    /// The least time from a loss of power until the arm is heard again.
    fn start_time(&self) -> Duration {
        CUT
    }
}

/// An arm on a bus. It ends when it is dropped.
pub struct CanServer<C: CanController> {
    shared: Arc<Shared<C>>,
    address: CanAddress,
    thread: Option<JoinHandle<()>>,
}

struct Shared<C> {
    controller: Mutex<C>,
    closing: AtomicBool,
    wake: Wake,
    sent: AtomicU64,
    not_taken: AtomicU64,
}

impl<C> Shared<C> {
    fn controller(&self) -> MutexGuard<'_, C> {
        lock(&self.controller)
    }
}

impl<C: CanController> CanServer<C> {
    /// An arm at `place` that sends every `period`. `name` is the arm's, for messages.
    pub fn start(name: &str, controller: C, place: &EmulatorAddress, period: Duration) -> AdapterResult<Self> {
        let failed = |e: io::Error| AdapterError::Io(format!("{name} emulator: {e}"));
        let (connection, address) = CanConnection::take(name, place, controller.filters())?;
        let shared = Arc::new(Shared {
            controller: Mutex::new(controller),
            closing: AtomicBool::new(false),
            wake: Wake::new().map_err(failed)?,
            sent: AtomicU64::new(0),
            not_taken: AtomicU64::new(0),
        });
        let mut arm = Arm {
            shared: shared.clone(),
            connection,
            period,
            frames: Vec::with_capacity(64),
            stalled: Mono::ZERO,
            deaf: Mono::ZERO,
            silent: false,
            heard: false,
        };
        let builder = std::thread::Builder::new().name(format!("{name}-sim"));
        let thread = builder.spawn(move || arm.run()).map_err(failed)?;
        Ok(Self { shared, address, thread: Some(thread) })
    }

    /// Where adapters find the bus.
    pub fn address(&self) -> &CanAddress {
        &self.address
    }

    /// Does something with the controller, now.
    pub fn with<T>(&self, f: impl FnOnce(&mut C, Mono) -> T) -> T {
        let mut controller = self.shared.controller();
        f(&mut controller, MonotonicClock.now())
    }

    /// How many frames it has sent.
    pub fn sent(&self) -> u64 {
        self.shared.sent.load(Relaxed)
    }

    /// How many frames its bus did not take.
    pub fn not_taken(&self) -> u64 {
        self.shared.not_taken.load(Relaxed)
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
        Some(self.with(|controller, now| controller.joints_at(now).0))
    }
}

impl<C: CanController> Drop for CanServer<C> {
    fn drop(&mut self) {
        self.shared.closing.store(true, Relaxed);
        self.shared.wake.raise();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// What the arm's thread works with.
struct Arm<C> {
    shared: Arc<Shared<C>>,
    connection: CanConnection,
    period: Duration,
    frames: Vec<CanFrame>,
    /// It does nothing until then; what arrives waits.
    stalled: Mono,
    /// It neither hears nor sends until then.
    deaf: Mono,
    /// In this period it sends nothing.
    silent: bool,
    /// A frame has come.
    heard: bool,
}

impl<C: CanController> Arm<C> {
    fn run(&mut self) {
        host::enter_realtime(host::EMULATOR_PRIORITY);
        let mut next = MonotonicClock.now().after(self.period);
        while !self.shared.closing.load(Relaxed) {
            let now = MonotonicClock.now();
            // An arm is not late because this computer is: what it would have sent meanwhile is sent now.
            next = next.max(now.before(self.period * MAKES_UP));
            while next <= now {
                self.tick(next);
                next = next.after(self.period);
            }
            if now >= self.stalled {
                self.listen(now);
            }
            let left = next.since(MonotonicClock.now());
            match self.connection.fd().filter(|_| now >= self.stalled) {
                Some(fd) => self.shared.wake.wait_or_readable(fd, left),
                None => self.shared.wake.wait(left),
            };
        }
    }

    /// Once per period: faults begin and end, and the state is sent.
    fn tick(&mut self, now: Mono) {
        self.connection.mend(now);
        if now < self.stalled || now < self.deaf {
            return;
        }
        self.frames.clear();
        let shared = self.shared.clone();
        let mut controller = shared.controller();
        let delivery = controller.tick(now, &mut self.frames);
        self.silent = delivery == Delivery::Silent;
        self.connection.refuse(delivery);
        match delivery {
            Delivery::Garbage => {
                let noise = controller.noise().iter().map(|(id, bytes)| CanFrame::new(*id, bytes));
                self.frames.splice(0..0, noise);
            }
            // A bus knows no damaged frames: they are repeated. It knows short ones.
            Delivery::Corrupt | Delivery::Truncated => {
                let half =
                    |frame: &CanFrame| CanFrame::new(frame.id, frame.bytes().split_at(frame.bytes().len() / 2).0);
                self.frames.iter_mut().for_each(|frame| *frame = half(frame));
            }
            Delivery::Stall(time) => self.stalled = now.after(time),
            Delivery::PowerLoss(time) => {
                self.deaf = now.after(time.max(controller.start_time()));
                self.connection.lose_power(self.deaf);
            }
            Delivery::Disconnect(time) => self.disconnect(now, time),
            Delivery::BusOff => self.connection.bus_off(),
            _ => {}
        }
        drop(controller);
        if now >= self.stalled && now >= self.deaf {
            self.send();
        }
    }

    /// The interface goes down; where it cannot, the arm neither hears nor sends.
    fn disconnect(&mut self, now: Mono, time: Duration) {
        if !self.connection.go_down(now, time) {
            self.deaf = now.after(time.max(CUT));
        }
    }

    /// Does what has arrived.
    fn listen(&mut self, now: Mono) {
        self.frames.clear();
        self.connection.open(now);
        while let Some(event) = self.connection.receive(now) {
            if let CanEvent::Frame(frame) = event
                && now >= self.deaf
            {
                if !std::mem::replace(&mut self.heard, true) {
                    events::note(SimEvent::Connected);
                }
                self.shared.controller().on_frame(&frame, now, &mut self.frames);
            }
        }
        self.send();
    }

    /// Sends `frames`, unless the arm is silent.
    fn send(&mut self) {
        if self.silent {
            self.frames.clear();
        }
        let sent = self.connection.send(&self.frames);
        self.shared.sent.fetch_add(sent as u64, Relaxed);
        self.shared.not_taken.fetch_add((self.frames.len() - sent) as u64, Relaxed);
        self.frames.clear();
    }
}

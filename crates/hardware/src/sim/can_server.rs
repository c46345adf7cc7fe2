//! Server of an emulated arm on a CAN bus: receives commands, and sends the arm's state periodically, whether or not a
//! program receives it.

use std::io;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};
use std::thread::JoinHandle;
use std::time::Duration;

use super::arm::{Delivery, HasArm};
use super::can_connection::CanConnection;
use super::delivery::MIN_CUT;
use super::events::{self, SimEvent};
use super::faults::{Fault, FaultKind};
use crate::adapter::{AdapterError, AdapterResult};
use crate::registry::{Emulator, EmulatorAddress, Truth};
use crate::transport::can::{CanAddress, CanEvent, CanFilter, CanFrame};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::sync::lock;
use dimos_rt::host;
use dimos_rt::wake::Wake;

/// Maximum number of missed periods that are sent late after this computer has stalled.
const MAX_LATE_PERIODS: u32 = 10;

/// The faults that a `SimArm` can play on a bus with integer values: no damaged bytes and no NaN.
pub const PLAYABLE: &[FaultKind] = &[
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::LostCommand,
    FaultKind::Disconnect,
    FaultKind::ErrorCode,
    FaultKind::Estop,
    FaultKind::PowerLoss,
    FaultKind::ZeroState,
    FaultKind::Misread,
    FaultKind::Garbage,
    FaultKind::Truncated,
    FaultKind::WrongDof,
    FaultKind::Sag,
    FaultKind::Blocked,
];

/// The arm's side of a CAN bus.
pub trait CanController: Send + 'static {
    /// Processes a frame and puts immediate replies into `answers`.
    fn on_frame(&mut self, frame: &CanFrame, now: Mono, answers: &mut Vec<CanFrame>);

    /// Puts the periodic frames into `frames`, and returns how they are delivered.
    fn tick(&mut self, now: Mono, frames: &mut Vec<CanFrame>) -> Delivery;

    /// Returns filters for the frames that the arm receives; empty for all frames.
    fn filters(&self) -> &'static [CanFilter] {
        &[]
    }

    /// Returns frames with unknown identifiers and random bytes, for the fault `garbage`.
    fn noise(&self) -> &'static [(u16, &'static [u8])] {
        &[(0x7FF, b"garbage")]
    }

    /// Returns the minimum time from a loss of power until the arm sends again.
    fn start_time(&self) -> Duration {
        MIN_CUT
    }
}

/// A running emulator on a CAN bus. It ends when it is dropped.
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
    /// Starts the arm at `place`, sending every `period`. `name` is for messages.
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
            offline_until: Mono::ZERO,
            silent: false,
            client_seen: false,
        };
        let builder = std::thread::Builder::new().name(format!("{name}-sim"));
        let thread = builder.spawn(move || arm.run()).map_err(failed)?;
        Ok(Self { shared, address, thread: Some(thread) })
    }

    /// Returns the address for adapters.
    pub fn address(&self) -> &CanAddress {
        &self.address
    }

    /// Calls `f` with the controller and the current time.
    pub fn with<T>(&self, f: impl FnOnce(&mut C, Mono) -> T) -> T {
        let mut controller = self.shared.controller();
        f(&mut controller, MonotonicClock.now())
    }

    /// Returns how many frames the arm has sent.
    pub fn sent(&self) -> u64 {
        self.shared.sent.load(Relaxed)
    }

    /// Returns how many frames the bus refused.
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

    fn truth(&self) -> Truth {
        self.with(|controller, now| controller.truth(now))
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

/// State of the arm's thread.
struct Arm<C> {
    shared: Arc<Shared<C>>,
    connection: CanConnection,
    period: Duration,
    frames: Vec<CanFrame>,
    /// The arm is stalled until then; arriving frames wait.
    stalled: Mono,
    /// The arm neither receives nor sends until then.
    offline_until: Mono,
    /// In this period the arm sends nothing.
    silent: bool,
    /// Whether a client has sent a frame.
    client_seen: bool,
}

impl<C: CanController> Arm<C> {
    fn run(&mut self) {
        host::enter_realtime(host::EMULATOR_PRIORITY);
        let mut next = MonotonicClock.now().after(self.period);
        while !self.shared.closing.load(Relaxed) {
            let now = MonotonicClock.now();
            // This computer was late, not the arm: the frames of the missed periods are sent now.
            next = next.max(now.before(self.period * MAX_LATE_PERIODS));
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

    /// Runs once per period: begins and ends faults, and sends the state.
    fn tick(&mut self, now: Mono) {
        self.connection.end_faults(now);
        if now < self.stalled || now < self.offline_until {
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
            // CAN repeats damaged frames, so there are none; short frames exist.
            Delivery::Corrupt | Delivery::Truncated => {
                let half =
                    |frame: &CanFrame| CanFrame::new(frame.id, frame.bytes().split_at(frame.bytes().len() / 2).0);
                self.frames.iter_mut().for_each(|frame| *frame = half(frame));
            }
            Delivery::Stall(time) => self.stalled = now.after(time),
            Delivery::PowerLoss(time) => {
                self.offline_until = now.after(time.max(controller.start_time()));
                self.connection.lose_power(self.offline_until);
            }
            Delivery::Disconnect(time) => self.disconnect(now, time),
            Delivery::BusOff => self.connection.bus_off(),
            _ => {}
        }
        drop(controller);
        if now >= self.stalled && now >= self.offline_until {
            self.send();
        }
    }

    /// Takes the interface down; if that is not possible, the arm neither receives nor sends.
    fn disconnect(&mut self, now: Mono, time: Duration) {
        if !self.connection.go_down(now, time) {
            self.offline_until = now.after(time.max(MIN_CUT));
        }
    }

    /// Processes arrived frames.
    fn listen(&mut self, now: Mono) {
        self.frames.clear();
        self.connection.open(now);
        while let Some(event) = self.connection.receive(now) {
            if let CanEvent::Frame(frame) = event
                && now >= self.offline_until
            {
                if !std::mem::replace(&mut self.client_seen, true) {
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

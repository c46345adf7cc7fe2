//! The emulator's bus and thread.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use super::controller::Controller;
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::registry::Place;
use crate::hardware::sim::faults::{DEFAULT_STALL, FaultKind};
use crate::hardware::spec::{AdapterError, AdapterResult};
use crate::hardware::transport::can::bus::{Bus, SEND_QUEUE};
use crate::hardware::transport::can::slcan_pty::SlcanPty;
use crate::hardware::transport::can::{self, CanAddress, CanEvent, CanFrame, CanPort, CanTrouble};
use crate::rt::host;
use crate::rt::wake::Wake;

/// Commands, beside which a Piper hears nothing: 0x150–0x15F and 0x470–0x47F, and the question for its firmware.
const FILTERS: &[can::CanFilter] = &[
    can::CanFilter { id: 0x150, mask: 0x7F0 },
    can::CanFilter { id: 0x470, mask: 0x7F0 },
    can::CanFilter { id: 0x4AF, mask: 0x7FF },
];
/// How long an interface is down that goes down and up again.
const DOWN: Duration = Duration::from_millis(100);
/// So many periods are made up for at most, after the computer has stalled.
const MAKES_UP: u32 = 10;
/// How long it may take until a bus has room again for what the arm sends.
const ROOM: Duration = Duration::from_millis(3);
/// Frames of one command, which a bus without room does not take.
const COMMAND: usize = 4;
/// Waits between attempts to open an interface that is down.
const REOPEN: Duration = Duration::from_millis(50);
/// Frames that no client knows: strange identifiers, too few bytes.
const NOISE: [(u16, &[u8]); 6] =
    [(0x000, &[]), (0x7FF, &[0xFF; 8]), (0x2A5, &[1]), (0x2A0, &[9; 8]), (0x267, &[0xFF; 8]), (0x4AF, &[])];

struct Shared {
    controller: Mutex<Controller>,
    closing: AtomicBool,
    wake: Wake,
    sent: AtomicU64,
    not_taken: AtomicU64,
}

/// A running emulator's thread.
pub struct Server {
    shared: Arc<Shared>,
    address: String,
    thread: Option<JoinHandle<()>>,
}

/// What the emulator sits on.
enum Seat {
    /// The wire of a bus in memory.
    Memory(Bus),
    /// An interface of the system.
    Interface(CanAddress),
    /// A serial line, behind its port.
    Serial,
}

/// The thread's own.
struct Arm {
    shared: Arc<Shared>,
    seat: Seat,
    port: Option<Box<dyn CanPort>>,
    period: Duration,
    out: Vec<CanFrame>,
    /// It does nothing until then; it has no power until then; the interface is down until then.
    stalled: Mono,
    dark: Mono,
    down: Mono,
    /// The bus takes nothing from programs; this period the arm says nothing.
    full: bool,
    silent: bool,
}

fn lock(controller: &Mutex<Controller>) -> MutexGuard<'_, Controller> {
    controller.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Server {
    /// Sits down at `place` and sends at `rate` [Hz].
    pub fn start(controller: Controller, place: &Place, rate: f64) -> AdapterResult<Self> {
        let io = |e: std::io::Error| AdapterError::Io(format!("piper emulator: {e}"));
        let (seat, port, address): (_, Box<dyn CanPort>, _) = match place {
            Place::InProcess => {
                let bus = Bus::new();
                let (port, address) = (bus.attach()?, bus.address());
                (Seat::Memory(bus), Box::new(port), address)
            }
            Place::Can(name) => {
                let address = CanAddress::parse(name).map_err(AdapterError::Rejected)?;
                let port = can::open("the piper emulator", &address, FILTERS)?;
                (Seat::Interface(address.clone()), port, address)
            }
            Place::Pty => {
                let pty = SlcanPty::open()?;
                let address = pty.address();
                (Seat::Serial, Box::new(pty), address)
            }
            Place::Bind(_) => {
                return Err(AdapterError::Rejected(
                    "this arm is on a CAN bus: its emulator has an interface or a pseudo-terminal, no IP address"
                        .into(),
                ));
            }
        };
        let shared = Arc::new(Shared {
            controller: Mutex::new(controller),
            closing: AtomicBool::new(false),
            wake: Wake::new().map_err(io)?,
            sent: AtomicU64::new(0),
            not_taken: AtomicU64::new(0),
        });
        let period = Duration::from_secs_f64(1.0 / rate);
        let out = Vec::with_capacity(64);
        let [stalled, dark, down] = [Mono::ZERO; 3];
        let (shared_too, port) = (shared.clone(), Some(port));
        let mut arm =
            Arm { shared: shared_too, seat, port, period, out, stalled, dark, down, full: false, silent: false };
        let thread = std::thread::Builder::new().name("piper-sim".into()).spawn(move || arm.run()).map_err(io)?;
        Ok(Self { shared, address: address.to_string(), thread: Some(thread) })
    }

    /// Where it is reached.
    pub fn address(&self) -> String {
        self.address.clone()
    }

    /// Does something with the controller, now.
    pub fn with<T>(&self, f: impl FnOnce(&mut Controller, Mono) -> T) -> T {
        f(&mut lock(&self.shared.controller), MonotonicClock.now())
    }

    /// Frames that the bus took.
    pub fn sent(&self) -> u64 {
        self.shared.sent.load(Relaxed)
    }

    /// Frames that it did not.
    pub fn not_taken(&self) -> u64 {
        self.shared.not_taken.load(Relaxed)
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.shared.closing.store(true, Relaxed);
        self.shared.wake.raise();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

impl Arm {
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
            self.listen(now);
            let left = next.since(MonotonicClock.now());
            match &self.port {
                Some(port) if self.stalled <= now => {
                    self.shared.wake.wait_or_readable(port.fd(), left);
                }
                _ => {
                    self.shared.wake.wait(left);
                }
            }
        }
    }

    /// Once per period: faults begin and end, and the state is sent.
    fn tick(&mut self, now: Mono) {
        self.play(now);
        self.mend(now);
        if now < self.stalled || now < self.dark {
            return;
        }
        self.out.clear();
        let shared = self.shared.clone();
        let mut controller = lock(&shared.controller);
        controller.suffer(now);
        controller.report(now, &mut self.out);
        if controller.strikes(FaultKind::Garbage, now).is_some() {
            let noise = NOISE.map(|(id, bytes)| CanFrame::new(id, bytes));
            self.out.splice(0..0, noise);
        }
        if controller.strikes(FaultKind::Truncated, now).is_some() {
            self.out.iter_mut().for_each(|frame| *frame = CanFrame::new(frame.id, frame.data.get(..4).unwrap_or(&[])));
        }
        self.silent = controller.strikes(FaultKind::Silent, now).is_some();
        drop(controller);
        self.send();
    }

    /// Faults of the bus and of the power.
    fn play(&mut self, now: Mono) {
        let shared = self.shared.clone();
        let mut controller = lock(&shared.controller);
        if let Some(left) = controller.strikes(FaultKind::Stall, now) {
            self.stalled = now.after(left.unwrap_or(DEFAULT_STALL));
        }
        if now >= self.dark
            && let Some(left) = controller.strikes(FaultKind::PowerLoss, now)
        {
            self.dark = now.after(left.unwrap_or(DEFAULT_STALL));
            controller.advance(now);
            controller.lose_power();
            if let Seat::Memory(bus) = &self.seat {
                bus.withhold(SEND_QUEUE);
            }
        }
        let Seat::Memory(bus) = &self.seat else { return };
        if now >= self.down
            && let Some(left) = controller.strikes(FaultKind::Disconnect, now)
        {
            self.down = now.after(left.unwrap_or(DOWN));
            bus.set_up(false);
        }
        if controller.strikes(FaultKind::BusOff, now).is_some() {
            bus.trouble(CanTrouble::BusOff);
        }
        match controller.strikes(FaultKind::NoBuffers, now) {
            Some(None) => bus.refuse(COMMAND),
            Some(_) => {
                bus.refuse(usize::MAX);
                self.full = true;
            }
            None if self.full => {
                bus.refuse(0);
                self.full = false;
            }
            None => {}
        }
    }

    /// Faults that are over.
    fn mend(&mut self, now: Mono) {
        if let Seat::Memory(bus) = &self.seat {
            if self.dark != Mono::ZERO && now >= self.dark {
                self.dark = Mono::ZERO;
                bus.acknowledge();
            }
            if self.down != Mono::ZERO && now >= self.down {
                self.down = Mono::ZERO;
                bus.set_up(true);
            }
        }
    }

    /// Obeys what has arrived.
    fn listen(&mut self, now: Mono) {
        if now < self.stalled {
            return;
        }
        self.open(now);
        self.out.clear();
        while let Some(port) = &mut self.port {
            match port.receive() {
                Ok(Some(CanEvent::Frame(frame))) if now >= self.dark => {
                    lock(&self.shared.controller).handle(&frame, now, &mut self.out);
                }
                Ok(Some(_)) => {}
                Ok(None) => break,
                Err(_) => self.lose(now),
            }
        }
        self.send();
    }

    /// Sends what is in `out`, with a little patience.
    fn send(&mut self) {
        if self.silent {
            self.out.clear();
        }
        let end = MonotonicClock.now().after(ROOM);
        let mut done = 0;
        while let Some(port) = &mut self.port
            && done < self.out.len()
        {
            match port.send(self.out.get(done..).unwrap_or_default()) {
                Ok(taken) => done += taken,
                Err(_) => {
                    self.lose(end);
                    break;
                }
            }
            if done < self.out.len() {
                if MonotonicClock.now() >= end {
                    break;
                }
                std::thread::sleep(Duration::from_micros(200));
            }
        }
        self.shared.sent.fetch_add(done as u64, Relaxed);
        self.shared.not_taken.fetch_add((self.out.len() - done) as u64, Relaxed);
        self.out.clear();
    }

    /// The interface is gone: it is tried again after a while.
    fn lose(&mut self, now: Mono) {
        self.port = None;
        self.down = now.after(REOPEN);
    }

    fn open(&mut self, now: Mono) {
        if let (None, Seat::Interface(address)) = (&self.port, &self.seat)
            && now >= self.down
        {
            self.down = now.after(REOPEN);
            self.port = can::open("the piper emulator", address, FILTERS).ok();
        }
    }
}

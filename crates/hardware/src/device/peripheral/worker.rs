//! The loop of a peripheral's thread: waits, executes orders and commands, reads.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering::{Relaxed, Release};
use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::Duration;

use super::{Command, Order, PeripheralConfig, PeripheralState, Shared};
use crate::adapter::{AdapterError, AdapterResult};
use crate::device::Note;
use crate::device::gripper::GripperStop;
use crate::peripheral::{Condition, Peripheral, PeripheralInfo};
use dimos_core::arm::Link;
use dimos_core::clock::Mono;
use dimos_core::sync::{lock, panic_text};
use dimos_rt::host;
use dimos_rt::slot::{SlotReader, SlotWriter};
use dimos_rt::wake::Wake;

/// Consecutive failed readings after which a device that is connected counts as lost.
const MAX_FAILURES: u32 = 5;
/// Shortest and longest wait between two attempts to reconnect.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(500), Duration::from_secs(5));

pub(super) struct Worker {
    config: PeripheralConfig,
    states: SlotWriter<PeripheralState>,
    commands: SlotReader<Command>,
    wake: Wake,
    shared: Arc<Shared>,
    state: PeripheralState,
    last: Command,
    stop: GripperStop,
    connected: bool,
    should_reconnect: bool,
    failures: u32,
    last_read: Mono,
    next_read: Mono,
    /// Time of the next attempt to reconnect, and the wait after it.
    reconnect: (Mono, Duration),
}

impl Worker {
    pub(super) fn new(
        config: PeripheralConfig,
        states: SlotWriter<PeripheralState>,
        commands: SlotReader<Command>,
        (wake, shared): (Wake, Arc<Shared>),
    ) -> Self {
        Self {
            config,
            states,
            commands,
            wake,
            shared,
            state: PeripheralState::default(),
            last: Command::default(),
            stop: GripperStop::default(),
            connected: false,
            should_reconnect: false,
            failures: 0,
            last_read: Mono::ZERO,
            next_read: Mono::ZERO,
            reconnect: (Mono::ZERO, BACK_OFF.0),
        }
    }

    /// Runs until it is ordered to finish. A panic of the adapter affects this device only.
    pub(super) fn run(mut self, mut device: Box<dyn Peripheral>, orders: Receiver<Order>) {
        host::enter_realtime(host::DEVICE_PRIORITY);
        let outcome = catch_unwind(AssertUnwindSafe(|| while !self.cycle(&mut *device, &orders) {}));
        if let Err(panic) = outcome {
            self.lost(&format!("its adapter panicked: {}", panic_text(&*panic)));
            let _ = catch_unwind(AssertUnwindSafe(move || drop(device)));
            // Orders are refused from now on; so are commands, as long as the arm's thread sends any.
            drop(orders);
            while Arc::strong_count(&self.shared) > 1 {
                self.wake.wait(Duration::from_millis(100));
                self.take_commands(None);
            }
        }
    }

    /// Runs one cycle. Returns `true` when the thread is to end.
    pub(super) fn cycle(&mut self, device: &mut dyn Peripheral, orders: &Receiver<Order>) -> bool {
        let due = match (self.connected, self.should_reconnect) {
            (true, _) => self.next_read,
            (false, true) => self.reconnect.0,
            (false, false) => Mono(u64::MAX),
        };
        self.wake.wait(due.since(self.config.clock.now()).min(Duration::from_secs(1)));
        loop {
            match orders.try_recv() {
                Ok(Order::Connect(reply)) => {
                    let result = self.connect(device);
                    if let Err(error) = &result
                        && device.waits_for_arm()
                    {
                        self.should_reconnect = true;
                        self.lost(&error.to_string());
                    }
                    drop(reply.send(result));
                }
                Ok(Order::Home(reply)) => drop(reply.send(self.home(device))),
                Ok(Order::Reset(reply)) => drop(reply.send(self.reset(device))),
                Ok(Order::Finish(reply)) => {
                    device.disconnect();
                    self.shared.set_link(Link::Down);
                    drop(reply.send(Ok(())));
                    return true;
                }
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => return true,
            }
        }
        self.take_commands(Some(device));
        let now = self.config.clock.now();
        if self.connected && now >= self.next_read {
            self.read(device);
        } else if !self.connected && self.should_reconnect && now >= self.reconnect.0 {
            self.reconnect_device(device).ok();
        }
        false
    }

    fn connect(&mut self, device: &mut dyn Peripheral) -> AdapterResult<PeripheralInfo> {
        let info = device.connect()?;
        (self.connected, self.should_reconnect, self.failures) = (true, true, 0);
        self.reconnect.1 = BACK_OFF.0;
        let serial = info.serial_number.as_ref().map(|serial| format!("serial {serial}"));
        self.shared.health.with_identity(|known| known.connected(serial));
        self.shared.set_link(Link::Up);
        self.read(device);
        Ok(info)
    }

    fn reconnect_device(&mut self, device: &mut dyn Peripheral) -> AdapterResult<()> {
        match self.connect(device) {
            Ok(_) => {
                self.shared.missed.store(false, Release);
                self.shared.health.reconnects.fetch_add(1, Relaxed);
                Ok(())
            }
            Err(error) => {
                let wait = self.reconnect.1;
                self.reconnect = (self.config.clock.now().after(wait), (wait * 2).min(BACK_OFF.1));
                Err(error)
            }
        }
    }

    fn home(&mut self, device: &mut dyn Peripheral) -> AdapterResult<()> {
        self.reachable()?;
        self.stop.end();
        let result = device.home();
        // Its condition is known when the client asks for it.
        match &result {
            Ok(()) => self.read(device),
            Err(error) => self.failed(device, &format!("it was not homed: {error}")),
        }
        result
    }

    fn reset(&mut self, device: &mut dyn Peripheral) -> AdapterResult<()> {
        let result = match self.connected {
            true => device.clear_errors(),
            false => self.reconnect_device(device),
        };
        self.shared.missed.store(false, Release);
        if self.connected {
            self.read(device);
        }
        result
    }

    /// Fails while it is lost.
    fn reachable(&self) -> AdapterResult<()> {
        if self.connected {
            return Ok(());
        }
        let (part, arm) = (self.config.part.text(), &self.config.arm);
        let last = self.shared.health.episodes().pop().filter(|episode| episode.until.is_none());
        let why = last.map_or(String::new(), |episode| format!(": {}", episode.text));
        let hint = format!("check its cable and supply, then: dimos arm reset {arm}");
        Err(AdapterError::Rejected(format!("the {part} is lost{why}\nhint: {hint}")))
    }

    /// Executes what came from the arm since the last call; refuses it without a device.
    fn take_commands(&mut self, mut device: Option<&mut (dyn Peripheral + '_)>) {
        let command = self.commands.read();
        let before = std::mem::replace(&mut self.last, command);
        if command.seq != before.seq {
            let result = match &mut device {
                Some(device) => self.command(&mut **device, &command),
                None => Err(AdapterError::NotConnected),
            };
            if let Some(arm) = self.shared.arm.get() {
                arm.answer_gripper(command.seq, result);
            }
        }
        if let Some(device) = device.filter(|_| command.stops != before.stops && self.connected) {
            self.stop.begin(self.config.clock.now());
            if let Err(error) = device.halt() {
                self.failed(device, &format!("it did not take the stop: {error}"));
            }
        }
    }

    fn command(&mut self, device: &mut dyn Peripheral, command: &Command) -> AdapterResult<()> {
        self.reachable()?;
        self.stop.end();
        device.condition().ready(&self.config.arm)?;
        let gripper = device.gripper().ok_or(AdapterError::Unsupported)?;
        let result = gripper.command(command.position, command.force, command.speed);
        match &result {
            Ok(()) => {
                self.stop.commanded(command.force);
                self.shared.health.writes.fetch_add(1, Relaxed);
                // What was read before says nothing of this command.
                self.state.holds = None;
                self.states.write(&self.state);
            }
            Err(AdapterError::Rejected(_) | AdapterError::Unsupported) => {}
            Err(error) => self.failed(device, &format!("its command failed: {error}")),
        }
        result
    }

    fn read(&mut self, device: &mut dyn Peripheral) {
        let now = self.config.clock.now();
        self.next_read = now.after(Duration::from_secs_f64(1.0 / self.config.native_rate.max(0.1)));
        match device.read().and_then(|()| self.take(device)) {
            Ok(()) => {
                let health = &self.shared.health;
                health.state_came(if self.last_read == Mono::ZERO { 0.0 } else { now.seconds_since(self.last_read) });
                (self.last_read, self.failures) = (now, 0);
                self.report_condition(device.condition());
                self.hold(device);
            }
            Err(error) => {
                self.shared.health.read_errors.fetch_add(1, Relaxed);
                self.failures += 1;
                self.failed(device, &format!("no state: {error}"));
            }
        }
        self.states.write(&self.state);
    }

    /// Takes the state that was read.
    fn take(&mut self, device: &mut dyn Peripheral) -> AdapterResult<()> {
        if let Some(gripper) = device.gripper() {
            self.state.position = gripper.read_gripper_position()?;
            self.state.force = gripper.read_gripper_force()?;
            self.state.holds = gripper.read_gripper_holds()?;
        }
        if let Some(sensor) = device.force_torque() {
            self.state.wrench = sensor.read_force_torque()?;
        }
        self.state.at = self.config.clock.now();
        Ok(())
    }

    /// Logs an error of the device once, and that it is over.
    fn report_condition(&mut self, now: Condition) {
        let before = std::mem::replace(&mut *lock(&self.shared.condition), now);
        match now {
            Condition::Fault(code, text) if before != now => self.trouble(&format!("it reports fault {code}: {text}")),
            Condition::Fault(..) => {}
            _ => {
                if let Some(text) = self.shared.health.over(self.config.clock.now()) {
                    (self.config.notes)(Note::Over(format!("{}: {text}", self.config.part.text())));
                }
            }
        }
    }

    /// Holds a gripper that continues to move after a stop, with the force of its last command.
    fn hold(&mut self, device: &mut dyn Peripheral) {
        let now = self.config.clock.now();
        let (Some(position), Some(gripper)) = (self.state.position, device.gripper()) else { return };
        let Some(here) = self.stop.observe(position, gripper.get_gripper_unit(), now) else { return };
        let (a, b) = gripper.get_gripper_range().unwrap_or((f64::MIN, f64::MAX));
        if let Err(error) = gripper.command(here.max(a.min(b)).min(a.max(b)), self.stop.force(), None) {
            self.failed(device, &format!("it cannot be held: {error}"));
        }
    }

    /// Decides what an error means for the connection.
    fn failed(&mut self, device: &mut dyn Peripheral, what: &str) {
        if !device.is_connected() || self.failures >= MAX_FAILURES {
            device.disconnect();
            self.lost(what);
        } else {
            self.trouble(what);
        }
    }

    /// Marks the connection as lost, and schedules the first attempt to reconnect. Nothing is known of it then.
    fn lost(&mut self, what: &str) {
        let held = self.state.holds == Some(true) || self.shared.carries.load(Relaxed);
        self.connected = false;
        self.shared.missed.store(held, Release);
        self.shared.set_link(Link::Faulted);
        self.reconnect = (self.config.clock.now().after(BACK_OFF.0), BACK_OFF.0);
        self.state = PeripheralState::default();
        self.states.write(&self.state);
        self.trouble(what);
    }

    fn trouble(&self, text: &str) {
        if self.shared.health.trouble(self.config.clock.now(), text) {
            (self.config.notes)(Note::Began(format!("{}: {text}", self.config.part.text())));
        }
    }
}

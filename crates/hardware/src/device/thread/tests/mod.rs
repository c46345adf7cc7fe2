//! A device thread's cycles, one by one, on a virtual clock: no thread, no waiting.

mod commands;
mod connection;
mod lead;
mod parts;
mod readings;

use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use super::{Shared, Worker};
use crate::adapter::AdapterResult;
use crate::device::{DeviceConfig, Health, Note, Order, Setup};
use crate::testing::Call;
use crate::testing::MockAdapter;
use dimos_core::arm::{ArmCommand, ArmState, Supervision};
use dimos_core::clock::{Clock, Mono};
use dimos_core::joint::ControlMode;
use dimos_core::sync::lock;
use dimos_rt::due::Due;
use dimos_rt::heartbeat::Heartbeat;
use dimos_rt::slot::{SlotReader, SlotWriter, slot};
use dimos_rt::wake::Wake;

/// Number of joints of the mock arm.
const DOF: usize = 3;
/// Period of ticks, and of reads.
pub(super) const PERIOD: Duration = Duration::from_millis(10);

/// A clock that advances a little with each question, so that loops with a time limit end.
#[derive(Debug, Clone)]
pub(super) struct TestClock(Arc<Mutex<(Mono, Duration)>>);

impl Clock for TestClock {
    fn now(&self) -> Mono {
        let (now, step) = &mut *lock(&self.0);
        *now = now.after(*step);
        *now
    }
}

/// A worker with its mock arm, and the other ends of all that it is connected to.
pub(super) struct Bench {
    pub worker: Worker,
    arm: MockAdapter,
    adapter: MockAdapter,
    pub clock: TestClock,
    pub beat: Arc<Heartbeat>,
    pub states: SlotReader<ArmState>,
    commands: SlotWriter<ArmCommand>,
    command: ArmCommand,
    orders: Receiver<Order>,
    _orders: Sender<Order>,
    notes: Arc<Mutex<Vec<String>>>,
    wake: Wake,
}

impl Bench {
    fn new(arm: MockAdapter) -> Self {
        Self::with(arm, |_| {})
    }

    fn with(arm: MockAdapter, change: impl FnOnce(&mut DeviceConfig)) -> Self {
        let (state_writer, states) = slot(ArmState::default());
        let (commands, command_reader) = slot(ArmCommand::default());
        let (beat, notes) = (Arc::new(Heartbeat::default()), Arc::new(Mutex::new(Vec::new())));
        let clock = TestClock(Arc::new(Mutex::new((Mono(1_000_000_000), Duration::ZERO))));
        let noted = notes.clone();
        let mut config = DeviceConfig {
            hardware_id: "arm".into(),
            dof: DOF,
            usb: Box::new(|| None),
            tick_period: PERIOD,
            native_rate: 1000.0,
            supervision: Supervision { accept_zero_pose: true, ..Supervision::default() },
            setup: Setup::default(),
            peripherals: Default::default(),
            beat: beat.clone(),
            pace: None,
            clock: Arc::new(clock.clone()),
            notes: Box::new(move |note| {
                lock(&noted).push(match note {
                    Note::Began(text) => text,
                    Note::Over(text) => format!("over: {text}"),
                });
            }),
        };
        change(&mut config);
        let wake = Wake::new().unwrap();
        let shared = Shared { wake: wake.clone(), health: Arc::<Health>::default(), due: Arc::<Due>::default() };
        let worker = Worker::new(config, state_writer, command_reader, shared);
        let (sender, orders) = channel();
        Self {
            worker,
            adapter: arm.clone(),
            arm,
            clock,
            beat,
            states,
            commands,
            command: ArmCommand::default(),
            orders,
            _orders: sender,
            notes,
            wake,
        }
    }

    /// A connected arm of three joints.
    fn connected() -> Self {
        Self::connected_to(MockAdapter::new(DOF))
    }

    fn connected_to(arm: MockAdapter) -> Self {
        let mut bench = Self::new(arm);
        bench.worker.connect(&mut bench.adapter).unwrap();
        bench.arm.clear_calls();
        bench
    }

    /// A connected arm whose motors this run has enabled.
    pub fn enabled() -> Self {
        Self::enabled_with(MockAdapter::new(DOF))
    }

    /// This arm, connected, its motors enabled by this run.
    fn enabled_with(arm: MockAdapter) -> Self {
        let mut bench = Self::connected_to(arm);
        bench.settle();
        bench.activate().unwrap();
        bench.arm.clear_calls();
        bench
    }

    /// Reads until the positions are plausible.
    fn settle(&mut self) {
        for _ in 0..15 {
            self.advance(PERIOD);
            self.cycle();
        }
    }

    fn activate(&mut self) -> AdapterResult<()> {
        self.stepping(Duration::from_millis(1), |bench| bench.worker.activate(&mut bench.adapter))
    }

    /// Does something while each question for the time takes `step`.
    fn stepping<T>(&mut self, step: Duration, act: impl FnOnce(&mut Self) -> T) -> T {
        lock(&self.clock.0).1 = step;
        let result = act(self);
        lock(&self.clock.0).1 = Duration::ZERO;
        result
    }

    pub fn now(&self) -> Mono {
        self.clock.now()
    }

    /// Sets the time.
    pub fn set(&self, now: Mono) {
        lock(&self.clock.0).0 = now;
    }

    pub fn advance(&self, by: Duration) {
        let now = &mut lock(&self.clock.0).0;
        *now = now.after(by);
    }

    /// One cycle of the thread, which does not wait.
    fn cycle(&mut self) -> ArmState {
        self.wake.raise();
        assert!(!self.worker.cycle(&mut self.adapter, &self.orders), "it ended");
        self.states.read()
    }

    /// A period later, a cycle with what a tick does: a heartbeat and a new command.
    pub fn tick(&mut self, change: impl FnOnce(&mut ArmCommand)) -> ArmState {
        self.advance(PERIOD);
        let now = self.now();
        self.beat.beat(now);
        self.command.seq += 1;
        (self.command.at, self.command.next_tick) = (now, now.after(PERIOD));
        change(&mut self.command);
        self.commands.write(&self.command);
        self.cycle()
    }

    /// A tick with a setpoint for the first joint [rad].
    pub fn hold_at(&mut self, position: f64) -> ArmState {
        self.tick(|c| (c.mode, c.values[0]) = (Some(ControlMode::Position), position))
    }

    fn count(&self, method: &str) -> usize {
        self.arm.calls().iter().filter(|call| call.name() == method).count()
    }

    fn written(&self) -> Vec<f64> {
        let first = |call: &Call| match call {
            Call::WriteJointPositions(values, _) | Call::WriteJointVelocities(values) => values.first().copied(),
            _ => None,
        };
        self.arm.calls().iter().filter_map(first).collect()
    }

    pub fn notes(&self) -> Vec<String> {
        std::mem::take(&mut lock(&self.notes))
    }
}

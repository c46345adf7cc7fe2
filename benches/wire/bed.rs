//! An arm with its emulator and its real device thread, and a thread that does the tick's part: the coordinator is
//! left out, what is measured lies behind it.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use dimos::arm::{ArmCommand, ArmState, Link};
use dimos::clock::{Clock, MonotonicClock};
use dimos::control::tick_loop::next_deadline;
use dimos::hardware::device::{Device, DeviceConfig};
use dimos::hardware::spec::ManipulatorAdapter;
use dimos::joint::{ControlMode, MAX_DOF};
use dimos::rt::beat::Beat;
use dimos::rt::host;
use dimos::rt::slot::{SlotReader, SlotWriter, slot};
use dimos::rt::wake::Wake;

use crate::timed::{Delays, Timed, moment};

/// Longest wait for an arm.
const PATIENCE: Duration = Duration::from_secs(5);

/// An arm that is enabled, and follows set points.
pub struct Arm {
    device: Device,
    commands: SlotWriter<ArmCommand>,
    states: SlotReader<ArmState>,
    wake: Wake,
    /// How long each command took to the wire [µs].
    pub sent: Delays,
    /// How long each state took from the wire [µs], where the adapter's first joint is a moment.
    pub arrived: Delays,
    // Ends after the thread that talks to it.
    _world: Box<dyn std::any::Any + Send>,
}

impl Arm {
    /// Connects and enables an arm. `world` is kept as long as the arm: its emulator, say.
    pub fn new(
        inner: Box<dyn ManipulatorAdapter>,
        world: Box<dyn std::any::Any + Send>,
        period: Duration,
        beat: &Arc<Beat>,
        room: usize,
    ) -> Result<Self, String> {
        let text = |e: dimos::hardware::spec::AdapterError| e.to_string();
        let dof = inner.get_dof();
        let [sent, arrived] = [(); 2].map(|()| Arc::new(Mutex::new(Vec::with_capacity(room))));
        let adapter = Box::new(Timed { inner, sent: sent.clone(), arrived: arrived.clone() });
        let (state_writer, states) = slot(ArmState::default());
        let (commands, command_reader) = slot(ArmCommand::default());
        let config = DeviceConfig {
            hardware_id: "bench".to_owned(),
            dof,
            tick_period: period,
            native_rate: 250.0,
            supervision: dimos::arm::Supervision::default(),
            beat: beat.clone(),
            clock: Arc::new(MonotonicClock),
            notes: Box::new(|_| {}),
        };
        let device = Device::spawn(config, adapter, state_writer, command_reader).map_err(|e| e.to_string())?;
        device.connect().wait(PATIENCE).map_err(text)?;
        device.activate().wait(PATIENCE).map_err(text)?;
        Ok(Self { wake: device.wake(), device, commands, states, sent, arrived, _world: world })
    }

    /// Lets go of the arm; an error when it was lost meanwhile.
    pub fn finish(mut self) -> Result<(), String> {
        let state = self.states.read();
        let _ = self.device.finish(false).wait(PATIENCE);
        self.device.join();
        match (state.link, state.self_held) {
            (Link::Up, false) => Ok(()),
            (link, held) => Err(format!("the arm is {}, held by its own thread: {held}", link.name())),
        }
    }
}

/// What became of the periods.
#[derive(Debug, Clone, Copy, Default)]
pub struct Periods {
    /// A command was handed over.
    pub ticked: u64,
    /// Skipped, because the machine stood still.
    pub skipped: u64,
    /// Handed over, but replaced by the next one before the device thread took it.
    pub overwritten: u64,
    /// The latest wake-up [µs].
    pub latest: f64,
}

/// Does what the tick does, for so many periods: reads all states, writes all commands, then wakes all device threads.
pub fn tick(arms: &mut [Arm], period: Duration, periods: u64, beat: &Beat) -> Periods {
    let (_, _latency) = host::prepare_process(true);
    let mut counted = Periods::default();
    std::thread::scope(|scope| {
        let thread = scope.spawn(|| run(arms, period, periods, beat));
        counted = thread.join().unwrap_or_default();
    });
    counted
}

fn run(arms: &mut [Arm], period: Duration, periods: u64, beat: &Beat) -> Periods {
    host::enter_realtime(host::TICK_PRIORITY);
    let mut counted = Periods::default();
    let hold: Vec<[f64; MAX_DOF]> = arms.iter_mut().map(|arm| arm.states.read().position).collect();
    let mut deadline = MonotonicClock.now().after(period);
    while counted.ticked + counted.skipped < periods {
        host::sleep_until(deadline);
        let woke = MonotonicClock.now();
        counted.latest = counted.latest.max(woke.seconds_since(deadline) * 1e6);
        beat.beat(woke);
        let (next, skipped) = next_deadline(deadline, woke, period);
        counted.ticked += 1;
        counted.skipped += u64::from(skipped);
        for (arm, hold) in arms.iter_mut().zip(&hold) {
            let _ = arm.states.read();
            let mut values = *hold;
            values[0] = moment();
            let mode = Some(ControlMode::ServoPosition);
            let command = ArmCommand { seq: counted.ticked, mode, values, next_tick: next, ..ArmCommand::default() };
            counted.overwritten += u64::from(arm.commands.write(&command));
        }
        for arm in arms.iter() {
            arm.wake.raise();
        }
        deadline = next;
    }
    // Until the last commands are written.
    std::thread::sleep(period * 2);
    counted
}

//! An arm with its emulator and its real device thread, and a thread in place of the tick: the coordinator is omitted,
//! the path behind it is measured.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use dimos::arm::{ArmCommand, ArmState, Link};
use dimos::clock::{Clock, MonotonicClock};
use dimos::control::pace::next_deadline;
use dimos::hardware::adapter::ManipulatorAdapter;
use dimos::hardware::device::{Device, DeviceConfig};
use dimos::joint::{ControlMode, MAX_DOF};
use dimos::rt::heartbeat::Heartbeat;
use dimos::rt::host;
use dimos::rt::slot::{SlotReader, SlotWriter, slot};
use dimos::rt::wake::Wake;

use crate::timed::{Delays, Timed};

/// Timeout for the arm.
const TIMEOUT: Duration = Duration::from_secs(5);

/// An enabled arm that follows setpoints.
pub struct Arm {
    device: Device,
    commands: SlotWriter<ArmCommand>,
    states: SlotReader<ArmState>,
    wake: Wake,
    /// Delay of each command to the wire [µs].
    pub sent: Delays,
    /// Delay of each state from the wire [µs], if the adapter's first joint is a time stamp.
    pub arrived: Delays,
    // Dropped after the thread that uses it.
    _world: Box<dyn std::any::Any + Send>,
}

impl Arm {
    /// Connects and enables an arm. `world` is kept as long as the arm, for instance its emulator.
    pub fn new(
        inner: Box<dyn ManipulatorAdapter>,
        world: Box<dyn std::any::Any + Send>,
        period: Duration,
        beat: &Arc<Heartbeat>,
        room: usize,
    ) -> Result<Self, String> {
        let text = |e: dimos::hardware::adapter::AdapterError| e.to_string();
        let dof = inner.get_dof();
        let [sent, arrived] = [(); 2].map(|()| Arc::new(Mutex::new(Vec::with_capacity(room))));
        let adapter = Box::new(Timed { inner, sent: sent.clone(), arrived: arrived.clone() });
        let (state_writer, states) = slot(ArmState::default());
        let (commands, command_reader) = slot(ArmCommand::default());
        let config = DeviceConfig {
            hardware_id: "bench".to_owned(),
            dof,
            usb: Box::new(|| None),
            tick_period: period,
            native_rate: 250.0,
            supervision: dimos::arm::Supervision::default(),
            setup: dimos::hardware::device::Setup::default(),
            peripherals: Default::default(),
            beat: beat.clone(),
            pace: None,
            clock: Arc::new(MonotonicClock),
            notes: Box::new(|_| {}),
        };
        let device = Device::spawn(config, adapter, state_writer, command_reader).map_err(|e| e.to_string())?;
        let connected = device.connect().wait(TIMEOUT).map_err(text)?;
        drop(device.set_limits(connected.limits));
        device.activate().wait(TIMEOUT).map_err(text)?;
        Ok(Self { wake: device.wake(), device, commands, states, sent, arrived, _world: world })
    }

    /// Releases the arm; an error if it was lost in the meantime.
    pub fn finish(mut self) -> Result<(), String> {
        let state = self.states.read();
        let _ = self.device.finish(false).wait(TIMEOUT);
        self.device.join();
        match (state.link, state.self_held) {
            (Link::Up, false) => Ok(()),
            (link, held) => Err(format!("the arm is {}, held by its own thread: {held}", link.name())),
        }
    }
}

/// Account of the periods.
#[derive(Debug, Clone, Copy, Default)]
pub struct Periods {
    /// Periods with a command.
    pub ticked: u64,
    /// Skipped, because the machine was stalled.
    pub skipped: u64,
    /// Commands replaced by the next one before the device thread took them.
    pub overwritten: u64,
    /// Maximum lateness of a wake-up [µs].
    pub latest: f64,
}

/// Does the work of the tick for this many periods: reads all states, writes all commands, then wakes all device
/// threads. Without a mode nothing is commanded.
pub fn tick(arms: &mut [Arm], period: Duration, periods: u64, beat: &Heartbeat, mode: Option<ControlMode>) -> Periods {
    let (_, _latency) = host::prepare_process(true);
    let mut counted = Periods::default();
    std::thread::scope(|scope| {
        let thread = scope.spawn(|| run(arms, period, periods, beat, mode));
        counted = thread.join().unwrap_or_default();
    });
    counted
}

fn run(arms: &mut [Arm], period: Duration, periods: u64, beat: &Heartbeat, mode: Option<ControlMode>) -> Periods {
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
            let command = ArmCommand {
                seq: counted.ticked,
                mode,
                values: *hold,
                next_tick: next,
                at: MonotonicClock.now(),
                start_seq: 1,
                ..ArmCommand::default()
            };
            counted.overwritten += u64::from(arm.commands.write(&command));
        }
        for arm in arms.iter() {
            arm.wake.raise();
        }
        deadline = next;
    }
    // Waits until the last commands are written.
    std::thread::sleep(period * 2);
    counted
}

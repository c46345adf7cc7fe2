//! One I/O thread per arm. Only this thread talks to the adapter, at the arm's own rate: a slow device delays no other
//! arm.
//!
//! ```text
//! tick ──command slot──▶ ┌───────────────┐ ──▶ adapter ──▶ wire
//!      ◀──state slot──── │ device/<arm>  │ ◀──
//! rpc  ──orders─────────▶└───────────────┘   monitors the tick's heartbeat; holds the arm without it
//! ```

mod details;
pub mod gripper;
mod health;
mod history;
mod identity;
pub mod peripheral;
mod plausible;
mod thread;
mod wire_guard;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, channel, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

pub use details::Details;
pub use health::{Episode, Health, Note};
pub use history::History;
pub use identity::Identity;
pub use peripheral::{PeripheralConfig, PeripheralDevice, Ports};
pub use thread::Way;

use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter, ManipulatorInfo, Reduction};
use dimos_core::arm::{
    ArmCommand, ArmState, Bridging, EffortLimits, FactoryKinematics, GripperInfo, Impedance, IoInfo, IoState, Load,
    OutputValue, SetpointFields, StopInput, Supervision,
};
use dimos_core::clock::{Clock, Mono};
use dimos_core::joint::{JointLimits, Joints};
use dimos_rt::due::Due;
use dimos_rt::heartbeat::Heartbeat;
use dimos_rt::slot::{SlotReader, SlotWriter};
use dimos_rt::wake::Wake;

/// Heartbeat timeout of a fast tick: without a heartbeat for this long, the device thread holds the arm.
const BEAT_TIMEOUT: Duration = Duration::from_millis(40);
/// Longest period of setpoints, even if the device reports less often.
const MAX_WRITE_PERIOD: Duration = Duration::from_millis(20);

/// Configuration of a device thread.
pub struct DeviceConfig {
    /// The arm's `hardware_id`.
    pub hardware_id: String,
    /// Number of joints in the blueprint.
    pub dof: usize,
    /// Returns the USB device at the arm's address, if it is one.
    pub usb: Box<dyn Fn() -> Option<String> + Send>,
    /// Period of the tick.
    pub tick_period: Duration,
    /// Rate at which the device delivers its state [Hz].
    pub native_rate: f64,
    /// Limits for checking the arm's measurements and motion.
    pub supervision: Supervision,
    /// What the blueprint sets of the arm's optional parts.
    pub setup: Setup,
    /// Its gripper and its sensor, where they have their own connections.
    pub peripherals: Ports,
    /// The tick's heartbeat.
    pub beat: Arc<Heartbeat>,
    /// Raised with each new state, if this arm clocks the ticks.
    pub pace: Option<Wake>,
    /// The clock.
    pub clock: Arc<dyn Clock>,
    /// Receives a note at the beginning and at the end of each episode of trouble.
    pub notes: Box<dyn Fn(Note) + Send>,
}

/// What a blueprint sets of an arm's optional parts.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Setup {
    /// The digital input that stops the arm: read in every cycle.
    pub stop_input: Option<StopInput>,
    /// Load at the flange: set before the motors are enabled.
    pub payload: Option<Load>,
    /// Largest mass of a load [kg], if it is known.
    pub max_payload: Option<f64>,
    /// Direction of gravity in the base frame, a unit vector: set before the motors are enabled. `None`: the
    /// controller keeps its own setting.
    pub gravity: Option<[f64; 3]>,
    /// Highest speed of the tool [m/s], if it is limited: the blueprint's, or the vendor's.
    pub tool_velocity: Option<f64>,
    /// Highest efforts beside the arm's own control; `None`: none is written.
    pub efforts: Option<EffortLimits>,
    /// Gains in impedance mode; `None`: none are written.
    pub impedance: Option<Impedance>,
}

impl DeviceConfig {
    /// Returns the period of reads: that of the tick, at most 10 ms, and never shorter than the device's own.
    pub fn read_period(&self) -> Duration {
        let own = Duration::from_secs_f64(1.0 / self.native_rate.max(0.1));
        self.tick_period.min(Duration::from_millis(10)).max(own)
    }

    /// Returns the period of setpoints: the longer of the tick's and the arm's own, `own` if the adapter states one.
    pub fn write_period(&self, own: Option<Duration>) -> Duration {
        let states = Duration::from_secs_f64(1.0 / self.native_rate.max(0.1));
        self.tick_period.max(own.unwrap_or(states.min(MAX_WRITE_PERIOD)))
    }

    /// Returns the maximum age of a state.
    pub fn state_timeout(&self) -> Duration {
        self.supervision.stale_after.max(3 * self.read_period())
    }

    /// Returns the timeout of the tick's heartbeat, after which the device thread holds the arm.
    pub fn beat_timeout(&self) -> Duration {
        (3 * self.tick_period).max(BEAT_TIMEOUT)
    }
}

/// What a connected arm reports about itself.
#[derive(Debug, Clone)]
pub struct Connected {
    /// Identity.
    pub info: ManipulatorInfo,
    /// Joint limits.
    pub limits: JointLimits,
    /// Units and ranges of its gripper, if it has one.
    pub gripper: Option<GripperInfo>,
    /// Its digital and analogue inputs and outputs, if it has any.
    pub io: Option<IoInfo>,
    /// Which arm it is: its serial number, or the offsets that its drives keep; `None` if it does not say.
    pub identity: Option<String>,
    /// Calibration offsets of its joints [rad], if it reports them.
    pub calibration_offsets: Option<Joints>,
    /// Its dimensions, if its controller has them.
    pub kinematics: Option<FactoryKinematics>,
    /// What it makes of gaps in its setpoints, if it says so itself.
    pub bridging: Option<Bridging>,
    /// What the settings of its controller leave of its limits, if it reports them.
    pub reduction: Option<Reduction>,
    /// What it takes of setpoints, if it says so itself.
    pub setpoint: Option<SetpointFields>,
    /// How it is held in impedance mode, if it says so itself.
    pub impedance: Option<Impedance>,
    /// Whether it streams its state.
    pub streams: bool,
    /// Whether its controller takes the load at the flange.
    pub has_payload: bool,
    /// Whether setting that load resets the controller, so that the arm must be enabled again.
    pub payload_resets: bool,
    /// Period of reads.
    pub read_period: Duration,
    /// Period of setpoints: the longer of the tick's and the arm's own.
    pub write_period: Duration,
}

enum Order {
    Connect(SyncSender<AdapterResult<Connected>>),
    Activate(SyncSender<AdapterResult<()>>),
    Disable(SyncSender<AdapterResult<()>>),
    ClearErrors(SyncSender<AdapterResult<()>>),
    SetLimits(JointLimits, SyncSender<AdapterResult<()>>),
    ReadIo(SyncSender<AdapterResult<IoState>>),
    SetOutput(OutputValue, SyncSender<AdapterResult<()>>),
    ReadPayload(SyncSender<AdapterResult<Option<Load>>>),
    SetPayload(Load, SyncSender<AdapterResult<Option<Load>>>),
    Tare(SyncSender<AdapterResult<[f64; 6]>>),
    WatchInputs(SyncSender<AdapterResult<()>>),
    TakeOver(SyncSender<AdapterResult<()>>),
    Lead(Way, u32, SyncSender<AdapterResult<()>>),
    Finish { disable: bool, reply: SyncSender<AdapterResult<()>> },
}

/// Handle of a device thread. Orders return an [`Answer`]; only the caller waits.
pub struct Device {
    hardware_id: String,
    orders: std::sync::mpsc::Sender<Order>,
    wake: Wake,
    health: Arc<Health>,
    due: Arc<Due>,
    thread: Option<JoinHandle<()>>,
}

impl Device {
    /// Starts the thread. It does nothing until it is ordered to connect.
    pub fn spawn(
        config: DeviceConfig,
        adapter: Box<dyn ManipulatorAdapter>,
        states: SlotWriter<ArmState>,
        commands: SlotReader<ArmCommand>,
    ) -> std::io::Result<Self> {
        let (orders, receiver) = channel();
        let wake = Wake::new()?;
        let health = Arc::new(Health::default());
        let hardware_id = config.hardware_id.clone();
        if let Some(gripper) = &config.peripherals.gripper {
            gripper.answer_to(health.clone());
        }
        let due = Arc::new(Due::default());
        let shared = thread::Shared { wake: wake.clone(), health: health.clone(), due: due.clone() };
        let worker = thread::Worker::new(config, states, commands, shared);
        let thread = std::thread::Builder::new()
            .name(format!("device/{hardware_id}").chars().take(15).collect())
            .stack_size(dimos_rt::host::STACK)
            .spawn(move || worker.run(adapter, receiver))?;
        Ok(Self { hardware_id, orders, wake, health, due, thread: Some(thread) })
    }

    /// Returns the arm's `hardware_id`.
    pub fn hardware_id(&self) -> &str {
        &self.hardware_id
    }

    /// Returns the event that wakes the thread for a new command.
    pub fn wake(&self) -> Wake {
        self.wake.clone()
    }

    /// Returns the joint positions at a time within the last 2 s [rad or m], between two states if need be; `None`:
    /// they are not known.
    pub fn joints_at(&self, time: Mono) -> Option<Joints> {
        self.health.history.at(time)
    }

    /// Returns the thread's counters, and its texts for status and log.
    pub fn health(&self) -> &Arc<Health> {
        &self.health
    }

    /// Connects and identifies the device.
    pub fn connect(&self) -> Answer<Connected> {
        self.order(Order::Connect)
    }

    /// Enables the motors, once the device's states are fresh and plausible.
    pub fn activate(&self) -> Answer<()> {
        self.order(Order::Activate)
    }

    /// Disables the motors.
    pub fn disable(&self) -> Answer<()> {
        self.order(Order::Disable)
    }

    /// Clears the device's error state.
    pub fn clear_errors(&self) -> Answer<()> {
        self.order(Order::ClearErrors)
    }

    /// Sets the limits of commands: the arm's own, narrowed by the blueprint.
    pub fn set_limits(&self, limits: JointLimits) -> Answer<()> {
        self.order(|reply| Order::SetLimits(limits, reply))
    }

    /// Reads the levels of all inputs and outputs. `Unsupported` for an arm without any.
    pub fn read_io(&self) -> Answer<IoState> {
        self.order(Order::ReadIo)
    }

    /// Sets an output. `Unsupported` for an arm without any.
    pub fn set_output(&self, value: OutputValue) -> Answer<()> {
        self.order(|reply| Order::SetOutput(value, reply))
    }

    /// Reads the load that the controller calculates with. `Unsupported` for an arm that takes none.
    pub fn read_payload(&self) -> Answer<Option<Load>> {
        self.order(Order::ReadPayload)
    }

    /// Sets the load at the flange, and returns what the controller then reports. `Rejected` while the arm moves, and
    /// if the controller reports another load. Repeated whenever the motors are enabled.
    pub fn set_payload(&self, load: Load) -> Answer<Option<Load>> {
        self.order(|reply| Order::SetPayload(load, reply))
    }

    /// Makes the present wrench zero until the next tare or the end of the run, and returns what was measured [N, N, N,
    /// Nm, Nm, Nm]. `Unsupported` for an arm without a wrench; `Rejected` while none is known.
    pub fn tare(&self) -> Answer<[f64; 6]> {
        self.order(Order::Tare)
    }

    /// Reads the digital inputs with every state from now on. `Unsupported` for an arm without any.
    pub fn watch_inputs(&self) -> Answer<()> {
        self.order(Order::WatchInputs)
    }

    /// Lets the arm be led, by a hand or by its own controller; the answer comes when that begins. `lead_seq` is that
    /// of the tick's command: a stop in between refuses the order. `Unsupported` for an arm without it. `activate` and
    /// `take_over` end it.
    pub fn lead(&self, way: Way, lead_seq: u32) -> Answer<()> {
        self.order(|reply| Order::Lead(way, lead_seq, reply))
    }

    /// Makes a led arm ready where it is, if its motors are on: `Rejected` otherwise.
    pub fn take_over(&self) -> Answer<()> {
        self.order(Order::TakeOver)
    }

    /// Returns the thread's wake deadline.
    pub fn due(&self) -> Arc<Due> {
        self.due.clone()
    }

    /// Stops commanded motion, disables the motors if requested, disconnects, and ends the thread.
    pub fn finish(&self, disable: bool) -> Answer<()> {
        self.order(|reply| Order::Finish { disable, reply })
    }

    fn order<T>(&self, order: impl FnOnce(SyncSender<AdapterResult<T>>) -> Order) -> Answer<T> {
        let (reply, answer) = sync_channel(1);
        // If the thread has ended, the order is dropped and the answer reports it.
        let _ = self.orders.send(order(reply));
        self.wake.raise();
        Answer { answer }
    }

    /// Waits for the thread to end. Call only after `finish` was answered.
    pub fn join(mut self) {
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The answer to an order.
pub struct Answer<T> {
    answer: Receiver<AdapterResult<T>>,
}

impl<T> Answer<T> {
    /// Waits for the answer, at most `timeout`.
    pub fn wait(self, timeout: Duration) -> AdapterResult<T> {
        match self.answer.recv_timeout(timeout) {
            Ok(result) => result,
            Err(RecvTimeoutError::Timeout) => {
                Err(AdapterError::Timeout(format!("no answer within {:.1} s", timeout.as_secs_f64())))
            }
            Err(RecvTimeoutError::Disconnected) => Err(AdapterError::Io("the device thread has ended".to_owned())),
        }
    }
}

//! One I/O thread per arm. It alone talks to the adapter, at the arm's own pace: a slow device hurts only itself.
//!
//! ```text
//! tick ──command slot──▶ ┌───────────────┐ ──▶ adapter ──▶ wire
//!      ◀──state slot──── │ device/<arm>  │ ◀──
//! rpc  ──orders─────────▶└───────────────┘   watches the tick's heartbeat; holds the arm by itself when it stops
//! ```

pub mod gripper;
mod health;
mod plausible;
mod thread;
mod wire_guard;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, channel, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

pub use health::{Episode, Health, Note};

use crate::arm::{ArmCommand, ArmState, Supervision};
use crate::clock::Clock;
use crate::hardware::adapter::{AdapterError, AdapterResult, ManipulatorAdapter, ManipulatorInfo};
use crate::joint::JointLimits;
use crate::rt::due::Due;
use crate::rt::heartbeat::Heartbeat;
use crate::rt::slot::{SlotReader, SlotWriter};
use crate::rt::wake::Wake;

/// Longest silence of the tick before the device thread holds the arm by itself, where the tick is fast.
const BEAT_TIMEOUT: Duration = Duration::from_millis(40);
/// The longest time between two setpoints that counts as regular, however seldom the device reports.
const LONGEST_WRITE_PERIOD: Duration = Duration::from_millis(20);

/// What a device thread is made from.
pub struct DeviceConfig {
    /// The arm's name in the blueprint.
    pub hardware_id: String,
    /// Number of joints the blueprint names.
    pub dof: usize,
    /// Period of the tick.
    pub tick_period: Duration,
    /// How often the device can deliver its state [Hz].
    pub native_rate: f64,
    /// Figures with which the arm's measurements and its motion are checked.
    pub supervision: Supervision,
    /// The tick's heartbeat.
    pub beat: Arc<Heartbeat>,
    /// Time.
    pub clock: Arc<dyn Clock>,
    /// Hears of episodes, one note at their beginning and one at their end.
    pub notes: Box<dyn Fn(Note) + Send>,
}

impl DeviceConfig {
    /// How often the device is read: with every tick, faster where the tick is slow, never faster than it delivers.
    pub fn read_period(&self) -> Duration {
        let own = Duration::from_secs_f64(1.0 / self.native_rate.max(0.1));
        self.tick_period.min(Duration::from_millis(10)).max(own)
    }

    /// The longer of the tick's period and the arm's own for setpoints.
    /// `own`: what the adapter says of it.
    pub fn write_period(&self, own: Option<Duration>) -> Duration {
        let states = Duration::from_secs_f64(1.0 / self.native_rate.max(0.1));
        self.tick_period.max(own.unwrap_or(states.min(LONGEST_WRITE_PERIOD)))
    }

    /// A state older than this is stale.
    pub fn state_timeout(&self) -> Duration {
        self.supervision.stale_after.max(3 * self.read_period())
    }

    /// Without the tick's heartbeat for this long, the device thread holds the arm by itself.
    pub fn beat_timeout(&self) -> Duration {
        (3 * self.tick_period).max(BEAT_TIMEOUT)
    }
}

/// What a connected arm said of itself.
#[derive(Debug, Clone)]
pub struct Connected {
    /// Who it is.
    pub info: ManipulatorInfo,
    /// Its joint limits.
    pub limits: JointLimits,
    /// How far its gripper closes and opens [m], where it has one and says so.
    pub gripper_range: Option<(f64, f64)>,
    /// Period of its states, as they are read.
    pub read_period: Duration,
    /// The longer of the tick's period and the arm's own for setpoints.
    pub write_period: Duration,
}

enum Order {
    Connect(SyncSender<AdapterResult<Connected>>),
    Activate(SyncSender<AdapterResult<()>>),
    Disable(SyncSender<AdapterResult<()>>),
    ClearErrors(SyncSender<AdapterResult<()>>),
    SetLimits(JointLimits, SyncSender<AdapterResult<()>>),
    Finish { disable: bool, reply: SyncSender<AdapterResult<()>> },
}

/// A device thread's handle: orders go in, answers come out. All waiting is done by the caller.
pub struct Device {
    hardware_id: String,
    orders: std::sync::mpsc::Sender<Order>,
    wake: Wake,
    health: Arc<Health>,
    due: Arc<Due>,
    thread: Option<JoinHandle<()>>,
}

impl Device {
    /// Starts the thread. It does nothing until it is told to connect.
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
        let due = Arc::new(Due::default());
        let shared = thread::Shared { wake: wake.clone(), health: health.clone(), due: due.clone() };
        let worker = thread::Worker::new(config, states, commands, shared);
        let thread = std::thread::Builder::new()
            .name(format!("device/{hardware_id}").chars().take(15).collect())
            .stack_size(crate::rt::host::STACK)
            .spawn(move || worker.run(adapter, receiver))?;
        Ok(Self { hardware_id, orders, wake, health, due, thread: Some(thread) })
    }

    /// The arm's name in the blueprint.
    pub fn hardware_id(&self) -> &str {
        &self.hardware_id
    }

    /// Wakes the thread when a command is in its slot.
    pub fn wake(&self) -> Wake {
        self.wake.clone()
    }

    /// What the thread counts and remembers.
    pub fn health(&self) -> &Arc<Health> {
        &self.health
    }

    /// Connects and asks the device what it is.
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

    /// Sets the limits that commands keep: the arm's own, narrowed by the blueprint.
    pub fn set_limits(&self, limits: JointLimits) -> Answer<()> {
        self.order(|reply| Order::SetLimits(limits, reply))
    }

    /// When the thread means to be awake.
    pub fn due(&self) -> Arc<Due> {
        self.due.clone()
    }

    /// Ends commanded motion, disables the motors if asked, disconnects, ends the thread.
    pub fn finish(&self, disable: bool) -> Answer<()> {
        self.order(|reply| Order::Finish { disable, reply })
    }

    fn order<T>(&self, order: impl FnOnce(SyncSender<AdapterResult<T>>) -> Order) -> Answer<T> {
        let (reply, answer) = sync_channel(1);
        // A thread that is gone drops the order, and the answer says so.
        let _ = self.orders.send(order(reply));
        self.wake.raise();
        Answer { answer }
    }

    /// Waits for the thread's end; only after `finish` was answered.
    pub fn join(mut self) {
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// The answer to an order, when it comes.
pub struct Answer<T> {
    answer: Receiver<AdapterResult<T>>,
}

impl<T> Answer<T> {
    /// Waits for it, so long at most.
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

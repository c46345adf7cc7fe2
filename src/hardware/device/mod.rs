//! One I/O thread per arm. It alone talks to the adapter, at the arm's own pace: a slow device hurts only itself.
//!
//! ```text
//! tick ──command slot──▶ ┌───────────────┐ ──▶ adapter ──▶ wire
//!      ◀──state slot──── │ device/<arm>  │ ◀──
//! rpc  ──orders─────────▶└───────────────┘   watches the tick's heartbeat; holds the arm by itself when it stops
//! ```

pub mod gripper;
mod health;
mod thread;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, channel, sync_channel};
use std::thread::JoinHandle;
use std::time::Duration;

pub use health::{Episode, Health, Note};

use crate::arm::{ArmCommand, ArmState};
use crate::clock::Clock;
use crate::hardware::spec::{AdapterError, AdapterResult, ManipulatorAdapter, ManipulatorInfo};
use crate::joint::JointLimits;
use crate::rt::beat::Beat;
use crate::rt::slot::{SlotReader, SlotWriter};
use crate::rt::wake::Wake;

/// Without real-time scheduling the computer itself stalls this long when it is busy; nothing is to be read into that.
const STALLS: Duration = Duration::from_millis(100);

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
    /// The fastest any joint may move [rad/s], to tell a plausible pose from an impossible one.
    pub velocity_max: f64,
    /// Whether the process may schedule in real time: silence is then noticed sooner.
    pub realtime: bool,
    /// The tick's heartbeat.
    pub beat: Arc<Beat>,
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

    /// A state older than this is stale.
    pub fn state_timeout(&self) -> Duration {
        (3 * self.read_period()).max(if self.realtime { Duration::from_millis(30) } else { STALLS })
    }

    /// Without the tick's heartbeat for this long, the device thread holds the arm by itself.
    pub fn beat_timeout(&self) -> Duration {
        (3 * self.tick_period).max(if self.realtime { Duration::from_millis(40) } else { STALLS })
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
    /// A state older than this is stale, at the rate that the arm has told.
    pub state_timeout: Duration,
}

enum Order {
    Connect(SyncSender<AdapterResult<Connected>>),
    Activate(SyncSender<AdapterResult<()>>),
    Disable(SyncSender<AdapterResult<()>>),
    ClearErrors(SyncSender<AdapterResult<()>>),
    Finish { disable: bool, reply: SyncSender<AdapterResult<()>> },
}

/// A device thread's handle: orders go in, answers come out. All waiting is done by the caller.
pub struct Device {
    hardware_id: String,
    orders: std::sync::mpsc::Sender<Order>,
    wake: Wake,
    health: Arc<Health>,
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
        let worker = thread::Worker::new(config, states, commands, wake.clone(), health.clone());
        let thread = std::thread::Builder::new()
            .name(format!("device/{hardware_id}").chars().take(15).collect())
            .stack_size(crate::rt::host::STACK)
            .spawn(move || worker.run(adapter, receiver))?;
        Ok(Self { hardware_id, orders, wake, health, thread: Some(thread) })
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

//! The device thread of a peripheral, and what it shares with the thread of its arm and with requests.
//!
//! ```text
//! tick ─▶ device/<arm> ──command slot──▶ ┌──────────────────┐ ──▶ peripheral ──▶ wire
//!      ◀─              ◀──state slot──── │ device/<arm>/<part> │ ◀──
//! rpc  ──orders─────────────────────────▶└──────────────────┘
//! ```
//!
//! A lost peripheral does not take its arm with it: the thread reconnects, its commands are refused meanwhile, and only
//! an arm that loses what it holds is held ([`Port::is_missed`]).

mod port;
#[cfg(test)]
mod tests;
mod worker;

use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::mpsc::{SyncSender, channel, sync_channel};
use std::sync::{Arc, Mutex, OnceLock};
use std::thread::JoinHandle;

use super::{Answer, Health, Note};
use crate::adapter::AdapterResult;
use crate::peripheral::{Condition, Part, Peripheral, PeripheralInfo};
use dimos_core::arm::Link;
use dimos_core::clock::{Clock, Mono};
use dimos_core::sync::lock;
use dimos_rt::slot::slot;
use dimos_rt::wake::Wake;

pub use port::{Port, Ports};

/// Configuration of the thread.
pub struct PeripheralConfig {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Which part of the arm it is.
    pub part: Part,
    /// Rate of readings [Hz].
    pub native_rate: f64,
    /// The clock.
    pub clock: Arc<dyn Clock>,
    /// Receives a note at the beginning and at the end of each episode of trouble.
    pub notes: Box<dyn Fn(Note) + Send>,
}

/// Latest known state of a peripheral; what is not known is `None`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct PeripheralState {
    /// Gripper position [m or rad].
    pub position: Option<f64>,
    /// Measured force of the gripper, in its force unit.
    pub force: Option<f64>,
    /// Whether the gripper itself reports an object in its grip.
    pub holds: Option<bool>,
    /// Force and torque [N, N, N, Nm, Nm, Nm].
    pub wrench: Option<[f64; 6]>,
    /// When all that was read.
    pub at: Mono,
}

/// Commands for a gripper.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Command {
    /// `ArmCommand::gripper_seq` of the newest command; 0 = none yet.
    seq: u32,
    /// Position [m or rad].
    position: f64,
    /// Largest force, in its force unit.
    force: Option<f64>,
    /// Fraction of its top speed.
    speed: Option<f64>,
    /// Counts the stops.
    stops: u32,
}

/// What the thread shares with the arm's thread and with requests.
#[derive(Debug, Default)]
struct Shared {
    link: AtomicU8,
    condition: Mutex<Condition>,
    /// The arm holds an object, by what requests know of it.
    carries: AtomicBool,
    /// It was lost while something was held; until it is back, or the loss is acknowledged.
    missed: AtomicBool,
    health: Health,
    /// Gets the answers to gripper commands.
    arm: OnceLock<Arc<Health>>,
}

impl Shared {
    fn set_link(&self, link: Link) {
        self.link.store(link as u8, Ordering::Release);
    }

    fn link(&self) -> Link {
        let links = [Link::Down, Link::Up, Link::Stale, Link::Faulted];
        let now = self.link.load(Ordering::Acquire);
        links.into_iter().find(|link| *link as u8 == now).unwrap_or_default()
    }
}

enum Order {
    Connect(SyncSender<AdapterResult<PeripheralInfo>>),
    Home(SyncSender<AdapterResult<()>>),
    Reset(SyncSender<AdapterResult<()>>),
    Finish(SyncSender<AdapterResult<()>>),
}

/// Handle of the thread. Orders return an [`Answer`]; only the caller waits. The thread ends when this is dropped.
pub struct PeripheralDevice {
    part: Part,
    orders: std::sync::mpsc::Sender<Order>,
    wake: Wake,
    shared: Arc<Shared>,
    waits_for_arm: bool,
    thread: Option<JoinHandle<()>>,
}

impl PeripheralDevice {
    /// Starts the thread. It does nothing until it is ordered to connect. The [`Port`] belongs to the arm's thread.
    pub fn spawn(config: PeripheralConfig, mut device: Box<dyn Peripheral>) -> std::io::Result<(Self, Port)> {
        let (orders, receiver) = channel();
        let (states, state_reader) = slot(PeripheralState::default());
        let (commands, command_reader) = slot(Command::default());
        let (wake, shared) = (Wake::new()?, Arc::new(Shared::default()));
        let (part, waits_for_arm) = (config.part, device.waits_for_arm());
        let info = device.gripper().map(|gripper| gripper.info());
        let port = Port::new(commands, state_reader, (wake.clone(), shared.clone()), info);
        // What is in front is the same for all of an arm; the kernel keeps 15 characters.
        let name = format!("{}/{}", part.name(), config.arm).chars().take(15).collect();
        let worker = worker::Worker::new(config, states, command_reader, (wake.clone(), shared.clone()));
        let thread = std::thread::Builder::new()
            .name(name)
            .stack_size(dimos_rt::host::STACK)
            .spawn(move || worker.run(device, receiver))?;
        Ok((Self { part, orders, wake, shared, waits_for_arm, thread: Some(thread) }, port))
    }

    /// Returns which part of the arm it is.
    pub fn part(&self) -> Part {
        self.part
    }

    /// Returns whether it may be unreachable until the arm is enabled.
    pub fn waits_for_arm(&self) -> bool {
        self.waits_for_arm
    }

    /// Returns the state of the connection.
    pub fn link(&self) -> Link {
        self.shared.link()
    }

    /// Returns whether it can be used, as read last.
    pub fn condition(&self) -> Condition {
        *lock(&self.shared.condition)
    }

    /// Returns why it is lost; `None`: it is not, as far as known.
    pub fn lost(&self) -> Option<String> {
        let last = || self.shared.health.episodes().pop().filter(|episode| episode.until.is_none());
        let text = || last().map_or("not connected yet".to_owned(), |episode| episode.text);
        (self.link() != Link::Up).then(text)
    }

    /// Returns the thread's counters, and its texts for status and log.
    pub fn health(&self) -> &Health {
        &self.shared.health
    }

    /// Says whether the arm holds an object: then it is held when this is lost, whatever the device itself reports.
    pub fn set_carries(&self, carries: bool) {
        self.shared.carries.store(carries, Ordering::Relaxed);
    }

    /// Connects and identifies the device. Without success the thread tries again, if the device waits for the arm.
    pub fn connect(&self) -> Answer<PeripheralInfo> {
        self.order(Order::Connect)
    }

    /// Begins to home it; [`condition`](Self::condition) shows the end.
    pub fn home(&self) -> Answer<()> {
        self.order(Order::Home)
    }

    /// Reconnects at once if it is lost, else clears its error. Acknowledges that it was lost with what it held.
    pub fn reset(&self) -> Answer<()> {
        self.order(Order::Reset)
    }

    /// Disconnects, and ends the thread.
    pub fn finish(&self) -> Answer<()> {
        self.order(Order::Finish)
    }

    fn order<T>(&self, order: impl FnOnce(SyncSender<AdapterResult<T>>) -> Order) -> Answer<T> {
        let (reply, answer) = sync_channel(1);
        // If the thread has ended, the order is dropped and the answer reports it.
        let _ = self.orders.send(order(reply));
        self.wake.raise();
        Answer { answer }
    }
}

impl Drop for PeripheralDevice {
    fn drop(&mut self) {
        drop(self.finish());
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

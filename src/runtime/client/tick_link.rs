//! The tick as requests see it: what it was asked, what it has done, and waiting for the effect. A condition is checked
//! after every tick and after every answer of an arm, without polling.

use std::sync::atomic::Ordering::{Acquire, Relaxed, SeqCst};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tokio::sync::watch;

use super::dispatch::Dispatcher;
use super::lease_changes::UnsentEnds;
use dimos_control::tick_loop::Pulse;
use dimos_core::arm::{ArmState, Link};
use dimos_core::joint::STANDSTILL;
use dimos_core::sync::lock;
use dimos_core::telemetry::{ArmSample, Phase, TaskView};
use dimos_rpc::api::SpeedReport;
use dimos_rt::slot::SlotReader;

/// Maximum wait for a tick.
const TICK_LIMIT: Duration = Duration::from_secs(1);

/// The connection to the tick.
pub(in crate::runtime) struct TickLink {
    dispatcher: Arc<Dispatcher>,
    pulse: Arc<Pulse>,
    arm_views: Mutex<Vec<SlotReader<ArmSample>>>,
    task_views: Mutex<Vec<SlotReader<TaskView>>>,
    /// Counts ticks and answers of arms, and wakes the requests that wait for them.
    progress: watch::Sender<u64>,
    unsent_ends: UnsentEnds,
}

/// While this exists, every tick wakes the outcome thread.
pub(in crate::runtime) struct EachTick(Arc<Pulse>);

impl Drop for EachTick {
    fn drop(&mut self) {
        self.0.waiting.fetch_sub(1, SeqCst);
    }
}

impl TickLink {
    /// Creates the link. The views are those of the arms and the tasks, in their order.
    pub fn new(
        dispatcher: Arc<Dispatcher>,
        pulse: Arc<Pulse>,
        arm_views: Vec<SlotReader<ArmSample>>,
        task_views: Vec<SlotReader<TaskView>>,
    ) -> Self {
        Self {
            dispatcher,
            pulse,
            arm_views: Mutex::new(arm_views),
            task_views: Mutex::new(task_views),
            progress: watch::Sender::default(),
            unsent_ends: UnsentEnds::default(),
        }
    }

    /// Returns what sends requests and notes.
    pub fn dispatcher(&self) -> &Dispatcher {
        &self.dispatcher
    }

    /// Returns the figures of the tick.
    pub fn pulse(&self) -> &Pulse {
        &self.pulse
    }

    /// Returns the number of interruptions so far: stops, holds, lost arms.
    pub fn epoch(&self) -> u64 {
        self.pulse.epoch.load(Acquire)
    }

    /// Returns the number of the last tick.
    pub fn last_tick(&self) -> u64 {
        self.pulse.ticks.load(Relaxed).saturating_sub(1)
    }

    /// Returns the speed override.
    pub fn speed_override(&self) -> SpeedReport {
        // 0 before the first tick.
        let fraction = Some(f64::from_bits(self.pulse.speed.load(Relaxed))).filter(|fraction| *fraction > 0.0);
        SpeedReport { fraction: fraction.unwrap_or(1.0), paused: self.pulse.paused.load(Relaxed) }
    }

    /// Returns the latest sample of an arm.
    pub fn arm_view(&self, arm: usize) -> Option<ArmSample> {
        lock(&self.arm_views).get_mut(arm).map(SlotReader::read)
    }

    /// Returns the latest state of a task.
    pub fn task_view(&self, task: usize) -> TaskView {
        lock(&self.task_views).get_mut(task).map(SlotReader::read).unwrap_or_default()
    }

    /// Returns the phase of an arm after the last tick.
    pub fn phase(&self, arm: usize) -> Phase {
        self.arm_view(arm).map_or(Phase::Unknown, |s| s.phase)
    }

    /// Returns `Some` once an arm is in a condition.
    pub fn seen(&self, arm: u16, is: impl Fn(&ArmSample) -> bool) -> Option<()> {
        self.arm_view(arm as usize).is_some_and(|view| is(&view)).then_some(())
    }

    /// Returns the velocity of an arm's fastest joint [rad/s]; 0 without a state.
    pub fn speed(&self, arm: u16) -> f64 {
        let view = self.arm_view(arm as usize).filter(|view| view.state.link == Link::Up);
        let joints = view.iter().flat_map(|view| view.state.velocity.iter().take(view.state.dof));
        joints.map(|v| v.abs()).fold(0.0, f64::max)
    }

    /// Returns whether every arm with known state is measured at rest.
    pub fn at_standstill(&self) -> bool {
        let still = |state: &ArmState| state.velocity.iter().take(state.dof).all(|v| v.abs() <= STANDSTILL);
        let mut views = lock(&self.arm_views);
        views.iter_mut().map(SlotReader::read).all(|view| view.state.link != Link::Up || still(&view.state))
    }

    /// Reports that a connection no longer commands an arm.
    pub fn lease_ended(&self, arm: u16, client: u64) {
        self.unsent_ends.add(arm, client);
        self.send_lease_ends();
    }

    /// Sends the ends of leases that there was no room for.
    pub fn send_lease_ends(&self) {
        self.unsent_ends.send(&self.dispatcher);
    }

    /// Counts a tick, or an answer of an arm.
    pub fn made(&self) {
        self.progress.send_modify(|count| *count = count.wrapping_add(1));
    }

    /// Lets every tick wake the outcome thread while the returned value exists.
    pub fn each_tick(&self) -> EachTick {
        self.pulse.waiting.fetch_add(1, SeqCst);
        EachTick(self.pulse.clone())
    }

    /// Waits until `look` returns `Some`. Calls it now, after every tick and every answer of an arm, and at least
    /// several times a second. Returns `None` at the `limit`.
    pub async fn until<T>(&self, limit: Instant, mut look: impl FnMut() -> Option<T>) -> Option<T> {
        let mut progress = self.progress.subscribe();
        let _waiting = self.each_tick();
        loop {
            if let Some(found) = look() {
                return Some(found);
            }
            if tokio::time::timeout_at(limit.into(), progress.changed()).await.is_err() {
                return look();
            }
        }
    }

    /// Waits for the end of the next tick to begin: it reads all that the arms have reported so far.
    pub async fn next_tick(&self) {
        let begun = self.pulse.begun.load(SeqCst);
        let done = || (self.pulse.ticks.load(Acquire) > begun).then_some(());
        self.until(Instant::now() + TICK_LIMIT, done).await;
    }
}

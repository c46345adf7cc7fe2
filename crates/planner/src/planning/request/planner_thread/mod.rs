//! The planner thread: plans one request at a time, accepts a cancel at any time, keeps the newest plans. A panic or a
//! hang fails only that request; a hung thread is abandoned and replaced.

mod tally;
#[cfg(test)]
mod tests;
mod worker;

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use glamx::DAffine3;
use nalgebra::Isometry3;

use crate::collision::world::World;
use crate::collision::{Scene, Stop};
use crate::planning::ik::reach::{Reached, reach};
use crate::planning::request::ahead::{Blocked, look_ahead};
use crate::planning::request::pipeline::{PlanFailure, PlanRequest, PlannedMotion, solve};
use crate::planning::request::revalidate::revalidate;
use crate::planning::scene::planning_scene::PlanningScene;
use crate::planning::scene::unplanned_joints::Measured;
use dimos_core::sync::lock;
use worker::{Shared, WorkItem, Worker};

pub use tally::Tally;
pub use worker::{Job, Progress, Solver};

/// Maximum number of plans kept.
const MAX_JOBS: usize = 16;
/// Grace period after the timeout or a cancel before a request counts as hung.
const GRACE_PERIOD: Duration = Duration::from_secs(5);
/// Maximum number of abandoned threads; after that, requests are refused.
const MAX_HANGING: usize = 4;
/// Maximum wait for the thread at drop.
const JOIN_TIMEOUT: Duration = Duration::from_secs(2);

/// A running planner thread. Shuts down when dropped.
pub struct PlannerThread {
    setup: Arc<PlanningScene>,
    /// `setup` with the joints that are not planned at their latest measured positions, and with the present tools.
    now: Mutex<Arc<PlanningScene>>,
    /// The world and its change count.
    world: Mutex<(World, u64)>,
    shared: Arc<Shared>,
    solver: Solver,
    timeout: Duration,
    worker: Mutex<Worker>,
}

/// Why a request was refused.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum BeginError {
    /// Another request is being planned.
    #[error("the planner is busy with another request")]
    Busy,
    /// Too many requests hang.
    #[error("{MAX_HANGING} earlier requests hang in the planner: a bug in the planner")]
    Hangs,
}

impl PlannerThread {
    /// Starts the thread.
    pub fn start(setup: PlanningScene, timeout: Duration) -> std::io::Result<Self> {
        Self::with(setup, timeout, Arc::new(solve))
    }

    /// Starts the thread with `solver` as the function that answers requests.
    pub fn with(setup: PlanningScene, timeout: Duration, solver: Solver) -> std::io::Result<Self> {
        let world = Mutex::new((setup.world.clone(), 1));
        let (setup, shared) = (Arc::new(setup), Arc::new(Shared::default()));
        let worker = Mutex::new(Worker::start(&shared, &solver, 0)?);
        let now = Mutex::new(setup.clone());
        Ok(Self { setup, now, world, shared, solver, timeout, worker })
    }

    /// Returns the robots as they were at the start.
    pub fn setup(&self) -> &PlanningScene {
        &self.setup
    }

    /// Returns the robots with the joints that are not planned at their latest measured positions, and with tools.
    pub fn now(&self) -> Arc<PlanningScene> {
        lock(&self.now).clone()
    }

    /// Updates the positions of the joints that are not planned.
    pub fn measured(&self, measured: &Measured) {
        let mut now = lock(&self.now);
        if let Some(changed) = now.with_idle_joints(measured) {
            *now = Arc::new(changed);
            lock(&self.world).1 += 1;
        }
    }

    /// Replaces the tool of a robot (index). A request that is being planned keeps the previous one.
    pub fn set_tool(&self, robot: usize, tool: Option<Isometry3<f64>>) {
        let mut now = lock(&self.now);
        let mut changed = (**now).clone();
        changed.robots.get_mut(robot).into_iter().for_each(|robot| robot.set_tool(tool));
        *now = Arc::new(changed);
    }

    /// Changes the world. A request that is being planned keeps its copy.
    pub fn world<T>(&self, act: impl FnOnce(&mut World) -> T) -> T {
        let mut world = lock(&self.world);
        world.1 += 1;
        act(&mut world.0)
    }

    /// Returns the change count of the world.
    pub fn version(&self) -> u64 {
        lock(&self.world).1
    }

    /// Returns the present world with the robots as they are now, and its change count.
    pub fn snapshot(&self) -> (Arc<Scene>, u64) {
        let now = lock(&self.now);
        let world = lock(&self.world);
        let robots = now.robots.iter().map(|robot| robot.body.clone()).collect();
        (world.0.with_robots(robots).snapshot(), world.1)
    }

    /// Begins request `id`. It ends after `timeout`, or the planner's default timeout.
    pub fn begin(&self, id: u64, request: PlanRequest, timeout: Option<Duration>) -> Result<(), BeginError> {
        self.abandon_hung_request();
        let mut jobs = lock(&self.shared.jobs);
        if jobs.iter().any(Job::is_planning) {
            return Err(BeginError::Busy);
        }
        let worker = lock(&self.worker);
        let Some(work) = &worker.work else { return Err(BeginError::Hangs) };
        let (now, request) = (Instant::now(), Arc::new(request));
        let deadline = now + timeout.unwrap_or(self.timeout);
        let cancelled = Arc::new(AtomicBool::new(false));
        let stop = Stop::new(Some(deadline), Some(cancelled.clone()));
        *lock(&self.shared.cancel) = Some(cancelled);
        jobs.push_back(Job { id, request: request.clone(), progress: Progress::Planning(now), deadline });
        if jobs.len() > MAX_JOBS {
            jobs.pop_front();
        }
        let item = WorkItem { id, setup: self.now(), request, world: lock(&self.world).0.clone(), stop };
        // The receiver exists as long as this sender.
        let _ = work.send(item);
        Ok(())
    }

    /// Cancels the request that is being planned, if it has this id; `None`: whichever it is. Returns whether it was
    /// being planned.
    pub fn cancel(&self, id: Option<u64>) -> bool {
        // Before the cancel flag, as in `begin`: the flag and the job must belong to the same request.
        let mut jobs = lock(&self.shared.jobs);
        let is_meant = |job: &&mut Job| job.is_planning() && id.is_none_or(|id| job.id == id);
        let Some(job) = jobs.iter_mut().find(is_meant) else { return false };
        job.deadline = job.deadline.min(Instant::now());
        if let Some(cancel) = &*lock(&self.shared.cancel) {
            cancel.store(true, Ordering::Relaxed);
        }
        true
    }

    /// Discards all plans: their ids belong to a run that has ended.
    pub fn forget(&self) {
        self.cancel(None);
        lock(&self.shared.jobs).retain(Job::is_planning);
    }

    /// Fails a request that exceeded its grace period, and starts a new thread for the next one.
    fn abandon_hung_request(&self) {
        let mut jobs = lock(&self.shared.jobs);
        let hangs = |job: &&mut Job| job.is_planning() && job.deadline.elapsed() > GRACE_PERIOD;
        let Some(job) = jobs.iter_mut().find(hangs) else { return };
        let Progress::Planning(since) = job.progress else { return };
        let failure = PlanFailure::new("the planner did not end at its timeout: a bug in the planner");
        job.progress = Progress::Failed(failure, since.elapsed());
        lock(&self.shared.tally).count(&job.progress);
        let mut worker = lock(&self.worker);
        let hanging = worker.hanging + 1;
        let fresh = (hanging < MAX_HANGING).then(|| Worker::start(&self.shared, &self.solver, hanging));
        *worker = match fresh {
            Some(Ok(fresh)) => fresh,
            _ => Worker { work: None, thread: None, hanging },
        };
    }

    /// Returns a check of a plan's motion against the current world and the current positions of all robots [rad]. Run
    /// it on another thread: its duration is not bounded.
    pub fn revalidate(
        &self,
        found: Arc<PlannedMotion>,
        positions: Vec<Vec<f64>>,
        stop: Stop,
    ) -> impl FnOnce() -> Result<(), PlanFailure> + Send + use<> {
        let (setup, world) = (self.now(), lock(&self.world).0.clone());
        move || revalidate(&setup, &world, &found, &positions, &stop)
    }

    /// Returns a check of the rest of a running motion, from `elapsed` [s] on, against the current world. Run it on
    /// another thread: it may take until `stop`.
    pub fn look_ahead(
        &self,
        found: Arc<PlannedMotion>,
        positions: Vec<Vec<f64>>,
        elapsed: f64,
        stop: Stop,
    ) -> impl FnOnce() -> Result<Option<Blocked>, PlanFailure> + Send + use<> {
        let (setup, world) = (self.now(), lock(&self.world).0.clone());
        move || look_ahead(&setup, &world, &found, &positions, elapsed, &stop)
    }

    /// Returns the inverse kinematics of a pose of a robot (index) in `map`, its orientation free if `position_only`:
    /// see [`reach`]. Run it on another thread.
    pub fn reach(
        &self,
        robot: usize,
        positions: Vec<Vec<f64>>,
        (target, position_only): (DAffine3, bool),
        near: Vec<f64>,
        stop: Stop,
    ) -> impl FnOnce() -> Result<Reached, PlanFailure> + Send + use<> {
        let (setup, world) = (self.now(), lock(&self.world).0.clone());
        move || reach(&setup, &world, robot, &positions, (&target, position_only), &near, &stop)
    }

    /// Returns a request by its id.
    pub fn job(&self, id: u64) -> Option<Job> {
        self.abandon_hung_request();
        lock(&self.shared.jobs).iter().rev().find(|job| job.id == id).cloned()
    }

    /// Returns how requests have ended since the start.
    pub fn tally(&self) -> Tally {
        self.abandon_hung_request();
        lock(&self.shared.tally).clone()
    }

    /// Returns the newest request.
    pub fn newest(&self) -> Option<Job> {
        self.abandon_hung_request();
        lock(&self.shared.jobs).back().cloned()
    }

    /// Returns the newest request that does not need its number to be selected, also one without a motion.
    pub fn newest_without_number(&self) -> Option<Job> {
        self.abandon_hung_request();
        lock(&self.shared.jobs).iter().rev().find(|job| !job.request.by_number).cloned()
    }
}

impl Drop for PlannerThread {
    fn drop(&mut self) {
        self.cancel(None);
        let mut worker = lock(&self.worker);
        worker.work = None;
        let Some(thread) = worker.thread.take() else { return };
        let began = Instant::now();
        while !thread.is_finished() && began.elapsed() < JOIN_TIMEOUT {
            std::thread::sleep(Duration::from_millis(1));
        }
        // Abandons a hung thread: it must not delay the release of the arms.
        if thread.is_finished() {
            let _ = thread.join();
        }
    }
}

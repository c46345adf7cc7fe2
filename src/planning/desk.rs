//! The planner's thread: takes one request at a time, can be cancelled at once, keeps the newest plans. A panic in a
//! request costs that request only.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::setup::Setup;
use super::solve::{Failure, Found, Request, solve};
use crate::collision::Stop;
use crate::collision::world::World;

/// Plans that are kept.
const KEPT: usize = 16;
/// Stack of the planner's thread: collision checks of large meshes recurse.
const STACK: usize = 8 << 20;

/// How a request stands.
#[derive(Debug, Clone)]
pub enum Progress {
    /// It is being planned, since then.
    Planning(Instant),
    /// A motion was found, in this time.
    Found(Arc<Found>, Duration),
    /// There is none, after this time.
    Failed(Failure, Duration),
}

/// A request and how it stands.
#[derive(Debug, Clone)]
pub struct Job {
    /// Its number.
    pub id: u64,
    /// What was asked.
    pub request: Arc<Request>,
    /// How it stands.
    pub progress: Progress,
}

struct Order {
    id: u64,
    request: Arc<Request>,
    world: World,
    stop: Stop,
}

#[derive(Default)]
struct Shared {
    jobs: Mutex<VecDeque<Job>>,
    /// Set to end the request that is being planned.
    cancel: Mutex<Option<Arc<AtomicBool>>>,
}

/// A planner that is running. Ends with its last owner.
pub struct Desk {
    setup: Arc<Setup>,
    world: Mutex<World>,
    shared: Arc<Shared>,
    orders: Mutex<Option<Sender<Order>>>,
    timeout: Duration,
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// Another request is being planned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the planner is busy with another request")]
pub struct Busy;

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Desk {
    /// Starts the thread.
    pub fn start(setup: Setup, timeout: Duration) -> std::io::Result<Self> {
        let (orders, receiver) = channel();
        let world = Mutex::new(setup.world.clone());
        let (setup, shared) = (Arc::new(setup), Arc::new(Shared::default()));
        let (its_setup, its_shared) = (setup.clone(), shared.clone());
        let thread = std::thread::Builder::new()
            .name("planner".into())
            .stack_size(STACK)
            .spawn(move || work(&its_setup, &its_shared, &receiver))?;
        let (orders, thread) = (Mutex::new(Some(orders)), Mutex::new(Some(thread)));
        Ok(Self { setup, world, shared, orders, timeout, thread })
    }

    /// The robots.
    pub fn setup(&self) -> &Setup {
        &self.setup
    }

    /// Looks at the world or changes it. Requests that are being planned keep the world that they began with.
    pub fn world<T>(&self, act: impl FnOnce(&mut World) -> T) -> T {
        act(&mut lock(&self.world))
    }

    /// Begins a request with this number. It ends by itself after `timeout`, or the planner's own.
    pub fn begin(&self, id: u64, request: Request, timeout: Option<Duration>) -> Result<(), Busy> {
        let mut jobs = lock(&self.shared.jobs);
        if jobs.iter().any(|job| matches!(job.progress, Progress::Planning(_))) {
            return Err(Busy);
        }
        let (now, request) = (Instant::now(), Arc::new(request));
        let cancelled = Arc::new(AtomicBool::new(false));
        let stop = Stop::new(Some(now + timeout.unwrap_or(self.timeout)), Some(cancelled.clone()));
        *lock(&self.shared.cancel) = Some(cancelled);
        jobs.push_back(Job { id, request: request.clone(), progress: Progress::Planning(now) });
        if jobs.len() > KEPT {
            jobs.pop_front();
        }
        let order = Order { id, request, world: lock(&self.world).clone(), stop };
        if let Some(orders) = &*lock(&self.orders) {
            // The thread ends with this sender only.
            let _ = orders.send(order);
        }
        Ok(())
    }

    /// Ends the request that is being planned, if there is one. `true`: there was.
    pub fn cancel(&self) -> bool {
        let planning = lock(&self.shared.jobs).iter().any(|job| matches!(job.progress, Progress::Planning(_)));
        if let Some(cancel) = &*lock(&self.shared.cancel) {
            cancel.store(true, Ordering::Relaxed);
        }
        planning
    }

    /// A request by its number.
    pub fn job(&self, id: u64) -> Option<Job> {
        lock(&self.shared.jobs).iter().find(|job| job.id == id).cloned()
    }

    /// The newest request, or the newest that led to a motion.
    pub fn newest(&self, found: bool) -> Option<Job> {
        let jobs = lock(&self.shared.jobs);
        jobs.iter().rev().find(|job| !found || matches!(job.progress, Progress::Found(..))).cloned()
    }
}

impl Drop for Desk {
    fn drop(&mut self) {
        self.cancel();
        lock(&self.orders).take();
        if let Some(thread) = lock(&self.thread).take() {
            let _ = thread.join();
        }
    }
}

fn work(setup: &Setup, shared: &Shared, orders: &Receiver<Order>) {
    while let Ok(order) = orders.recv() {
        let began = Instant::now();
        let outcome = catch_unwind(AssertUnwindSafe(|| solve(setup, &order.world, &order.request, &order.stop)));
        let took = began.elapsed();
        let progress = match outcome {
            Ok(Ok(found)) => Progress::Found(Arc::new(found), took),
            Ok(Err(failure)) => Progress::Failed(failure, took),
            Err(_) => {
                Progress::Failed(Failure::new("the planner failed at this request: a defect of the program"), took)
            }
        };
        if let Some(job) = lock(&shared.jobs).iter_mut().find(|job| job.id == order.id) {
            job.progress = progress;
        }
    }
}

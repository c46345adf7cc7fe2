//! The thread that plans, and the requests that it works on. A panic of the solver fails only its request.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::AtomicBool;
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::Tally;
use crate::collision::Stop;
use crate::collision::world::World;
use crate::planning::request::pipeline::{PlanFailure, PlanRequest, PlannedMotion};
use crate::planning::scene::planning_scene::PlanningScene;
use dimos_core::sync::lock;

/// Stack of the thread [bytes]: collision checks of large meshes recurse.
const STACK: usize = 8 << 20;

/// Function that answers a request: [`solve`](crate::planning::request::pipeline::solve), or a replacement for tests.
pub type Solver =
    Arc<dyn Fn(&PlanningScene, &World, &PlanRequest, &Stop) -> Result<PlannedMotion, PlanFailure> + Send + Sync>;

/// Progress of a request.
#[derive(Debug, Clone)]
pub enum Progress {
    /// Being planned since this time.
    Planning(Instant),
    /// A motion was found after this duration.
    Found(Arc<PlannedMotion>, Duration),
    /// Planning failed after this duration.
    Failed(PlanFailure, Duration),
}

/// A request and its progress.
#[derive(Debug, Clone)]
pub struct Job {
    /// Id of the request.
    pub id: u64,
    /// The request.
    pub request: Arc<PlanRequest>,
    /// Its progress.
    pub progress: Progress,
    /// When it must end.
    pub(in crate::planning) deadline: Instant,
}

impl Job {
    pub(in crate::planning) fn is_planning(&self) -> bool {
        matches!(self.progress, Progress::Planning(_))
    }
}

/// Input of the thread for a request: its own copies of the scene and the world.
pub(in crate::planning) struct WorkItem {
    pub id: u64,
    pub setup: Arc<PlanningScene>,
    pub request: Arc<PlanRequest>,
    pub world: World,
    pub stop: Stop,
}

/// The requests, shared with the thread.
#[derive(Default)]
pub(in crate::planning) struct Shared {
    pub jobs: Mutex<VecDeque<Job>>,
    /// Cancels the request that is being planned.
    pub cancel: Mutex<Option<Arc<AtomicBool>>>,
    /// How requests have ended.
    pub tally: Mutex<Tally>,
}

/// The thread that plans.
pub(in crate::planning) struct Worker {
    /// Dropped to end the thread.
    pub work: Option<Sender<WorkItem>>,
    pub thread: Option<JoinHandle<()>>,
    /// Number of abandoned threads.
    pub hanging: usize,
}

impl Worker {
    pub fn start(shared: &Arc<Shared>, solver: &Solver, hanging: usize) -> std::io::Result<Self> {
        let (work, receiver) = channel();
        let (shared, solver) = (shared.clone(), solver.clone());
        let thread = std::thread::Builder::new()
            .name("planner".into())
            .stack_size(STACK)
            .spawn(move || run(&solver, &shared, &receiver))?;
        Ok(Self { work: Some(work), thread: Some(thread), hanging })
    }
}

fn run(solver: &Solver, shared: &Shared, work: &Receiver<WorkItem>) {
    while let Ok(item) = work.recv() {
        let began = Instant::now();
        let outcome = catch_unwind(AssertUnwindSafe(|| solver(&item.setup, &item.world, &item.request, &item.stop)));
        let took = began.elapsed();
        let progress = match outcome {
            Ok(Ok(found)) => Progress::Found(Arc::new(found), took),
            Ok(Err(failure)) => Progress::Failed(failure, took),
            Err(_) => Progress::Failed(PlanFailure::new("the planner panicked: a bug in the planner"), took),
        };
        if let Some(job) = lock(&shared.jobs).iter_mut().find(|job| job.id == item.id && job.is_planning()) {
            lock(&shared.tally).count(&progress);
            job.progress = progress;
        }
    }
}

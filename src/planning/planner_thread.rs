//! The planner thread: plans one request at a time, accepts a cancel at any time, keeps the newest plans. A panic or a
//! hang fails only that request; a hung thread is abandoned and replaced.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::ahead::{Blocked, look_ahead};
use super::pipeline::{PlanFailure, PlanRequest, PlannedMotion, solve};
use super::planning_scene::PlanningScene;
use super::revalidate::revalidate;
use super::unplanned_joints::Measured;
use crate::collision::Stop;
use crate::collision::world::World;
use crate::sync::lock;

/// Maximum number of plans kept.
const MAX_JOBS: usize = 16;
/// Stack of the planner thread: collision checks of large meshes recurse.
const STACK: usize = 8 << 20;

/// Grace period after the timeout or a cancel before a request counts as hung.
const GRACE_PERIOD: Duration = Duration::from_secs(5);
/// Maximum number of abandoned threads; after that, requests are refused.
const MAX_HANGING: usize = 4;
/// Maximum wait for the thread at drop.
const JOIN_TIMEOUT: Duration = Duration::from_secs(2);

/// Function that answers a request: [`solve`], or a replacement for tests.
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
    deadline: Instant,
}

impl Job {
    fn is_planning(&self) -> bool {
        matches!(self.progress, Progress::Planning(_))
    }
}

struct WorkItem {
    id: u64,
    setup: Arc<PlanningScene>,
    request: Arc<PlanRequest>,
    world: World,
    stop: Stop,
}

#[derive(Default)]
struct Shared {
    jobs: Mutex<VecDeque<Job>>,
    /// Cancels the request that is being planned.
    cancel: Mutex<Option<Arc<AtomicBool>>>,
}

/// A running planner thread. Shuts down when dropped.
pub struct PlannerThread {
    setup: Arc<PlanningScene>,
    /// `setup` with the joints that are not planned at their latest measured positions.
    now: Mutex<Arc<PlanningScene>>,
    /// The world and its change count.
    world: Mutex<(World, u64)>,
    shared: Arc<Shared>,
    solver: Solver,
    timeout: Duration,
    worker: Mutex<Worker>,
}

/// The thread that plans.
struct Worker {
    /// Dropped to end the thread.
    work: Option<Sender<WorkItem>>,
    thread: Option<JoinHandle<()>>,
    /// Number of abandoned threads.
    hanging: usize,
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

    /// Returns the robots.
    pub fn setup(&self) -> &PlanningScene {
        &self.setup
    }

    /// Returns the robots with the joints that are not planned at their latest measured positions.
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

    /// Cancels the request that is being planned. Returns whether there was one.
    pub fn cancel(&self) -> bool {
        if let Some(cancel) = &*lock(&self.shared.cancel) {
            cancel.store(true, Ordering::Relaxed);
        }
        let mut jobs = lock(&self.shared.jobs);
        let mut planning = false;
        for job in jobs.iter_mut().filter(|job| job.is_planning()) {
            job.deadline = job.deadline.min(Instant::now());
            planning = true;
        }
        planning
    }

    /// Discards all plans: their ids belong to a run that has ended.
    pub fn forget(&self) {
        self.cancel();
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

    /// Returns a request by its id.
    pub fn job(&self, id: u64) -> Option<Job> {
        self.abandon_hung_request();
        lock(&self.shared.jobs).iter().rev().find(|job| job.id == id).cloned()
    }

    /// Returns the newest request, or the newest with a motion.
    pub fn newest(&self, found: bool) -> Option<Job> {
        self.abandon_hung_request();
        let jobs = lock(&self.shared.jobs);
        jobs.iter().rev().find(|job| !found || matches!(job.progress, Progress::Found(..))).cloned()
    }
}

impl Worker {
    fn start(shared: &Arc<Shared>, solver: &Solver, hanging: usize) -> std::io::Result<Self> {
        let (work, receiver) = channel();
        let (shared, solver) = (shared.clone(), solver.clone());
        let thread = std::thread::Builder::new()
            .name("planner".into())
            .stack_size(STACK)
            .spawn(move || run_thread(&solver, &shared, &receiver))?;
        Ok(Self { work: Some(work), thread: Some(thread), hanging })
    }
}

impl Drop for PlannerThread {
    fn drop(&mut self) {
        self.cancel();
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

fn run_thread(solver: &Solver, shared: &Shared, work: &Receiver<WorkItem>) {
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
            job.progress = progress;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use nalgebra::Isometry3;

    use super::super::config::{ObjectConfig, ObjectShape, PlannerConfig, RobotConfig};
    use super::super::pipeline::Goal;
    use super::*;

    const HOME: [f64; 6] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];
    /// Far longer than any of these tests takes, also on a busy machine.
    const TIMEOUT: Duration = Duration::from_secs(20);

    fn object(name: &str, size: [f64; 3], at: [f64; 3]) -> ObjectConfig {
        let pose = Isometry3::translation(at[0], at[1], at[2]);
        ObjectConfig { name: name.into(), shape: ObjectShape::Box(size), pose, padding: 0.0 }
    }

    fn yourarm(objects: Vec<ObjectConfig>) -> PlanningScene {
        let joints: Vec<String> = (1..=6).map(|k| format!("joint{k}")).collect();
        let robot = RobotConfig {
            name: "arm".into(),
            model_path: "builtin:yourarm".into(),
            packages: BTreeMap::new(),
            xacro_args: BTreeMap::new(),
            srdf: None,
            joint_limits: None,
            shapes: BTreeMap::new(),
            convert_meshes: true,
            base_pose: Isometry3::identity(),
            base_link: "base_link".into(),
            end_effector_link: "flange".into(),
            coordinator_joints: joints.iter().map(|joint| format!("arm_{joint}")).collect(),
            joints,
            task: None,
            exclusions: Vec::new(),
            max_velocity: 1.0,
            max_acceleration: 2.0,
            max_jerk: None,
            joint_prefix: String::new(),
            gripper_joint: None,
            named_poses: BTreeMap::new(),
        };
        PlanningScene::load(&PlannerConfig {
            timeout: Duration::from_secs(60),
            padding: 0.003,
            robots: vec![robot],
            objects,
        })
        .unwrap()
    }

    /// Walls that no search passes within the time of these tests.
    fn walled() -> PlanningScene {
        let wall = |name, x| object(name, [2.0, 0.02, 4.0], [x, 0.0, 0.0]);
        yourarm(vec![wall("front", 1.16), wall("back", -1.16)])
    }

    fn turn(from: f64, to: f64, seed: u64) -> PlanRequest {
        let at = |angle| [&[angle], &HOME[1..]].concat();
        PlanRequest { goals: vec![(0, Goal::Joints(at(to)))], positions: vec![at(from)], speed: 0.5, seed }
    }

    fn outcome(planner: &PlannerThread, id: u64) -> Progress {
        let began = Instant::now();
        loop {
            let progress = planner.job(id).unwrap().progress;
            if !matches!(progress, Progress::Planning(_)) {
                return progress;
            }
            assert!(began.elapsed() < TIMEOUT, "request {id} does not end");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn found(planner: &PlannerThread, id: u64, request: PlanRequest) -> Arc<PlannedMotion> {
        planner.begin(id, request, None).unwrap();
        match outcome(planner, id) {
            Progress::Found(found, _) => found,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_panic_costs_one_request() {
        let breaks = |setup: &PlanningScene, world: &World, request: &PlanRequest, stop: &Stop| {
            assert!(request.seed != 13, "a test's panic");
            solve(setup, world, request, stop)
        };
        let planner = PlannerThread::with(yourarm(Vec::new()), TIMEOUT, Arc::new(breaks)).unwrap();
        found(&planner, 1, turn(0.0, 0.5, 0));
        planner.begin(2, turn(0.0, 0.5, 13), None).unwrap();
        let failed = outcome(&planner, 2);
        assert!(matches!(&failed, Progress::Failed(f, _) if f.what.contains("a bug in the planner")), "{failed:?}");
        found(&planner, 3, turn(0.0, 0.5, 0));
        assert_eq!(planner.newest(true).unwrap().id, 3);
        assert!(matches!(planner.job(1).unwrap().progress, Progress::Found(..)));
    }

    #[test]
    fn a_hung_request_fails_alone_and_does_not_block_the_shutdown() {
        let hangs = |setup: &PlanningScene, world: &World, request: &PlanRequest, stop: &Stop| {
            if request.seed != 13 {
                return solve(setup, world, request, stop);
            }
            loop {
                std::thread::sleep(Duration::from_millis(50)); // and ignores the cancel flag
            }
        };
        let planner = PlannerThread::with(yourarm(Vec::new()), TIMEOUT, Arc::new(hangs)).unwrap();
        planner.begin(1, turn(0.0, 0.5, 13), Some(Duration::from_millis(10))).unwrap();
        assert_eq!(planner.begin(2, turn(0.0, 0.5, 0), None), Err(BeginError::Busy));
        let failed = outcome(&planner, 1);
        assert!(matches!(&failed, Progress::Failed(f, took) if f.what.contains("did not end") && *took > GRACE_PERIOD));
        found(&planner, 2, turn(0.0, 0.5, 0));
        planner.begin(3, turn(0.0, 0.5, 13), None).unwrap();
        let began = Instant::now();
        drop(planner);
        assert!(began.elapsed() < TIMEOUT / 2);
    }

    #[test]
    fn the_same_request_gives_the_same_plan() {
        let post = object("post", [0.04, 0.04, 0.4], [0.22, 0.12, 0.2]);
        let planner = PlannerThread::start(yourarm(vec![post]), TIMEOUT).unwrap();
        let first = found(&planner, 1, turn(0.0, 1.0, 7));
        let again = found(&planner, 2, turn(0.0, 1.0, 7));
        assert!(first.path.len() > 2, "the straight line should be blocked: {:?}", first.path);
        assert_eq!((&first.path, &first.trajectory), (&again.path, &again.trajectory));
        assert_ne!(first.path, found(&planner, 3, turn(0.0, 1.0, 8)).path);
    }

    #[test]
    fn a_request_ends_at_its_timeout() {
        let planner = PlannerThread::start(walled(), TIMEOUT).unwrap();
        // Far less than a search around the walls needs.
        let limit = Duration::from_millis(10);
        // One collision check more than the timeout allows; a busy machine gets several attempts.
        let late = (1..=8).map(|id| {
            planner.begin(id, turn(1.5, -1.5, id), Some(limit)).unwrap();
            match outcome(&planner, id) {
                Progress::Failed(failure, took) => {
                    assert!(failure.what.contains("in time") && !failure.cancelled, "{failure:?}");
                    took.saturating_sub(limit)
                }
                other => panic!("{other:?}"),
            }
        });
        let least = late.min().unwrap();
        assert!(least < Duration::from_millis(50), "{least:?} late");
    }

    #[test]
    fn a_cancel_ends_the_request_and_frees_the_planner() {
        let planner = PlannerThread::start(walled(), TIMEOUT).unwrap();
        assert!(!planner.cancel());
        planner.begin(1, turn(1.5, -1.5, 0), None).unwrap();
        assert_eq!(planner.begin(2, turn(1.5, 1.4, 0), None), Err(BeginError::Busy));
        assert!(planner.cancel());
        let cancelled = outcome(&planner, 1);
        assert!(matches!(&cancelled, Progress::Failed(f, took) if f.cancelled && *took < TIMEOUT / 4), "{cancelled:?}");
        found(&planner, 2, turn(1.5, 1.4, 0));
        // Dropping does not wait for the running request.
        planner.begin(3, turn(1.5, -1.5, 0), None).unwrap();
        let began = Instant::now();
        drop(planner);
        assert!(began.elapsed() < TIMEOUT / 4);
    }

    #[test]
    fn a_goal_at_the_start_gives_a_short_stationary_trajectory() {
        let planner = PlannerThread::start(yourarm(Vec::new()), TIMEOUT).unwrap();
        let found = found(&planner, 1, turn(0.5, 0.5, 0));
        assert!(found.trajectory.validate().is_ok() && found.trajectory.duration() < 0.2);
        assert!(found.trajectory.points.iter().all(|point| point.positions == found.path[0]));
    }

    #[test]
    fn a_start_in_slight_contact_gives_a_timed_motion() {
        // A plate under the flange, as deep in contact with it as allowed.
        let mut plate = object("plate", [0.3, 0.3, 0.02], [0.26, 0.0, 0.1]);
        let height = |plate: &ObjectConfig, setup: &PlanningScene| {
            let world = setup.world.snapshot();
            let depth = crate::collision::ExactChecker::new(world, Default::default());
            let contacts = crate::collision::CollisionChecker::contacts(&mut { depth }, &HOME);
            (plate.pose.translation.z, contacts.first().map_or(0.0, |contact| -contact.distance))
        };
        let mut setup = yourarm(vec![plate.clone()]);
        while height(&plate, &setup).1 < 0.001 {
            plate.pose.translation.z += 0.001;
            assert!(plate.pose.translation.z < 0.5, "the arm is never touched");
            setup = yourarm(vec![plate.clone()]);
        }
        let planner = PlannerThread::start(setup, TIMEOUT).unwrap();
        let mut up = turn(0.0, 0.3, 0);
        up.goals = vec![(0, Goal::Joints(vec![0.3, -0.6, 0.6, 0.0, 0.8, 0.0]))];
        let found = found(&planner, 1, up);
        assert_eq!(found.path[0], HOME);
        // An unchanged world leaves it valid.
        planner.revalidate(found.clone(), vec![HOME.to_vec()], Stop::never())().unwrap();
        let stone = object("stone", [0.1, 0.1, 0.1], [0.25, 0.06, 0.42]);
        planner.world(|world| world.add(super::super::planning_scene::obstacle(&stone).unwrap())).unwrap();
        let failure = planner.revalidate(found, vec![HOME.to_vec()], Stop::never())().unwrap_err();
        assert!(failure.what.contains("obstacle \"stone\""), "{failure:?}");
    }
}

//! The planner's thread: takes one request at a time, can be cancelled at once, keeps the newest plans. A request that
//! panics, or that does not end when its time is over, costs that request only: what hangs is left behind, and the next
//! request gets a thread of its own.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, Sender, channel};
use std::sync::{Arc, Mutex};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use super::ahead::{Blocked, look_ahead};
use super::idle::Measured;
use super::review::review;
use super::setup::Setup;
use super::solve::{Failure, Found, Request, solve};
use crate::collision::Stop;
use crate::collision::world::World;
use crate::sync::lock;

/// Plans that are kept.
const KEPT: usize = 16;
/// Stack of the planner's thread: collision checks of large meshes recurse.
const STACK: usize = 8 << 20;

/// How long a request may go on when its time is over or it is cancelled, before it is taken to hang.
const OVERTIME: Duration = Duration::from_secs(5);
/// So many threads that hang are left behind before nothing new is begun.
const MAX_HANGING: usize = 4;
/// How long the last owner waits for the thread.
const FAREWELL: Duration = Duration::from_secs(2);

/// What answers a request: [`solve`], or what stands in its place.
pub type Solver = Arc<dyn Fn(&Setup, &World, &Request, &Stop) -> Result<Found, Failure> + Send + Sync>;

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
    /// When it must end.
    deadline: Instant,
}

impl Job {
    fn is_planning(&self) -> bool {
        matches!(self.progress, Progress::Planning(_))
    }
}

struct Order {
    id: u64,
    setup: Arc<Setup>,
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
    /// The same with the joints that are not planned where they were measured last.
    now: Mutex<Arc<Setup>>,
    /// The world and how often it was changed.
    world: Mutex<(World, u64)>,
    shared: Arc<Shared>,
    solver: Solver,
    timeout: Duration,
    worker: Mutex<Worker>,
}

/// The thread that plans.
struct Worker {
    /// Dropped to end it.
    orders: Option<Sender<Order>>,
    thread: Option<JoinHandle<()>>,
    /// How many before it hang.
    hanging: usize,
}

/// Why a request is not begun.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum NotBegun {
    /// Another one is being planned.
    #[error("the planner is busy with another request")]
    Busy,
    /// Too many before it never ended.
    #[error("the planner hangs in {MAX_HANGING} requests that never ended: a defect of the program")]
    Hangs,
}

impl Desk {
    /// Starts the thread.
    pub fn start(setup: Setup, timeout: Duration) -> std::io::Result<Self> {
        Self::with(setup, timeout, Arc::new(solve))
    }

    /// Starts the thread with what answers each request.
    pub fn with(setup: Setup, timeout: Duration, solver: Solver) -> std::io::Result<Self> {
        let world = Mutex::new((setup.world.clone(), 1));
        let (setup, shared) = (Arc::new(setup), Arc::new(Shared::default()));
        let worker = Mutex::new(Worker::start(&shared, &solver, 0)?);
        let now = Mutex::new(setup.clone());
        Ok(Self { setup, now, world, shared, solver, timeout, worker })
    }

    /// The robots.
    pub fn setup(&self) -> &Setup {
        &self.setup
    }

    /// The robots with the joints that are not planned where they were measured last.
    pub fn now(&self) -> Arc<Setup> {
        lock(&self.now).clone()
    }

    /// Takes note of where the joints that are not planned are.
    pub fn measured(&self, measured: &Measured) {
        let mut now = lock(&self.now);
        if let Some(changed) = now.with_idle_joints(measured) {
            *now = Arc::new(changed);
            lock(&self.world).1 += 1;
        }
    }

    /// Changes the world. Requests that are being planned keep the world that they began with.
    pub fn world<T>(&self, act: impl FnOnce(&mut World) -> T) -> T {
        let mut world = lock(&self.world);
        world.1 += 1;
        act(&mut world.0)
    }

    /// How often the world was changed.
    pub fn version(&self) -> u64 {
        lock(&self.world).1
    }

    /// Begins a request with this number. It ends by itself after `timeout`, or the planner's own.
    pub fn begin(&self, id: u64, request: Request, timeout: Option<Duration>) -> Result<(), NotBegun> {
        self.leave_what_hangs();
        let mut jobs = lock(&self.shared.jobs);
        if jobs.iter().any(Job::is_planning) {
            return Err(NotBegun::Busy);
        }
        let worker = lock(&self.worker);
        let Some(orders) = &worker.orders else { return Err(NotBegun::Hangs) };
        let (now, request) = (Instant::now(), Arc::new(request));
        let deadline = now + timeout.unwrap_or(self.timeout);
        let cancelled = Arc::new(AtomicBool::new(false));
        let stop = Stop::new(Some(deadline), Some(cancelled.clone()));
        *lock(&self.shared.cancel) = Some(cancelled);
        jobs.push_back(Job { id, request: request.clone(), progress: Progress::Planning(now), deadline });
        if jobs.len() > KEPT {
            jobs.pop_front();
        }
        let order = Order { id, setup: self.now(), request, world: lock(&self.world).0.clone(), stop };
        // The thread ends with this sender only.
        let _ = orders.send(order);
        Ok(())
    }

    /// Ends the request that is being planned, if there is one. `true`: there was.
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

    /// Forgets all plans: their numbers were given by a run that is gone.
    pub fn forget(&self) {
        self.cancel();
        lock(&self.shared.jobs).retain(Job::is_planning);
    }

    /// Fails the request that goes on long after it should have ended, and gives the next one a thread of its own.
    fn leave_what_hangs(&self) {
        let mut jobs = lock(&self.shared.jobs);
        let hangs = |job: &&mut Job| job.is_planning() && job.deadline.elapsed() > OVERTIME;
        let Some(job) = jobs.iter_mut().find(hangs) else { return };
        let Progress::Planning(since) = job.progress else { return };
        let failure = Failure::new("the planner did not end when its time was over: a defect of the program");
        job.progress = Progress::Failed(failure, since.elapsed());
        let mut worker = lock(&self.worker);
        let hanging = worker.hanging + 1;
        let fresh = (hanging < MAX_HANGING).then(|| Worker::start(&self.shared, &self.solver, hanging));
        *worker = match fresh {
            Some(Ok(fresh)) => fresh,
            _ => Worker { orders: None, thread: None, hanging },
        };
    }

    /// Checks a plan's motion in the world as it is now, with all robots where they are now [rad]: work for another
    /// thread, because it takes as long as it takes.
    pub fn review(
        &self,
        found: Arc<Found>,
        positions: Vec<Vec<f64>>,
        stop: Stop,
    ) -> impl FnOnce() -> Result<(), Failure> + Send + use<> {
        let (setup, world) = (self.now(), lock(&self.world).0.clone());
        move || review(&setup, &world, &found, &positions, &stop)
    }

    /// Looks at the rest of a motion under way, from `elapsed` [s] on, in the world as it is now: work for another
    /// thread, which may take until `stop`.
    pub fn look_ahead(
        &self,
        found: Arc<Found>,
        positions: Vec<Vec<f64>>,
        elapsed: f64,
        stop: Stop,
    ) -> impl FnOnce() -> Result<Option<Blocked>, Failure> + Send + use<> {
        let (setup, world) = (self.now(), lock(&self.world).0.clone());
        move || look_ahead(&setup, &world, &found, &positions, elapsed, &stop)
    }

    /// A request by its number.
    pub fn job(&self, id: u64) -> Option<Job> {
        self.leave_what_hangs();
        lock(&self.shared.jobs).iter().rev().find(|job| job.id == id).cloned()
    }

    /// The newest request, or the newest that led to a motion.
    pub fn newest(&self, found: bool) -> Option<Job> {
        self.leave_what_hangs();
        let jobs = lock(&self.shared.jobs);
        jobs.iter().rev().find(|job| !found || matches!(job.progress, Progress::Found(..))).cloned()
    }
}

impl Worker {
    fn start(shared: &Arc<Shared>, solver: &Solver, hanging: usize) -> std::io::Result<Self> {
        let (orders, receiver) = channel();
        let (shared, solver) = (shared.clone(), solver.clone());
        let thread = std::thread::Builder::new()
            .name("planner".into())
            .stack_size(STACK)
            .spawn(move || work(&solver, &shared, &receiver))?;
        Ok(Self { orders: Some(orders), thread: Some(thread), hanging })
    }
}

impl Drop for Desk {
    fn drop(&mut self) {
        self.cancel();
        let mut worker = lock(&self.worker);
        worker.orders = None;
        let Some(thread) = worker.thread.take() else { return };
        let began = Instant::now();
        while !thread.is_finished() && began.elapsed() < FAREWELL {
            std::thread::sleep(Duration::from_millis(1));
        }
        // One that hangs is left behind: it must not keep the arms from being released.
        if thread.is_finished() {
            let _ = thread.join();
        }
    }
}

fn work(solver: &Solver, shared: &Shared, orders: &Receiver<Order>) {
    while let Ok(order) = orders.recv() {
        let began = Instant::now();
        let outcome =
            catch_unwind(AssertUnwindSafe(|| solver(&order.setup, &order.world, &order.request, &order.stop)));
        let took = began.elapsed();
        let progress = match outcome {
            Ok(Ok(found)) => Progress::Found(Arc::new(found), took),
            Ok(Err(failure)) => Progress::Failed(failure, took),
            Err(_) => {
                Progress::Failed(Failure::new("the planner failed at this request: a defect of the program"), took)
            }
        };
        if let Some(job) = lock(&shared.jobs).iter_mut().find(|job| job.id == order.id && job.is_planning()) {
            job.progress = progress;
        }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use nalgebra::Isometry3;

    use super::super::config::{ObjectConfig, ObjectShape, PlannerConfig, RobotConfig};
    use super::super::solve::Goal;
    use super::*;

    const HOME: [f64; 6] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];
    /// Far more than anything here takes, on a machine that is busy with other things too.
    const PATIENCE: Duration = Duration::from_secs(20);

    fn object(name: &str, size: [f64; 3], at: [f64; 3]) -> ObjectConfig {
        let pose = Isometry3::translation(at[0], at[1], at[2]);
        ObjectConfig { name: name.into(), shape: ObjectShape::Box(size), pose, padding: 0.0 }
    }

    fn yourarm(objects: Vec<ObjectConfig>) -> Setup {
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
        Setup::load(&PlannerConfig { timeout: Duration::from_secs(60), padding: 0.003, robots: vec![robot], objects })
            .unwrap()
    }

    /// Walls that no search gets around in the time of these tests.
    fn walled() -> Setup {
        let wall = |name, x| object(name, [2.0, 0.02, 4.0], [x, 0.0, 0.0]);
        yourarm(vec![wall("front", 1.16), wall("back", -1.16)])
    }

    fn turn(from: f64, to: f64, seed: u64) -> Request {
        let at = |angle| [&[angle], &HOME[1..]].concat();
        Request { goals: vec![(0, Goal::Joints(at(to)))], positions: vec![at(from)], speed: 0.5, seed }
    }

    fn outcome(desk: &Desk, id: u64) -> Progress {
        let began = Instant::now();
        loop {
            let progress = desk.job(id).unwrap().progress;
            if !matches!(progress, Progress::Planning(_)) {
                return progress;
            }
            assert!(began.elapsed() < PATIENCE, "request {id} does not end");
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    fn found(desk: &Desk, id: u64, request: Request) -> Arc<Found> {
        desk.begin(id, request, None).unwrap();
        match outcome(desk, id) {
            Progress::Found(found, _) => found,
            other => panic!("{other:?}"),
        }
    }

    #[test]
    fn a_panic_costs_one_request() {
        let breaks = |setup: &Setup, world: &World, request: &Request, stop: &Stop| {
            assert!(request.seed != 13, "a defect");
            solve(setup, world, request, stop)
        };
        let desk = Desk::with(yourarm(Vec::new()), PATIENCE, Arc::new(breaks)).unwrap();
        found(&desk, 1, turn(0.0, 0.5, 0));
        desk.begin(2, turn(0.0, 0.5, 13), None).unwrap();
        let failed = outcome(&desk, 2);
        assert!(matches!(&failed, Progress::Failed(f, _) if f.what.contains("a defect of the program")), "{failed:?}");
        found(&desk, 3, turn(0.0, 0.5, 0));
        assert_eq!(desk.newest(true).unwrap().id, 3);
        assert!(matches!(desk.job(1).unwrap().progress, Progress::Found(..)));
    }

    #[test]
    fn a_request_that_never_ends_costs_one_request_and_not_the_end_of_its_desk() {
        let hangs = |setup: &Setup, world: &World, request: &Request, stop: &Stop| {
            if request.seed != 13 {
                return solve(setup, world, request, stop);
            }
            loop {
                std::thread::sleep(Duration::from_millis(50)); // and never looks whether it shall stop
            }
        };
        let desk = Desk::with(yourarm(Vec::new()), PATIENCE, Arc::new(hangs)).unwrap();
        desk.begin(1, turn(0.0, 0.5, 13), Some(Duration::from_millis(10))).unwrap();
        assert_eq!(desk.begin(2, turn(0.0, 0.5, 0), None), Err(NotBegun::Busy));
        let failed = outcome(&desk, 1);
        assert!(matches!(&failed, Progress::Failed(f, took) if f.what.contains("did not end") && *took > OVERTIME));
        found(&desk, 2, turn(0.0, 0.5, 0));
        desk.begin(3, turn(0.0, 0.5, 13), None).unwrap();
        let began = Instant::now();
        drop(desk);
        assert!(began.elapsed() < PATIENCE / 2);
    }

    #[test]
    fn the_same_request_gives_the_same_plan() {
        let post = object("post", [0.04, 0.04, 0.4], [0.22, 0.12, 0.2]);
        let desk = Desk::start(yourarm(vec![post]), PATIENCE).unwrap();
        let first = found(&desk, 1, turn(0.0, 1.0, 7));
        let again = found(&desk, 2, turn(0.0, 1.0, 7));
        assert!(first.path.len() > 2, "the straight way is not free: {:?}", first.path);
        assert_eq!((&first.path, &first.trajectory), (&again.path, &again.trajectory));
        assert_ne!(first.path, found(&desk, 3, turn(0.0, 1.0, 8)).path);
    }

    #[test]
    fn time_is_kept() {
        let desk = Desk::start(walled(), PATIENCE).unwrap();
        // Far less than a way around the walls takes to find.
        let limit = Duration::from_millis(10);
        // One look more than the time allows; a busy machine is given several tries to show it.
        let late = (1..=8).map(|id| {
            desk.begin(id, turn(1.5, -1.5, id), Some(limit)).unwrap();
            match outcome(&desk, id) {
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
    fn a_request_is_cancelled_and_keeps_the_desk_until_then() {
        let desk = Desk::start(walled(), PATIENCE).unwrap();
        assert!(!desk.cancel());
        desk.begin(1, turn(1.5, -1.5, 0), None).unwrap();
        assert_eq!(desk.begin(2, turn(1.5, 1.4, 0), None), Err(NotBegun::Busy));
        assert!(desk.cancel());
        let cancelled = outcome(&desk, 1);
        assert!(
            matches!(&cancelled, Progress::Failed(f, took) if f.cancelled && *took < PATIENCE / 4),
            "{cancelled:?}"
        );
        found(&desk, 2, turn(1.5, 1.4, 0));
        // Its last owner does not wait for what is being planned.
        desk.begin(3, turn(1.5, -1.5, 0), None).unwrap();
        let began = Instant::now();
        drop(desk);
        assert!(began.elapsed() < PATIENCE / 4);
    }

    #[test]
    fn who_is_there_already_stands_for_a_moment() {
        let desk = Desk::start(yourarm(Vec::new()), PATIENCE).unwrap();
        let found = found(&desk, 1, turn(0.5, 0.5, 0));
        assert!(found.trajectory.validate().is_ok() && found.trajectory.duration() < 0.2);
        assert!(found.trajectory.points.iter().all(|point| point.positions == found.path[0]));
    }

    #[test]
    fn a_start_that_touches_a_little_is_left_in_a_timed_motion() {
        // A plate under the flange's end of the arm, as far into it as may be.
        let mut plate = object("plate", [0.3, 0.3, 0.02], [0.26, 0.0, 0.1]);
        let height = |plate: &ObjectConfig, setup: &Setup| {
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
        let desk = Desk::start(setup, PATIENCE).unwrap();
        let mut up = turn(0.0, 0.3, 0);
        up.goals = vec![(0, Goal::Joints(vec![0.3, -0.6, 0.6, 0.0, 0.8, 0.0]))];
        let found = found(&desk, 1, up);
        assert_eq!(found.path[0], HOME);
        // And it is still free when it is looked at again, where nothing has changed.
        desk.review(found.clone(), vec![HOME.to_vec()], Stop::never())().unwrap();
        let stone = object("stone", [0.1, 0.1, 0.1], [0.25, 0.06, 0.42]);
        desk.world(|world| world.add(super::super::setup::obstacle(&stone).unwrap())).unwrap();
        let failure = desk.review(found, vec![HOME.to_vec()], Stop::never())().unwrap_err();
        assert!(failure.what.contains("obstacle \"stone\""), "{failure:?}");
    }
}

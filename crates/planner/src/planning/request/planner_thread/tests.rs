//! Tests of the planner thread with the built-in robot.

use nalgebra::Isometry3;

use super::*;
use crate::planning::request::pipeline::Goal;
use crate::planning::scene::config::{ObjectConfig, ObjectShape, PlannerConfig, RobotConfig};
use crate::planning::search::level::Level;

const HOME: [f64; 6] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];
/// Far longer than any of these tests takes, also on a busy machine.
const TIMEOUT: Duration = Duration::from_secs(20);

fn object(name: &str, size: [f64; 3], at: [f64; 3]) -> ObjectConfig {
    let pose = Isometry3::translation(at[0], at[1], at[2]);
    ObjectConfig { name: name.into(), shape: ObjectShape::Box(size), pose, padding: 0.0 }
}

fn yourarm(objects: Vec<ObjectConfig>) -> PlanningScene {
    PlanningScene::load(&PlannerConfig {
        proofs: None,
        timeout: Duration::from_secs(60),
        padding: 0.003,
        robots: vec![RobotConfig::yourarm()],
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
    PlanRequest {
        goals: vec![(0, Goal::Joints(at(to)))],
        positions: vec![at(from)],
        speed: 0.5,
        seed,
        level: Level::default(),
        refine: 0,
        through: Vec::new(),
        blend: 0.0,
        tcp_speed: None,
        touch: Vec::new(),
        by_number: false,
    }
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
    assert_eq!(planner.newest().unwrap().id, 3);
    found(&planner, 4, PlanRequest { by_number: true, ..turn(0.0, 0.5, 0) });
    assert_eq!(planner.newest_without_number().unwrap().id, 3);
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
    let limit = Duration::from_micros(300);
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
    assert!(!planner.cancel(None));
    planner.begin(1, turn(1.5, -1.5, 0), None).unwrap();
    assert_eq!(planner.begin(2, turn(1.5, 1.4, 0), None), Err(BeginError::Busy));
    assert!(!planner.cancel(Some(2)), "the plan of another client");
    assert!(planner.newest().unwrap().is_planning());
    assert!(planner.cancel(Some(1)));
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
    assert!(found.trajectory.points.iter().all(|point| point.positions[..] == found.path[0]));
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
    planner.world(|world| world.add(crate::planning::scene::planning_scene::obstacle(&stone).unwrap())).unwrap();
    let failure = planner.revalidate(found, vec![HOME.to_vec()], Stop::never())().unwrap_err();
    assert!(failure.what.contains("obstacle \"stone\""), "{failure:?}");
}

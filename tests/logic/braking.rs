//! Planned motions with an obstacle that appears in their way, without real time: each is cancelled as a run cancels
//! it, brakes along its path in the coordinator's ticks, and keeps the padding until it is at rest. `DIMOS_BRAKING` is
//! the number of motions (80), `SEED` repeats a run.

use dimos::joint::{CommandLimits, ControlMode, JointLimits, joints_of};
use std::collections::VecDeque;
use std::time::Duration;

use dimos::arm::{ArmState, Link, Supervision, VelocitySource};
use dimos::clock::Mono;
use dimos::collision::{CheckSettings, CollisionChecker, ExactChecker, Stop};
use dimos::control::config::{ArmConfig, CONFIG_VERSION, CoordinatorConfig, TaskConfig, TaskKind, TrajectoryParams};
use dimos::control::coordinator::{Coordinator, TickTime};
use dimos::control::request::{Envelope, Motion, Request};
use dimos::control::task_spec::TaskTable;
use dimos::planning::request::ahead::{look_ahead, rests_before};
use dimos::planning::request::pipeline::{self, Goal, PlannedMotion, solve};
use dimos::planning::scene::config::{ObjectConfig, ObjectShape};
use dimos::planning::scene::planning_scene::{PlanningScene, obstacle};
use dimos::planning::search::level::Level;
use dimos::robot::random::Random;
use dimos::runtime::Run;
use dimos::telemetry::TaskState;
use dimos::trajectory::{Cursor, Sample, Spline};

/// Obstacles that are put into the way of one motion.
const EACH: usize = 20;
const PERIOD: Duration = Duration::from_millis(10);
const TICK: f64 = 0.01;
const DOF: usize = 6;
const ACCELERATION: f64 = 2.0;
const JERK: f64 = 100.0;

fn config() -> CoordinatorConfig {
    let limits = JointLimits { acceleration_max: vec![ACCELERATION; DOF], ..JointLimits::uniform(DOF, 3.2, 1.0) };
    let arm = ArmConfig {
        tool: None,
        effort: None,
        name: "arm".into(),
        dof: DOF,
        limits: limits.with_defaults(),
        modes: vec![ControlMode::ServoPosition],
        gripper: false,
        gripper_info: Default::default(),
        own_velocity: Vec::new(),
        read_period: Duration::from_millis(10),
        write_period: Duration::from_millis(10),
        supervision: Supervision { stale_after: Duration::from_millis(50), ..Supervision::default() },
    };
    let task = TaskConfig {
        name: "traj_arm".into(),
        kind: TaskKind::new("trajectory", &TrajectoryParams { path_tolerance: 0.1, ..TrajectoryParams::default() }),
        joints: (0..DOF as u16).collect(),
        priority: 10,
        auto_start: false,
    };
    CoordinatorConfig { version: CONFIG_VERSION, rate: 100.0, arms: vec![arm], tasks: vec![task] }
}

/// The coordinator on a virtual clock, with an arm that follows each command one period later.
struct Virtual {
    coordinator: Coordinator,
    arm: ArmState,
    now: Mono,
    inbox: VecDeque<Envelope>,
    /// State of the task after the last tick, and the elapsed time of its motion [s].
    task: (TaskState, f64),
}

impl Virtual {
    /// Returns a run that executes a motion from its start.
    fn executing(found: &PlannedMotion) -> Self {
        let start: Vec<f64> = found.path[0].clone();
        let arm = ArmState {
            dof: DOF,
            position: joints_of(&start),
            velocity_source: VelocitySource::Measured,
            mode: ControlMode::ServoPosition,
            enabled: true,
            link: Link::Up,
            ..ArmState::default()
        };
        let coordinator = Coordinator::new(&config(), TaskTable::builtin().build(&config().tasks).unwrap());
        let task = (TaskState::Idle, 0.0);
        let mut run = Self { coordinator, arm, now: Mono(1_000_000_000), inbox: VecDeque::new(), task };
        run.step();
        run.ask(Request::Enabled { arm: 0, outside: false });
        (0..30).for_each(|_| run.step());
        let joints = (0..DOF as u16).collect();
        let motion = Box::new(Motion { id: 7, joints, spline: Spline::new(&found.trajectory).unwrap(), until: None });
        run.ask(Request::Execute { task: 0, motion });
        run.step();
        assert_eq!(run.task.0, TaskState::Executing);
        run
    }

    fn ask(&mut self, request: Request) {
        self.inbox.push_back(Envelope { id: 7, origin: None, request });
    }

    fn step(&mut self) {
        self.arm.seq += 1;
        self.arm.stamp = self.now.before(Duration::from_micros(1500));
        let next = self.now.after(PERIOD);
        let time = TickTime { now: self.now, next, skipped: 0, late_ns: 20_000, woke_late_ns: 20_000 };
        let states = [self.arm];
        let output = self.coordinator.tick(time, &states, || self.inbox.pop_front());
        let command = output.commands[0];
        self.task = (output.tasks[0].state, output.tasks[0].elapsed);
        if let Some(mode) = command.mode {
            (self.arm.mode, self.arm.written) = (mode, command.seq);
            for j in 0..DOF {
                let before = self.arm.position[j];
                self.arm.position[j] = command.values[j];
                self.arm.velocity[j] = (command.values[j] - before) / TICK;
            }
        }
        self.now = next;
    }

    fn position(&self) -> Vec<f64> {
        self.arm.position.iter().take(DOF).copied().collect()
    }

    fn rests(&self) -> bool {
        self.arm.velocity.iter().take(DOF).all(|v| v.abs() < 1e-9)
    }
}

fn at(found: &PlannedMotion, time: f64) -> Vec<f64> {
    let spline = Spline::new(&found.trajectory).unwrap();
    let mut samples = vec![Sample::default(); DOF];
    spline.sample(time, &mut Cursor::default(), &mut samples);
    samples.iter().map(|sample| sample.position).collect()
}

/// Plans a motion between two random free configurations, if there is one.
fn motion(setup: &PlanningScene, checker: &mut ExactChecker, random: &mut Random) -> Option<PlannedMotion> {
    let mut random_free = || {
        (0..1000).find_map(|_| {
            let inside = |l: &dimos::robot::model::Limits| random.between(l.lower.max(-2.5), l.upper.min(2.5));
            let q: Vec<f64> = setup.robots[0].limits.iter().map(inside).collect();
            checker.is_free(&q).then_some(q)
        })
    };
    let (start, goal) = (random_free()?, random_free()?);
    let (speed, seed) = (random.between(0.2, 1.0), random.bits());
    let request = pipeline::PlanRequest {
        goals: vec![(0, Goal::Joints(goal))],
        positions: vec![start],
        speed,
        seed,
        level: Level::default(),
        refine: 0,
        through: Vec::new(),
        blend: 0.0,
        tcp_speed: None,
        touch: Vec::new(),
        by_number: false,
    };
    let stop = Stop::new(Some(std::time::Instant::now() + Duration::from_secs(2)), None);
    solve(setup, &setup.world, &request, &stop).ok().filter(|found| found.trajectory.duration() > 0.5)
}

/// Returns a random obstacle near a link of the arm in a configuration.
fn random_obstacle(setup: &PlanningScene, q: &[f64], random: &mut Random) -> ObjectConfig {
    let robot = &setup.robots[0];
    let kinematics = &robot.body.kinematics;
    let mut frames = kinematics.frames();
    kinematics.forward_from(&robot.body.base, q, &mut frames);
    let link = 2 + random.below(robot.model.links.len() - 2);
    let place = kinematics.link_frame(link, &frames).translation;
    let mut near = || random.between(-0.06, 0.06);
    let pose = nalgebra::Isometry3::translation(place.x + near(), place.y + near(), place.z + near());
    let shape = match random.below(3) {
        0 => ObjectShape::Sphere(random.between(0.005, 0.08)),
        1 => ObjectShape::Box([0; 3].map(|_| random.between(0.01, 0.2))),
        _ => ObjectShape::Cylinder([random.between(0.005, 0.08), random.between(0.01, 0.3)]),
    };
    ObjectConfig { name: "late".into(), shape, pose, padding: 0.0 }
}

/// Returns the distance of the arm from the obstacle in a configuration, if it is less than the padding [m].
fn too_close(judge: &ExactChecker, q: &[f64]) -> Option<f64> {
    let mut judge = judge.clone();
    let near = judge.closer_than_padding(q).into_iter().find(|(_, contact)| contact.other == "late");
    near.map(|(_, contact)| contact.distance)
}

/// Returns the planner's scene, with the limits that a run sets for its arm.
fn setup() -> PlanningScene {
    let loaded = Run::from_name("yourarm-planner").unwrap().check();
    let setup = PlanningScene::load(loaded.blueprint.unwrap().planner.as_ref().unwrap()).unwrap();
    let bounds = CommandLimits {
        position: [-3.0, 3.0],
        velocity: 3.0,
        acceleration: ACCELERATION,
        jerk: JERK,
        tcp_velocity: None,
    };
    setup.within(&(1..=DOF).map(|j| (format!("arm_joint{j}"), bounds)).collect()).unwrap()
}

#[test]
fn planned_motions_keep_the_jerk_limit_in_what_is_commanded() {
    let (setup, mut random) = (setup(), Random::new(4));
    let mut checker = ExactChecker::new(setup.world.snapshot(), CheckSettings::default());
    let mut motions = 0;
    while motions < 10 {
        let Some(found) = motion(&setup, &mut checker, &mut random) else { continue };
        motions += 1;
        let mut run = Virtual::executing(&found);
        let mut commanded = vec![run.position(); 3];
        while run.task.0 == TaskState::Executing {
            run.step();
            commanded.push(run.position());
        }
        // Steps of the acceleration between ticks; the last tick already belongs to the hold.
        for four in commanded[..commanded.len() - 1].windows(4) {
            for (j, a) in four[0].iter().enumerate() {
                let [b, c, d] = [1, 2, 3].map(|k: usize| four[k][j]);
                let step = (d - 3.0 * c + 3.0 * b - a) / (TICK * TICK);
                assert!(step.abs() <= JERK * TICK * 1.02 + 1e-6, "joint {j}: a step of {step} rad/s²");
            }
        }
    }
}

#[test]
fn cancelled_motions_brake_before_an_obstacle_in_their_way() {
    let number = |variable, otherwise| std::env::var(variable).ok().and_then(|s| s.parse().ok()).unwrap_or(otherwise);
    let (seed, cases) = (number("SEED", 9), number("DIMOS_BRAKING", 80) as usize);
    println!("SEED={seed}");
    let mut random = Random::new(seed);
    let setup = setup();
    assert!(setup.padding > 0.0);
    let mut checker = ExactChecker::new(setup.world.snapshot(), CheckSettings::default());
    let (mut held, mut too_late, mut beside, mut nearest) = (0, 0, 0, f64::INFINITY);
    while held < cases {
        let Some(found) = motion(&setup, &mut checker, &mut random) else { continue };
        let (spline, duration) = (Spline::new(&found.trajectory).unwrap(), found.trajectory.duration());
        for _ in 0..EACH {
            let moment = random.between(0.0, 0.8 * duration);
            let ahead = random.between((moment + 0.3).min(duration), duration);
            let thing = random_obstacle(&setup, &at(&found, ahead), &mut random);
            let mut world = setup.world.clone();
            world.add(obstacle(&thing).unwrap()).unwrap();
            let seen = look_ahead(&setup, &world, &found, &found.path[..1], moment, &Stop::never()).unwrap();
            let Some(blocked) = seen else {
                beside += 1;
                continue;
            };
            if !rests_before(blocked.free_until, &spline, &[ACCELERATION; DOF], moment + TICK, TICK) {
                too_late += 1;
                continue;
            }
            let mut run = Virtual::executing(&found);
            while run.task.1 < moment {
                run.step();
            }
            let judge = ExactChecker::new(world.snapshot(), CheckSettings::default()).with_padding(setup.padding);
            // The request takes a few ticks.
            (0..random.below(6)).for_each(|_| run.step());
            run.ask(Request::Cancel { task: Some(0) });
            run.step();
            let mut ticks = 0;
            while run.task.0 == TaskState::Cancelling || !run.rests() {
                run.step();
                ticks += 1;
                assert!(ticks < 1000, "it never rests: {:?}", run.task);
                if ticks % 10 == 0 {
                    let close = too_close(&judge, &run.position());
                    assert!(close.is_none(), "case {held} of SEED={seed}: {close:?} m on the way, {blocked:?}");
                }
            }
            assert_eq!(run.task.0, TaskState::Aborted);
            let close = too_close(&judge, &run.position());
            assert!(close.is_none(), "case {held} of SEED={seed}: rests {close:?} m from {thing:?}, {blocked:?}");
            nearest = f64::min(nearest, blocked.free_until - run.task.1);
            held += 1;
            if held == cases {
                break;
            }
        }
    }
    println!("{held} held, {too_late} inside the braking distance, {beside} not in the way; nearest {nearest:.3} s");
}

//! From a pose goal to an executable plan, through the socket: collision-free, timed, clearance included. The goals are
//! random, reachable and free, in a seeded world of obstacles, for every shipped blueprint with a planner; then with
//! point clouds, with a thousand boxes, and the check of a motion under way.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;
use std::time::{Duration, Instant};

use dimos::blueprint::names;
use dimos::collision::world::World;
use dimos::collision::{CheckSettings, CollisionChecker, ExactChecker, Stop};
use dimos::planning::request::ahead::look_ahead;
use dimos::planning::request::pipeline::{Goal as PlanningGoal, PlanRequest, solve};
use dimos::planning::scene::config::{ObjectConfig, ObjectShape};
use dimos::planning::scene::planning_scene::{PlanningScene, obstacle};
use dimos::robot::kinematics::pose;
use dimos::robot::random::Random;
use dimos::rpc::api::{
    Plan, PlanGoal, Planner, Planning, PlanningReport, PoseSpec, ShapeSpec, State, WorldAdd, WorldObject,
};
use dimos::rpc::client::Client;
use dimos::runtime::Run;
use nalgebra::Isometry3;

use super::Effort;
use super::support::measure::{Goal, Measure, figure, print, print_rows, quantile};
use super::support::run::LiveRun;

/// Obstacles around the first robot.
const OBSTACLES: usize = 8;
/// Smallest distance of the robots from obstacles at the start, and at goals [m].
const ROOM: f64 = 0.01;
/// Pause between questions for the result.
const PAUSE: Duration = Duration::from_micros(100);
/// Blueprint of the parts with clouds and boxes.
const CELL: &str = "yourarm-planner";
/// Stages of a request, by their names in the reply.
const STAGES: [&str; 5] = ["ik", "search", "shorten", "timing", "clearance"];

/// A run with a planner, and the same scene here to choose goals.
struct Cell {
    run: LiveRun,
    client: Client,
    scene: PlanningScene,
    world: World,
    /// Positions of all robots [rad].
    start: Vec<Vec<f64>>,
    /// Limits of the first robot's joints [rad].
    limits: Vec<[f64; 2]>,
    random: Random,
}

impl Cell {
    fn up(blueprint: &str, seed: u64) -> Result<Self, String> {
        let text = |e: &dyn std::fmt::Display| e.to_string();
        let loaded = Run::from_name(blueprint).map_err(|e| text(&e))?.check();
        let config = loaded.blueprint.and_then(|b| b.planner).ok_or("no planner")?;
        let scene = PlanningScene::load(&config)?;
        let mut run = LiveRun::start(blueprint, &["--sim"]).map_err(|e| text(&e))?;
        let mut client = run.client()?;
        let report = client.call(Planner {}).map_err(|e| text(&e))?;
        let bound = |[low, high]: &[Option<f64>; 2]| [low.unwrap_or(-3.1).max(-3.1), high.unwrap_or(3.1).min(3.1)];
        let limits = report.robots.first().ok_or("no robot")?.limits.iter().map(bound).collect();
        let start = positions(&mut client, &scene)?;
        Ok(Self { world: scene.world.clone(), run, client, scene, start, limits, random: Random::new(seed) })
    }

    /// Adds an obstacle unless a robot is close to it at the start; returns whether it was added.
    fn add(&mut self, object: ObjectConfig, shape: ShapeSpec) -> Result<bool, String> {
        let made = obstacle(&object)?;
        let mut alone = self.scene.world.clone();
        alone.clear();
        alone.add(made.clone()).map_err(|e| e.to_string())?;
        if !checker(&alone).is_free(&self.start.concat()) {
            return Ok(false);
        }
        let xyz = object.pose.translation.vector.into();
        let pose = PoseSpec { xyz, ..PoseSpec::default() };
        let added = WorldObject { name: object.name, shape, pose, padding: 0.0, held_by: None };
        self.client.call(WorldAdd(added)).map_err(|e| e.to_string())?;
        self.world.add(made).map_err(|e| e.to_string())?;
        Ok(true)
    }

    /// Adds a random box, sphere or cylinder around the first robot, with sizes up to `most` [m].
    fn add_random(&mut self, number: usize, most: f64) -> Result<(), String> {
        for _ in 0..1000 {
            let random = &mut self.random;
            let (turn, out) = (random.between(-3.1, 3.1), random.between(0.3, 0.8));
            let base = self.scene.robots[0].config.base_pose.translation.vector;
            let at = base + nalgebra::vector![out * turn.cos(), out * turn.sin(), random.between(0.05, 0.7)];
            let [a, b, c] = std::array::from_fn(|_| random.between(0.3 * most, most));
            let (shape, spec) = match number % 3 {
                0 => (ObjectShape::Box([a, b, c]), ShapeSpec::Box([a, b, c])),
                1 => (ObjectShape::Sphere(0.5 * a), ShapeSpec::Sphere(0.5 * a)),
                _ => (ObjectShape::Cylinder([0.5 * a, b]), ShapeSpec::Cylinder([0.5 * a, b])),
            };
            let pose = Isometry3::translation(at.x, at.y, at.z);
            if self.add(ObjectConfig { name: format!("thing{number}"), shape, pose, padding: 0.0 }, spec)? {
                return Ok(());
            }
        }
        Err("no place for an obstacle".into())
    }

    /// Returns random configurations of the first robot that touch nothing, the other robots where they are [rad].
    fn goals(&mut self, number: usize) -> Result<Vec<Vec<f64>>, String> {
        let mut goals = Vec::new();
        let mut checker = checker(&self.world);
        for _ in 0..1000 * number {
            let q: Vec<f64> = self.limits.iter().map(|[low, high]| self.random.between(*low, *high)).collect();
            let mut all = self.start.clone();
            all[0].clone_from(&q);
            if checker.is_free(&all.concat()) {
                goals.push(q);
            }
            if goals.len() == number {
                return Ok(goals);
            }
        }
        Err("hardly any configuration is free".into())
    }

    /// Plans to the poses of configurations, one after the other.
    fn plans(&mut self, goals: &[Vec<f64>]) -> Result<Figures, String> {
        let mut figures = Figures::default();
        let name = self.scene.robots[0].config.name.clone();
        for (seed, q) in goals.iter().enumerate() {
            let at = pose(&self.scene.robots[0].tcp_pose(q));
            let goal = PoseSpec {
                xyz: at.translation.vector.into(),
                quat: Some(at.rotation.coords.into()),
                ..PoseSpec::default()
            };
            let goal = PlanGoal { robot: name.clone(), pose: Some(goal), ..PlanGoal::default() };
            let began = Instant::now();
            let plan = Plan { goals: vec![goal], seed: seed as u64, timeout: Some(5.0), ..Plan::default() };
            let plan = self.client.call(plan).map_err(|e| e.to_string())?.plan;
            let report = loop {
                let report = self.client.call(Planning { plan }).map_err(|e| e.to_string())?;
                if report.state != "PLANNING" {
                    break report;
                }
                std::thread::sleep(PAUSE);
            };
            figures.add(began.elapsed(), &report);
        }
        Ok(figures)
    }
}

fn positions(client: &mut Client, scene: &PlanningScene) -> Result<Vec<Vec<f64>>, String> {
    let state = client.call(State {}).map_err(|e| e.to_string())?;
    let joints: Vec<_> = state.arms.iter().flat_map(|arm| &arm.joints).collect();
    let position = |name: &String| {
        let joint = joints.iter().find(|joint| joint.name == *name).ok_or("a joint is missing")?;
        joint.command.or(joint.position).ok_or("a position is missing")
    };
    let all = scene.robots.iter().map(|robot| robot.config.coordinator_joints.iter().map(position).collect());
    all.collect::<Result<_, &str>>().map_err(str::to_owned)
}

/// Returns a checker that keeps all robots at a distance from obstacles and other robots.
fn checker(world: &World) -> ExactChecker {
    ExactChecker::new(world.snapshot(), CheckSettings::default()).with_padding(ROOM)
}

/// What plans took [ms].
#[derive(Default)]
struct Figures {
    asked: usize,
    whole: Vec<f64>,
    planner: Vec<f64>,
    stages: [Vec<f64>; STAGES.len()],
    failed: Vec<String>,
}

impl Figures {
    fn add(&mut self, whole: Duration, report: &PlanningReport) {
        self.asked += 1;
        let Some(summary) = &report.summary else {
            self.failed.push(report.error.clone().unwrap_or_default());
            return;
        };
        self.whole.push(whole.as_secs_f64() * 1e3);
        self.planner.push(report.elapsed * 1e3);
        for (name, times) in STAGES.iter().zip(&mut self.stages) {
            times.push(summary.times.get(*name).copied().unwrap_or_default() * 1e3);
        }
    }

    fn row(&self, name: &str) -> Vec<String> {
        let at = |q| figure(quantile(&self.whole, q));
        let solved = format!("{}/{}", self.whole.len(), self.asked);
        let both = |times: &[f64]| format!("{} / {}", figure(quantile(times, 0.5)), figure(quantile(times, 0.95)));
        let stages = self.stages.iter().map(|times| both(times));
        [name.to_owned(), solved, at(0.5), at(0.95), at(0.99), both(&self.planner)].into_iter().chain(stages).collect()
    }
}

fn head() -> Vec<String> {
    let head = ["", "solved", "p50", "p95", "p99", "planner p50 / p95"];
    head.iter().chain(&STAGES).map(|name| (*name).to_owned()).collect()
}

/// Measures every shipped blueprint with a planner.
pub fn measure(effort: Effort) -> Result<(), String> {
    let mut rows = vec![head()];
    let mut failed = Vec::new();
    for name in names().into_iter().filter(|name| name.ends_with("-planner")) {
        let mut cell = Cell::up(&name, 1)?;
        (0..OBSTACLES).try_for_each(|number| cell.add_random(number, 0.15))?;
        let goals = cell.goals(effort.of(5, 300))?;
        let figures = cell.plans(&goals)?;
        rows.push(figures.row(&name));
        failed.extend(figures.failed.iter().map(|why| format!("{name}: {why}")));
    }
    print_rows(
        &format!("pose goal → executable plan, {OBSTACLES} obstacles around the arm [ms] (goal: p50 ≤ 1, p95 ≤ 5)"),
        rows,
    );
    failed.iter().for_each(|why| println!("  not solved: {why}"));
    Ok(())
}

/// Measures plans with point clouds and many boxes, and the check of a motion under way.
pub fn worlds(effort: Effort) -> Result<(), String> {
    let mut rows = vec![head()];
    let mut adding = Vec::new();
    for (points, limit) in [(10_000, f64::INFINITY), (effort.of(50_000, 1_000_000), 200.0)] {
        let mut cell = Cell::up(CELL, 2)?;
        let file = cell.run.folder().join("cloud.ply");
        let random = &mut cell.random;
        let cloud: Vec<[f64; 3]> = (0..points).map(|_| on_walls(random)).collect();
        write_ply(&file, &cloud).map_err(|e| e.to_string())?;
        let object = ObjectConfig {
            name: "cloud".into(),
            shape: ObjectShape::Cloud(file.clone()),
            pose: Isometry3::identity(),
            padding: 0.0,
        };
        let began = Instant::now();
        let path = file.display().to_string();
        let added = WorldObject {
            name: "cloud".into(),
            shape: ShapeSpec::Cloud(path),
            pose: PoseSpec::default(),
            padding: 0.0,
            held_by: None,
        };
        cell.client.call(WorldAdd(added)).map_err(|e| e.to_string())?;
        let took = began.elapsed().as_secs_f64() * 1e3;
        adding.push(Measure::new(format!("adding {points} points"), "ms", vec![took]).goal(Goal::AtMost(limit)));
        cell.world.add(obstacle(&object)?).map_err(|e| e.to_string())?;
        let goals = cell.goals(effort.of(5, 200))?;
        rows.push(cell.plans(&goals)?.row(&format!("{points} points")));
        if points == 10_000 {
            let times = under_way(&mut cell, &goals, effort.of(5, 100), false)?;
            adding.push(Measure::new("check of the rest of a motion", "ms", times).goal(Goal::AtMost(1.0)));
            let times = under_way(&mut cell, &goals, effort.of(5, 100), true)?;
            adding.push(Measure::new("the same, the first after a change", "ms", times).goal(Goal::AtMost(1.0)));
        }
    }
    let mut cell = Cell::up(CELL, 3)?;
    (0..effort.of(50, 1000)).try_for_each(|number| cell.add_random(3 * number, 0.05))?;
    let goals = cell.goals(effort.of(5, 100))?;
    rows.push(cell.plans(&goals)?.row("1000 boxes, cluttered"));
    print_rows("pose goal → executable plan [ms] (goals: p50 ≤ 3 with 10 000 points, 50 with 1 M, 5 with boxes)", rows);
    print("changes of the world", &adding);
    Ok(())
}

/// A point of a table and of the walls of a room around the arm [m], with noise.
fn on_walls(random: &mut Random) -> [f64; 3] {
    let (a, b, noise) = (random.between(-0.9, 0.9), random.between(0.0, 1.2), random.between(-0.004, 0.004));
    match random.below(5) {
        0 => [0.9 + noise, a, b],
        1 => [-0.9 + noise, a, b],
        2 => [a, 0.9 + noise, b],
        3 => [a, -0.9 + noise, b],
        // A box on the table in front of the arm.
        _ => [0.45 + 0.1 * a, 0.3 + 0.1 * b, 0.2 + noise],
    }
}

fn write_ply(file: &Path, points: &[[f64; 3]]) -> std::io::Result<()> {
    let mut out = BufWriter::new(File::create(file)?);
    write!(out, "ply\nformat binary_little_endian 1.0\nelement vertex {}\n", points.len())?;
    out.write_all(b"property float x\nproperty float y\nproperty float z\nend_header\n")?;
    points.iter().flatten().try_for_each(|x| out.write_all(&(*x as f32).to_le_bytes()))
}

/// Times the check of the rest of planned motions in the world of a cell, from a tenth of their duration on [ms];
/// `changed`: each the first one after an obstacle was moved that is in nothing's way.
fn under_way(cell: &mut Cell, goals: &[Vec<f64>], number: usize, changed: bool) -> Result<Vec<f64>, String> {
    let mut times = Vec::new();
    for (k, q) in goals.iter().take(number).enumerate() {
        let goal = PlanningGoal::Joints(q.clone());
        let request = PlanRequest { positions: cell.start.clone(), ..PlanRequest::new(Vec::new(), goal) };
        let deadline = Stop::new(Some(Instant::now() + Duration::from_secs(5)), None);
        let Ok(motion) = solve(&cell.scene, &cell.world, &request, &deadline) else { continue };
        let elapsed = 0.1 * motion.trajectory.duration();
        if changed {
            let pose = Isometry3::translation(5.0, 0.01 * k as f64, 0.0);
            let shape = ObjectShape::Box([0.1; 3]);
            let moved = ObjectConfig { name: "moved".into(), shape, pose, padding: 0.0 };
            cell.world.put(obstacle(&moved)?).map_err(|e| e.to_string())?;
        }
        let began = Instant::now();
        let blocked = look_ahead(&cell.scene, &cell.world, &motion, &cell.start, elapsed, &Stop::never());
        times.push(began.elapsed().as_secs_f64() * 1e3);
        if let Some(blocked) = blocked.map_err(|failure| failure.what)? {
            return Err(format!("a motion that was just planned is blocked: {}", blocked.what));
        }
    }
    Ok(times)
}

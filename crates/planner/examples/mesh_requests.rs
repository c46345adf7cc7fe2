//! Measures how long requests of an arm with its own meshes compute: from a random free configuration to another, in an
//! empty world and between obstacles.
//!
//! ```sh
//! cargo run --release -p dimos-planner --example mesh_requests -- arm.urdf tool0 --package arm_description=DIR
//! ```
//!
//! `--joints a,b`: the planned ones, otherwise all; `--goals N` per world, `--worlds N`, `--level LEVEL`, `--proofs
//! DIR`.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use dimos_planner::collision::allowed_pairs::sample;
use dimos_planner::collision::{CheckSettings, CollisionChecker, ExactChecker, Stop};
use dimos_planner::planning::request::pipeline::{Goal, PlanRequest, solve};
use dimos_planner::planning::scene::config::{ObjectConfig, ObjectShape, PlannerConfig, RobotConfig};
use dimos_planner::planning::scene::planning_scene::PlanningScene;
use dimos_planner::planning::search::level::Level;
use dimos_robot::Source;
use dimos_robot::random::Random;
use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

/// Longest request [s].
const TIMEOUT: Duration = Duration::from_secs(20);
/// Obstacles of a world that is not empty.
const OBSTACLES: usize = 9;

struct Given {
    robot: RobotConfig,
    goals: usize,
    worlds: u64,
    level: Level,
    proofs: Option<PathBuf>,
}

fn given() -> Result<Given, String> {
    let mut arguments = std::env::args().skip(1);
    let mut next = |what: &str| arguments.next().ok_or(format!("{what} is missing"));
    let (urdf, tip) = (PathBuf::from(next("URDF")?), next("the end effector's link")?);
    let (mut packages, mut joints, mut proofs) = (BTreeMap::new(), None, None);
    let (mut goals, mut worlds, mut level) = (100, 10, Level::default());
    while let Ok(option) = next("") {
        let value = next(&option)?;
        let number = || value.parse::<usize>().map_err(|error| format!("{option} {value}: {error}"));
        match option.as_str() {
            "--package" => {
                let (name, folder) = value.split_once('=').ok_or("--package NAME=DIR")?;
                packages.insert(name.to_owned(), PathBuf::from(folder));
            }
            "--joints" => joints = Some(value.split(',').map(str::to_owned).collect()),
            "--goals" => goals = number()?,
            "--proofs" => proofs = Some(PathBuf::from(&value)),
            "--worlds" => worlds = number()? as u64,
            "--level" if value == "fast" => level = Level::Fast,
            "--level" if value == "exact" => level = Level::Exact,
            other => return Err(format!("unknown option {other} {value}")),
        }
    }
    let source = Source { path: urdf.clone(), packages: packages.clone(), ..Source::default() };
    let model = dimos_robot::load(&source).into_model()?;
    let all = || model.independent_joints().into_iter().map(|joint| model.joints[joint].name.clone()).collect();
    let joints: Vec<String> = joints.unwrap_or_else(all);
    let base = model.links.first().map_or_else(String::new, |link| link.name.clone());
    let robot = RobotConfig { packages, base_link: base, ..RobotConfig::new("", urdf, &tip, joints) };
    Ok(Given { robot, goals, worlds, level, proofs })
}

/// Obstacles of three kinds about an arm that reaches this far [m].
fn obstacles(random: &mut Random, reach: f64) -> Vec<ObjectConfig> {
    let thing = |number: usize, random: &mut Random| {
        let mut size = |least, most| random.between(least, most);
        let shape = match number % 3 {
            0 => ObjectShape::Box([size(0.05, 0.3), size(0.05, 0.3), size(0.05, 0.5)]),
            1 => ObjectShape::Sphere(size(0.03, 0.1)),
            _ => ObjectShape::Cylinder([size(0.02, 0.06), size(0.1, 0.6)]),
        };
        let (angle, away) = (random.between(-3.1, 3.1), random.between(0.35, 1.0) * reach);
        let at = Translation3::new(away * angle.cos(), away * angle.sin(), random.between(0.0, 1.0) * reach);
        let turn = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), random.between(-1.5, 1.5));
        ObjectConfig { name: format!("thing{number}"), shape, pose: Isometry3::from_parts(at, turn), padding: 0.0 }
    };
    (0..OBSTACLES).map(|number| thing(number, random)).collect()
}

fn free(checker: &mut ExactChecker, random: &mut Random) -> Option<Vec<f64>> {
    let limits = checker.limits().to_vec();
    let mut any = || limits.iter().map(|l| sample(l.lower, l.upper, random)).collect::<Vec<f64>>();
    (0..2000).map(|_| any()).find(|q| checker.is_free(q))
}

/// Returns the time that this thread has computed [ms]: other programs do not count.
fn computed() -> f64 {
    let at = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    at.tv_sec as f64 * 1e3 + at.tv_nsec as f64 * 1e-6
}

/// Plans between random configurations; returns the times of all requests [ms].
fn measure(scene: &PlanningScene, given: &Given, seed: u64, goals: usize) -> Vec<f64> {
    let mut checker = ExactChecker::new(scene.world.snapshot(), CheckSettings::default());
    let mut random = Random::new(seed);
    let mut times = Vec::new();
    for number in 0..goals {
        let ends = (free(&mut checker, &mut random), free(&mut checker, &mut random));
        let (Some(start), Some(goal)) = ends else { continue };
        let plain = PlanRequest::new(start, Goal::Joints(goal));
        let settings = PlanRequest { level: given.level, refine: 4, seed: number as u64, ..plain };
        let stop = Stop::new(Some(Instant::now() + TIMEOUT), None);
        let began = computed();
        let found = solve(scene, &scene.world, &settings, &stop);
        let took = computed() - began;
        match found {
            Ok(motion) if std::env::var_os("DIMOS_EACH").is_some() => {
                let clearance = motion.clearance.map(|kept| (kept.distance, kept.pair));
                println!("  {took:9.2} ms: {:?} {clearance:?}", motion.times);
            }
            Ok(_) => {}
            Err(failure) => println!("  {took:.1} ms: {}", failure.what),
        }
        times.push(took);
    }
    times
}

fn print(what: &str, times: &mut [f64]) {
    times.sort_by(f64::total_cmp);
    let at = |part: f64| times.get((part * times.len() as f64) as usize).or(times.last()).copied().unwrap_or(f64::NAN);
    let (p50, p95, p100) = (at(0.5), at(0.95), at(1.0));
    println!("{what}: {} requests, p50 {p50:.2} ms, p95 {p95:.2} ms, longest {p100:.1} ms", times.len());
}

fn main() -> Result<(), String> {
    let given = given()?;
    let config = |objects| PlannerConfig {
        robots: vec![given.robot.clone()],
        objects,
        padding: 0.003,
        proofs: given.proofs.clone(),
        ..PlannerConfig::default()
    };
    let began = computed();
    let mut scene = PlanningScene::load(&config(Vec::new()))?;
    let loaded = computed();
    ExactChecker::new(scene.world.snapshot(), CheckSettings::default());
    println!("loaded in {:.2} s, covered in {:.2} s", (loaded - began) * 1e-3, (computed() - loaded) * 1e-3);
    for pair in scene.ignored_pairs(&scene.world, &[0]) {
        if pair.reason != "neighbours" && pair.reason != "fixed to each other" {
            println!("  {} ~ {}: {}", pair.links[0], pair.links[1], pair.reason);
        }
    }
    print("empty world", &mut measure(&scene, &given, 1, given.goals));
    let reach = {
        let robot = &scene.robots[0];
        let at = robot.tcp_pose(&vec![0.0; robot.joints.len()]).translation - robot.base_pose().translation;
        at.length().clamp(0.4, 1.2)
    };
    let mut all = Vec::new();
    for number in 0..given.worlds {
        let loaded = PlanningScene::load(&config(obstacles(&mut Random::new(100 + number), reach)))?;
        // The same solids, with the covers that were made of them.
        scene.world = loaded.world.with_robots(scene.world.robots().to_vec());
        all.extend(measure(&scene, &given, number, given.goals / given.worlds.max(1) as usize));
    }
    print("clutter", &mut all);
    Ok(())
}

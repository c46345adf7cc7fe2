//! Motions along curves are about as quick as an optimizer that we did not write finds them: lines and arcs of the
//! arms of all shipped planner blueprints, and recorded paths.

use dimos::blueprint::{Overrides, find, load};
use dimos::collision::Stop;
use dimos::planning::curve::tool_path::ToolPath;
use dimos::planning::ik::cartesian::follow;
use dimos::planning::ik::settings::LineSettings;
use dimos::planning::request::joint_path::JointPath;
use dimos::planning::request::pipeline::{Goal, PlanRequest, solve};
use dimos::planning::scene::planning_scene::PlanningScene;
use dimos::planning::timing::bounds;
use dimos::robot::kinematics::pose;
use dimos::robot::random::Random;
use glamx::DVec3;
use nalgebra::{Isometry3, Translation3, Vector3};
use serde_json::{Value, json};

use crate::support::python::ask_python;

/// Shortest time from rest to full acceleration of a joint without a jerk limit [s]: what the planner's curves take.
const RAMP: f64 = 0.03;

/// A scene with an arm and nothing else, of a shipped blueprint.
fn alone(blueprint: &str) -> PlanningScene {
    let set = Overrides { sim: true, ..Overrides::default() };
    let loaded = load(&find(blueprint).unwrap(), &set, &dimos::arms::registry());
    let mut planner = loaded.blueprint.unwrap_or_else(|| panic!("{blueprint}")).planner.unwrap();
    planner.objects.clear();
    PlanningScene::load(&planner).unwrap()
}

fn by(from: &Isometry3<f64>, way: Vector3<f64>) -> Isometry3<f64> {
    Translation3::from(way) * from
}

/// The motions of one arm, and what the optimizer is asked.
struct Asked {
    what: Vec<String>,
    durations: Vec<f64>,
    cases: Vec<Value>,
}

impl Asked {
    fn push(&mut self, scene: &PlanningScene, what: String, q: &[Vec<f64>], duration: f64, natural: bool) {
        let robot = &scene.robots[0];
        let bounds = bounds(&robot.config.coordinator_joints, &robot.limits).unwrap();
        let of = |f: &dyn Fn(&dimos::joint::JointBounds) -> f64| bounds.iter().map(f).collect::<Vec<f64>>();
        self.cases.push(json!({
            "q": q, "natural": natural, "duration": duration,
            "velocity": of(&|b| b.velocity), "acceleration": of(&|b| b.acceleration),
            "jerk": of(&|b| b.jerk.min(b.acceleration / RAMP)),
        }));
        self.what.push(what);
        self.durations.push(duration);
    }
}

fn duration(scene: &PlanningScene, start: &[f64], goal: Goal) -> Option<f64> {
    let motion = solve(scene, &scene.world, &PlanRequest::new(start.to_vec(), goal), &Stop::never()).ok()?;
    Some(motion.trajectory.duration())
}

/// Lines, arcs and recorded paths that an arm can follow.
fn asked(name: &str, scene: &mut PlanningScene, each: usize, asked: &mut Asked) {
    // The tool's own limit is another test's.
    scene.robots[0].tcp_velocity = None;
    let robot = scene.robots[0].clone();
    let mut random = Random::new(11);
    let home = robot.config.named_poses.values().next().cloned();
    let home = home.unwrap_or_else(|| robot.limits.iter().map(|l| 0.5 * (l.lower + l.upper)).collect());
    let mut found = [0; 3];
    for _ in 0..400 {
        if found.iter().all(|found| *found >= each) {
            return;
        }
        let inside = |(q, l): (&f64, &dimos::robot::model::Limits)| {
            (q + random.between(-0.5, 0.5)).clamp(l.lower + 0.05, l.upper - 0.05)
        };
        let start: Vec<f64> = home.iter().zip(&robot.limits).map(inside).collect();
        let from = pose(&robot.tcp_pose(&start));
        let mut direction =
            || Vector3::new(random.between(-1.0, 1.0), random.between(-1.0, 1.0), random.between(-1.0, 1.0));
        let (along, across) = (direction(), direction());
        let far = random.between(0.1, 0.5);
        let (to, via) = (by(&from, along.normalize() * far), by(&from, along.normalize() * 0.5 * far + 0.2 * across));
        let root = robot.body.base.inverse();
        let frame = |pose: &Isometry3<f64>| root * dimos::robot::kinematics::frame(pose);
        let line = ToolPath::line(frame(&from), frame(&to));
        let via_root = root.transform_point3(DVec3::from_array(via.translation.vector.into()));
        let arc = ToolPath::arc(frame(&from), via_root, frame(&to)).unwrap();
        let exact = |way: &ToolPath| -> Option<Vec<Vec<f64>>> {
            let settings = LineSettings { step: 1e-3, tolerance: 1e-11, ..LineSettings::default() };
            let line = follow(&robot.body.kinematics, robot.tcp(), &start, way, &settings, |_, _| true);
            (line.fraction == 1.0).then_some(line.path)
        };
        let goals = [("line", Goal::Line(to), &line), ("arc", Goal::Arc { via: via.translation.vector, to }, &arc)];
        for (k, (kind, goal, way)) in goals.into_iter().enumerate() {
            if found[k] >= each || way.length() > 0.8 {
                continue;
            }
            if let Some(q) = exact(way)
                && let Some(duration) = duration(scene, &start, goal)
            {
                asked.push(scene, format!("{name}: {kind} of {:.2} m", way.length()), &q, duration, false);
                found[k] += 1;
            }
        }
        if found[2] < each {
            // A recorded path: a smooth motion in the arm's ranges, by few or many points.
            let count = [10, 40, 300, 2000][(found[2] + asked.cases.len()) % 4];
            let size: Vec<f64> = start.iter().map(|_| random.between(-0.3, 0.3)).collect();
            let at = |k: usize| {
                let u = k as f64 / (count - 1) as f64;
                start
                    .iter()
                    .zip(&size)
                    .enumerate()
                    .map(|(j, (q, a))| q + a * ((4.0 * u + j as f64).sin() - (j as f64).sin()))
                    .collect()
            };
            let points: Vec<Vec<f64>> = (0..count).map(at).collect();
            let goal = Goal::Path(JointPath { points: points.clone(), tolerance: 0.005 });
            if let Some(duration) = duration(scene, &start, goal) {
                asked.push(scene, format!("{name}: path of {count} points"), &points, duration, true);
                found[2] += 1;
            }
        }
    }
}

#[test]
fn curves_are_about_as_quick_as_an_optimizer_makes_them() {
    let each = std::env::var("DIMOS_CURVES").ok().map_or(1, |each| each.parse().expect("DIMOS_CURVES is a number"));
    let mut all = Asked { what: Vec::new(), durations: Vec::new(), cases: Vec::new() };
    for name in ["yourarm", "xarm7", "xarm6", "ur5e", "fr3", "piper"] {
        let blueprint = format!("{name}-planner");
        let Ok(_) = find(&blueprint) else { panic!("no blueprint {blueprint}") };
        asked(name, &mut alone(&blueprint), each, &mut all);
    }
    assert!(all.cases.len() >= 15 * each, "{} cases", all.cases.len());
    let Some(theirs) = ask_python("curve_time.py", "casadi", &json!(all.cases)) else { return };
    let mut ratios = Vec::new();
    for ((what, own), theirs) in all.what.iter().zip(&all.durations).zip(theirs.as_array().unwrap()) {
        let Some(theirs) = theirs.as_f64() else {
            eprintln!("{what}: {own:.3} s, the optimizer found none");
            continue;
        };
        eprintln!("{what}: {own:.3} s, optimizer {theirs:.3} s, ratio {:.3}", own / theirs);
        ratios.push(own / theirs);
    }
    ratios.sort_by(f64::total_cmp);
    let (median, most) = (ratios[ratios.len() / 2], ratios[ratios.len() - 1]);
    eprintln!("{} curves: ratio {median:.3} at the median, {most:.3} at most", ratios.len());
    assert!(ratios.len() * 5 >= all.cases.len() * 4, "the optimizer found {} of {}", ratios.len(), all.cases.len());
    assert!(median <= 1.10 && most <= 1.25, "{median} at the median, {most} at most");
}

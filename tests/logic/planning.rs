//! Plans on real problems, re-checked by brute force; timing against toppra; straight lines.

#[path = "../../benches/planning/problems.rs"]
#[allow(dead_code, reason = "shared with the benchmark")]
pub mod problems;

use std::sync::Arc;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use dimos::collision::body::{MeshMode, solids};
use dimos::collision::world::{Obstacle, Robot};
use dimos::collision::{CheckSettings, CollisionChecker, ExactChecker, Solid, Stop, World};
use dimos::joint::JointBounds;
use dimos::planning::curve::tool_path::ToolPath;
use dimos::planning::ik::cartesian::{Shortfall, follow};
use dimos::planning::ik::settings::LineSettings;
use dimos::planning::search::level::Level;
use dimos::planning::search::path::{distance, tidy};
use dimos::planning::search::path_planner::{PlanError, plan};
use dimos::planning::search::settings::{PlanSettings, ShortcutSettings};
use dimos::planning::search::shortcut::shorten;
use dimos::planning::timing::blend::curves;
use dimos::planning::timing::settings::TimingSettings;
use dimos::planning::timing::time;
use dimos::planning::timing::topp::parameterize;
use dimos::robot::kinematics::Kinematics;
use dimos::robot::random::Random;
use dimos::robot::{builtin, urdf};
use dimos::trajectory::{Cursor, Sample, Spline};
use glamx::{DAffine3, DVec3};
use problems::{Arm, Problem, Shapes, load};
use serde_json::json;

use crate::support::python::ask_python;
use crate::support::shared::shared;

/// The sphere model of the Panda with every 40th problem.
fn panda() -> Option<(Arm, Vec<Problem>)> {
    let folder = shared("planning/panda")?;
    let srdf = folder.join("panda.srdf");
    let arm = Arm::load(&folder.join("panda_spherized.urdf"), Some(&srdf), std::collections::BTreeMap::new()).unwrap();
    let all = load(&folder.join("problems.jsonl"), None).unwrap();
    Some((arm, all.into_iter().skip(3).step_by(40).collect()))
}

fn checker(arm: &Arm, problem: &Problem) -> (ExactChecker, Arc<Kinematics>) {
    let kinematics = Arc::new(arm.kinematics(problem).unwrap());
    let scene = arm.scene(&kinematics, problem, Shapes::True).unwrap();
    (ExactChecker::new(scene, CheckSettings::default()), kinematics)
}

#[test]
fn plans_are_free_between_samples_and_the_same_for_the_same_seed() {
    let Some((arm, problems)) = panda() else { return };
    assert_eq!(problems.len(), 18);
    for problem in &problems {
        let (mut checker, kinematics) = checker(&arm, problem);
        let (start, goal) = problem.ends();
        let settings = PlanSettings { seed: 7, ..PlanSettings::default() };
        let goals = [goal.to_vec()];
        let found = plan(&mut checker, start, &goals, &settings, &Stop::never()).unwrap();
        let again = plan(&mut checker, start, &goals, &settings, &Stop::never()).unwrap();
        assert_eq!(found.path, again.path);
        assert_eq!((found.path.first().unwrap().as_slice(), found.path.last().unwrap().as_slice()), (start, goal));
        for edge in found.path.windows(2) {
            let steps = (distance(&edge[0], &edge[1]) * 320.0).ceil() as usize;
            for k in 0..=steps {
                let t = k as f64 / steps as f64;
                let q: Vec<f64> = edge[0].iter().zip(&edge[1]).map(|(a, b)| a + (b - a) * t).collect();
                assert!(checker.is_free(&q), "{} {}: {:?}", problem.problem, problem.index, checker.contacts(&q));
                assert!(q.iter().zip(kinematics.limits()).all(|(x, l)| *x >= l.lower && *x <= l.upper));
            }
        }
        times_well(&mut checker, &kinematics, &found.path, found.length);
    }
}

/// The timed motion keeps its limits and is free at every sample.
fn times_well(checker: &mut ExactChecker, kinematics: &Kinematics, path: &[Vec<f64>], length: f64) {
    let bounds = dimos::planning::timing::bounds(kinematics.names(), kinematics.limits()).unwrap();
    let free = |a: &[f64], b: &[f64]| checker.motion_is_free(a, b, &Stop::never());
    let timed = time(kinematics.names(), path, &bounds, &TimingSettings::default(), free).unwrap();
    let spline = Spline::new(&timed.trajectory).unwrap();
    let (mut cursor, mut samples) = (Cursor::default(), vec![Sample::default(); 7]);
    let mut t = 0.0;
    while t < spline.duration() {
        spline.sample(t, &mut cursor, &mut samples);
        for (s, b) in samples.iter().zip(&bounds) {
            assert!(s.velocity.abs() <= b.velocity * 1.0001 && s.acceleration.abs() <= b.acceleration * 1.0001);
        }
        let q: Vec<f64> = samples.iter().map(|s| s.position).collect();
        assert!(checker.is_free(&q), "{:?}", checker.contacts(&q));
        t += 0.004;
    }
    assert!(timed.duration > length / 7.0 && timed.duration < 60.0);
}

#[test]
fn what_cannot_be_planned_is_said() {
    let Some((arm, problems)) = panda() else { return };
    let (mut checker, _) = checker(&arm, &problems[0]);
    let (start, goal) = problems[0].ends();
    let settings = PlanSettings::default();
    let mut ask =
        |start: &[f64], goal: &[f64], stop: &Stop| plan(&mut checker, start, &[goal.to_vec()], &settings, stop);
    let mut outside = start.to_vec();
    outside[3] = 0.5;
    let error = ask(&outside, goal, &Stop::never()).unwrap_err();
    assert!(matches!(error, PlanError::Outside { which: "start", joint: 3, .. }), "{error}");
    // A start a little outside is brought back first.
    outside[3] = -3.0718 - 0.01;
    assert_eq!(
        ask(&outside, &outside.iter().map(|x| x.max(-3.07)).collect::<Vec<_>>(), &Stop::never()).map(|p| p.path[0][3]),
        Ok(outside[3])
    );
    let folded = [0.0, 1.7, 0.0, -3.0, 0.0, 0.0, 0.0];
    let error = ask(start, &folded, &Stop::never()).unwrap_err();
    assert!(matches!(&error, PlanError::Collides { which: "goal", contacts } if !contacts.is_empty()), "{error}");
    assert!(error.to_string().contains("deep in"), "{error}");
    assert!(matches!(ask(start, &[0.0; 3], &Stop::never()), Err(PlanError::Shape("goal", 7))));
    let cancelled = Stop::new(None, Some(Arc::new(AtomicBool::new(true))));
    assert_eq!(ask(start, goal, &cancelled).unwrap_err(), PlanError::Cancelled);
    let looked = checker.checks();
    assert_eq!(plan(&mut checker, start, &[goal.to_vec()], &settings, &cancelled), Err(PlanError::Cancelled));
    assert!(checker.checks() - looked <= 4, "{} checks after it was cancelled", checker.checks() - looked);
    // Shortcutting and timing end too.
    let long: Vec<Vec<f64>> = (0..40).map(|k| start.iter().map(|x| x + 0.01 * f64::from(k % 7)).collect()).collect();
    let looked = checker.checks();
    let mut is_free = |a: &[f64], b: &[f64]| checker.motion_is_free(a, b, &cancelled);
    shorten(&long, &[false; 7], &ShortcutSettings::default(), &mut is_free);
    assert_eq!(checker.checks(), looked);
}

#[test]
fn a_goal_that_cannot_be_reached_takes_no_longer_than_it_may() {
    let Some((arm, problems)) = panda() else { return };
    let cage = problems.iter().find(|p| p.problem == "cage").unwrap();
    let (mut checker, _) = checker(&arm, cage);
    let (start, goal) = cage.ends();
    // The way is there, the time is not.
    let deadline = Instant::now() + Duration::from_micros(50);
    let began = Instant::now();
    let found = plan(&mut checker, start, &[goal.to_vec()], &PlanSettings::default(), &Stop::new(Some(deadline), None));
    assert!(matches!(found, Err(PlanError::Timeout(_))), "{found:?}");
    assert!(began.elapsed() < Duration::from_secs(1), "{:?}", began.elapsed());
}

/// A world with a `yourarm` for each name, at a place along y [m].
fn world_of(arms: &[(&str, f64)]) -> World {
    let model = Arc::new(urdf::from_text("yourarm.urdf", builtin::text("yourarm").unwrap()).unwrap());
    let mut world = World::new();
    for (name, y) in arms {
        let robot = Robot {
            name: (*name).into(),
            model: model.clone(),
            kinematics: Arc::new(Kinematics::whole(&model).unwrap()),
            solids: solids(&model, MeshMode::Hull).unwrap(),
            base: DAffine3::from_translation(DVec3::Y * *y),
            padding: 0.0,
            apart: 0.0,
            proven: Vec::new(),
            allowed: vec![],
        };
        world.add_robot(robot).unwrap();
    }
    world
}

/// Two arms 0.5 m apart with a box and a post between them.
fn two_arms() -> ExactChecker {
    let mut world = world_of(&[("left", 0.25), ("right", -0.25)]);
    let at = |x, y, z| DAffine3::from_translation(DVec3::new(x, y, z));
    let things = [
        ("box", Solid::cuboid(DVec3::new(0.1, 0.2, 0.3), at(0.35, 0.0, 0.15))),
        ("post", Solid::cylinder(0.03, 0.6, at(-0.3, 0.1, 0.3))),
    ];
    for (name, solid) in things {
        world.add(Obstacle { name: name.into(), solid: solid.unwrap(), padding: 0.0 }).unwrap();
    }
    ExactChecker::new(world.snapshot(), CheckSettings::default())
}

#[test]
fn two_arms_are_planned_together_without_any_setting() {
    let mut checker = two_arms();
    let limits = checker.limits().to_vec();
    let mut random = Random::new(4);
    let mut free = |checker: &mut ExactChecker| loop {
        let q: Vec<f64> = limits.iter().map(|l| 0.7 * random.between(l.lower, l.upper)).collect();
        if checker.is_free(&q) {
            return q;
        }
    };
    let mut settings = PlanSettings::default();
    settings.search.max_samples = 1_000_000;
    let mut searched = 0;
    for number in 0..16 {
        let (start, goal) = (free(&mut checker), free(&mut checker));
        let found = plan(&mut checker, &start, std::slice::from_ref(&goal), &settings, &Stop::never());
        let found = found.unwrap_or_else(|error| panic!("{number}: {error}: {start:?} to {goal:?}"));
        assert!(found.proven && found.path.windows(2).all(|e| checker.motion_is_free(&e[0], &e[1], &Stop::never())));
        searched += usize::from(!found.straight);
    }
    assert!(searched > 5, "{searched}");
}

#[test]
fn a_folded_elbow_cannot_be_reached_from_a_straight_one_and_the_links_in_the_way_are_named() {
    let mut checker = ExactChecker::new(world_of(&[("arm", 0.0)]).snapshot(), CheckSettings::default());
    for goal in [[0.3, -0.4, 2.3, 0.5, -0.8, 0.2], [-0.8, 0.6, 2.4, -1.0, 0.6, 1.0]] {
        let settings = PlanSettings { level: Level::Fast, ..PlanSettings::default() };
        let found = plan(&mut checker, &[0.0; 6], &[goal.to_vec()], &settings, &Stop::never());
        let Err(PlanError::Enclosed { which: "goal", enclosed }) = found else { panic!("{found:?}") };
        assert!(enclosed.joint == 2 && (1.85..2.0).contains(&enclosed.reached[0]), "{enclosed:?}");
        assert!(enclosed.pairs().contains("link \"arm/link1\" and link \"arm/link5\""), "{}", enclosed.pairs());
    }
}

#[test]
fn speeds_are_as_high_as_toppras() {
    let mut random = Random::new(31);
    let mut asked = Vec::new();
    let mut own = Vec::new();
    for n in [2, 3, 5, 8] {
        for _ in 0..5 {
            let path: Vec<Vec<f64>> = (0..n).map(|_| (0..6).map(|_| random.between(-1.5, 1.5)).collect()).collect();
            let bounds: Vec<JointBounds> = (0..6)
                .map(|_| JointBounds {
                    velocity: random.between(0.5, 3.0),
                    acceleration: random.between(1.0, 8.0),
                    jerk: f64::INFINITY,
                    ..JointBounds::NONE
                })
                .collect();
            let names: Vec<String> = (0..6).map(|j| format!("j{j}")).collect();
            let all = curves(&tidy(path.clone()), &vec![0.1; n]);
            let [curve] = all.as_slice() else { continue };
            let (mut s, mut q, mut start) = (Vec::new(), Vec::new(), 0.0);
            for (p, piece) in curve.iter().enumerate() {
                let steps = if piece.bends { 40 } else { 120 };
                for k in usize::from(p > 0)..=steps {
                    let at = piece.length * k as f64 / steps as f64;
                    s.push(start + at);
                    q.push(piece.jets(at).map(|jet| jet.q).collect::<Vec<f64>>());
                }
                start += piece.length;
            }
            let of = |f: fn(&JointBounds) -> f64| bounds.iter().map(f).collect::<Vec<f64>>();
            asked.push(
                json!({ "s": s, "q": q, "velocity": of(|b| b.velocity), "acceleration": of(|b| b.acceleration) }),
            );
            let settings = TimingSettings { deviation: 0.1, ..TimingSettings::default() };
            let timed = time(&names, &path, &bounds, &settings, |_, _| true).unwrap();
            assert!(
                timed.excess.velocity <= 1.0 + 1e-6 && timed.excess.acceleration <= 1.0 + 1e-6,
                "{:?}",
                timed.excess
            );
            own.push((parameterize(curve, &bounds, settings.corner_intervals).last().unwrap().time, timed.duration));
        }
    }
    assert!(own.len() > 10);
    let Some(theirs) = ask_python("timing.py", "toppra", &json!(asked)) else { return };
    for ((found, emitted), best) in own.iter().zip(theirs.as_array().unwrap()) {
        let best = best.as_f64().unwrap();
        // toppra's grid is finer, and its spline rounds the curve a little differently.
        assert!((found / best - 1.0).abs() < 0.02, "{found} {best}");
        assert!(*emitted < best * 1.1, "{emitted} {best}");
    }
}

#[test]
fn jerk_stays_within_its_limits_and_speed_scales_the_whole() {
    let mut random = Random::new(33);
    let names: Vec<String> = (0..7).map(|j| format!("j{j}")).collect();
    for n in [2, 4] {
        let path: Vec<Vec<f64>> = (0..n).map(|_| (0..7).map(|_| random.between(-1.5, 1.5)).collect()).collect();
        let bounds = [JointBounds { velocity: 2.0, acceleration: 5.0, jerk: 40.0, ..JointBounds::NONE }; 7];
        let full = time(&names, &path, &bounds, &TimingSettings::default(), |_, _| true).unwrap();
        let half = TimingSettings { speed: 0.5, ..TimingSettings::default() };
        let half = time(&names, &path, &bounds, &half, |_, _| true).unwrap();
        assert!((half.duration / full.duration - 2.0).abs() < 1e-9);
        let spline = Spline::new(&full.trajectory).unwrap();
        let (mut cursor, mut samples) = (Cursor::default(), vec![Sample::default(); 7]);
        let mut before: Option<Vec<f64>> = None;
        let step = 1e-3;
        for k in 0..(spline.duration() / step) as usize {
            spline.sample(k as f64 * step, &mut cursor, &mut samples);
            let now: Vec<f64> = samples.iter().map(|s| s.acceleration).collect();
            if let Some(before) = before {
                for (a, b) in now.iter().zip(&before) {
                    assert!((a - b).abs() / step <= 40.0 * 1.1, "{} at {k}", (a - b).abs() / step);
                }
            }
            assert!(samples.iter().all(|s| s.velocity.abs() <= 2.0001 && s.acceleration.abs() <= 5.0001));
            before = Some(now);
        }
        assert_eq!(full.trajectory.points[0].positions[..], path[0]);
        assert_eq!(full.trajectory.points.last().unwrap().positions[..], path[n - 1]);
    }
}

#[test]
fn straight_lines_are_straight_and_end_where_they_must() {
    let Some(folder) = shared("models/xarm6") else { return };
    let path = folder.join("xarm6.urdf");
    let model = urdf::from_text("xarm6", &std::fs::read_to_string(path).unwrap()).unwrap();
    let tip = model.link_index("link6").unwrap();
    let joints = model.chain(0, tip).unwrap().into_iter().filter(|&j| model.joints[j].is_independent());
    let kinematics = Kinematics::new(&model, &joints.collect::<Vec<_>>(), &[]).unwrap();
    let start = [0.0, -0.4, -0.8, 0.0, 1.2, 0.0];
    let mut frames = kinematics.frames();
    let mut pose = |q: &[f64]| {
        kinematics.forward(q, &mut frames);
        kinematics.link_frame(tip, &frames)
    };
    let from = pose(&start);
    let mut target = from;
    target.translation.y += 0.2;
    target.translation.z -= 0.05;
    let settings = LineSettings::default();
    let line = follow(&kinematics, tip, &start, &ToolPath::line(from, target), &settings, |_, _| true);
    assert_eq!((line.fraction, line.shortfall), (1.0, None));
    let along = (target.translation - from.translation).normalize();
    for pair in line.path.windows(2) {
        for k in 0..10 {
            let t = f64::from(k) / 10.0;
            let at = pose(&pair[0].iter().zip(&pair[1]).map(|(a, b)| a + (b - a) * t).collect::<Vec<_>>());
            let off = (at.translation - from.translation).reject_from(along).length();
            assert!(off < 1.5e-3, "{off}");
        }
    }
    let mut far = from;
    far.translation.x += 2.0;
    let line = follow(&kinematics, tip, &start, &ToolPath::line(from, far), &settings, |_, _| true);
    assert!(line.fraction > 0.05 && line.fraction < 0.9 && line.shortfall.is_some(), "{line:?}");
    let mut left = 5;
    let free = |_: &[f64], _: &[f64]| {
        left -= 1;
        left >= 0
    };
    let line = follow(&kinematics, tip, &start, &ToolPath::line(from, target), &settings, free);
    assert_eq!((line.path.len(), line.shortfall), (6, Some(Shortfall::NotFree)));
}

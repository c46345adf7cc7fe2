//! Requests with goals at their limits, straight lines that are blocked, and several arms.

use std::time::{Duration, Instant};

use nalgebra::{Isometry3, Translation3};

use super::goals::configurations;
use super::joint_path::JointPath;
use super::pipeline::{Goal, PlanRequest, PlannedMotion, solve, stage};
use crate::collision::{CheckSettings, CollisionChecker, ExactChecker, Stop};
use crate::planning::scene::config::{ObjectConfig, ObjectShape, PlannerConfig, RobotConfig};
use crate::planning::scene::planning_scene::PlanningScene;
use crate::planning::search::level::Level;
use crate::planning::search::path::length;
use crate::planning::search::path_planner::PlanError;
use crate::planning::search::thin::thin;
use dimos_core::trajectory::{Cursor, Sample, Spline};
use dimos_robot::kinematics::pose;
use dimos_robot::random::Random;

fn scene(robots: Vec<RobotConfig>, objects: Vec<ObjectConfig>) -> PlanningScene {
    PlanningScene::load(&PlannerConfig { robots, objects, ..PlannerConfig::default() }).unwrap()
}

fn ask(scene: &PlanningScene, goal: Goal, start: &[f64]) -> Result<PlannedMotion, String> {
    ask_at(Level::default(), scene, goal, start)
}

fn ask_at(level: Level, scene: &PlanningScene, goal: Goal, start: &[f64]) -> Result<PlannedMotion, String> {
    let request = PlanRequest { level, ..PlanRequest::new(start.to_vec(), goal) };
    solve(scene, &scene.world, &request, &Stop::never()).map_err(|failure| failure.what)
}

/// The timeout ended refinement, and with it the plan: no time was left for its timing.
#[test]
fn refinement_leaves_time_for_the_rest_of_the_request() {
    let at = |turn| vec![turn, -0.3, 0.6, 0.0, 0.8, 0.0];
    // In the middle of the direct way.
    let middle = flange(&scene(vec![RobotConfig::yourarm()], Vec::new()), 0, &at(0.0)).translation;
    let ball = ObjectConfig { name: "ball".into(), shape: ObjectShape::Sphere(0.1), pose: middle.into(), padding: 0.0 };
    let scene = scene(vec![RobotConfig::yourarm()], vec![ball]);
    let request = PlanRequest { refine: u32::MAX, ..PlanRequest::new(at(-0.9), Goal::Joints(at(0.9))) };
    let stop = Stop::new(Some(Instant::now() + Duration::from_secs(4)), None);
    let motion = solve(&scene, &scene.world, &request, &stop).unwrap();
    assert!(motion.path.len() > 2 && motion.times["refine"] > 0.1, "{:?}", motion.times);
}

/// A shorter path may turn more, or by more of the slower joints: its motion took longer.
#[test]
fn a_refined_plan_is_no_slower() {
    let at = |turn| vec![turn, -0.3, 0.6, 0.0, 0.8, 0.0];
    let middle = flange(&scene(vec![RobotConfig::yourarm()], Vec::new()), 0, &at(0.0)).translation;
    let wall = ObjectShape::Box([0.1, 0.02, 0.4]);
    let wall = ObjectConfig { name: "wall".into(), shape: wall, pose: middle.into(), padding: 0.0 };
    let scene = scene(vec![RobotConfig::yourarm()], vec![wall]);
    let (mut shorter, mut quicker) = (0, 0);
    for seed in 0..24 {
        let [plain, refined] = [0, 60].map(|refine| {
            let goal = Goal::Joints(at(0.9));
            let request = PlanRequest { seed, refine, ..PlanRequest::new(at(-0.9), goal) };
            let motion = solve(&scene, &scene.world, &request, &Stop::never()).unwrap();
            (motion.trajectory.duration(), length(&motion.path))
        });
        assert!(refined.0 <= plain.0, "seed {seed}: {:.3} s, refined {:.3} s", plain.0, refined.0);
        quicker += usize::from(refined.0 < plain.0);
        shorter += usize::from(refined.1 < plain.1);
    }
    assert!(quicker > 16 && shorter > 16, "{quicker} quicker, {shorter} shorter");
}

/// Returns the pose of a robot's end effector in the frame `map`.
fn flange(scene: &PlanningScene, robot: usize, q: &[f64]) -> Isometry3<f64> {
    let robot = &scene.robots[robot];
    let mut frames = robot.body.kinematics.frames();
    robot.body.kinematics.forward_from(&robot.body.base, q, &mut frames);
    pose(&robot.body.kinematics.link_frame(robot.end_effector, &frames))
}

#[test]
fn a_goal_at_a_rounded_limit_is_moved_to_the_limit_and_reported() {
    let scene = scene(vec![RobotConfig::yourarm()], Vec::new());
    let (start, upper) = ([0.0, 0.0, 0.5, 0.0, 0.0, 0.0], scene.robots[0].limits[0].upper);
    let to = |first: f64| ask(&scene, Goal::Joints([&[first], &start[1..]].concat()), &start);
    let motion = to(upper + 5e-4).unwrap();
    assert_eq!(motion.path.last().unwrap()[0], upper);
    assert_eq!(motion.clamped, [("arm_joint1".to_owned(), upper + 5e-4, upper)]);
    assert_eq!(to(upper).unwrap().clamped, []);
    let refused = to(upper + 2e-3).unwrap_err();
    assert!(refused.contains("arm_joint1 at 2.") && refused.contains("is outside its limits"), "{refused}");
}

#[test]
fn a_position_and_its_limit_are_shown_with_digits_that_differ() {
    let pi = std::f64::consts::PI;
    let upper = (pi * 1e5).floor() / 1e5;
    let lower = -upper;
    let shown = |position| PlanError::Outside { which: "goal", joint: 6, position, lower, upper }.to_string();
    assert_eq!(shown(3.5), "joint 6 of the goal is at 3.5000, outside -3.1416 to 3.1416");
    assert_eq!(shown(pi), "joint 6 of the goal is at 3.141593, outside -3.141590 to 3.141590");
    assert_eq!(shown(-pi), "joint 6 of the goal is at -3.141593, outside -3.141590 to 3.141590");
}

#[test]
fn a_blocked_straight_line_names_the_pair_and_where_it_is() {
    let start = [0.0, -0.2, 0.8, 0.0, 0.6, 0.0];
    let empty = scene(vec![RobotConfig::yourarm()], Vec::new());
    let from = flange(&empty, 0, &start);
    let target = Translation3::new(0.0, 0.25, 0.0) * from;
    assert_eq!(ask(&empty, Goal::Line(target), &start).unwrap().fraction, Some(1.0));
    let ball = ObjectConfig {
        name: "ball".into(),
        shape: ObjectShape::Sphere(0.03),
        pose: (Translation3::new(0.0, 0.2, 0.0) * from).translation.into(),
        padding: 0.0,
    };
    let blocked = scene(vec![RobotConfig::yourarm()], vec![ball]);
    let failure = ask(&blocked, Goal::Line(target), &start).unwrap_err();
    let (place, _) = failure.split_once(" of 0.250 m link ").unwrap_or_else(|| panic!("{failure}"));
    let along: f64 = place.rsplit_once("after ").unwrap().1.parse().unwrap();
    assert!((0.05..0.2).contains(&along), "{failure}");
    assert!(failure.contains("would come too close to obstacle \"ball\"") && failure.contains(" m deep"), "{failure}");
}

#[test]
fn goals_of_several_arms_touch_nothing_that_is_fixed() {
    let arm = |name: &str, y: f64| RobotConfig {
        name: name.into(),
        base_pose: Isometry3::translation(0.0, y, 0.0),
        coordinator_joints: (1..=6).map(|k| format!("{name}_joint{k}")).collect(),
        ..RobotConfig::yourarm()
    };
    let table = ObjectConfig {
        name: "table".into(),
        shape: ObjectShape::Box([3.0, 6.0, 0.1]),
        pose: Isometry3::translation(0.9, 0.0, 0.05),
        padding: 0.0,
    };
    // The base is just above the table.
    let mut arms = vec![arm("left", 1.0), arm("right", -1.0)];
    arms.iter_mut().for_each(|arm| arm.base_pose.translation.z = 0.102);
    let scene = scene(arms, vec![table]);
    let home = vec![vec![0.0; 6]; 2];
    let mut random = Random::new(4);
    let (mut looked, mut several) = (0, 0);
    for _ in 0..200 {
        let mut stage = stage(&scene, &scene.world, &[0, 1], &home, 0.0, &[]).unwrap();
        let known: Vec<f64> = scene.robots[0].limits.iter().map(|l| random.between(l.lower, l.upper)).collect();
        if !stage.checker.is_free(&[known.clone(), known.clone()].concat()) {
            continue;
        }
        looked += 1;
        if looked > 8 {
            break;
        }
        let goals = [0, 1].map(|robot| (robot, Goal::Pose(flange(&scene, robot, &known))));
        let found = configurations(&mut stage, &goals, 0, &Stop::never()).unwrap();
        several += usize::from(found.len() > 2);
        for q in found {
            let contacts = stage.checker.contacts(&q);
            assert!(contacts.is_empty(), "{contacts:?}");
        }
    }
    assert!(looked > 5 && several > 0, "{looked} {several}");
}

/// A record of hand guiding at 100 Hz, with the noise of encoders.
fn led(seconds: f64) -> Vec<Vec<f64>> {
    let mut random = Random::new(11);
    let mut at = |t: f64| {
        let way = [0.5 * t.sin(), -0.3 + 0.2 * (1.3 * t).cos(), 0.6, 0.1 * t, 0.8 + 0.1 * (2.0 * t).sin(), 0.0];
        way.iter().map(|q| q + random.between(-5e-4, 5e-4)).collect()
    };
    (0..=(seconds * 100.0) as i32).map(|k| at(f64::from(k) * 0.01)).collect()
}

#[test]
fn a_led_path_is_followed_within_its_tolerance_after_a_planned_approach() {
    let scene = scene(vec![RobotConfig::yourarm()], Vec::new());
    let (record, tolerance, start) = (led(12.0), 0.005, [0.0, -0.3, 0.6, 0.0, 0.8, 0.4]);
    let points = thin(&record, tolerance / 2.0);
    let waypoints = points.len();
    assert!(waypoints < 120, "{waypoints} waypoints");
    let path = Goal::Path(JointPath { points, tolerance: tolerance / 2.0 });
    let motion = ask(&scene, path.clone(), &start).unwrap();
    let spline = Spline::new(&motion.trajectory).unwrap();
    // Every position of the record is passed, in its order, and nothing else after the approach.
    let (mut cursor, mut at) = (Cursor::default(), [Sample::default(); 6]);
    let mut row = 0;
    for k in 0..(spline.duration() * 1000.0) as u32 {
        spline.sample(f64::from(k) * 1e-3, &mut cursor, &mut at);
        let off = |q: &Vec<f64>| at.iter().zip(q).map(|(a, q)| (a.position - q).abs()).fold(0.0, f64::max);
        let ahead = record[row..].iter().take(120);
        let nearest = ahead.enumerate().map(|(i, q)| (i, off(q))).min_by(|a, b| a.1.total_cmp(&b.1)).unwrap();
        if row > 0 || nearest.1 < tolerance {
            // A record at 100 Hz: half of a step beside the tolerance.
            assert!(nearest.1 <= tolerance + 4e-3, "{} rad off at {k} ms, row {row}", nearest.1);
            row += nearest.0;
        }
    }
    assert!(row > record.len() - 10, "it ended at row {row}");
    let rest = |q: &[f64]| q.iter().zip(&record[0]).all(|(a, b)| (a - b).abs() < 1e-3);
    let first = motion.trajectory.points.iter().find(|p| rest(&p.positions)).unwrap();
    assert!(first.velocities.iter().all(|v| v.abs() < 1e-6), "it rests where the path begins: {first:?}");
    // The hand took 12 s.
    assert!(motion.trajectory.duration() < 15.0, "{} s with {waypoints} waypoints", motion.trajectory.duration());
}

#[test]
fn a_path_is_refused_where_it_is_not_free_or_leaves_the_limits() {
    let at = flange(&scene(vec![RobotConfig::yourarm()], Vec::new()), 0, &led(12.0)[471]);
    let pose = Isometry3::from_parts(at.translation, Default::default());
    let block = ObjectConfig { name: "post".into(), shape: ObjectShape::Box([0.03; 3]), pose, padding: 0.0 };
    let blocked = scene(vec![RobotConfig::yourarm()], vec![block]);
    let path = |points: &[Vec<f64>]| Goal::Path(JointPath { points: thin(points, 0.0025), tolerance: 0.0025 });
    let start = led(0.0).remove(0);
    let refused = ask(&blocked, path(&led(12.0)), &start).unwrap_err();
    assert!(refused.contains("the path is not free at its waypoint") && refused.contains("\"post\""), "{refused}");
    // Slightly outside is moved inside, within the tolerance.
    let free = scene(vec![RobotConfig::yourarm()], Vec::new());
    let upper = free.robots[0].limits[0].upper;
    let to = |first: f64| ask(&free, path(&[start.clone(), [&[first], &start[1..]].concat()]), &start);
    assert_eq!(to(upper + 1e-3).unwrap().path.last().unwrap()[0], upper);
    let refused = to(upper + 5e-3).unwrap_err();
    assert!(refused.contains("path: arm_joint1 at 2.") && refused.contains("outside its limits"), "{refused}");
}

/// Returns the smallest distance at many places of a motion [m].
fn closest(scene: &PlanningScene, motion: &PlannedMotion) -> f64 {
    let mut checker = ExactChecker::new(scene.world.snapshot(), CheckSettings::default());
    let spline = Spline::new(&motion.trajectory).unwrap();
    let (mut cursor, mut at) = (Cursor::default(), vec![Sample::default(); spline.joints()]);
    let mut distance = |k: u32| {
        spline.sample(spline.duration() * f64::from(k) / 1000.0, &mut cursor, &mut at);
        let q: Vec<f64> = at.iter().map(|s| s.position).collect();
        checker.clearance(&q).unwrap().distance
    };
    (0..=1000).map(&mut distance).fold(f64::INFINITY, f64::min)
}

#[test]
fn the_clearance_of_a_plan_is_proven_for_the_whole_motion() {
    let ball = |name: &str, at: [f64; 3]| ObjectConfig {
        name: name.into(),
        shape: ObjectShape::Sphere(0.05),
        pose: Isometry3::translation(at[0], at[1], at[2]),
        padding: 0.0,
    };
    let scene = scene(vec![RobotConfig::yourarm()], vec![ball("a", [0.35, 0.25, 0.35]), ball("b", [0.45, -0.2, 0.2])]);
    let home = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];
    let mut random = Random::new(5);
    let (mut planned, mut missing) = (0, 0.0);
    for _ in 0..24 {
        let goal: Vec<f64> = home.iter().map(|q| q + random.between(-1.0, 1.0)).collect();
        let at = |level| ask_at(level, &scene, Goal::Joints(goal.clone()), &home);
        let Ok(certified) = at(Level::Certified) else { continue };
        let kept = certified.clearance.clone().unwrap();
        let measured = closest(&scene, &certified);
        assert!(kept.distance <= measured + 1e-6, "{kept:?} of {measured}");
        planned += 1;
        missing += measured.min(0.2) - kept.distance;
        let exact = at(Level::Exact).unwrap();
        let (kept, measured) = (exact.clearance.clone().unwrap(), closest(&scene, &exact));
        // Between the samples it may be a little closer.
        assert!(kept.distance <= measured + 1e-6 && kept.distance > measured.min(0.2) - 1e-3, "{kept:?} of {measured}");
        assert!(exact.ignored.iter().any(|pair| pair.reason == "neighbours"));
    }
    let mean = missing / f64::from(planned);
    println!("{planned} plans: {mean:.4} m less than measured");
    assert!(planned > 6 && mean < 0.005, "{planned} plans, {mean} m");
}

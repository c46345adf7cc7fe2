//! Motions along lines, arcs, recorded paths and blends.

use nalgebra::{Isometry3, Translation3, Vector3};

use super::joint_path::JointPath;
use super::pipeline::{Goal, PlanRequest, PlannedMotion, solve};
use crate::collision::Stop;
use crate::planning::scene::config::{ObjectConfig, ObjectShape, PlannerConfig, RobotConfig};
use crate::planning::scene::planning_scene::PlanningScene;
use dimos_core::trajectory::{Cursor, Sample, Spline};
use dimos_robot::kinematics::pose;
use dimos_robot::random::Random;

const START: [f64; 6] = [0.2, -0.4, 0.9, 0.1, 0.8, 0.2];

fn scene() -> PlanningScene {
    let robots = vec![RobotConfig::yourarm()];
    PlanningScene::load(&PlannerConfig { robots, ..PlannerConfig::default() }).unwrap()
}

fn tcp(scene: &PlanningScene, q: &[f64]) -> Isometry3<f64> {
    pose(&scene.robots[0].tcp_pose(q))
}

fn by(from: &Isometry3<f64>, xyz: [f64; 3]) -> Isometry3<f64> {
    Translation3::from(Vector3::from(xyz)) * from
}

fn planned(scene: &PlanningScene, request: &PlanRequest) -> PlannedMotion {
    solve(scene, &scene.world, request, &Stop::never()).unwrap()
}

/// Calls `see` with the positions every millisecond.
fn along(motion: &PlannedMotion, mut see: impl FnMut(f64, &[f64], &[Sample])) {
    let spline = Spline::new(&motion.trajectory).unwrap();
    let joints = motion.trajectory.joint_names.len();
    let (mut cursor, mut samples) = (Cursor::default(), vec![Sample::default(); joints]);
    for k in 0..=(spline.duration() * 1e3) as usize {
        spline.sample(k as f64 * 1e-3, &mut cursor, &mut samples);
        let q: Vec<f64> = samples.iter().map(|sample| sample.position).collect();
        see(k as f64 * 1e-3, &q, &samples);
    }
}

#[test]
fn a_line_and_an_arc_are_followed_exactly_in_their_own_time() {
    let scene = scene();
    let from = tcp(&scene, &START);
    for xyz in [[0.0, 0.1, 0.0], [0.0, 0.3, 0.0], [0.1, 0.2, -0.1], [-0.05, -0.3, 0.05]] {
        let to = by(&from, xyz);
        let motion = planned(&scene, &PlanRequest::new(START.to_vec(), Goal::Line(to)));
        let mut farthest = 0.0_f64;
        along(&motion, |_, q, _| {
            let p = tcp(&scene, q).translation.vector - from.translation.vector;
            let direction = Vector3::from(xyz).normalize();
            farthest = farthest.max((p - direction * p.dot(&direction)).norm());
        });
        assert!(farthest < 1e-4, "{farthest} m off the line");
    }
    let (via, to) = (by(&from, [0.0, 0.1, 0.1]), by(&from, [0.0, 0.2, 0.0]));
    let goal = Goal::Arc { via: via.translation.vector, to };
    let motion = planned(&scene, &PlanRequest::new(START.to_vec(), goal));
    let center = by(&from, [0.0, 0.1, 0.0]).translation.vector;
    along(&motion, |_, q, _| {
        let p = tcp(&scene, q).translation.vector - center;
        assert!((p.norm() - 0.1).abs() < 1e-4 && p.x.abs() < 1e-4, "{p:?}");
    });
}

#[test]
fn a_blend_passes_where_it_says_and_is_quicker() {
    let scene = scene();
    let from = tcp(&scene, &START);
    let (corner, to) = (by(&from, [0.0, 0.15, 0.0]), by(&from, [0.0, 0.15, 0.15]));
    let mut last = f64::INFINITY;
    for blend in [0.0, 0.005, 0.02] {
        let mut request = PlanRequest::new(START.to_vec(), Goal::Line(to));
        request.through = vec![vec![(0, Goal::Line(corner))]];
        request.blend = blend;
        let motion = planned(&scene, &request);
        let mut nearest = f64::INFINITY;
        along(&motion, |_, q, _| {
            nearest = nearest.min((tcp(&scene, q).translation.vector - corner.translation.vector).norm());
        });
        assert!((0.5 * blend - 1e-9..=blend + 1e-6).contains(&nearest), "{nearest} m for {blend} m");
        assert!(motion.trajectory.duration() < last, "{blend}: {} after {last}", motion.trajectory.duration());
        last = motion.trajectory.duration();
    }
}

#[test]
fn the_time_along_a_recorded_path_does_not_depend_on_the_number_of_its_points() {
    let scene = scene();
    let at = |u: f64| -> Vec<f64> {
        let turn = u * std::f64::consts::TAU;
        START.iter().enumerate().map(|(j, q)| q + 0.3 * ((turn + j as f64).sin() - (j as f64).sin())).collect()
    };
    let mut durations = Vec::new();
    for count in [12, 50, 500, 2000] {
        let points = (0..count).map(|k| at(k as f64 / (count - 1) as f64)).collect();
        let goal = Goal::Path(JointPath { points, tolerance: 0.005 });
        let motion = planned(&scene, &PlanRequest::new(START.to_vec(), goal));
        durations.push(motion.trajectory.duration());
    }
    let [least, most] = [f64::min, f64::max].map(|of| durations.iter().copied().reduce(of).unwrap());
    assert!(most < 1.05 * least, "{durations:?}");
}

#[test]
fn a_tool_keeps_the_speed_that_was_asked_for() {
    let scene = scene();
    let from = tcp(&scene, &START);
    let mut request = PlanRequest::new(START.to_vec(), Goal::Line(by(&from, [0.0, 0.3, 0.0])));
    request.tcp_speed = Some(0.1);
    let motion = planned(&scene, &request);
    let (mut last, mut fastest, mut steady) = (from, 0.0_f64, 0);
    along(&motion, |_, q, _| {
        let now = tcp(&scene, q);
        let speed = (now.translation.vector - last.translation.vector).norm() / 1e-3;
        fastest = fastest.max(speed);
        steady += usize::from((0.099..=0.1001).contains(&speed));
        last = now;
    });
    assert!(fastest <= 0.1001, "{fastest} m/s");
    let share = steady as f64 * 1e-3 / motion.trajectory.duration();
    assert!(share > 0.8 && motion.trajectory.duration() < 3.4, "{share} of {}", motion.trajectory.duration());
}

#[test]
fn rounds_of_refinement_make_a_path_with_corners_quicker() {
    let at = |turn| vec![turn, -0.3, 0.6, 0.0, 0.8, 0.0];
    let middle = tcp(&scene(), &at(0.0)).translation;
    let wall = ObjectShape::Box([0.1, 0.02, 0.4]);
    let wall = ObjectConfig { name: "wall".into(), shape: wall, pose: middle.into(), padding: 0.0 };
    let robots = vec![RobotConfig::yourarm()];
    let scene =
        PlanningScene::load(&PlannerConfig { robots, objects: vec![wall], ..PlannerConfig::default() }).unwrap();
    let mut gains = Vec::new();
    for seed in 0..12 {
        let [plain, refined] = [15, 16].map(|refine| {
            let request = PlanRequest { refine, seed, ..PlanRequest::new(at(-0.9), Goal::Joints(at(0.9))) };
            planned(&scene, &request).trajectory.duration()
        });
        gains.push(refined / plain);
    }
    gains.sort_by(f64::total_cmp);
    assert!(gains[0] < 0.98 && gains[6] < 0.996 && gains[11] <= 1.0, "{gains:?}");
}

/// A line that cannot be followed from one posture can be from another at the same pose: the hint has it.
#[test]
fn a_line_that_cannot_be_followed_says_where_and_from_which_posture_it_can() {
    let scene = scene();
    let limits = &scene.robots[0].limits;
    let mut random = Random::new(2);
    let (mut failed, mut followed) = (0, 0);
    for _ in 0..300 {
        let start: Vec<f64> = limits.iter().map(|l| random.between(0.7 * l.lower, 0.7 * l.upper)).collect();
        let way = [0; 3].map(|_| random.between(-0.2, 0.2));
        let ask = |start: &[f64]| {
            let to = by(&tcp(&scene, start), way);
            solve(&scene, &scene.world, &PlanRequest::new(start.to_vec(), Goal::Line(to)), &Stop::never())
        };
        let Err(failure) = ask(&start) else { continue };
        if failure.what.starts_with("the start collides") {
            continue;
        }
        failed += 1;
        assert!(failure.what.contains("% of the straight line is possible: after 0."), "{failure:?}");
        let hint = failure.hint.unwrap();
        let Some((_, rest)) = hint.split_once("move to ") else { continue };
        let numbers = rest.strip_suffix(" first").unwrap().split(' ').map(|q| q.parse().unwrap());
        ask(&numbers.collect::<Vec<f64>>()).unwrap();
        followed += 1;
    }
    assert!(failed > 20 && followed > 5, "{followed} of {failed}");
}

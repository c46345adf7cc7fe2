//! Motions along lines, arcs, recorded paths and blends.

use nalgebra::{Isometry3, Translation3, Vector3};

use super::joint_path::JointPath;
use super::pipeline::{Goal, PlanRequest, PlannedMotion, solve};
use crate::collision::Stop;
use crate::planning::scene::config::{PlannerConfig, RobotConfig};
use crate::planning::scene::planning_scene::PlanningScene;
use dimos_core::trajectory::{Cursor, Sample, Spline};
use dimos_robot::kinematics::pose;

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

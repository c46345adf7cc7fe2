//! Plans a motion around a wall, and prints it as CSV: time [s], positions [rad].

use dimos_planner::collision::Stop;
use dimos_planner::planning::request::pipeline::{Goal, PlanRequest, solve};
use dimos_planner::planning::scene::config::{ObjectConfig, ObjectShape, PlannerConfig, RobotConfig};
use dimos_planner::planning::scene::planning_scene::PlanningScene;
use nalgebra::Isometry3;

fn main() -> Result<(), String> {
    let joints = (1..=6).map(|number| format!("joint{number}")).collect();
    let robot = RobotConfig::new("arm", "builtin:yourarm", "flange", joints);
    let (shape, pose) = (ObjectShape::Box([0.5, 0.02, 0.6]), Isometry3::translation(0.4, 0.0, 0.3));
    let wall = ObjectConfig { name: "wall".into(), shape, pose, padding: 0.0 };
    let config = PlannerConfig { robots: vec![robot], objects: vec![wall], padding: 0.01, ..PlannerConfig::default() };
    let scene = PlanningScene::load(&config)?;

    let side = |turn| vec![turn, -0.3, 0.6, 0.0, 0.8, 0.0];
    let request = PlanRequest::new(side(-0.9), Goal::Joints(side(0.9)));
    let motion = solve(&scene, &scene.world, &request, &Stop::never()).map_err(|failure| failure.what)?;

    let clearance = motion.clearance.map_or(f64::INFINITY, |kept| kept.distance);
    eprintln!("{:.2} s, proven to keep {:.1} mm from the wall", motion.trajectory.duration(), clearance * 1e3);
    println!("time,{}", motion.trajectory.joint_names.join(","));
    for point in &motion.trajectory.points {
        let positions: Vec<String> = point.positions.iter().map(|q| format!("{q:.5}")).collect();
        println!("{:.5},{}", point.time_from_start, positions.join(","));
    }
    Ok(())
}

//! One meaning for a pose: what `state` prints is what a pose goal means, for every robot of every shipped planner
//! blueprint. A plan to the printed pose moves nothing, also for redundant arms, bases off the origin, and tools.

use dimos::joint::CommandLimits;
use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use dimos::blueprint::{self, Overrides, find, load};
use dimos::collision::Stop;
use dimos::planning::request::pipeline::{Goal, PlanFailure, PlanRequest, PlannedMotion, solve};
use dimos::planning::scene::config::PlannerConfig;
use dimos::planning::scene::planning_scene::{PlannedRobot, PlanningScene};
use dimos::planning::search::level::Level;
use dimos::pose::{from_xyz_rpy, to_xyz_rpy};
use dimos::robot::kinematics::pose;
use dimos::robot::random::Random;
use nalgebra::Isometry3;

/// Largest motions of a joint [rad] and of the tool centre point [m, rad] to a printed pose.
const JOINT: f64 = 5e-3;
const PLACE: f64 = 5e-4;
const TURN: f64 = 1.7e-3;

fn planners() -> Vec<(String, PlannerConfig)> {
    let listed = blueprint::list(&dimos::arms::registry());
    let names = listed.into_iter().map(|listing| listing.name).filter(|name| name.ends_with("-planner"));
    let config = |name: String| {
        let set = Overrides { sim: true, ..Overrides::default() };
        let loaded = load(&find(&name).unwrap(), &set, &dimos::arms::registry());
        let planner = loaded.blueprint.unwrap_or_else(|| panic!("{name}")).planner;
        (name.clone(), planner.unwrap_or_else(|| panic!("{name} has no planner")))
    };
    let needs_can = |name: &String| cfg!(feature = "can") || !name.contains("piper");
    names.filter(needs_can).map(config).collect()
}

fn at(robot: &PlannedRobot, q: &[f64]) -> Isometry3<f64> {
    pose(&robot.tcp_pose(q))
}

/// As `dimos state` prints it and a user pastes it: six decimals.
fn printed(pose: &Isometry3<f64>) -> Isometry3<f64> {
    let typed = |values: [f64; 3]| values.map(|v| format!("{v:.6}").parse::<f64>().unwrap());
    let (xyz, rpy) = to_xyz_rpy(pose);
    from_xyz_rpy(typed(xyz), typed(rpy))
}

fn plan(
    scene: &PlanningScene,
    positions: &[Vec<f64>],
    robot: usize,
    goal: Isometry3<f64>,
) -> Result<PlannedMotion, PlanFailure> {
    let goals = vec![(robot, Goal::Pose(goal))];
    let request = PlanRequest {
        goals,
        positions: positions.to_vec(),
        speed: 1.0,
        seed: 0,
        level: Level::default(),
        refine: 0,
        through: Vec::new(),
        blend: 0.0,
        tcp_speed: None,
        touch: Vec::new(),
        by_number: false,
    };
    solve(scene, &scene.world, &request, &Stop::new(Some(Instant::now() + Duration::from_secs(20)), None))
}

/// Where each robot begins: home, the zero pose, and configurations all over its ranges.
fn starts(robot: &PlannedRobot, random: &mut Random) -> Vec<Vec<f64>> {
    let inside = |q: f64, l: &dimos::robot::model::Limits| q.max(l.lower).min(l.upper);
    let mut all: Vec<Vec<f64>> = robot.config.named_poses.values().cloned().collect();
    all.push(robot.limits.iter().map(|l| inside(0.0, l)).collect());
    for _ in 0..12 {
        all.push(robot.limits.iter().map(|l| random.between(l.lower.max(-3.1), l.upper.min(3.1))).collect());
    }
    all
}

/// Plans from where the robot is to the pose that is printed for `shown`; `None` if the start collides.
fn moves(
    scene: &PlanningScene,
    index: usize,
    start: &[f64],
    shown: &[f64],
    others: &[Vec<f64>],
) -> Option<(f64, f64, f64)> {
    let robot = &scene.robots[index];
    let mut positions = others.to_vec();
    positions[index] = start.to_vec();
    let found = match plan(scene, &positions, index, printed(&at(robot, shown))) {
        Ok(found) => found,
        // A start in contact: a plan refuses it, or moves it out of contact first.
        Err(failure) if failure.what.contains(" collides: ") => return None,
        Err(failure) => panic!("{} from {start:?}: {}", robot.config.name, failure.what),
    };
    let farthest = |path: &[Vec<f64>]| {
        let most = |q: &Vec<f64>| q.iter().zip(start).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        path.iter().map(most).fold(0.0, f64::max)
    };
    let (from, to) = (at(robot, shown), at(robot, found.path.last().unwrap()));
    let far = (from.translation.vector - to.translation.vector).norm();
    Some((farthest(&found.path), far, from.rotation.angle_to(&to.rotation)))
}

#[test]
fn a_printed_pose_is_where_the_arm_is() {
    let all = planners();
    assert!(all.len() >= 5, "{:?}", all.iter().map(|(name, _)| name).collect::<Vec<_>>());
    let tool = from_xyz_rpy([0.02, -0.01, 0.11], [0.1, -0.7, 1.2]);
    for (name, mut config) in all {
        config.robots.iter_mut().for_each(|robot| robot.base_pose *= from_xyz_rpy([0.0, 0.0, 0.1], [0.0, 0.0, 0.4]));
        for tool in [None, Some(tool)] {
            config.robots.iter_mut().for_each(|robot| robot.tool = tool);
            let scene = PlanningScene::load(&config).unwrap();
            let mut random = Random::new(7);
            let others: Vec<Vec<f64>> = scene.robots.iter().map(|r| starts(r, &mut random)[0].clone()).collect();
            for (index, robot) in scene.robots.iter().enumerate() {
                let mut planned = 0;
                for start in starts(robot, &mut random) {
                    let Some((joint, place, turn)) = moves(&scene, index, &start, &start, &others) else { continue };
                    assert!(
                        joint <= JOINT && place <= PLACE && turn <= TURN,
                        "{name} {start:?}: {joint} {place} {turn}"
                    );
                    // Measured slightly off the commanded positions, from which a plan starts.
                    let measured: Vec<f64> = start.iter().map(|q| q + random.between(-1e-4, 1e-4)).collect();
                    let clamp = measured.iter().zip(&robot.limits).map(|(q, l)| q.max(l.lower).min(l.upper));
                    let measured: Vec<f64> = clamp.collect();
                    if let Some((joint, place, turn)) = moves(&scene, index, &start, &measured, &others) {
                        assert!(
                            joint <= JOINT && place <= PLACE && turn <= TURN,
                            "{name} {start:?}: {joint} {place} {turn}"
                        );
                    }
                    planned += 1;
                }
                assert!(planned >= 4, "{name}: only {planned} starts are free");
            }
        }
    }
}

/// Commands stay 0.01 rad inside the limits of an arm, which may rest at one. Another solution would be a large motion.
#[test]
fn a_printed_pose_at_a_limit_moves_the_arm_just_inside() {
    for (name, config) in planners() {
        let scene = PlanningScene::load(&config).unwrap();
        let others: Vec<Vec<f64>> = scene.robots.iter().map(|r| starts(r, &mut Random::new(1))[0].clone()).collect();
        let start = others[0].clone();
        let robot = &scene.robots[0];
        let (joint, limits) = (&robot.config.coordinator_joints[1], &robot.limits[1]);
        let (rate, wide) = (limits.velocity.min(3.0), 20.0);
        let bounds = CommandLimits {
            tcp_velocity: None,
            position: [start[1] + 0.008, limits.upper],
            velocity: rate,
            acceleration: wide,
            jerk: 10.0 * wide,
        };
        let scene = scene.clone().within(&BTreeMap::from([(joint.clone(), bounds)])).unwrap();
        let (moved, ..) = moves(&scene, 0, &start, &start, &others).expect("its home is free");
        assert!((0.008..0.0081).contains(&moved), "{name}: {moved} rad");
    }
}

/// The tool turns about its own centre point, not about the link that carries it.
#[test]
fn a_tool_is_where_a_pose_goal_brings_it() {
    let (_, mut config) = planners().into_iter().find(|(name, _)| name == "xarm7-planner").unwrap();
    let tool = from_xyz_rpy([0.0, 0.05, 0.1], [0.0, 0.5, 0.0]);
    let home = config.robots[0].named_poses["home"].clone();
    let bare = at(&PlanningScene::load(&config).unwrap().robots[0], &home);
    config.robots[0].tool = Some(tool);
    let mut scene = PlanningScene::load(&config).unwrap();
    let own = at(&scene.robots[0], &home);
    assert!((own.translation.vector - (bare * tool).translation.vector).norm() < 1e-9);
    let goal = own * from_xyz_rpy([0.0; 3], [0.0, 0.0, 0.3]);
    let found = plan(&scene, std::slice::from_ref(&home), 0, goal).unwrap();
    let to = at(&scene.robots[0], found.path.last().unwrap());
    assert!((to.translation.vector - own.translation.vector).norm() < 1e-4, "{to} for {goal}");
    assert!(to.rotation.angle_to(&goal.rotation) < 1e-3);
    scene.robots[0].set_tool(None);
    assert!((at(&scene.robots[0], &home).translation.vector - bare.translation.vector).norm() < 1e-9, "taken off");
}

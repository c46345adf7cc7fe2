//! A planned motion under way and a world that changes: the arm stops before the obstacle, in whole runs.
//! Judged from the positions of the emulated joints and a collision checker of its own.

use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::collision::{CheckSettings, CollisionChecker, ExactChecker};
use dimos::hardware::registry::Emulator;
use dimos::planning::scene::planning_scene::{PlanningScene, obstacle};
use dimos::rpc::api::{
    ExecutePlan, Move, Plan, PlanGoal, Planning, PoseSpec, Preview, ShapeSpec, WorldAdd, WorldObject, WorldRemove,
};
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Builder, Record, Run};

use crate::support::program::eventually;

const PADDING: f64 = 0.003;
const HOME: [f64; 6] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];

/// A run with an emulated arm that shows where its joints truly are, and the planner's robots for the judge.
struct Cell {
    run: Run,
    arm: YourArmEmulator,
    setup: PlanningScene,
    _folder: tempfile::TempDir,
}

fn up() -> Cell {
    let arm = YourArmEmulator::with(&SimOptions::default()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let blueprint = || -> Builder {
        Run::from_name("yourarm-planner").unwrap().set("hardware.arm.address", arm.address()).record(Record::Off)
    };
    let setup = PlanningScene::load(blueprint().check().blueprint.unwrap().planner.as_ref().unwrap()).unwrap();
    let run = blueprint().folder(RunDir::closed(folder.path())).start().unwrap();
    let cell = Cell { run, arm, setup, _folder: folder };
    let begun = cell.run.call(Move { direct: true, ..Move::new("arm", HOME, 1.0) }).unwrap();
    assert_eq!(cell.run.wait(begun.motion).unwrap().state, "COMPLETED");
    cell
}

fn at(angle: f64) -> Vec<f64> {
    [&[angle], &HOME[1..]].concat()
}

impl Cell {
    /// Plans to an angle of the first joint.
    fn plan(&self, angle: f64, speed: f64) -> u64 {
        let goal = PlanGoal { robot: "arm".into(), joints: Some(at(angle)), ..PlanGoal::default() };
        let plan =
            self.run.call(Plan { goals: vec![goal], speed, seed: 0, timeout: None, ..Plan::default() }).unwrap().plan;
        eventually("planning ends", || self.run.call(Planning { plan }).unwrap().state != "PLANNING");
        assert_eq!(self.run.call(Planning { plan }).unwrap().state, "PLANNED");
        plan
    }

    /// Where the joints truly are.
    fn joints(&self) -> Vec<f64> {
        self.arm.joints().0.iter().take(6).copied().collect()
    }

    /// A ball where the flange is with the first joint at that angle.
    fn ball(&self, name: &str, angle: f64) -> WorldObject {
        let robot = &self.setup.robots[0];
        let kinematics = &robot.body.kinematics;
        let mut frames = kinematics.frames();
        kinematics.forward_from(&robot.body.base, &at(angle), &mut frames);
        let xyz = kinematics.link_frame(robot.end_effector, &frames).translation.to_array();
        let pose = PoseSpec { xyz, ..PoseSpec::default() };
        WorldObject { name: name.into(), shape: ShapeSpec::Sphere(0.03), pose, padding: 0.0, held_by: None }
    }

    /// Returns the distance of the arm's true pose from the world and the objects [m].
    fn clearance(&self, objects: &[WorldObject]) -> f64 {
        self.clearance_at(&self.joints(), objects)
    }

    /// The same at a configuration.
    fn clearance_at(&self, q: &[f64], objects: &[WorldObject]) -> f64 {
        let mut world = self.setup.world.clone();
        for object in objects {
            let ShapeSpec::Sphere(radius) = object.shape else { unreachable!() };
            let [x, y, z] = object.pose.xyz;
            let config = dimos::planning::scene::config::ObjectConfig {
                name: object.name.clone(),
                shape: dimos::planning::scene::config::ObjectShape::Sphere(radius),
                pose: nalgebra::Isometry3::translation(x, y, z),
                padding: 0.0,
            };
            world.put(obstacle(&config).unwrap()).unwrap();
        }
        let mut checker = ExactChecker::new(world.snapshot(), CheckSettings::default());
        assert!(checker.is_free(q), "{:?}", checker.contacts(q));
        let near = checker.with_padding(1.0).closer_than_padding(q);
        let own = |name: &str| objects.iter().any(|object| object.name == name);
        near.into_iter().filter(|(_, c)| own(&c.other)).map(|(_, c)| c.distance).fold(f64::INFINITY, f64::min)
    }
}

impl Cell {
    /// A ball above the flange at an angle of the first joint, at a distance from the arm there [m].
    fn ball_at(&self, name: &str, angle: f64, distance: f64) -> WorldObject {
        let mut ball = self.ball(name, angle);
        ball.pose.xyz[2] += 0.12;
        ball.shape = ShapeSpec::Sphere(0.001);
        ball.shape = ShapeSpec::Sphere(0.001 + self.clearance_at(&at(angle), &[ball.clone()]) - distance);
        ball
    }

    /// The least distance from the objects on a plan's trajectory, for each of its points [rad, m].
    fn distances(&self, plan: u64, objects: &[WorldObject]) -> Vec<(Vec<f64>, f64)> {
        let preview = self.run.call(Preview { plan: Some(plan), hz: None }).unwrap();
        let ends = preview.trajectory.points.windows(2);
        let between = ends.flat_map(|pair| {
            let mix =
                |part: f64| pair[0].positions.iter().zip(&pair[1].positions).map(|(a, b)| a + (b - a) * part).collect();
            [0.0, 0.25, 0.5, 0.75, 1.0].map(mix).to_vec()
        });
        between.map(|q: Vec<f64>| (q.clone(), self.clearance_at(&q, objects))).collect()
    }
}

#[test]
fn plans_keep_the_padding_and_give_it_up_only_near_a_goal_that_is_closer() {
    let cell = up();
    // Beside the straight way: a path that only does not touch passes at 1.5 mm.
    let beside = cell.ball_at("beside", 0.5, 0.0015);
    cell.run.call(WorldAdd(beside.clone())).unwrap();
    let plan = cell.plan(1.0, 0.5);
    let least = cell.distances(plan, &[beside]).into_iter().map(|(_, distance)| distance).fold(f64::INFINITY, f64::min);
    assert!(least >= PADDING, "{least}");
    let summary = cell.run.call(Planning { plan }).unwrap().summary.unwrap();
    assert!(summary.padding == PADDING && summary.padding_given_up.is_empty(), "{summary:?}");
    // Beside the goal.
    cell.run.call(WorldRemove { name: None }).unwrap();
    let near = cell.ball_at("near", 1.0, 0.0015);
    cell.run.call(WorldAdd(near.clone())).unwrap();
    let plan = cell.plan(1.0, 0.5);
    let summary = cell.run.call(Planning { plan }).unwrap().summary.unwrap();
    let [given_up] = &summary.padding_given_up[..] else { panic!("{summary:?}") };
    assert!(given_up.near == "goal" && given_up.other == "near", "{given_up:?}");
    assert!((given_up.distance - 0.0015).abs() < 1e-5, "{given_up:?}");
    for (q, distance) in cell.distances(plan, &[near]) {
        let away = q.iter().zip(at(1.0)).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt();
        assert!(distance > 0.0007 && (away < 0.3 || distance >= PADDING), "{distance} m at {away} rad from the goal");
    }
    let begun = cell.run.call(ExecutePlan { plan: Some(plan), ..Default::default() }).unwrap();
    assert_eq!(cell.run.wait(begun.motion).unwrap().state, "COMPLETED");
}

#[test]
fn an_obstacle_in_the_way_of_a_motion_under_way_is_not_driven_through() {
    let cell = up();
    let plan = cell.plan(1.4, 0.5);
    let begun = cell.run.call(ExecutePlan { plan: Some(plan), ..Default::default() }).unwrap();
    eventually("it moves", || cell.joints()[0] > 0.15);
    let ball = cell.ball("late", 1.1);
    cell.run.call(WorldAdd(ball.clone())).unwrap();
    let ended = cell.run.wait(begun.motion).unwrap();
    let error = ended.error.unwrap_or_default();
    assert_eq!(ended.state, "ABORTED", "{error}, at {:?}", cell.joints());
    assert!(error.contains("obstacle \"late\"") && error.contains("link \"arm/"), "{error}");
    eventually("it rests", || cell.arm.joints().1.iter().take(6).all(|v| *v == 0.0));
    let clearance = cell.clearance(&[ball]);
    println!("{error}; rests {:.1} mm from it at {:?}", clearance * 1e3, cell.joints());
    assert!(clearance >= PADDING, "{clearance}");
}

#[test]
fn with_replan_it_goes_around_and_arrives() {
    let cell = up();
    let plan = cell.plan(1.4, 0.5);
    let begun = cell.run.call(ExecutePlan { plan: Some(plan), replan: true, ..Default::default() }).unwrap();
    eventually("it moves", || cell.joints()[0] > 0.15);
    let ball = cell.ball("late", 0.9);
    cell.run.call(WorldAdd(ball.clone())).unwrap();
    let first = {
        eventually("the first motion ends", || cell.run.motion(begun.motion).unwrap().done);
        cell.run.motion(begun.motion).unwrap()
    };
    assert!(first.state == "ABORTED" && first.next.is_some(), "{first:?}");
    let ended = cell.run.wait(begun.motion).unwrap();
    assert_eq!(ended.state, "COMPLETED", "{:?}", ended.error);
    assert_eq!(Some(ended.motion), first.next);
    let there = cell.joints().iter().zip(at(1.4)).all(|(is, goal)| (is - goal).abs() < 0.01);
    assert!(there && cell.clearance(&[ball]) >= PADDING, "{:?}", cell.joints());
    // With no way around it stays where it rests, and says why.
    let back = cell.plan(0.0, 0.5);
    let begun = cell.run.call(ExecutePlan { plan: Some(back), replan: true, ..Default::default() }).unwrap();
    eventually("it moves", || cell.joints()[0] < 1.3);
    let goal = cell.ball("goal", 0.0);
    cell.run.call(WorldAdd(goal)).unwrap();
    let ended = cell.run.wait(begun.motion).unwrap();
    let error = ended.error.unwrap_or_default();
    assert!(ended.state == "ABORTED" && error.contains("no way around: the goal collides"), "{error}");
    assert!(cell.joints()[0] > 0.2);
}

#[test]
fn what_appears_inside_the_braking_distance_is_met_with_a_stop_that_says_so() {
    let cell = up();
    let plan = cell.plan(1.4, 1.0);
    let begun = cell.run.call(ExecutePlan { plan: Some(plan), ..Default::default() }).unwrap();
    eventually("it is fast", || cell.arm.joints().1[0] > 0.9);
    cell.run.call(WorldAdd(cell.ball("sudden", cell.joints()[0] + 0.05))).unwrap();
    let ended = cell.run.wait(begun.motion).unwrap();
    let error = ended.error.unwrap_or_default();
    assert!(ended.state == "ABORTED" && error.contains("closer than the arm can brake"), "{error}");
    let arm = &cell.run.status().arms[0];
    // No operator has stopped it.
    assert_eq!((&*arm.phase, arm.cause.as_ref().map(|cause| &*cause.name)), ("held", Some("way_blocked")));
}

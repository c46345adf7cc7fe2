//! Continuous joints: the short way round, wherever their turn count starts.

use std::f64::consts::{PI, TAU};
use std::sync::Arc;

use glamx::{DAffine3, DVec3};

use super::ik::Ik;
use super::ik::settings::IkSettings;
use super::search::path::{length, unwind};
use super::search::path_planner::{Plan, PlanError, plan};
use super::search::settings::PlanSettings;
use super::timing::settings::TimingSettings;
use super::timing::{bounds, time};
use crate::collision::body::{MeshMode, solids};
use crate::collision::checker::{CollisionChecker, Stop};
use crate::collision::settings::CheckSettings;
use crate::collision::world::{Obstacle, Robot, World};
use crate::collision::{ExactChecker, Solid};
use dimos_robot::RobotModel;
use dimos_robot::kinematics::Kinematics;
use dimos_robot::random::Random;
use dimos_robot::urdf::from_text;

/// A planar arm of two continuous joints about z, and a slide with a ball at its end.
fn model(second: &str) -> RobotModel {
    let text = format!(
        r#"<robot name="r"><link name="base"/>
<link name="l1"><collision><origin xyz="0.25 0 0"/><geometry><box size="0.5 0.04 0.04"/></geometry></collision></link>
<link name="l2"><collision><origin xyz="0.15 0 0.05"/><geometry><box size="0.3 0.04 0.04"/></geometry></collision></link>
<link name="l3"><collision><geometry><sphere radius="0.03"/></geometry></collision></link>
<joint name="j1" type="continuous"><parent link="base"/><child link="l1"/><axis xyz="0 0 1"/>
<limit velocity="1" effort="1"/></joint>
{second}
<joint name="j3" type="prismatic"><parent link="l2"/><child link="l3"/><origin xyz="0.3 0 0"/><axis xyz="1 0 0"/>
<limit lower="0" upper="0.2" velocity="1" effort="1"/></joint></robot>"#
    );
    from_text("r.urdf", &text).unwrap()
}

const ENDLESS: &str = r#"<joint name="j2" type="continuous"><parent link="l1"/><child link="l2"/>
<origin xyz="0.5 0 0"/><axis xyz="0 0 1"/><limit velocity="1" effort="1"/></joint>"#;
const TWO_TURNS: &str = r#"<joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/>
<origin xyz="0.5 0 0"/><axis xyz="0 0 1"/><limit lower="-6.2" upper="6.2" velocity="1" effort="1"/></joint>"#;

fn checker(posts: &[(f64, f64)]) -> ExactChecker {
    let model = Arc::new(model(ENDLESS));
    let mut world = World::new();
    let robot = Robot {
        name: String::new(),
        kinematics: Arc::new(Kinematics::whole(&model).unwrap()),
        solids: solids(&model, MeshMode::Hull).unwrap(),
        model,
        base: DAffine3::IDENTITY,
        padding: 0.0,
        apart: 0.0,
        proven: Vec::new(),
        allowed: vec![("l1".into(), "l3".into())],
    };
    world.add_robot(robot).unwrap();
    for (i, (x, y)) in posts.iter().enumerate() {
        let at = DAffine3::from_translation(DVec3::new(*x, *y, 0.0));
        let solid = Solid::cylinder(0.03, 0.5, at).unwrap();
        world.add(Obstacle { name: format!("post{i}"), solid, padding: 0.0 }).unwrap();
    }
    ExactChecker::new(world.snapshot(), CheckSettings::default())
}

fn planned(checker: &mut ExactChecker, start: &[f64], goal: &[f64], seed: u64) -> Result<Plan, PlanError> {
    let mut settings = PlanSettings { seed, ..PlanSettings::default() };
    settings.search.max_samples = 400;
    plan(checker, start, &[goal.to_vec()], &settings, &Stop::never())
}

/// Returns whether two angles are the same except for whole turns.
fn same(a: f64, b: f64) -> bool {
    let d = a - b;
    (d - (d / TAU).round() * TAU).abs() < 1e-9
}

#[test]
fn the_short_way_round_is_taken() {
    let mut free = checker(&[]);
    for (from, to, end) in
        [(3.0, -3.0, TAU - 3.0), (-3.0, 3.0, 3.0 - TAU), (0.5, 20.0, 20.0 - 3.0 * TAU), (7.0, 0.0, TAU)]
    {
        let found = planned(&mut free, &[from, 0.0, 0.1], &[to, 0.3, 0.1], 0).unwrap();
        assert!(found.straight && (found.path[1][0] - end).abs() < 1e-12, "{from} to {to}: {:?}", found.path);
    }
    // A goal that is already nearest keeps its exact value.
    assert_eq!(planned(&mut free, &[0.1, 0.0, 0.1], &[0.3, 0.7, 0.1], 0).unwrap().path[1], [0.3, 0.7, 0.1]);
}

#[test]
fn the_long_way_round_is_found_where_the_short_one_is_blocked() {
    // A post on the circle of the inner link, right in its way.
    let mut blocked = checker(&[(-0.3, 0.0)]);
    let (start, goal) = ([2.8, 0.0, 0.1], [-2.8, 0.0, 0.1]);
    let found = planned(&mut blocked, &start, &goal, 1).unwrap();
    let end = found.path.last().unwrap();
    assert!((end[0] + 2.8).abs() < 1e-9, "{:?}", found.path);
    assert!(found.path.windows(2).all(|pair| (pair[1][0] - pair[0][0]).abs() < TAU));
    // The same, two turns farther.
    let start = [2.8 + 2.0 * TAU, 0.0, 0.1];
    let end = planned(&mut blocked, &start, &goal, 1).unwrap().path.pop().unwrap();
    assert!((end[0] - (2.0 * TAU - 2.8)).abs() < 1e-9, "{end:?}");
}

#[test]
fn plans_do_not_depend_on_the_initial_turn_count() {
    let mut random = Random::new(3);
    let (mut straight, mut searched) = (0, 0);
    for seed in 0..40 {
        let posts: Vec<(f64, f64)> = (0..4)
            .map(|_| (random.between(0.3, 0.9), random.between(-PI, PI)))
            .map(|(r, a)| (r * a.cos(), r * a.sin()))
            .collect();
        let mut checker = checker(&posts);
        let mut turned = |turns: f64| {
            let whole = random.between(-turns, turns).round() * TAU;
            random.between(-PI, PI) + whole
        };
        let start = [turned(3.0), turned(3.0), 0.05];
        let goal = [turned(3.0), turned(3.0), 0.15];
        if !checker.is_free(&start) || !checker.is_free(&goal) {
            continue;
        }
        let Ok(found) = planned(&mut checker, &start, &goal, seed) else { continue };
        let (first, last) = (&found.path[0], found.path.last().unwrap());
        assert_eq!(first, &start);
        assert!(same(last[0], goal[0]) && same(last[1], goal[1]) && last[2] == goal[2], "{last:?} for {goal:?}");
        assert!(found.path.windows(2).all(|e| checker.motion_is_free(&e[0], &e[1], &Stop::never())));
        let turn = |from: &[f64; 3], k: [f64; 2]| [from[0] + k[0] * TAU, from[1] + k[1] * TAU, from[2]];
        let other = planned(&mut checker, &turn(&start, [2.0, -1.0]), &turn(&goal, [-1.0, 5.0]), seed).unwrap();
        assert_eq!(other.straight, found.straight, "{seed}");
        assert!((length(&other.path) - length(&found.path)).abs() < 1e-6, "{seed}: {:?}\n{:?}", found.path, other.path);
        match found.straight {
            true => assert!((0..2).all(|j| (last[j] - first[j]).abs() <= PI + 1e-9), "{:?}", found.path),
            false => searched += 1,
        }
        straight += usize::from(found.straight);
        no_jumps(&found);
    }
    assert!(straight > 5 && searched > 5, "{straight} straight, {searched} searched");
}

/// The motion starts at the arm's position and continues without jumps.
fn no_jumps(found: &Plan) {
    let names: Vec<String> = ["j1", "j2", "j3"].map(str::to_owned).into();
    let limits = bounds(&names, Kinematics::whole(&model(ENDLESS)).unwrap().limits()).unwrap();
    let timed = time(&names, &found.path, &limits, &TimingSettings::default(), |_, _| true).unwrap();
    let points = &timed.trajectory.points;
    assert_eq!(points[0].positions[..], found.path[0]);
    for pair in points.windows(2) {
        let most = pair[1].time_from_start - pair[0].time_from_start + 1e-6;
        assert!(pair[0].positions.iter().zip(&pair[1].positions).all(|(a, b)| (b - a).abs() <= most), "{pair:?}");
    }
}

#[test]
fn solutions_of_a_pose_are_those_near_the_seed() {
    let mut random = Random::new(5);
    for second in [ENDLESS, TWO_TURNS] {
        let model = model(second);
        let kinematics = Kinematics::whole(&model).unwrap();
        let mut ik = Ik::new(&kinematics, model.link_index("l3").unwrap());
        for round in 0..200 {
            let q = [random.between(-PI, PI), random.between(-PI, PI), random.between(0.0, 0.2)];
            let near = [random.between(-20.0, 20.0), random.between(-6.2, 6.2), 0.1];
            let target = ik.pose(&q);
            let settings = IkSettings { seed: round, ..IkSettings::default() };
            let found = ik.solve(&target, &near, &settings, |_| true, &Stop::never()).unwrap();
            assert!((found[0][0] - near[0]).abs() <= PI + 1e-9, "{found:?} near {near:?}");
            let (is, other) = (found[0][1], near[1]);
            let nearer = |k: f64| (is + k * TAU - other).abs() < (is - other).abs() - 1e-9;
            let allowed = |k: f64| second == ENDLESS || (-6.2..=6.2).contains(&(is + k * TAU));
            assert!(![-1.0, 1.0].into_iter().any(|k| allowed(k) && nearer(k)), "{found:?} near {near:?}");
            assert!(allowed(0.0) && ik.pose(&found[0]).abs_diff_eq(target, 1e-5));
        }
    }
}

#[test]
fn a_mimic_joint_that_does_not_repeat_limits_its_continuous_leader() {
    let gear = |factor: &str| {
        let text = format!(
            r#"<robot name="r"><link name="a"/><link name="b"/><link name="c"/>
<joint name="lead" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/></joint>
<joint name="follow" type="continuous"><parent link="a"/><child link="c"/><axis xyz="0 0 1"/>
<mimic joint="lead" multiplier="{factor}"/></joint></robot>"#
        );
        Kinematics::whole(&from_text("r.urdf", &text).unwrap()).unwrap().turns()
    };
    assert_eq!((gear("-2"), gear("0.5")), (vec![true], vec![false]));
    let mut q = [0.0, 9.0];
    unwind(&mut q, &[7.0, 0.0], &[true, false]);
    assert_eq!(q, [TAU, 9.0]);
}

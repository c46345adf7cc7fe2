//! Covers and solids of a pair agree.

use std::sync::Arc;

use glamx::{DAffine3, DQuat, DVec3};

use crate::collision::allowed_pairs::sample;
use crate::collision::body::{MeshMode, solids};
use crate::collision::cloud::Cloud;
use crate::collision::exact::Gap;
use crate::collision::shape::Mesh;
use crate::collision::world::{Obstacle, Robot};
use crate::collision::{CheckSettings, CollisionChecker, ExactChecker, Solid, World};
use dimos_robot::builtin;
use dimos_robot::kinematics::Kinematics;
use dimos_robot::random::Random;
use dimos_robot::urdf::from_text;

/// A closed wedge: not what its hull or box is.
fn wedge() -> Mesh {
    let corners = [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [0.0, 0.3, 0.0], [0.05, 0.05, 0.3]];
    let sides = vec![[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];
    Mesh::new(corners.map(DVec3::from_array).to_vec(), sides).unwrap()
}

/// One obstacle of each kind about a robot.
fn obstacles(random: &mut Random) -> Vec<Obstacle> {
    let mut at = || {
        let mut point = || DVec3::new(random.between(-0.8, 0.8), random.between(-0.8, 0.8), random.between(0.0, 1.0));
        let (axis, place) = (point().normalize_or(DVec3::Z), point());
        DAffine3::from_rotation_translation(DQuat::from_axis_angle(axis, place.x), place)
    };
    let frames: Vec<DAffine3> = (0..7).map(|_| at()).collect();
    let points: Vec<DVec3> = (0..300).map(|_| DVec3::new(random.unit(), random.unit(), random.unit()) * 0.3).collect();
    let shapes = [
        Solid::cuboid(DVec3::new(0.1, 0.2, 0.3), frames[0]),
        Solid::sphere(0.12, frames[1]),
        Solid::cylinder(0.08, 0.4, frames[2]),
        Solid::capsule(0.05, 0.3, frames[3]),
        Solid::hull(&points, frames[4]),
        Solid::mesh(Arc::new(wedge()), frames[5]),
        Solid::cloud(Arc::new(Cloud::new(points.iter().copied()).unwrap()), 0.01, frames[6]),
    ];
    let named = shapes.into_iter().enumerate();
    named.map(|(i, solid)| Obstacle { name: format!("o{i}"), solid: solid.unwrap(), padding: 0.0 }).collect()
}

/// A checker of a robot of the program between obstacles.
fn checker(name: &str, text: &str, base: DVec3, random: &mut Random) -> ExactChecker {
    let model = from_text(name, text).unwrap();
    let mut world = World::new();
    let robot = Robot {
        name: String::new(),
        kinematics: Arc::new(Kinematics::whole(&model).unwrap()),
        solids: solids(&model, MeshMode::Hull).unwrap(),
        model: Arc::new(model),
        base: DAffine3::from_translation(base),
        padding: 0.0,
        apart: 0.0,
        proven: Vec::new(),
        allowed: vec![],
    };
    world.add_robot(robot).unwrap();
    for mut obstacle in obstacles(random) {
        obstacle.solid.frame.translation += base;
        world.add(obstacle).unwrap();
    }
    ExactChecker::new(world.snapshot(), CheckSettings::default())
}

fn random_q(checker: &ExactChecker, random: &mut Random) -> Vec<f64> {
    checker.limits().iter().map(|l| sample(l.lower, l.upper, random)).collect()
}

#[test]
fn pairs_that_covers_find_apart_are_apart_and_those_that_touch_touch() {
    let mut random = Random::new(7);
    let (mut apart, mut touching, mut open) = (0, 0, 0);
    for (name, text) in builtin::names().filter_map(|name| Some((name, builtin::text(name)?))) {
        let mut checker = checker(name, text, DVec3::new(1.0, -2.0, 0.3), &mut random).with_margin(0.01);
        for _ in 0..40 {
            let q = random_q(&checker, &mut random);
            checker.place(&q);
            checker.lanes.set(&q);
            let (none, pads) = (checker.lanes.none.clone(), checker.pads.clone());
            for pair in 0..checker.pairs.len() {
                let found = checker.lanes.find((1, 0.0), &none, &pads, &[pair as u32], None);
                let (touches, close) = (found == Some(pair), !checker.lanes.close.is_empty());
                let exact = checker.gap(pair, 0.0);
                let what = || format!("{name}: {:?} at {q:?}", checker.contact(checker.pairs[pair]));
                assert!(!touches || exact == Gap::Touch, "{}: touches with covers only", what());
                assert!(touches || close || exact == Gap::Far, "{}: apart with covers only", what());
                apart += usize::from(!touches && !close);
                touching += usize::from(touches);
                open += usize::from(close);
            }
        }
    }
    // Covers decide nearly all.
    assert!(apart + touching > 10 * open && touching > 100, "{apart} apart, {touching} touch, {open} open");
}

#[test]
fn a_motion_that_passes_touches_nothing_in_between() {
    let mut random = Random::new(8);
    let (mut free, mut not_free) = (0, 0);
    for (name, text) in builtin::names().filter_map(|name| Some((name, builtin::text(name)?))) {
        let mut checker = checker(name, text, DVec3::ZERO, &mut random);
        for _ in 0..60 {
            let (from, mut to) = (random_q(&checker, &mut random), random_q(&checker, &mut random));
            let part = random.between(0.02, 0.3);
            to.iter_mut().zip(&from).for_each(|(to, from)| *to = from + (*to - from) * part);
            let passes = checker.motion_is_free(&from, &to, &crate::collision::Stop::never());
            let mut touches = 0;
            for i in 0..=200 {
                let part = f64::from(i) / 200.0;
                let q: Vec<f64> = from.iter().zip(&to).map(|(a, b)| a + (b - a) * part).collect();
                checker.place(&q);
                touches += usize::from((0..checker.pairs.len()).any(|pair| checker.gap(pair, 0.0) == Gap::Touch));
            }
            assert!(!passes || touches == 0, "{name}: {from:?} to {to:?}: {touches} contacts");
            // A motion that does not pass touches somewhere, if only for less than a sample here.
            not_free += usize::from(!passes);
            free += usize::from(passes);
        }
    }
    assert!(free > 30 && not_free > 30, "{free} free, {not_free} not");
}

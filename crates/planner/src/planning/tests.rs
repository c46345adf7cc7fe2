//! The planner with a point in the plane, against the checker's trait alone, and with an arm that starts in contact.

use std::sync::Arc;

use dimos_kernels::block::{LANES, Lanes};
use glamx::{DAffine3, DVec3};

use super::scene::padded::{Near, Padded};
use super::search::edges::EdgeValidator;
use super::search::enclosure::enclosed;
use super::search::level::Level;
use super::search::path::{distance, length};
use super::search::path_planner::{PlanError, plan};
use super::search::rrt_connect::{Quantum, Search};
use super::search::settings::{EnclosureSettings, PlanSettings, RrtSettings};
use crate::collision::body::{MeshMode, solids};
use crate::collision::checker::{CollisionChecker, Samples, Stop};
use crate::collision::report::{Contact, Measured, Pair};
use crate::collision::settings::CheckSettings;
use crate::collision::world::{Obstacle, Robot, World};
use crate::collision::{ExactChecker, Solid};
use crate::planning::settings::PlannerSettings;
use dimos_robot::kinematics::Kinematics;
use dimos_robot::model::Limits;
use dimos_robot::random::Random;
use dimos_robot::urdf::from_text;

/// A point among round obstacles: centre and radius each.
struct Plane {
    limits: [Limits; 2],
    posts: Vec<([f64; 2], f64)>,
    checks: u64,
}

impl Plane {
    fn new(posts: Vec<([f64; 2], f64)>) -> Self {
        Self { limits: [Limits { lower: -1.0, upper: 1.0, ..Limits::NONE }; 2], posts, checks: 0 }
    }
}

impl CollisionChecker for Plane {
    fn dof(&self) -> usize {
        2
    }
    fn limits(&self) -> &[Limits] {
        &self.limits
    }
    fn turns(&self) -> &[bool] {
        &[false; 2]
    }
    fn is_free(&mut self, q: &[f64]) -> bool {
        self.checks += 1;
        self.posts.iter().all(|(c, r)| distance(c, q) > *r)
    }
    fn motion_is_free(&mut self, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        self.checks += 1;
        let near = |c: &[f64; 2]| {
            let d = [to[0] - from[0], to[1] - from[1]];
            let t = ((c[0] - from[0]) * d[0] + (c[1] - from[1]) * d[1]) / (d[0] * d[0] + d[1] * d[1]).max(1e-300);
            let t = t.clamp(0.0, 1.0);
            distance(c, &[from[0] + d[0] * t, from[1] + d[1] * t])
        };
        !stop.is_over() && self.posts.iter().all(|(c, r)| near(c) > *r)
    }
    fn motion_looks_free_at(&mut self, samples: Samples, from: &[f64], to: &[f64]) -> bool {
        // The first sample is the end.
        if samples == Samples::First { self.is_free(to) } else { self.motion_looks_free(from, to) }
    }
    fn first_contact(&mut self, q: &[f64]) -> Option<Pair> {
        (!self.is_free(q)).then_some(Pair::Obstacle(0, 0))
    }
    fn clearance(&mut self, _: &[f64]) -> Option<Contact> {
        None
    }
    fn contacts(&mut self, q: &[f64]) -> Vec<Contact> {
        let deep = self.posts.iter().enumerate().filter(|(_, (c, r))| distance(c, q) <= *r);
        let contact = |(post, (c, r)): (usize, &([f64; 2], f64))| Contact {
            pair: Pair::Obstacle(0, post),
            link: "point".into(),
            other: format!("post {post}"),
            distance: distance(c, q) - r,
            on_link: DVec3::ZERO,
            on_other: DVec3::ZERO,
            by: Measured::Shapes,
        };
        deep.map(contact).collect()
    }
    fn checks(&self) -> u64 {
        self.checks
    }
}

/// Eight joints, and a wall across the first one with a window in the next three.
struct Walled {
    limits: [Limits; 8],
    /// Half of a window's width [rad].
    window: f64,
    checks: u64,
}

impl CollisionChecker for Walled {
    fn dof(&self) -> usize {
        8
    }
    fn limits(&self) -> &[Limits] {
        &self.limits
    }
    fn turns(&self) -> &[bool] {
        &[false; 8]
    }
    fn is_free(&mut self, q: &[f64]) -> bool {
        self.checks += 1;
        !(0.4..0.5).contains(&q[0]) || q[1..4].iter().all(|x| (x - 2.0).abs() < self.window)
    }
    fn motion_is_free(&mut self, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        let steps = (distance(from, to) / 0.02).ceil().max(1.0);
        let at = |k: f64| from.iter().zip(to).map(|(a, b)| a + (b - a) * k / steps).collect::<Vec<f64>>();
        !stop.is_over() && (0..=steps as usize).all(|k| self.is_free(&at(k as f64)))
    }
    fn first_contact(&mut self, q: &[f64]) -> Option<Pair> {
        (!self.is_free(q)).then_some(Pair::Links(0, 1))
    }
    fn clearance(&mut self, _: &[f64]) -> Option<Contact> {
        None
    }
    fn contacts(&mut self, _: &[f64]) -> Vec<Contact> {
        Vec::new()
    }
    fn checks(&self) -> u64 {
        self.checks
    }
}

#[test]
fn a_window_in_a_wall_is_a_way_out_and_a_wall_without_one_encloses() {
    let limits = [Limits { lower: -3.0, upper: 3.0, ..Limits::NONE }; 8];
    let (from, other) = ([1.0, -2.0, -2.0, -2.0, 0.0, 0.0, 0.0, 0.0], vec![-1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    for seed in 0..3 {
        let encloses = |window| {
            let mut walled = Walled { limits, window, checks: 0 };
            enclosed(
                &mut walled,
                &from,
                std::slice::from_ref(&other),
                (&EnclosureSettings::default(), seed),
                &Stop::never(),
            )
        };
        // Half a percent of the wall; no joint but the first is held up.
        assert_eq!(encloses(0.5), None, "seed {seed}");
        let found = encloses(0.0).unwrap();
        assert!(found.joint == 0 && (0.5..0.54).contains(&found.reached[0]), "seed {seed}: {found:?}");
    }
}

/// Only a grid of pipes is free. Ends of edges are checked together, or not.
struct Pipes {
    looks: bool,
    checked: usize,
}

fn is_in_pipe(q: impl Iterator<Item = f32>) -> bool {
    q.map(|x| (6.0 * x).cos()).sum::<f32>() < -0.8
}

impl EdgeValidator for Pipes {
    fn is_free(&mut self, from: &[f64], to: &[f64]) -> bool {
        self.checked += 1;
        (1..=16).all(|k| is_in_pipe(from.iter().zip(to).map(|(a, b)| (a + (b - a) * f64::from(k) / 16.0) as f32)))
    }

    fn is_confirmed(&mut self, _: &[f64], _: &[f64]) -> bool {
        true
    }

    fn blocked(&mut self, q: &[Lanes], lanes: u16) -> u16 {
        let touches = |lane: &usize| self.looks && !is_in_pipe(q.iter().map(|block| block.0[*lane]));
        (0..LANES).filter(touches).fold(0, |all, lane| all | 1 << lane) & lanes
    }
}

#[test]
fn a_search_that_checks_ends_together_is_the_same_with_fewer_checks() {
    let limits = [Limits { lower: -2.0, upper: 2.0, ..Limits::NONE }; 3];
    let (mut found, mut checked) = (0, [0, 0]);
    for seed in 0..20 {
        let [alone, together] = [false, true].map(|looks| {
            let (start, goal) = ([-1.57; 3], vec![vec![1.57; 3]]);
            let mut search = Search::new(&start, &goal, (&limits, &[false; 3]), &RrtSettings::default(), 0.4, seed);
            let mut pipes = Pipes { looks, checked: 0 };
            let quantum = Quantum { edges: 4000, samples: 100_000, nodes: 10_000 };
            let path = search.run(&mut pipes, quantum, &Stop::never());
            checked[usize::from(looks)] += pipes.checked;
            (path, search.count())
        });
        assert_eq!(alone, together, "seed {seed}");
        found += usize::from(alone.0.is_some());
    }
    assert!(found > 5 && 2 * checked[1] < checked[0], "{found} found, {checked:?} checked");
}

/// Edges are free where the first joint is negative.
struct LeftOnly;

impl EdgeValidator for LeftOnly {
    fn is_free(&mut self, from: &[f64], to: &[f64]) -> bool {
        from[0] < 0.0 && to[0] < 0.0
    }

    fn is_confirmed(&mut self, _: &[f64], _: &[f64]) -> bool {
        true
    }

    fn blocked(&mut self, q: &[Lanes], lanes: u16) -> u16 {
        (0..LANES).filter(|lane| q[0].0[*lane] >= 0.0).fold(0, |all, lane| all | 1 << lane) & lanes
    }
}

#[test]
fn a_tree_that_does_not_grow_gets_samples_that_it_can_use() {
    let limits = [Limits { lower: -3.0, upper: 3.0, ..Limits::NONE }; 8];
    let settings = RrtSettings { radius: 0.5, min_radius: 0.5, ..RrtSettings::default() };
    let mut search = Search::new(&[-1.0; 8], &[vec![2.0; 8]], (&limits, &[false; 8]), &settings, 0.5, 0);
    // The start's tree grows, and nothing leads away from the goal.
    let quantum = Quantum { edges: 2000, samples: 1_000_000, nodes: 100_000 };
    assert_eq!(search.run(&mut LeftOnly, quantum, &Stop::never()), None);
    // Of the samples between the limits none is near the goal; half of them are drawn there.
    assert!(search.count().samples < 64_000, "{:?}", search.count());
}

/// Edges of which only the ends are checked until they are part of a path.
struct Ends {
    plane: Plane,
    refused: usize,
}

impl EdgeValidator for Ends {
    fn is_free(&mut self, _: &[f64], to: &[f64]) -> bool {
        self.plane.is_free(to)
    }

    fn is_confirmed(&mut self, from: &[f64], to: &[f64]) -> bool {
        let free = self.plane.motion_is_free(from, to, &Stop::never());
        self.refused += usize::from(!free);
        free
    }

    fn blocked(&mut self, _: &[Lanes], _: u16) -> u16 {
        0
    }
}

#[test]
fn what_grew_from_an_edge_that_is_not_confirmed_is_part_of_no_path() {
    // A wall of posts with a gap at its end: most edges cross it, and their ends are free.
    let wall = (0..40).map(|k| ([0.0, 0.9 - 0.04 * f64::from(k)], 0.03));
    let mut ends = Ends { plane: Plane::new(wall.collect()), refused: 0 };
    let limits = [Limits { lower: -1.0, upper: 1.0, ..Limits::NONE }; 2];
    for (seed, range) in (0..30).zip([0.3, 0.6, 1.0].into_iter().cycle()) {
        let (start, goals) = ([-0.5, 0.5], [vec![0.5, 0.5], vec![0.6, 0.8]]);
        let mut search = Search::new(&start, &goals, (&limits, &[false; 2]), &RrtSettings::default(), range, seed);
        let quantum = Quantum { edges: 100_000, samples: 1_000_000, nodes: 100_000 };
        let path = search.run(&mut ends, quantum, &Stop::never()).expect("a path");
        assert!(path[0] == start && goals.contains(path.last().unwrap()));
        assert!(path.windows(2).all(|edge| ends.plane.motion_is_free(&edge[0], &edge[1], &Stop::never())), "{path:?}");
    }
    assert!(ends.refused > 100, "{}", ends.refused);
}

#[test]
fn every_edge_of_every_plan_is_free() {
    let mut random = Random::new(1);
    let mut searched = 0;
    for seed in 0..300 {
        let posts =
            (0..12).map(|_| ([random.between(-0.8, 0.8), random.between(-0.8, 0.8)], random.between(0.02, 0.2)));
        let mut plane = Plane::new(posts.collect());
        let (start, goals) = ([-0.95, -0.95], [vec![0.95, 0.95], vec![0.95, -0.9]]);
        let level = [Level::Fast, Level::Certified, Level::Exact][seed as usize % 3];
        let settings = PlanSettings { seed, level, refine: 4 * (seed as u32 % 2), ..PlanSettings::default() };
        let found = plan(&mut plane, &start, &goals, &settings, &Stop::never()).unwrap();
        assert_eq!(found.path, plan(&mut plane, &start, &goals, &settings, &Stop::never()).unwrap().path);
        assert!(found.path.windows(2).all(|e| plane.motion_is_free(&e[0], &e[1], &Stop::never())));
        assert!(goals.contains(found.path.last().unwrap()) && (found.length - length(&found.path)).abs() < 1e-12);
        searched += usize::from(!found.straight);
    }
    assert!(searched > 20, "{searched}");
}

#[test]
fn more_rounds_of_refinement_give_shorter_paths_and_the_same_number_the_same() {
    // Around a post: two tangents and an arc are the shortest way.
    let mut plane = Plane::new(vec![([0.0, 0.0], 0.4)]);
    let (start, goals) = ([-0.9, 0.0], [vec![0.9, 0.0]]);
    let shortest = 2.0 * (0.81_f64 - 0.16).sqrt() + 0.4 * (std::f64::consts::PI - 2.0 * (0.4_f64 / 0.9).acos());
    for seed in 0..10 {
        let mut refined = |refine| {
            let settings = PlanSettings { seed, refine, ..PlanSettings::default() };
            let found = plan(&mut plane, &start, &goals, &settings, &Stop::never()).unwrap();
            let again = plan(&mut plane, &start, &goals, &settings, &Stop::never()).unwrap();
            assert_eq!((&found.path, found.refined), (&again.path, refine));
            assert!(found.path.windows(2).all(|e| plane.motion_is_free(&e[0], &e[1], &Stop::never())));
            assert!((found.length - length(&found.path)).abs() < 1e-12);
            found.length
        };
        let lengths = [0, 10, 100, 400].map(&mut refined);
        assert!(lengths.is_sorted_by(|a, b| a >= b), "{lengths:?}");
        assert!(lengths[3] >= shortest && lengths[3] < 1.01 * shortest, "{lengths:?} of {shortest}");
    }
}

#[test]
fn a_search_without_a_path_ends_at_its_maximum_counts() {
    // The goal is enclosed by a ring of overlapping posts.
    let ring = (0..40).map(|k| f64::from(k) * std::f64::consts::TAU / 40.0);
    let mut plane = Plane::new(ring.map(|a| ([0.3 * a.cos(), 0.3 * a.sin()], 0.04)).collect());
    let found = plan(&mut plane, &[-0.9, -0.9], &[vec![0.0, 0.0]], &PlanSettings::default(), &Stop::never());
    let Err(PlanError::Enclosed { which: "goal", enclosed }) = found else { panic!("{found:?}") };
    assert!(enclosed.reached.iter().all(|end| (0.2..0.27).contains(&end.abs())), "{enclosed:?}");
    assert!(!enclosed.contacts.is_empty() && enclosed.pairs().contains("obstacle \"post "), "{}", enclosed.pairs());
    let found =
        plan(&mut plane, &[0.0, 0.0], &[vec![-0.9, 0.0], vec![0.9, 0.9]], &PlanSettings::default(), &Stop::never());
    assert!(matches!(found, Err(PlanError::Enclosed { which: "start", .. })), "{found:?}");
    // One of several goals is not enclosed.
    let goals = [vec![0.0, 0.0], vec![0.9, 0.9]];
    let found = plan(&mut plane, &[-0.9, -0.9], &goals, &PlanSettings::default(), &Stop::never()).unwrap();
    assert_eq!(found.path.last(), Some(&goals[1]));

    let mut settings = PlanSettings::default();
    settings.search.max_samples = 5000;
    let found = plan(&mut plane, &[-0.9, -0.9], &[vec![0.0, 0.0]], &settings, &Stop::never());
    assert!(matches!(found, Err(PlanError::Exhausted(count)) if count.samples == 5000), "{found:?}");
    settings.search.max_nodes = 50;
    let found = plan(&mut plane, &[-0.9, -0.9], &[vec![0.0, 0.0]], &settings, &Stop::never());
    assert!(
        matches!(found, Err(PlanError::Exhausted(count)) if count.nodes >= 50 && count.samples < 5000),
        "{found:?}"
    );
}

/// An arm with one joint about z within these limits [rad], and a ball 0.5 m from it.
fn pointer(lower: f64, upper: f64) -> Robot {
    let text = format!(
        r#"<robot name="r"><link name="base"/><link name="l"><collision><origin xyz="0.5 0 0"/>
<geometry><sphere radius="0.05"/></geometry></collision></link><joint name="j" type="revolute"><parent link="base"/>
<child link="l"/><axis xyz="0 0 1"/><limit lower="{lower}" upper="{upper}" velocity="1" effort="1"/></joint></robot>"#
    );
    let model = Arc::new(from_text("r.urdf", &text).unwrap());
    Robot {
        name: String::new(),
        kinematics: Arc::new(Kinematics::whole(&model).unwrap()),
        solids: solids(&model, MeshMode::Hull).unwrap(),
        model,
        base: DAffine3::IDENTITY,
        padding: 0.0,
        apart: 0.0,
        proven: Vec::new(),
        allowed: vec![],
    }
}

#[test]
fn a_pair_is_always_closer_than_the_padding_if_it_is_so_within_the_limits() {
    let mut world = World::new();
    // A range beyond a half turn.
    world.add_robot(pointer(4.0, 4.2)).unwrap();
    let below = DAffine3::from_translation(DVec3::new(0.5 * 4.1_f64.cos(), 0.5 * 4.1_f64.sin(), -0.11));
    world.add(Obstacle { name: "post".into(), solid: Solid::sphere(0.05, below).unwrap(), padding: 0.0 }).unwrap();
    let mut checker = Padded::new(world.snapshot(), 0.03, &PlannerSettings::default());
    checker.relax(Near::Start, &[4.1]);
    let near: Vec<Near> = checker.exceptions().iter().map(|exception| exception.near).collect();
    assert_eq!(near, [Near::Everywhere]);
}

#[test]
fn what_is_within_the_padding_only_is_not_blocked_near_a_start() {
    let mut world = World::new();
    world.add_robot(pointer(-2.0, 2.0)).unwrap();
    // 10 mm from the arm at 0 rad, and in the arm's way at -0.5 rad: half a metre out.
    for (name, turn, below) in [("near", 0.0_f64, -0.11), ("in the way", -0.5, 0.0)] {
        let at = DAffine3::from_translation(DVec3::new(0.5 * turn.cos(), 0.5 * turn.sin(), below));
        let solid = Solid::sphere(0.05, at).unwrap();
        world.add(Obstacle { name: name.into(), solid, padding: 0.0 }).unwrap();
    }
    let mut checker = Padded::new(world.snapshot(), 0.03, &PlannerSettings::default());
    let q = [Lanes(std::array::from_fn(|lane| [0.0, 1.5, -0.5][lane % 3]))];
    let [near, free, in_the_way] = [0o111111, 0o22222, 0o44444];
    assert_eq!(checker.any_contact_batch(&q, u16::MAX) & free, 0);
    assert_eq!(checker.any_contact_batch(&q, u16::MAX), near | in_the_way);
    checker.relax(Near::Start, &[0.0]);
    assert!(checker.is_free(&[0.0]), "{:?}", checker.exceptions());
    assert_eq!(checker.any_contact_batch(&q, u16::MAX), in_the_way);
    assert_eq!(checker.any_contact_batch(&q, 0o4), 0o4);
}

#[test]
fn a_start_in_slight_contact_is_escaped_and_a_deep_one_is_reported() {
    let mut world = World::new();
    world.add_robot(pointer(-2.0, 2.0)).unwrap();
    let mut from = |overlap: f64| {
        let at = DAffine3::from_translation(DVec3::new(0.5, 0.1 - overlap, 0.0));
        let solid = Solid::sphere(0.05, at).unwrap();
        world.put(Obstacle { name: "post".into(), solid, padding: 0.0 }).unwrap();
        let mut checker = ExactChecker::new(world.snapshot(), CheckSettings::default());
        plan(&mut checker, &[0.0], &[vec![-1.0]], &PlanSettings::default(), &Stop::never())
    };
    let found = from(0.002).unwrap();
    assert_eq!(found.path[0], [0.0]);
    assert!(found.path.len() == 3 && found.path[1][0] < 0.0, "{:?}", found.path);
    assert!(from(-0.01).unwrap().straight);
    let error = from(0.01).unwrap_err();
    assert!(error.to_string().contains("0.0100 m deep in obstacle \"post\""), "{error}");
}

//! Tests of worlds and the exact checker.

use std::sync::Arc;

use glamx::{DAffine3, DVec3};

use super::allowed_pairs::always_touching;
use super::body::{MeshMode, of_mesh, solids, surface};
use super::checker::{CollisionChecker, Stop};
use super::exact::ExactChecker;
use super::report::Pair;
use super::settings::CheckSettings;
use super::shape::Solid;
use super::world::{Attached, Obstacle, Robot, World, WorldError};
use nalgebra::Point3;

use dimos_robot::kinematics::Kinematics;
use dimos_robot::mesh::Mesh;
use dimos_robot::random::Random;
use dimos_robot::urdf::from_text;

/// Three links in a plane, each a capsule-like box of 0.4 m.
const ARM: &str = r#"<robot name="arm"><link name="base"><collision><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="l1"><collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.05 0.05"/></geometry></collision></link>
<link name="l2"><collision><origin xyz="0.2 0 0" rpy="0 1.5707963 0"/><geometry><cylinder radius="0.03" length="0.4"/></geometry></collision></link>
<link name="l3"><collision><origin xyz="0.15 0 0"/><geometry><sphere radius="0.05"/></geometry></collision></link>
<joint name="j1" type="revolute"><parent link="base"/><child link="l1"/><origin xyz="0 0 0.1"/><axis xyz="0 0 1"/><limit lower="-3.1" upper="3.1" velocity="1" effort="1"/></joint>
<joint name="j2" type="revolute"><parent link="l1"/><child link="l2"/><origin xyz="0.4 0 0"/><axis xyz="0 0 1"/><limit lower="-3.1" upper="3.1" velocity="1" effort="1"/></joint>
<joint name="j3" type="revolute"><parent link="l2"/><child link="l3"/><origin xyz="0.4 0 0"/><axis xyz="0 0 1"/><limit lower="-3.1" upper="3.1" velocity="1" effort="1"/></joint></robot>"#;

fn arm(name: &str, base: DVec3) -> Robot {
    let model = from_text("arm.urdf", ARM).unwrap();
    Robot {
        name: name.into(),
        kinematics: Arc::new(Kinematics::whole(&model).unwrap()),
        solids: solids(&model, MeshMode::Hull).unwrap(),
        model: Arc::new(model),
        base: DAffine3::from_translation(base),
        padding: 0.0,
        apart: 0.0,
        proven: Vec::new(),
        allowed: vec![],
    }
}

fn ball(name: &str, at: DVec3, radius: f64) -> Obstacle {
    let solid = Solid::sphere(radius, DAffine3::from_translation(at)).unwrap();
    Obstacle { name: name.into(), solid, padding: 0.0 }
}

fn checker(world: &World) -> ExactChecker {
    ExactChecker::new(world.snapshot(), CheckSettings::default())
}

fn one_arm(obstacles: &[Obstacle]) -> World {
    let mut world = World::new();
    world.add_robot(arm("", DVec3::ZERO)).unwrap();
    obstacles.iter().for_each(|o| world.add(o.clone()).unwrap());
    world
}

#[test]
fn contacts_report_names_and_depth() {
    let world = one_arm(&[ball("post", DVec3::new(0.95, 0.08, 0.1), 0.05)]);
    let mut checker = checker(&world);
    let contacts = checker.contacts(&[0.0; 3]);
    assert_eq!(contacts.len(), 1, "{contacts:?}");
    assert_eq!((contacts[0].link.as_str(), contacts[0].other.as_str()), ("l3", "post"));
    assert!((contacts[0].distance + 0.02).abs() < 1e-9);
    assert_eq!(contacts[0].to_string(), "link \"l3\" is 0.0200 m deep in obstacle \"post\"");
    assert!(!checker.is_free(&[0.0; 3]) && checker.is_free(&[-1.0, 0.0, 0.0]));
    // The other links are farther away than this one.
    let near = checker.clearance(&[-0.1, 0.0, 0.0]).unwrap();
    assert!(near.distance > 0.0 && near.other == "post", "{near}");
    assert!((near.on_link.distance(near.on_other) - near.distance).abs() < 1e-9);
}

#[test]
fn an_end_effector_and_what_it_holds_touch_only_what_they_may() {
    let posts = [ball("post", DVec3::new(0.95, 0.08, 0.1), 0.05), ball("wall", DVec3::new(0.95, -0.08, 0.1), 0.05)];
    let mut world = one_arm(&posts);
    world.add(ball("middle", DVec3::new(0.6, 0.06, 0.1), 0.05)).unwrap();
    let held = Solid::sphere(0.06, DAffine3::from_translation(DVec3::new(0.15, 0.0, 0.0))).unwrap();
    let held = Attached {
        name: "cup".into(),
        robot: 0,
        link: "l3".into(),
        solids: vec![held],
        touch_links: vec![],
        padding: 0.0,
    };
    world.attach(held).unwrap();
    let tip = world.robots()[0].model.link_index("l3").unwrap();
    let touching = |world: &World| -> Vec<[String; 2]> {
        let contacts = checker(world).contacts(&[0.0; 3]).into_iter();
        contacts.map(|contact| [contact.link, contact.other]).collect()
    };
    let all = ["l3 post", "l3 wall", "cup post", "cup wall", "l2 middle"];
    let expect = |world: &World, left: &[&str]| {
        let mut found: Vec<String> = touching(world).iter().map(|pair| pair.join(" ")).collect();
        found.sort();
        let mut left: Vec<String> = left.iter().map(|pair| (*pair).to_owned()).collect();
        left.sort();
        assert_eq!(found, left);
    };
    expect(&world, &all);
    let posts = ["post".to_owned(), "middle".to_owned()];
    expect(&world.letting_touch(0, tip, &posts), &["l3 wall", "cup wall", "l2 middle"]);
    let from_forearm = world.robots()[0].model.link_index("l2").unwrap();
    expect(&world.letting_touch(0, from_forearm, &posts), &["l3 wall", "cup wall"]);
}

#[test]
fn padding_and_snapshots_hold() {
    let post = ball("post", DVec3::new(0.95, 0.11, 0.1), 0.05);
    let mut world = one_arm(std::slice::from_ref(&post));
    let before = world.snapshot();
    assert!(checker(&world).is_free(&[0.0; 3]));
    world.put(Obstacle { padding: 0.02, ..post.clone() }).unwrap();
    assert!(!checker(&world).is_free(&[0.0; 3]));
    assert!(ExactChecker::new(before, CheckSettings::default()).is_free(&[0.0; 3]));
    assert_eq!(world.add(post.clone()), Err(WorldError::Taken("post".into())));
    assert_eq!(world.remove("wall").map(|o| o.name), Err(WorldError::Unknown("wall".into())));
    world.move_to("post", DAffine3::from_translation(DVec3::new(0.3, 0.0, 0.1))).unwrap();
    assert!(!checker(&world).is_free(&[0.0; 3]));
    assert!(world.put(Obstacle { padding: f64::NAN, ..post }).is_err());
}

#[test]
fn a_robot_that_may_be_off_its_model_keeps_that_distance() {
    let mut world = World::new();
    world.add_robot(Robot { apart: 0.02, ..arm("", DVec3::ZERO) }).unwrap();
    world.add(ball("post", DVec3::new(0.95, 0.11, 0.1), 0.05)).unwrap();
    assert!(checker(&world).is_free(&[0.0; 3]), "contact is contact");
    assert!(!checker(&world).with_padding(0.0).is_free(&[0.0; 3]));
    let folded = [0.0, 2.6, 2.6];
    let is_free = checker(&world).is_free(&folded);
    assert_eq!(checker(&world).with_padding(0.0).is_free(&folded), is_free, "its own links are where they are");
}

#[test]
fn neighbours_may_touch_and_others_may_not() {
    let mut checker = checker(&one_arm(&[]));
    assert!(checker.is_free(&[0.0; 3]));
    // Folded back onto itself: the end-effector link over the first link.
    assert_eq!(checker.first_contact(&[0.0, 3.05, 3.05]), Some(Pair::Links(1, 3)));
    let mut world = World::new();
    world
        .add_robot(Robot {
            allowed: vec![("l3".into(), "l1".into()), ("base".into(), "l3".into()), ("base".into(), "l2".into())],
            ..arm("", DVec3::ZERO)
        })
        .unwrap();
    assert!(self::checker(&world).is_free(&[0.0, 3.05, 3.05]));
}

#[test]
fn two_robots_see_each_other() {
    let mut world = World::new();
    world.add_robot(arm("left", DVec3::ZERO)).unwrap();
    world.add_robot(arm("right", DVec3::new(1.5, 0.0, 0.0))).unwrap();
    assert!(world.add_robot(arm("left", DVec3::ZERO)).is_err());
    let mut checker = checker(&world);
    assert_eq!(checker.dof(), 6);
    assert_eq!(checker.scene().joint_names()[3], "right/j1");
    let away = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    assert!(checker.is_free(&away));
    let towards = [0.0, 0.0, 0.0, 3.1, 0.0, 0.0];
    let contacts = checker.contacts(&towards);
    assert!(contacts.iter().any(|c| c.link.starts_with("left/") && c.other.starts_with("right/")), "{contacts:?}");
}

#[test]
fn held_objects_move_with_the_arm_and_keep_their_allowed_pairs() {
    let mut world = one_arm(&[ball("post", DVec3::new(1.2, 0.0, 0.1), 0.05)]);
    assert!(checker(&world).is_free(&[0.0; 3]));
    let rod =
        Solid::cuboid(DVec3::new(0.4, 0.02, 0.02), DAffine3::from_translation(DVec3::new(0.2, 0.0, 0.0))).unwrap();
    let held = Attached {
        name: "rod".into(),
        robot: 0,
        link: "l3".into(),
        solids: vec![rod],
        touch_links: vec!["l2".into()],
        padding: 0.0,
    };
    world.attach(held.clone()).unwrap();
    assert_eq!(checker(&world).contacts(&[0.0; 3])[0].link, "rod");
    assert!(checker(&world).is_free(&[0.5, 0.0, 0.0]));
    assert!(world.attach(held).is_err());
    world.detach("rod").unwrap();
    assert!(checker(&world).is_free(&[0.0; 3]));
}

#[test]
fn pairs_that_always_touch_are_reported_by_name() {
    let mut robot = arm("", DVec3::ZERO);
    robot.solids[2].push(Solid::sphere(0.2, DAffine3::from_translation(DVec3::new(-0.4, 0.0, 0.0))).unwrap());
    let mut world = World::new();
    world.add_robot(robot).unwrap();
    let suspects = always_touching(&world.snapshot(), &[0.0; 3], 200, 7);
    assert_eq!((suspects[0].contact.link.as_str(), suspects[0].contact.other.as_str()), ("base", "l2"));
    assert!(suspects[0].at_home);
    assert_eq!(suspects, always_touching(&world.snapshot(), &[0.0; 3], 200, 7));
    assert!(always_touching(&one_arm(&[]).snapshot(), &[0.0; 3], 200, 7).is_empty());
}

/// A motion reported as free is free at ten times any sampling density; a blocked one touches.
#[test]
fn a_cylinder_with_a_sphere_at_each_end_is_one_capsule() {
    let shapes = |second: f64| {
        let sphere = |z: f64, r: f64| {
            format!("<collision><origin xyz='0 {z} 1'/><geometry><sphere radius='{r}'/></geometry></collision>")
        };
        let text = format!(
            "<robot name='r'><link name='l'>{}<collision><origin xyz='0 0.2 1' rpy='1.5707963267948966 0 0'/><geometry>\
             <cylinder radius='0.1' length='0.4'/></geometry></collision>{}</link></robot>",
            sphere(0.0, 0.1),
            sphere(0.4, second)
        );
        solids(&from_text("r.urdf", &text).unwrap(), MeshMode::Hull).unwrap().remove(0)
    };
    let [capsule] = &shapes(0.1)[..] else { panic!("{} solids", shapes(0.1).len()) };
    assert!(matches!(capsule.core, super::shape::Core::Segment { half } if (half - 0.2).abs() < 1e-12));
    assert_eq!((capsule.radius, shapes(0.11).len()), (0.1, 3));
}

#[test]
fn a_free_motion_is_free_between_samples() {
    let mut random = Random::new(21);
    let (mut free, mut blocked) = (0, 0);
    for round in 0..12 {
        let mut balls = Vec::new();
        for i in 0..6 {
            let at = DVec3::new(random.between(-0.9, 0.9), random.between(-0.9, 0.9), 0.1);
            // Thin posts fit between the samples of a coarse check.
            balls.push(ball(&format!("post{i}"), at, random.between(0.002, 0.03)));
        }
        let mut checker = checker(&one_arm(&balls));
        for _ in 0..40 {
            let mut q = || -> Vec<f64> { (0..3).map(|_| random.between(-3.0, 3.0)).collect() };
            let (a, b) = (q(), q());
            let is_free = checker.motion_is_free(&a, &b, &Stop::never());
            let steps = 1500;
            let mut touches = (0..=steps).filter(|k| {
                let t = f64::from(*k) / f64::from(steps);
                let at: Vec<f64> = a.iter().zip(&b).map(|(a, b)| a + (b - a) * t).collect();
                !checker.is_free(&at)
            });
            if is_free {
                free += 1;
                assert_eq!(touches.next(), None, "round {round}: {a:?} {b:?}");
            } else {
                blocked += 1;
                assert!(touches.next().is_some(), "round {round}: {a:?} {b:?}");
            }
        }
    }
    assert!(free > 40 && blocked > 40, "{free} {blocked}");
}

#[test]
fn a_stop_ends_a_motion_check() {
    let mut checker = checker(&one_arm(&[ball("post", DVec3::new(0.95, 0.5, 0.1), 0.05)]));
    let flag = Arc::new(std::sync::atomic::AtomicBool::new(true));
    let stop = Stop::new(None, Some(flag));
    assert!(!checker.motion_is_free(&[0.0; 3], &[-1.0, 0.0, 0.0], &stop) && stop.is_cancelled());
    assert!(checker.motion_is_free(&[0.0; 3], &[-1.0, 0.0, 0.0], &Stop::never()));
}

/// A fork: a palm of 40 cm × 10 cm × 10 cm along x, and two fingers of 30 cm along y at its ends.
fn fork() -> Mesh {
    let (mut vertices, mut triangles) = (Vec::new(), Vec::new());
    // The outline in the plane, and the quadrilaterals that fill it.
    let outline = [[0.0, 0.0], [0.4, 0.0], [0.4, 0.4], [0.3, 0.4], [0.3, 0.1], [0.1, 0.1], [0.1, 0.4], [0.0, 0.4]];
    for z in [-0.05, 0.05] {
        vertices.extend(outline.iter().map(|[x, y]| Point3::new(*x, *y, z)));
    }
    for [a, b, c] in [[0, 5, 1], [1, 5, 4], [1, 4, 3], [1, 3, 2], [0, 7, 6], [0, 6, 5]] {
        triangles.extend([[a, b, c], [a + 8, c + 8, b + 8]]);
    }
    for i in 0..8u32 {
        let next = (i + 1) % 8;
        triangles.extend([[i, next, next + 8], [i, next + 8, i + 8]]);
    }
    Mesh { vertices, triangles }
}

#[test]
fn what_no_joint_moves_is_not_checked_and_named() {
    let table = Solid::cuboid(DVec3::new(2.0, 2.0, 0.1), DAffine3::from_translation(DVec3::Z * -0.05)).unwrap();
    let mut robot = arm("", DVec3::ZERO);
    robot.solids[0] = vec![Solid::cuboid(DVec3::splat(0.1), DAffine3::from_translation(DVec3::Z * 0.05)).unwrap()];
    let mut world = World::new();
    world.add_robot(robot).unwrap();
    world.add(Obstacle { name: "table".into(), solid: table, padding: 0.0 }).unwrap();
    let mut checker = checker(&world).with_padding(0.003);
    assert_eq!(checker.fixed_contacts(), [["base".to_owned(), "table".to_owned()]]);
    assert!(checker.is_free(&[0.0; 3]), "{:?}", checker.contacts(&[0.0; 3]));
    assert!(checker.motion_is_free(&[0.0; 3], &[0.5, 0.2, 0.1], &Stop::never()));
}

#[test]
fn what_is_between_the_fingers_of_a_fork_is_not_in_it() {
    // A box of 10 cm × 20 cm × 10 cm about the centre of the fork's bounding box, 5 cm from each finger.
    let corner = |i: u32| {
        let sign = |bit: u32| if i >> bit & 1 == 0 { -1.0 } else { 1.0 };
        Point3::new(0.2 + 0.05 * sign(0), 0.25 + 0.1 * sign(1), 0.1 + 0.05 * sign(2))
    };
    let quads = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
    let triangles = quads.iter().flat_map(|q: &[u32; 4]| [[q[0], q[1], q[2]], [q[0], q[2], q[3]]]).collect();
    let block = Mesh { vertices: (0..8).map(corner).collect(), triangles };
    let free = |shift: f64| {
        let mut robot = arm("", DVec3::ZERO);
        robot.solids = vec![vec![], of_mesh(&fork(), MeshMode::Triangles, DAffine3::IDENTITY).unwrap(), vec![], vec![]];
        let mut world = World::new();
        world.add_robot(robot).unwrap();
        let solid = surface(&block, DAffine3::from_translation(DVec3::X * shift)).unwrap();
        world.add(Obstacle { name: "block".into(), solid, padding: 0.0 }).unwrap();
        checker(&world).is_free(&[0.0; 3])
    };
    assert!(free(0.0) && free(0.04));
    assert!(!free(0.06) && !free(-0.06), "it is in a finger");
}

#[test]
fn a_decomposition_contains_the_mesh_and_leaves_its_gap_free() {
    let touched = |mode: MeshMode, at: DVec3| {
        let mut robot = arm("", DVec3::ZERO);
        robot.solids = vec![vec![], of_mesh(&fork(), mode, DAffine3::IDENTITY).unwrap(), vec![], vec![]];
        let mut world = World::new();
        world.add_robot(robot).unwrap();
        world.add(ball("ball", DVec3::Z * 0.1 + at, 0.002)).unwrap();
        !checker(&world).contacts(&[0.0; 3]).is_empty()
    };
    let between = DVec3::new(0.2, 0.25, 0.0);
    assert!(touched(MeshMode::Hull, between), "a hull fills the gap");
    for mode in [MeshMode::Decomposition, MeshMode::Triangles] {
        assert!(!touched(mode, between), "{mode:?}");
        // Over the whole surface, and inside a finger.
        let mut random = Random::new(7);
        let mesh = fork();
        for [a, b, c] in &mesh.triangles {
            let [a, b, c] = [a, b, c].map(|i| mesh.vertices[*i as usize]);
            let (s, t) = (random.unit(), random.unit());
            let (s, t) = if s + t > 1.0 { (1.0 - s, 1.0 - t) } else { (s, t) };
            let p = a + (b - a) * s + (c - a) * t;
            assert!(touched(mode, DVec3::new(p.x, p.y, p.z)), "{mode:?} {p}");
        }
        assert!(touched(mode, DVec3::new(0.05, 0.3, 0.0)), "{mode:?}");
    }
}

/// Pieces of a motion that touched were checked again as pieces of the next one, past its end.
#[test]
fn a_check_does_not_depend_on_earlier_ones() {
    let world =
        one_arm(&[ball("near", DVec3::new(0.9, 0.35, 0.1), 0.1), ball("far", DVec3::new(-0.3, 0.8, 0.1), 0.15)]);
    let mut random = Random::new(3);
    let (fresh, mut used) = (checker(&world), checker(&world));
    let (mut free, mut number) = (0, 0);
    for _ in 0..300 {
        let from: Vec<f64> = (0..3).map(|_| random.between(-3.0, 3.0)).collect();
        if !used.is_free(&from) {
            continue;
        }
        for _ in 0..4 {
            // Up to just before the first contact, and a little farther.
            let to: Vec<f64> = from.iter().map(|q| (q + random.between(-0.7, 0.7)).clamp(-3.1, 3.1)).collect();
            for part in [0.25, 0.5, 0.75, 1.0] {
                let end: Vec<f64> = from.iter().zip(&to).map(|(a, b)| a + (b - a) * part).collect();
                let now = used.motion_is_free(&from, &end, &Stop::never());
                assert_eq!(now, fresh.clone().motion_is_free(&from, &end, &Stop::never()), "{from:?} to {end:?}");
                (free, number) = (free + u32::from(now), number + 1);
            }
        }
    }
    println!("{free} of {number} motions are free");
    assert!(free > number / 4 && free < number);
}

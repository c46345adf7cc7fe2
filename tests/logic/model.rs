//! Robot descriptions: the vendors' in `../shared`, and the built-in ones.

use std::collections::HashMap;
use std::path::PathBuf;

use dimos::robot::mesh::Mesh;
use dimos::robot::urdf::Meshes;
use dimos::robot::{Geometry, Link, RobotModel, Source, builtin, load};
use nalgebra::{Isometry3, Point3, Vector3};

use crate::support::shared;

fn robot(source: &Source) -> RobotModel {
    load(source).into_model().unwrap_or_else(|e| panic!("{e}"))
}

fn built_in(name: &str) -> RobotModel {
    robot(&Source::new(format!("builtin:{name}")))
}

/// Numbers in -1…1, the same in every run.
fn random(seed: u64) -> impl FnMut() -> f64 {
    let mut state = seed;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 33) as f64 / f64::from(1_u32 << 30) - 1.0
    }
}

#[test]
fn vendors_models_are_read_with_their_meshes() {
    let Some(models) = shared::shared("models") else { return };
    for (name, links, moving) in [("panda", 14, 8), ("piper", 11, 8), ("xarm6", 17, 7), ("xarm7", 18, 8)] {
        let loaded = load(&Source::new(models.join(name).join(format!("{name}.urdf"))));
        assert_eq!(loaded.render(false), "", "{name}");
        let robot = loaded.model.unwrap();
        assert_eq!((robot.links.len(), robot.independent_joints().len()), (links, moving), "{name}");
        for mesh in robot.meshes() {
            let read = Mesh::load(mesh).unwrap_or_else(|e| panic!("{e}"));
            let (low, high) = read.bounds();
            assert!((high - low).norm() < 1.0, "{}: {low} {high}", mesh.uri);
            assert!(read.vertices.len() * 3 < read.triangles.len() * 4, "{}: not welded", mesh.uri);
        }
    }
}

/// The same files through another reader: `urdf-rs`.
#[test]
fn another_reader_reads_the_same() {
    let Some(shared) = shared::shared("models") else { return };
    let mut files: Vec<PathBuf> =
        ["panda", "piper", "xarm6", "xarm7"].map(|n| shared.join(n).join(format!("{n}.urdf"))).to_vec();
    files.push(shared.join("../planning/panda/panda_spherized.urdf"));
    files.push(shared.join("../planning/panda/panda.urdf"));
    let texts = files.iter().map(|f| (f.display().to_string(), std::fs::read_to_string(f).unwrap()));
    let own = builtin::NAMES.iter().map(|n| ((*n).to_owned(), builtin::text(n).unwrap().to_owned()));
    for (name, text) in texts.chain(own) {
        let ours = dimos::robot::urdf::from_text(&name, &text).unwrap();
        let theirs = urdf_rs::read_from_string(&text).unwrap();
        assert_eq!((ours.links.len(), ours.joints.len()), (theirs.links.len(), theirs.joints.len()), "{name}");
        for joint in &theirs.joints {
            let own = &ours.joints[ours.joint_index(&joint.name).unwrap()];
            let [r, p, y] = *joint.origin.rpy;
            let pose = dimos::pose::from_xyz_rpy(*joint.origin.xyz, [r, p, y]);
            assert!((own.origin.to_homogeneous() - pose.to_homogeneous()).norm() < 1e-15, "{name} {}", joint.name);
            assert_eq!(ours.links[own.parent].name, joint.parent.link);
            assert_eq!(ours.links[own.child].name, joint.child.link);
            if own.kind.name() == "revolute" || own.kind.name() == "prismatic" {
                assert!(
                    (own.axis.into_inner() - Vector3::from(*joint.axis.xyz)).norm() < 1e-15,
                    "{name} {}",
                    joint.name
                );
                // Soft limits are the narrower ones.
                let soft = joint.safety_controller.as_ref();
                let lower = soft.map_or(f64::MIN, |soft| soft.soft_lower_limit).max(joint.limit.lower);
                let upper = soft.map_or(f64::MAX, |soft| soft.soft_upper_limit).min(joint.limit.upper);
                let limits = (own.limits.lower, own.limits.upper, own.limits.velocity);
                assert_eq!(limits, (lower, upper, joint.limit.velocity), "{name} {}", joint.name);
            }
        }
        for link in &theirs.links {
            let own = &ours.links[ours.link_index(&link.name).unwrap()];
            assert_eq!((own.visuals.len(), own.collisions.len()), (link.visual.len(), link.collision.len()), "{name}");
        }
    }
}

/// Makes two robots differ by nothing but rounding of their poses.
fn same_robot(what: &str, a: &RobotModel, b: &RobotModel) {
    fn poses(robot: &mut RobotModel) -> Vec<Isometry3<f64>> {
        let mut all: Vec<_> = robot.joints.iter_mut().map(|joint| std::mem::take(&mut joint.origin)).collect();
        for link in &mut robot.links {
            let shapes = link.visuals.iter_mut().chain(&mut link.collisions);
            all.extend(shapes.map(|shape| std::mem::take(&mut shape.origin)));
            all.extend(link.inertial.iter_mut().map(|inertial| std::mem::take(&mut inertial.origin)));
        }
        all
    }
    let (mut a, mut b) = (a.clone(), b.clone());
    let (in_a, in_b) = (poses(&mut a), poses(&mut b));
    assert_eq!(a, b, "{what}");
    for (one, other) in in_a.iter().zip(&in_b) {
        assert!((one.to_homogeneous() - other.to_homogeneous()).amax() < 1e-9, "{what}: {one} {other}");
    }
}

#[test]
fn a_robot_goes_through_urdf_rs_and_back() {
    for name in builtin::NAMES {
        let text = builtin::text(name).unwrap();
        let ours = dimos::robot::urdf::from_text(name, text).unwrap();
        let theirs = urdf_rs::Robot::from(&ours);
        same_robot(name, &ours, &RobotModel::try_from(&theirs).unwrap());
        // As a file, and as their reader has it.
        let written = urdf_rs::write_to_string(&theirs).unwrap();
        let read = urdf_rs::read_from_string(&written).unwrap();
        same_robot(name, &ours, &RobotModel::try_from(&read).unwrap());
        same_robot(name, &ours, &RobotModel::try_from(&urdf_rs::read_from_string(text).unwrap()).unwrap());
    }
}

#[test]
fn what_urdf_rs_takes_for_a_robot_is_checked_all_the_same() {
    let text = builtin::text("yourarm").unwrap();
    let with = |change: &dyn Fn(&mut urdf_rs::Robot)| {
        let mut robot = urdf_rs::read_from_string(text).unwrap();
        change(&mut robot);
        RobotModel::try_from(&robot).unwrap_err().to_string()
    };
    assert!(with(&|robot| robot.joints[1].child.link = "link1".into()).contains("two parents"));
    assert!(with(&|robot| robot.joints[3].joint_type = urdf_rs::JointType::Floating).contains("are not supported"));
    assert!(with(&|robot| drop(robot.joints.pop())).contains("both have no parent"));
}

/// Poses of links in the frame of `base`, for joints by name.
fn poses(robot: &RobotModel, base: &str, joints: &HashMap<String, f64>) -> HashMap<String, Isometry3<f64>> {
    let all = robot.link_poses(&robot.positions(joints));
    let base = all[robot.link_index(base).unwrap()].inverse();
    robot.links.iter().zip(all).map(|(link, pose)| (link.name.clone(), base * pose)).collect()
}

fn agree(ours: &RobotModel, theirs: &RobotModel, base: &str, least: usize) {
    let mut next = random(3);
    let mut compared = 0;
    for _ in 0..50 {
        let joints: HashMap<String, f64> = theirs
            .independent_joints()
            .iter()
            .map(|i| {
                (theirs.joints[*i].name.clone(), next() * if theirs.joints[*i].kind.is_angle() { 3.0 } else { 0.05 })
            })
            .collect();
        let (a, b) = (poses(ours, base, &joints), poses(theirs, base, &joints));
        for (name, pose) in &a {
            let Some(other) = b.get(name) else { continue };
            let error = (pose.to_homogeneous() - other.to_homogeneous()).amax();
            assert!(error <= 1e-9, "{} {name}: {error:e}", ours.name);
            compared += 1;
        }
    }
    assert!(compared >= 50 * least, "{}: {compared} poses", ours.name);
}

#[test]
fn robots_built_in_move_as_the_vendors_do() {
    let Some(models) = shared::shared("models") else { return };
    for (own, vendor, base, least) in [
        ("xarm6_gripper", "xarm6", "link_base", 16),
        ("xarm7_gripper", "xarm7", "link_base", 17),
        ("xarm6", "xarm6", "link_base", 8),
    ] {
        agree(&built_in(own), &robot(&Source::new(models.join(vendor).join(format!("{vendor}.urdf")))), base, least);
    }
    let mut ours = built_in("piper_gripper");
    // The vendor's second finger moves on its own; ours follows the first.
    ours.joints.iter_mut().for_each(|j| j.mimic = None);
    agree(&ours, &robot(&Source::new(models.join("piper/piper.urdf"))), "base_link", 9);
    for (own, vendor) in [("xarm5", "xarm5"), ("lite6", "lite6"), ("xarm850", "uf850")] {
        let source =
            Source { meshes: Meshes::Ignore, ..Source::new(models.join(format!("../xacro/out/{vendor}.urdf"))) };
        agree(&built_in(own), &robot(&source), "link_base", 7);
    }
}

#[test]
fn yourarm_stands_as_its_sheet_says() {
    let robot = built_in("yourarm");
    let at = |joints: &[(&str, f64)]| {
        let joints = joints.iter().map(|(n, q)| ((*n).to_owned(), *q)).collect();
        poses(&robot, "base_link", &joints)["flange"]
    };
    let flange = at(&[]);
    assert!((flange.translation.vector - Vector3::new(0.4, 0.0, 0.55)).norm() < 1e-12);
    assert!((flange * Vector3::z() - Vector3::x()).norm() < 1e-12, "its z axis points out of the hand");
    let turned = at(&[("joint1", std::f64::consts::FRAC_PI_2), ("joint3", std::f64::consts::FRAC_PI_2)]);
    assert!((turned.translation.vector - Vector3::new(0.0, 0.0, 0.15)).norm() < 1e-12, "{turned}");
    let limits = robot.joints.iter().filter(|j| j.is_movable()).map(|j| j.limits.lower.to_degrees().round());
    assert_eq!(limits.collect::<Vec<_>>(), [-170.0, -100.0, -70.0, -175.0, -100.0, -270.0]);
}

/// Positions of tcp and jaw that another reader computes from the published description (TheRobotStudio,
/// `so101_new_calib.urdf`, whose zero is LeRobot's), to the tenth of a millimetre.
#[test]
fn the_so101_moves_as_published() {
    let robot = built_in("so101");
    for (joints, tcp, jaw) in [
        ([0.0; 6], [0.391361, -0.000009, 0.226470], None),
        ([0.4, -0.6, 0.7, 0.5, -0.8, 0.3], [0.274110, -0.093384, 0.122674], Some([0.231068, -0.084433, 0.191975])),
    ] {
        let names = ["joint1", "joint2", "joint3", "joint4", "joint5", "jaw_joint"].map(str::to_owned);
        let poses = poses(&robot, "base_link", &names.into_iter().zip(joints).collect());
        for (link, at) in [("tcp", Some(tcp)), ("jaw", jaw)] {
            let Some(at) = at else { continue };
            let off = (poses[link].translation.vector - Vector3::from(at)).norm();
            assert!(off < 1e-4, "{link} of {joints:?} is {off} m away");
        }
    }
}

/// How far a point of a link's frame lies outside the nearest of its shapes [m].
fn outside(link: &Link, point: &Point3<f64>) -> f64 {
    let distance = |shape: &dimos::robot::Shape| {
        let p = shape.origin.inverse_transform_point(point);
        match &shape.geometry {
            Geometry::Box { size } => (p.coords.abs() - size / 2.0).max(),
            Geometry::Sphere { radius } => p.coords.norm() - radius,
            Geometry::Cylinder { radius, length } => (p.x.hypot(p.y) - radius).max(p.z.abs() - length / 2.0),
            Geometry::Capsule { radius, length } => {
                (p - Point3::new(0.0, 0.0, p.z.clamp(-length / 2.0, length / 2.0))).norm() - radius
            }
            Geometry::Mesh(_) => f64::INFINITY,
        }
    };
    link.collisions.iter().map(distance).fold(f64::INFINITY, f64::min)
}

#[test]
fn shapes_built_in_cover_the_vendors_meshes() {
    let Some(models) = shared::shared("models") else { return };
    for (own, vendor) in [("xarm6_gripper", "xarm6"), ("xarm7_gripper", "xarm7"), ("piper_gripper", "piper")] {
        let (ours, theirs) = (built_in(own), robot(&Source::new(models.join(vendor).join(format!("{vendor}.urdf")))));
        let mut vertices = 0;
        for link in &theirs.links {
            let Some(own) = ours.link_index(&link.name).map(|i| &ours.links[i]) else { continue };
            for shape in &link.visuals {
                let Geometry::Mesh(file) = &shape.geometry else { continue };
                for vertex in Mesh::load(file).unwrap().vertices {
                    let out = outside(own, &(shape.origin * vertex));
                    assert!(out <= 0.0, "{vendor} {}: {vertex} lies {out} m outside", link.name);
                    vertices += 1;
                }
            }
        }
        assert!(vertices > 5000, "{vendor}: {vertices}");
    }
}

#[test]
fn every_robot_built_in_is_sound() {
    for name in builtin::NAMES {
        let loaded = load(&Source::new(format!("builtin:{name}")));
        assert_eq!(loaded.render(false), "", "{name}");
        let robot = loaded.model.unwrap();
        for joint in robot.joints.iter().filter(|j| j.is_movable()) {
            assert!(
                joint.limits.lower < joint.limits.upper && joint.limits.velocity.is_finite(),
                "{name} {}",
                joint.name
            );
        }
        assert!(robot.links.iter().filter(|l| !l.collisions.is_empty()).count() >= 6, "{name}");
        assert_eq!(robot.meshes().count(), 0, "{name}");
    }
    let wrong = load(&Source::new("builtin:xarm66")).render(false);
    assert!(wrong.contains("unknown built-in robot `xarm66`") && wrong.contains("lite6, lite6_gripper"), "{wrong}");
}

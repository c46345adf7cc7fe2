//! Descriptions of robots, and their meshes.

use std::collections::BTreeMap;
use std::path::Path;

use dimos::collision::ply;
use dimos::robot::kinematics::Kinematics;
use dimos::robot::mesh::Mesh;
use dimos::robot::packages::Packages;
use dimos::robot::xml::{Calls, Node};
use dimos::robot::{JointKind, RobotModel, srdf, urdf, xacro, xml};
use dimos::yaml::{Tree, render};
use nalgebra::Vector3;

use super::text;
use crate::{Target, bug};

/// A robot with every kind of joint.
const ROBOT: &str = include_str!("../../seeds/robot.urdf");
const DESCRIPTION: &str = include_str!("../../seeds/description.xacro");
const SEMANTICS: &str = include_str!("../../seeds/semantics.srdf");

/// URDF.
pub const URDF: Target = Target {
    name: "urdf",
    about: "a robot whose kinematics are finite, or errors; written and read, it is the same",
    run: |data| {
        let Some(text) = text(data) else { return };
        if let Ok(model) = urdf::from_text("fuzz", text) {
            robot(&model);
        }
    },
    seeds: || vec![ROBOT.into()],
};

fn robot(model: &RobotModel) {
    assert_eq!(model.links.len(), model.joints.len() + 1);
    if let Ok(kinematics) = Kinematics::whole(model) {
        let mut frames = kinematics.frames();
        kinematics.forward(&vec![0.25; kinematics.dof()], &mut frames);
        let finite = model.joints.iter().all(|joint| {
            let far = joint.origin.translation.vector.amax();
            let mimic = joint.mimic.as_ref().map_or(0.0, |mimic| mimic.multiplier.abs().max(mimic.offset.abs()));
            far.max(mimic) < 1e100
        });
        let moved = frames.iter().all(|frame| frame.translation.is_finite());
        assert!(!finite || moved, "frames are not finite");
    }
    if let Ok(again) = RobotModel::try_from(&urdf_rs::Robot::from(model)) {
        assert_eq!(again.joints.len(), model.joints.len());
    }
    bug(1, model.joints.iter().any(|joint| joint.kind == JointKind::Prismatic && joint.mimic.is_some()));
    bug(2, model.links.len() > 5);
    bug(3, model.joints.iter().any(|joint| joint.kind == JointKind::Fixed));
}

/// Xacro.
pub const XACRO: Target = Target {
    name: "xacro",
    about: "a description, or errors with places, in bounded time and memory",
    run: expand,
    seeds: || vec![DESCRIPTION.into()],
};

fn expand(data: &[u8]) {
    let Some(text) = text(data) else { return };
    let mut tree = Tree::new();
    let source = tree.add_source("fuzz.xacro", text);
    let Some(document) = xml::parse(&mut tree, source) else { return };
    let packages = Packages::named(BTreeMap::new());
    let expansion = xacro::expand(&mut tree, Path::new("/nowhere/fuzz.xacro"), document, &packages, &BTreeMap::new());
    tree.diags().iter().for_each(|diag| drop(render(&tree, diag, false)));
    assert!(tree.diags().iter().all(|diag| !diag.message.contains("panicked")), "the expansion panicked");
    let Some(expansion) = expansion else { return };
    let links = expansion
        .document
        .root
        .children
        .iter()
        .filter(|child| matches!(child, Node::Element(e) if e.name == "link"))
        .count();
    bug(1, links == 3);
    bug(2, !expansion.unknown_args.is_empty());
    bug(3, links > 0 && text.contains("${-"));
}

/// SRDF of a robot.
pub const SRDF: Target = Target {
    name: "srdf",
    about: "groups and poses of joints that the robot has, or errors",
    run: semantics,
    seeds: || vec![SEMANTICS.into()],
};

fn semantics(data: &[u8]) {
    let Some(text) = text(data) else { return };
    let Ok(model) = urdf::from_text("robot", ROBOT) else { unreachable!("the robot is correct") };
    let mut tree = Tree::new();
    let source = tree.add_source("fuzz.srdf", text);
    let Some(document) = xml::parse(&mut tree, source) else { return };
    let Some(read) = srdf::read(&document.root, &model, &mut tree, &Calls::default()) else { return };
    for group in &read.groups {
        if let Some(joints) = read.group_joints(&model, &group.name) {
            assert!(joints.iter().all(|joint| *joint < model.joints.len()));
        }
        bug(1, group.chains.len() == 2);
    }
    bug(2, read.poses.iter().any(|pose| pose.positions.len() > 1));
    bug(3, read.disabled.len() >= 2 && !read.passive.is_empty());
}

/// Meshes; the first byte is the format.
pub const MESH: Target = Target {
    name: "mesh",
    about: "triangles of vertices that are there, or an error",
    run: mesh,
    seeds: || {
        let obj = b"1v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nvn 0 0 1\nf 1 2 3\nf 1/1 2/2 4/4\nf -1//1 -2//1 -3//1 -4//1\n";
        let ascii = concat!(
            "0solid s
facet normal 0 0 1
outer loop
vertex 0 0 0
vertex 1 0 0
vertex 0 1 0
",
            "endloop
endfacet
endsolid s
"
        );
        let mut binary = vec![b'0'];
        binary.extend([0_u8; 80]);
        binary.extend(1_u32.to_le_bytes());
        [0.0_f32, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]
            .iter()
            .for_each(|v| binary.extend(v.to_le_bytes()));
        binary.extend([0, 0]);
        let dae = [&b"2"[..], include_bytes!("../../seeds/part.dae")].concat();
        vec![obj.to_vec(), ascii.into(), binary, dae]
    },
};

fn mesh(data: &[u8]) {
    let Some((first, rest)) = data.split_first() else { return };
    let name = ["m.stl", "m.obj", "m.dae"][usize::from(first.wrapping_sub(b'0')) % 3];
    let Ok(mesh) = Mesh::from_bytes(rest, Path::new(name), Vector3::new(1.0, -2.0, 0.5)) else { return };
    let count = mesh.vertices.len() as u32;
    assert!(mesh.triangles.iter().flatten().all(|vertex| *vertex < count), "a vertex that is not there");
    assert!(mesh.vertices.iter().all(|vertex| vertex.iter().all(|v| v.is_finite())), "a vertex is not finite");
    bug(1, name == "m.obj" && mesh.triangles.len() >= 5);
    bug(2, name == "m.dae" && mesh.vertices.len() != 3);
    bug(3, name == "m.stl" && mesh.triangles.len() == 2);
}

/// Point clouds.
pub const POINTS: Target = Target {
    name: "points",
    about: "points that are finite, or an error",
    run: |data| {
        let Ok(points) = ply::read(data) else { return };
        assert!(points.iter().all(|point| point.is_finite()), "a point is not finite");
        bug(1, points.len() == 3);
        bug(2, points.iter().any(|point| point.x > 100.0));
        bug(3, points.len() > 5);
    },
    seeds: || {
        let ascii = concat!(
            "ply
format ascii 1.0
comment c
element vertex 2
property float x
property double y
",
            "property float z
property uchar red
end_header
0 0 1 255
1 2 3 0
"
        );
        let head = concat!(
            "ply
format binary_little_endian 1.0
element vertex 2
property float x
property float y
",
            "property float z
end_header
"
        );
        let mut binary = head.as_bytes().to_vec();
        [0.0_f32, 1.0, 2.0, 3.0, 4.0, 5.0].iter().for_each(|v| binary.extend(v.to_le_bytes()));
        vec![ascii.into(), binary]
    },
};

//! `dimos model info` and `tree`: the structure of a robot.

use serde_json::{Value, json};

use super::File;
use crate::cli::exit::{Exit, Failure, Result};
use crate::cli::output::{self, Table};
use dimos_core::pose::to_xyz_rpy;
use dimos_robot::mesh::MeshSizes;
use dimos_robot::srdf::Semantics;
use dimos_robot::urdf::Meshes;
use dimos_robot::{Geometry, Joint, RobotModel, Shape};

/// Runs `info`.
pub(super) fn info(file: &File) -> Result {
    let (robot, loaded) = file.robot(Meshes::Mark)?;
    let mut meshes = MeshSizes::default();
    for diag in meshes.mistakes(&robot, loaded.document.as_ref()) {
        let hint = diag.hint.map(|hint| format!("\nhint: {hint}")).unwrap_or_default();
        output::note(format_args!("warning: {}{hint}", diag.message));
    }
    if file.json {
        output::json(&to_json(&robot, &loaded.semantics, &mut meshes));
        return complete(&robot, &mut meshes);
    }
    let independent = robot.independent_joints().len();
    let (links, joints) = (robot.links.len(), robot.joints.len());
    let root = robot.links.first().map_or("", |link| link.name.as_str());
    output::line(format_args!("{}: {links} links, {joints} joints, {independent} of them independent", robot.name));
    output::line(format_args!("root: {root}"));
    output::line("");
    print_joints(&robot);
    output::line("");
    let mut table = Table::new(&["LINK", ">MASS kg", "~VISUAL", "~COLLISION"]);
    for link in &robot.links {
        let mass = output::number(link.inertial.as_ref().map(|i| i.mass), 3);
        let (visual, collision) = (shapes(&link.visuals, &mut meshes), shapes(&link.collisions, &mut meshes));
        let collision = if collision == visual && !visual.is_empty() { "the same".to_owned() } else { collision };
        table.row([link.name.clone(), mass, visual, collision]);
    }
    table.print();
    print_semantics(&robot, &loaded.semantics);
    complete(&robot, &mut meshes)
}

/// Returns a failure if collision meshes are missing or unreadable: the table shows which.
fn complete(robot: &RobotModel, meshes: &mut MeshSizes) -> Result {
    let collisions = robot.links.iter().flat_map(|link| &link.collisions);
    let lacks = |shape: &&Shape| match &shape.geometry {
        Geometry::Mesh(mesh) => !matches!(meshes.of(mesh), Some(Ok(_))),
        _ => false,
    };
    match collisions.filter(lacks).count() {
        0 => Ok(Exit::Ok),
        1 => Err(Failure::usage("a collision mesh is missing or unreadable")),
        more => Err(Failure::usage(format!("{more} collision meshes are missing or unreadable"))),
    }
}

/// Prints the joints; without the columns that are empty for all of them.
fn print_joints(robot: &RobotModel) {
    let headings =
        ["JOINT", "TYPE", "PARENT → CHILD", ">RANGE rad", ">RANGE °", ">SPEED /s", ">ACC /s²", ">JERK /s³", "~NOTE"];
    let rows: Vec<Vec<String>> = robot.joints.iter().map(|joint| joint_row(robot, joint)).collect();
    let is_shown =
        |column: &usize| rows.iter().any(|row| !matches!(row.get(*column).map_or("", |cell| cell), "" | "-"));
    let shown: Vec<usize> = (0..headings.len()).filter(is_shown).collect();
    let mut table = Table::new(&shown.iter().filter_map(|column| headings.get(*column).copied()).collect::<Vec<_>>());
    for row in &rows {
        table.row(shown.iter().filter_map(|column| row.get(*column).cloned()));
    }
    table.print();
}

fn joint_row(robot: &RobotModel, joint: &Joint) -> Vec<String> {
    let name = |link: usize| robot.links.get(link).map_or("?", |l| l.name.as_str());
    let limits = &joint.limits;
    let finite = |value: f64| Some(value).filter(|v| v.is_finite());
    let range = |factor: f64, decimals: usize| match (finite(limits.lower), finite(limits.upper)) {
        (Some(lower), Some(upper)) => {
            format!("{}…{}", output::fixed(lower * factor, decimals), output::fixed(upper * factor, decimals))
        }
        _ => "-".to_owned(),
    };
    let degrees = if joint.kind.is_angle() { range(1f64.to_degrees(), 1) } else { "-".to_owned() };
    let note = match joint.mimic {
        Some(mimic) => {
            let leader = robot.joints.get(mimic.leader).map_or("?", |j| j.name.as_str());
            format!("follows {leader} · {} + {}", mimic.multiplier, mimic.offset)
        }
        None if joint.kind.name() == "prismatic" => "metres".to_owned(),
        None => String::new(),
    };
    vec![
        joint.name.clone(),
        joint.kind.name().to_owned(),
        format!("{} → {}", name(joint.parent), name(joint.child)),
        range(1.0, 3),
        degrees,
        output::number(finite(limits.velocity), 2),
        output::number(limits.acceleration, 2),
        output::number(limits.jerk, 1),
        note,
    ]
}

fn print_semantics(robot: &RobotModel, semantics: &Semantics) {
    if *semantics == Semantics::default() {
        return;
    }
    output::line("");
    let mut table = Table::new(&["GROUP", "~JOINTS"]);
    for group in &semantics.groups {
        table.row([group.name.clone(), joint_names(robot, semantics, &group.name).join(" ")]);
    }
    table.print();
    for pose in &semantics.poses {
        let values: Vec<String> = pose.positions.iter().map(|(joint, q)| format!("{joint} {q}")).collect();
        let outside = if pose.outside(robot).is_some() { " (OUTSIDE THE LIMITS)" } else { "" };
        output::line(format_args!("pose {} of {}: {}{outside}", pose.name, pose.group, values.join(", ")));
    }
    for tool in &semantics.end_effectors {
        output::line(format_args!("end effector {}: {} on {}", tool.name, tool.group, tool.parent_link));
    }
    output::line(format_args!("{} allowed collision pairs", semantics.disabled.len()));
}

fn joint_names(robot: &RobotModel, semantics: &Semantics, group: &str) -> Vec<String> {
    let joints = semantics.group_joints(robot, group).unwrap_or_default();
    joints.iter().filter_map(|i| robot.joints.get(*i)).map(|j| j.name.clone()).collect()
}

fn shapes(shapes: &[Shape], meshes: &mut MeshSizes) -> String {
    let words: Vec<String> = shapes.iter().map(|shape| described(&shape.geometry, meshes)).collect();
    words.join(", ")
}

fn described(geometry: &Geometry, meshes: &mut MeshSizes) -> String {
    match geometry {
        Geometry::Box { size } => format!("box {} × {} × {} m", size.x, size.y, size.z),
        Geometry::Sphere { radius } => format!("sphere r {radius} m"),
        Geometry::Cylinder { radius, length } => format!("cylinder r {radius} l {length} m"),
        Geometry::Capsule { radius, length } => format!("capsule r {radius} l {length} m"),
        Geometry::Mesh(mesh) => {
            let name = mesh.uri.rsplit('/').next().unwrap_or(&mesh.uri);
            match meshes.of(mesh) {
                Some(Ok(size)) => format!("{name} ({} triangles, {})", size.triangles, size.shown()),
                Some(Err(_)) => format!("{name} (UNREADABLE)"),
                None => format!("{name} (NOT FOUND)"),
            }
        }
    }
}

/// Runs `tree`.
pub(super) fn tree(file: &File) -> Result {
    let (robot, _) = file.robot(Meshes::Ignore)?;
    if file.json {
        output::json(&branch(&robot, 0));
        return Ok(Exit::Ok);
    }
    output::line(robot.links.first().map_or("", |link| link.name.as_str()));
    draw(&robot);
    Ok(Exit::Ok)
}

/// Draws all links below the root. Links are in depth-first order; a line needs to know which branches continue.
fn draw(robot: &RobotModel) {
    // For every open level: whether more branches follow.
    let mut levels: Vec<(usize, bool)> = Vec::new();
    for (i, joint) in robot.joints.iter().enumerate() {
        while levels.last().is_some_and(|(parent, _)| *parent != joint.parent) {
            levels.pop();
        }
        let more = robot.joints.iter().skip(i + 1).any(|j| j.parent == joint.parent);
        match levels.last_mut() {
            Some(level) => level.1 = more,
            None => levels.push((joint.parent, more)),
        }
        let (_, above) = levels.split_last().unwrap_or((&(0, false), &[]));
        let indent: String = above.iter().map(|(_, more)| if *more { "│  " } else { "   " }).collect();
        let sign = if more { "├─" } else { "└─" };
        let child = robot.links.get(joint.child).map_or("?", |l| l.name.as_str());
        output::line(format_args!("{indent}{sign} {child}  ({}, {})", joint.name, joint.kind.name()));
        levels.push((joint.child, false));
    }
}

fn branch(robot: &RobotModel, link: usize) -> Value {
    let below = robot.joints.iter().filter(|j| j.parent == link);
    let children: Vec<Value> =
        below.map(|j| json!({"joint": j.name, "type": j.kind.name(), "link": branch(robot, j.child)})).collect();
    json!({"name": robot.links.get(link).map(|l| l.name.as_str()), "children": children})
}

fn to_json(robot: &RobotModel, semantics: &Semantics, meshes: &mut MeshSizes) -> Value {
    let name = |link: usize| robot.links.get(link).map(|l| l.name.as_str());
    let finite = |value: f64| Some(value).filter(|v| v.is_finite());
    let pose = |p: &nalgebra::Isometry3<f64>| {
        let (xyz, rpy) = to_xyz_rpy(p);
        json!({"xyz": xyz, "rpy": rpy})
    };
    let joints: Vec<Value> = robot
        .joints
        .iter()
        .map(|j| {
            let mimic = j.mimic.map(|m| {
                json!({
                    "joint": robot.joints.get(m.leader).map(|l| l.name.as_str()),
                    "multiplier": m.multiplier, "offset": m.offset,
                })
            });
            json!({
                "name": j.name, "type": j.kind.name(), "parent": name(j.parent), "child": name(j.child),
                "origin": pose(&j.origin), "axis": j.axis.as_slice(), "mimic": mimic,
                "lower": finite(j.limits.lower), "upper": finite(j.limits.upper), "velocity": finite(j.limits.velocity),
                "effort": finite(j.limits.effort), "acceleration": j.limits.acceleration, "jerk": j.limits.jerk,
            })
        })
        .collect();
    let mut shape = |s: &Shape| {
        let what = match &s.geometry {
            Geometry::Box { size } => json!({"box": size.as_slice()}),
            Geometry::Sphere { radius } => json!({"sphere": {"radius": radius}}),
            Geometry::Cylinder { radius, length } => json!({"cylinder": {"radius": radius, "length": length}}),
            Geometry::Capsule { radius, length } => json!({"capsule": {"radius": radius, "length": length}}),
            Geometry::Mesh(m) => {
                let size = meshes.of(m).and_then(|size| size.as_ref().ok());
                json!({"mesh": {
                    "uri": m.uri, "path": m.path, "scale": m.scale.as_slice(),
                    "triangles": size.map(|size| size.triangles), "extents": size.map(|size| size.extents.as_slice()),
                }})
            }
        };
        json!({"origin": pose(&s.origin), "geometry": what})
    };
    let links: Vec<Value> = robot
        .links
        .iter()
        .map(|l| {
            json!({
                "name": l.name, "mass": l.inertial.as_ref().map(|i| i.mass),
                "visuals": l.visuals.iter().map(&mut shape).collect::<Vec<_>>(),
                "collisions": l.collisions.iter().map(&mut shape).collect::<Vec<_>>(),
            })
        })
        .collect();
    let groups: Vec<Value> = semantics
        .groups
        .iter()
        .map(|g| json!({"name": g.name, "joints": joint_names(robot, semantics, &g.name)}))
        .collect();
    let poses: Vec<Value> = semantics
        .poses
        .iter()
        .map(|p| {
            let positions: serde_json::Map<String, Value> =
                p.positions.iter().map(|(j, q)| (j.clone(), json!(q))).collect();
            json!({"name": p.name, "group": p.group, "positions": positions})
        })
        .collect();
    let disabled: Vec<Value> = semantics.disabled.iter().map(|d| json!([d.a, d.b, d.reason])).collect();
    json!({
        "name": robot.name, "root": name(0), "joints": joints, "links": links,
        "groups": groups, "named_poses": poses, "disabled_collisions": disabled,
    })
}

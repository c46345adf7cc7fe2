//! What `check` says of the files of robots and of the world: the same as `model check`, and what a run would refuse.

use serde_json::json;

use crate::support::program::Home;

/// An arm of one joint, and a mesh in its world.
const TURN: &str = "\
name: turn
hardware:
  - {hardware_id: turn, joints: [turn_j], adapter_type: mock}
tasks:
  - {name: traj, type: trajectory, joint_names: {hardware: turn}}
planner:
  robots:
    - {name: turn, model_path: turn.urdf, base_link: a, end_effector_link: b, joint_names: [j], joint_prefix: turn_, \
       coordinator_task_name: traj}
  world:
    part: {shape: {mesh: part.stl}, pose: {xyz: [0, 0, 4.9]}}
";

/// A binary STL file of a tetrahedron with edges of this length.
fn tetrahedron(length: f32) -> Vec<u8> {
    let corners = [[0.0, 0.0, 0.0], [length, 0.0, 0.0], [0.0, length, 0.0], [0.0, 0.0, length]];
    let mut bytes = [vec![0; 80], 4_u32.to_le_bytes().to_vec()].concat();
    for face in [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]] {
        bytes.extend([0; 12]);
        face.iter().flat_map(|i: &usize| corners[*i]).for_each(|v: f32| bytes.extend(v.to_le_bytes()));
        bytes.extend([0, 0]);
    }
    bytes
}

/// The arm of [`TURN`], with more links on its end: each with these shapes and inertias.
fn turn(links: usize, inside: &str, limit: &str) -> Home {
    let home = Home::new();
    let more: String = (0..links)
        .map(|i| {
            let ends = format!("<parent link='b'/><child link='l{i}'/>");
            let inside = inside.replace('#', &i.to_string());
            format!("<link name='l{i}'>{inside}</link><joint name='f{i}' type='fixed'>{ends}</joint>\n")
        })
        .collect();
    home.write(
        "turn.urdf",
        &format!(
            "<robot name='turn'><link name='a'/><link name='b'/>{more}<joint name='j' type='revolute'>\
             <parent link='a'/><child link='b'/><axis xyz='0 0 1'/>{limit}</joint></robot>"
        ),
    );
    std::fs::write(home.path().join("part.stl"), tetrahedron(0.1)).unwrap();
    home.write("turn.yaml", TURN);
    home
}

const LIMIT: &str = "<limit lower='-2' upper='2' velocity='1' effort='1'/>";
/// An inertia that no body has.
const IMPOSSIBLE: &str = "<inertial><mass value='1'/><inertia ixx='1' iyy='1' izz='9'/></inertial>";

#[test]
fn check_repeats_every_warning_of_model_check() {
    let missing = "<visual><geometry><mesh filename='no#.stl'/></geometry></visual>";
    let home = turn(7, &format!("{missing}{IMPOSSIBLE}"), &LIMIT.replace("'1' e", "'0' e"));
    let alone = home.dimos("model check turn.urdf").with(0);
    assert!(alone.out.contains("no mistakes, 15 warnings"), "{}", alone.out);
    std::fs::write(home.path().join("part.stl"), tetrahedron(8.0)).unwrap();
    let shown = home.dimos("check turn.yaml").with(0).says(&[
        "no4.stl",
        "2 more visual meshes of the robot were not found",
        "a velocity limit of 0 counts as not given",
        "the inertia of the link `l0` is impossible",
        "the inertia of the link `l6` is impossible",
        "the mesh of the object `part` extends over 8.000 × 8.000 × 8.000 m",
    ]);
    assert!(!shown.err.contains("no5.stl"), "{}", shown.err);
    // Five meshes and a line for the others, the velocity, seven inertias and the part.
    assert!(shown.out.ends_with("no mistakes, 15 warnings\n"), "{}", shown.out);
    let document = home.dimos("check turn.yaml --json").with(0).json();
    assert_eq!((&document["ok"], &document["errors"], &document["warnings"]), (&json!(true), &json!(0), &json!(15)));
    assert_eq!(document["diagnostics"].as_array().unwrap().len(), 15);
}

#[test]
fn check_calls_invalid_what_a_run_refuses() {
    let home = turn(0, "", LIMIT);
    std::fs::write(home.path().join("part.stl"), &tetrahedron(0.1)[..120]).unwrap();
    let words = "its header declares 4 triangles (284 bytes), it has 120";
    home.dimos("check turn.yaml").with(2).says(&[words]);
    let document = home.dimos("check turn.yaml --json").with(2).json();
    assert_eq!((&document["ok"], &document["errors"]), (&json!(false), &json!(1)), "{document}");
    let found = &document["diagnostics"][0];
    assert!(found["severity"] == "error" && found["message"].as_str().unwrap().contains(words), "{document}");
}

#[test]
fn warnings_in_any_number_are_no_mistake() {
    let home = turn(120, IMPOSSIBLE, LIMIT);
    let alone = home.dimos("model check turn.urdf").with(0).says(&["20 more are not listed"]);
    assert!(alone.out.contains("no mistakes, 120 warnings"), "{}", alone.out);
    let shown = home.dimos("check turn.yaml").with(0).says(&["Not all warnings are listed"]);
    assert!(shown.out.contains("no mistakes, 101 warnings"), "{}", shown.out);
    assert_eq!(home.dimos("check turn.yaml --json").with(0).json()["ok"], json!(true));
    // A mistake that comes after them is listed all the same.
    let missing = "<visual><geometry><mesh filename='no#.stl'/></geometry></visual>";
    let home = turn(120, missing, "<limit lower='-1' upper='1'/>");
    home.dimos("model check turn.urdf").with(2).says(&["this limit has no `velocity`"]);
    home.dimos("check turn.yaml").with(2).says(&["this limit has no `velocity`"]);
}

#[test]
fn one_joint_goes_through_positions() {
    let home = turn(0, "", LIMIT);
    let _run = home.run("turn.yaml --no-record");
    home.dimos("move turn --through 0.5 -0.5").with(0);
    let at = home.positions("turn");
    assert!((at[0] + 0.5).abs() < 1e-3, "{at:?}");
    let added = home.dimos("world add shelf --mesh part.stl --at 0 0 4.9").with(0);
    assert!(!added.err.contains("warning"), "{}", added.err);
    std::fs::write(home.path().join("part.stl"), tetrahedron(8.0)).unwrap();
    home.dimos("world add shelf --mesh part.stl --at 0 0 4.9").with(0).says(&[
        "warning: the mesh of the object `shelf` extends over 8.000 × 8.000 × 8.000 m",
        "hint: a mesh in the world is in metres",
    ]);
    std::fs::write(home.path().join("part.stl"), tetrahedron(100.0)).unwrap();
    let refusal = &["part.stl extends over 100.0 × 100.0 × 100.0 m", "hint: a mesh in the world is in metres"];
    home.dimos("world add shelf --mesh part.stl --at 0 0 4.9").with(2).says(refusal);
    home.write("more.yaml", "rack: {shape: {mesh: part.stl}, pose: {xyz: [0, 0, 4.9]}}\n");
    home.dimos("world load more.yaml").with(2).says(refusal);
    home.dimos("check turn.yaml").with(2).says(refusal);
}

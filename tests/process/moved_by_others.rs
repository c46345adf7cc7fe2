//! Joints that a plan does not move and that carry the arm: measured by another arm, fixed, or not known.

use std::path::Path;
use std::process::{Command, Stdio};

use serde_json::{Value, json};

use crate::support::program::{Home, Started, UP, eventually};
use crate::support::skip::skip_tool;
use crate::view::Page;

/// A beam that turns on a column, whose height another arm sets; a cover that nothing measures.
const URDF: &str = r#"<robot name="cell">
  <link name="base_link"/>
  <link name="column"/>
  <link name="beam"><collision><origin xyz="0.25 0 0"/><geometry><box size="0.4 0.04 0.04"/></geometry></collision></link>
  <link name="tip"/>
  <link name="cover"><collision><origin xyz="0.1 0 0"/><geometry><box size="0.2 0.1 0.01"/></geometry></collision></link>
  <joint name="lift" type="prismatic"><parent link="base_link"/><child link="column"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="0.8" velocity="1" effort="1"/></joint>
  <joint name="turn" type="revolute"><parent link="column"/><child link="beam"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <joint name="end" type="fixed"><parent link="beam"/><child link="tip"/><origin xyz="0.45 0 0"/></joint>
  <joint name="hinge" type="revolute"><parent link="base_link"/><child link="cover"/><origin xyz="-0.3 0 0"/>
    <axis xyz="0 1 0"/><limit lower="0" upper="0.4" velocity="1" effort="1"/></joint>
</robot>"#;
/// The post is in the beam's way at a height of 0.5 m.
const BLUEPRINT: &str = "
name: cell
hardware:
  - {hardware_id: column, joints: [height, b, c, d, e, f], adapter_type: yourarm, address: sim,
     options: {sim: {initial_positions: [0.5, 0, 0, 0, 0, 0] FAULT}}}
  - {hardware_id: arm, joints: [arm_turn], adapter_type: mock}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
planner:
  robots:
    - name: arm
      model_path: cell.urdf
      end_effector_link: tip
      joint_names: [turn]
      joint_prefix: arm_
      coordinator_task_name: traj_arm
      JOINTS
  world:
    post: {shape: {box: [0.04, 0.04, 0.2]}, pose: {xyz: [0.28, 0.28, 0.5]}}
";

fn home(joints: &str, fault: &str) -> Home {
    let home = Home::new();
    home.write("cell.urdf", URDF);
    home.write("cell.yaml", &BLUEPRINT.replace("JOINTS", joints).replace("FAULT", fault));
    home
}

const MEASURED: &str = "joint_name_mapping: {height: lift}";

#[test]
fn what_another_arm_moves_is_planned_for_where_it_is_measured() {
    let home = home(MEASURED, "");
    let shown = home.dimos("check cell.yaml").with(0).out;
    assert!(shown.contains("lift is where height is measured"), "{shown}");
    assert!(shown.contains("hinge is assumed at its widest") && shown.contains("fixed_joints: {hinge: "), "{shown}");
    let _run = home.run("cell.yaml --no-record");
    home.dimos("plan arm 0.785").with(1).says(&["the goal collides", "post"]);
    let pose = home.dimos("state --json").json()["arms"][1]["pose"]["xyz"].clone();
    assert!((pose[2].as_f64().unwrap() - 0.5).abs() < 1e-3, "{pose}");
}

/// A page, and what other tools read in a log, have the arm on its lift, and a joint that is fixed where it is.
#[test]
fn a_log_and_a_page_show_the_arm_where_its_lift_is() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let python = root.join(".venv/bin/python");
    if !python.exists() {
        return skip_tool("the Python readers in .venv");
    }
    let home = home(&format!("{MEASURED}\n      fixed_joints: {{hinge: 0.2}}"), "");
    let run = Started::of(home.as_typed("run cell.yaml").stdin(Stdio::null()));
    run.until(UP);
    home.dimos("move arm 0.3 --speed 1").with(0);
    let page = Page::of(home.dimos("view").with(0).out.trim()).scene();
    let robot = &page["robots"][0];
    assert_eq!((&robot["moved_by_others"]["height"], &robot["fixed"]["hinge"]), (&json!("lift"), &json!(0.2)));
    home.dimos("down").with(0);
    run.wait().with(0);
    let urdf = home.path().join("description.urdf");
    let read = |frame: &str| -> Value {
        let mut read = Command::new(&python);
        read.arg(root.join("tests/readers/read_scene.py")).arg(&home.logs()[0]).arg(frame).arg(&urdf);
        let output = read.output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        serde_json::from_slice(&output.stdout).unwrap()
    };
    let height = |pose: &Value| pose[2][3].as_f64().unwrap();
    assert!((height(&read("arm_tcp")["pose"]) - 0.5).abs() < 1e-3, "{}", read("arm_tcp"));
    let cover = &read("cover")["pose"];
    assert!((cover[0][2].as_f64().unwrap() - 0.2_f64.sin()).abs() < 1e-6, "{cover}");
    // The description has the joints of `/joint_states`.
    let fk = format!("model fk {} --base map --link tip 0.5 0.3 --json", urdf.display());
    assert!((home.dimos(&fk).with(0).json()["xyz"][2].as_f64().unwrap() - 0.5).abs() < 1e-9);
    let text = std::fs::read_to_string(&urdf).unwrap();
    assert!(text.contains("\"height\"") && text.contains("\"arm_turn\""), "{text}");
    let tcp = home.dimos("log cat --last --topics /tcp/arm --json").with(0).out;
    let z = tcp.lines().last().map(|line| serde_json::from_str::<Value>(line).unwrap());
    let z = z.unwrap()["data"]["pose"]["position"]["z"].as_f64();
    assert!((z.unwrap() - 0.5).abs() < 1e-3, "{z:?}");
}

/// A lift whose connection is lost is where it was, and not at zero.
#[test]
fn a_joint_that_is_no_longer_measured_is_not_at_zero() {
    let home = home(MEASURED, ", faults: [{at: 6, kind: silent, duration: 60}]");
    let _run = home.run("cell.yaml --no-record");
    home.dimos("plan arm 0.785").with(1).says(&["the goal collides"]);
    eventually("its state is old", || home.dimos("plan arm 0.785").err.contains("no state"));
    let refused = home.dimos("plan arm 0.785").with(1).err;
    assert!(refused.contains("height, which moves arm: no state that is younger than 1 s"), "{refused}");
    home.dimos("move arm 0.785").with(1).says(&["height, which moves arm"]);
    assert_eq!(home.positions("arm"), [0.0]);
}

#[test]
fn a_joint_below_the_tool_that_nothing_measures_is_an_error_with_the_line_to_add() {
    let unknown = home("max_velocity: 1.0", "");
    let said = unknown.dimos("check cell.yaml").with(2).err;
    assert!(said.contains("the joint `lift` moves `tip`, and nothing plans or measures it"), "{said}");
    assert!(
        said.contains("`joint_name_mapping: {JOINT: lift}`") && said.contains("`fixed_joints: {lift: 0}`"),
        "{said}"
    );
    unknown.dimos("run cell.yaml --no-record").with(2);
    // The same by its own name, or with the prefix of the arm's joints.
    let named = home("max_velocity: 1.0", "");
    for name in ["lift", "arm_lift"] {
        named.write(
            "cell.yaml",
            &BLUEPRINT.replace("JOINTS", "max_velocity: 1.0").replace("FAULT", "").replace("height", name),
        );
        assert!(named.dimos("check cell.yaml").with(0).out.contains(&format!("lift is where {name} is measured")));
    }
}

#[test]
fn a_fixed_joint_is_where_the_blueprint_says() {
    for (height, free) in [("0.5", false), ("0.1", true)] {
        let home = home(&format!("fixed_joints: {{lift: {height}, hinge: 0}}"), "");
        assert!(!home.dimos("check cell.yaml").with(0).out.contains("assumed"));
        let _run = home.run("cell.yaml --no-record");
        home.dimos("plan arm 0.785").with(if free { 0 } else { 1 });
    }
    for (joints, words) in [
        ("fixed_joints: {lfit: 0}", ["the model has no joint `lfit`", "lift"]),
        ("fixed_joints: {turn: 0, lift: 0}", ["the joint `turn` is a planned joint", "remove it here"]),
        ("fixed_joints: {end: 0, lift: 0}", ["the joint `end` is fixed", "hint: "]),
        ("fixed_joints: {lift: 0.9}", ["`lift` at 0.9 m is outside the model's limits", "0.8"]),
        ("joint_name_mapping: {height: lift}\n      fixed_joints: {lift: 0}", ["`lift` is measured", "`height`"]),
        ("joint_name_mapping: {height: lift, b: lift}", ["the joint `lift` is mapped twice", "first mapped here"]),
        ("joint_name_mapping: {height: lfit}", ["the model has no independent joint `lfit`", "lift"]),
        ("joint_name_mapping: {arm_turn: lift}", ["`arm_turn` is two joints of the model", "first used here"]),
        ("joint_name_mapping: {hieght: lift}", ["no arm has a joint `hieght`", "height"]),
    ] {
        home(joints, "").dimos("check cell.yaml").with(2).says(&words);
    }
}

/// The run's `lift` is the model's `turn`: it is not the model's `lift` as well.
#[test]
fn a_joint_of_the_run_is_one_joint_of_the_model() {
    let home = home("joint_name_mapping: {lift: turn}", "");
    let blueprint = std::fs::read_to_string(home.path().join("cell.yaml")).unwrap();
    home.write("cell.yaml", &blueprint.replace("arm_turn", "lift"));
    home.dimos("check cell.yaml").with(2).says(&["the joint `lift` moves `tip`, and nothing plans or measures it"]);
}

/// A task does not follow a joint that another arm moves, and says so.
#[test]
fn a_task_says_that_it_does_not_follow_a_joint_of_another_arm() {
    let jog = |params: &str| {
        let home = home(MEASURED, "");
        let blueprint = std::fs::read_to_string(home.path().join("cell.yaml")).unwrap();
        let task = format!("tasks:\n  - {{name: jog, type: eef_twist, joint_names: {{hardware: arm}}{params}}}\n");
        home.write("cell.yaml", &blueprint.replace("tasks:\n", &task));
        home.dimos("check cell.yaml")
    };
    let said = jog("").with(2).err;
    assert!(said.contains("the planner follows it where it is measured; a task does not"), "{said}");
    assert!(said.contains("`params: {fixed_joints: {lift: POSITION}}`"), "{said}");
    jog(", params: {fixed_joints: {lift: 0.5}}").with(0);
    jog(", params: {fixed_joints: {lift: 5}}").with(2).says(&["`lift` at 5 m is outside the model's limits"]);
}

/// The shapes of a cover may be on a link that is fixed to the one that its joint moves.
#[test]
fn the_widest_pose_is_that_of_all_that_a_joint_moves() {
    let widest = |urdf: &str| {
        let home = home(MEASURED, "");
        home.write("cell.urdf", urdf);
        let checked = home.dimos("check cell.yaml --json").with(0).json();
        checked["robots"][0]["assumed"]["hinge"].as_f64().unwrap()
    };
    let turned = URDF.replace(r#"lower="0" upper="0.4""#, r#"lower="-3.1" upper="0""#);
    let framed = turned.replace(
        r#"<child link="cover"/><origin xyz="-0.3 0 0"/>"#,
        r#"<child link="frame"/><origin xyz="-0.3 0 0"/>"#,
    );
    let fixed = r#"<link name="frame"/><joint name="at" type="fixed"><parent link="frame"/><child link="cover"/></joint></robot>"#;
    let framed = framed.replace("</robot>", fixed);
    assert!(framed.contains("frame") && turned != URDF);
    assert_eq!(widest(&turned), -3.1, "away from what it is on");
    assert_eq!(widest(&framed), -3.1, "the same with a frame between");
}

/// In whichever order the model's joints are listed, positions are in the order of the arm.
#[test]
fn positions_are_in_the_order_of_the_arm() {
    let home = Home::new();
    home.dimos("list-blueprints");
    let tip_first = "joint6, joint5, joint4, joint3, joint2, joint1";
    home.write(
        "reversed.yaml",
        &format!(
            "name: reversed
hardware:
  - {{hardware_id: arm, joints: {{prefix: arm, count: 6}}, adapter_type: yourarm, address: sim}}
tasks:
  - {{name: traj_arm, type: trajectory, joint_names: {{hardware: arm}}}}
planner:
  robots:
    - {{name: arm, model_path: 'builtin:yourarm', end_effector_link: flange, flange_link: flange, joint_names: [{tip_first}],
       joint_prefix: arm_, coordinator_task_name: traj_arm, named_poses: {{ready: [0.1, 0.8, 0, 0.6, -0.3, 0.2]}}}}
"
        ),
    );
    let robots = home.dimos("check reversed.yaml --json").with(0).json()["robots"].clone();
    let names: Vec<&Value> =
        robots[0]["joints"].as_array().unwrap().iter().map(|joint| &joint["coordinator"]).collect();
    assert_eq!(names.first().and_then(|name| name.as_str()), Some("arm_joint1"), "{robots}");
    let _run = home.run("reversed.yaml --no-record");
    let goal = [0.2, -0.3, 0.6, 0.0, 0.8, 0.1];
    home.dimos("move arm 0.2 -0.3 0.6 0 0.8 0.1 --speed 1").with(0);
    let planned = home.positions("arm");
    assert!(planned.iter().zip(goal).all(|(a, b)| (a - b).abs() < 2e-3), "{planned:?}");
    home.dimos("move arm --named ready --speed 1").with(0);
    let ready = home.positions("arm");
    assert!(ready.iter().zip([0.2, -0.3, 0.6, 0.0, 0.8, 0.1]).all(|(a, b)| (a - b).abs() < 2e-3), "{ready:?}");
    home.dimos("move arm 0.2 -0.3 0.6 0 0.8 0.1 --direct").with(0);
}

//! A gripper's fingers are planned for where they are measured to be, not where the model has its zero.

use crate::support::program::{Home, eventually};

/// One joint that turns a beam, and two fingers at its end, of which the right follows the left.
const URDF: &str = r#"<robot name="tongs">
  <link name="base_link"/>
  <link name="beam"><collision><origin xyz="0.2 0 0"/><geometry><box size="0.3 0.04 0.04"/></geometry></collision></link>
  <link name="left"><collision><origin xyz="0.05 0 0"/><geometry><box size="0.1 0.01 0.01"/></geometry></collision></link>
  <link name="right"><collision><origin xyz="0.05 0 0"/><geometry><box size="0.1 0.01 0.01"/></geometry></collision></link>
  <joint name="turn" type="revolute"><parent link="base_link"/><child link="beam"/><axis xyz="0 0 1"/>
    <limit lower="-2" upper="2" velocity="1" effort="1"/></joint>
  <joint name="left_finger" type="revolute"><parent link="beam"/><child link="left"/><origin xyz="0.4 0.02 0"/>
    <axis xyz="0 0 1"/><limit lower="0" upper="1.2" velocity="1" effort="1"/></joint>
  <joint name="right_finger" type="revolute"><parent link="beam"/><child link="right"/><origin xyz="0.4 -0.02 0"/>
    <axis xyz="0 0 1"/><limit lower="-1.2" upper="0" velocity="1" effort="1"/>
    <mimic joint="left_finger" multiplier="-1"/></joint>
</robot>"#;
const BLUEPRINT: &str = "
name: tongs
hardware:
  - {hardware_id: arm, joints: [arm_turn], adapter_type: mock}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
planner:
  robots:
    - name: arm
      model_path: tongs.urdf
      end_effector_link: beam
      joint_names: [turn]
      joint_prefix: arm_
      coordinator_task_name: traj_arm
      collision_exclusion_pairs: [[left, right]]
      GRIPPER
  world:
    post: {shape: {box: [0.02, 0.02, 0.2]}, pose: {xyz: [0.42, -0.22, 0]}}
";

fn home(gripper: &str) -> Home {
    let home = Home::new();
    home.write("tongs.urdf", URDF);
    home.write("tongs.yaml", &BLUEPRINT.replace("GRIPPER", gripper));
    home
}

/// The clearance of a plan to where the arm is almost already [m], and what comes closest.
fn clearance(home: &Home) -> (f64, String) {
    let planned = home.dimos("plan arm 0.01 --json").with(0).json();
    (planned["summary"]["clearance"].as_f64().unwrap(), planned["summary"]["closest"].to_string())
}

#[test]
fn fingers_are_planned_for_where_they_are_measured() {
    fingers_follow(&home(FINGER));
}

/// The jaw of an SO-101 has an angle, which goes from closed to open like an opening.
#[test]
fn the_angle_of_a_rotary_gripper_is_mapped_as_well() {
    let home = home(FINGER);
    let sim = "options: {sim: {initial_positions: [0, 0, 0, 0, 0, 0.5]}}";
    let arm = format!("[arm_turn, arm_b, arm_c, arm_d, arm_e], adapter_type: so101, address: sim, {sim}}}");
    let blueprint = BLUEPRINT.replace("[arm_turn], adapter_type: mock}", &arm).replace("GRIPPER", FINGER);
    home.write("tongs.yaml", &blueprint.replace("joint_names: {hardware: arm}", "joint_names: [arm_turn]"));
    fingers_follow(&home);
}

/// The fingers turn by 1.2 rad while the gripper opens.
const FINGER: &str = "gripper_joint: {joint: left_finger, closed: 0, open: 1.2}";

fn fingers_follow(home: &Home) {
    let _run = home.run("tongs.yaml --no-record");
    home.dimos("arm gripper arm close").with(0);
    eventually("the gripper is closed", || clearance(home).0 > 0.15);
    home.dimos("arm gripper arm open").with(0);
    // The right finger, which follows the left one by `mimic`, now points at the post.
    eventually("the gripper is open", || clearance(home).0 < 0.12);
    assert!(clearance(home).1.contains("arm/right"), "{:?}", clearance(home));
}

#[test]
fn a_gripper_that_nothing_is_known_of_is_planned_for_wide_open_and_check_says_so() {
    let home = home("max_velocity: 1.0");
    let shown = home.dimos("check tongs.yaml").with(0).out;
    assert!(
        shown.contains("left_finger is assumed at its widest, 1.2000")
            && shown.contains("fixed_joints: {left_finger: 1.2000}"),
        "{shown}"
    );
    let _run = home.run("tongs.yaml --no-record");
    home.dimos("arm gripper arm close").with(0);
    let (distance, closest) = clearance(&home);
    assert!(distance < 0.12 && closest.contains("arm/right"), "{distance} {closest}");
}

#[test]
fn a_gripper_joint_that_cannot_be_one_is_refused() {
    for (gripper, words) in [
        ("{joint: left_fingr, closed: 0, open: 1}", ["the model has no joint `left_fingr`", "left_finger"]),
        ("{joint: right_finger, closed: 0, open: -1}", ["right_finger` mimics another joint", "hint: "]),
        ("{joint: turn, closed: 0, open: 1}", ["the joint `turn` is a planned joint", "hint: "]),
        ("{joint: left_finger, closed: 0, open: 2}", ["left_finger` at 2 rad is outside the model's limits", "1.2"]),
    ] {
        home(&format!("gripper_joint: {gripper}")).dimos("check tongs.yaml").with(2).says(&words);
    }
}

/// A robot that spans two arms has the gripper of the one that carries the fingers.
#[test]
fn of_several_arms_the_one_that_carries_the_fingers_drives_them() {
    let home = Home::new();
    let turn = r#"<joint name="turn" type="revolute"><parent link="base_link"/>"#;
    let foot = r#"<link name="foot"/><joint name="foot" type="revolute"><parent link="base_link"/><child link="foot"/>
        <axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="1" effort="1"/></joint>"#;
    let spanning = URDF.replace(turn, &format!("{foot}{}", turn.replace("base_link", "foot")));
    assert!(spanning != URDF);
    home.write("tongs.urdf", &spanning);
    let blueprint = BLUEPRINT
        .replace("tasks:", "  - {hardware_id: foot, joints: [arm_foot], adapter_type: mock}\ntasks:")
        .replace("joint_names: {hardware: arm}", "joint_names: [arm_foot, arm_turn]")
        .replace("joint_names: [turn]", "joint_names: [foot, turn]")
        .replace("name: arm\n", "name: both\n")
        .replace("GRIPPER", FINGER);
    // The foot is the first arm.
    let arms: Vec<&str> = blueprint.lines().filter(|line| line.contains("hardware_id")).collect();
    home.write("tongs.yaml", &blueprint.replace(&arms.join("\n"), &format!("{}\n{}", arms[1], arms[0])));
    let _run = home.run("tongs.yaml --no-record");
    let clearance = || home.dimos("plan both 0 0.01 --json").with(0).json()["summary"]["clearance"].as_f64().unwrap();
    home.dimos("arm gripper foot close").with(0);
    home.dimos("arm gripper arm open").with(0);
    eventually("the fingers of the arm are open", || clearance() < 0.12);
    home.dimos("arm gripper foot open").with(0);
    home.dimos("arm gripper arm close").with(0);
    eventually("the fingers of the arm are closed", || clearance() > 0.15);
}

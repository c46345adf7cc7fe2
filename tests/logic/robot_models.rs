//! Robot models in blueprints, with the real binary: every key of a planner's robot does what it says, and what a
//! description gets wrong is reported at its line.

use serde_json::Value;

use crate::support::program::{Home, Started};
use crate::support::shared;

/// A cart on a rail with an arm that turns without end, a wrist, and a gripper of two fingers of which one follows.
const RIG: &str = r#"<robot name="rig" xmlns:xacro="http://www.ros.org/wiki/xacro">
<xacro:arg name="reach" default="0.3"/><xacro:property name="reach" value="$(arg reach)"/>
<link name="base_link"/>
<link name="cart"><visual><geometry><mesh filename="package://rig_description/meshes/lost.stl"/></geometry></visual>
<collision><origin xyz="0 0 0.05"/><geometry><box size="0.1 0.1 0.1"/></geometry></collision></link>
<link name="arm"><collision><origin xyz="${reach / 2} 0 0"/><geometry><box size="${reach} 0.04 0.04"/></geometry></collision></link>
<link name="hand"><collision><geometry><mesh filename="package://rig_description/meshes/hand.dae"/></geometry></collision></link>
<link name="finger_left"><collision><origin xyz="0.05 0.01 0"/><geometry><box size="0.06 0.01 0.02"/></geometry></collision></link>
<link name="finger_right"><collision><origin xyz="0.05 -0.01 0"/><geometry><box size="0.06 0.01 0.02"/></geometry></collision></link>
<link name="tip"/>
<joint name="rail" type="prismatic"><parent link="base_link"/><child link="cart"/><axis xyz="1 0 0"/>
<limit lower="0" upper="0.5" velocity="0.5" effort="10"/></joint>
<joint name="turn" type="continuous"><parent link="cart"/><child link="arm"/><origin xyz="0 0 0.15"/><axis xyz="0 0 1"/>
<limit velocity="2" effort="10"/></joint>
<joint name="wrist" type="revolute"><parent link="arm"/><child link="hand"/><origin xyz="${reach} 0 0"/><axis xyz="0 0 1"/>
<limit lower="-1.5" upper="1.5" velocity="2" effort="10"/></joint>
<joint name="left" type="prismatic"><parent link="hand"/><child link="finger_left"/><axis xyz="0 1 0"/>
<limit lower="0" upper="0.04" velocity="0.1" effort="10"/></joint>
<joint name="right" type="prismatic"><parent link="hand"/><child link="finger_right"/><axis xyz="0 -1 0"/>
<limit lower="0" upper="0.04" velocity="0.1" effort="10"/><mimic joint="left"/></joint>
<joint name="end" type="fixed"><parent link="hand"/><child link="tip"/><origin xyz="0.08 0 0"/></joint>
<gazebo reference="hand"/><transmission name="t"/><ros2_control name="c"/><wonder/></robot>
"#;
/// A tetrahedron, in centimetres.
const HAND: &str = r##"<?xml version="1.0"?><COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit name="centimeter" meter="0.01"/><up_axis>Z_UP</up_axis></asset><library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="12">0 -1 -1 0 1 -1 0 0 1 2 0 0</float_array><technique_common>
<accessor source="#a" count="4" stride="3"><param name="X" type="float"/><param name="Y" type="float"/>
<param name="Z" type="float"/></accessor></technique_common></source><vertices id="v">
<input semantic="POSITION" source="#p"/></vertices><triangles count="4"><input semantic="VERTEX" source="#v" offset="0"/>
<p>0 2 1 0 1 3 1 2 3 2 0 3</p></triangles></mesh></geometry></library_geometries><library_visual_scenes>
<visual_scene id="s"><node><instance_geometry url="#g"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>"##;
const SRDF: &str = r#"<robot name="rig">
<group name="body"><joint name="rail"/><chain base_link="cart" tip_link="tip"/></group>
<group name="gripper"><joint name="left"/></group>
<group name="all"><group name="body"/><group name="gripper"/></group>
<group_state name="ready" group="all"><joint name="rail" value="0.1"/><joint name="turn" value="3.0"/>
<joint name="wrist" value="0.2"/><joint name="left" value="0.01"/></group_state>
<group_state name="beyond" group="all"><joint name="rail" value="0.9"/><joint name="turn" value="0"/>
<joint name="wrist" value="0"/><joint name="left" value="0"/></group_state>
<disable_collisions link1="finger_left" link2="finger_right" reason="Default"/>
<disable_collisions link1="finger_left" link2="camera" reason="Never"/></robot>
"#;
const LIMITS: &str = "joint_limits:
  rail: {has_velocity_limits: true, max_velocity: 0.2, has_acceleration_limits: true, max_acceleration: 0.5, max_jerk: 4}
  turn: {has_acceleration_limits: true, max_acceleration: 1.0, has_jerk_limits: true, max_jerk: 8.0}
  wrist: {has_position_limits: true, min_position: -1.2, max_position: 1.2}
";
const BLUEPRINT: &str = "
name: lab
hardware:
  - {hardware_id: rig, joints: [rig_rail, rig_turn, rig_wrist, rig_left], adapter_type: mock}
tasks:
  - {name: traj, type: trajectory, joint_names: {hardware: rig}}
planner:
  robots:
    - name: rig
      model_path: robots/urdf/rig.urdf.xacro
      package_paths: {rig_description: robots}
      xacro_args: {reach: 0.4}
      srdf_path: robots/rig.srdf
      joint_limits_path: robots/joint_limits.yaml
      base_pose: {xyz: [0, 0.5, 0.2], rpy: [0, 0, 1.5707963267948966]}
      base_link: base_link
      end_effector_link: tip
      joint_names: {group: all}
      joint_prefix: rig_
      coordinator_task_name: traj
      collision_exclusion_pairs: [[arm, finger_right]]
      auto_convert_meshes: true
      max_velocity: 3.0
      max_acceleration: 4.0
      named_poses: {home: [0, 0, 0, 0]}
";

fn lab() -> Home {
    let home = Home::new();
    ["robots/urdf", "robots/meshes"].iter().for_each(|f| std::fs::create_dir_all(home.path().join(f)).unwrap());
    home.write("robots/urdf/rig.urdf.xacro", RIG);
    home.write("robots/meshes/hand.dae", HAND);
    home.write("robots/rig.srdf", SRDF);
    home.write("robots/joint_limits.yaml", LIMITS);
    home.write("lab.yaml", BLUEPRINT);
    home
}

fn up() -> (Home, Started) {
    let home = lab();
    let run = home.run("lab.yaml --no-record");
    (home, run)
}

#[track_caller]
fn is_at(home: &Home, goal: [f64; 4]) {
    let is = home.positions("rig");
    assert!(is.iter().zip(goal).all(|(is, goal)| (is - goal).abs() < 1e-3), "{is:?} for {goal:?}");
}

fn list(value: &Value) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect()
}

#[test]
fn check_shows_what_files_add_to_a_robot() {
    let home = lab();
    let shown = home.dimos("check lab.yaml").with(0).says(&[
        "rig.urdf.xacro:4:53: visual mesh not found, it is not shown",
        "1 pair of `disable_collisions` with links that this robot lacks",
        "the SRDF's pose `beyond` cannot be used: `rail` at 0.9 m is outside the model's limits",
        "3 warnings",
    ]);
    assert!(
        shown.out.contains("named poses: home, ready") && shown.out.ends_with("no mistakes, 3 warnings\n"),
        "{}",
        shown.out
    );
    let document = home.dimos("check lab.yaml --json").with(0).json();
    let robot = &document["robots"][0];
    let joint = |i: usize, key: &str| robot["joints"][i][key].clone();
    let names = ["rail", "turn", "wrist", "left"];
    assert!((0..4).all(|i| joint(i, "model") == names[i] && joint(i, "coordinator") == format!("rig_{}", names[i])));
    let limits = |i| ["lower", "upper", "velocity", "acceleration", "jerk"].map(|key| joint(i, key).as_f64());
    assert_eq!(limits(0), [Some(0.0), Some(0.5), Some(0.2), Some(0.5), Some(4.0)]);
    assert_eq!(limits(1), [None, None, Some(2.0), Some(1.0), Some(8.0)]);
    assert_eq!(limits(2), [Some(-1.2), Some(1.2), Some(2.0), Some(4.0), Some(100.0)], "the arm's own jerk");
    assert_eq!(robot["always_touching"].as_array().unwrap().len(), 0);
}

#[test]
fn groups_poses_limits_and_arguments_take_effect() {
    let (home, _run) = up();
    home.dimos("move rig --named ready --speed 1").with(0).says(&["planned, collision-checked"]);
    is_at(&home, [0.1, 3.0, 0.2, 0.01]);
    home.dimos("plan rig --named beyond").with(2).says(&["no pose named `beyond`", "home, ready"]);
    // The short way round, from where the arm is: counted on, without a jump.
    home.dimos("move rig 0.1 -3.0 0.2 0.01 --speed 1").with(0);
    is_at(&home, [0.1, std::f64::consts::TAU - 3.0, 0.2, 0.01]);
    // One turn on would be nearer, but the arm does not go so far.
    home.dimos("move rig --named home --speed 1").with(0);
    is_at(&home, [0.0; 4]);
    // base_pose, and the xacro argument: the tip is 0.48 m along the base's x, which is the map's y.
    home.dimos("plan rig 0.5 0 0 0 --speed 1").with(0);
    let preview = home.dimos("preview --json").with(0).json();
    let way = preview["end_effectors"]["rig"].as_array().unwrap();
    let ends: [Vec<f64>; 2] = [list(way.first().unwrap()), list(way.last().unwrap())];
    for (end, y) in ends.iter().zip([0.98, 1.48]) {
        assert!(end.iter().zip([0.0, y, 0.35]).all(|(is, should)| (is - should).abs() < 1e-6), "{end:?}");
    }
    // The files' limits of the rail: 0.2 m/s, 0.5 m/s², 4 m/s³.
    let points = preview["trajectory"]["points"].as_array().unwrap();
    let time = |i: usize| points[i]["time_from_start"].as_f64().unwrap();
    let of = |key: &str| points.iter().map(|p| list(&p[key])[0]).collect::<Vec<_>>();
    let (speeds, accelerations) = (of("velocities"), of("accelerations"));
    let most = |values: &[f64]| values.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
    assert!((0.18..=0.2 + 1e-9).contains(&most(&speeds)), "{}", most(&speeds));
    assert!((0.4..=0.5 + 1e-9).contains(&most(&accelerations)), "{}", most(&accelerations));
    for i in 1..points.len() {
        let jerk = (accelerations[i] - accelerations[i - 1]) / (time(i) - time(i - 1));
        assert!(jerk.abs() < 4.2, "{jerk} at {}", time(i));
    }
    // 0.5 m at 0.2 m/s take 2.5 s, 0.4 s more for the acceleration, 0.1 s for the jerk, and little more.
    assert!((2.9..3.3).contains(&time(points.len() - 1)), "{}", time(points.len() - 1));
    home.dimos("plan rig 0.9 0 0 0").with(1).says(&["rig_rail at 0.9000 m is outside its limits 0.0000 … 0.5000 m"]);
    home.dimos("plan rig 0 0 1.3 0")
        .with(1)
        .says(&["rig_wrist at 1.3000 rad is outside its limits -1.2000 … 1.2000 rad"]);
    let planner = home.client().call(dimos::rpc::api::Planner {}).unwrap();
    // The model lets the arm turn without end, the mock arm two turns: commands stay 0.01 rad inside.
    let two = std::f64::consts::TAU - 0.01;
    assert_eq!(planner.robots[0].limits[..2], [[Some(0.0), Some(0.5)], [Some(-two), Some(two)]]);
}

#[test]
fn a_finger_that_follows_collides_like_any_other_and_meshes_are_in_metres() {
    let (home, _run) = up();
    // In the map the arm points along y, and the right finger opens towards x.
    home.dimos("world add peg --box 0.02 0.02 0.1 --at 0.055 0.95 0.35").with(0);
    home.dimos("plan rig 0 0 0 0.005").with(0);
    home.dimos("plan rig 0 0 0 0.04").with(1).says(&["link \"rig/finger_right\" is", "deep in obstacle \"peg\""]);
    home.dimos("world remove peg").with(0);
    // The Collada file's tetrahedron ends 2 cm before the wrist, on the arm's axis: above the fingers nothing is.
    home.dimos("world add crumb --sphere 0.001 --at 0 0.918 0.35").with(0);
    home.dimos("plan rig 0.001 0 0 0").with(1).says(&["link \"rig/hand\" is"]);
    home.dimos("world move crumb --at 0 0.9225 0.35").with(0);
    home.dimos("plan rig 0.001 0 0 0").with(0);
}

#[test]
fn links_that_always_touch_are_named_by_every_verb() {
    let home = lab();
    let swollen = RIG.replace(
        "<link name=\"finger_left\">",
        "<link name=\"finger_left\"><collision><geometry><box size=\"0.2 0.2 0.2\"/></geometry></collision>",
    );
    assert_ne!(swollen, RIG);
    home.write("robots/urdf/rig.urdf.xacro", &swollen);
    let pair = "arm and finger_left touch in every configuration";
    let shown = home.dimos("check lab.yaml").with(0);
    assert!(shown.out.contains(pair) && shown.out.contains("hint: "), "{}", shown.out);
    let document = home.dimos("check lab.yaml --json").with(0).json();
    assert_eq!(document["robots"][0]["always_touching"], serde_json::json!([["arm", "finger_left"]]));
    let alone = "model check robots/urdf/rig.urdf.xacro --srdf robots/rig.srdf --package rig_description=robots";
    home.dimos(alone)
        .with(0)
        .says(&["the links `arm` and `finger_left` touch in every configuration", "disable_collisions"]);
    let run = home.run("lab.yaml --no-record");
    assert!(run.err().contains(pair) || run.out().contains(pair), "{}{}", run.out(), run.err());
    home.dimos("down").with(0);
    // Allowed to touch, they are not reported again.
    home.write("lab.yaml", &BLUEPRINT.replace("[[arm, finger_right]]", "[[arm, finger_right], [finger_left, arm]]"));
    let shown = home.dimos("check lab.yaml").with(0);
    assert!(!shown.out.contains("touch"), "{}", shown.out);
}

#[test]
fn mistakes_around_a_description_stand_at_the_keys_that_name_it() {
    let home = lab();
    let table: &[(&str, &str, &str, &str)] = &[
        ("group: all", "group: al", "the SRDF has no group `al`", "lab.yaml:18:28"),
        ("{group: all}", "{grup: all}", "unknown key `grup`", "lab.yaml:18:21"),
        (
            "      srdf_path: robots/rig.srdf\n",
            "",
            "the group `all` is not known: the robot has no SRDF",
            "lab.yaml:17:28",
        ),
        ("rig.srdf", "rg.srdf", "rg.srdf: No such file", "lab.yaml:13:18"),
        ("joint_limits.yaml", "limits.yaml", "limits.yaml: No such file", "lab.yaml:14:26"),
        ("{group: all}", "[rail, turn, wrist, right]", "the joint `right` mimics another joint", "lab.yaml:18:40"),
        ("{group: all}", "[rail, turn, wrist, end]", "the joint `end` is fixed", "lab.yaml:18:40"),
        ("{group: all}", "[rail, turn, wrist, rail]", "the joint `rail` is named twice", "lab.yaml:18:40"),
        ("meshes: true", "meshes: false", "the collision mesh of the link `hand` is a Collada file", "lab.yaml:22:28"),
        ("rig_description: robots", "rig_description: robot", "does not exist: robot", "lab.yaml:10:19"),
        ("home: [0,", "home: [0.9,", "`rail` at 0.9 m is outside the model's limits", "lab.yaml:25:27"),
    ];
    for (right, wrong, words, place) in table {
        assert!(BLUEPRINT.contains(right), "{right}");
        home.write("lab.yaml", &BLUEPRINT.replacen(right, wrong, 1));
        home.dimos("check lab.yaml").with(2).says(&[words, place]);
    }
    home.write("lab.yaml", BLUEPRINT);
    for (file, text, right, wrong, words) in [
        ("robots/rig.srdf", SRDF, "value=\"3.0\"", "value=\"up\"", "rig.srdf:5:97: `up` is not a joint position"),
        (
            "robots/joint_limits.yaml",
            LIMITS,
            "max_jerk: 4",
            "max_jerk: -4",
            "joint_limits.yaml:2:120: `max_jerk` is -4",
        ),
        ("robots/urdf/rig.urdf.xacro", RIG, "lower=\"-1.5\"", "lower=\"2\"", "is above the upper limit 1.5"),
    ] {
        assert!(text.contains(right));
        home.write(file, &text.replace(right, wrong));
        home.dimos("check lab.yaml").with(2).says(&["the robot's description cannot be used: ", words]);
        home.write(file, text);
    }
    home.dimos("check lab.yaml --set planner.robots.rig.xacro_args.rech=1").with(0).says(&["did you mean `reach`?"]);
}

/// What a description may get wrong: each mistake is reported at its line, and what has no meaning here is ignored.
#[test]
fn model_check_knows_every_feature_of_a_description() {
    let home = Home::new();
    let joint = |name: &str, kind: &str, parent: &str, child: &str, rest: &str| {
        format!("<joint name='{name}' type='{kind}'><parent link='{parent}'/><child link='{child}'/>{rest}</joint>\n")
    };
    let limit = "<limit lower='-1' upper='1' velocity='1' effort='1'/>";
    let mesh =
        |what: &str| format!("<link name='c'><{what}><geometry><mesh filename='none.stl'/></geometry></{what}></link>");
    let (a_b, b_c) = (joint("j", "revolute", "a", "b", limit), joint("k", "revolute", "b", "c", limit));
    let table: Vec<(&str, String, i32, &str)> = vec![
        ("unknown tags", format!("<link name='c'><odd/></link><gazebo/><transmission/>{a_b}{b_c}"), 0, "no mistakes"),
        ("a missing visual mesh", format!("{}{a_b}{b_c}", mesh("visual")), 0, "visual mesh not found"),
        ("a missing collision mesh", format!("{}{a_b}{b_c}", mesh("collision")), 2, "file not found"),
        ("a loop", format!("<link name='c'/>{a_b}{b_c}{}", joint("l", "fixed", "c", "a", "")), 2, "form a loop"),
        ("two roots", format!("<link name='c'/>{a_b}"), 2, "the links `c` and `a` both have no parent"),
        ("two parents", format!("<link name='c'/>{a_b}{b_c}{}", joint("l", "fixed", "a", "c", "")), 2, "two parents"),
        (
            "an unknown parent",
            format!("<link name='c'/>{a_b}{}", joint("k", "fixed", "x", "c", "")),
            2,
            "`x` does not exist",
        ),
        (
            "a zero axis",
            format!("<link name='c'/>{a_b}{}", b_c.replace("</joint>", "<axis xyz='0 0 0'/></joint>")),
            2,
            "axis is zero",
        ),
        (
            "swapped limits",
            format!("<link name='c'/>{a_b}{}", b_c.replace("'-1' upper='1'", "'1' upper='-1'")),
            2,
            "swapped",
        ),
        ("no limits", format!("<link name='c'/>{a_b}{}", b_c.replace(limit, "")), 2, "has no `limit`"),
        ("an unknown type", format!("<link name='c'/>{a_b}{}", b_c.replace("revolute", "revolut")), 2, "revolute"),
        (
            "a floating joint",
            format!("<link name='c'/>{a_b}{}", b_c.replace("revolute", "floating")),
            2,
            "are not supported",
        ),
        ("twins", format!("<link name='c'/><link name='c'/>{a_b}{b_c}"), 2, "two links are named `c`"),
        (
            "an unknown leader",
            format!("<link name='c'/>{a_b}{}", b_c.replace("</joint>", "<mimic joint='x'/></joint>")),
            2,
            "`x`",
        ),
        ("nothing wrong", format!("<link name='c'/>{a_b}{b_c}"), 0, "no mistakes"),
    ];
    for (what, body, code, words) in table {
        home.write("r.urdf", &format!("<robot name='r'>\n<link name='a'/><link name='b'/>{body}</robot>\n"));
        let ended = home.dimos("model check r.urdf").with(code);
        assert!(ended.out.contains(words) || ended.err.contains(words), "{what}: {}{}", ended.out, ended.err);
        assert!(code == 0 || ended.err.contains("--> r.urdf:"), "{what} has no place: {}", ended.err);
    }
}

/// Vendors' files as they are: MoveIt's SRDF with its groups and poses, the arm's meshes.
#[test]
fn a_vendors_model_with_moveits_files_is_planned_for() {
    let (Some(models), Some(moveit)) = (shared::shared("models/panda"), shared::shared("planning/panda")) else {
        return;
    };
    let home = Home::new();
    let joints: Vec<String> = (1..8).map(|k| format!("panda_joint{k}")).collect();
    // The benchmark's SRDF, with the names of the arm's own description.
    let srdf = std::fs::read_to_string(moveit.join("panda.srdf")).unwrap();
    home.write("panda.srdf", &srdf.replace("panda_", "fer_"));
    home.write(
        "lab.yaml",
        &format!(
            "name: lab\nhardware:\n  - {{hardware_id: arm, joints: [{names}], adapter_type: mock}}\ntasks:\n\
             \x20 - {{name: traj, type: trajectory, joint_names: {{hardware: arm}}}}\nplanner:\n  robots:\n\
             \x20   - name: arm\n      model_path: {urdf}\n      package_paths: {{panda: {folder}}}\n\
             \x20     srdf_path: panda.srdf\n      base_link: fer_link0\n      end_effector_link: fer_link8\n\
             \x20     joint_names: {{group: fer_arm}}\n      joint_name_mapping: {{{mapping}}}\n\
             \x20     coordinator_task_name: traj\n",
            names = joints.join(", "),
            urdf = models.join("panda.urdf").display(),
            folder = models.display(),
            mapping = (1..8).map(|k| format!("panda_joint{k}: fer_joint{k}")).collect::<Vec<_>>().join(", "),
        ),
    );
    home.dimos("check lab.yaml").with(0);
    let _run = home.run("lab.yaml --no-record");
    // The mock arm starts at zero, which this arm's elbow cannot reach.
    home.dimos("move arm 0 -0.5 0 -1.5 0 1.6 0.8 --direct --speed 1").with(0);
    home.dimos("move arm --named ready --speed 1").with(0).says(&["planned, collision-checked"]);
    home.dimos("plan arm --pose 0.4 0.2 0.4").with(0);
}

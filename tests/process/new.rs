//! `dimos new`: what it writes passes `check` and runs, for every arm of the table.

use dimos::robot::builtin;
use serde_json::Value;

use crate::support::program::{Ended, Home, eventually};
use crate::support::terminal::Terminal;

/// The arms of an adapter, as `--arm` takes them: its models, or the adapter.
fn arms(home: &Home, adapter: &str) -> Vec<String> {
    let refused = home.dimos(&format!("new x --arm {adapter}")).with(2);
    match refused.err.lines().next().unwrap().split_once(&format!("which {adapter}? ")) {
        Some((_, models)) => models.split(", ").map(str::to_owned).collect(),
        None => vec![adapter.to_owned()],
    }
}

/// `dimos new ARM`, with no gripper, on a table where there is a built-in model of it.
fn write(home: &Home, arm: &str, row: &Value) -> Ended {
    let is_known = builtin::text(arm).is_some();
    let model = if is_known { format!("{arm} --tool 0 0 0.1 --table 0") } else { "none".to_owned() };
    let dof = &row["dof"];
    let joints = if model == "none" && dof["min"] != dof["max"] { " --joints 6" } else { "" };
    home.dimos(&format!("new {arm} --arm {arm} --address sim --gripper none --model {model}{joints}"))
}

/// Moves the first joint a little, planned where the run has a planner.
fn try_out(home: &Home, blueprint: &str) {
    // An emulator at zero is refused like an arm that has not measured; the hint says how to accept it.
    let zero = if blueprint == "remote.yaml" { "--set hardware.arm.accept_zero_pose=true" } else { "" };
    let run = home.run(&format!("{blueprint} --sim --no-record {zero}"));
    let phase = || home.status()["arms"][0]["phase"].as_str().unwrap().to_owned();
    assert_ne!(phase(), "ready", "{blueprint}: its motors are off");
    home.dimos("arm enable arm").with(0);
    eventually("it is ready", || phase() == "ready");
    let mut goal = home.positions("arm");
    goal[0] += 0.05;
    let goal: Vec<String> = goal.iter().map(|q| format!("{q:.5}")).collect();
    let moved = home.dimos(&format!("move arm {}", goal.join(" "))).with(0);
    assert!(moved.out.contains("COMPLETED"), "{blueprint}: {}", moved.out);
    run.end(rustix::process::Signal::TERM).with(143);
}

#[test]
fn every_arm_of_the_table_passes_check_and_one_of_each_adapter_runs() {
    let home = Home::new();
    let rows = home.dimos("list-adapters --json").with(0).json();
    let rows = rows.as_array().unwrap();
    assert!(rows.len() >= 8, "{rows:?}");
    let mut models = 0;
    for row in rows.iter().filter(|row| row["part"].is_null()) {
        let adapter = row["name"].as_str().unwrap();
        let arms = arms(&home, adapter);
        for arm in &arms {
            write(&home, arm, row).with(0).shows(&[&format!("wrote {arm}.yaml"), "next:"]);
            let checked = home.dimos(&format!("check {arm}.yaml")).with(0);
            assert!(checked.out.contains("no mistakes") && !checked.out.contains("warning"), "{arm}: {}", checked.out);
            models += usize::from(builtin::text(arm).is_some());
        }
        try_out(&home, &format!("{}.yaml", arms[0]));
    }
    assert!(models >= 9, "{models} arms with a built-in model");
}

#[test]
fn it_asks_on_a_terminal_and_a_wrong_answer_is_asked_for_again() {
    let (home, terminal) = (Home::new(), Terminal::new(100, 50));
    let asked = terminal.start(&home, "new cell");
    for (question, answer) in [
        ("Which arm: ", "xram6"),
        ("did you mean `xarm6`?", "xarm6"),
        ("Its address: HOST", "not an address"),
        ("its form: HOST", "192.168.1.185"),
        ("Its gripper: ", "xarm"),
        ("Model to plan with", ""),
        ("Tool centre point from link_tcp", "0 0 120"),
        ("120 mm is 0.12 m", "0 0 0.12"),
        ("Height of the table", "-0.05"),
    ] {
        terminal.until(question);
        terminal.keys(&format!("{answer}\r"));
    }
    asked.wait().with(0);
    terminal.until("wrote cell.yaml");
    let text = std::fs::read_to_string(home.path().join("cell.yaml")).unwrap();
    for line in [
        "    address: 192.168.1.185\n",
        "options: {gripper: xarm, model: xarm6}",
        "model_path: builtin:xarm6_gripper\n",
        "tool: {xyz: [0, 0, 0.12]}",
        "named_poses: {home: [0.0, -0.5, ",
        "pose: {xyz: [0, 0, -0.06]}",
    ] {
        assert!(text.contains(line), "no {line:?} in\n{text}");
    }
    home.dimos("check cell.yaml").with(0).shows(&["REAL ARM at 192.168.1.185", "no mistakes"]);
    try_out(&home, "cell.yaml");

    let terminal = Terminal::new(100, 50);
    let left = terminal.start(&home, "new other");
    terminal.until("Which arm: ");
    terminal.keys("\x03");
    left.wait().with(130);
    assert!(!home.path().join("other.yaml").exists());
}

/// The jaw of the SO-101 is a joint of its model, and none of the arm.
#[test]
fn the_so101_is_planned_with_its_jaw_where_it_is() {
    let (home, terminal) = (Home::new(), Terminal::new(100, 50));
    let asked = terminal.start(&home, "new cell --arm so101 --address sim");
    for question in ["Model to plan with: builtin:NAME, a .urdf or .xacro file, or none [builtin:so101]", "from tcp"] {
        terminal.until(question);
        terminal.keys("\r");
    }
    terminal.until("Height of the table");
    terminal.keys("0\r");
    asked.wait().with(0);
    let text = std::fs::read_to_string(home.path().join("cell.yaml")).unwrap();
    for line in [
        "      model_path: builtin:so101\n",
        "      end_effector_link: tcp #",
        "      joint_names: [joint1, joint2, joint3, joint4, joint5]\n",
        "      gripper_joint: {joint: jaw_joint, closed: -0.174533, open: 1.74533}",
        "named_poses: {home: [0.0, -0.8, ",
    ] {
        assert!(text.contains(line), "no {line:?} in\n{text}");
    }
    home.dimos("check cell.yaml").with(0).shows(&["no mistakes"]);
    try_out(&home, "cell.yaml");
}

#[test]
fn what_is_missing_or_wrong_is_named_and_nothing_is_written() {
    let home = Home::new();
    let all = ["--arm xarm6", "--address 10.0.0.1", "--gripper none", "--model xarm6", "--tool none", "--table none"];
    for missing in all {
        let rest: Vec<&str> = all.into_iter().filter(|option| *option != missing).collect();
        let option = missing.split(' ').next().unwrap();
        home.dimos(&format!("new cell {}", rest.join(" "))).with(2).says(&[option, "is missing", "hint: "]);
    }
    // All that is missing is named at once, also before the arm is known.
    let every = ["--address", "--gripper", "--model", "--tool", "--table"];
    for (given, missing) in [
        ("", [&["--arm"][..], &every].concat()),
        ("--arm xarm6", every.to_vec()),
        ("--arm xarm6 --address sim --model xarm6", vec!["--gripper", "--tool", "--table"]),
        ("--arm so101", vec!["--address", "--model", "--tool", "--table"]),
        ("--arm mock --gripper none", vec!["--model", "--joints"]),
    ] {
        let refused = home.dimos(&format!("new cell {given}")).with(2).says(&["these options are missing", "hint: "]);
        let named: Vec<&str> =
            refused.err.lines().filter_map(|line| line.strip_prefix("  --")?.split(' ').next()).collect();
        let missing: Vec<&str> = missing.iter().map(|option| &option[2..]).collect();
        assert_eq!(named, missing, "{given}: {}", refused.err);
        assert!(refused.err.lines().all(|line| line.chars().count() <= 110), "{}", refused.err);
    }
    for (wrong, said) in [
        ("--arm xarm6 --address 10.0.0.1:x", "--address: "),
        ("--arm xarm6 --address sim --gripper claw", "knows no gripper"),
        ("--arm xarm6 --address sim --gripper none --model xarm7", "7 joints"),
        ("--arm xarm6 --address sim --gripper none --model nothing.urdf", "nothing.urdf"),
        ("--arm xarm6 --address sim --gripper none --model xarm6 --tool 0 0", "three numbers"),
        ("--arm xarm6 --address sim --gripper none --model xarm6 --tool none --table 700", "m"),
        ("--arm so101 --address sim --gripper claw", "no choice of grippers"),
        ("--arm mock --gripper none --model none --joints 17", "cannot have 17 joints"),
        ("--arm mock --gripper none --model none --joints 6 --table 0", "needs a model"),
        ("--arm xarm6 --address sim --joints 6 --gripper none --model none --tool 0 0 1", "needs a model"),
    ] {
        let refused = home.dimos(&format!("new cell {wrong}")).with(2);
        assert!(refused.err.contains(said) && refused.err.contains("hint: "), "{wrong}: {}", refused.err);
    }
    home.dimos("new a/b:c --arm mock --gripper none --model none --joints 2").with(2);
    assert!(!home.path().join("cell.yaml").exists());

    home.write("cell.yaml", "mine");
    let written = "new cell --arm mock --gripper none --model none --joints 2";
    home.dimos(written).with(2).says(&["cell.yaml exists already", "--force"]);
    assert_eq!(std::fs::read_to_string(home.path().join("cell.yaml")).unwrap(), "mine");
    let said = home.dimos(&format!("{written} --force --json")).with(0).json();
    assert_eq!((&said["written"], &said["blueprint"]), (&"cell.yaml".into(), &"cell".into()));
    home.dimos("check cell.yaml").with(0);
}

/// A description whose joints have their own names, in another folder than the blueprint.
#[test]
fn a_model_of_your_own_is_planned_with() {
    let home = Home::new();
    let link = |name: &str| {
        let shape = "<geometry><box size=\"0.05 0.05 0.1\"/></geometry>";
        format!("<link name=\"{name}\"><collision><origin xyz=\"0 0 0.1\"/>{shape}</collision></link>")
    };
    let joint = |name: &str, parent: &str, child: &str, z: f64| {
        format!(
            "<joint name=\"{name}\" type=\"revolute\"><parent link=\"{parent}\"/><child link=\"{child}\"/>\
             <origin xyz=\"0 0 {z}\"/><axis xyz=\"0 1 0\"/><limit lower=\"-2\" upper=\"2\" velocity=\"1\" effort=\"9\"/>\
             </joint>"
        )
    };
    let parts = [
        link("root"),
        link("upper"),
        link("lower"),
        joint("shoulder", "root", "upper", 0.2),
        joint("elbow", "upper", "lower", 0.3),
    ];
    home.write("own.urdf", &format!("<robot name=\"own\">{}</robot>", parts.concat()));
    std::fs::create_dir(home.path().join("cells")).unwrap();
    home.dimos("new cells/own --arm mock --gripper none --model own.urdf --tool none --table none").with(0);
    let checked = home.dimos("check cells/own.yaml").with(0);
    assert!(checked.out.contains("arm_elbow") && checked.out.contains("planned to lower"), "{}", checked.out);
    try_out(&home, "cells/own.yaml");
}

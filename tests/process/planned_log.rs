//! What an emulated arm did on planned motions, from its log, judged by Pinocchio and coal: the measured positions
//! keep clear of all that the motions were planned around.

use dimos::robot::builtin;
use serde_json::json;

use crate::support::program::Home;
use crate::support::python::{python_with, recheck};

/// Measured positions, one row a tick at which they change, from an exported log.
fn measured(table: &str, joints: usize) -> Vec<Vec<f64>> {
    let mut lines = table.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    let columns: Vec<usize> = (1..=joints)
        .map(|joint| names.iter().position(|name| *name == format!("arm_joint{joint}.position")).unwrap())
        .collect();
    let row = |line: &str| {
        let cells: Vec<&str> = line.split(',').collect();
        columns.iter().map(|column| cells[*column].parse().ok()).collect::<Option<Vec<f64>>>()
    };
    let mut rows: Vec<Vec<f64>> = lines.filter_map(row).collect();
    rows.dedup();
    rows
}

#[test]
fn an_emulated_arm_keeps_clear_of_what_its_motions_were_planned_around() {
    let Some(python) = python_with(&["pinocchio", "coal"]) else { return };
    let home = Home::new();
    let run = home.run("xarm6-planner --sim");
    home.dimos("world add post --cylinder 0.04 0.9 --at 0.35 0.25 0.45").with(0);
    home.dimos("world add beam --box 0.1 0.5 0.05 --at 0.45 -0.2 0.5").with(0);
    for goal in ["--pose 0.2 0.45 0.3 --rpy 3.14 0 0", "--pose 0.2 -0.45 0.3 --rpy 3.14 0 0", "--named home"] {
        home.dimos(&format!("move arm {goal} --speed 1")).with(0);
    }
    home.dimos("down").with(0);
    run.wait().with(0);
    let table = home.path().join("log.csv");
    home.dimos(&format!("log export --last -o {}", table.display())).with(0);
    let path = measured(&std::fs::read_to_string(&table).unwrap(), 6);
    let way: f64 = path.windows(2).map(|pair| (pair[1][0] - pair[0][0]).abs()).sum();
    assert!(path.len() > 100 && way > 2.0, "{} rows, joint 1 turned by {way} rad", path.len());

    let still = [0.0, 0.0, 0.0, 1.0];
    let problem = json!({
        "problem": "log", "index": 0, "start": path[0], "goal": path[path.len() - 1],
        "joints": ["joint1", "joint2", "joint3", "joint4", "joint5", "joint6"],
        "obstacles": [
            {"name": "table", "type": "box", "size": [1.2, 1.2, 0.02], "position": [0, 0, -0.02], "quat_xyzw": still},
            {"name": "post", "type": "cylinder", "size": [0.04, 0.9], "position": [0.35, 0.25, 0.45], "quat_xyzw": still},
            {"name": "beam", "type": "box", "size": [0.1, 0.5, 0.05], "position": [0.45, -0.2, 0.5], "quat_xyzw": still},
        ],
    });
    let urdf = home.path().join("arm.urdf");
    std::fs::write(&urdf, builtin::text("xarm6_gripper").unwrap()).unwrap();
    let row = json!({ "problem": "log", "index": 0, "solved": true, "path": path });
    let said = recheck(&python, &urdf, None, &[problem], &[row]);
    assert!(said.starts_with("1 paths") && said.contains(": 0 touch;"), "{said}");
}

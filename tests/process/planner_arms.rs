//! Planning for every shipped arm, and for two arms at once, with the real binary.

use dimos::rpc::api::{Plan, PlanGoal, Planning};
use serde_json::Value;

use crate::planner_run::is_at;
use crate::support::program::{Home, eventually};
use crate::support::wire::watch::Watch;

/// Starts a shipped planner blueprint, moves each arm to a pose, and home again.
fn moves_to_a_pose_and_home(blueprint: &str, arms: &[(&str, &str)]) {
    let home = Home::new();
    let _run = home.run(&format!("{blueprint} --sim --no-record"));
    for (arm, pose) in arms {
        home.dimos(&format!("move {arm} --pose {pose} --speed 1")).with(0);
    }
    let goals: Vec<String> = arms.iter().map(|(arm, _)| format!("--goal {arm}=named:home")).collect();
    home.dimos(&format!("move {} --speed 1", goals.join(" "))).with(0).says(&["planned, collision-checked"]);
}

macro_rules! shipped {
    ($($test:ident: $blueprint:literal, $arms:expr;)*) => { $(
        #[test]
        fn $test() {
            moves_to_a_pose_and_home($blueprint, &$arms);
        }
    )* };
}

shipped! {
    yourarm_planner: "yourarm-planner", [("arm", "0.35 0.1 0.3 --rpy 3.14 0 0")];
    xarm6_planner: "xarm6-planner", [("arm", "0.35 0.1 0.3 --rpy 3.14 0 0")];
    xarm7_planner: "xarm7-planner", [("arm", "0.35 0.1 0.3 --rpy 3.14 0 0")];
    piper_planner: "piper-planner", [("arm", "0.3 0.1 0.2 --rpy 0 2 0")];
    dual_yourarm_planner: "dual-yourarm-planner",
        [("left", "0.35 0.4 0.3 --rpy 3.14 0 0"), ("right", "0.35 -0.4 0.3 --rpy 3.14 0 0")];
}

#[test]
fn two_arms_move_in_one_plan_and_keep_clear_of_each_other() {
    let home = Home::new();
    let mocks = "--set hardware.left.adapter_type=mock --set hardware.right.adapter_type=mock";
    let _run = home.run(&format!("dual-yourarm-planner --no-record {mocks}"));
    let mut client = home.client();
    let both = |left: [f64; 6], right: [f64; 6]| {
        let goal = |robot: &str, joints: [f64; 6]| PlanGoal {
            robot: robot.into(),
            joints: Some(joints.into()),
            ..PlanGoal::default()
        };
        Plan { goals: vec![goal("left", left), goal("right", right)], speed: 1.0, seed: 3, ..Plan::default() }
    };
    let turned = |angle| [angle, -0.3, 0.6, 0.0, 0.8, 0.0];
    let mut planned = |plan: Plan| {
        let number = client.call(plan).unwrap().plan;
        let mut report = client.call(Planning { plan: number }).unwrap();
        eventually("planning ends", || {
            report = client.call(Planning { plan: number }).unwrap();
            report.state != "PLANNING"
        });
        report
    };
    let report = planned(both(turned(0.4), turned(-0.4)));
    assert_eq!((report.state.as_str(), report.summary.unwrap().joints.len()), ("PLANNED", 12), "{:?}", report.error);
    home.dimos("execute").with(0);
    is_at(&home, "left", &turned(0.4));
    is_at(&home, "right", &turned(-0.4));
    // Both reach for the middle between them.
    let across = |angle| [angle, 0.0, 0.0, 0.0, 0.0, 0.0];
    let report = planned(both(across(-1.3), across(1.3)));
    let why = report.error.unwrap_or_default();
    assert!(report.state == "FAILED" && why.contains("left/link") && why.contains("right/link"), "{why}");
    // A plan for one arm avoids the current pose of the other.
    home.dimos("plan left -1.3 0 0 0 0 0").with(0);
    home.dimos("move right 1.3 0 0 0 0 0 --direct --speed 1").with(0);
    home.dimos("execute").with(1).says(&["PLAN_OUTDATED", "left/link", "right/link"]);
    home.dimos("plan left -1.3 0 0 0 0 0").with(1).says(&["left/link", "right/link"]);
}

#[test]
fn several_arms_are_sent_together_from_the_command_line() {
    let home = Home::new();
    let mocks = "--set hardware.left.adapter_type=mock --set hardware.right.adapter_type=mock";
    let _run = home.run(&format!("dual-yourarm-planner --no-record {mocks}"));
    home.dimos("plan --goal left=named:home --goal right=0,-0.3,0.6,0,0.8,0").with(0).says(&["nothing has moved"]);
    let preview = home.dimos("preview --json").with(0).json();
    assert_eq!(preview["trajectory"]["joint_names"].as_array().unwrap().len(), 12);
    let done = home.dimos("execute").with(0);
    assert!(done.out.contains("left_joint1") && done.out.contains("right_joint6"), "{}", done.out);
    // One straight line in the space of both: each has done the same part of its way at every moment.
    let (there, home_pose) =
        ("left=0.8,-0.3,0.6,0,0.8,0 --goal right=-0.4,-0.3,0.6,0,0.8,0", "left=named:home --goal right=named:home");
    Watch::of_processors().unless_stalled(|| {
        home.dimos(&format!("move --goal {home_pose}")).with(0);
        home.dimos(&format!("move --goal {there} --speed 0.2 --no-wait")).with(0);
        let (mut between, mut apart, mut task) = (0, 0.0_f64, Value::Null);
        eventually("it ends", || {
            let state = home.dimos("state --json").with(0).json();
            let turned = |arm: usize| state["arms"][arm]["joints"][0]["position"].as_f64().unwrap();
            let (left, right) = (turned(0) / 0.8, turned(1) / -0.4);
            (task, apart) = (home.status()["tasks"][0].take(), apart.max((left - right).abs()));
            between += usize::from((0.1..0.9).contains(&left));
            task["state"] != "EXECUTING"
        });
        if between > 0 && apart < 0.03 && task["state"] == "COMPLETED" {
            return Ok(());
        }
        for arm in ["left", "right"] {
            home.dimos(&format!("arm reset {arm}"));
            home.dimos(&format!("arm enable {arm}"));
        }
        Err(format!("seen {between} times on the way, {apart:.3} of the way apart: {task}"))
    });
    is_at(&home, "left", &[0.8, -0.3, 0.6, 0.0, 0.8, 0.0]);
    is_at(&home, "right", &[-0.4, -0.3, 0.6, 0.0, 0.8, 0.0]);
    // Poses, each in its own way, and the ways to type it wrong.
    home.dimos("plan --goal left=pose:0.35,0.4,0.3,3.14,0,0 --goal right=pose:0.35,-0.4,0.3").with(0);
    home.dimos("plan --goal left=pose:0.35,0.4,0.3,1,0,0,0").with(0);
    // Each in a frame of its own: back by 4 cm along the tool, and 5 cm up in map.
    let before = home.dimos("state --json").with(0).json();
    home.dimos("plan --goal left=by:0,0,-0.04@tool --goal right=by:0,0,0.05").with(0);
    let preview = home.dimos("preview --json").with(0).json();
    for (index, arm, distance) in [(0, "left", 0.04), (1, "right", 0.05)] {
        let start = &before["arms"][index]["pose"]["xyz"];
        let goal = preview["end_effectors"][arm].as_array().unwrap().last().unwrap();
        let moved =
            (0..3).map(|k| (goal[k].as_f64().unwrap() - start[k].as_f64().unwrap()).powi(2)).sum::<f64>().sqrt();
        assert!((moved - distance).abs() < 1e-3, "{arm} moves by {moved} m");
    }
    for (arguments, words) in [
        ("plan --goal left", "must be ARM=GOAL"),
        ("plan --goal left=home", "not a number"),
        ("plan --goal left=pose:1,2", "a pose has 3, 6 or 7 numbers"),
        ("plan --goal left=pos:1,2,3", "must be ARM=GOAL"),
        ("plan --goal left=by:0,0,0.1@", "@ needs a frame"),
        ("plan --goal left=by:0,0,0.1@cup", "cup"),
        ("plan left --goal right=named:home", "cannot be used with"),
        ("move --goal left=named:home --direct", "cannot be used with"),
        ("plan --goal left=named:home --named home", "cannot be used with"),
        ("plan --goal left=named:home --goal left=named:home", "left has a goal already"),
        ("plan", "required"),
    ] {
        home.dimos(arguments).with(2).says(&[words]);
    }
}

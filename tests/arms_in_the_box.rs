//! The blueprints of the arms in the box, as a user starts them: with `--sim` each moves, grips, records and stops.

#[allow(dead_code, reason = "shared with other tests")]
#[path = "support/program.rs"]
mod program;

use program::{Home, eventually};
use rustix::process::Signal;
use serde_json::Value;

/// An arm of a blueprint and what is asked of it.
struct Arm {
    name: &'static str,
    /// Where it is sent [rad].
    target: &'static [f64],
    /// How far its gripper opens [m].
    gripper: Option<f64>,
}

/// Runs a blueprint: everything that it promises, and what its log tells of it.
fn exercise(blueprint: &str, arms: &[Arm]) {
    let home = Home::new();
    home.dimos(&format!("check {blueprint} --sim")).with(0);
    let run = home.run(&format!("{blueprint} --sim --record log.mcap"));
    for arm in arms {
        let ready = run.err().lines().any(|line| line.contains(&format!("{}: SIMULATED", arm.name)));
        assert!(ready, "{} in\n{}", arm.name, run.err());
        let start = home.positions(arm.name);
        assert_eq!(start.len(), arm.target.len());
        let target: Vec<String> = arm.target.iter().map(f64::to_string).collect();
        let moved = home.dimos(&format!("move {} {} --speed 1", arm.name, target.join(" "))).with(0);
        assert!(moved.out.contains("COMPLETED"), "{}", moved.out);
        for (is, should) in home.positions(arm.name).iter().zip(arm.target) {
            assert!((is - should).abs() <= 0.01, "{}: {is} for {should}", arm.name);
        }
        if let Some(opening) = arm.gripper {
            grip(&home, arm.name, opening);
        }
    }
    let status = home.status();
    assert_eq!(status["arms"].as_array().unwrap().len(), arms.len());
    for arm in status["arms"].as_array().unwrap() {
        assert_eq!((&arm["phase"], &arm["simulated"]), (&"ready".into(), &true.into()), "{arm}");
    }
    let stopped = home.dimos("stop").with(0);
    assert!(!stopped.out.contains("not confirmed"), "{}", stopped.out);
    run.end(Signal::INT).with(130);
    let played = home.dimos("replay log.mcap --json --rate 1000 --topics /joint_states").with(0);
    let messages: Vec<Value> = played.out.lines().filter_map(|line| serde_json::from_str(line).ok()).collect();
    for arm in arms {
        let reached = messages.iter().any(|message| {
            let [names, positions] = ["name", "position"].map(|key| message["data"][key].as_array().unwrap());
            let mine = names.iter().zip(positions).filter(|(name, _)| {
                name.as_str().unwrap().strip_prefix(arm.name).is_some_and(|rest| rest.starts_with("_joint"))
            });
            let positions: Vec<f64> = mine.map(|(_, position)| position.as_f64().unwrap()).collect();
            assert_eq!(positions.len(), arm.target.len(), "{names:?}");
            positions.iter().zip(arm.target).all(|(is, should)| (is - should).abs() <= 0.01)
        });
        assert!(reached, "the log of {blueprint} does not show {} at its target", arm.name);
    }
}

/// Opens and closes a gripper.
fn grip(home: &Home, arm: &str, opening: f64) {
    for (word, position) in [("open", opening), ("close", 0.0)] {
        home.dimos(&format!("arm gripper {arm} {word}")).with(0);
        eventually(&format!("{arm} {word}"), || {
            let state = home.dimos("state --json").with(0).json();
            let arm = state["arms"].as_array().unwrap().iter().find(|a| a["hardware_id"] == arm).unwrap();
            arm["gripper"].as_f64().is_some_and(|now| (now - position).abs() < 0.002)
        });
    }
}

const PIPER: [f64; 6] = [0.4, 0.9, -0.9, -0.2, 0.3, 0.3];
const XARM: [f64; 6] = [0.3, -0.2, -0.3, 0.2, 0.4, 0.1];

#[test]
#[cfg(feature = "can")]
fn coordinator_piper() {
    exercise("coordinator-piper", &[Arm { name: "arm", target: &PIPER, gripper: Some(0.07) }]);
}

#[test]
#[cfg(feature = "can")]
fn coordinator_piper_xarm() {
    let arms = [
        Arm { name: "piper", target: &PIPER, gripper: Some(0.07) },
        Arm { name: "xarm", target: &XARM, gripper: Some(0.085) },
    ];
    exercise("coordinator-piper-xarm", &arms);
}

#[test]
#[cfg(feature = "can")]
fn a_piper_that_cannot_be_reached_or_leads_is_told_in_one_line() {
    let home = Home::new();
    let nowhere = "run coordinator-piper --no-record --set hardware.arm.address=nosuchcan7";
    home.dimos(nowhere).with(3).says(&["nosuchcan7", "hint: "]);
    home.write(
        "leader.yaml",
        "include: [coordinator-piper]\nhardware: [{hardware_id: arm, options: {sim: {faults: [{kind: leader}]}}}]\n",
    );
    let leader = home.dimos("run leader.yaml --sim --no-record").with(3);
    leader.says(&["this arm leads others: it sends commands instead of its state", "hint: ", "MasterSlaveConfig(0xFC"]);
}

#[test]
#[cfg(feature = "can")]
fn a_piper_has_no_velocity_mode_and_check_says_so() {
    let home = Home::new();
    home.write(
        "velocity.yaml",
        "include: [coordinator-piper]\ntasks: [{name: v, type: velocity, joint_names: {hardware: arm}, priority: 20}]\n",
    );
    home.dimos("check velocity.yaml").with(2).says(&["velocity", "piper"]);
    home.dimos("check coordinator-piper").with(0);
}

#[test]
#[cfg(feature = "can")]
fn a_piper_that_falls_is_told_of_wherever_its_motors_go_off() {
    let home = Home::new();
    assert!(home.dimos("list-adapters").with(0).out.lines().any(|l| l.contains("piper") && l.contains("no, falls")));
    let checked = home.dimos("check coordinator-piper --set hardware.arm.on_exit=disable --sim");
    assert!(
        format!("{}{}", checked.out, checked.err).contains("it FALLS unless supported"),
        "{}{}",
        checked.out,
        checked.err
    );
}

//! The blueprints of the built-in arms, as a user starts them: with `--sim` each moves, grips, records and stops.

use rustix::process::Signal;
use serde_json::Value;

use crate::support::program::{Home, eventually};

/// An arm of a blueprint and what is asked of it.
struct Arm {
    name: &'static str,
    /// Where it is sent [rad].
    target: &'static [f64],
    /// How far its gripper opens [m, or rad for a rotary one].
    gripper: Option<f64>,
}

/// Arms whose brakes are released by an order only.
const WITH_BRAKES: &[&str] = &["coordinator-ur5e", "ur5e-planner", "ur5e-robotiq", "keyboard-teleop-ur5e"];

/// Runs a blueprint: everything that it promises, and what its log contains.
fn exercise(blueprint: &str, arms: &[Arm]) {
    let home = Home::new();
    home.dimos(&format!("check {blueprint} --sim")).with(0);
    let run = home.run(&format!("{blueprint} --sim --record log.mcap"));
    for arm in arms {
        let ready = run.err().lines().any(|line| line.contains(&format!("{}: SIMULATED", arm.name)));
        assert!(ready, "{} in\n{}", arm.name, run.err());
        if WITH_BRAKES.contains(&blueprint) {
            assert_eq!(home.status()["arms"][0]["enabled"], false);
            assert_eq!(home.dimos(&format!("arm enable {}", arm.name)).with(0).out, format!("{}: ready\n", arm.name));
        }
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
    assert_eq!(stopped.out.matches("confirmed").count(), arms.len(), "{blueprint}: {}", stopped.out);
    let first = &arms[0];
    assert!(home.dimos(&format!("arm reset {}", first.name)).with(0).out.contains("standby"));
    assert!(home.dimos(&format!("arm enable {}", first.name)).with(0).out.contains("ready"));
    assert_eq!(home.positions(first.name).len(), first.target.len());
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
        let outcome = if word == "open" { "gripper open at" } else { "gripper closed at" };
        home.dimos(&format!("arm gripper {arm} {word}")).with(0).shows(&[outcome]);
        eventually(&format!("{arm} {word}"), || {
            let state = home.dimos("state --json").with(0).json();
            let arm = state["arms"].as_array().unwrap().iter().find(|a| a["hardware_id"] == arm).unwrap();
            arm["gripper"].as_f64().is_some_and(|now| (now - position).abs() < 0.003)
        });
    }
}

const PIPER: &[f64] = &[0.4, 0.9, -0.9, -0.2, 0.3, 0.3];
const SO101: &[f64] = &[0.3, -0.4, 0.5, 0.2, -0.6];
const FR3: &[f64] = &[0.4, -0.4, -0.2, -2.1, 0.2, 1.9, 0.6];
const UR5E: &[f64] = &[0.4, -1.3, 1.4, -1.6, -1.4, 0.3];
const XARM6: &[f64] = &[0.2, -0.5, -0.9, 0.1, 1.3, -0.1];
const XARM7: &[f64] = &[0.2, -0.4, 0.1, 0.8, 0.0, 1.2, -0.1];
const LITE6: &[f64] = &[0.2, 0.3, 1.2, 0.1, 0.9, -0.1];

#[test]
fn coordinator_xarm6() {
    exercise("coordinator-xarm6", &[Arm { name: "arm", target: XARM6, gripper: Some(0.085) }]);
}

#[test]
fn coordinator_xarm7() {
    exercise("coordinator-xarm7", &[Arm { name: "arm", target: XARM7, gripper: Some(0.085) }]);
}

#[test]
fn coordinator_lite6() {
    exercise("coordinator-lite6", &[Arm { name: "arm", target: LITE6, gripper: None }]);
}

#[test]
fn coordinator_dual_xarm() {
    let arms = [
        Arm { name: "left_arm", target: XARM7, gripper: Some(0.085) },
        Arm { name: "right_arm", target: XARM6, gripper: Some(0.085) },
    ];
    exercise("coordinator-dual-xarm", &arms);
}

#[test]
fn coordinator_piper() {
    exercise("coordinator-piper", &[Arm { name: "arm", target: PIPER, gripper: Some(0.07) }]);
}

#[test]
fn coordinator_so101() {
    exercise("coordinator-so101", &[Arm { name: "arm", target: SO101, gripper: Some(1.92) }]);
}

#[test]
fn coordinator_fr3() {
    // Its controller waits for late commands: the computer of a test may be busy.
    let slow = "coordinator-fr3 --set hardware.arm.options.sim.command_wait=0.02";
    exercise(slow, &[Arm { name: "arm", target: FR3, gripper: None }]);
}

#[test]
fn coordinator_ur5e() {
    exercise("coordinator-ur5e", &[Arm { name: "arm", target: UR5E, gripper: None }]);
}

#[test]
fn coordinator_piper_xarm() {
    let arms = [
        Arm { name: "piper", target: PIPER, gripper: Some(0.07) },
        Arm { name: "xarm", target: XARM6, gripper: Some(0.085) },
    ];
    exercise("coordinator-piper-xarm", &arms);
}

/// Everything that `dimos list-blueprints` offers runs unchanged and without hardware: with emulated arms.
#[test]
fn every_shipped_blueprint_is_without_mistakes_and_starts() {
    let home = Home::new();
    let listed = home.dimos("list-blueprints --json").with(0).json();
    let shipped: Vec<&Value> = listed.as_array().unwrap().iter().filter(|b| b["source"] == "embedded").collect();
    assert!(shipped.len() >= 18, "{listed}");
    for blueprint in shipped {
        let name = blueprint["name"].as_str().unwrap();
        assert_eq!(blueprint["problem"], Value::Null, "{name}");
        let checked = home.dimos(&format!("check {name}")).with(0);
        assert_eq!(checked.err, "", "{name} has warnings");
        assert!(!checked.out.contains("warning"), "{name}: {}", checked.out);
        let started = home.dimos(&format!("run {name} --no-record --duration 0.2")).with(0);
        let phase = if WITH_BRAKES.contains(&name) { "SIMULATED, ur, disabled" } else { "ready" };
        started.says(&[&format!("run {name}  SIMULATED"), phase, "duration reached"]);
    }
}

#[test]
#[cfg(feature = "can")]
fn a_piper_that_cannot_be_reached_or_leads_is_reported_in_one_line() {
    let home = Home::new();
    let nowhere = "run coordinator-piper --no-record --address arm=nosuchcan7";
    home.dimos(nowhere).with(3).says(&["nosuchcan7", "hint: "]);
    home.write(
        "leader.yaml",
        "include: [coordinator-piper]\nhardware: [{hardware_id: arm, options: {sim: {faults: [{kind: leader}]}}}]\n",
    );
    let leader = home.dimos("run leader.yaml --sim --no-record").with(3);
    leader.says(&["this arm leads others: it sends commands instead of its state", "hint: ", "MasterSlaveConfig(0xFC"]);
}

#[test]
fn a_piper_in_its_e_stop_is_reported_with_one_hint_and_not_as_held() {
    let home = Home::new();
    let piper = |faults: &str| {
        format!(
            "include: [coordinator-piper]\nhardware: [{{hardware_id: arm, options: {{sim: {{faults: [{faults}]}}}}}}]\n"
        )
    };
    home.write("stopped.yaml", &piper("{kind: estop}"));
    let refused = home.dimos("run stopped.yaml --sim --no-record").with(3);
    let refused =
        refused.says(&["cannot be enabled: fault 1: E-stop", "hint: the arm leaves its E-stop only by a reset"]);
    assert_eq!(refused.err.matches("hint: ").count(), 1, "{}", refused.err);
    home.write("stops.yaml", &piper("{kind: estop, at: 1.0}"));
    let run = home.run("stops.yaml --sim --no-record");
    eventually("its motors are off", || home.status()["arms"][0]["enabled"] == false);
    run.end(Signal::INT).with(130).says(&["arm: motors are off; it does not hold its pose"]);
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
fn a_piper_that_falls_is_reported_by_list_adapters_and_check() {
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

#[test]
fn what_is_wrong_with_an_xarm_is_one_line_and_exit_3() {
    let home = Home::new();
    home.dimos("run coordinator-xarm6 --set hardware.arm.address=127.0.0.1:9:9 --no-record")
        .with(3)
        .says(&["cannot connect to xarm at 127.0.0.1:9:9: connection refused", "hint: "]);
    // The emulator plays an xArm 6 with error 31, or a Lite 6.
    let simulated = "--set hardware.arm.address=sim --no-record";
    home.write("error.yaml", &with_faults("{kind: error_code, code: 31}"));
    home.dimos(&format!("run error.yaml {simulated}"))
        .with(3)
        .says(&["fault 31: a collision", "hint: clear the arm's"]);
    let run = home.run(&format!("error.yaml {simulated} --set hardware.arm.auto_enable=false"));
    let status = home.status();
    assert_eq!((&status["arms"][0]["enabled"], &status["arms"][0]["error"]["code"]), (&false.into(), &31.into()));
    run.end(Signal::INT).with(130);
    home.write("model.yaml", &with_faults("{kind: wrong_model}"));
    let said = ["expected the model xArm 6 with 6 joints, found a", "hint: is the address right?", "{model: lite6}"];
    home.dimos(&format!("run model.yaml {simulated}")).with(3).says(&said);
}

/// A recorded SO-101's shoulder rests up to 0.108 rad below its goal, and follows 0.13 s late.
#[test]
fn an_so101_that_droops_like_a_recorded_one_works() {
    let home = Home::new();
    let sim = "hardware.arm.options.sim";
    let run = home.run(&format!("coordinator-so101 --sim --no-record --set {sim}.droop=0.11 --set {sim}.lag=0.13"));
    for target in ["0.3 -0.4 0.5 0.2 -0.3", "-0.2 0.3 -0.4 -0.1 0.4", "0 0 0 0 0"] {
        let moved = home.dimos(&format!("move arm {target} --speed 0.5")).with(0);
        assert!(moved.out.contains("COMPLETED"), "{}\n{}", moved.out, moved.err);
    }
    grip(&home, "arm", 1.92);
    home.dimos("stop").with(0);
    home.dimos("arm reset arm").with(0);
    // Once more from where it hangs.
    assert_eq!(home.dimos("arm enable arm").with(0).out, "arm: ready\n");
    home.dimos("arm disable arm --now").with(0);
    run.end(Signal::INT).with(130);
}

/// Gravity parks a Piper's joints 2 and 3 at -1.999° and +1.971°, outside of their ranges (recorded on an arm).
#[test]
fn a_piper_that_gravity_has_parked_is_enabled_and_moves() {
    let home = Home::new();
    let parked = "[0.0,-0.034889,0.0344,0.0,-0.0349,0.0388]";
    let run = home
        .run(&format!("coordinator-piper --sim --no-record --set hardware.arm.options.sim.initial_positions={parked}"));
    assert_eq!(home.status()["arms"][0]["phase"], "ready", "{}", run.err());
    let moved = home.dimos("move arm 0.1 0.5 -0.5 0.1 0.2 0.1").with(0);
    assert!(moved.out.contains("COMPLETED"), "{}", moved.out);
    run.end(Signal::INT).with(130);
}

#[test]
fn an_xarm_that_is_disabled_is_not_at_fault() {
    let home = Home::new();
    let run = home.run("coordinator-xarm6 --sim --no-record");
    // Its controller reports five times a second which motors are on.
    assert_eq!(home.dimos("arm disable arm").with(0).out, "arm: disabled\n");
    assert_eq!(home.status()["arms"][0]["cause"], Value::Null);
    assert_eq!(home.dimos("arm enable arm").with(0).out, "arm: ready\n");
    home.dimos("arm disable arm").with(0);
    run.end(Signal::INT).with(130).says(&["arm: motors are off; it keeps its pose"]);
}

#[test]
fn options_that_do_not_fit_the_joints_have_a_hint_of_their_own() {
    let home = Home::new();
    home.write("seven.yaml", &with_faults("").replace("{sim", "{model: xarm7, sim"));
    let said = home.dimos("run seven.yaml --no-record").with(2);
    said.says(&["xArm 7 has 7 joints, not 6", "seven.yaml:6:22", "hint: give the arm 7 joints, or leave `model` out"]);
}

/// A blueprint of an xArm 6 whose emulator has these faults.
fn with_faults(faults: &str) -> String {
    format!(
        "hardware:
  - hardware_id: arm
    joints: {{prefix: arm, count: 6}}
    adapter_type: xarm
    address: sim
    options: {{sim: {{faults: [{faults}]}}}}
tasks:
  - {{name: traj_arm, type: trajectory, joint_names: {{hardware: arm}}}}
"
    )
}

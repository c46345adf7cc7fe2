//! A gripper with its own connection: what an arm's own does, it does as well; homed on request only; lost, it does not
//! take its arm with it.

use dimos::arms::robotiq::emulator::{self, Server};
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use serde_json::{Value, json};

use crate::support::program::{Home, Started, eventually};

const BLUEPRINT: &str = "
name: cell
include: [ur5e-planner]
hardware:
  - {hardware_id: arm, auto_enable: true, gripper: {adapter_type: robotiq_2f85, address: sim, options: {force: 60}}}
";

/// A run of a UR5e with an emulated gripper that this test has in its hand.
fn cell(options: Value, more: &str) -> (Home, Server, Started) {
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 0, options };
    let gripper = emulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    let home = Home::new();
    home.write("cell.yaml", BLUEPRINT);
    let run = home.run(&format!("cell.yaml --set hardware.arm.gripper.address={} {more}", gripper.address()));
    (home, gripper, run)
}

fn opening(gripper: &Server) -> f64 {
    gripper.truth().gripper_position.unwrap()
}

fn own(home: &Home) -> Value {
    home.status()["arms"][0]["peripherals"][0].clone()
}

#[test]
fn nothing_moves_at_the_start_and_homing_is_an_act_of_its_own() {
    let (home, gripper, run) = cell(json!({}), "");
    let before = opening(&gripper);
    assert_eq!((&own(&home)["link"], &own(&home)["condition"]), (&json!("up"), &json!("not_homed")));
    home.dimos("status").with(0).shows(&[
        "! the gripper of arm is not homed",
        "hint: dimos arm gripper arm home, which moves its fingers",
        "gripper robotiq_2f85 at /dev/pts/",
    ]);
    home.dimos("arm gripper arm open").with(1).says(&["the gripper is not homed", "hint: ", "arm gripper arm home"]);
    home.dimos("move arm --through home gripper:close up").with(1).says(&["not homed", "hint: "]);
    assert_eq!(opening(&gripper), before);
    home.dimos("arm gripper arm home --force 20").with(2).says(&["neither force nor speed"]);
    home.dimos("arm gripper arm home").with(0).shows(&["arm: gripper homed, after "]);
    assert_eq!(own(&home)["condition"], "ready");
    assert!(opening(&gripper) < 1e-6, "activation ends closed");
    let homed = home.dimos("arm gripper arm home --json").with(0).json();
    assert_eq!(homed["condition"], "ready");
    // A stop of the arm ends homing.
    home.dimos("arm gripper arm home --no-wait").with(0);
    home.dimos("stop arm").with(0);
    eventually("homing is ended", || own(&home)["condition"] == "not_homed");
    home.dimos("arm gripper arm home").with(1).says(&["arm is held", "dimos arm reset arm"]);
    home.dimos("down").with(0);
    drop(run);
    let [log] = &home.logs()[..] else { panic!("one log") };
    home.dimos(&format!("replay {} --verify", log.display())).with(0).shows(&["reproducible"]);
}

#[test]
fn verbs_outcomes_waypoints_and_attached_objects_are_as_with_an_arms_own() {
    let (home, gripper, _run) = cell(json!({"sim": {"homed": true}}), "--no-record");
    home.dimos("arm gripper arm open").with(0).shows(&["arm: gripper open at 0.0850 m, after 0."]);
    home.dimos("status -v")
        .with(0)
        .shows(&["gripper 0.0000 m closed, 0.0850 m open; force 20 to 235 N; speed control"]);
    home.dimos("arm gripper arm 0.04 --speed 1").with(0).shows(&["gripper reached 0.04"]);
    home.dimos("arm gripper arm close --force 100").with(0).shows(&["gripper closed at 0.0000 m"]);
    assert!((gripper.truth().gripper_force.unwrap() - 100.0).abs() < 1.0);
    home.dimos("arm gripper arm 0.2").with(1).says(&["0.2", "hint: "]);
    home.dimos("arm gripper arm close --force 300").with(1).says(&["20 to 235 N"]);

    home.dimos("move arm --named home").with(0);
    home.dimos("arm gripper arm open").with(0);
    gripper.with(|fingers, _| fingers.put_object(0.03));
    let pose = home.dimos("state --json").with(0).json()["arms"][0]["pose"]["xyz"].clone();
    let at: Vec<f64> = pose.as_array().unwrap().iter().map(|v| v.as_f64().unwrap()).collect();
    // The flange points down.
    home.dimos(&format!("world add cup --sphere 0.01 --at {:.4} {:.4} {:.4}", at[0], at[1], at[2] - 0.06)).with(0);
    let through = "gripper:close:cup up gripper:open:cup home --speed 1";
    let moved = home.dimos(&format!("move arm --through {through}")).with(0);
    moved.shows(&["holding an object at 0.03", "cup attached", "open at 0.0850 m", "cup detached"]);

    gripper.with(|fingers, _| fingers.put_object(0.0));
    home.dimos("arm gripper arm 0.02").with(0);
    gripper.inject(Fault::new(FaultKind::GripperBlocked).lasting(60.0)).unwrap();
    home.dimos("arm gripper arm open").with(1).says(&["gripper blocked at 0.0", "on the way to 0.0850 m"]);
}

#[test]
fn a_lost_gripper_refuses_its_acts_and_its_arm_continues() {
    let (home, gripper, _run) = cell(json!({"sim": {"homed": true}}), "--no-record");
    home.dimos("move arm --named home --speed 1").with(0);
    let moving = home.start("move arm --named up --speed 0.3");
    eventually("it moves", || home.status()["tasks"][0]["state"] == "EXECUTING");
    gripper.inject(Fault::new(FaultKind::PowerLoss).lasting(20.0)).unwrap();
    eventually("it is named", || own(&home)["link"] == "faulted");
    home.dimos("status").with(0).shows(&[
        "! the gripper of arm (robotiq_2f85 at ",
        "is lost: ",
        "hint: check its cable",
    ]);
    let moved = moving.wait().with(0);
    assert!(moved.out.contains("COMPLETED"), "{}", moved.out);
    assert_eq!((&home.status()["arms"][0]["phase"], &own(&home)["link"]), (&json!("ready"), &json!("faulted")));
    home.dimos("arm gripper arm open").with(1).says(&["the gripper of arm is lost", "hint: ", "dimos arm reset arm"]);
    home.dimos("arm gripper arm home").with(1).says(&["is lost"]);
    let still_lost = home.dimos("arm reset arm").with(0);
    assert!((still_lost.out.clone() + &still_lost.err).contains("its gripper is still lost"), "{}", still_lost.err);
    // A motion that needs it is refused before it begins.
    home.dimos("move arm --through home gripper:close up").with(1).says(&["the gripper of arm is lost"]);
    eventually("it is back", || own(&home)["link"] == "up");
    assert_eq!(own(&home)["condition"], "not_homed", "it has had no power");
    home.dimos("arm gripper arm home").with(0);
    home.dimos("arm gripper arm open").with(0);
}

#[test]
fn an_arm_that_loses_what_it_holds_is_held_and_a_motion_that_needs_the_gripper_ends() {
    let (home, gripper, _run) = cell(json!({"sim": {"homed": true}}), "--no-record");
    home.dimos("move arm --named home --speed 1").with(0);
    home.dimos("arm gripper arm open").with(0);
    let ended = home.start("move arm --through up gripper:close home --speed 0.3");
    eventually("it moves", || home.status()["tasks"][0]["state"] == "EXECUTING");
    gripper.inject(Fault::new(FaultKind::Silent).lasting(3.0)).unwrap();
    ended.wait().with(1).says(&["the gripper of arm is lost"]);
    assert_eq!(home.status()["arms"][0]["phase"], "ready", "it held nothing");
    eventually("it is back", || own(&home)["link"] == "up");

    gripper.with(|fingers, _| fingers.put_object(0.03));
    home.dimos("arm gripper arm close").with(0).shows(&["holding an object"]);
    gripper.inject(Fault::new(FaultKind::Silent).lasting(5.0)).unwrap();
    eventually("the arm is held", || home.status()["arms"][0]["cause"]["name"] == "tool_lost");
    home.dimos("status").with(0).shows(&["arm is held: its gripper is lost, with what it holds"]);
    // The operator has seen it: the arm may move.
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    eventually("it is back", || own(&home)["link"] == "up");
    home.dimos("arm gripper arm open").with(0);
}

#[test]
fn sim_starts_its_emulator_and_a_device_that_is_not_there_ends_the_start() {
    let home = Home::new();
    home.write("cell.yaml", &BLUEPRINT.replace("address: sim, options", "address: /dev/pts/7777, options"));
    home.dimos("check cell.yaml").with(0).shows(&["gripper: robotiq_2f85 at /dev/pts/7777"]);
    let failed = home.dimos("run cell.yaml --no-record --duration 1s").with(3);
    failed.says(&["arm: gripper robotiq_2f85: cannot open serial device /dev/pts/7777", "no such device"]);
    let _run = home.run("cell.yaml --no-record --sim");
    home.dimos("arm gripper arm home").with(0);
    home.dimos("arm gripper arm close").with(0);
    home.dimos("arm gripper arm open").with(0).shows(&["open at 0.0850 m"]);
}

#[test]
fn the_kit_emulates_and_tests_a_gripper_without_a_run() {
    let home = Home::new();
    let emulated = home.start("adapter emulate robotiq_2f85 --pty --link gripper");
    emulated.until("hardware[].gripper: {adapter_type: robotiq_2f85, address: ");
    let path = home.path().join("gripper").display().to_string();
    let tested = home.dimos(&format!("adapter test robotiq_2f85 --address {path}")).with(0);
    tested.shows(&["passed  reads", "Robotiq 2F: not homed, position unknown", " 0 failed"]);
    let suite = home.dimos("adapter test robotiq_2f85 --address sim --json").with(0).json();
    assert!(suite["passed"] == true && suite["checks"].as_array().unwrap().len() >= 8, "{suite}");
    home.dimos("adapter test robotiq_2f85").with(2).says(&["needs --address", "sim for its emulator"]);
    home.dimos("adapter emulate robotiq_ft300 --fault list").with(0).shows(&["power_loss"]);
    let listed = home.dimos("list-adapters").with(0).out;
    assert!(listed.contains("AT AN ARM") && listed.contains("in a blueprint: hardware[].force_torque"), "{listed}");
}

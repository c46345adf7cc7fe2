//! Runs with an arm of Universal Robots, judged by what its controller has.

use std::time::Duration;

use dimos::hardware::arms::ur::emulator::UrEmulator;
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use rustix::process::Signal;
use serde_json::json;

use crate::support::program::{Home, Started, eventually};

#[test]
fn stop_input_load_and_mounting_of_a_blueprint_are_those_of_the_controller() {
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options: json!({}) };
    let arm = UrEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    let home = Home::new();
    home.write(
        "cell.yaml",
        "include: [coordinator-ur5e]
hardware:
  - hardware_id: arm
    stop_input: {input: di2}
    mounting: {rpy: [3.141592653589793, 0, 0]}
    payload: {mass: 1.25, center: [0, 0.01, 0.05]}
",
    );
    let run = home.run(&format!("cell.yaml --no-record --set hardware.arm.address={}", arm.address()));
    assert_eq!(arm.program(), None, "nothing is enabled without an order");
    home.dimos("arm enable arm").with(0);
    let upside_down = arm.gravity().iter().zip([0.0, 0.0, -9.82]).all(|(a, b)| (a - b).abs() < 1e-6);
    assert!(upside_down, "{:?}", arm.gravity());
    assert_eq!(arm.payload(), (1.25, [0.0, 0.01, 0.05]));
    arm.set_input(2, false);
    eventually("the arm is held", || home.status()["arms"][0]["cause"]["name"] == "stop_input");
    eventually("its program ends", || arm.program().is_none());
    let refused = home.dimos("arm reset arm").with(1);
    assert!(refused.err.contains("the stop input is open"), "{}", refused.err);
    arm.set_input(2, true);
    eventually("it can be reset", || home.dimos("arm reset arm").code == Some(0));
    home.dimos("arm enable arm").with(0);
    run.end(Signal::INT).with(130);
}

/// The controller ends a protective stop 5 s after it at the earliest. A stop of that time is not reset with it.
#[test]
fn a_stop_while_an_error_is_cleared_holds_the_arm() {
    let home = Home::new();
    let fault = "hardware.arm.options.sim.faults=[{at: 4, kind: error_code, code: 153}]";
    let mut run = home.command("run coordinator-ur5e --no-record");
    let run = Started::of(run.arg("--set").arg(fault));
    run.until("Press Ctrl-C for a controlled stop.");
    home.dimos("arm enable arm").with(0);
    eventually("the protective stop", || home.status()["arms"][0]["phase"] == "held");
    let reset = home.start("arm reset arm");
    std::thread::sleep(Duration::from_millis(800));
    home.dimos("stop").with(0).shows(&["confirmed"]);
    reset.wait().with(1).says(&["arm was stopped while its hold was being cleared", "dimos arm reset arm"]);
    assert_eq!(home.status()["arms"][0]["phase"], "held");
    home.dimos("arm enable arm").with(1).says(&["reset it first"]);
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    run.end(Signal::INT).with(130);
}

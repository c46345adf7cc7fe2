//! Runs with an arm of Universal Robots, judged by what its controller has.

use std::time::Duration;

use dimos::arms::ur::emulator::UrEmulator;
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
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

#[test]
fn the_arms_own_kinematics_are_read_and_kept_and_another_arm_is_not_taken_for_it() {
    let mut dh = dimos::arms::ur::model::Model::Ur5e.dh();
    (dh[1].a, dh[2].d, dh[3].alpha) = (-0.423, 0.004, dh[3].alpha + 0.001);
    let options = json!({"sim": {"kinematics": dh}});
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options };
    let arm = UrEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    let (home, address) = (Home::new(), arm.address());
    home.dimos(&format!("arm kinematics ur --address {address} --write arm.json")).with(0).shows(&["-0.423000"]);
    let read = |path: &str| -> serde_json::Value {
        serde_json::from_str(&std::fs::read_to_string(home.path().join(path)).unwrap()).unwrap()
    };
    assert_eq!(read("arm.json")["actual"], json!(dh));
    let run = home.run(&format!("ur5e-planner --no-record --set hardware.arm.address={address}"));
    assert!(run.err().contains("model: factory kinematics of serial 20195500123"), "{}", run.err());
    assert_eq!(read("state/dimos/kinematics/ur-20195500123.json"), read("arm.json"), "kept as it is written");
    home.dimos(&format!("arm kinematics ur --address {address}")).with(3).says(&["in use by process"]);
    assert_eq!(home.dimos("arm kinematics arm --json").with(0).json()["actual"], json!(dh), "of the run");
    home.dimos("arm kinematics other").with(2).says(&["the run has no arm other", "hint: "]);
    home.dimos("arm enable arm").with(0);
    arm.set_serial("20219999999");
    arm.inject(Fault::new(FaultKind::Disconnect)).unwrap();
    eventually("another arm is seen", || home.status()["arms"][0]["cause"]["name"] == "identity_changed");
    home.dimos("arm enable arm").with(1);
    home.dimos("arm reset arm").with(1).says(&["serial 20195500123", "serial 20219999999"]);
    home.dimos("arm enable arm").with(1);
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    assert_eq!(home.status()["arms"][0]["identity"], "serial 20219999999");
    run.end(Signal::INT).with(130);
    // A new run does not ask.
    let run = home.run(&format!("coordinator-ur5e --no-record --set hardware.arm.address={address}"));
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

/// An arm that is not simulated by its run, and a run of it.
fn live(home: &Home, options: serde_json::Value) -> (UrEmulator, Started) {
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options };
    let arm = UrEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    let run = home.run(&format!("coordinator-ur5e --no-record --set hardware.arm.address={}", arm.address()));
    home.dimos("arm enable arm").with(0);
    (arm, run)
}

/// Moves all joints by 0.8 rad with `during` beside it. Returns the time that passed from the first to the last point
/// of servoj that is another one than the point before [s], and the furthest point from the straight line [rad].
fn moved(home: &Home, arm: &UrEmulator, during: impl FnOnce()) -> (f64, f64) {
    let from = home.positions("arm");
    let to: Vec<f64> = from.iter().enumerate().map(|(j, q)| q + [0.8, -0.6, 0.4, 0.7, -0.5, 0.3][j]).collect();
    let seen = arm.servoj().len();
    let goal: Vec<String> = to.iter().map(f64::to_string).collect();
    let moving = home.start(&format!("move arm {} --speed 0.5", goal.join(" ")));
    during();
    moving.wait().with(0).shows(&["COMPLETED"]);
    let points = arm.servoj().split_off(seen);
    let moves: Vec<_> = points.windows(2).filter(|two| two[0].1 != two[1].1).map(|two| two[1].0).collect();
    let time = moves.last().unwrap().seconds_since(moves[0]);
    let way: f64 = from.iter().zip(&to).map(|(a, b)| (b - a).powi(2)).sum();
    let off = |point: &[f64; 6]| {
        let along: f64 = (0..6).map(|j| (point[j] - from[j]) * (to[j] - from[j])).sum::<f64>() / way;
        (0..6).map(|j| (point[j] - from[j] - along * (to[j] - from[j])).abs()).fold(0.0, f64::max)
    };
    (time, points.iter().map(|(_, point)| off(point)).fold(0.0, f64::max))
}

#[test]
fn a_motion_at_30_percent_of_the_slider_takes_as_much_longer_on_the_same_line() {
    let home = Home::new();
    let (arm, run) = live(&home, json!({}));
    let (full, off) = moved(&home, &arm, || ());
    assert!(off < 2e-3, "{off} rad off the line at full speed");
    arm.set_slider(0.3);
    let says = "arm is slowed by its controller to 30 % of the speed";
    eventually("the status says so", || home.status()["arms"][0]["speed_fraction"] == 0.3);
    home.dimos("status").with(0).shows(&[says]);
    home.dimos("state").with(0).shows(&[says]);
    assert_eq!(home.dimos("state --json").json()["arms"][0]["speed_fraction"], 0.3);
    let (slow, off) = moved(&home, &arm, || ());
    assert!(off < 2e-3, "{off} rad off the line at 30 %");
    assert!((slow / full * 0.3 - 1.0).abs() < 0.05, "{slow} s instead of {full} s");
    // The limits of reduced mode, beside the slider.
    arm.set_safety(Some(2));
    arm.set_scaling(0.5);
    let (slower, off) = moved(&home, &arm, || ());
    assert!(off < 2e-3 && (slower / full * 0.15 - 1.0).abs() < 0.05, "{slower} s instead of {full} s, {off} rad off");
    assert!(home.status()["arms"][0]["cause"].is_null());
    run.end(Signal::INT).with(130);
}

#[test]
fn a_slider_that_changes_in_motion_also_to_zero_and_back_is_followed() {
    let home = Home::new();
    let (arm, run) = live(&home, json!({}));
    let (_, off) = moved(&home, &arm, || {
        eventually("it moves", || home.status()["tasks"][0]["progress"].as_f64().is_some_and(|p| p > 0.2));
        arm.set_slider(0.3);
        std::thread::sleep(Duration::from_millis(400));
        arm.set_slider(0.0);
        std::thread::sleep(Duration::from_millis(300));
        let rests = home.positions("arm");
        std::thread::sleep(Duration::from_millis(2500));
        let moved = home.positions("arm").iter().zip(&rests).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(moved < 1e-6, "{moved} rad at 0 %");
        home.dimos("status").with(0).shows(&["EXECUTING", "is stopped by its controller (0 % of the speed)"]);
        arm.set_slider(0.1);
        std::thread::sleep(Duration::from_millis(400));
        arm.set_slider(1.0);
    });
    assert!(off < 5e-3, "{off} rad off the line");
    assert_eq!(home.status()["arms"][0]["phase"], "ready");
    // At 0, a motion can be cancelled, and nothing moves when the slider goes up.
    let motion = home.start("move arm 0.3 -1.4 1.5 -1.7 -1.5 0.4");
    eventually("it moves", || home.status()["tasks"][0]["state"] == "EXECUTING");
    std::thread::sleep(Duration::from_millis(300));
    arm.set_slider(0.0);
    eventually("it is seen", || home.status()["arms"][0]["speed_fraction"] == 0.0);
    home.dimos("cancel").with(0);
    motion.wait().with(1);
    home.dimos("stop").with(0).shows(&["confirmed"]);
    eventually("the program ends", || arm.program().is_none());
    run.end(Signal::INT).with(130);
}

/// Before power-on, and when its motors are on.
#[test]
fn zeros_that_nothing_proves_are_no_pose() {
    for powered in [false, true] {
        let home = Home::new();
        let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options: json!({}) };
        let arm = UrEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
        let run = home.run(&format!("coordinator-ur5e --no-record --set hardware.arm.address={}", arm.address()));
        if powered {
            home.dimos("arm enable arm").with(0);
            home.dimos("stop").with(0);
            home.dimos("arm reset arm").with(0);
        }
        let seen = arm.servoj().len();
        arm.inject(Fault::new(FaultKind::ZeroState).lasting(60.0)).unwrap();
        eventually("it is read", || home.positions("arm") == [0.0; 6]);
        let mut refused = home.dimos("arm enable arm").with(1);
        // Read for long enough, they are a jump first, which is to be reset.
        if refused.err.contains("ARM_LATCHED") {
            assert!(refused.err.contains("jumped by"), "{powered}: {}", refused.err);
            home.dimos("arm reset arm").with(0);
            refused = home.dimos("arm enable arm").with(1);
        }
        assert!(refused.err.contains("every joint reads exactly 0"), "{powered}: {}", refused.err);
        assert_eq!((arm.program(), arm.servoj().len()), (None, seen), "nothing is written");
        run.end(Signal::INT).with(130);
    }
}

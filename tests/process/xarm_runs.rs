//! Whole runs with an xArm, judged by what its emulator received: another client takes the arm over, stops it; a box
//! that takes its time; an arm at zero.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use dimos::arms::xarm::emulator::{Received, XArmEmulator};
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use rustix::process::Signal;
use serde_json::{Value, json};

use crate::support::program;
use crate::support::program::{Home, Started, eventually};

fn emulator(options: Value) -> XArmEmulator {
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options };
    XArmEmulator::start(&config, &EmulatorAddress::InProcess).unwrap()
}

fn run(home: &Home, emulator: &XArmEmulator, more: &str) -> Started {
    let address = emulator.address();
    home.start(&format!("run coordinator-xarm6 --no-record --set hardware.arm.address={address} {more}"))
}

const NO_GRIPPER: &str = "--set hardware.arm.options.gripper=none";

fn phase(home: &Home) -> (String, String) {
    let arm = &home.status()["arms"][0];
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    (text(&arm["phase"]), text(&arm["cause"]["name"]))
}

fn up(home: &Home, run: &Started) {
    run.until(program::UP);
    eventually("ready", || phase(home).0 == "ready");
}

/// Another client of the controller. It speaks protocol 2, the run 3.
fn send(client: &mut TcpStream, register: u8, payload: &[u8]) {
    let head = [0, 1, 0, 2, 0, payload.len() as u8 + 1, register];
    client.write_all(&[&head[..], payload].concat()).unwrap();
    assert_ne!(client.read(&mut [0; 64]).unwrap(), 0);
}

fn connect(emulator: &XArmEmulator) -> TcpStream {
    TcpStream::connect(emulator.address().rsplit_once(':').unwrap().0).unwrap()
}

/// What the run sent after the first request of another client that changes mode, state, motors or position.
fn ours(emulator: &XArmEmulator) -> Vec<Received> {
    let trace = emulator.trace();
    let theirs = trace.iter().position(|r| r.protocol == 2 && !r.second).unwrap_or(trace.len());
    let orders = [11, 12, 16, 19, 21, 23, 29, 30, 81];
    trace.into_iter().skip(theirs).filter(|r| r.protocol == 3 && orders.contains(&r.register)).collect()
}

/// Setpoints already on their way are refused by the controller.
fn only_refused_set_points(received: &[Received]) -> bool {
    received.len() <= 2 && received.iter().all(|r| r.register == 29 && r.status & 0x58 != 0)
}

#[test]
fn an_arm_that_another_client_takes_over_is_left_to_it() {
    for spacing in [0, 5, 200] {
        let (home, emulator) = (Home::new(), emulator(json!({})));
        let run = run(&home, &emulator, NO_GRIPPER);
        up(&home, &run);
        let goal = emulator.joints().0.map(|q| q + 0.4);
        let mut client = connect(&emulator);
        emulator.record();
        send(&mut client, 19, &[0, 0]);
        std::thread::sleep(Duration::from_millis(spacing));
        send(&mut client, 12, &[0]);
        std::thread::sleep(Duration::from_millis(spacing));
        let numbers: Vec<f32> = goal[..6].iter().map(|q| *q as f32).chain([0.0, 3.0, 8.0, 0.0]).collect();
        send(&mut client, 23, &numbers.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>());
        let there = || emulator.joints().0.iter().zip(&goal[..6]).all(|(q, goal)| (q - goal).abs() < 1e-3);
        eventually("the client's goal", there);
        eventually("the hold", || phase(&home) == ("held".into(), "mode_changed".into()));
        // A requested stop goes to the arm; the end of the run alone sends nothing.
        run.end(Signal::INT);
        let ours = ours(&emulator);
        assert!(there() && emulator.enabled() && only_refused_set_points(&ours), "{spacing} ms: {ours:?}");
    }
}

#[test]
fn a_stop_by_another_client_is_named_and_reset_and_enable_take_the_arm_back() {
    let (home, emulator) = (Home::new(), emulator(json!({})));
    let run = run(&home, &emulator, NO_GRIPPER);
    up(&home, &run);
    let mut client = connect(&emulator);
    emulator.record();
    send(&mut client, 12, &[4]);
    eventually("the hold", || phase(&home) == ("held".into(), "stopped_elsewhere".into()));
    assert!(run.err().contains("another client stopped the arm (state 4)"), "{}", run.err());
    assert!(only_refused_set_points(&ours(&emulator)), "{:?}", ours(&emulator));
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    eventually("ready", || phase(&home).0 == "ready");
    run.end(Signal::INT).with(130);
}

#[test]
fn a_box_that_takes_its_time_is_enabled_stopped_and_reset() {
    for delay in [0.3, 0.6, 1.2] {
        let home = Home::new();
        let slow = |register: u8, delay: f64| json!({"register": register, "delay": delay});
        let slow = json!([slow(11, delay), slow(12, 0.25), slow(16, 0.25), slow(124, 0.1)]);
        let emulator = emulator(json!({"gripper": "xarm", "sim": {"slow_replies": slow}}));
        let run = run(&home, &emulator, "");
        up(&home, &run);
        let stopped = home.dimos("stop --json").with(0).json();
        assert_eq!(stopped["coordinator-xarm6"]["arms"]["arm"], "confirmed", "{delay} s");
        home.dimos("arm reset arm").with(0);
        home.dimos("arm enable arm").with(0);
        eventually("ready", || phase(&home).0 == "ready");
        run.end(Signal::INT).with(130);
        assert!(!emulator.enabled());
    }
}

#[test]
fn an_arm_at_zero_is_enabled_and_one_that_has_not_measured_is_not() {
    let zero = json!({"sim": {"initial_positions": [0, 0, 0, 0, 0, 0]}});
    let (home, at_zero) = (Home::new(), emulator(zero));
    let started = run(&home, &at_zero, NO_GRIPPER);
    up(&home, &started);
    started.end(Signal::INT).with(130);
    let (home, unmeasured) = (Home::new(), emulator(json!({})));
    unmeasured.inject(Fault::new(FaultKind::ZeroState).lasting(60.0)).unwrap();
    let ended = run(&home, &unmeasured, NO_GRIPPER).wait();
    assert!(ended.err.contains("not measured yet"), "{}", ended.err);
    assert!(!unmeasured.enabled());
}

fn floats(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).collect()
}

/// Sets the limits of reduced mode and switches it on: speed of the tool [mm/s] and of joints [rad/s].
fn reduce(client: &mut TcpStream, tool: f32, joint: f32) {
    send(client, 47, &floats(&[tool]));
    send(client, 48, &floats(&[joint]));
    let ranges = [[-6.0, 6.0], [-2.0, 2.0], [-3.8, 0.1], [-6.0, 6.0], [-1.6, 3.0], [-6.0, 0.5], [-6.0, 6.0]];
    send(client, 58, &floats(ranges.as_flattened()));
    send(client, 50, &[1]);
}

#[test]
fn a_run_keeps_within_reduced_mode_and_is_held_if_it_becomes_narrower() {
    let (home, emulator) = (Home::new(), emulator(json!({})));
    let mut client = connect(&emulator);
    reduce(&mut client, 200.0, 0.5);
    let run = run(&home, &emulator, &format!("{NO_GRIPPER} --set hardware.arm.auto_enable=false"));
    run.until(program::UP);
    // An arm that is off is not enabled while its box allows less than the run.
    reduce(&mut client, 100.0, 0.5);
    let tool = "its controller's settings limit the tool to 0.10 m/s, the run to 0.19 m/s";
    eventually("the limits", || run.err().contains(tool));
    home.dimos("arm enable arm").with(1).says(&[tool, "hint: restart the run"]);
    reduce(&mut client, 200.0, 0.5);
    eventually("enabled", || home.dimos("arm enable arm").code == Some(0));
    eventually("ready", || phase(&home).0 == "ready");
    home.dimos("status").with(0).shows(&["reduced mode is on: joints 0.50 rad/s, tool 0.19 m/s"]);
    assert_eq!(home.status()["arms"][0]["position_limits"][5], json!([-6.0, 0.5]));
    // A far joint is limited by its own speed, the first one by that of the tool. Faster, the box reports error 24 or
    // 60.
    home.dimos("move arm 0.8 -0.6 -0.8 0.9 1.4 0.1").with(0);
    home.dimos("move arm 0.1 -0.6 -0.8 0.05 1.4 0.6").with(1).says(&["joint6"]);
    // Wider limits change nothing, narrower ones hold the arm: also in a motion.
    reduce(&mut client, 400.0, 1.0);
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(phase(&home).0, "ready");
    let moves = home.start("move arm -0.8 -0.6 -0.8 0.05 1.4 0.1");
    eventually("the motion", || emulator.joints().1.iter().any(|v| v.abs() > 0.1));
    reduce(&mut client, 400.0, 0.4);
    eventually("the hold", || phase(&home) == ("held".into(), "limits_changed".into()));
    assert_ne!(moves.wait().code, Some(0));
    let said = "its controller limits joint 1 to 0.40 rad/s, the run to 0.50 rad/s";
    assert!(run.err().contains(said), "{}", run.err());
    home.dimos("arm reset arm").with(1).says(&["narrower than those of the run"]);
    reduce(&mut client, 200.0, 0.5);
    eventually("a reset", || home.dimos("arm reset arm").code == Some(0));
    home.dimos("arm enable arm").with(0);
    eventually("ready", || phase(&home).0 == "ready");
    run.end(Signal::INT).with(130);
}

/// What is said of a Lite 6's gripper is what its outputs are, and never that it holds something.
#[test]
fn a_gripper_that_only_opens_and_closes_is_ordered_and_not_measured() {
    let home = Home::new();
    let run = home.run("coordinator-lite6 --sim --no-record --set hardware.arm.options.gripper=lite6");
    assert!(!home.dimos("state").with(0).out.contains("gripper"), "nothing is known before the first order");
    home.dimos("status -v").with(0).shows(&["gripper only opens (1) and closes (0); nothing measures its fingers"]);
    let closed = home.dimos("arm gripper arm close --json").with(0).json();
    assert_eq!((&closed["outcome"], &closed["unit"]), (&json!("ordered"), &json!("on_off")), "{closed}");
    home.dimos("state").with(0).shows(&["gripper  closed (as ordered)"]);
    home.dimos("arm gripper arm open").with(0).shows(&["gripper ordered to open, which nothing measures"]);
    home.dimos("arm gripper arm 0.5").with(1).says(&["only closes (0) and opens (1)", "hint: "]);
    home.dimos("arm gripper arm close --force 10").with(1).says(&["has no force control"]);
    home.dimos("state").with(0).shows(&["gripper  open (as ordered)"]);
    run.end(Signal::INT).with(130);
}

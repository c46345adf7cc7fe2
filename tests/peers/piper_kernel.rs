//! The Piper's adapter and emulator over the CAN of a real kernel, in a guest (`support/uml.rs`).

#![cfg(all(feature = "can", target_os = "linux"))]

use std::io::{BufRead, BufReader, Write};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use dimos::arm::StopPoint;
use dimos::arms::piper::GripperKind;
use dimos::arms::piper::adapter::PiperAdapter;
use dimos::arms::piper::emulator::{PiperEmulator, SimOptions};
use dimos::hardware::adapter::{AdapterError, JointReading, ManipulatorAdapter};
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::joint::ControlMode;
use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::support::python::python_with;
use crate::support::uml;
use crate::support::uml::{Guest, parts_in_guest, sh};

/// For what should take a moment, on a busy machine.
const WAIT: Duration = Duration::from_secs(20);
/// How long frames are counted.
const FULL_RATE_FOR: Duration = Duration::from_secs(4);

#[test]
fn the_adapter_over_a_real_kernel() {
    let parts = uml::parts! {
        at_the_full_rate_nothing_is_lost: uml::VCAN;
        an_interface_may_go_down_and_come_back: uml::VCAN;
        at_most_two_set_points_wait_in_the_kernel: uml::VXCAN;
        two_arms_on_two_interfaces_do_not_hear_each_other: uml::VCAN;
    };
    parts_in_guest(module_path!(), "the_adapter_over_a_real_kernel", &Guest::with(""), &parts);
}

#[test]
fn the_vendors_sdk_over_a_real_kernel() {
    if python_with(&["piper_sdk"]).is_none() {
        return;
    }
    let parts = uml::parts! {
        what_the_vendors_sdk_changes_of_the_mode_is_seen_and_left_alone: uml::VXCAN;
        what_the_vendors_sdk_changes_of_the_power_is_seen_and_left_alone: uml::VXCAN;
        the_vendors_sdk_moves_the_emulator_over_a_pair_of_interfaces: uml::VXCAN;
    };
    let guest = Guest { limit: Duration::from_secs(180), ..Guest::with("") };
    parts_in_guest(module_path!(), "the_vendors_sdk_over_a_real_kernel", &guest, &parts);
}

fn emulator(interface: &str, options: &SimOptions) -> PiperEmulator {
    PiperEmulator::with(options, GripperKind::Small, &EmulatorAddress::Can(interface.into())).unwrap()
}

fn adapter(interface: &str) -> PiperAdapter {
    let options = serde_json::Value::Null;
    PiperAdapter::new(&AdapterConfig { hardware_id: interface.into(), address: interface.into(), dof: 6, options })
        .unwrap()
}

fn until(what: &str, mut done: impl FnMut() -> bool) {
    let end = Instant::now() + WAIT;
    while !done() {
        assert!(Instant::now() < end, "{what}: not within {WAIT:?}");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// Waits for the next state as a device thread does, and takes it up.
fn next(arm: &mut PiperAdapter, reading: &mut JointReading) {
    let timeout = Timespec { tv_sec: 1, tv_nsec: 0 };
    let state = arm.state_fd().expect("connected");
    poll(&mut [PollFd::from_borrowed_fd(state, PollFlags::IN)], Some(&timeout)).unwrap();
    arm.read_joints(reading).unwrap();
}

/// Lets the arm pause for a moment, in which all that was under way arrives: frames sent, and frames decoded.
fn counted(emulator: &PiperEmulator, arm: &mut PiperAdapter) -> (u64, u64) {
    emulator.inject(Fault::new(FaultKind::Silent).lasting(0.12)).unwrap();
    std::thread::sleep(Duration::from_millis(80));
    arm.read_joints(&mut JointReading::default()).unwrap();
    (emulator.sent(), arm.counts().0.decoded)
}

fn near(a: &[f64], b: &[f64]) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-3)
}

fn at_the_full_rate_nothing_is_lost() {
    let emulator = emulator("vcan0", &SimOptions::default());
    let mut arm = adapter("vcan0");
    arm.connect().unwrap();
    arm.activate().unwrap();
    let before = counted(&emulator, &mut arm);
    let mut reading = JointReading::default();
    until("the end of the pause", || arm.read_joints(&mut reading).is_ok() && emulator.sent() > before.0);
    let began = Instant::now();
    let mut target = reading.position[..6].to_vec();
    let mut bursts = 0;
    while began.elapsed() < FULL_RATE_FOR {
        next(&mut arm, &mut reading);
        // Commands go the other way meanwhile, at 100 Hz.
        if began.elapsed().as_millis() / 10 > bursts {
            bursts = began.elapsed().as_millis() / 10;
            target[0] = 0.1 + 0.3 * (began.elapsed().as_secs_f64()).sin();
            arm.write_joint_positions(&target, 1.0).unwrap();
        }
    }
    let seconds = began.elapsed().as_secs_f64();
    let after = counted(&emulator, &mut arm);
    let (sent, decoded) = (after.0 - before.0, after.1 - before.1);
    let (counts, wire) = arm.counts();
    println!("{:.0} frames/s for {seconds:.1} s: {sent} sent, {decoded} decoded, {wire:?}", sent as f64 / seconds);
    assert_eq!((sent, emulator.not_taken()), (decoded, 0));
    assert_eq!((counts.damaged, counts.other, wire.overflows, wire.not_taken), (0, 0, 0, 0));
    // 2 320 frames/s: the emulator makes up for the periods in which the guest got nothing of the machine.
    assert!(sent as f64 >= 2_213.0 * FULL_RATE_FOR.as_secs_f64(), "{sent} frames in {seconds} s");
}

fn an_interface_may_go_down_and_come_back() {
    let emulator = emulator("vcan0", &SimOptions::default());
    let mut arm = adapter("vcan0");
    arm.connect().unwrap();
    arm.activate().unwrap();
    let (there, _) = emulator.joints();
    sh("ip link set vcan0 down");
    let mut reading = JointReading::default();
    until("the end of the connection", || arm.read_joints(&mut reading).is_err() && !arm.is_connected());
    let error = arm.connect().unwrap_err().to_string();
    assert!(error.contains("is down\nhint: ip link set vcan0 up"), "{error}");
    sh("ip link set vcan0 up");
    until("the arm", || arm.connect().is_ok());
    assert_eq!(arm.read_enabled(), Ok(true), "its motors stayed on");
    assert!(near(&emulator.joints().0, &there), "and it did not move");
    arm.activate().unwrap();
    let target = [0.3, 0.7, -0.8, 0.1, 0.3, 0.0];
    arm.write_joint_positions(&target, 0.5).unwrap();
    until("arrival", || arm.read_joints(&mut reading).is_ok() && near(&reading.position, &target));
    sh("ip link del vcan0");
    until("the end of the interface", || arm.read_joints(&mut reading).is_err() && !arm.is_connected());
    let error = arm.connect().unwrap_err();
    assert!(matches!(&error, AdapterError::Io(text) if text.contains("no such interface\nhint: ")), "{error}");
}

/// The interface sends nothing for a while: at most two setpoints wait, and after `discard_pending` nothing new goes
/// out before they are transmitted.
fn at_most_two_set_points_wait_in_the_kernel() {
    let emulator = emulator("sim0", &SimOptions::default());
    let mut arm = adapter("can0");
    arm.connect().unwrap();
    arm.activate().unwrap();
    arm.set_control_mode(ControlMode::ServoPosition).unwrap();
    sh("tc qdisc add dev can0 root plug limit 100000; tc qdisc change dev can0 root plug block");
    emulator.record();
    let mut target = [0.1, 0.6, -0.7, 0.05, 0.4, -0.1];
    let taken = (0..20).filter(|_| {
        target[0] += 0.002;
        arm.write_joint_positions(&target, 1.0).is_ok()
    });
    let taken = taken.count();
    assert!((1..=2).contains(&taken), "{taken} setpoints wait");
    arm.discard_pending();
    let rest = StopPoint { position: Some(dimos::joint::joints_of(&target)) };
    assert!(arm.write_stop(&rest).is_err() && arm.is_connected(), "they must be out first");
    sh("tc qdisc change dev can0 root plug release_indefinite");
    until("a stop", || arm.write_stop(&rest).is_ok());
    until("the stop at the arm", || emulator.trace().iter().filter(|(_, f)| f.id == 0x157).count() == taken + 1);
    let ids: Vec<u16> = emulator.trace().iter().map(|(_, frame)| frame.id).collect();
    assert!(ids.len() <= 12, "{ids:x?}");
}

fn two_arms_on_two_interfaces_do_not_hear_each_other() {
    let names = ["vcan0", "vcan1"];
    let emulators = names.map(|name| emulator(name, &SimOptions::default()));
    let mut arms = names.map(adapter);
    let targets = [[0.4, 0.9, -0.9, 0.2, 0.2, 0.3], [-0.4, 0.3, -0.4, -0.2, 0.6, -0.5]];
    for (arm, target) in arms.iter_mut().zip(&targets) {
        arm.connect().unwrap();
        arm.activate().unwrap();
        arm.write_joint_positions(target, 0.5).unwrap();
    }
    let mut reading = JointReading::default();
    until("both arms", || {
        let there = |(arm, target): (&mut PiperAdapter, &[f64; 6])| {
            arm.read_joints(&mut reading).is_ok() && near(&reading.position, target)
        };
        arms.iter_mut().zip(&targets).all(there)
    });
    for (emulator, target) in emulators.iter().zip(&targets) {
        assert!(near(&emulator.joints().0, target));
    }
}

/// Streams the arm's pose as a device thread does, until its mode or motors differ from what was commanded.
fn stream_until_changed(arm: &mut PiperAdapter, reading: &mut JointReading) {
    let pose = reading.position;
    until("a sign of the change", || {
        let _ = arm.read_joints(reading);
        if arm.get_control_mode() != ControlMode::ServoPosition || !arm.read_enabled().unwrap_or(true) {
            return true;
        }
        let _ = arm.write_joint_positions(&pose[..6], 1.0);
        std::thread::sleep(Duration::from_millis(5));
        false
    });
}

/// The vendor's SDK beside the adapter on one interface: the adapter does not hear it, and sees in the arm's feedback
/// what its calls change. They are not undone.
fn interfere(kinds: &[&str], pauses: &[u32], feedback_hz: f64) {
    let emulator = emulator("sim0", &SimOptions { feedback_hz, ..SimOptions::default() });
    let mut sdk = Command::new(".venv/bin/python")
        .args(["tests/python/piper_sdk_interferes.py", "can0"])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let (mut calls, mut answers) = (sdk.stdin.take().unwrap(), BufReader::new(sdk.stdout.take().unwrap()).lines());
    let mut answered = |word: &str| assert_eq!(answers.next().unwrap().unwrap(), word);
    answered("ready");
    let mut arm = adapter("can0");
    arm.connect().unwrap();
    let mut reading = JointReading::default();
    for (kind, pause) in kinds.iter().flat_map(|kind| pauses.iter().map(move |pause| (kind, pause))) {
        until("the arm", || arm.write_clear_errors().is_ok() && arm.write_enable(true).is_ok());
        arm.set_control_mode(ControlMode::ServoPosition).unwrap();
        arm.read_joints(&mut reading).unwrap();
        arm.write_joint_positions(&reading.position[..6], 1.0).unwrap();
        emulator.record();
        writeln!(calls, "{kind} {pause}").unwrap();
        stream_until_changed(&mut arm, &mut reading);
        answered("done");
        assert!(arm.write_joint_positions(&reading.position[..6], 1.0).is_err(), "{kind} {pause}");
        let trace = emulator.trace();
        // Of the frames that change a mode or switch motors, there are the SDK's only.
        let orders = trace.iter().filter(|(_, f)| matches!(f.id, 0x150 | 0x151 | 0x471)).count();
        assert_eq!(orders, if *kind == "pose" { 1 } else { 2 }, "{kind} {pause}: {trace:x?}");
        println!("{kind}, {pause} ms apart: seen, not changed");
        if *kind == "pose" {
            let there = |joints: &[f64]| emulator.joints().1.iter().all(|v| v.abs() < 1e-3) && joints[1] > 0.0;
            until("the SDK's pose", || there(&emulator.joints().0));
        }
    }
    drop(calls);
    sdk.wait().unwrap();
}

fn what_the_vendors_sdk_changes_of_the_mode_is_seen_and_left_alone() {
    // At the full rate the SDK's Python takes most of the guest's one processor.
    interfere(&["pose", "guiding"], &[0, 5, 200], 20.0);
}

fn what_the_vendors_sdk_changes_of_the_power_is_seen_and_left_alone() {
    // The arm's motors tell that they are off with every fifth state: a shorter pause may hide in a stall of the guest.
    interfere(&["power"], &[200], 200.0);
}

/// The vendor's SDK opens its sockets without local loopback: on one interface its commands would not arrive.
fn the_vendors_sdk_moves_the_emulator_over_a_pair_of_interfaces() {
    // At the full rate the SDK's Python takes most of the guest's one processor.
    let options = SimOptions { feedback_hz: 20.0, firmware: "S-V1.6-3".into(), ..SimOptions::default() };
    let emulator = emulator("sim0", &options);
    sh(".venv/bin/python tests/python/piper_sdk_moves.py can0");
    assert!(!emulator.enabled() && emulator.power_drops() == 0);
    assert!((emulator.joints().0[0].to_degrees() - 20.0).abs() < 0.05);
}

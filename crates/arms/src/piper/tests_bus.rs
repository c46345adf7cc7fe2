//! Faults of the CAN bus: interface down, loss of power, no buffers, bus-off, damaged frames. Numbers as in
//! `docs/faults.md`.

use std::time::Duration;

use super::adapter::PiperAdapter;
use super::emulator::PiperEmulator;
use super::feedback::Feedback;
use super::golden;
use super::protocol::{DOF, decode};
use super::tests::{START, activate, at, config, connected, farthest, ids, read, until};
use super::tests_faults::{failure, other};
use dimos_core::clock::Mono;
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::{AdapterError, Cartesian, Gripper, ManipulatorAdapter};
use dimos_hardware::registry::Emulator;
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::transport::can::CanFrame;

#[test]
fn f04_an_interface_that_goes_down_is_noticed_and_used_again() {
    let (emulator, mut arm) = connected();
    emulator.inject(Fault::new(FaultKind::Disconnect).lasting(0.3)).unwrap();
    let error = failure(&mut arm).to_string();
    assert!(error.contains("the interface went down"), "{error}");
    assert!(!arm.is_connected());
    assert_eq!(read(&mut arm).unwrap_err(), AdapterError::NotConnected);
    assert!(matches!(arm.connect(), Err(AdapterError::Io(_))), "still down");
    until("the interface", || arm.connect().is_ok());
    assert!(farthest(&read(&mut arm).unwrap().position, &START) < 1e-4);
}

/// Lets the arm lose its power, and commands on until a setpoint is refused. Answers the commands that reached the arm
/// when its power was back.
fn commanded_without_power(discard: bool) -> (PiperEmulator, PiperAdapter, usize) {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    arm.set_control_mode(ControlMode::ServoPosition).unwrap();
    emulator.inject(Fault::new(FaultKind::PowerLoss).lasting(1.5)).unwrap();
    let mut target = START;
    let mut refused = None;
    until("the refusal", || {
        target[0] += 0.002;
        refused = arm.write_joint_positions(&target, 1.0).err();
        let _ = arm.read_joints(&mut Default::default());
        std::thread::sleep(Duration::from_millis(8));
        refused.is_some()
    });
    let text = refused.unwrap().to_string();
    assert!(["takes no frames", "no state", "unacknowledged"].iter().any(|part| text.contains(part)), "{text}");
    emulator.record();
    if discard {
        arm.discard_pending();
    }
    arm.disconnect();
    until("power", || arm.connect().is_ok());
    let stale = ids(&emulator).iter().filter(|id| (0x150..=0x15F).contains(*id)).count();
    (emulator, arm, stale)
}

#[test]
fn f16_what_waits_when_the_power_goes_moves_nothing_when_it_returns() {
    let (emulator, mut arm, stale) = commanded_without_power(false);
    assert_eq!(arm.read_enabled(), Ok(false));
    assert!(stale <= 8, "{stale} frames waited"); // two setpoints, to an arm whose motors are off
    let lies = emulator.joints().0;
    arm.activate().unwrap_or_else(|e| panic!("{e}"));
    assert!(farthest(&emulator.joints().0, &lies) < 0.05, "it holds where it lies");
    // Outside of its range it goes to the end, slowly.
    until("the end of the range", || emulator.joints().1.iter().all(|v| v.abs() < 1e-4));
    let (there, _) = emulator.joints();
    std::thread::sleep(Duration::from_millis(200));
    assert!(farthest(&emulator.joints().0, &there) < 0.005);
}

#[test]
fn f16_what_waits_is_discarded_before_anything_else_goes_out() {
    assert_eq!(commanded_without_power(true).2, 0);
}

#[test]
fn f17_a_set_point_that_the_bus_does_not_take_is_told() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    arm.set_control_mode(ControlMode::ServoPosition).unwrap();
    emulator.inject(Fault::new(FaultKind::NoBuffers)).unwrap();
    let mut error = None;
    until("an error", || {
        error = arm.write_joint_positions(&START, 0.1).err();
        read(&mut arm).unwrap();
        error.is_some()
    });
    let text = error.unwrap().to_string();
    assert!(text.contains("its bus takes no frames") && text.contains("\nhint: "), "{text}");
    assert!(arm.is_connected(), "its state still comes");
    until("room", || {
        read(&mut arm).unwrap();
        arm.write_joint_positions(&START, 0.1).is_ok()
    });
    assert!(arm.counts().1.not_taken >= 4);
}

/// Leaves the bus without room for this number of commands.
fn no_room(emulator: &PiperEmulator, commands: usize) {
    emulator.inject(Fault::new(FaultKind::NoBuffers)).unwrap();
    let mut other = other(emulator);
    let mut left = 4; // of one strike
    until("no room", || {
        left -= usize::from(other.send(&[golden::frame(golden::ASK_FIRMWARE)]).unwrap() == 0);
        left == commands
    });
}

#[test]
fn f17_a_stop_that_the_bus_does_not_take_is_no_stop() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    arm.set_control_mode(ControlMode::ServoPosition).unwrap();
    no_room(&emulator, 1);
    emulator.record();
    let error = arm.write_stop(&at(&START)).unwrap_err().to_string();
    assert!(error.contains("its bus takes no frames"), "{error}");
    assert_eq!((ids(&emulator), arm.is_connected()), (vec![], true));
    arm.write_stop(&at(&START)).unwrap();
    until("the hold", || ids(&emulator) == [0x151, 0x155, 0x156, 0x157]);
}

#[test]
fn f17_motors_do_not_come_on_when_the_hold_before_them_is_lost() {
    let (emulator, mut arm) = connected();
    no_room(&emulator, 1);
    emulator.record();
    let error = arm.write_enable(true).unwrap_err().to_string();
    assert!(error.contains("its bus takes no frames"), "{error}");
    assert_eq!((ids(&emulator), emulator.enabled()), (vec![], false));
    activate(&emulator, &mut arm);
    assert!(farthest(&emulator.joints().0, &START) < 1e-3);
}

#[test]
fn f17_what_nothing_replaces_is_told_when_it_is_lost() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    emulator.inject(Fault::new(FaultKind::ErrorCode).code(7)).unwrap();
    until("the collision", || {
        read(&mut arm).unwrap();
        arm.read_error().unwrap().0 == 7
    });
    no_room(&emulator, 1);
    assert!(matches!(arm.write_clear_errors(), Err(AdapterError::Io(_))));
    arm.write_clear_errors().unwrap();
    let pose = arm.read_cartesian_position().unwrap().unwrap().tcp;
    no_room(&emulator, 3);
    assert!(arm.write_joint_positions(&START, 0.1).is_err(), "a planned move");
    assert!(arm.write_cartesian_position(&pose, 0.1).is_err());
    assert!(arm.write_gripper_position(0.01).is_err());
    arm.write_gripper_position(0.01).unwrap();
    // The command for the motors is repeated until they obey.
    no_room(&emulator, 2);
    arm.write_enable(false).unwrap();
    assert!(!emulator.enabled());
}

#[test]
fn f17_bus_off_ends_the_connection_at_once() {
    let (emulator, mut arm) = connected();
    emulator.inject(Fault::new(FaultKind::BusOff)).unwrap();
    let error = failure(&mut arm).to_string();
    assert!(error.contains("has left the bus after too many errors\nhint: "), "{error}");
    assert!(!arm.is_connected());
    arm.connect().unwrap();
}

#[test]
fn f18_noise_and_short_frames_cost_nothing_but_readings() {
    let (emulator, mut arm) = connected();
    for kind in [FaultKind::Garbage, FaultKind::Truncated] {
        let before = arm.counts().0.damaged;
        emulator.inject(Fault::new(kind)).unwrap();
        until("the damage", || {
            assert!(farthest(&read(&mut arm).unwrap().position, &START) < 1e-4);
            arm.counts().0.damaged > before
        });
    }
    // Random frames at the arm's rate: nothing panics, and neither joints nor a pose are made of them.
    let mut feedback = Feedback::default();
    let mut seed = 0x2545_F491_4F6C_DD1D_u64;
    let mut take = |n: u64, id: Option<u16>| {
        seed ^= seed << 13;
        seed ^= seed >> 7;
        seed ^= seed << 17;
        let (id, len) = id.map_or(((seed >> 48) as u16 & 0x7FF, seed as u8 % 10), |id| (id, 8));
        feedback.take(decode(&CanFrame { id, len, data: seed.to_le_bytes() }), Mono(330_000 * (n + 1)));
        (feedback.joints_at, feedback.counts.sets, feedback.pose, feedback.counts.damaged)
    };
    let random = (0..200_000).fold(Default::default(), |_, n| take(n, None));
    assert_eq!((random.0, random.1, random.2), (Mono::ZERO, 0, None));
    assert!(random.3 > 1_000, "some were as good as the arm's");
    // Not even where they come in the order of joint positions.
    let ordered = (200_001..260_001).fold(random, |_, n| take(n, Some(0x2A5 + (n % 3) as u16)));
    assert_eq!((ordered.0, ordered.1, ordered.3 - random.3), (Mono::ZERO, 0, 20_000), "60 000 frames, 20 000 sets");
}

#[test]
fn an_interface_that_is_missing_is_told() {
    let mut arm = PiperAdapter::new(&config("nosuchcan7", serde_json::json!({}))).unwrap();
    let error = arm.connect().unwrap_err().to_string();
    assert!(error.contains("nosuchcan7") && error.contains("\nhint: "), "{error}");
    let mut positions = [0.0; DOF];
    assert_eq!(arm.read_joint_positions(&mut positions), Err(AdapterError::NotConnected));
}

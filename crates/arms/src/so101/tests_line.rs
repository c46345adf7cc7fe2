//! Two arms on one line: servos 1 to 6 and 7 to 12.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use serde_json::json;

use super::adapter::So101Adapter;
use super::emulator::{Servos, start};
use super::{DOF, SPEC};
use dimos_core::arm::StopPoint;
use dimos_core::joint::{ControlMode, joints_of};
use dimos_hardware::adapter::{AdapterError, Gripper, ManipulatorAdapter, Stop};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::serial_server::SerialServer;

fn config(address: String, options: serde_json::Value) -> AdapterConfig {
    AdapterConfig { hardware_id: "arm".into(), address, dof: DOF, options }
}

/// Both arms, connected, and their servos.
fn two() -> ([So101Adapter; 2], SerialServer<Servos>) {
    let sim = json!({"sim": {"ids": (1..=12).collect::<Vec<u8>>()}});
    let servos = start(&config(String::new(), sim), &EmulatorAddress::InProcess).unwrap();
    let arms = [1, 7].map(|first| {
        let mut arm = So101Adapter::new(&config(servos.address(), json!({"first_id": first}))).unwrap();
        arm.connect().unwrap();
        arm
    });
    (arms, servos)
}

/// The goals of an arm's servos [counts].
fn goals(servos: &mut Servos) -> [u16; 6] {
    [0, 1, 2, 3, 4, 5].map(|servo| u16::from_le_bytes([servos.byte(servo, 42), servos.byte(servo, 43)]))
}

/// Moves the arm there in steps of 10 ms, until it is there. Returns the longest wait of a cycle.
fn stream(arm: &mut So101Adapter, goal: [f64; DOF], end: &AtomicBool) -> Duration {
    let (mut longest, mut positions) = (Duration::ZERO, [0.0; DOF]);
    while !end.load(Ordering::Relaxed) {
        let began = Instant::now();
        arm.read_joint_positions(&mut positions).unwrap();
        arm.write_joint_positions(&goal, 1.0).unwrap();
        longest = longest.max(began.elapsed());
        std::thread::sleep(Duration::from_millis(10).saturating_sub(began.elapsed()));
    }
    longest
}

fn there(positions: &[f64], goal: [f64; DOF]) -> bool {
    positions.iter().zip(goal).all(|(position, goal)| (position - goal).abs() < 3e-3)
}

#[test]
fn two_arms_stream_at_once_and_each_moves_its_own_servos() {
    let ([mut one, mut other], servos) = two();
    for arm in [&mut one, &mut other] {
        arm.activate().unwrap();
        arm.set_control_mode(ControlMode::ServoPosition).unwrap();
    }
    let (to_one, to_other, end) = ([0.3, -0.2, 0.1, 0.4, -0.5], [-0.3, 0.4, -0.2, 0.1, 0.6], AtomicBool::new(false));
    std::thread::scope(|scope| {
        let (end, arms) = (&end, [(&mut one, to_one), (&mut other, to_other)]);
        let longest = arms.map(|(arm, goal)| scope.spawn(move || stream(arm, goal, end)));
        std::thread::sleep(Duration::from_secs(2));
        end.store(true, Ordering::Relaxed);
        for longest in longest {
            println!("longest cycle: {:?}", longest.join().unwrap());
        }
    });
    servos.with(|servos, _| {
        let second = servos.beside().unwrap();
        assert!(there(&second.angles()[..DOF], to_other), "{:?}", second.angles());
        assert!(there(&servos.angles()[..DOF], to_one), "{:?}", servos.angles());
    });
    // Its gripper is servo 12.
    let before = servos.with(|servos, _| goals(servos));
    other.write_gripper_position(1.0).unwrap();
    assert_eq!(servos.with(|servos, _| goals(servos)), before);
    // 1 rad from closed, at −0.175 rad.
    let goal = servos.with(|servos, _| goals(servos.beside().unwrap())[5]);
    assert!((f64::from(goal) - (2048.0 + (1.0 - 0.175) * 4096.0 / std::f64::consts::TAU)).abs() < 2.0, "{goal}");
    other.write_enable(false).unwrap();
    assert_eq!((one.read_enabled(), other.read_enabled()), (Ok(true), Ok(false)));
}

#[test]
fn an_arm_without_power_does_not_end_the_other_and_a_stop_waits_for_one_exchange() {
    let ([mut one, mut other], servos) = two();
    one.activate().unwrap();
    servos.with(|servos, _| (0..6).for_each(|servo| servos.beside().unwrap().plug(servo, 0)));
    std::thread::scope(|scope| {
        let silent = scope.spawn(move || {
            let mut positions = [0.0; DOF];
            let missing = [(); 3].map(|()| other.read_joint_positions(&mut positions).unwrap_err());
            (missing, other.is_connected())
        });
        let here = StopPoint { position: Some(joints_of(&[0.0; DOF])) };
        while !silent.is_finished() {
            // Its own two exchanges, and before each of them one of the other arm: 30 ms.
            let began = Instant::now();
            assert_eq!(one.write_stop(&here), Ok(Stop::Confirmed));
            assert!(began.elapsed() < Duration::from_millis(150), "{:?}", began.elapsed());
        }
        let (missing, connected) = silent.join().unwrap();
        let text = missing[0].to_string();
        assert!(text.contains("servo 7 (shoulder_pan) did not"), "{text}");
        assert!(!connected, "three missing replies in a row end its own connection only");
    });
    assert!(one.is_connected() && one.read_enabled().unwrap());
}

#[test]
fn a_lost_line_is_lost_for_both_and_opened_again_once() {
    let ([mut one, mut other], servos) = two();
    servos.inject(Fault::new(FaultKind::PowerLoss)).unwrap();
    let mut positions = [0.0; DOF];
    // The reply that is lost with the power is asked for again.
    drop(one.read_joint_positions(&mut positions));
    drop(servos);
    for arm in [&mut one, &mut other] {
        let lost = arm.read_joint_positions(&mut positions).unwrap_err();
        assert!(matches!(lost, AdapterError::Io(_)) && lost.to_string().contains("is gone"), "{lost}");
        assert!(!arm.is_connected());
    }
}

#[test]
fn a_calibration_file_has_the_numbers_of_its_arm() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("arm.json");
    let servo = |id: usize| super::calibration::Servo {
        id: id as u8,
        range_min: 1000,
        range_max: 3000,
        ..super::calibration::Servo::default()
    };
    std::fs::write(&path, super::calibration::file(&[7, 8, 9, 10, 11, 12].map(servo))).unwrap();
    let check = |first: u8| (SPEC.check)(&config(String::new(), json!({"first_id": first, "calibration": path})));
    assert!(check(7).is_ok());
    assert!(check(1).unwrap_err().what.contains("shoulder_pan is servo 7, expected 1"));
    let checked = |first: u8| (SPEC.check)(&config(String::new(), json!({"first_id": first}))).map_err(|e| e.option);
    assert_eq!(checked(247).unwrap().line.unwrap().numbers, (247, 252));
    assert_eq!((checked(0).unwrap_err(), checked(248).unwrap_err()), ("first_id".into(), "first_id".into()));
}

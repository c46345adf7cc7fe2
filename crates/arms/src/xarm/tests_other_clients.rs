//! Another client of the controller takes the arm over, stops it, guides it: that is reported, and never undone.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::Duration;

use serde_json::json;

use super::adapter::XArmAdapter;
use super::emulator::XArmEmulator;
use super::tests::{read, ready, sent, six, until};
use dimos_core::arm::StopPoint;
use dimos_core::joint::ControlMode::{self, Impedance, Position, ServoPosition};
use dimos_hardware::adapter::{AdapterError, ManipulatorAdapter};
use dimos_hardware::registry::Emulator;
use dimos_hardware::sim::faults::{Fault, FaultKind};

/// Another client of the controller. It speaks protocol 2, the adapter 3.
struct Other(TcpStream);

impl Other {
    fn connect(emulator: &XArmEmulator) -> Self {
        let address = emulator.address();
        Self(TcpStream::connect(address.rsplit_once(':').unwrap().0).unwrap())
    }

    fn send(&mut self, register: u8, payload: &[u8]) {
        let head = [0, 1, 0, 2, 0, payload.len() as u8 + 1, register];
        self.0.write_all(&[&head[..], payload].concat()).unwrap();
        assert_ne!(self.0.read(&mut [0; 64]).unwrap(), 0);
    }
}

/// What a device thread does in a cycle that insists on its mode.
fn insist(arm: &mut XArmAdapter, mode: ControlMode, hold: &[f64]) {
    read(arm).unwrap();
    if arm.get_control_mode() != mode {
        let _ = arm.set_control_mode(mode);
    }
    let _ = arm.write_joint_positions(hold, 1.0);
}

/// What this run sent since another client's request to `register`: registers that change mode, state or position, and
/// whether the controller took it.
fn ours_after(emulator: &XArmEmulator, register: u8) -> Vec<(u8, bool)> {
    let trace = emulator.trace();
    let theirs = trace.iter().position(|r| r.protocol == 2 && r.register == register).unwrap();
    let ours =
        trace[theirs..].iter().filter(|r| r.protocol == 3 && [11, 12, 16, 19, 23, 29, 30, 81].contains(&r.register));
    ours.map(|r| (r.register, r.status & 0x58 == 0)).collect()
}

#[test]
fn an_arm_that_another_client_takes_over_is_left_to_it() {
    for spacing in [0, 5, 200] {
        let (emulator, mut arm) = ready(json!({}), ServoPosition);
        let hold = six(&mut arm);
        let goal = hold.map(|q| q + 0.4);
        let mut other = Other::connect(&emulator);
        emulator.record();
        let stop = std::sync::atomic::AtomicBool::new(false);
        std::thread::scope(|scope| {
            let ours = scope.spawn(|| {
                while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                    insist(&mut arm, ServoPosition, &hold);
                    std::thread::sleep(Duration::from_millis(2));
                }
            });
            until("setpoints", || sent(&emulator, 29).len() > 5);
            let pause = || std::thread::sleep(Duration::from_millis(spacing));
            other.send(19, &[0, 0]);
            pause();
            other.send(12, &[0]);
            pause();
            let numbers: Vec<f32> = goal.iter().map(|q| *q as f32).chain([0.0, 3.0, 8.0, 0.0]).collect();
            other.send(23, &numbers.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<_>>());
            let there = || emulator.joints().0.iter().zip(goal).all(|(a, b)| (a - b).abs() < 1e-3);
            let end = std::time::Instant::now() + Duration::from_secs(5);
            while !there() && std::time::Instant::now() < end {
                std::thread::sleep(Duration::from_millis(5));
            }
            std::thread::sleep(Duration::from_millis(100));
            stop.store(true, std::sync::atomic::Ordering::Relaxed);
            ours.join().unwrap();
            let ours = ours_after(&emulator, 19);
            assert!(there(), "{spacing} ms: driven away from its goal; {ours:?}");
            // What was on its way already is refused by the controller.
            assert!(ours.len() <= 2 && ours.iter().all(|sent| *sent == (29, false)), "{spacing} ms: {ours:?}");
        });
    }
}

#[test]
fn what_another_client_changed_is_named() {
    type Change = (u8, u8);
    let cases: [(&[Change], ControlMode, &str); 4] = [
        (&[(19, 0), (12, 0)], Position, "another client changed the mode to 0 (position)"),
        (&[(12, 4), (19, 2), (12, 0)], Impedance, "another client changed the mode to 2 (manual guiding)"),
        (&[(12, 4)], ServoPosition, "another client stopped the arm (state 4)"),
        (&[(12, 3)], ServoPosition, "another client paused the arm (state 3)"),
    ];
    for (changes, mode, what) in cases {
        let (emulator, mut arm) = ready(json!({}), ServoPosition);
        assert_eq!(arm.foreign_change(), None);
        let mut other = Other::connect(&emulator);
        changes.iter().for_each(|(register, value)| other.send(*register, &[*value]));
        until(what, || {
            read(&mut arm).unwrap();
            arm.foreign_change() == Some(what)
        });
        assert_eq!(arm.get_control_mode(), mode);
        let refused = arm.set_control_mode(ServoPosition);
        assert_eq!(refused, Err(AdapterError::Rejected(format!("{what}: enable it again"))));
        arm.activate().unwrap();
        assert_eq!((arm.foreign_change(), arm.get_control_mode()), (None, ServoPosition));
    }
}

#[test]
fn motors_that_another_client_disables_are_reported() {
    let (emulator, mut arm) = ready(json!({}), ServoPosition);
    Other::connect(&emulator).send(11, &[8, 0]);
    until("the motors", || {
        read(&mut arm).unwrap();
        arm.read_enabled() == Ok(false) && arm.foreign_change() == Some("another client disabled the motors")
    });
}

#[test]
fn an_error_of_the_arm_is_nobody_elses_doing() {
    let (emulator, mut arm) = ready(json!({}), ServoPosition);
    emulator.inject(Fault::new(FaultKind::ErrorCode).code(31)).unwrap();
    until("the error", || {
        read(&mut arm).unwrap();
        assert_eq!(arm.foreign_change(), None);
        arm.read_error().unwrap().0 == 31
    });
    arm.write_clear_errors().unwrap();
    arm.activate().unwrap();
    assert_eq!(arm.foreign_change(), None);
}

#[test]
fn stops_of_this_run_are_its_own() {
    let (_emulator, mut arm) = ready(json!({}), ServoPosition);
    arm.write_stop(&StopPoint::default()).unwrap();
    for _ in 0..20 {
        read(&mut arm).unwrap();
        assert_eq!(arm.foreign_change(), None);
        std::thread::sleep(Duration::from_millis(2));
    }
    let refused = arm.set_control_mode(Position).unwrap_err().to_string();
    assert_eq!(refused, "the arm was stopped: enable it again");
}

#[test]
fn a_reply_tells_before_any_report_does() {
    let (emulator, mut arm) = ready(json!({}), ServoPosition);
    let hold = six(&mut arm);
    emulator.withhold_full_reports(super::emulator::Withhold::Silence);
    emulator.record();
    Other::connect(&emulator).send(12, &[4]);
    let mut refused = None;
    until("a refusal", || {
        refused = arm.write_joint_positions(&hold, 1.0).err().filter(|error| *error != AdapterError::Busy);
        refused.is_some()
    });
    assert!(matches!(refused, Some(AdapterError::Rejected(_) | AdapterError::Io(_))), "{refused:?}");
    assert!((0..100).all(|_| arm.write_joint_positions(&hold, 1.0).is_err()));
    assert!(ours_after(&emulator, 12).len() <= 2);
}

#[test]
fn the_end_of_a_run_leaves_the_arm_to_the_client_that_took_it() {
    let (emulator, mut arm) = ready(json!({}), ServoPosition);
    let mut other = Other::connect(&emulator);
    emulator.record();
    [(19, 0), (12, 0)].iter().for_each(|(register, value)| other.send(*register, &[*value]));
    until("the change", || {
        read(&mut arm).unwrap();
        arm.foreign_change().is_some()
    });
    arm.deactivate(&StopPoint::default()).unwrap();
    assert_eq!(ours_after(&emulator, 19), []);
}

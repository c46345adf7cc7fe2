//! The adapter against the emulator: every test goes over a real socket.

use std::time::{Duration, Instant};

use super::emulator::wire::Request;
use super::emulator::{SimOptions, YourArmEmulator};
use super::{SPEC, protocol::DOF};
use dimos_core::arm::{Pose, StopPoint};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::{AdapterError, JointReading, ManipulatorAdapter, Stop};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::faults::{Fault, FaultKind};

const START: [f64; DOF] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];

fn adapter(address: &str) -> Box<dyn ManipulatorAdapter> {
    let options = serde_json::Value::Null;
    let config = AdapterConfig { hardware_id: "arm".into(), address: address.into(), dof: DOF, options };
    (SPEC.create)(&config).unwrap()
}

fn pair(faults: &[Fault]) -> (YourArmEmulator, Box<dyn ManipulatorAdapter>) {
    let emulator = YourArmEmulator::with(&SimOptions { faults: faults.to_vec(), ..SimOptions::default() }).unwrap();
    let adapter = adapter(&emulator.address());
    (emulator, adapter)
}

fn connected(faults: &[Fault]) -> (YourArmEmulator, Box<dyn ManipulatorAdapter>) {
    let (emulator, mut adapter) = pair(faults);
    adapter.connect().unwrap();
    (emulator, adapter)
}

fn read(adapter: &mut dyn ManipulatorAdapter) -> Result<JointReading, AdapterError> {
    let mut reading = JointReading::default();
    adapter.read_joints(&mut reading).map(|()| reading)
}

/// Waits until `done`, for at most 10 s.
fn until(what: &str, mut done: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(10);
    while !done() {
        assert!(Instant::now() < end, "{what}: not within 10 s");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn close(a: &[f64], b: &[f64]) -> bool {
    a.iter().zip(b).all(|(a, b)| (a - b).abs() < 1e-6)
}

#[test]
fn units_go_both_ways_and_the_arm_gets_there() {
    let (emulator, mut arm) = connected(&[]);
    let info = arm.get_info();
    assert_eq!((info.model.as_str(), info.firmware_version.as_deref()), ("YOURARM-6", Some("2.1.3")));
    assert!(close(&read(&mut *arm).unwrap().position, &START), "rad, not deg");
    arm.activate().unwrap();
    let target = [0.3, -0.2, 0.5, 0.1, 0.4, -0.1];
    emulator.record();
    arm.write_joint_positions(&target, 0.5).unwrap();
    until("arrival", || close(&read(&mut *arm).unwrap().position, &target));
    let there = emulator.joints();
    // It may still be settling by less than the wire can tell.
    let off = there.0.iter().zip(target).map(|(q, t)| (q - t).abs()).fold(0.0, f64::max);
    assert!(off < 1e-3, "it stays there: {there:?}");
    let [first, ..] = emulator.trace()[..] else { panic!("nothing recorded") };
    let degrees = target.map(|v: f64| v.to_degrees() as f32);
    assert_eq!(first.request, Request::MoveJoints(50.0, degrees), "deg and % on the wire");
    let pose = arm.cartesian().unwrap().read_cartesian_position().unwrap().unwrap().tcp;
    assert!(pose.xyz[0] > 0.2 && pose.xyz[0] < 0.6, "metres: {pose:?}");
    arm.gripper().unwrap().write_gripper_position(0.08).unwrap();
    until("gripper", || (arm.gripper().unwrap().read_gripper_position().unwrap().unwrap() - 0.08).abs() < 1e-6);
}

#[test]
fn cartesian_targets_are_reached() {
    let (_emulator, mut arm) = connected(&[]);
    arm.activate().unwrap();
    let now = arm.cartesian().unwrap().read_cartesian_position().unwrap().unwrap().tcp;
    let goal = Pose { xyz: [now.xyz[0], now.xyz[1] + 0.05, now.xyz[2] + 0.03], rpy: now.rpy };
    arm.cartesian().unwrap().write_cartesian_position(&goal, 1.0).unwrap();
    until("pose", || {
        let pose = arm.cartesian().unwrap().read_cartesian_position().unwrap().unwrap().tcp;
        pose.xyz.iter().zip(goal.xyz).all(|(a, b)| (a - b).abs() < 1e-4)
    });
    let far = Pose { xyz: [5.0, 0.0, 0.0], rpy: [0.0; 3] };
    assert!(matches!(arm.cartesian().unwrap().write_cartesian_position(&far, 1.0), Err(AdapterError::Rejected(_))));
}

#[test]
fn one_cycle_of_reads_is_one_round_trip() {
    let (emulator, mut arm) = connected(&[]);
    let mut least = usize::MAX;
    for _ in 0..20 {
        emulator.record();
        read(&mut *arm).unwrap();
        arm.read_error().unwrap();
        arm.read_enabled().unwrap();
        arm.read_state().unwrap();
        arm.gripper().unwrap().read_gripper_position().unwrap();
        arm.cartesian().unwrap().read_cartesian_position().unwrap();
        least = least.min(emulator.trace().len());
    }
    assert_eq!(least, 1);
}

#[test]
fn stamps_are_of_the_moment_of_measurement() {
    let (_emulator, mut arm) = connected(&[]);
    let mut last = MonotonicClock.now();
    for _ in 0..50 {
        let reading = read(&mut *arm).unwrap();
        let stamp = reading.stamp.unwrap();
        assert!(stamp <= MonotonicClock.now() && stamp >= last.before(Duration::from_millis(1)));
        last = stamp;
    }
}

#[test]
fn connecting_and_leaving_move_and_enable_nothing() {
    let (emulator, mut arm) = pair(&[]);
    emulator.record();
    arm.connect().unwrap();
    assert_eq!(arm.read_enabled(), Ok(false));
    arm.activate().unwrap();
    arm.deactivate(&StopPoint::default()).unwrap();
    arm.disconnect();
    arm.disconnect();
    assert_eq!(read(&mut *arm).unwrap_err(), AdapterError::NotConnected);
    assert!(emulator.trace().iter().all(|received| !received.request.moves()));
    assert!(close(&emulator.joints().0, &START));
    assert!(emulator.enabled(), "leaving does not switch off the motors");
    arm.connect().unwrap();
}

#[test]
fn modes_change_at_standstill_only_and_velocities_time_out() {
    let (emulator, mut arm) = connected(&[]);
    arm.activate().unwrap();
    arm.set_control_mode(ControlMode::Velocity).unwrap();
    assert_eq!(arm.get_control_mode(), ControlMode::Velocity);
    assert_eq!(arm.set_control_mode(ControlMode::Torque), Err(AdapterError::Unsupported));
    arm.write_joint_velocities(&[0.5, 0.0, 0.0, 0.0, 0.0, -1.0]).unwrap();
    // No further velocity: the controller stops after 200 ms.
    until("standstill", || emulator.joints().0[0] > 0.01 && emulator.joints().1.iter().all(|v| *v == 0.0));
    let moved = emulator.joints().0[0];
    assert!(moved > 0.01 && moved < 0.5 * 0.2 + 0.5 * 0.5 / 10.0 + 1e-3, "{moved}");
    arm.set_control_mode(ControlMode::Position).unwrap();
    arm.write_joint_positions(&[2.5, -0.3, 0.6, 0.0, 0.8, 0.0], 0.02).unwrap();
    until("motion", || read(&mut *arm).is_ok_and(|reading| reading.velocity.unwrap()[0] > 0.01));
    let refused = arm.set_control_mode(ControlMode::ServoPosition).unwrap_err();
    assert_eq!(refused, AdapterError::Rejected("yourarm refuses SET_MODE: the arm is moving".into()));
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    until("standstill", || arm.set_control_mode(ControlMode::ServoPosition).is_ok());
}

#[test]
fn f38_wrong_arm_is_refused_with_expected_and_found() {
    let (emulator, mut arm) = pair(&[Fault::new(FaultKind::WrongDof)]);
    emulator.record();
    let error = arm.connect().unwrap_err().to_string();
    assert!(error.ends_with("expected 6 joints, the controller says 7"), "{error}");
    assert!(!arm.is_connected() && emulator.trace().len() == 1, "nothing but HELLO was sent");
}

#[test]
fn a_second_client_is_turned_away() {
    let (emulator, _first) = connected(&[]);
    let error = adapter(&emulator.address()).connect().unwrap_err().to_string();
    assert_eq!(error, "yourarm refuses HELLO: another client is connected to it");
    assert_eq!(emulator.refused_clients(), 1);
}

#[test]
fn errors_have_code_and_text_and_are_cleared() {
    let (emulator, mut arm) = connected(&[]);
    arm.activate().unwrap();
    emulator.inject(Fault::new(FaultKind::ErrorCode).code(2)).unwrap();
    read(&mut *arm).unwrap();
    assert_eq!(arm.read_error(), Ok((2, "collision detected".into())));
    let refused = arm.write_joint_positions(&START, 1.0).unwrap_err();
    assert_eq!(refused.to_string(), "fault 2: collision detected");
    arm.write_clear_errors().unwrap();
    assert_eq!(arm.read_error(), Ok((0, String::new())));

    emulator.press_estop();
    assert!(!emulator.enabled() && arm.write_clear_errors().is_err());
    emulator.release_estop();
    read(&mut *arm).unwrap();
    assert_eq!(arm.read_error(), Ok((1, "E-stop line open".into())), "release changes nothing");
    arm.write_clear_errors().unwrap();
    assert_eq!(arm.read_enabled(), Ok(false));
}

#[test]
fn f04_a_broken_connection_is_noticed_and_made_again() {
    let (emulator, mut arm) = connected(&[]);
    emulator.inject(Fault::new(FaultKind::Disconnect)).unwrap();
    assert!(matches!(read(&mut *arm), Err(AdapterError::Io(_))));
    assert!(!arm.is_connected());
    assert_eq!(read(&mut *arm).unwrap_err(), AdapterError::NotConnected);
    arm.connect().unwrap();
    read(&mut *arm).unwrap();
}

#[test]
fn f18_noise_is_skipped_and_a_damaged_or_lost_reply_is_asked_for_again() {
    let (emulator, mut arm) = connected(&[]);
    emulator.inject(Fault::new(FaultKind::Garbage)).unwrap();
    assert!(close(&read(&mut *arm).unwrap().position, &START));
    for kind in [FaultKind::Corrupt, FaultKind::Truncated, FaultKind::Silent] {
        emulator.inject(Fault::new(kind)).unwrap();
        assert!(close(&read(&mut *arm).unwrap().position, &START), "{kind:?}");
    }
    emulator.inject(Fault::new(FaultKind::Nan)).unwrap();
    assert!(matches!(read(&mut *arm), Err(AdapterError::Protocol(_))));
}

#[test]
fn a_silent_controller_is_dropped_after_three_replies() {
    let (emulator, mut arm) = connected(&[]);
    emulator.inject(Fault::new(FaultKind::Silent).lasting(60.0)).unwrap();
    for _ in 0..3 {
        assert!(arm.is_connected());
        assert!(matches!(read(&mut *arm), Err(AdapterError::Timeout(_))));
    }
    assert!(!arm.is_connected());
    let start = Instant::now();
    assert!(matches!(arm.connect(), Err(AdapterError::Timeout(_))), "it accepts, but does not say hello");
    assert!(start.elapsed() < Duration::from_secs(3));
}

#[test]
fn a_stall_passes() {
    let (emulator, mut arm) = connected(&[]);
    emulator.inject(Fault::new(FaultKind::Stall).lasting(0.5)).unwrap();
    assert!(read(&mut *arm).is_err());
    until("the end of the stall", || {
        if !arm.is_connected() {
            let _ = arm.connect();
        }
        read(&mut *arm).is_ok()
    });
}

#[test]
fn power_comes_back_with_the_motors_off() {
    let (emulator, mut arm) = connected(&[]);
    arm.activate().unwrap();
    emulator.inject(Fault::new(FaultKind::PowerLoss).lasting(0.3)).unwrap();
    assert!(read(&mut *arm).is_err() || read(&mut *arm).is_err());
    until("power", || arm.connect().is_ok());
    assert_eq!(arm.read_enabled(), Ok(false));
}

#[test]
fn sag_and_zero_state_and_blocked_joints_can_be_played() {
    let (emulator, mut arm) = connected(&[Fault::new(FaultKind::Sag)]);
    arm.activate().unwrap();
    until("sag", || (emulator.joints().0[1] - (-0.35)).abs() < 1e-6);
    emulator.inject(Fault::new(FaultKind::ZeroState)).unwrap();
    assert_eq!(read(&mut *arm).unwrap().position, [0.0; 16]);
    emulator.inject(Fault { joint: 1, ..Fault::new(FaultKind::Blocked).lasting(60.0) }).unwrap();
    arm.write_joint_positions(&[0.1, -0.3, 0.6, 0.0, 0.8, 0.1], 1.0).unwrap();
    until("joint 6", || (read(&mut *arm).unwrap().position[5] - 0.1).abs() < 1e-6);
    assert!(emulator.joints().0[0].abs() < 1e-9);
    assert!(emulator.inject(Fault::new(FaultKind::Panic)).is_err());
}

#[test]
fn an_address_in_full_has_its_port() {
    let full = |address| (SPEC.address.check)(address).unwrap();
    assert_eq!(full("arm.local"), format!("arm.local:{}", super::protocol::PORT));
    assert_eq!(full("[::1]:7"), "[::1]:7");
}

#[test]
fn wrong_configurations_are_refused() {
    let config = |address: &str, dof, options| AdapterConfig {
        hardware_id: "arm".into(),
        address: address.into(),
        dof,
        options,
    };
    for (config, part) in [
        (config("192.168.1.100", 7, serde_json::json!({})), "arm: yourarm has 6 joints, not 7"),
        (config("192.168.1.300", 6, serde_json::json!({})), "192.168.1.300"),
        (config("", 6, serde_json::json!({})), "host is missing"),
        (config("::1", 6, serde_json::json!({"speed_scale": 1.5})), "1.5 is not above 0 and at most 1"),
        (config("::1", 6, serde_json::json!({"speed": 1.0})), "unknown field"),
    ] {
        let error = (SPEC.create)(&config).err().unwrap().to_string();
        assert!(error.contains(part), "{error}");
    }
    let sim = serde_json::json!({"sim": {"initial_positions": [0, 0, 0, 0, 0, 9]}});
    assert!(YourArmEmulator::start(&config("sim", 6, sim), &EmulatorAddress::InProcess).is_err());
}

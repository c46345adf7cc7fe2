//! The adapter against the emulator: every test goes over real sockets.

use std::io::{Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use super::SPEC;
use super::adapter::XArmAdapter;
use super::emulator::XArmEmulator;
use dimos_core::arm::{Pose, StopPoint};
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::{
    AdapterError, Cartesian, ForceTorque, Gripper, HandGuiding, JointReading, ManipulatorAdapter, Stop,
};
use dimos_hardware::conformance::{Check, Outcome, Subject, checks, run_on};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::faults::{Fault, FaultKind};

pub(super) fn config(address: &str, dof: usize, options: Value) -> AdapterConfig {
    AdapterConfig { hardware_id: "arm".into(), address: address.into(), dof, options }
}

pub(super) fn pair(dof: usize, options: Value) -> (XArmEmulator, XArmAdapter) {
    let emulator = XArmEmulator::start(&config("", dof, options.clone()), &EmulatorAddress::InProcess).unwrap();
    let adapter = XArmAdapter::new(&config(&emulator.address(), dof, options)).unwrap();
    (emulator, adapter)
}

/// An xArm 6 with its motors on, in a mode.
pub(super) fn ready(options: Value, mode: ControlMode) -> (XArmEmulator, XArmAdapter) {
    let (emulator, mut arm) = pair(6, options);
    arm.connect().unwrap();
    arm.activate().unwrap();
    until("the mode", || set(&mut arm, mode).is_ok());
    (emulator, arm)
}

/// Changes the mode as the device thread does: `Rejected` is asked again.
pub(super) fn set(arm: &mut XArmAdapter, mode: ControlMode) -> Result<(), AdapterError> {
    arm.set_control_mode(mode)
}

pub(super) fn read(arm: &mut XArmAdapter) -> Result<JointReading, AdapterError> {
    let mut reading = JointReading::default();
    arm.read_joints(&mut reading).map(|()| reading)
}

pub(super) fn six(arm: &mut XArmAdapter) -> [f64; 6] {
    *read(arm).unwrap().position.first_chunk().unwrap()
}

/// Waits until `done`, for at most 10 s.
pub(super) fn until(what: &str, mut done: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(10);
    while !done() {
        assert!(Instant::now() < end, "{what}: not within 10 s");
        std::thread::sleep(Duration::from_millis(2));
    }
}

fn floats(payload: &[u8]) -> Vec<f32> {
    payload.as_chunks::<4>().0.iter().map(|chunk| f32::from_le_bytes(*chunk)).collect()
}

/// The requests to a register that came since recording began.
pub(super) fn sent(emulator: &XArmEmulator, register: u8) -> Vec<Vec<u8>> {
    let trace = emulator.trace().into_iter();
    trace.filter(|request| request.register == register).map(|request| request.payload).collect()
}

#[test]
fn a_hand_guides_the_arm_in_mode_2_until_it_is_stopped_or_activated() {
    let push =
        |emulator: &XArmEmulator| emulator.inject(Fault { amount: 0.04, ..Fault::new(FaultKind::Pushed) }).unwrap();
    for by_stop in [true, false] {
        let (emulator, mut arm) = ready(json!({}), ControlMode::ServoPosition);
        let start = six(&mut arm)[0];
        push(&emulator);
        std::thread::sleep(Duration::from_millis(50));
        assert!((six(&mut arm)[0] - start).abs() < 1e-5, "a servo does not give way");
        emulator.record();
        until("the mode", || arm.begin_hand_guiding().is_ok());
        assert_eq!(sent(&emulator, 19).first().map(|mode| mode[0]), Some(2));
        assert_eq!((arm.get_control_mode(), arm.foreign_change()), (ControlMode::Impedance, None), "by order");
        push(&emulator);
        until("the push", || (six(&mut arm)[0] - start - 0.04).abs() < 1e-4);
        let here = six(&mut arm);
        assert!(matches!(arm.write_joint_positions(&here, 1.0), Err(AdapterError::Rejected(_))));
        if by_stop {
            assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
        } else {
            arm.activate().unwrap();
            assert_eq!(arm.get_control_mode(), ControlMode::ServoPosition);
        }
        push(&emulator);
        std::thread::sleep(Duration::from_millis(50));
        assert!((six(&mut arm)[0] - start - 0.04).abs() < 1e-4, "it holds where it is");
    }
}

#[test]
fn si_units_and_the_vendors_units() {
    let (emulator, mut arm) = ready(json!({"gripper": "xarm", "force_torque": true}), ControlMode::Position);
    let info = arm.get_info();
    assert_eq!((info.model.as_str(), info.firmware_version.as_deref(), info.dof), ("xArm 6", Some("2.5.1"), 6));
    assert!(info.serial_number.unwrap().starts_with("XI1305C"));
    assert_eq!(arm.get_limits().unwrap().position_lower[2].to_degrees().round(), -219.0);
    let start = six(&mut arm);
    let goal = start.map(|q| q + 0.1);
    emulator.record();
    arm.write_joint_positions(&goal, 0.5).unwrap();
    arm.write_joint_positions(&goal, 0.5).unwrap();
    until("arrival", || six(&mut arm).iter().zip(goal).all(|(a, b)| (a - b).abs() < 1e-5));
    let [only] = &sent(&emulator, 23)[..] else { panic!("the same target twice is one move") };
    let values = floats(only);
    assert!((values[1] - goal[1] as f32).abs() < 1e-6 && (values[7] - std::f32::consts::FRAC_PI_2).abs() < 1e-6);
    let pose = arm.read_cartesian_position().unwrap().unwrap().tcp;
    let there = Pose { xyz: [pose.xyz[0], pose.xyz[1] + 0.03, pose.xyz[2] + 0.02], rpy: pose.rpy };
    arm.write_cartesian_position(&there, 0.2).unwrap();
    let values = floats(&sent(&emulator, 21)[0]);
    assert!((values[1] - 1000.0 * there.xyz[1] as f32).abs() < 0.01 && values[6] == 200.0, "mm, mm/s: {values:?}");
    until("the pose", || {
        let pose = arm.read_cartesian_position().unwrap().unwrap().tcp;
        pose.xyz.iter().zip(there.xyz).all(|(a, b)| (a - b).abs() < 1e-4)
    });
    let far = Pose { xyz: [5.0, 0.0, 0.0], rpy: [0.0; 3] };
    let refused = arm.write_cartesian_position(&far, 1.0).unwrap_err();
    assert_eq!(refused.to_string(), "xarm refuses the move: the command has no solution (14)");
    arm.write_gripper_position(0.07).unwrap();
    until("the gripper", || {
        read(&mut arm).unwrap();
        (arm.read_gripper_position().unwrap().unwrap() - 0.07).abs() < 1e-4
    });
    let targets = sent(&emulator, 124).into_iter().filter(|telegram| telegram.get(3..5) == Some(&[7, 0]));
    assert_eq!(targets.map(|t| t[8..].to_vec()).collect::<Vec<_>>(), [700_i32.to_be_bytes()], "pulses, once");
    assert!(matches!(arm.write_gripper_position(0.09), Err(AdapterError::Rejected(_))));
    let wrench = arm.read_force_torque().unwrap().unwrap();
    assert!((wrench[2] + 4.9).abs() < 1e-3, "{wrench:?}");
}

#[test]
fn the_zeros_of_a_sensor_that_is_off_are_no_measurement() {
    let (_emulator, mut arm) = pair(6, json!({"force_torque": true}));
    arm.connect().unwrap();
    assert_eq!(arm.read_force_torque(), Ok(None), "not switched on yet");
    arm.activate().unwrap();
    until("the sensor", || arm.read_force_torque().unwrap().is_some_and(|wrench| wrench[2] < -4.0));
    arm.disconnect();
    arm.connect().unwrap();
    assert_eq!(arm.read_force_torque(), Ok(None), "another controller may have lost its power meanwhile");
    let (_emulator, mut arm) = ready(json!({}), ControlMode::Position);
    assert!(arm.force_torque().is_none(), "not asked for");
}

#[test]
fn starting_and_stopping_asks_for_no_motion() {
    let (emulator, mut arm) = pair(6, json!({"gripper": "xarm"}));
    emulator.record();
    let start = emulator.joints().0;
    arm.connect().unwrap();
    assert_eq!(arm.read_enabled(), Ok(false));
    arm.activate().unwrap();
    arm.deactivate(&StopPoint::default()).unwrap();
    arm.disconnect();
    assert_eq!(read(&mut arm), Err(AdapterError::NotConnected));
    let trace: Vec<_> = emulator.trace().into_iter().filter(|received| !received.second).collect();
    let moves: Vec<_> = trace.iter().filter(|received| received.moves()).collect();
    assert!(moves.is_empty() && emulator.enabled(), "{moves:?}");
    assert_eq!(emulator.joints().0, start);
    let first = trace.first().unwrap();
    assert_eq!((first.register, first.protocol, trace.last().unwrap().protocol), (1, 2, 3));
}

#[test]
fn modes_change_through_a_stop_and_velocities_end() {
    let (emulator, mut arm) = ready(json!({}), ControlMode::ServoPosition);
    emulator.record();
    until("velocity mode", || set(&mut arm, ControlMode::Velocity).is_ok());
    assert_eq!(arm.get_control_mode(), ControlMode::Velocity);
    let steps: Vec<_> = emulator.trace().into_iter().filter(|r| [12, 19].contains(&r.register)).collect();
    let steps: Vec<_> = steps.iter().map(|r| (r.register, r.payload[0])).collect();
    assert_eq!(steps, [(12, 4), (19, 4), (12, 0)], "never from one streaming mode to another while ready");
    arm.write_joint_velocities(&[0.5, 0.0, 0.0, 0.0, 0.0, -0.5]).unwrap();
    let start = emulator.joints().0[0];
    until("standstill", || emulator.joints().0[0] > start + 0.01 && emulator.joints().1.iter().all(|v| *v == 0.0));
    assert!(emulator.joints().0[0] < start + 0.5 * 0.3, "the controller ends it after 200 ms");
    assert_eq!(&sent(&emulator, 81)[0][28..], [&[1][..], &0.2_f32.to_le_bytes()].concat());
    assert_eq!(set(&mut arm, ControlMode::Torque), Err(AdapterError::Unsupported));
    until("position mode", || set(&mut arm, ControlMode::Position).is_ok());
    let far = six(&mut arm).map(|q| q - 0.5);
    arm.write_joint_positions(&far, 0.05).unwrap();
    until("motion", || read(&mut arm).unwrap().velocity.unwrap()[0] < -0.02);
    assert_eq!(set(&mut arm, ControlMode::Velocity), Err(AdapterError::Rejected("the arm is moving".into())));
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    let refused = arm.write_joint_positions(&far, 0.05).unwrap_err().to_string();
    assert!(refused.ends_with("enable it again"), "{refused}");
}

#[test]
fn why_a_mode_was_not_reached_is_told_by_whichever_call_comes_next() {
    let (emulator, mut arm) = ready(json!({}), ControlMode::ServoPosition);
    emulator.keep_mode(true);
    let under_way = set(&mut arm, ControlMode::Velocity).unwrap_err();
    assert_eq!(under_way, AdapterError::Rejected("the change of mode is under way".into()));
    // The change continues with every reading, and fails in one of them.
    let end = Instant::now() + Duration::from_secs(3);
    while Instant::now() < end {
        read(&mut arm).unwrap();
        std::thread::sleep(Duration::from_millis(2));
    }
    let error = set(&mut arm, ControlMode::Velocity).unwrap_err();
    assert_eq!(error, AdapterError::Protocol("xarm did not change to mode 4: it does not take the mode".into()));
    let refused = set(&mut arm, ControlMode::Velocity).unwrap_err().to_string();
    assert_eq!(refused, "the arm was stopped: enable it again", "reported once");
    emulator.keep_mode(false);
    arm.activate().unwrap();
    until("velocity mode", || set(&mut arm, ControlMode::Velocity).is_ok());
}

#[test]
fn set_points_do_not_wait_for_their_responses_and_two_at_most_are_on_their_way() {
    let (emulator, mut arm) = ready(json!({}), ControlMode::ServoPosition);
    let start = six(&mut arm);
    emulator.record();
    // The replies to setpoints take a minute: the second goes out before the first is answered, the third does not.
    emulator.slow_down(29, 60.0);
    arm.write_joint_positions(&start, 1.0).unwrap();
    arm.write_joint_positions(&start.map(|q| q + 1e-4), 1.0).unwrap();
    for _ in 0..20 {
        let third = arm.write_joint_positions(&start.map(|q| q + 2e-4), 1.0);
        assert_eq!(third, Err(AdapterError::Busy));
        read(&mut arm).unwrap();
    }
    assert!(sent(&emulator, 29).len() <= 2);
    let (emulator, mut arm) = ready(json!({}), ControlMode::ServoPosition);
    emulator.record();
    (0..20).for_each(|_| until("room", || arm.write_joint_positions(&start, 1.0) != Err(AdapterError::Busy)));
    until("all", || sent(&emulator, 29).len() == 20);
}

#[test]
fn a_stop_by_somebody_else_is_not_overridden() {
    let (emulator, mut arm) = ready(json!({}), ControlMode::ServoPosition);
    let hold = six(&mut arm);
    let (control, _) = emulator.address().rsplit_once(':').map(|(a, b)| (a.to_owned(), b.to_owned())).unwrap();
    let mut studio = TcpStream::connect(control).unwrap();
    studio.write_all(&[0, 1, 0, 2, 0, 2, 12, 4]).unwrap();
    studio.read_exact(&mut [0; 8]).unwrap();
    until("the stop", || {
        read(&mut arm).unwrap();
        let _ = arm.write_joint_positions(&hold, 1.0);
        arm.foreign_change().is_some()
    });
    assert_eq!(arm.foreign_change(), Some("another client stopped the arm (state 4)"));
    for _ in 0..5 {
        let refused = set(&mut arm, ControlMode::Position).unwrap_err().to_string();
        assert_eq!(refused, "another client stopped the arm (state 4): enable it again");
    }
    arm.activate().unwrap();
    arm.write_joint_positions(&hold, 1.0).unwrap();
}

#[test]
fn errors_are_told_with_what_to_do_and_stay_until_they_are_cleared() {
    let (emulator, mut arm) = pair(6, json!({"sim": {"faults": [{"kind": "error_code", "code": 13}]}}));
    arm.connect().unwrap();
    until("the servo's code", || {
        read(&mut arm).unwrap();
        arm.read_error().unwrap().1.contains("joint 3: 23 following error")
    });
    let (code, text) = arm.read_error().unwrap();
    assert!(code == 13 && text.starts_with("the servo of joint 3 reports an error; "), "{text}");
    assert!(matches!(arm.activate(), Err(AdapterError::Fault { code: 13, .. })));
    assert!(!emulator.enabled());
    arm.write_clear_errors().unwrap();
    assert_eq!(arm.read_error(), Ok((0, String::new())));
    arm.activate().unwrap();
    emulator.press_estop();
    until("the E-stop", || {
        read(&mut arm).unwrap();
        arm.read_error().unwrap().0 == 1
    });
    assert_eq!(arm.read_enabled(), Ok(false));
    assert!(matches!(arm.write_clear_errors(), Err(AdapterError::Fault { code: 1, .. })));
    emulator.release_estop();
    arm.write_clear_errors().unwrap();
    assert_eq!(arm.read_enabled(), Ok(false));
}

#[test]
fn an_error_shows_at_once_and_refuses_set_points() {
    let (emulator, mut arm) = ready(json!({}), ControlMode::ServoPosition);
    let hold = six(&mut arm);
    // A stop shows in the next report and triggers a request of register 15: no need to wait for the 5 Hz report.
    emulator.mute_condition(true);
    emulator.inject(Fault::new(FaultKind::ErrorCode).code(24)).unwrap();
    until("the error", || {
        read(&mut arm).unwrap();
        matches!(arm.write_joint_positions(&hold, 1.0), Err(AdapterError::Fault { code: 24, .. }))
    });
}

#[test]
fn what_is_known_of_the_motors_does_not_outlive_its_reports() {
    let (emulator, mut arm) = ready(json!({}), ControlMode::ServoPosition);
    emulator.mute_condition(true);
    let mut error = None;
    until("an error", || {
        error = read(&mut arm).err();
        error.is_some()
    });
    let Some(AdapterError::Io(text)) = error else { panic!("{error:?}") };
    assert!(text.ends_with("sent nothing for 1s") && !arm.is_connected(), "{text}");
    assert!(arm.connect().is_err(), "still silent");
    emulator.mute_condition(false);
    arm.connect().unwrap();
    assert_eq!(arm.read_enabled(), Ok(true));
}

#[test]
fn an_arm_at_zero_is_told_from_one_that_has_not_measured() {
    for (dof, options) in [(5, json!({})), (6, json!({})), (6, json!({"model": "lite6"})), (7, json!({}))] {
        let mut options = options;
        options["sim"] = json!({"initial_positions": vec![0.0; dof]});
        let (emulator, mut arm) = pair(dof, options);
        arm.connect().unwrap();
        let reading = read(&mut arm).unwrap();
        assert_eq!((reading.valid, reading.position), (Some(true), [0.0; 16]));
        emulator.inject(Fault::new(FaultKind::ZeroState).lasting(60.0)).unwrap();
        until("the sign", || read(&mut arm).unwrap().valid == Some(false));
    }
    let (_emulator, mut arm) = pair(6, json!({"sim": {"faults": [{"kind": "zero_state", "duration": 60}]}}));
    arm.connect().unwrap();
    let reading = read(&mut arm).unwrap();
    assert_eq!((reading.valid, reading.position), (Some(false), [0.0; 16]));
    let (_emulator, mut arm) = pair(6, json!({}));
    arm.connect().unwrap();
    assert_eq!(read(&mut arm).unwrap().valid, Some(true));
}

#[test]
fn motors_that_are_switched_on_make_the_arm_ready() {
    let (_emulator, mut arm) = pair(6, json!({}));
    arm.connect().unwrap();
    arm.write_enable(true).unwrap();
    let hold = six(&mut arm);
    assert_eq!(arm.write_joint_positions(&hold, 1.0), Ok(()));
    arm.write_enable(false).unwrap();
    assert_eq!((arm.read_enabled(), arm.foreign_change()), (Ok(false), None));
    arm.write_enable(true).unwrap();
    assert_eq!(arm.write_joint_positions(&hold, 1.0), Ok(()));
}

#[test]
fn silence_ends_the_connection_and_a_jump_is_not_believed_at_once() {
    let (emulator, mut arm) = ready(json!({}), ControlMode::ServoPosition);
    let before = six(&mut arm);
    emulator.inject(Fault::new(FaultKind::ZeroState)).unwrap();
    for _ in 0..100 {
        assert!((six(&mut arm)[1] - before[1]).abs() < 0.01, "one report of zeros");
        std::thread::sleep(Duration::from_millis(1));
    }
    emulator.inject(Fault::new(FaultKind::Silent).lasting(60.0)).unwrap();
    until("an error", || read(&mut arm).is_err());
    assert!(!arm.is_connected());
}

#[test]
fn a_gripper_that_is_not_there_is_said_and_one_that_falls_silent_harms_nothing() {
    let (emulator, _) = pair(6, json!({}));
    let mut arm = XArmAdapter::new(&config(&emulator.address(), 6, json!({"gripper": "xarm"}))).unwrap();
    let error = arm.connect().unwrap_err().to_string();
    assert!(error.contains("no gripper answers") && error.contains("{gripper: none}"), "{error}");
    let (_emulator, mut arm) = ready(json!({}), ControlMode::Position);
    assert!(arm.gripper().is_none());
}

#[test]
fn an_arm_in_error_is_disabled_all_the_same() {
    let (emulator, mut arm) = ready(json!({}), ControlMode::ServoPosition);
    emulator.inject(Fault { code: 31, ..Fault::new(FaultKind::ErrorCode) }).unwrap();
    until("the error", || arm.read_error().unwrap().0 == 31);
    assert_eq!(arm.write_enable(false), Ok(()));
    assert_eq!((arm.read_enabled(), arm.read_error().unwrap().0), (Ok(false), 31));
    assert!(matches!(arm.write_enable(true), Err(AdapterError::Fault { code: 31, .. })));
}

#[test]
fn grippers_conform() {
    let gripper = |check: &&Check| check.name.contains("gripper");
    assert_eq!(checks().filter(gripper).count(), 6);
    std::thread::scope(|scope| {
        let kinds = ["xarm", "xarm_g2", "lite6", "vacuum"];
        for (check, gripper) in checks().filter(gripper).flat_map(|check| kinds.map(|kind| (check, kind))) {
            scope.spawn(move || {
                let config = config("", 6, json!({ "gripper": gripper }));
                let subject = Subject { config, ..Subject::emulated(&SPEC) };
                let outcome = run_on(&subject, check).0;
                // Nothing stops the fingers of one that only opens and closes.
                let on_off = ["lite6", "vacuum"].contains(&gripper) && check.name == "stop_holds_the_gripper";
                let skipped = Outcome::Skipped("its gripper only opens and closes".into());
                assert_eq!(outcome, if on_off { skipped } else { Outcome::Passed }, "{gripper}: {}", check.name);
            });
        }
    });
}

#[test]
fn the_flange_is_where_it_is_whatever_tool_and_base_are_set() {
    let (_emulator, mut plain) = pair(6, json!({}));
    plain.connect().unwrap();
    let flange = plain.read_cartesian_position().unwrap().unwrap().flange().unwrap().isometry();
    let offsets =
        json!({"tcp_offset": [0.01, -0.02, 0.172, 0.1, 0.2, 0.3], "world_offset": [0.2, -0.1, 0.5, 0.4, 0.0, 3.0]});
    let (emulator, mut arm) = ready(json!({"sim": offsets}), ControlMode::Position);
    let stated = |arm: &mut XArmAdapter| arm.read_cartesian_position().unwrap().unwrap();
    let now = stated(&mut arm);
    let off = now.flange().unwrap().isometry().inverse() * flange;
    assert!(off.translation.vector.norm() < 1e-5 && off.rotation.angle() < 1e-5, "{off}");
    assert!((now.tcp.isometry().translation.vector - flange.translation.vector).norm() > 0.3, "{now:?}");
    // A goal for the flange is commanded as the pose of the controller's tool in its frame, and reached by the flange.
    let goal = flange * nalgebra::Translation3::new(0.02, 0.01, -0.03);
    let wire = Pose::from(&now.tcp_at(&goal).unwrap());
    arm.write_cartesian_position(&wire, 0.2).unwrap();
    until("the flange at its goal", || {
        let off = stated(&mut arm).flange().unwrap().isometry().inverse() * goal;
        off.translation.vector.norm() < 1e-4
    });
    drop(emulator);
}

#[test]
fn the_flange_is_unknown_before_a_report_has_the_offsets() {
    let wire = [300.0, 0.0, 200.0, 3.1, 0.0, 0.0];
    let stated = |tool: Option<[f64; 6]>, base: Option<[f64; 6]>| dimos_core::arm::ControllerPose {
        tcp: super::report_validity::pose(&wire),
        tool: tool.as_ref().map(super::report_validity::pose),
        base: base.as_ref().map(super::report_validity::pose),
    };
    assert_eq!(stated(None, None).missing(), Some("tool offset"));
    // Reports of older firmware end before the base offset.
    assert_eq!(stated(Some([0.0; 6]), None).missing(), Some("base offset"));
}

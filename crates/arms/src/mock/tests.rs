use std::sync::Arc;
use std::time::Duration;

use super::MockArm;
use dimos_core::arm::StopPoint;
use dimos_core::clock::{Mono, VirtualClock};
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::{AdapterError, Gripper, JointReading, ManipulatorAdapter, Stop};
use dimos_hardware::registry::AdapterConfig;

fn arm(options: serde_json::Value) -> (MockArm, VirtualClock) {
    let clock = VirtualClock::starting_at(Mono(5_000_000_000));
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 2, options };
    (MockArm::with_clock(&config, Arc::new(clock.clone())).unwrap(), clock)
}

fn ready(options: serde_json::Value, mode: ControlMode) -> (MockArm, VirtualClock) {
    let (mut arm, clock) = arm(options);
    arm.connect().unwrap();
    arm.activate().unwrap();
    arm.set_control_mode(mode).unwrap();
    (arm, clock)
}

fn positions(arm: &mut MockArm) -> [f64; 2] {
    let mut out = [0.0; 2];
    arm.read_joint_positions(&mut out).unwrap();
    out
}

fn ms(n: u64) -> Duration {
    Duration::from_millis(n)
}

#[test]
fn servo_set_points_within_the_limits_are_reached_at_once() {
    let options = serde_json::json!({"initial_positions": [0.3, -0.3]});
    let (mut arm, clock) = ready(options, ControlMode::ServoPosition);
    for i in 1..=100 {
        clock.advance(ms(10));
        let target = [0.3 + 0.005 * f64::from(i), -0.3];
        arm.write_joint_positions(&target, 1.0).unwrap();
        assert_eq!(positions(&mut arm), target);
    }
    let mut reading = JointReading::default();
    arm.read_joints(&mut reading).unwrap();
    assert!((reading.velocity.unwrap()[0] - 0.5).abs() < 1e-9);
    assert_eq!((reading.effort, reading.stamp), (None, Some(Mono(6_000_000_000))));
}

#[test]
fn velocity_integrates_and_stop_decelerates() {
    let (mut arm, clock) = ready(serde_json::json!({}), ControlMode::Velocity);
    arm.write_joint_velocities(&[1.0, -0.5]).unwrap();
    clock.advance(ms(1000));
    let [a, b] = positions(&mut arm);
    assert!((a - 1.0).abs() < 1e-9 && (b + 0.5).abs() < 1e-9);
    let refused = arm.set_control_mode(ControlMode::Position);
    assert!(matches!(refused, Err(AdapterError::Rejected(_))), "no change of mode in motion: {refused:?}");
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    clock.advance(ms(200));
    let stopped = positions(&mut arm);
    clock.advance(ms(1000));
    assert_eq!(positions(&mut arm), stopped);
    arm.set_control_mode(ControlMode::Position).unwrap();
}

#[test]
fn nothing_moves_without_power_or_in_the_wrong_mode_or_by_nonsense() {
    let (mut arm, clock) = arm(serde_json::json!({}));
    assert_eq!(arm.write_joint_positions(&[0.1, 0.1], 1.0), Err(AdapterError::NotConnected));
    arm.connect().unwrap();
    assert!(matches!(arm.write_joint_positions(&[0.1, 0.1], 1.0), Err(AdapterError::Rejected(_))));
    arm.activate().unwrap();
    assert!(matches!(arm.write_joint_velocities(&[0.1, 0.1]), Err(AdapterError::Rejected(_))));
    assert!(matches!(arm.write_joint_positions(&[f64::NAN, 0.1], 1.0), Err(AdapterError::Rejected(_))));
    assert!(matches!(arm.write_joint_positions(&[0.1], 1.0), Err(AdapterError::Rejected(_))));
    assert_eq!(arm.set_control_mode(ControlMode::Torque), Err(AdapterError::Unsupported));
    clock.advance(ms(1000));
    assert_eq!(positions(&mut arm), [0.0, 0.0]);
}

#[test]
fn scripted_faults_happen_when_they_should() {
    let options = serde_json::json!({"faults": [
        {"at": 1.0, "kind": "read_error", "count": 2},
        {"at": 2.0, "kind": "write_error"},
        {"at": 3.0, "kind": "error_code", "code": 7},
        {"at": 4.0, "kind": "disconnect"},
        {"at": 5.0, "kind": "power_loss", "duration": 1.0},
    ]});
    let (mut arm, clock) = ready(options, ControlMode::ServoPosition);
    let mut out = [0.0; 2];
    let io = |result| matches!(result, Err(AdapterError::Io(_)));
    clock.advance(ms(1000));
    assert!(io(arm.read_joint_positions(&mut out)) && io(arm.read_joint_positions(&mut out)));
    assert!(arm.read_joint_positions(&mut out).is_ok() && arm.is_connected());
    clock.advance(ms(1000));
    assert!(io(arm.write_joint_positions(&[0.1, 0.1], 1.0)));
    assert!(arm.write_joint_positions(&[0.1, 0.1], 1.0).is_ok());
    clock.advance(ms(1000));
    assert!(matches!(arm.write_joint_positions(&[0.2, 0.2], 1.0), Err(AdapterError::Fault { code: 7, .. })));
    assert_eq!(arm.read_error(), Ok((7, "scripted error 7".into())));
    arm.write_clear_errors().unwrap();
    assert_eq!(arm.read_error(), Ok((0, String::new())));
    clock.advance(ms(1000));
    assert!(io(arm.read_joint_positions(&mut out)) && !arm.is_connected());
    assert_eq!(arm.read_joint_positions(&mut out), Err(AdapterError::NotConnected));
    arm.connect().unwrap();
    clock.advance(ms(1000));
    assert!(io(arm.read_joint_positions(&mut out)) && io(arm.connect()));
    clock.advance(ms(1000));
    arm.connect().unwrap();
    assert_eq!(arm.read_enabled(), Ok(false), "the motors stay off after a loss of power");
}

#[test]
fn an_open_estop_line_cannot_be_cleared() {
    let options = serde_json::json!({"faults": [{"at": 1.0, "kind": "estop", "duration": 1.0}]});
    let (mut arm, clock) = ready(options, ControlMode::ServoPosition);
    clock.advance(ms(1000));
    positions(&mut arm);
    assert_eq!(arm.read_enabled(), Ok(false));
    assert!(arm.write_clear_errors().is_err() && arm.write_enable(true).is_err());
    clock.advance(ms(1000));
    assert_eq!(arm.read_error().map(|e| e.0), Ok(1), "release changes nothing");
    arm.write_clear_errors().unwrap();
    assert_eq!(arm.read_enabled(), Ok(false), "clearing enables nothing");
    arm.write_enable(true).unwrap();
}

#[test]
fn gripper_and_optional_parts() {
    let (mut arm, clock) = ready(serde_json::json!({}), ControlMode::Position);
    arm.write_gripper_position(0.08).unwrap();
    clock.advance(ms(100));
    assert!((arm.read_gripper_position().unwrap().unwrap() - 0.05).abs() < 1e-12, "0.1 m/s from half open");
    assert!(matches!(arm.write_gripper_position(0.1), Err(AdapterError::Rejected(_))));
    assert_eq!(arm.get_gripper_force_range(), Some((1.0, 40.0)));
    for (position, force) in [(0.02, 0.5), (0.02, 40.1), (0.02, f64::NAN), (0.1, 5.0)] {
        let refused = arm.write_gripper_position_with_force(position, force);
        assert!(matches!(refused, Err(AdapterError::Rejected(_))), "{position} m, {force} N");
    }
    arm.device.gripper.put_object(0.03);
    arm.write_gripper_position_with_force(0.02, 5.0).unwrap();
    clock.advance(ms(1000));
    assert_eq!((arm.read_gripper_position(), arm.read_gripper_force()), (Ok(Some(0.03)), Ok(Some(5.0))));
    arm.write_stop(&StopPoint::default()).unwrap();
    assert_eq!(arm.read_gripper_force(), Ok(Some(5.0)), "a stop keeps the grip");
    arm.write_gripper_position(0.02).unwrap();
    assert_eq!(arm.read_gripper_force(), Ok(Some(20.0)), "without a force it has its own");
    assert!(arm.cartesian().is_none() && arm.force_torque().is_none());
    let (mut bare, _) = ready(serde_json::json!({"gripper": false, "force_torque": true}), ControlMode::Position);
    assert!(bare.gripper().is_none());
    assert_eq!(bare.force_torque().unwrap().read_force_torque(), Ok(Some([0.0; 6])));
}

#[test]
fn without_brakes_it_sinks_when_disabled() {
    let (mut arm, clock) = arm(serde_json::json!({"brakes": false}));
    assert!(!arm.get_info().holds_when_disabled);
    arm.connect().unwrap();
    clock.advance(ms(1000));
    assert!((positions(&mut arm)[0] + 0.2).abs() < 1e-9);
}

#[test]
fn wrong_options_are_refused_with_the_arm_named() {
    for (options, part) in [
        (serde_json::json!({"initial_positions": [1.0]}), "arm: initial_positions has 1 values for 2 joints"),
        (serde_json::json!({"latency_ms": -1.0}), "latency_ms"),
        (serde_json::json!({"lagg": 0.1}), "unknown field `lagg`"),
        (serde_json::json!({"faults": [{"kind": "garbage"}]}), "cannot play"),
    ] {
        let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 2, options };
        let error = MockArm::new(&config).err().unwrap().to_string();
        assert!(error.contains(part), "{error}");
    }
}

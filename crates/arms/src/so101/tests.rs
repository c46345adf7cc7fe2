//! The adapter against the emulated servos.

use std::time::{Duration, Instant};

use serde_json::json;

use super::adapter::So101Adapter;
use super::emulator::{Servos, start};
use super::{DOF, SPEC};
use dimos_core::arm::{GripperUnit, JointSet, StopPoint};
use dimos_core::joint::{ControlMode, joints_of};
use dimos_hardware::adapter::{AdapterError, Gripper, JointReading, ManipulatorAdapter, Stop};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::serial_server::SerialServer;

/// An adapter and its servos.
pub fn arm(options: serde_json::Value) -> (So101Adapter, SerialServer<Servos>) {
    let mut config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: DOF, options };
    let servos = start(&config, &EmulatorAddress::InProcess).unwrap();
    config.address = servos.address();
    (So101Adapter::new(&config).unwrap(), servos)
}

/// The goals that the servos have received [counts].
pub fn goals(servos: &SerialServer<Servos>) -> [u16; 6] {
    let goal = |servos: &Servos, i| u16::from_le_bytes([servos.byte(i, 42), servos.byte(i, 43)]);
    servos.with(|servos, _| [0, 1, 2, 3, 4, 5].map(|i| goal(servos, i)))
}

pub fn positions(adapter: &mut So101Adapter) -> [f64; DOF] {
    let mut positions = [0.0; DOF];
    // On a busy computer an answer may be late.
    for late in (0..3).rev() {
        match adapter.read_joint_positions(&mut positions) {
            Err(AdapterError::Timeout(_)) if late > 0 => {}
            read => return read.map(|()| positions).unwrap(),
        }
    }
    positions
}

fn until(mut done: impl FnMut() -> bool) {
    let began = Instant::now();
    while !done() {
        assert!(began.elapsed() < Duration::from_secs(10));
        std::thread::sleep(Duration::from_millis(5));
    }
}

#[test]
fn a_lost_a_damaged_and_a_late_answer_cost_no_reading() {
    let (mut adapter, servos) = arm(json!({}));
    adapter.connect().unwrap();
    let start = positions(&mut adapter);
    for fault in [
        Fault::new(FaultKind::Silent),
        Fault::new(FaultKind::Corrupt),
        Fault::new(FaultKind::Truncated),
        Fault::new(FaultKind::Garbage),
        Fault::new(FaultKind::Stall).lasting(0.02),
    ] {
        servos.inject(fault).unwrap();
        assert_eq!(positions(&mut adapter), start, "{:?}", fault.kind);
    }
}

#[test]
fn a_lost_servo_loses_its_joint_only_and_no_motor_is_said_to_be_off_that_is_not_heard() {
    let (mut adapter, servos) = arm(json!({}));
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    let before = positions(&mut adapter);
    servos.with(|servos, _| servos.plug(2, 0));
    let mut reading = JointReading::default();
    until(|| adapter.read_joints(&mut reading).is_ok() && !reading.missing.is_empty());
    assert_eq!(reading.missing, JointSet::of([2]), "its cable is off");
    assert_eq!(reading.position[..DOF], before, "what is missing is where it was heard last");
    // The others follow a stop, and the line stays open.
    let mut rest = before;
    rest[0] += 0.05;
    let stop = StopPoint { position: Some(joints_of(&rest)) };
    assert_eq!(adapter.write_stop(&stop), Ok(Stop::Confirmed));
    until(|| adapter.read_joints(&mut reading).is_ok() && (reading.position[0] - rest[0]).abs() < 3e-3);
    assert!(adapter.is_connected());
    let unknown = adapter.write_enable(false).unwrap_err().to_string();
    assert!(unknown.contains("servo 3 (elbow_flex) does not answer"), "{unknown}");
    servos.with(|servos, _| servos.plug(2, 3));
    until(|| adapter.read_joints(&mut reading).is_ok() && reading.missing.is_empty());
    adapter.write_enable(false).unwrap();
    // The gripper's servo is none of the joints.
    servos.with(|servos, _| servos.plug(DOF, 0));
    until(|| adapter.read_gripper_position() == Ok(None));
    adapter.read_joints(&mut reading).unwrap();
    assert!(reading.missing.is_empty(), "{:?}", reading.missing);
}

#[test]
fn joints_and_gripper_move_in_radians() {
    for echo in [false, true] {
        let (mut adapter, servos) = arm(json!({"echo": echo, "sim": {"echo": echo}}));
        adapter.connect().unwrap();
        adapter.activate().unwrap();
        adapter.set_control_mode(ControlMode::Position).unwrap();
        let goal = [0.2, -0.3, 0.4, -0.1, 0.5];
        adapter.write_joint_positions(&goal, 1.0).unwrap();
        let near = |found: &[f64]| found.iter().zip(goal).all(|(a, b)| (a - b).abs() < 2e-3);
        until(|| near(&positions(&mut adapter)));
        assert!(near(&servos.true_positions().unwrap()[..DOF]));
        let (closed, open) = adapter.get_gripper_range().unwrap();
        assert_eq!((adapter.get_gripper_unit(), closed), (GripperUnit::Radians, 0.0));
        assert!((open - 1.92).abs() < 2e-3, "−0.175 to 1.745 rad: {open}");
        adapter.write_gripper_position(1.3).unwrap();
        until(|| (adapter.read_gripper_position().unwrap().unwrap() - 1.3).abs() < 2e-3);
        assert!(near(&positions(&mut adapter)), "the joints stay");
        // Closed is at −0.175 rad of the servo.
        assert!((servos.true_positions().unwrap()[DOF] - 1.125).abs() < 3e-3);
        assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
        assert!(adapter.write_gripper_position(open + 0.01).is_err() && adapter.write_gripper_position(-0.01).is_err());
        assert_eq!(adapter.write_gripper_position_with_force(1.0, 0.5), Err(AdapterError::Unsupported));
    }
}

#[test]
fn the_gripper_has_a_speed_of_its_own_also_while_joints_stream() {
    let (mut adapter, servos) = arm(json!({}));
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    adapter.set_control_mode(ControlMode::ServoPosition).unwrap();
    let speeds = || {
        let speed = |servos: &Servos, i| u16::from_le_bytes([servos.byte(i, 46), servos.byte(i, 47)]);
        servos.with(|servos, _| [speed(servos, 0), speed(servos, DOF)])
    };
    let stream = |adapter: &mut So101Adapter| {
        let here = positions(adapter);
        adapter.write_joint_positions(&here, 1.0).unwrap();
    };
    stream(&mut adapter);
    let command = |adapter: &mut So101Adapter, to, speed| {
        let gripper: &mut dyn Gripper = adapter;
        assert!(gripper.info().has_speed);
        gripper.command(to, None, speed).unwrap();
    };
    // A tenth of 3 rad/s.
    command(&mut adapter, 1.5, Some(0.1));
    let counts = (0.3 * 4096.0 / std::f64::consts::TAU) as u16;
    assert_eq!(speeds(), [0, counts]);
    let mut fastest = 0;
    for _ in 0..40 {
        stream(&mut adapter);
        std::thread::sleep(Duration::from_millis(10));
        fastest = fastest.max(adapter.fetch().unwrap()[DOF].velocity);
    }
    assert_eq!(speeds(), [0, counts], "setpoints of the joints leave it alone");
    assert!(fastest > 0 && fastest <= i32::from(counts) + 1, "{fastest} counts/s");
    command(&mut adapter, 0.2, None);
    assert_eq!(speeds(), [0, 0], "the fastest");
    until(|| (adapter.read_gripper_position().unwrap().unwrap() - 0.2).abs() < 2e-3);
}

#[test]
fn a_joint_outside_its_range_is_not_enabled() {
    // The calibration says that the first joint ends at 2100 counts; it is at 2048 + 326.
    let home = tempfile::tempdir().unwrap();
    let path = home.path().join("arm.json");
    let names = super::calibration::NAMES;
    let entry =
        |id: usize| json!({"id": id + 1, "drive_mode": 0, "homing_offset": 0, "range_min": 1000, "range_max": 3100});
    let mut file: serde_json::Map<_, _> =
        names.iter().enumerate().map(|(i, name)| ((*name).into(), entry(i))).collect();
    std::fs::write(&path, serde_json::to_string(&file).unwrap()).unwrap();
    let (mut adapter, _servos) = arm(json!({"calibration": path}));
    let error = adapter.connect().unwrap_err().to_string();
    assert!(error.contains("servo 1 (shoulder_pan) has the range 797 to 3299 and the offset 0"), "{error}");
    assert!(error.contains("\nhint: "), "{error}");
    file.remove("gripper");
    std::fs::write(&path, serde_json::to_string(&file).unwrap()).unwrap();
    let options = json!({"calibration": path});
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: DOF, options };
    let error = (SPEC.check)(&config).unwrap_err();
    assert!(error.what.ends_with("arm.json: gripper is missing"), "{}", error.what);
}

#[test]
fn servos_without_a_power_supply_are_not_enabled() {
    let (mut adapter, _servos) = arm(json!({"sim": {"voltage": 5.0}}));
    adapter.connect().unwrap();
    let error = adapter.activate().unwrap_err().to_string();
    assert!(error.starts_with("so101: the servos have 5.0 V\nhint: "), "{error}");
    assert!(!adapter.read_enabled().unwrap());
}

#[test]
fn a_servo_that_does_not_answer_is_named() {
    let (mut adapter, servos) = arm(json!({}));
    servos.inject(Fault::new(FaultKind::Silent).lasting(20.0)).unwrap();
    let error = adapter.connect().unwrap_err();
    assert!(matches!(&error, AdapterError::Timeout(text) if text.contains("servo 1 (shoulder_pan)")), "{error}");
    assert!(error.to_string().contains("\nhint: is the arm powered"), "{error}");
}

#[test]
fn an_overload_is_reported_and_ends_when_the_goal_is_where_the_joint_is() {
    let (mut adapter, servos) = arm(json!({}));
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    servos.inject(Fault::new(FaultKind::ErrorCode).code(0x20)).unwrap();
    until(|| adapter.read_error().unwrap() == (0x20, "servo 1 (shoulder_pan): overload".into()));
    let here = positions(&mut adapter);
    assert!(matches!(adapter.write_joint_positions(&here, 1.0), Err(AdapterError::Fault { code: 0x20, .. })));
    adapter.write_clear_errors().unwrap();
    assert_eq!(adapter.read_error().unwrap(), (0, String::new()));
    adapter.write_joint_positions(&here, 1.0).unwrap();
}

#[test]
fn a_stop_leaves_the_gripper_its_grip_and_joints_that_droop_their_goals() {
    let (mut adapter, servos) = arm(json!({"sim": {"droop": 0.05}}));
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    adapter.set_control_mode(ControlMode::Position).unwrap();
    adapter.write_joint_positions(&[0.2, -0.3, 0.4, -0.1, 0.5], 1.0).unwrap();
    adapter.write_gripper_position(1.5).unwrap();
    until(|| adapter.read_state().unwrap().state >> 8 != 0);
    until(|| adapter.read_state().unwrap().state >> 8 == 0);
    // A workpiece in the gripper: it cannot close.
    servos.inject(Fault { joint: 6, ..Fault::new(FaultKind::Blocked).lasting(60.0) }).unwrap();
    adapter.write_gripper_position(0.0).unwrap();
    until(|| adapter.read_state().unwrap().state >> 8 == 0);
    let held = goals(&servos);
    assert!(adapter.read_gripper_position().unwrap().unwrap() > 1.2, "the workpiece keeps it open");
    let at = |joints: [f64; DOF]| StopPoint { position: Some(joints_of(&joints)) };
    assert_eq!(adapter.write_stop(&at([0.2, -0.3, 0.4, -0.1, 0.5])), Ok(Stop::Confirmed));
    assert_eq!(goals(&servos), held, "at rest");
    // The same while a joint moves: it stops where its braking ends.
    let start = positions(&mut adapter);
    adapter.write_joint_positions(&[-1.5, -0.3, 0.4, -0.1, 0.5], 0.3).unwrap();
    until(|| (positions(&mut adapter)[0] - start[0]).abs() > 0.1);
    assert_eq!(adapter.write_stop(&at([-0.1, -0.3, 0.4, -0.1, 0.5])), Ok(Stop::Confirmed));
    let stopped = goals(&servos);
    assert_eq!((stopped[0], &stopped[1..]), (2048 - 65, &held[1..]));
}

#[test]
fn a_reconnect_takes_few_requests_and_writes_no_settings() {
    let (mut adapter, servos) = arm(json!({"write_settings": true, "sim": {"factory": true}}));
    adapter.connect().unwrap();
    let requests = || servos.with(|servos, _| servos.instructions());
    let before = requests();
    adapter.disconnect();
    adapter.connect().unwrap();
    // Five for each servo and one for the state of all, but for repetitions on a busy computer.
    let made = requests() - before;
    assert!(made < 40, "{made}");
}

//! The adapter against the emulator, over a bus in memory.

use std::time::{Duration, Instant};

use super::adapter::PiperAdapter;
use super::emulator::{PiperEmulator, SimOptions};
use super::protocol::DOF;
use super::{GripperKind, SPEC, golden};
use dimos_core::arm::{Pose, StopPoint};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::joint::{ControlMode, joints_of};
use dimos_hardware::adapter::{AdapterError, Cartesian, Gripper, JointReading, ManipulatorAdapter, Stop};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::transport::can::CanFrame;

pub const START: [f64; DOF] = [0.1, 0.6, -0.7, 0.05, 0.4, -0.1];

pub fn config(address: &str, options: serde_json::Value) -> AdapterConfig {
    AdapterConfig { hardware_id: "arm".into(), address: address.into(), dof: DOF, options }
}

pub fn pair(options: serde_json::Value) -> (PiperEmulator, PiperAdapter) {
    let emulator = PiperEmulator::start(&config("sim", options.clone()), &EmulatorAddress::InProcess).unwrap();
    let adapter = PiperAdapter::new(&config(&emulator.address(), options)).unwrap();
    (emulator, adapter)
}

pub fn connected() -> (PiperEmulator, PiperAdapter) {
    let (emulator, mut adapter) = pair(serde_json::json!({}));
    adapter.connect().unwrap();
    (emulator, adapter)
}

pub fn read(arm: &mut PiperAdapter) -> Result<JointReading, AdapterError> {
    let mut reading = JointReading::default();
    arm.read_joints(&mut reading).map(|()| reading)
}

/// Waits until `done`, for at most 10 s.
pub fn until(what: &str, mut done: impl FnMut() -> bool) {
    let end = Instant::now() + Duration::from_secs(10);
    while !done() {
        assert!(Instant::now() < end, "{what}: not within 10 s");
        std::thread::sleep(Duration::from_millis(2));
    }
}

pub fn farthest(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// The identifiers that came over the bus.
pub fn ids(emulator: &PiperEmulator) -> Vec<u16> {
    emulator.trace().iter().map(|(_, frame)| frame.id).collect()
}

/// Activates, and waits until the emulator has taken the last frame of it.
pub fn activate(emulator: &PiperEmulator, arm: &mut PiperAdapter) {
    emulator.record();
    arm.activate().unwrap();
    until("the hold", || ids(emulator).iter().filter(|id| **id == 0x157).count() == 2);
}

/// A point of rest.
pub fn at(joints: &[f64; DOF]) -> StopPoint {
    StopPoint { position: Some(joints_of(joints)) }
}

/// Two big-endian numbers of a frame.
pub fn two(frame: &CanFrame) -> [i32; 2] {
    let half = |i: usize| i32::from_be_bytes(frame.data[i..i + 4].try_into().unwrap());
    [half(0), half(4)]
}

#[test]
fn units_go_both_ways_and_the_arm_gets_there() {
    let (emulator, mut arm) = connected();
    let info = arm.get_info();
    assert_eq!((info.model.as_str(), info.firmware_version.as_deref()), ("Piper", Some("S-V1.8-5")));
    assert!(farthest(&read(&mut arm).unwrap().position, &START) < 1e-5, "rad, not deg");
    activate(&emulator, &mut arm);
    let target = [0.3, 0.9, -0.9, -0.1, 0.2, 0.2];
    emulator.record();
    arm.write_joint_positions(&target, 0.25).unwrap();
    until("motion", || read(&mut arm).unwrap().velocity.unwrap()[1] > 0.1);
    until("arrival", || farthest(&read(&mut arm).unwrap().position, &target) < 2e-5);
    assert!(farthest(&emulator.joints().0, &target) < 1e-3);
    let frames: Vec<CanFrame> = emulator.trace().iter().map(|(_, frame)| *frame).collect();
    assert_eq!(frames[0], golden::frame("151#0101190000000000"), "MOVE J at 25 %");
    let wire: Vec<i32> = frames[1..4].iter().flat_map(two).collect();
    assert_eq!(wire, target.map(|v: f64| (v.to_degrees() * 1000.0).round() as i32), "0.001 deg on the wire");
    assert_eq!(frames.len(), 4, "nothing else was sent");
    let pose = arm.read_cartesian_position().unwrap().unwrap().tcp;
    assert!(pose.xyz[2] > 0.2 && pose.xyz[2] < 0.6, "metres: {pose:?}");
}

#[test]
fn velocities_and_torques_are_those_of_the_motors() {
    for (firmware, quarter) in [("S-V1.8-2", true), ("S-V1.8-3", false)] {
        let (emulator, mut arm) = pair(serde_json::json!({ "sim": { "firmware": firmware } }));
        arm.connect().unwrap();
        activate(&emulator, &mut arm);
        arm.write_joint_positions(&[1.5, 0.6, -0.7, 0.05, 0.4, 1.5], 0.2).unwrap();
        until("0.6 rad/s", || (read(&mut arm).unwrap().velocity.unwrap()[0] - 0.6).abs() < 2e-3);
        let reading = read(&mut arm).unwrap();
        // The plant's friction is 0.5 Nm·s/rad, whatever the firmware makes of it on the wire.
        let efforts = reading.effort.unwrap();
        assert!((efforts[0] - 0.3).abs() < 0.01 && (efforts[5] - 0.3).abs() < 0.01, "{firmware}: {efforts:?}");
        assert_eq!(arm.get_info().firmware_version.as_deref(), Some(firmware), "{quarter}");
        drop(emulator);
    }
}

#[test]
fn set_points_are_followed_smoothly_or_directly() {
    for (follow, byte) in [("smooth", 0x00), ("direct", 0xAD)] {
        let (emulator, mut arm) = pair(serde_json::json!({ "follow": follow }));
        arm.connect().unwrap();
        activate(&emulator, &mut arm);
        arm.set_control_mode(ControlMode::ServoPosition).unwrap();
        emulator.record();
        let mut target = START;
        for _ in 0..100 {
            target[0] += 0.005;
            arm.write_joint_positions(&target, 0.1).unwrap();
            std::thread::sleep(Duration::from_millis(5));
        }
        until("the last", || farthest(&read(&mut arm).unwrap().position, &target) < 1e-4);
        let modes: Vec<CanFrame> = emulator.trace().iter().map(|(_, f)| *f).filter(|f| f.id == 0x151).collect();
        // The hold of the enabling has set the smooth way already.
        let expected = if follow == "smooth" { 0..20 } else { 1..20 };
        assert!(expected.contains(&modes.len()), "{follow}: where it changes, not before all: {}", modes.len());
        assert!(modes.iter().all(|frame| frame.data[..4] == [1, 1, 100, byte]), "{follow}: full speed, its own way");
        let joints = ids(&emulator).iter().filter(|id| (0x155..=0x157).contains(*id)).count();
        assert_eq!(joints, 300);
    }
}

#[test]
fn cartesian_targets_are_reached_or_told() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    let now = arm.read_cartesian_position().unwrap().unwrap().tcp;
    let goal = Pose { xyz: [now.xyz[0] + 0.03, now.xyz[1] + 0.04, now.xyz[2] + 0.03], rpy: now.rpy };
    arm.write_cartesian_position(&goal, 1.0).unwrap();
    until("pose", || {
        read(&mut arm).unwrap();
        farthest(&arm.read_cartesian_position().unwrap().unwrap().tcp.xyz, &goal.xyz) < 1e-4
    });
    arm.write_cartesian_position(&Pose { xyz: [3.0, 0.0, 0.0], rpy: [0.0; 3] }, 1.0).unwrap();
    until("refusal", || {
        read(&mut arm).unwrap();
        arm.read_error() == Ok((2, "no solution for the target".into()))
    });
    assert!(arm.write_cartesian_position(&Pose { xyz: [f64::NAN; 3], rpy: [0.0; 3] }, 1.0).is_err());
    arm.write_clear_errors().unwrap();
}

#[test]
fn the_gripper_counts_in_metres_and_knows_its_size() {
    for (kind, stroke) in [("small", 0.07), ("large", 0.1)] {
        let (emulator, mut arm) = pair(serde_json::json!({ "gripper": kind, "gripper_torque": 2.5 }));
        arm.connect().unwrap();
        assert_eq!(arm.get_gripper_range(), Some((0.0, stroke)));
        assert!(arm.write_gripper_position(stroke).is_err(), "not while the motors are off");
        activate(&emulator, &mut arm);
        emulator.record();
        arm.write_gripper_position(stroke).unwrap();
        until("open", || {
            read(&mut arm).unwrap();
            (arm.read_gripper_position().unwrap().unwrap() - stroke).abs() < 1e-6
        });
        let [(_, frame)] = emulator.trace()[..] else { panic!("one frame") };
        assert_eq!((two(&frame)[0], &frame.data[4..]), ((stroke * 1e6) as i32, &[0x09, 0xC4, 1, 0][..]), "2500 mNm");
        for torque in [0.0, 5.1, f64::NAN] {
            let error = arm.write_gripper_position_with_force(0.0, torque).unwrap_err().to_string();
            assert!(error.ends_with("Nm is not within 0.001 to 5 Nm"), "{error}");
        }
        emulator.put_object(0.04);
        emulator.record();
        arm.write_gripper_position_with_force(0.02, 1.25).unwrap();
        until("the grip", || {
            read(&mut arm).unwrap();
            arm.read_gripper_force() == Ok(Some(1.25))
        });
        assert_eq!(arm.read_gripper_position(), Ok(Some(0.04)));
        let [(_, frame)] = emulator.trace()[..] else { panic!("one frame") };
        assert_eq!((two(&frame)[0], &frame.data[4..]), (20_000, &[0x04, 0xE2, 1, 0][..]), "1250 mNm");
        let error = arm.write_gripper_position(stroke + 0.001).unwrap_err().to_string();
        assert!(error.ends_with(&format!("m is not within 0 to {stroke} m")), "{error}");
    }
    let (_emulator, mut arm) = pair(serde_json::json!({ "gripper": "none" }));
    arm.connect().unwrap();
    assert!(arm.gripper().is_none());
}

#[test]
fn connecting_and_leaving_move_nothing_and_never_take_the_power() {
    let (emulator, mut arm) = pair(serde_json::json!({}));
    emulator.record();
    arm.connect().unwrap();
    assert_eq!(arm.read_enabled(), Ok(false));
    assert!(ids(&emulator).iter().all(|id| [0x472, 0x4AF].contains(id)), "connect only asks");
    activate(&emulator, &mut arm);
    arm.deactivate(&StopPoint::default()).unwrap();
    arm.disconnect();
    arm.disconnect();
    assert_eq!(read(&mut arm).unwrap_err(), AdapterError::NotConnected);
    assert!(emulator.enabled(), "leaving does not switch off the motors");
    assert!(farthest(&emulator.joints().0, &START) < 1e-4);
    assert!(!ids(&emulator).contains(&0x150) && emulator.power_drops() == 0);
    arm.connect().unwrap();
    assert_eq!(arm.read_enabled(), Ok(true));
}

#[test]
fn the_first_command_is_to_stay_and_the_pose_is_never_zero() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    let trace: Vec<CanFrame> = emulator.trace().iter().map(|(_, frame)| *frame).collect();
    let first = trace.iter().position(|frame| frame.id == 0x471).unwrap();
    assert_eq!(first, 4, "the target is set before the motors come on: {trace:?}");
    let targets: Vec<_> = trace.iter().filter(|f| (0x155..=0x157).contains(&f.id)).flat_map(two).collect();
    let measured = START.map(|v: f64| (v.to_degrees() * 1000.0).round() as i32);
    assert_eq!(targets, [measured, measured].concat(), "and when they are on");
    let enables: Vec<Mono> = emulator.trace().iter().filter(|(_, f)| f.id == 0x471).map(|(at, _)| *at).collect();
    assert!(enables.len() >= 3, "asked again while the motors come on");
    assert!(enables.windows(2).all(|pair| pair[1].since(pair[0]) >= Duration::from_millis(5)), "every 10 ms");
}

#[test]
fn a_stop_holds_and_is_confirmed_by_the_motors() {
    let (emulator, mut arm) = connected();
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed), "at rest, motors off");
    activate(&emulator, &mut arm);
    arm.write_joint_positions(&[2.0, 2.0, -2.0, 0.0, 0.0, 0.0], 0.3).unwrap();
    until("motion", || read(&mut arm).unwrap().velocity.unwrap()[0] > 0.5);
    emulator.record();
    let (there, speed) = emulator.joints();
    let rest = std::array::from_fn(|i| there[i] + speed[i] * speed[i].abs() / 10.0);
    assert_eq!(arm.write_stop(&at(&rest)), Ok(Stop::Confirmed));
    assert_eq!(ids(&emulator), [0x151, 0x155, 0x156, 0x157], "a hold, no E-stop");
    until("standstill", || emulator.joints().1.iter().all(|v| v.abs() < 1e-4));
    assert!(farthest(&emulator.joints().0, &there) < 0.15 && emulator.enabled());
}

#[test]
fn disabling_is_verified_and_the_arm_falls() {
    let (emulator, mut arm) = connected();
    activate(&emulator, &mut arm);
    assert_eq!(arm.read_enabled(), Ok(true));
    arm.write_enable(false).unwrap();
    assert_eq!(arm.read_enabled(), Ok(false));
    let refused = arm.write_joint_positions(&START, 0.1).unwrap_err();
    assert_eq!(refused, AdapterError::Rejected("arm: the motors are disabled".into()));
    until("the fall", || emulator.joints().0[1] < 0.5);
    assert!(!SPEC.holds_when_disabled && !arm.get_info().holds_when_disabled);
    // It holds where it has fallen to, not at its earlier target.
    until("the end of the fall", || emulator.joints().1.iter().all(|v| *v == 0.0));
    let (lies, _) = emulator.joints();
    until("the last of it", || farthest(&read(&mut arm).unwrap().position, &lies) < 1e-4);
    activate(&emulator, &mut arm);
    assert!(farthest(&emulator.joints().0, &lies) < 1e-3);
}

#[test]
fn stamps_are_of_the_arrival_and_the_same_when_nothing_came() {
    let (_emulator, mut arm) = connected();
    let (mut last, mut fresh) = (Mono::ZERO, 0);
    let end = Instant::now() + Duration::from_millis(500);
    while Instant::now() < end {
        let stamp = read(&mut arm).unwrap().stamp.unwrap();
        assert!(stamp <= MonotonicClock.now() && stamp >= last);
        fresh += u32::from(stamp > last);
        last = stamp;
        std::thread::sleep(Duration::from_micros(200));
    }
    assert!((40..=105).contains(&fresh), "200 Hz: {fresh} in 0.5 s");
}

#[test]
fn limits_are_the_narrower_of_sheet_and_arm() {
    let (emulator, mut arm) = connected();
    let sheet = (SPEC.check)(&config("can0", serde_json::json!({}))).unwrap().limits;
    let own = arm.get_limits().unwrap();
    assert!(farthest(&own.position_lower, &sheet.position_lower) < 1e-3);
    assert!(farthest(&own.position_upper, &sheet.position_upper) < 1e-3);
    assert_eq!(own.velocity_max, [3.0; DOF]);
    // Somebody narrows joint 1 to ±90° and 1.5 rad/s, and opens joint 2 to ±180°.
    let mut port = dimos_hardware::transport::can::open(
        "test",
        &dimos_hardware::transport::can::CanAddress::parse(&emulator.address()).unwrap(),
        &[],
    )
    .unwrap();
    let frames = ["474#010384FC7C05DC00", "474#020708F8F87FFF00"].map(golden::frame);
    port.send(&frames).unwrap();
    until("narrower limits", || {
        arm.connect().unwrap();
        let limits = arm.get_limits().unwrap();
        (limits.position_upper[0] - 90f64.to_radians()).abs() < 1e-9 && limits.velocity_max[0] == 1.5
    });
    let limits = arm.get_limits().unwrap();
    let joint_2 = (limits.position_lower[1], limits.position_upper[1]);
    assert_eq!(joint_2, (sheet.position_lower[1], sheet.position_upper[1]), "never wider than the sheet");
}

#[test]
fn wrong_configurations_are_refused() {
    let with = |dof, address: &str, options| AdapterConfig { dof, ..config(address, options) };
    for (config, part) in [
        (with(7, "can0", serde_json::json!({})), "arm: piper has 6 joints, not 7"),
        (with(6, "", serde_json::json!({})), "arm: address: the CAN interface is missing"),
        (with(6, "/dev/ttyACM0", serde_json::json!({})), "a serial CAN adapter is slcan:/dev/ttyACM0"),
        (with(6, "can0", serde_json::json!({ "speed_scale": 1.5 })), "1.5 is not above 0 and at most 1"),
        (with(6, "can0", serde_json::json!({ "gripper_torque": 6 })), "6 is not above 0 and at most 5"),
        (with(6, "can0", serde_json::json!({ "gripper": "huge" })), "unknown variant `huge`"),
    ] {
        let error = (SPEC.create)(&config).err().unwrap().to_string();
        assert!(error.contains(part), "{error}");
    }
    let emulate = |sim: serde_json::Value, place: &EmulatorAddress| {
        PiperEmulator::start(&config("sim", serde_json::json!({ "sim": sim })), place).err().unwrap().to_string()
    };
    assert!(
        emulate(serde_json::json!({ "initial_positions": [0, 0, 1, 0, 0, 0] }), &EmulatorAddress::InProcess)
            .contains("limits")
    );
    assert!(
        emulate(serde_json::json!({ "feedback_hz": 500 }), &EmulatorAddress::InProcess).contains("between 20 and 200")
    );
    assert!(emulate(serde_json::json!({ "firmware": "1.6" }), &EmulatorAddress::InProcess).contains("8 characters"));
    let bind = EmulatorAddress::Bind([127, 0, 0, 5].into());
    assert!(emulate(serde_json::json!({}), &bind).contains("no IP address"));
    let script = SimOptions { faults: vec![Fault::new(FaultKind::Nan)], ..SimOptions::default() };
    assert!(PiperEmulator::with(&script, GripperKind::Small, &EmulatorAddress::InProcess).is_err());
}

/// A joint of a Piper-H goes where a Piper's may not.
#[test]
fn the_models_have_their_ranges() {
    let limits = |model: &str| {
        let config = config("can0", serde_json::json!({"model": model}));
        (SPEC.check)(&config).unwrap().limits
    };
    assert!((limits("piper").position_upper[3] - 100f64.to_radians()).abs() < 1e-3);
    for (model, wrist, tilt) in [("piper_h", 135.0, 89.5), ("piper_l", 127.0, 89.5), ("piper_x", 89.0, 89.0)] {
        let limits = limits(model);
        let is = [limits.position_upper[3].to_degrees(), limits.position_upper[4].to_degrees()];
        assert!((is[0] - wrist).abs() < 0.02 && (is[1] - tilt).abs() < 0.02, "{model}: {is:?}");
    }
}

//! The adapter against the emulated controller.

use std::time::{Duration, Instant};

use serde_json::json;

use super::adapter::UrAdapter;
use super::emulator::UrEmulator;
use super::{DOF, SPEC};
use dimos_core::arm::StopPoint;
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::{AdapterError, Cartesian, ForceTorque, JointReading, ManipulatorAdapter, Stop};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::faults::{Fault, FaultKind};

/// An adapter and its controller.
pub(super) fn arm(options: serde_json::Value) -> (UrAdapter, UrEmulator) {
    let mut config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: DOF, options };
    let emulator = UrEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    config.address = emulator.address();
    (UrAdapter::new(&config).unwrap(), emulator)
}

/// One that is connected and enabled.
pub(super) fn ready(options: serde_json::Value) -> (UrAdapter, UrEmulator) {
    let (mut adapter, emulator) = arm(options);
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    (adapter, emulator)
}

pub(super) fn positions(adapter: &mut UrAdapter) -> [f64; DOF] {
    let mut positions = [0.0; DOF];
    adapter.read_joint_positions(&mut positions).unwrap();
    positions
}

/// Reads until something is the case, as the device thread does.
pub(super) fn until(adapter: &mut UrAdapter, mut done: impl FnMut(&mut UrAdapter) -> bool) {
    let began = Instant::now();
    loop {
        let _ = adapter.read_joints(&mut JointReading::default());
        if done(adapter) {
            return;
        }
        assert!(began.elapsed() < Duration::from_secs(10));
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Streams setpoints that move the first joint by `way` [rad] in a quarter of a second, and stay there as long.
pub(super) fn stream(adapter: &mut UrAdapter, way: f64) -> [f64; DOF] {
    let start = positions(adapter);
    let mut goal = start;
    for i in 1..=50 {
        goal[0] = start[0] + way * f64::from(i.min(25)) / 25.0;
        adapter.write_joint_positions(&goal, 1.0).unwrap();
        std::thread::sleep(Duration::from_millis(10));
        positions(adapter);
    }
    goal
}

/// Resets the arm, as the device thread does: with each state, until it is done.
pub(super) fn reset(adapter: &mut UrAdapter) -> Result<(), AdapterError> {
    let mut cleared = Err(AdapterError::Busy);
    until(adapter, |adapter| {
        cleared = adapter.write_clear_errors();
        cleared != Err(AdapterError::Busy)
    });
    cleared
}

pub(super) fn text(error: AdapterError) -> String {
    error.to_string()
}

#[test]
fn after_a_stop_the_arm_is_enabled_again_and_moves() {
    let (mut adapter, emulator) = ready(json!({}));
    stream(&mut adapter, 0.1);
    assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    until(&mut adapter, |_| emulator.program().is_none());
    assert!(adapter.read_enabled().unwrap(), "the motors stay on");
    let here = positions(&mut adapter);
    let refused = adapter.write_joint_positions(&here, 1.0).map_err(text);
    assert_eq!(refused, Err("the arm was stopped: enable it again".into()));
    assert_eq!(adapter.foreign_change(), None);
    assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed), "at rest, without a program");
    adapter.activate().unwrap();
    let goal = stream(&mut adapter, -0.1);
    until(&mut adapter, |adapter| (positions(adapter)[0] - goal[0]).abs() < 1e-3);
}

#[test]
fn a_stream_that_ends_holds_and_the_program_stays() {
    let (mut adapter, emulator) = ready(json!({}));
    let goal = stream(&mut adapter, 0.1);
    let began = Instant::now();
    while began.elapsed() < Duration::from_millis(2500) {
        positions(&mut adapter);
        std::thread::sleep(Duration::from_millis(5));
    }
    assert_eq!(emulator.program().as_deref(), Some("dimos_control"));
    assert!((positions(&mut adapter)[0] - goal[0]).abs() < 1e-3);
    adapter.write_joint_positions(&goal, 1.0).unwrap();
    // A velocity ends on its own.
    adapter.set_control_mode(ControlMode::Velocity).unwrap();
    for _ in 0..20 {
        adapter.write_joint_velocities(&[0.3, 0.0, 0.0, 0.0, 0.0, 0.0]).unwrap();
        std::thread::sleep(Duration::from_millis(10));
        positions(&mut adapter);
    }
    let there = positions(&mut adapter)[0];
    until(&mut adapter, |adapter| adapter.state().unwrap().velocity[0] == 0.0);
    assert!((positions(&mut adapter)[0] - there).abs() < 0.05);
    assert_eq!(emulator.program().as_deref(), Some("dimos_control"));
}

#[test]
fn without_orders_the_program_stops_the_arm_and_ends() {
    let (mut adapter, emulator) = ready(json!({}));
    adapter.set_control_mode(ControlMode::Velocity).unwrap();
    for _ in 0..10 {
        adapter.write_joint_velocities(&[0.5, 0.0, 0.0, 0.0, 0.0, 0.0]).unwrap();
        std::thread::sleep(Duration::from_millis(10));
    }
    // As if this process hung: the arm is at rest soon, and the program ends later.
    let began = Instant::now();
    let mut stopped = 0.0;
    while emulator.true_positions().unwrap()[0] != stopped {
        assert!(began.elapsed() < Duration::from_secs(5));
        stopped = emulator.true_positions().unwrap()[0];
        std::thread::sleep(Duration::from_millis(50));
    }
    assert!(emulator.program().is_some() || began.elapsed() > Duration::from_millis(900));
    while emulator.program().is_some() {
        assert!(began.elapsed() < Duration::from_secs(5));
        std::thread::sleep(Duration::from_millis(50));
    }
    assert_eq!(emulator.true_positions().unwrap()[0], stopped);
    until(&mut adapter, |adapter| adapter.foreign_change().is_some());
    let why = adapter.foreign_change().unwrap();
    assert!(
        why.starts_with("no order reached the program on the controller for 1 s") && !why.contains("client"),
        "{why}"
    );
    let rest = positions(&mut adapter);
    let refused = text(adapter.write_joint_velocities(&[0.5; DOF]).unwrap_err());
    assert!(refused.contains("enable it again"), "{refused}");
    std::thread::sleep(Duration::from_millis(100));
    assert_eq!(positions(&mut adapter), rest);
    // What the pendant or a lost connection ended is not stopped once more.
    assert_eq!(adapter.deactivate(&StopPoint::default()), Ok(()));
    adapter.activate().unwrap();
    assert_eq!(adapter.foreign_change(), None);
}

#[test]
fn what_others_change_is_reported_and_not_undone() {
    let (mut adapter, emulator) = ready(json!({}));
    emulator.press_stop();
    until(&mut adapter, |adapter| adapter.foreign_change().is_some());
    assert!(adapter.foreign_change().unwrap().starts_with("another client or the pendant ended"));
    assert_eq!(emulator.program(), None, "not started again");
    adapter.activate().unwrap();
    emulator.set_remote_control(false);
    let refused = text(adapter.activate().unwrap_err());
    assert_eq!(refused, "the controller is in local control\nhint: select remote control at the pendant");
    until(&mut adapter, |_| emulator.clients() == 1);
    emulator.set_remote_control(true);
    adapter.activate().unwrap();
}

#[test]
fn a_protective_stop_is_released_by_order_only_and_not_before_5_s() {
    let (mut adapter, emulator) = ready(json!({}));
    stream(&mut adapter, 0.1);
    let began = Instant::now();
    emulator.inject(Fault::new(FaultKind::ErrorCode).code(153)).unwrap();
    until(&mut adapter, |adapter| adapter.read_error().unwrap().0 != 0);
    let (code, what) = adapter.read_error().unwrap();
    assert_eq!(code, 153);
    assert!(what.starts_with("protective stop (C153A0: a joint deviates"), "{what}");
    assert_eq!(adapter.foreign_change(), None, "the arm itself is the cause");
    until(&mut adapter, |adapter| adapter.state().unwrap().velocity == [0.0; DOF]);
    let here = positions(&mut adapter);
    assert!(matches!(adapter.write_joint_positions(&here, 1.0), Err(AdapterError::Fault { code: 153, .. })));
    assert!(matches!(adapter.activate(), Err(AdapterError::Fault { .. })));
    assert_eq!(adapter.read_state().unwrap().mode, 3);
    // The same error after a reconnection.
    adapter.disconnect();
    adapter.connect().unwrap();
    assert_eq!(adapter.read_error().unwrap(), (code, what));
    assert_eq!(emulator.program().as_deref(), Some("dimos_control"), "the program is only paused");
    // It does not wait: states are read, and the arm is stopped again.
    assert_eq!(adapter.write_clear_errors(), Err(AdapterError::Busy));
    until(&mut adapter, |_| emulator.program().is_none());
    let before = adapter.state().unwrap().time;
    assert_eq!(adapter.write_clear_errors(), Err(AdapterError::Busy));
    until(&mut adapter, |adapter| adapter.state().unwrap().time > before + 0.1);
    assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    assert_eq!(adapter.read_state().unwrap().mode, 3, "still a protective stop");
    reset(&mut adapter).unwrap();
    assert!(began.elapsed() >= Duration::from_secs(5));
    assert_eq!(emulator.program(), None, "it would have continued");
    assert_eq!(adapter.read_error().unwrap(), (0, String::new()));
    let after = positions(&mut adapter);
    assert!(after.iter().zip(&here).all(|(a, b)| (a - b).abs() < 1e-3), "nothing moved");
    adapter.activate().unwrap();
}

#[test]
fn safety_modes_are_reported() {
    let (mut adapter, emulator) = ready(json!({}));
    emulator.set_safety(Some(2));
    until(&mut adapter, |adapter| adapter.read_state().unwrap().mode == 2);
    assert_eq!(adapter.read_error().unwrap().0, 0, "reduced mode is no error");
    stream(&mut adapter, 0.02);
    emulator.set_safety(Some(5));
    until(&mut adapter, |adapter| adapter.read_error().unwrap().0 == 5);
    assert_eq!(adapter.read_error().unwrap().1, "safeguard stop: a safeguard input is open");
    let refused = text(adapter.write_clear_errors().unwrap_err());
    assert!(refused.contains("safeguard") && refused.contains("\nhint: end its cause"), "{refused}");
    emulator.set_safety(None);
    until(&mut adapter, |adapter| adapter.read_error().unwrap().0 == 0);
    let here = positions(&mut adapter);
    assert!(adapter.write_joint_positions(&here, 1.0).is_err(), "it must be enabled again");
    // A violation switches power off, and ends with a restart of the safety system.
    emulator.set_safety(Some(8));
    until(&mut adapter, |adapter| adapter.read_error().unwrap().0 == 8 && !adapter.read_enabled().unwrap());
    reset(&mut adapter).unwrap();
    assert!(!adapter.read_enabled().unwrap(), "clearing enables nothing");
    adapter.activate().unwrap();
}

#[test]
fn payload_and_outputs_show_in_the_state() {
    let (mut adapter, emulator) = ready(json!({"force_torque": true}));
    adapter.set_payload(1.25, [0.0, 0.01, 0.05], None).unwrap();
    let state = *adapter.state().unwrap();
    assert_eq!((state.payload, state.payload_cog), (1.25, [0.0, 0.01, 0.05]));
    adapter.set_payload(0.5, [0.0; 3], Some([0.1, 0.2, 0.3, 0.0, 0.0, 0.0])).unwrap();
    assert_eq!(adapter.state().unwrap().payload_inertia[2], 0.3);
    let refused = text(adapter.set_payload(7.0, [0.0; 3], None).unwrap_err());
    assert_eq!(refused, "a payload of 7 kg is not between 0 and 6.0 kg");
    for number in [0, 7, 9, 17] {
        adapter.set_digital_output(number, true).unwrap();
    }
    adapter.set_digital_output(7, false).unwrap();
    assert_eq!(emulator.outputs().0, 1 | 1 << 9 | 1 << 17);
    assert!(adapter.set_digital_output(18, true).is_err());
    adapter.set_analog_output(1, true, 0.25).unwrap();
    adapter.set_analog_output(0, false, 0.5).unwrap();
    until(&mut adapter, |adapter| adapter.state().unwrap().analog_out[0] != 0.0);
    let outputs = emulator.outputs().1;
    assert!((outputs[0] - 0.012).abs() < 1e-12 && (outputs[1] - 2.5).abs() < 1e-12, "{outputs:?}");
    adapter.set_tool_voltage(24).unwrap();
    assert!(adapter.set_tool_voltage(5).is_err());
    let state = *adapter.state().unwrap();
    assert_eq!((state.digital_in, state.tool_voltage), ((1 << 18) - 1, 24));
    assert_eq!((state.temperature[5], state.voltage[0], state.joint_mode), (36.0, 48.0, [253; 6]));
    assert_eq!(adapter.read_force_torque().unwrap().map(|wrench| wrench[2]), Some(-4.0));
    assert_eq!(emulator.program().as_deref(), Some("dimos_control"), "the program was not disturbed");
}

#[test]
fn a_second_program_with_the_registers_is_named() {
    let (mut first, emulator) = ready(json!({}));
    let config =
        AdapterConfig { hardware_id: "other".into(), address: emulator.address(), dof: DOF, options: json!({}) };
    let mut second = UrAdapter::new(&config).unwrap();
    second.connect().unwrap();
    let refused = text(second.activate().unwrap_err());
    assert!(refused.starts_with("another RTDE client has the input registers from 24 on\nhint: "), "{refused}");
    positions(&mut second);
    first.disconnect();
    until(&mut second, |_| emulator.clients() == 2);
    second.connect().unwrap();
    second.activate().unwrap();
}

#[test]
fn every_model_is_moved_and_has_its_pose() {
    for model in ["ur3", "ur10e", "ur20"] {
        let (mut adapter, emulator) = ready(json!({"model": model}));
        let goal = stream(&mut adapter, 0.1);
        until(&mut adapter, |adapter| (positions(adapter)[0] - goal[0]).abs() < 1e-3);
        assert!((emulator.true_positions().unwrap()[0] - goal[0]).abs() < 1e-3);
        let pose = adapter.read_cartesian_position().unwrap().unwrap().tcp;
        assert!(pose.xyz.iter().any(|v| v.abs() > 0.1), "{pose:?}");
        assert_eq!(adapter.get_info().native_rate, if model == "ur3" { 125.0 } else { 500.0 });
        assert_eq!(adapter.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    }
    let config = AdapterConfig {
        hardware_id: "arm".into(),
        address: "127.0.0.1".into(),
        dof: DOF,
        options: json!({"gain": 50.0}),
    };
    let error = (SPEC.check)(&config).unwrap_err();
    assert_eq!((error.option.as_str(), error.what.as_str()), ("gain", "gain is 100 to 2000, not 50"));
}

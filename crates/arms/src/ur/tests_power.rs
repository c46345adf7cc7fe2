//! Power, brakes, and the optional parts.

use std::time::Duration;

use serde_json::json;

use super::tests::{arm, ready, text, until};
use dimos_core::arm::{AnalogUnit, IoState, JointStatus, Load};
use dimos_hardware::adapter::ManipulatorAdapter;
use dimos_hardware::sim::faults::{Fault, FaultKind};

#[test]
fn the_brakes_are_released_only_if_the_time_is_enough() {
    let (mut adapter, _emulator) = arm(json!({"sim": {"power_time": 2.2}}));
    adapter.connect().unwrap();
    let refused = text(adapter.activate().unwrap_err());
    let expected =
        "the arm is on, and its brakes hold: too little time was left to release them\nhint: enable it again";
    assert_eq!(refused, expected);
    // Nothing is under way after that, whatever this program does then.
    std::thread::sleep(Duration::from_millis(2500));
    until(&mut adapter, |adapter| adapter.read_state().is_ok());
    assert_eq!((adapter.read_state().unwrap().state, adapter.read_enabled()), (5, Ok(false)), "the brakes hold");
    adapter.activate().unwrap();
    assert_eq!(adapter.read_enabled(), Ok(true));
}

#[test]
fn an_arm_in_backdrive_is_not_enabled() {
    let (mut adapter, emulator) = arm(json!({}));
    adapter.connect().unwrap();
    emulator.set_robot_mode(6);
    until(&mut adapter, |adapter| adapter.read_state().unwrap().state == 6);
    let refused = text(adapter.activate().unwrap_err());
    assert_eq!(refused, "the controller is not ready: its robot mode is BACKDRIVE");
    std::thread::sleep(Duration::from_millis(200));
    until(&mut adapter, |adapter| adapter.read_state().is_ok());
    assert_eq!(adapter.read_state().unwrap().state, 6);
}

#[test]
fn inputs_outputs_load_and_joints_are_parts_of_the_arm() {
    let (mut adapter, emulator) = ready(json!({}));
    emulator.set_input(2, false);
    let mut state = IoState::default();
    until(&mut adapter, |adapter| {
        adapter.io().unwrap().read_io(&mut state).unwrap();
        !state.input(2)
    });
    assert_eq!(state.digital_inputs, ((1 << 18) - 1) & !(1 << 2));
    assert_eq!(state.analog_inputs[..4], [1.5, 2.5, 0.004, 0.005]);
    let info = adapter.io().unwrap().get_io();
    assert_eq!((info.digital_inputs, info.digital_outputs), (18, 18));
    let (volt, ampere) = (AnalogUnit::Volt, AnalogUnit::Ampere);
    assert_eq!((info.analog_inputs, info.analog_outputs), (&[volt, volt, ampere, ampere][..], &[volt, volt][..]));
    adapter.io().unwrap().write_analog_output(1, 7.5).unwrap();
    assert_eq!(emulator.outputs().1[1], 7.5);
    let refused = text(adapter.io().unwrap().write_analog_output(1, 10.5).unwrap_err());
    assert_eq!(refused, "analogue output 1 takes 0 to 10 V, not 10.5 V");

    let load = Load { mass: 1.5, center: [0.0, 0.02, 0.06], inertia: [0.01, 0.0, 0.0, 0.02, 0.0, 0.03] };
    adapter.payload().unwrap().write_payload(&load).unwrap();
    assert!(adapter.payload().unwrap().read_payload().unwrap().unwrap().agrees_with(&load));
    // Mounted on the ceiling.
    adapter.payload().unwrap().write_mounting([0.0, 0.0, 1.0]).unwrap();
    until(&mut adapter, |_| emulator.gravity() == [0.0, 0.0, -9.82]);

    let mut joints = [JointStatus::default(); 6];
    adapter.joint_monitor().unwrap().read_joint_status(&mut joints).unwrap();
    assert_eq!((joints[5].temperature, joints[0].voltage, joints[3].error), (Some(36.0), Some(48.0), Some(0)));
}

/// PolyScope X has no dashboard: power, brakes and the end of a protective stop are ordered by its Robot API.
#[test]
fn polyscope_x_is_switched_by_its_robot_api() {
    let (mut adapter, emulator) = arm(json!({"sim": {"software": "10.11.0"}}));
    adapter.connect().unwrap();
    assert_eq!(adapter.get_info().firmware_version.as_deref(), Some("10.11.0"));
    emulator.set_remote_control(false);
    let refused = text(adapter.activate().unwrap_err());
    assert_eq!(refused, "the controller is in local control\nhint: select remote control at the pendant");
    emulator.set_remote_control(true);
    adapter.activate().unwrap();
    assert_eq!(adapter.read_enabled(), Ok(true));
    dimos_hardware::registry::Emulator::inject(&emulator, Fault::new(FaultKind::ErrorCode).code(153)).unwrap();
    until(&mut adapter, |adapter| adapter.read_error().is_ok_and(|(code, _)| code != 0));
    until(&mut adapter, |adapter| adapter.write_clear_errors().is_ok());
    until(&mut adapter, |adapter| adapter.read_error().is_ok_and(|(code, _)| code == 0));
    adapter.activate().unwrap();
    adapter.write_enable(false).unwrap();
    assert_eq!(adapter.read_enabled(), Ok(false));
}

#[test]
fn polyscope_x_before_10_11_is_switched_on_at_the_pendant() {
    let (mut adapter, emulator) = arm(json!({"sim": {"software": "10.8.0"}}));
    adapter.connect().unwrap();
    let refused = text(adapter.activate().unwrap_err());
    assert!(refused.contains("has no \"power on\"") && refused.contains("hint: switch the arm on"), "{refused}");
    emulator.set_robot_mode(7);
    until(&mut adapter, |adapter| adapter.read_state().is_ok_and(|state| state.state == 7));
    adapter.activate().unwrap();
    assert_eq!(adapter.read_enabled(), Ok(true), "switched on by hand, it takes programs");
}

#[test]
fn a_ur7e_is_told_from_a_ur5e() {
    for (model, others) in [("ur7e", "ur5e"), ("ur12e", "ur10e")] {
        let (mut adapter, emulator) = arm(json!({"model": model}));
        adapter.connect().unwrap();
        assert_eq!(adapter.connection_warning(), None);
        let config = dimos_hardware::registry::AdapterConfig {
            hardware_id: "arm".into(),
            address: dimos_hardware::registry::Emulator::address(&emulator),
            dof: 6,
            options: json!({"model": others}),
        };
        let mut other = super::adapter::UrAdapter::new(&config).unwrap();
        other.connect().unwrap();
        let warning = other.connection_warning().unwrap();
        assert!(warning.contains(&format!("set `model: {model}`")), "{warning}");
    }
    for model in ["ur15", "ur18", "ur8long"] {
        let (mut adapter, _emulator) = arm(json!({"model": model}));
        adapter.connect().unwrap();
    }
}

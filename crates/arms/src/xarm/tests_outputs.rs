//! Grippers that two outputs of the tool board open and close.

use serde_json::json;

use super::tests::{read, ready, sent, six, until};
use dimos_core::arm::StopPoint;
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter::{Gripper, ManipulatorAdapter};
use dimos_hardware::registry::Emulator;
use dimos_hardware::sim::faults::{Fault, FaultKind};

/// What the vendor's client sends for the Lite 6's gripper and the vacuum gripper: two outputs, one after the other.
#[test]
fn grippers_that_only_open_and_close_are_two_outputs_that_are_read_back() {
    for (gripper, opens) in [("lite6", [0x0101, 0x0200]), ("vacuum", [0x0100, 0x0202])] {
        let (emulator, mut arm) = ready(json!({ "gripper": gripper }), ControlMode::Position);
        assert_eq!(arm.read_gripper_position(), Ok(None), "nothing is known before the first order");
        emulator.record();
        for (position, order) in [(1.0, opens), (0.0, opens.map(|value| value ^ (value >> 8)))] {
            arm.write_gripper_position(position).unwrap();
            until("the outputs", || {
                read(&mut arm).unwrap();
                arm.read_gripper_position().unwrap() == Some(position)
            });
            let values = sent(&emulator, 127).split_off(if position == 1.0 { 0 } else { 2 });
            let values: Vec<u16> = values
                .iter()
                .map(|data| {
                    assert_eq!(data[..3], [9, 0x0A, 0x15]);
                    f32::from_le_bytes(data[3..7].try_into().unwrap()) as u16
                })
                .collect();
            assert_eq!(values, order, "{gripper} to {position}");
            until("the fingers", || {
                std::thread::sleep(std::time::Duration::from_millis(20));
                emulator.gripper() == position
            });
        }
        let error = arm.write_gripper_position(0.5).unwrap_err().to_string();
        assert!(error.contains("only closes (0) and opens (1)"), "{error}");
    }
}

#[test]
fn a_vacuum_gripper_says_whether_it_holds_something() {
    let (emulator, mut arm) = ready(json!({"gripper": "vacuum"}), ControlMode::Position);
    for (object, holds) in [(0.0, false), (0.2, true)] {
        arm.write_gripper_position(1.0).unwrap();
        until("it is off", || {
            read(&mut arm).unwrap();
            arm.read_gripper_position().unwrap() == Some(1.0) && emulator.gripper() == 1.0
        });
        emulator.inject(Fault { amount: object, ..Fault::new(FaultKind::Object) }).unwrap();
        arm.write_gripper_position(0.0).unwrap();
        until("the switch", || {
            read(&mut arm).unwrap();
            arm.read_gripper_position().unwrap() == Some(0.0) && arm.read_gripper_holds().unwrap() == Some(holds)
        });
    }
}

/// A box without the second port, whose setpoints share the connection with the tool board's requests.
#[test]
fn an_order_is_confirmed_while_setpoints_are_streamed() {
    for gripper in ["lite6", "vacuum"] {
        let options = json!({"gripper": gripper, "sim": {"port_503": false}});
        let (emulator, mut arm) = ready(options, ControlMode::ServoPosition);
        let hold = six(&mut arm);
        emulator.record();
        let mut stream = |position: Option<f64>| {
            if let Some(position) = position {
                arm.write_gripper_position(position).unwrap();
            }
            (0..500).any(|_| {
                read(&mut arm).unwrap();
                let _ = arm.write_joint_positions(&hold, 1.0);
                std::thread::sleep(std::time::Duration::from_millis(4));
                position.is_some() && arm.read_gripper_position().unwrap() == position
            })
        };
        assert!(stream(Some(1.0)) && stream(Some(0.0)), "{gripper}");
        stream(None);
        let asked = sent(&emulator, 128).len();
        stream(None);
        assert_eq!(sent(&emulator, 128).len(), asked, "{gripper}: at rest nothing delays the setpoints");
    }
}

#[test]
fn a_stop_leaves_no_order_half_done() {
    let (emulator, mut arm) = ready(json!({"gripper": "lite6"}), ControlMode::Position);
    emulator.record();
    emulator.slow_down(127, 0.2);
    arm.write_gripper_position(1.0).unwrap();
    until("the first output", || {
        read(&mut arm).unwrap();
        !sent(&emulator, 127).is_empty()
    });
    arm.write_stop(&StopPoint::default()).unwrap();
    until("the second output", || {
        read(&mut arm).unwrap();
        sent(&emulator, 127).len() == 2
    });
}

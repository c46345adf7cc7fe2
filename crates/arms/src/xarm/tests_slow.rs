//! Controllers that take their time, as real ones do: none of it delays setpoints or a stop.

use serde_json::json;

use super::tests::{pair, read, ready, sent, six, until};
use dimos_core::arm::StopPoint;
use dimos_core::joint::ControlMode::ServoPosition;
use dimos_hardware::adapter::{AdapterError, Gripper, ManipulatorAdapter, Stop};

#[test]
fn motors_that_take_long_come_on_and_the_arm_is_ready() {
    for delay in [0.3, 0.6, 1.2] {
        let (emulator, mut arm) = pair(6, json!({"sim": {"slow_replies": [{"register": 11, "delay": delay}]}}));
        arm.connect().unwrap();
        let activated = arm.activate();
        assert!(activated.is_ok() && emulator.enabled(), "{delay} s: {activated:?}");
        let hold = six(&mut arm);
        arm.write_joint_positions(&hold, 1.0).unwrap();
    }
}

#[test]
fn slow_stops_and_clearings_are_confirmed() {
    let slow = json!([{"register": 12, "delay": 0.25}, {"register": 16, "delay": 0.25}]);
    let (_emulator, mut arm) = ready(json!({"sim": {"slow_replies": slow}}), ServoPosition);
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    assert_eq!(arm.write_clear_errors(), Ok(()));
    assert_eq!(arm.activate(), Ok(()));
}

#[test]
fn a_stop_that_is_never_answered_is_confirmed_by_the_reports() {
    let (emulator, mut arm) = ready(json!({}), ServoPosition);
    emulator.record();
    emulator.slow_down(12, 60.0);
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    assert_eq!(sent(&emulator, 12), [[4]]);
}

#[test]
fn a_gripper_telegram_delays_neither_set_points_nor_a_stop() {
    let (emulator, mut arm) = ready(json!({"gripper": "xarm"}), ServoPosition);
    let start = six(&mut arm);
    emulator.record();
    // The next answer of the gripper takes a minute: what would wait for it does not arrive in this test.
    emulator.slow_down(124, 60.0);
    until("a telegram", || {
        read(&mut arm).unwrap();
        !sent(&emulator, 124).is_empty()
    });
    for i in 1..=50 {
        until("room", || {
            read(&mut arm).unwrap();
            match arm.write_joint_positions(&start.map(|q| q + 1e-4 * f64::from(i)), 1.0) {
                Err(AdapterError::Busy) => false,
                result => result.map(|()| true).unwrap(),
            }
        });
        until("the setpoint at the controller", || sent(&emulator, 29).len() == i as usize);
    }
    assert_eq!(arm.write_stop(&StopPoint::default()), Ok(Stop::Confirmed));
    assert!(emulator.trace().iter().all(|request| request.second == (request.register == 124)));
}

#[test]
fn a_gripper_that_answers_slowly_at_first_is_found() {
    let slow = json!([{"register": 124, "delay": 0.5}]);
    let (_emulator, mut arm) = pair(6, json!({"gripper": "xarm", "sim": {"slow_replies": slow}}));
    arm.connect().unwrap();
    assert!(arm.read_gripper_position().unwrap().is_some());
}

#[test]
fn without_port_503_a_gripper_at_rest_is_not_asked_while_set_points_are_streamed() {
    let (emulator, mut arm) = ready(json!({"gripper": "xarm", "sim": {"port_503": false}}), ServoPosition);
    let hold = six(&mut arm);
    let mut stream = |cycles: u32, until: &dyn Fn(Option<f64>) -> bool| {
        (0..cycles).any(|_| {
            read(&mut arm).unwrap();
            let result = arm.write_joint_positions(&hold, 1.0);
            assert!(matches!(result, Ok(()) | Err(AdapterError::Busy)), "{result:?}");
            std::thread::sleep(std::time::Duration::from_millis(4));
            until(arm.read_gripper_position().unwrap())
        })
    };
    stream(2, &|_| false);
    emulator.record();
    stream(100, &|_| false);
    // At most the one that was due before the first setpoint.
    assert!(sent(&emulator, 124).len() <= 1 && sent(&emulator, 29).len() > 50);
    arm.write_gripper_position(0.03).unwrap();
    let mut stream = |cycles: u32, until: &dyn Fn(Option<f64>) -> bool| {
        (0..cycles).any(|_| {
            read(&mut arm).unwrap();
            let _ = arm.write_joint_positions(&hold, 1.0);
            std::thread::sleep(std::time::Duration::from_millis(4));
            until(arm.read_gripper_position().unwrap())
        })
    };
    assert!(stream(5000, &|opening| opening.is_some_and(|opening| (opening - 0.03).abs() < 1e-4)), "it moves");
    assert!((emulator.gripper() - 0.03).abs() < 1e-4);
}

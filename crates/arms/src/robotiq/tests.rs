//! The adapter and its emulator.

use std::time::{Duration, Instant};

use super::adapter::Robotiq2F;
use super::emulator::{self, Server};
use dimos_hardware::adapter::{AdapterError, Gripper};
use dimos_hardware::peripheral::{Condition, Peripheral};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::sim::faults::{Fault, FaultKind};
use serde_json::{Value, json};

fn config(address: &str, options: Value) -> AdapterConfig {
    AdapterConfig { hardware_id: "arm".into(), address: address.into(), dof: 0, options }
}

fn connected(options: Value) -> (Server, Robotiq2F) {
    let server = emulator::start(&config("", options.clone()), &EmulatorAddress::InProcess).unwrap();
    let mut gripper = Robotiq2F::new(&config(&server.address(), options)).unwrap();
    gripper.connect().unwrap();
    (server, gripper)
}

/// Reads until something is so, at most 10 s.
fn until(gripper: &mut Robotiq2F, what: &str, mut is_so: impl FnMut(&mut Robotiq2F) -> bool) {
    let limit = Instant::now() + Duration::from_secs(10);
    while !is_so(gripper) {
        assert!(Instant::now() < limit, "{what}");
        std::thread::sleep(Duration::from_millis(5));
        gripper.read().unwrap();
    }
}

#[test]
fn nothing_moves_before_it_is_homed() {
    for options in [json!({}), json!({"framing": "tcp"})] {
        let (server, mut gripper) = connected(options);
        assert_eq!((gripper.condition(), gripper.read_gripper_position()), (Condition::NotHomed, Ok(None)));
        let before = server.truth();
        let refused = gripper.write_gripper_position(0.01).unwrap_err().to_string();
        assert!(refused.contains("not homed\nhint: `dimos arm gripper arm home`"), "{refused}");
        std::thread::sleep(Duration::from_millis(50));
        assert_eq!(server.truth(), before);
        gripper.home().unwrap();
        assert_eq!(gripper.condition(), Condition::Homing);
        until(&mut gripper, "homed", |gripper| gripper.condition() == Condition::Ready);
        assert_eq!(gripper.read_gripper_position(), Ok(Some(0.0)), "it has closed");
    }
}

#[test]
fn positions_forces_and_objects_are_those_of_the_fingers() {
    let (server, mut gripper) = connected(json!({"sim": {"homed": true}}));
    let at = |server: &Server| server.truth().gripper_position.unwrap();
    gripper.write_gripper_position(0.085).unwrap();
    until(&mut gripper, "open", |gripper| gripper.read_gripper_position() == Ok(Some(0.085)));
    assert!((at(&server) - 0.085).abs() < 4e-4, "the position is in counts");
    gripper.set_gripper_speed(Some(1.0));
    gripper.write_gripper_position_with_force(0.04, 100.0).unwrap();
    until(&mut gripper, "there", |gripper| (gripper.read_gripper_position().unwrap().unwrap() - 0.04).abs() < 4e-4);
    assert!((server.truth().gripper_force.unwrap() - 100.0).abs() < 1.0, "{:?}", server.truth());
    assert_eq!(gripper.read_gripper_holds(), Ok(Some(false)));
    server.with(|fingers, _| fingers.put_object(0.03));
    gripper.write_gripper_position(0.0).unwrap();
    until(&mut gripper, "held", |gripper| gripper.read_gripper_holds() == Ok(Some(true)));
    assert!((at(&server) - 0.03).abs() < 1e-9);
    // A status from before a command says nothing of it.
    gripper.write_gripper_position(0.085).unwrap();
    assert_eq!(gripper.read_gripper_holds(), Ok(None));
    until(&mut gripper, "released", |gripper| gripper.read_gripper_holds() == Ok(Some(false)));
    for wrong in [-0.01, 0.09, f64::NAN] {
        assert!(gripper.write_gripper_position(wrong).is_err(), "{wrong}");
    }
    assert!(gripper.write_gripper_position_with_force(0.05, 300.0).is_err());
}

#[test]
fn a_stop_ends_homing_where_the_fingers_are() {
    let (server, mut gripper) = connected(json!({}));
    gripper.home().unwrap();
    gripper.halt().unwrap();
    let held = server.truth().gripper_position;
    std::thread::sleep(Duration::from_millis(50));
    gripper.read().unwrap();
    assert_eq!((server.truth().gripper_position, gripper.condition()), (held, Condition::NotHomed));
}

#[test]
fn faults_are_named_and_homing_clears_them() {
    let (server, mut gripper) = connected(json!({"sim": {"homed": true}}));
    server.inject(Fault::new(FaultKind::ErrorCode).code(14)).unwrap();
    until(&mut gripper, "the fault", |gripper| gripper.condition() == Condition::Fault(14, "too much current"));
    let refused = gripper.write_gripper_position(0.05).unwrap_err().to_string();
    assert!(refused.contains("fault 14: too much current\nhint: "), "{refused}");
    gripper.home().unwrap();
    until(&mut gripper, "homed", |gripper| gripper.condition() == Condition::Ready);
}

#[test]
fn a_damaged_line_is_survived_and_a_dead_one_is_lost() {
    let (server, mut gripper) = connected(json!({"sim": {"homed": true}}));
    for kind in [FaultKind::Silent, FaultKind::Garbage, FaultKind::Corrupt, FaultKind::Truncated] {
        server.inject(Fault::new(kind)).unwrap();
        assert_eq!(gripper.read(), Ok(()), "{kind:?}");
    }
    // Without power it forgets its activation, and the fingers stay where they are.
    server.inject(Fault::new(FaultKind::PowerLoss).lasting(2.0)).unwrap();
    let lost = (0..20).find_map(|_| gripper.read().err().filter(|_| !gripper.is_connected()));
    assert!(matches!(lost, Some(AdapterError::Timeout(_) | AdapterError::Io(_))), "{lost:?}");
    let limit = Instant::now() + Duration::from_secs(10);
    while gripper.connect().is_err() {
        assert!(Instant::now() < limit);
    }
    assert_eq!(gripper.condition(), Condition::NotHomed);
}

#[test]
fn options_that_cannot_be_are_mistakes_of_the_blueprint() {
    let wrong = |address: &str, options| Robotiq2F::new(&config(address, options)).err().map(|error| error.to_string());
    assert_eq!(wrong("/dev/ttyUSB0", json!({})), None);
    for options in [
        json!({"unit": 0}),
        json!({"force": 5}),
        json!({"speed": 0}),
        json!({"stroke": 0}),
        json!({"closed_count": 40}),
        json!({"framing": "tcp"}),
        json!({"sim": {"faults": [{"kind": "nan"}]}}),
    ] {
        assert!(wrong("/dev/ttyUSB0", options.clone()).is_some(), "{options}");
    }
    assert!(wrong("10.0.0.7", json!({})).is_some());
}

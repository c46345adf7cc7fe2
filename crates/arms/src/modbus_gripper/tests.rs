//! The adapter and its emulator, with the registers of a DH Robotics AG-95, and with a rotary jaw.

use std::time::{Duration, Instant};

use super::adapter::ModbusGripper;
use super::emulator;
use dimos_core::arm::{ForceUnit, GripperUnit};
use dimos_hardware::adapter::{AdapterError, Gripper};
use dimos_hardware::peripheral::{Condition, Peripheral};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use serde_json::{Value, json};

fn config(address: &str, options: &Value) -> AdapterConfig {
    AdapterConfig { hardware_id: "arm".into(), address: address.into(), dof: 0, options: options.clone() }
}

fn ag95() -> Value {
    json!({
        "range": [0, 0.095],
        "position": {"register": 0x0202, "closed": 0, "open": 1000},
        "target": {"register": 0x0103, "closed": 0, "open": 1000},
        "force": {"register": 0x0101, "unit": "%", "range": [20, 100], "counts": [20, 100], "default": 50},
        "holds": {"register": 0x0201, "is": [2]},
        "homed": {"register": 0x0200, "is": [1]},
        "home": [{"register": 0x0100, "value": 1}],
    })
}

fn until(gripper: &mut ModbusGripper, what: &str, mut is_so: impl FnMut(&mut ModbusGripper) -> bool) {
    let limit = Instant::now() + Duration::from_secs(10);
    while !is_so(gripper) {
        assert!(Instant::now() < limit, "{what}");
        std::thread::sleep(Duration::from_millis(5));
        gripper.read().unwrap();
    }
}

fn is_at(position: f64) -> impl FnMut(&mut ModbusGripper) -> bool {
    move |gripper| gripper.read_gripper_position().unwrap().is_some_and(|at| (at - position).abs() < 2e-4)
}

#[test]
fn a_gripper_by_its_registers_is_homed_moves_and_holds() {
    let server = emulator::start(&config("", &ag95()), &EmulatorAddress::InProcess).unwrap();
    let mut gripper = ModbusGripper::new(&config(&server.address(), &ag95())).unwrap();
    gripper.connect().unwrap();
    assert_eq!((gripper.condition(), gripper.read_gripper_position()), (Condition::NotHomed, Ok(None)));
    assert!(gripper.write_gripper_position(0.05).unwrap_err().to_string().contains("not homed"));
    gripper.home().unwrap();
    assert_eq!(gripper.condition(), Condition::Homing);
    until(&mut gripper, "homed", |gripper| gripper.condition() == Condition::Ready);
    gripper.write_gripper_position_with_force(0.08, 30.0).unwrap();
    until(&mut gripper, "there", is_at(0.08));
    assert_eq!(gripper.read_gripper_holds(), Ok(Some(false)));
    server.with(|fingers, _| fingers.put_object(0.04));
    gripper.write_gripper_position(0.0).unwrap();
    until(&mut gripper, "held", |gripper| gripper.read_gripper_holds() == Ok(Some(true)));
    assert_eq!((gripper.get_gripper_force_unit(), gripper.has_gripper_speed()), (ForceUnit::Percent, false));
    assert!(
        gripper.write_gripper_position(0.1).is_err() && gripper.write_gripper_position_with_force(0.0, 10.0).is_err()
    );
}

#[test]
fn a_rotary_jaw_that_closes_at_the_larger_angle_over_tcp() {
    let options = json!({
        "unit": 7, "framing": "tcp", "position_unit": "rad", "range": [1.2, 0.0],
        "position": {"register": 3, "table": "input", "closed": 4000, "open": 100},
        "target": {"register": 10, "closed": 4000, "open": 100},
        "speed": {"register": 11, "counts": [0, 255], "default": 0.5},
        "then": [{"register": 12, "value": 1}],
    });
    let server = emulator::start(&config("", &options), &EmulatorAddress::InProcess).unwrap();
    let mut gripper = ModbusGripper::new(&config(&server.address(), &options)).unwrap();
    gripper.connect().unwrap();
    assert_eq!((gripper.condition(), gripper.get_gripper_unit()), (Condition::Ready, GripperUnit::Radians));
    for angle in [1.2, 0.0, 0.5] {
        gripper.write_gripper_position(angle).unwrap();
        until(&mut gripper, "there", |gripper| {
            gripper.read_gripper_position().unwrap().is_some_and(|at| (at - angle).abs() < 1e-3)
        });
        assert!((server.truth().gripper_position.unwrap() - angle).abs() < 1e-3);
    }
    assert_eq!(gripper.home(), Err(AdapterError::Unsupported));
    // A register that the device lacks is named.
    let mut wrong = options.clone();
    wrong["position"]["register"] = json!(99);
    let mut wrong = ModbusGripper::new(&config(&server.address(), &wrong)).unwrap();
    drop(gripper);
    let refused = wrong.connect().unwrap_err().to_string();
    assert_eq!(refused, "the gripper refused to read register 99: it has no such register (exception 2)");
}

#[test]
fn a_map_that_cannot_be_is_a_mistake_of_the_blueprint() {
    let wrong = |change: fn(&mut Value)| {
        let mut options = ag95();
        change(&mut options);
        ModbusGripper::new(&config("/dev/ttyUSB0", &options)).err().map(|error| error.to_string())
    };
    assert_eq!(wrong(|_| ()), None);
    let missing = wrong(|options| options["target"] = Value::Null).unwrap();
    assert!(missing.contains("`target` is missing\nhint: for example `target: {register"), "{missing}");
    let changes: [fn(&mut Value); 6] = [
        |options| options["range"] = json!([0.1, 0.1]),
        |options| options["position"]["open"] = json!(0),
        |options| options["force"]["default"] = json!(5),
        |options| options["home"] = json!([]),
        |options| options["position_unit"] = json!("on_off"),
        |options| options["unit"] = json!(0),
    ];
    assert!(changes.into_iter().all(|change| wrong(change).is_some()));
}

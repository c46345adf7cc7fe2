//! A force/torque sensor with its own connection: its forces are the arm's, a motion ends at them, and what it does not
//! say any longer is not known.

use dimos::arms::robotiq::ft300;
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use serde_json::{Value, json};

use crate::support::program::{Home, eventually};

const BLUEPRINT: &str = "
name: cell
include: [coordinator-yourarm]
hardware:
  - {hardware_id: arm, force_torque: {adapter_type: robotiq_ft300, address: sim}}
";

fn wrench(home: &Home) -> Value {
    home.dimos("state --json").with(0).json()["arms"][0]["wrench"].clone()
}

#[test]
fn its_forces_end_a_motion_and_a_silent_one_does_too() {
    let options = json!({"sim": {"wrench": [0.0, 0.0, -12.0, 0.0, 0.0, 0.0]}});
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 0, options };
    let sensor = ft300::start(&config, &EmulatorAddress::InProcess).unwrap();
    let home = Home::new();
    home.write("cell.yaml", BLUEPRINT);
    let _run = home.run(&format!("cell.yaml --no-record --set hardware.arm.force_torque.address={}", sensor.address()));
    eventually("its force is the arm's", || wrench(&home)[2] == -12.0);
    let tared = home.dimos("arm tare arm --json").with(0).json();
    assert_eq!(tared["wrench"][2], -12.0, "{tared}");
    eventually("the weight is taken out", || wrench(&home)[2] == 0.0);

    let moving = home.start("move arm 0.4 0 0 0 0 0 --speed 0.1 --until force=5 --json");
    eventually("it moves", || home.status()["tasks"][0]["state"] == "EXECUTING");
    sensor.with(|sensor, _| sensor.wrench[2] = -18.0);
    let ended: Value = serde_json::from_str(moving.wait().with(0).out.trim()).unwrap();
    assert_eq!((&ended["ended_by"], &ended["value"]), (&json!("force"), &json!(6.0)), "{ended}");
    sensor.with(|sensor, _| sensor.wrench[2] = -12.0);
    eventually("nothing presses", || wrench(&home)[2] == 0.0);

    // A tool may press on while its sensor says nothing: the last force is not the present one.
    let moving = home.start("move arm 0 0 0 0 0 0 --speed 0.1 --until force=5");
    eventually("it moves", || home.status()["tasks"][0]["state"] == "EXECUTING");
    sensor.inject(Fault::new(FaultKind::Silent).lasting(3.0)).unwrap();
    eventually("its force is not known", || wrench(&home).is_null());
    assert_eq!(home.status()["arms"][0]["peripherals"][0]["link"], "up", "before the sensor counts as lost");
    let ended = moving.wait().with(1);
    assert!(ended.err.contains("the force of arm is no longer known"), "{}", ended.err);
    home.dimos("move arm 0.1 0 0 0 0 0 --until force=5").with(1).says(&["reports no force at present"]);
    eventually("it is back", || wrench(&home)[2] == 0.0);
}

//! Every row of the table of peripherals passes its suite; blueprints name them, and their mistakes are found there.

use dimos::blueprint::{Loaded, Overrides, load};
use dimos::hardware::conformance::peripheral::{CHECKS, run};
use dimos::hardware::peripheral::Part;
use serde_json::{Value, json};

/// Options that a row needs.
fn options(name: &str) -> Value {
    match name {
        "modbus_gripper" => json!({
            "range": [0, 0.095],
            "position": {"register": 514, "closed": 0, "open": 1000},
            "target": {"register": 259, "closed": 0, "open": 1000},
            "force": {"register": 257, "unit": "%", "range": [20, 100], "counts": [20, 100], "default": 50},
            "holds": {"register": 513, "is": [2]},
            "homed": {"register": 512, "is": [1]},
            "home": [{"register": 256, "value": 1}],
        }),
        _ => json!({}),
    }
}

#[test]
fn every_peripheral_passes_its_suite() {
    let registry = dimos::arms::registry();
    assert!(registry.peripherals().len() >= 3);
    let mut failures = Vec::new();
    std::thread::scope(|scope| {
        let checks = registry.peripherals().iter().flat_map(|row| CHECKS.iter().map(move |check| (row, check)));
        let all: Vec<_> =
            checks.map(|(row, check)| scope.spawn(move || (row.name, run(row, &options(row.name), check)))).collect();
        for one in all {
            if let (name, Err(what)) = one.join().unwrap() {
                failures.push(format!("{name}: {what}"));
            }
        }
    });
    assert!(failures.is_empty(), "{failures:#?}");
    assert!(registry.peripherals().iter().any(|row| row.part == Part::ForceTorque));
}

fn loaded(hardware: &str, overrides: &Overrides) -> Loaded {
    let text = format!(
        "hardware:\n  - {{hardware_id: arm, joints: {{prefix: arm, count: 6}}, {hardware}}}\n\
         tasks: [{{name: traj_arm, type: trajectory, joint_names: {{hardware: arm}}}}]\n"
    );
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("cell.yaml");
    std::fs::write(&path, text).unwrap();
    let found = dimos::blueprint::find(path.to_str().unwrap()).unwrap();
    load(&found, overrides, &dimos::arms::registry())
}

fn mistakes(hardware: &str) -> String {
    loaded(hardware, &Overrides::default()).render(false)
}

#[test]
fn mistakes_in_a_peripheral_are_found_where_they_are() {
    let ur = "adapter_type: ur, address: 192.0.2.7, gripper: ";
    let at = |gripper: &str| mistakes(&format!("{ur}{gripper}"));
    assert_eq!(at("{adapter_type: robotiq_2f85, address: /dev/ttyUSB0, options: {force: 60}}"), "");
    assert_eq!(at("{adapter_type: robotiq_2f85, address: \"ur:192.0.2.7\"}"), "");
    for (gripper, found) in [
        ("{adapter_type: robotik_2f85, address: sim}", "did you mean `robotiq_2f85`"),
        ("{adapter_type: ur, address: sim}", "is an arm, not a gripper"),
        ("{adapter_type: robotiq_ft300, address: sim}", "is a force/torque sensor, not a gripper"),
        ("{adapter_type: robotiq_2f85}", "needs an address"),
        ("{adapter_type: robotiq_2f85, address: ttyUSB0}", "is not an address of"),
        ("{adapter_type: robotiq_2f85, address: sim, options: {force: 5}}", "force is 20 to 235, not 5"),
        ("{adapter_type: robotiq_2f85, address: sim, options: {forze: 50}}", "did you mean `force`"),
        ("{adapter_type: modbus_gripper, address: sim}", "`range` is missing"),
        ("{adapter_type: robotiq_2f85, address: sim, port: 3}", "port"),
    ] {
        let said = at(gripper);
        assert!(said.contains(found), "{gripper}: {said}");
    }
    let both = "adapter_type: xarm, address: 192.0.2.7, options: {gripper: xarm}, \
                gripper: {adapter_type: robotiq_2f85, address: sim}";
    let said = mistakes(both);
    assert!(
        said.contains("the arm has a gripper by its own option") && said.contains("`options.gripper: none`"),
        "{said}"
    );
    let same = "adapter_type: ur, address: 192.0.2.7, gripper: {adapter_type: robotiq_2f85, address: /dev/ttyUSB0}, \
                force_torque: {adapter_type: robotiq_ft300, address: /dev/ttyUSB0@115200}";
    let said = mistakes(same);
    assert!(said.contains("two devices have the address"), "{said}");
}

#[test]
fn sim_simulates_the_peripherals_too() {
    let hardware = "adapter_type: ur, address: 192.0.2.7, gripper: {adapter_type: robotiq_2f85, address: /dev/ttyUSB0}";
    let real = loaded(hardware, &Overrides::default()).blueprint.unwrap();
    assert!(!real.arms[0].peripherals[0].is_simulated() && real.arms[0].has_gripper());
    let sim = loaded(hardware, &Overrides { sim: true, ..Overrides::default() }).blueprint.unwrap();
    assert!(sim.arms[0].simulated && sim.arms[0].peripherals[0].is_simulated());
    let set = vec!["hardware.arm.gripper.address=sim".to_owned()];
    let only = loaded(hardware, &Overrides { set, ..Overrides::default() }).blueprint.unwrap();
    assert!(!only.arms[0].simulated && only.arms[0].peripherals[0].is_simulated());
}

//! Work on the emulated servos outside a run: calibration, settings, numbers.

use std::path::Path;

use serde_json::json;

use super::adapter::So101Adapter;
use super::calibration::Calibration;
use super::emulator::{Servos, start};
use super::{DOF, SPEC};
use dimos_hardware::adapter::{AdapterError, ManipulatorAdapter};
use dimos_hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos_hardware::service::Service;
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::serial_server::SerialServer;

/// The emulator, and a configuration that finds it.
fn line(options: serde_json::Value) -> (AdapterConfig, SerialServer<Servos>) {
    let mut config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: DOF, options };
    let servos = start(&config, &EmulatorAddress::InProcess).unwrap();
    config.address = servos.address();
    (config, servos)
}

fn open(config: &AdapterConfig) -> Box<dyn Service> {
    SPEC.service.unwrap()(config).unwrap()
}

/// Saves a calibration with these ranges, and writes it to the servos.
fn calibrate(arm: &mut dyn Service, ranges: &[(i32, i32)], path: &Path) -> Result<Vec<&'static str>, AdapterError> {
    std::fs::write(path, arm.calibration(ranges).unwrap()).unwrap();
    arm.write_calibration(path)
}

fn push(servos: &dyn Emulator, joint: usize, amount: f64) {
    servos.inject(Fault { joint, amount, ..Fault::new(FaultKind::Pushed) }).unwrap();
}

/// Moves each joint by hand to both ends of its range, and away from its end. Returns the ranges.
fn lead(arm: &mut dyn Service, servos: &dyn Emulator) -> Vec<(i32, i32)> {
    let mut ranges = Vec::new();
    for joint in 0..6 {
        let mut ends = [-10.0, 10.0].map(|amount| {
            push(servos, joint + 1, amount);
            // A fault of a joint is played with the next request.
            arm.positions().unwrap();
            arm.positions().unwrap()[joint]
        });
        ends.sort();
        ranges.push((ends[0], ends[1]));
        push(servos, joint + 1, -1.0);
        arm.positions().unwrap();
    }
    ranges
}

#[test]
fn a_calibration_is_that_of_lerobot_and_outlives_a_power_loss() {
    let (config, servos) = line(json!({"sim": {"initial_positions": [0.1, -0.3, 0.2, 0.0, 0.5, 0.4]}}));
    let mut arm = open(&config);
    assert!(arm.identify().unwrap().starts_with("SO-101: 6 servos STS3215, firmware 3.10"));
    assert_eq!(arm.powered(), Ok(vec![]));
    arm.take_middle().unwrap();
    assert_eq!(arm.positions(), Ok(vec![2047; 6]));
    let mut ranges = lead(&mut *arm, &servos);
    ranges[4] = (0, 4095);
    // Until now the servos are as they were.
    assert_eq!(servos.with(|servos, _| servos.stored(0, 31)), 0);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("arm.json");
    calibrate(&mut *arm, &ranges, &path).unwrap();
    let file = Calibration::read(&path, 1).unwrap();
    // The middle of the travel, 796 to 3300, reads 2047, wherever the pose at the beginning was.
    assert_eq!((file[0].homing_offset, file[0].range_min, file[0].range_max), (1, 795, 3299));
    for servo in &file[..4] {
        assert!(((servo.range_min + servo.range_max) / 2 - 2047).abs() <= 1, "{servo:?}");
    }
    assert_eq!((file[4].range_min, file[4].range_max), (0, 4095));
    drop(arm);
    let options = json!({"calibration": path});
    let connect =
        || So101Adapter::new(&AdapterConfig { options: options.clone(), ..config.clone() }).unwrap().connect();
    assert_eq!(connect(), Ok(()));
    servos.inject(Fault::new(FaultKind::PowerLoss).lasting(0.05)).unwrap();
    let began = std::time::Instant::now();
    while let Err(error) = connect() {
        // A servo that was locked during its calibration has lost it.
        assert!(matches!(error, AdapterError::Timeout(_)), "{error}");
        assert!(began.elapsed().as_secs() < 10, "{error}");
    }
    assert_eq!(servos.with(|servos, _| servos.byte(0, 55)), 1, "locked");
}

#[test]
fn joints_move_by_the_offset_and_range_of_their_calibration() {
    let (config, servos) = line(json!({"sim": {"initial_positions": [0.1, -0.3, 0.2, 0.0, 0.5, 0.4]}}));
    let mut arm = open(&config);
    arm.take_middle().unwrap();
    let mut ranges = lead(&mut *arm, &servos);
    ranges[4] = (0, 4095);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("arm.json");
    calibrate(&mut *arm, &ranges, &path).unwrap();
    drop(arm);
    let mut adapter = So101Adapter::new(&AdapterConfig { options: json!({"calibration": path}), ..config }).unwrap();
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    adapter.set_control_mode(dimos_core::joint::ControlMode::Position).unwrap();
    let goal = [0.3, 0.2, -0.2, 0.1, -0.4];
    adapter.write_joint_positions(&goal, 1.0).unwrap();
    let began = std::time::Instant::now();
    loop {
        let mut found = [0.0; DOF];
        adapter.read_joint_positions(&mut found).unwrap();
        if found.iter().zip(goal).all(|(a, b)| (a - b).abs() < 2e-3) {
            break;
        }
        assert!(began.elapsed().as_secs() < 10, "{found:?}");
    }
    // The middle of the range −1.92 to 1.92 rad is the zero of shoulder_pan; wrist_roll's is where it was calibrated.
    let truth = servos.true_positions().unwrap();
    assert!((truth[0] - 0.3).abs() < 4e-3 && (truth[4] - (0.5 - 0.4)).abs() < 4e-3, "{truth:?}");
}

#[test]
fn a_calibration_is_refused_while_a_motor_is_on_and_restored_from_its_file() {
    let (config, servos) = line(json!({}));
    let mut arm = open(&config);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("arm.json");
    arm.take_middle().unwrap();
    let ranges = [(700, 3300), (700, 3300), (900, 3100), (900, 3100), (0, 4095), (1900, 3200)];
    assert_eq!(calibrate(&mut *arm, &ranges, &path).unwrap().len(), 6);
    let text = std::fs::read_to_string(&path).unwrap();
    assert_eq!(arm.write_calibration(&path), Ok(vec![]), "nothing is written twice");
    std::fs::write(&path, text.replace("3147", "3050")).unwrap();
    drop(arm);
    let mut adapter = So101Adapter::new(&config).unwrap();
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    adapter.disconnect();
    let mut arm = open(&config);
    assert_eq!(arm.powered().unwrap().len(), 6);
    let refused = arm.write_calibration(&path).unwrap_err();
    assert!(matches!(&refused, AdapterError::Rejected(what) if what.starts_with("motors are on: shoulder_pan, ")));
    assert!(matches!(arm.write_settings(), Err(AdapterError::Rejected(_))));
    arm.release().unwrap();
    assert_eq!(arm.powered(), Ok(vec![]));
    assert_eq!(arm.write_calibration(&path), Ok(vec!["elbow_flex", "wrist_flex"]));
    assert_eq!(servos.with(|servos, _| servos.stored(2, 11)), 3050u16.to_le_bytes()[0]);
    assert!(arm.write_calibration(Path::new("/no/such/file")).is_err());
}

#[test]
fn settings_of_the_factory_are_listed_and_written_once() {
    let (config, servos) = line(json!({"sim": {"factory": true}}));
    let mut arm = open(&config);
    let found = arm.settings().unwrap();
    // The P coefficient of six servos, and three limits of the gripper.
    assert_eq!(found.len(), 9);
    let texts: Vec<_> = found.iter().map(|s| format!("{} {} {} {}", s.motor, s.name, s.found, s.wanted)).collect();
    assert!(texts.contains(&"elbow_flex P coefficient 32 16".into()), "{texts:?}");
    assert!(texts.contains(&"gripper maximum torque [0.1 %] 1000 500".into()), "{texts:?}");
    // Without being asked, a connection writes nothing.
    drop(arm);
    So101Adapter::new(&config).unwrap().connect().unwrap();
    assert_eq!(servos.with(|servos, _| servos.stored(5, 36)), 80);
    let options = json!({"write_settings": true});
    So101Adapter::new(&AdapterConfig { options, ..config.clone() }).unwrap().connect().unwrap();
    let mut arm = open(&config);
    assert_eq!(arm.settings(), Ok(vec![]));
    assert_eq!(servos.with(|servos, _| (servos.stored(5, 36), servos.stored(0, 21), servos.byte(0, 55))), (25, 16, 1));
    // Another mode gives goals another meaning: not connected.
    servos.with(|servos, _| servos.execute(3, 0x03, &[33, 1], &mut Vec::new()));
    drop(arm);
    let error = So101Adapter::new(&config).unwrap().connect().unwrap_err().to_string();
    let hint = format!("hint: dimos arm configure so101 --address {}@1000000", servos.path());
    assert!(error.contains("elbow_flex is in control mode 1, not 0 (position)\n") && error.ends_with(&hint), "{error}");
}

#[test]
fn new_servos_get_their_numbers_one_at_a_time() {
    let (config, servos) = line(json!({"sim": {"ids": [1, 1, 0, 0, 0, 0]}}));
    let mut arm = open(&config);
    let several = arm.find_single().unwrap_err().to_string();
    assert!(several.starts_with("2 servos answer: [1, 1]\nhint: leave one connected"), "{several}");
    for servo in 0..6 {
        servos.with(|servos, _| (0..6).for_each(|other| servos.plug(other, u8::from(other == servo))));
        let single = arm.find_single().unwrap();
        assert_eq!((single.id, single.baud), (1, 1_000_000));
        let motor = arm.motors()[servo];
        arm.assign(&single, &motor).unwrap();
        assert_eq!(servos.with(|servos, _| (servos.stored(servo, 5), servos.byte(servo, 55))), (motor.id, 1));
    }
    servos.with(|servos, _| (0..6).for_each(|servo| servos.plug(servo, 0)));
    let error = arm.find_single().unwrap_err().to_string();
    assert!(error.starts_with("no servo answers at /dev/pts/"), "{error}");
    servos.with(|servos, _| (0..6).for_each(|servo| servos.plug(servo, servo as u8 + 1)));
    drop(arm);
    assert!(open(&config).identify().is_ok());
}

#[test]
fn a_calibration_that_failed_halfway_is_written_again_from_its_file() {
    let (config, servos) = line(json!({"sim": {"initial_positions": [0.1, -0.3, 0.2, 0.0, 0.5, 0.4]}}));
    let mut arm = open(&config);
    arm.take_middle().unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("arm.json");
    let ranges = [(700, 3300), (700, 3300), (900, 3100), (900, 3100), (0, 4095), (1900, 3200)];
    servos.with(|servos, _| servos.wear_out(2, true));
    let error = calibrate(&mut *arm, &ranges, &path).unwrap_err().to_string();
    assert!(error.starts_with("servo 3 (elbow_flex) keeps [0, 0] in register 31 instead of ["), "{error}");
    let offset = |servo| servos.with(|servos, _| servos.stored(servo, 31));
    assert!(offset(0) != 0 && offset(3) == 0, "half written");
    servos.with(|servos, _| servos.wear_out(2, false));
    let written = arm.write_calibration(&path).unwrap();
    assert_eq!(written, ["elbow_flex", "wrist_flex", "wrist_roll", "gripper"]);
    drop(arm);
    let options = json!({"calibration": path});
    assert_eq!(So101Adapter::new(&AdapterConfig { options, ..config }).unwrap().connect(), Ok(()));
}

#[test]
fn a_servo_gets_the_rate_of_the_address() {
    let (config, servos) = line(json!({"sim": {"ids": [0, 0, 0, 0, 0, 1]}}));
    let at = |rate: u32| AdapterConfig { address: format!("{}@{rate}", servos.path()), ..config.clone() };
    let mut arm = open(&at(500_000));
    let (single, gripper) = (arm.find_single().unwrap(), arm.motors()[5]);
    arm.assign(&single, &gripper).unwrap();
    assert_eq!(servos.with(|servos, _| (servos.stored(5, 5), servos.stored(5, 6))), (6, 1));
    drop(arm);
    let mut arm = open(&at(9600));
    let error = arm.find_single().unwrap_err().to_string();
    assert!(error.starts_with("the servos have no rate of 9600 bit/s\nhint: their rates: 1000000, "), "{error}");
}

#[test]
fn a_port_that_cannot_be_opened_is_named_when_a_motor_is_searched() {
    let (config, servos) = line(json!({"sim": {"ids": [0, 0, 0, 0, 0, 1]}}));
    let mut arm = open(&config);
    drop(servos);
    let error = arm.find_single().unwrap_err().to_string();
    assert!(error.starts_with(&format!("cannot open serial device {}", config.address)), "{error}");
}

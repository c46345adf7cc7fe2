//! LeRobot's own bus: it calibrates, configures and moves the emulated servos of an SO-101; its packets are ours, and
//! each program takes the other's calibration.

use std::path::Path;
use std::process::{Command, Stdio};

use dimos::arms::so101::SPEC;
use dimos::arms::so101::adapter::So101Adapter;
use dimos::arms::so101::calibration::{Calibration, NAMES};
use dimos::arms::so101::emulator::{Servos, start};
use dimos::arms::so101::protocol::{Instruction, MAX_INSTRUCTION, encode, with_sign};
use dimos::hardware::adapter::ManipulatorAdapter;
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::serial_server::SerialServer;
use serde_json::{Value, json};

use crate::support::python::python_with;

/// Runs `tests/python/lerobot_bus.py`; `None` where LeRobot is not installed.
fn lerobot(arguments: &[&str]) -> Option<String> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python/lerobot_bus.py");
    let mut command = Command::new(python_with(&["lerobot", "scservo_sdk", "deepdiff", "draccus", "tqdm"])?);
    let output = command.arg(script).args(arguments).env("PYTHONDONTWRITEBYTECODE", "1").stdin(Stdio::null()).output();
    let output = output.unwrap();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{out}\n{err}");
    Some(out.into_owned())
}

fn line(sim: Value) -> (AdapterConfig, SerialServer<Servos>) {
    let options = json!({ "sim": sim });
    let mut config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 5, options };
    let servos = start(&config, &EmulatorAddress::Pty).unwrap();
    config.address = servos.address();
    (config, servos)
}

#[test]
fn lerobots_bus_uses_the_emulated_servos_and_its_packets_and_calibration_are_ours() {
    let (config, servos) =
        line(json!({"factory": true, "initial_positions": [0.1, -0.3, 0.2, 0.0, 0.5, 0.4], "lag": 0.0}));
    let folder = tempfile::tempdir().unwrap();
    let (theirs, ours) = (folder.path().join("theirs.json"), folder.path().join("ours.json"));
    let Some(sent) = lerobot(&["use", &config.address, theirs.to_str().unwrap()]) else { return };

    // The packets that both send.
    let file = Calibration::read(&theirs, 1).unwrap();
    assert_eq!(file[0].homing_offset, 66, "0.1 rad is 65 counts from 2048, and the middle reads 2047");
    let offset = with_sign(file[1].homing_offset, 11).to_le_bytes();
    let range = (file[1].range_max as u16).to_le_bytes();
    let goals: Vec<u8> =
        servos.with(|servos, _| (0..6).flat_map(|i| [servos.byte(i, 42), servos.byte(i, 43)]).collect());
    let ours_of = |instruction: Instruction<'_>| {
        let mut frame = [0; MAX_INSTRUCTION];
        encode(instruction, &mut frame).iter().map(|byte| format!("{byte:02x}")).collect::<String>()
    };
    for instruction in [
        Instruction::Ping(1),
        Instruction::Read(1, 3, 2),
        Instruction::Read(2, 31, 2),
        Instruction::Write(2, 31, &offset),
        Instruction::Write(2, 11, &range),
        Instruction::Write(2, 40, &[0]),
        Instruction::Write(2, 55, &[0]),
        Instruction::Write(6, 16, &500u16.to_le_bytes()),
        Instruction::ReadAll(1, 56, 2),
        Instruction::WriteAll(1, 42, 2, &goals),
    ] {
        let ours = ours_of(instruction);
        assert!(sent.lines().any(|line| line == ours), "{instruction:?}: {ours} is not among\n{sent}");
    }

    // Its settings are those that ours wants, and its calibration is taken.
    let mut service = SPEC.service.unwrap()(&config).unwrap();
    assert_eq!(service.settings(), Ok(vec![]));
    assert_eq!(service.powered(), Ok(vec![]), "it has switched them off");
    drop(service);
    let options = json!({"calibration": theirs});
    let mut adapter = So101Adapter::new(&AdapterConfig { options, ..config.clone() }).unwrap();
    adapter.connect().unwrap();
    drop(adapter);

    // It takes ours.
    let mut service = SPEC.service.unwrap()(&config).unwrap();
    service.take_middle().unwrap();
    let ranges = [(700, 3300), (800, 3200), (900, 3100), (1000, 3000), (0, 4095), (1900, 3100)];
    std::fs::write(&ours, service.calibration(&ranges).unwrap()).unwrap();
    service.write_calibration(&ours).unwrap();
    drop(service);
    assert_eq!(lerobot(&["calibrated", &config.address, ours.to_str().unwrap()]).as_deref(), Some("as it says\n"));
}

#[test]
fn lerobots_bus_uses_the_second_arm_of_a_line() {
    let (config, servos) = line(json!({"ids": (1..=12).collect::<Vec<u8>>(), "lag": 0.0}));
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("second.json");
    let Some(sent) = lerobot(&["use", &config.address, file.to_str().unwrap(), "7"]) else { return };
    let mut frame = [0; MAX_INSTRUCTION];
    let ours = encode(Instruction::ReadAll(7, 56, 2), &mut frame);
    let ours = ours.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    assert!(sent.lines().any(|line| line == ours), "{ours} is not among\n{sent}");
    servos.with(|servos, _| {
        assert!((0..6).all(|servo| servos.byte(servo, 40) == 0), "the first arm's motors stay off");
        assert!((0..6).all(|servo| servos.stored(servo, 31) == 0), "and it has its own offsets");
    });
    // Both arms on that line, the second one with LeRobot's calibration.
    let arm = |options: Value| So101Adapter::new(&AdapterConfig { options, ..config.clone() }).unwrap();
    let mut arms = [arm(json!({})), arm(json!({"first_id": 7, "calibration": file}))];
    arms.iter_mut().for_each(|arm| arm.connect().unwrap());
}

#[test]
fn lerobots_bus_gives_a_new_servo_its_number() {
    let (config, servos) = line(json!({"ids": [0, 0, 0, 0, 0, 1], "factory": true}));
    let Some(said) = lerobot(&["setup", &config.address, NAMES[5]]) else { return };
    assert_eq!(said, "as it says\n");
    assert_eq!(servos.with(|servos, _| (servos.stored(5, 5), servos.stored(5, 6))), (6, 0));
}

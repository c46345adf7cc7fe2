//! Libraries of others for the gripper and its protocol: two drivers of Robotiq's grippers use the emulated one, and
//! pymodbus's server is the device of the adapter.

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use dimos::arms::robotiq::adapter::Robotiq2F;
use dimos::arms::robotiq::emulator;
use dimos::hardware::adapter::Gripper;
use dimos::hardware::peripheral::{Condition, Peripheral};
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use serde_json::{Value, json};

use crate::support::python::python_with;

fn config(address: &str, options: Value) -> AdapterConfig {
    AdapterConfig { hardware_id: "arm".into(), address: address.into(), dof: 0, options }
}

fn script(name: &str, modules: &[&str]) -> Option<Command> {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/python").join(name);
    let mut command = Command::new(python_with(modules)?);
    command.arg(script).env("PYTHONDONTWRITEBYTECODE", "1").stdin(Stdio::null());
    Some(command)
}

/// Lets a library use the emulated gripper.
fn used_by(library: &str, options: Value) {
    let Some(mut command) = script("robotiq_libraries.py", &[library]) else { return };
    let gripper = emulator::start(&config("", options), &EmulatorAddress::InProcess).unwrap();
    let address = gripper.address();
    let output = command.arg(library).arg(address.trim_start_matches("tcp:")).output().unwrap();
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success() && out.ends_with("all is as it says\n"), "{out}\n{err}");
}

#[test]
fn pyrobotiqgripper_uses_the_emulated_gripper() {
    used_by("pyrobotiqgripper", json!({}));
}

#[test]
fn robotiq2f_uses_the_emulated_gripper() {
    used_by("robotiq2f", json!({}));
}

#[test]
fn pymodbus_uses_the_emulated_gripper_over_tcp() {
    used_by("pymodbus", json!({"framing": "tcp"}));
}

/// A server of pymodbus; it ends with this value.
struct Server(Child, String);

impl Server {
    fn start(kind: &str) -> Option<Self> {
        let mut command = script("modbus_gripper.py", &["pymodbus", "serial"])?;
        let mut server = command.arg(kind).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
        let mut address = String::new();
        BufReader::new(server.stdout.take().unwrap()).read_line(&mut address).unwrap();
        Some(Self(server, address.trim().to_owned()))
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
fn the_adapter_uses_the_registers_of_pymodbus() {
    for kind in ["tcp", "rtu"] {
        let Some(server) = Server::start(kind) else { return };
        let mut gripper = Robotiq2F::new(&config(&server.1, json!({}))).unwrap();
        let limit = Instant::now() + Duration::from_secs(20);
        // It prints its address before it listens.
        while let Err(error) = gripper.connect() {
            assert!(Instant::now() < limit, "{kind}: {error}");
            std::thread::sleep(Duration::from_millis(50));
        }
        assert_eq!(gripper.condition(), Condition::NotHomed, "{kind}");
        gripper.home().unwrap();
        gripper.read().unwrap();
        assert_eq!(gripper.condition(), Condition::Ready, "{kind}");
        for opening in [0.085, 0.05] {
            gripper.write_gripper_position(opening).unwrap();
            gripper.read().unwrap();
            let at = gripper.read_gripper_position().unwrap().unwrap();
            assert!((at - opening).abs() < 3e-4, "{kind}: {at}");
            assert_eq!(gripper.read_gripper_holds(), Ok(Some(false)));
        }
        gripper.write_gripper_position_with_force(0.0, 40.0).unwrap();
        gripper.read().unwrap();
        assert_eq!(gripper.read_gripper_holds(), Ok(Some(true)), "{kind}");
        assert!((gripper.read_gripper_position().unwrap().unwrap() - 0.0487).abs() < 3e-4);
    }
}

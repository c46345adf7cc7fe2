//! A device at an arm's tool flange, behind the arm's RS-485: it is reached like one at a serial line of this computer.
//! The arms are emulated, the device is one that speaks Modbus RTU.

use std::time::{Duration, Instant};

use dimos::arms::robotiq;
use dimos::arms::robotiq::adapter::Robotiq2F;
use dimos::arms::robotiq::emulator::{AtTool, Fingers};
use dimos::arms::ur::adapter::UrAdapter;
use dimos::arms::ur::emulator::UrEmulator;
use dimos::arms::xarm::emulator::XArmEmulator;
use dimos::clock::{Clock, MonotonicClock};
use dimos::hardware::adapter::{AdapterError, Gripper, ManipulatorAdapter};
use dimos::hardware::peripheral::{Condition, Peripheral};
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::tool_device::ToolDevice;
use dimos::hardware::transport::Scan;
use dimos::hardware::transport::line::{Line, LineAddress};
use dimos::hardware::transport::modbus::Framing;
use dimos::hardware::transport::request_reply::{RequestReply, Retry};
use serde_json::{Value, json};

const TIMEOUT: Duration = Duration::from_secs(2);
const REPLY: Retry = Retry { each: Duration::from_millis(300), times: 2 };

/// The checksum of Modbus RTU, by its definition: division of the bits by x^16 + x^15 + x^2 + 1, the lowest first.
fn check_sum(bytes: &[u8]) -> [u8; 2] {
    let mut rest = 0xFFFF_u16;
    for bit in bytes.iter().flat_map(|byte| (0..8).map(move |i| u16::from(byte >> i & 1))) {
        let carry = (rest & 1) ^ bit;
        rest = rest >> 1 ^ if carry == 1 { 0xA001 } else { 0 };
    }
    rest.to_le_bytes()
}

fn telegram(bytes: &[u8]) -> Vec<u8> {
    [bytes, &check_sum(bytes)].concat()
}

/// A sensor, number 5 on its bus: register n has the value 100 + n.
struct Sensor;

impl ToolDevice for Sensor {
    fn exchange(&mut self, bytes: &[u8], answer: &mut Vec<u8>) {
        let Some((asked @ &[5, 3, 0, register, 0, 1], sum)) = bytes.split_last_chunk::<2>() else { return };
        if check_sum(asked) == *sum {
            answer.extend(telegram(&[5, 3, 2, 0, 100 + register]));
        }
    }
}

/// Reads a register as an adapter of the kit does.
fn read(line: &mut RequestReply<Line>, register: u8) -> Result<u16, AdapterError> {
    line.request(&telegram(&[5, 3, 0, register, 0, 1]), REPLY, |bytes| match bytes {
        [5, 3, 2, high, low, ..] if bytes.len() >= 7 => Scan::Take(7, u16::from_be_bytes([*high, *low])),
        [5, ..] => Scan::More,
        _ => Scan::Skip(1),
    })
}

fn open(address: &str) -> Result<RequestReply<Line>, AdapterError> {
    let address = LineAddress::parse(address, 115_200).unwrap();
    let mut line = RequestReply::half_duplex(false);
    line.open(Line::connect("sensor", &address, TIMEOUT)?);
    Ok(line)
}

fn config(dof: usize, address: &str, options: Value) -> AdapterConfig {
    AdapterConfig { hardware_id: "arm".into(), address: address.into(), dof, options }
}

#[test]
fn addresses_of_lines() {
    let full = |text| LineAddress::parse(text, 115_200).map(|address| address.to_string());
    assert_eq!(full("/dev/ttyUSB0"), Ok("/dev/ttyUSB0@115200".into()));
    assert_eq!(full("/dev/serial/by-path/pci-0:2"), Ok("/dev/serial/by-path/pci-0:2@115200".into()));
    assert_eq!(full("tcp:10.0.0.7:4001"), Ok("tcp:10.0.0.7:4001".into()));
    assert_eq!(full("ur:10.0.0.7"), Ok("ur:10.0.0.7:54321".into()));
    assert_eq!(full("xarm:10.0.0.7"), Ok("xarm:10.0.0.7:503@115200".into()));
    assert_eq!(full("xarm:10.0.0.7:502@2000000"), Ok("xarm:10.0.0.7:502@2000000".into()));
    for bad in ["tcp:10.0.0.7", "ur:10.0.0.7@9600", "xarm:10.0.0.7@fast", "10.0.0.7:4001", "ttyUSB0", "xarm:", ""] {
        assert!(full(bad).is_err(), "{bad:?}: {:?}", full(bad));
    }
}

#[test]
fn a_device_at_the_tool_of_an_xarm_answers() {
    let options = config(6, "", json!({}));
    let emulator = XArmEmulator::start(&options, &EmulatorAddress::InProcess).unwrap();
    let control: u16 = emulator.address().split(':').nth(1).unwrap().parse().unwrap();
    let tool = format!("xarm:127.0.0.1:{}", control + 1);
    let refused = open(&tool).unwrap_err().to_string();
    assert!(refused.contains("the tool's line runs at 2000000 bit/s, not 115200 bit/s\nhint: "), "{refused}");
    let mut line = open(&format!("{tool}@2000000")).unwrap();
    let silent = read(&mut line, 7);
    assert!(matches!(silent, Err(AdapterError::Timeout(_))), "nothing is there: {silent:?}");
    let mut line = open(&format!("{tool}@2000000")).unwrap();
    emulator.fit_tool(Sensor, 115_200);
    assert!(matches!(read(&mut line, 7), Err(AdapterError::Timeout(_))), "the device runs at another rate");
    let mut line = open(&format!("{tool}@2000000")).unwrap();
    emulator.fit_tool(Sensor, 2_000_000);
    for register in 0..100 {
        assert_eq!(read(&mut line, register), Ok(100 + u16::from(register)));
    }
    drop(emulator);
    assert!(read(&mut line, 1).is_err());
}

#[test]
fn a_device_at_the_tool_of_a_ur_answers_once_the_arm_has_set_up_its_line() {
    let options = json!({"tool_line": {"voltage": 24, "baud": 57600}});
    let emulator = UrEmulator::start(&config(6, "", options.clone()), &EmulatorAddress::InProcess).unwrap();
    emulator.fit_tool(Sensor, 57_600);
    let tool = format!("ur:{}", emulator.tool_line().unwrap());
    let mut line = open(&tool).unwrap();
    assert!(matches!(read(&mut line, 7), Err(AdapterError::Timeout(_))), "the line is not set up");
    let mut arm = UrAdapter::new(&config(6, &emulator.address(), options)).unwrap();
    arm.connect().unwrap();
    arm.activate().unwrap();
    for register in 0..100 {
        assert_eq!(read(&mut line, register), Ok(100 + u16::from(register)));
    }
    // Others read the line beside.
    assert_eq!(read(&mut open(&tool).unwrap(), 9), Ok(109));
}

#[test]
fn settings_that_a_tool_does_not_have_are_mistakes_of_the_blueprint() {
    let wrong = |options: Value| UrAdapter::new(&config(6, "127.0.0.1", options)).err().map(|error| error.to_string());
    let line = |option: &str, value: Value| json!({"tool_line": {option: value}});
    assert_eq!(wrong(json!({"tool_line": {}})), None);
    for options in [line("voltage", json!(5)), line("baud", json!(1200)), line("parity", json!(3))] {
        assert!(wrong(options.clone()).is_some(), "{options}");
    }
    let cb3 = wrong(json!({"model": "ur5", "tool_line": {}})).unwrap();
    assert!(cb3.contains("has no RS-485 at its tool"), "{cb3}");
}

/// Homes and closes a gripper at `address`.
fn grips(address: &str) -> Result<(), AdapterError> {
    let mut gripper = Robotiq2F::new(&config(0, address, json!({})))?;
    gripper.connect()?;
    gripper.home()?;
    let limit = Instant::now() + Duration::from_secs(20);
    let until = |gripper: &mut Robotiq2F, is_so: fn(&mut Robotiq2F) -> bool| {
        while !is_so(gripper) {
            assert!(Instant::now() < limit, "{address}");
            gripper.read()?;
        }
        Ok::<(), AdapterError>(())
    };
    until(&mut gripper, |gripper| gripper.condition() == Condition::Ready)?;
    gripper.write_gripper_position(0.05)?;
    until(&mut gripper, |gripper| matches!(gripper.read_gripper_position(), Ok(Some(at)) if (at - 0.05).abs() < 4e-4))
}

#[test]
fn a_gripper_at_the_tool_of_either_arm_is_reached_by_its_address() {
    let gripper = || AtTool(Fingers::new(&robotiq::Options::default(), Framing::Rtu), || MonotonicClock.now());
    let xarm = XArmEmulator::start(&config(6, "", json!({})), &EmulatorAddress::InProcess).unwrap();
    xarm.fit_tool(gripper(), 2_000_000);
    let control: u16 = xarm.address().split(':').nth(1).unwrap().parse().unwrap();
    grips(&format!("xarm:127.0.0.1:{}@2000000", control + 1)).unwrap();

    let options = json!({"tool_line": {"voltage": 24}});
    let ur = UrEmulator::start(&config(6, "", options.clone()), &EmulatorAddress::InProcess).unwrap();
    ur.fit_tool(gripper(), 115_200);
    let address = format!("ur:{}", ur.tool_line().unwrap());
    assert!(Robotiq2F::new(&config(0, &address, json!({}))).unwrap().waits_for_arm());
    assert!(matches!(grips(&address), Err(AdapterError::Timeout(_))), "the arm is not enabled");
    let mut arm = UrAdapter::new(&config(6, &ur.address(), options)).unwrap();
    arm.connect().unwrap();
    arm.activate().unwrap();
    grips(&address).unwrap();
}

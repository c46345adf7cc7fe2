//! Adapter rows for tests about blueprints: they say what they can do, and do nothing.

use dimos::hardware::adapter::AdapterError;
use dimos::hardware::check::Checked;
use dimos::hardware::registry::{AdapterSpec, AddressForm, Level, OptionsSpec, Registry, Teach};
use dimos::joint::{ControlMode, JointLimits};
use schemars::JsonSchema;
use serde::Deserialize;

#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
#[allow(dead_code, reason = "shared by test programs that use parts of it")]
struct NetOptions {
    /// How long to wait for an answer [s].
    timeout: f64,
    /// What is at the flange.
    tool: Tool,
    /// Steps.
    steps: Vec<u8>,
}

#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
enum Tool {
    #[default]
    None,
    Gripper,
}

#[derive(Debug, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct NoOptions {}

fn host(text: &str) -> Result<String, String> {
    let (host, port) = text.split_once(':').unwrap_or((text, "1"));
    match port.parse::<u16>() {
        _ if host.is_empty() => Err("the host is missing".to_owned()),
        _ if host.contains(char::is_whitespace) => Err("a host has no spaces".to_owned()),
        Err(_) => Err(format!("{port:?} is no port number")),
        Ok(port) => Ok(format!("{host}:{port}")),
    }
}

const NOT_HERE: &str = "this adapter exists for tests about blueprints only";

/// A network arm with 6 joints and an emulator that is never started.
pub const YOURARM: AdapterSpec = AdapterSpec {
    name: "yourarm",
    about: "a network arm",
    level: Level::Emulated,
    transport: "tcp",
    dof: (6, 6),
    modes: &[ControlMode::Position, ControlMode::ServoPosition, ControlMode::Velocity],
    wire_units: "deg, mm",
    native_rate: 100.0,
    accuracy: 0.005,
    resolution: 1e-9,
    error_code: 2,
    lag: 0.05,
    stale_after: std::time::Duration::from_millis(50),
    droop: 0.0,
    relief: 0.0,
    outside: 0.02,
    gap_tolerance: std::time::Duration::ZERO,
    after_gap: dimos::arm::AfterGap::RestsAtSetpoint,
    topology: dimos::arm::Topology::MultiTurn,
    address: AddressForm { form: "HOST[:PORT]", required: true, check: host },
    holds_when_disabled: true,
    teach: Teach::HandGuiding,
    gripper: true,
    options: OptionsSpec::of::<NetOptions>(),
    check: |config| Ok(Checked::new(JointLimits::uniform(config.dof, 3.0, 2.0)).digital_inputs(8)),
    create: |_| Err(AdapterError::Rejected(NOT_HERE.to_owned())),
    emulate: Some(|_, _| Err(AdapterError::Rejected(NOT_HERE.to_owned()))),
    service: None,
    wire: None,
};

/// An arm in memory that needs no address.
pub const MOCK: AdapterSpec = AdapterSpec {
    name: "mock",
    about: "an arm in memory",
    transport: "memory",
    dof: (1, 16),
    address: AddressForm { form: "none", required: false, check: |address| Ok(address.to_owned()) },
    options: OptionsSpec::of::<NoOptions>(),
    emulate: None,
    service: None,
    wire: None,
    ..YOURARM
};

/// A serial arm without emulator that takes positions only and falls when disabled.
pub const SERVOBOT: AdapterSpec = AdapterSpec {
    name: "servobot",
    about: "a serial arm",
    transport: "serial",
    dof: (1, 7),
    modes: &[ControlMode::Position],
    address: AddressForm {
        form: "/dev/ttyX",
        required: true,
        check: |address| match address.starts_with("/dev/") {
            true => Ok(address.to_owned()),
            false => Err("a serial port starts with /dev/".to_owned()),
        },
    },
    holds_when_disabled: false,
    options: OptionsSpec::of::<NoOptions>(),
    emulate: None,
    service: None,
    wire: None,
    ..YOURARM
};

/// The built-in arms with those of this file in their place.
pub fn registry() -> Registry {
    dimos::arms::registry().with(&[YOURARM, MOCK, SERVOBOT])
}

//! SO-101 (and SO-100): five joints and a gripper of Feetech STS3215 servos on one half-duplex serial line.
//!
//! `protocol.rs` has the bytes, `bus.rs` the line, `calibration.rs` what counts mean, `servos.rs` the state of all
//! servos and writes to them, `connect.rs` the checks when connecting, `adapter.rs` the lifecycle, `activation.rs`
//! where the motors come on, `turns.rs` and `seam.rs` the seam of the encoders, `parts.rs` gripper and joint status,
//! `service.rs` and `settings.rs` the work outside a run, `emulator/` the servos' side of the line.

mod activation;
pub mod adapter;
mod bus;
pub mod calibration;
mod connect;
pub mod emulator;
mod messages;
mod parts;
pub mod protocol;
pub mod seam;
mod service;
mod servos;
mod settings;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_line;
#[cfg(test)]
mod tests_seam;
#[cfg(test)]
mod tests_service;
#[cfg(test)]
mod tests_wrong_readings;
mod turns;

use std::path::PathBuf;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use calibration::Calibration;
use dimos_core::arm::{AfterGap, Field, SetpointFields, Topology};
use dimos_core::joint::{ControlMode, JointLimits};
use dimos_hardware::check::{Checked, ConfigError, LineShare};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, AddressForm, Level, OptionsSpec, Teach};
use dimos_hardware::transport::serial::SerialAddress;
use emulator::SimOptions;
use protocol::SERVOS;

/// Number of joints.
pub const DOF: usize = 5;
/// The modes: the servos take goals at any time, with a top speed or without.
const MODES: &[ControlMode] = &[ControlMode::ServoPosition, ControlMode::Position];
/// Rate at which all servos are read [Hz]: a request for their state takes 2.4 ms of the line.
const NATIVE_RATE: f64 = 100.0;
/// Without power the arm falls: its gears do not hold it.
const HOLDS_WHEN_DISABLED: bool = false;
/// Rate of the line, where an address names none [bit/s].
const BAUD: u32 = 1_000_000;
/// Highest number of a first servo: five follow it, and 252 is the highest number that servos take.
const LAST_FIRST: u8 = 247;
/// Bits on the line for a state of all servos and one setpoint of each, in characters of ten: a request of 14 bytes,
/// six replies of 37, and 56.
const CYCLE_BITS: u32 = 10 * (14 + 6 * 37 + 56);
/// Top speed [rad/s], acceleration [rad/s²] and jerk [rad/s³] of every joint: less than a servo's 45 rpm without load.
const TOP_SPEED: f64 = 3.0;
const ACCELERATION: f64 = 15.0;
const JERK: f64 = 200.0;

/// The arm's row in the adapter table.
pub const SPEC: AdapterSpec = AdapterSpec {
    name: "so101",
    about: "SO-101 and SO-100, Feetech STS3215 servos",
    level: Level::Emulated,
    transport: "serial",
    dof: (DOF, DOF),
    modes: MODES,
    wire_units: "counts",
    native_rate: NATIVE_RATE,
    accuracy: 0.03,
    resolution: std::f64::consts::TAU / 4096.0,
    error_code: 2,
    // Recorded (30 Hz): it follows 0.10 to 0.13 s late.
    lag: 0.13,
    stale_after: Duration::from_millis(100),
    // Recorded on an arm (LeRobot data set, 50 s): p95 0.073 and 0.067, largest 0.108 rad of the shoulder.
    droop: 0.11,
    // It has goals, no stop of its own: a blocked joint presses on with its torque limit.
    relief: 0.04,
    // Leaders and followers rest against their end stops, a few counts outside of what was calibrated.
    outside: 0.05,
    // A servo continues to its goal; two periods of setpoints at 100 Hz.
    gap_tolerance: Duration::from_millis(20),
    after_gap: AfterGap::RestsAtSetpoint,
    // STS3215: the encoder counts one turn, 0 to 4095.
    topology: Topology::Seamed,
    address: AddressForm {
        form: "/dev/ttyX[@BAUD]",
        required: true,
        check: |address| SerialAddress::parse(address, BAUD).map(|address| address.to_string()),
    },
    holds_when_disabled: HOLDS_WHEN_DISABLED,
    teach: Teach::MotorsOff,
    gripper: true,
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(adapter::So101Adapter::new(config)?)),
    emulate: Some(|config, place| Ok(Box::new(emulator::start(config, place)?))),
    service: Some(service::open),
    wire: Some(messages::WIRE),
};

/// What a servo takes besides its goal: register 46 is a top speed and register 41 an acceleration of its own way
/// there; both are at their highest for setpoints.
const SETPOINT: SetpointFields = SetpointFields {
    velocity: Field::Refused("register 46 is a top speed, not that of a setpoint: STS3215 memory table"),
    acceleration: Field::Refused("register 41 is that of its own ramp, not of a setpoint: STS3215 memory table"),
    effort: Field::Refused("register 48 limits the torque, and none adds to it: STS3215 memory table"),
    at: Field::Refused("no register has a time: STS3215 memory table"),
    expires: Field::Refused("no register has a time: STS3215 memory table"),
    ..SetpointFields::each_as(Field::Refused(
        "registers 21 to 23 are gains of its own loop, without unit: STS3215 \
        memory table",
    ))
};

/// Checks the number of joints, the options and the calibration file; returns the joint limits.
fn check(config: &AdapterConfig) -> Result<Checked, ConfigError> {
    config.check_dof("so101", SPEC.dof)?;
    let options = config.options::<Options>()?;
    options.sim.check()?;
    let first = options.first_id;
    if !(1..=LAST_FIRST).contains(&first) {
        return Err(ConfigError::new("first_id", format!("servos have the numbers 1 to {}", LAST_FIRST + 5)));
    }
    let baud = SerialAddress::parse(&config.address, BAUD).map_or(BAUD, |address| address.baud);
    let load = f64::from(CYCLE_BITS) * NATIVE_RATE / f64::from(baud);
    let line = LineShare { numbers: (first, first + SERVOS as u8 - 1), option: "first_id", load };
    Ok(Checked::new(limits(&options.calibration()?)).digital_inputs(0).max_payload(0.0).line(line).setpoint(SETPOINT))
}

/// Returns the joint limits of a calibrated arm in SI units.
fn limits(calibration: &Calibration) -> JointLimits {
    let ranges = calibration.0.iter().take(DOF).map(calibration::Range::angles);
    let (position_lower, position_upper) = ranges.unzip();
    JointLimits {
        position_lower,
        position_upper,
        velocity_max: vec![TOP_SPEED; DOF],
        acceleration_max: vec![ACCELERATION; DOF],
        jerk_max: vec![JERK; DOF],
    }
}

/// What a blueprint may set of an SO-101.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Number of the first servo; the others follow it. A second arm on the same line has 7.
    #[schemars(range(min = 1, max = 247))]
    pub first_id: u8,
    /// LeRobot's calibration file of this arm, such as `~/.cache/huggingface/lerobot/calibration/robots/…/my_arm.json`.
    /// Without one, zero of each joint is the middle of its servo's turn.
    pub calibration: Option<PathBuf>,
    /// Whether the line returns what is sent on it.
    pub echo: bool,
    /// Whether settings of the servos that differ from LeRobot's (gains, the gripper's torque limits, return delay) are
    /// written when connecting. Otherwise a warning lists them. EEPROM wears: `dimos arm configure` once is enough.
    pub write_settings: bool,
    /// Settings of the emulator.
    pub sim: SimOptions,
}

impl Default for Options {
    fn default() -> Self {
        Self { first_id: 1, calibration: None, echo: false, write_settings: false, sim: SimOptions::default() }
    }
}

impl Options {
    /// Reads the calibration file, if there is one.
    fn calibration(&self) -> Result<Calibration, ConfigError> {
        let load = |path: &PathBuf| {
            Calibration::load(&expanded(path), self.first_id).map_err(|e| ConfigError::new("calibration", e))
        };
        self.calibration.as_ref().map_or(Ok(Calibration::default()), load)
    }
}

/// Replaces a leading `~` by the home folder.
fn expanded(path: &std::path::Path) -> PathBuf {
    match (path.strip_prefix("~"), std::env::var_os("HOME")) {
        (Ok(rest), Some(home)) => PathBuf::from(home).join(rest),
        _ => path.to_owned(),
    }
}

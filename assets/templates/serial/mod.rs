//! Acme, a 6-joint arm of servos on one serial line, with a gripper. Where a comment says `YOUR ARM`, the template is
//! made up: put in what the vendor's manual says. In this order: `protocol.rs` and `golden.rs` (the bytes), `wire.rs`
//! (what they travel on), `calibration.rs` (the units), `adapter.rs`, the numbers below, and `emulator.rs` (the servos'
//! side of the same bytes).

pub mod adapter;
pub mod calibration;
pub mod emulator;
#[cfg(test)]
mod golden;
pub mod protocol;
pub mod wire;

use std::time::Duration;

use dimos_hardware::arm::{AfterGap, Topology};
use dimos_hardware::check::{Checked, ConfigError};
use dimos_hardware::joint::{ControlMode, JointLimits};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, AddressForm, Level, OptionsSpec, Teach};
use dimos_hardware::sim::arm::SimOptions;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use calibration::{Calibration, Range};

/// Number of joints.
pub const DOF: usize = 6;
/// Number of servos: the gripper is the last one. They are numbered from 1. YOUR ARM: for one without a gripper `DOF`,
/// and `gripper: false` below; the compiler then leads to all that is the gripper's.
pub const SERVOS: usize = DOF + 1;

// YOUR ARM: the modes that it has, and whether it keeps its pose when the motors are off. Most geared servos do not.
const MODES: &[ControlMode] = &[ControlMode::Position, ControlMode::ServoPosition];
const HOLDS_WHEN_DISABLED: bool = false;

/// Rate at which all servos are read [Hz].
///
/// YOUR ARM: request and replies must fit into the period. A byte takes 10 bits: 7 replies of 80 bytes take 5.6 ms at
/// 1 Mbit/s, and 56 ms at 100 kbit/s. A pseudo-terminal has no rate, so the emulator does not show it.
const NATIVE_RATE: f64 = 100.0;
/// Opening of the gripper when it is open [m].
const OPEN: f64 = 0.08; // YOUR ARM
/// Top speed of every joint [rad/s].
const TOP_SPEED: f64 = 3.0; // YOUR ARM

/// The row in the table of adapters: what `list-adapters` shows, and how an arm or its emulator is made.
pub const SPEC: AdapterSpec = AdapterSpec {
    name: "acme",
    about: "Acme with 6 joints", // YOUR ARM: which models this is for
    level: Level::Emulated,
    transport: wire::TRANSPORT,
    dof: (DOF, DOF),
    modes: MODES,
    wire_units: "counts",
    native_rate: NATIVE_RATE,
    accuracy: 0.03,     // servos droop under load
    resolution: 1.6e-3, // YOUR ARM: the smallest step of its positions [rad]
    error_code: 2,      // YOUR ARM: any error that stops it
    lag: 0.05,
    stale_after: Duration::from_millis(100),
    // YOUR ARM: with the source of each: see docs/adding-an-arm.md. These assume nothing.
    droop: 0.0,
    relief: 0.0,
    outside: 0.02,
    gap_tolerance: Duration::ZERO,
    after_gap: AfterGap::RestsAtSetpoint,
    topology: Topology::MultiTurn,
    address: AddressForm {
        form: wire::FORM,
        required: true,
        check: |address| wire::address(address).map(|address| address.to_string()),
    },
    holds_when_disabled: HOLDS_WHEN_DISABLED,
    teach: Teach::No("not implemented"), // YOUR ARM: `Teach::MotorsOff` if one hand can hold it with its motors off
    gripper: true,
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(adapter::AcmeAdapter::new(config)?)),
    emulate: Some(emulator::start),
    service: None, // YOUR ARM: `dimos arm calibrate` and `setup-motors`, if you implement `Service`
    wire: None,    // YOUR ARM: how a captured protocol is read, for `adapter replay`: hardware::wire
};

/// Checks the number of joints and the options, and returns the joint limits; `dimos check` calls it.
fn check(config: &AdapterConfig) -> Result<Checked, ConfigError> {
    config.check_dof("acme", SPEC.dof)?;
    let options = config.options::<Options>()?;
    let calibration = Calibration::of(&options.calibration).map_err(|e| ConfigError::new("calibration", e))?;
    options.sim.check("acme", &limits(&Calibration::default()), emulator::PLAYABLE)?;
    Ok(Checked::new(limits(&calibration)))
}

/// The joint limits of a calibrated arm, in SI units.
fn limits(calibration: &Calibration) -> JointLimits {
    let (position_lower, position_upper) = calibration.joints().iter().map(Range::angles).unzip();
    JointLimits {
        position_lower,
        position_upper,
        velocity_max: vec![TOP_SPEED; DOF],
        acceleration_max: vec![10.0; DOF], // YOUR ARM [rad/s²]
        jerk_max: vec![100.0; DOF],        // YOUR ARM [rad/s³]
    }
}

/// What a blueprint may set under `options:`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Zero and range of each servo, from the base, the gripper last: `[{zero: 2048, low: 114, high: 3982}, …]`;
    /// `reversed: true` for a joint that turns the other way. Empty: those of the data sheet.
    pub calibration: Vec<Range>,
    /// Whether the line returns what is sent on it.
    pub echo: bool,
    /// Settings of the emulator.
    pub sim: SimOptions,
}

//! Acme, a 6-joint arm on a CAN bus. Where a comment says `YOUR ARM`, the template is made up: put in what the vendor's
//! manual says. In this order: `protocol.rs` and `golden.rs` (the bytes), `adapter.rs` (the units), the numbers below, and
//! `emulator.rs` (the arm's side of the same bytes).

pub mod adapter;
pub mod emulator;
#[cfg(test)]
mod golden;
pub mod protocol;

use std::time::Duration;

use dimos_hardware::arm::{AfterGap, Topology};
use dimos_hardware::check::{Checked, ConfigError};
use dimos_hardware::joint::{ControlMode, JointLimits};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, AddressForm, Level, OptionsSpec, Teach};
use dimos_hardware::sim::arm::SimOptions;
use dimos_hardware::sim::can_server::PLAYABLE;
use dimos_hardware::transport::can::CanAddress;
use dimos_hardware::transport::can::address::FORMS;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Number of joints.
pub const DOF: usize = 6;

// YOUR ARM: the modes that it has, and whether it has brakes that keep its pose when the motors are off.
const MODES: &[ControlMode] = &[ControlMode::Position, ControlMode::ServoPosition];
const HOLDS_WHEN_DISABLED: bool = true;

/// Rate at which the arm sends its state [Hz].
const NATIVE_RATE: f64 = 200.0; // YOUR ARM

/// The row in the table of adapters: what `list-adapters` shows, and how an arm or its emulator is made.
pub const SPEC: AdapterSpec = AdapterSpec {
    name: "acme",
    about: "Acme with 6 joints, on CAN", // YOUR ARM: which models this is for
    level: Level::Emulated,
    transport: "can",
    dof: (DOF, DOF),
    modes: MODES,
    wire_units: "deg",
    native_rate: NATIVE_RATE,
    accuracy: 0.01,
    resolution: 1.75e-5, // YOUR ARM: the smallest step of its positions [rad]
    error_code: 2,       // YOUR ARM: any error that stops it
    lag: 0.05,
    stale_after: Duration::from_millis(50),
    // YOUR ARM: with the source of each: see docs/adding-an-arm.md. These assume nothing.
    droop: 0.0,
    relief: 0.0,
    outside: 0.02,
    gap_tolerance: Duration::ZERO,
    after_gap: AfterGap::RestsAtSetpoint,
    topology: Topology::MultiTurn,
    address: AddressForm {
        form: FORMS,
        required: true,
        check: |address| CanAddress::parse(address).map(|address| address.to_string()),
    },
    holds_when_disabled: HOLDS_WHEN_DISABLED,
    teach: Teach::No("not implemented"),
    gripper: false,
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(adapter::AcmeAdapter::new(config)?)),
    emulate: Some(emulator::start),
    service: None,
    wire: None, // YOUR ARM: how a captured protocol is read, for `adapter replay`: hardware::wire
};

/// Checks the number of joints and the options, and returns the joint limits; `dimos check` calls it.
fn check(config: &AdapterConfig) -> Result<Checked, ConfigError> {
    config.check_dof("acme", SPEC.dof)?;
    let (options, limits) = (config.options::<Options>()?, limits());
    options.sim.check("acme", &limits, PLAYABLE)?;
    Ok(Checked::new(limits)) // YOUR ARM: where an option changes the limits, like a model, this is the place
}

/// The joint limits of the data sheet, in SI units.
fn limits() -> JointLimits {
    // YOUR ARM: lowest and highest position [deg] and top speed [deg/s] of each joint, base first.
    const DATA_SHEET: [(f64, f64, f64); DOF] = [(-170.0, 170.0, 180.0); DOF];
    JointLimits {
        acceleration_max: vec![10.0; DOF], // YOUR ARM [rad/s²]; leave it out where the sheet says nothing
        jerk_max: vec![100.0; DOF],        // YOUR ARM [rad/s³]; the same
        ..JointLimits::of_degrees(&DATA_SHEET)
    }
}

/// What a blueprint may set under `options:`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    // YOUR ARM: options of its own, each with a default: a payload, a tool, a serial number to insist on.
    /// Settings of the emulator.
    pub sim: SimOptions,
}

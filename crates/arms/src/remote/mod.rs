//! An arm that another process serves: a vendor's SDK behind a small shim, in Python (`assets/python/dimos_shim.py`)
//! or anything that has sockets. `docs/remote-adapter.md` is the protocol.
//!
//! The peer describes the arm after the connection; until then the nominal numbers below apply.

mod adapter;
pub mod address;
pub mod emulator;
mod link;
mod messages;
mod protocol;
mod session;
#[cfg(test)]
mod tests;

use std::f64::consts::PI;
use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use address::Address;
use dimos_core::arm::{AfterGap, SetpointFields, Topology};
use dimos_core::joint::{ControlMode, JointLimits, MAX_DOF};
use dimos_hardware::check::{Checked, ConfigError};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, AddressForm, Level, OptionsSpec, Teach};
use dimos_hardware::sim::arm::SimOptions;

/// All modes that the protocol knows.
const MODES: &[ControlMode] =
    &[ControlMode::Position, ControlMode::ServoPosition, ControlMode::Velocity, ControlMode::Impedance];

/// Those of a peer that does not name its own.
const USUAL_MODES: &[ControlMode] = &[ControlMode::Position, ControlMode::ServoPosition, ControlMode::Velocity];

/// Maximum rate of states [Hz]; the peer reports the rate of its arm.
const NATIVE_RATE: f64 = 1000.0;

/// The row of remote arms in the adapter table.
pub const SPEC: AdapterSpec = AdapterSpec {
    name: "remote",
    about: "an arm served by another process: a vendor's SDK behind dimos_shim.py",
    level: Level::Conformant,
    transport: "unix, tcp",
    dof: (1, MAX_DOF),
    modes: MODES,
    wire_units: "rad, m",
    native_rate: NATIVE_RATE,
    accuracy: 0.02,
    resolution: 1e-6,
    error_code: 2,
    lag: 0.1,
    stale_after: Duration::from_millis(200),
    // What the server's `hello` says; nothing is assumed of an arm that is not known.
    droop: 0.0,
    relief: 0.0,
    outside: 0.02,
    gap_tolerance: Duration::ZERO,
    after_gap: AfterGap::RestsAtSetpoint,
    topology: Topology::MultiTurn,
    address: AddressForm {
        form: address::FORM,
        required: true,
        check: |address| Address::parse(address).map(|address| address.to_string()),
    },
    // Unknown before the connection; the default must be the safe one.
    holds_when_disabled: false,
    teach: Teach::No("its protocol has no hand guiding"),
    gripper: true,
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(adapter::RemoteAdapter::new(config)?)),
    emulate: Some(emulator::start),
    service: None,
    wire: Some(messages::WIRE),
};

fn check(config: &AdapterConfig) -> Result<Checked, ConfigError> {
    config.check_dof("a remote arm", SPEC.dof)?;
    let (sim, limits) = (config.options::<Options>()?.sim, limits(config.dof));
    sim.check("remote", &limits, emulator::PLAYABLE)?;
    // What the server's `hello` says; until then the protocol has all of it.
    Ok(Checked::new(limits).digital_inputs(0).max_payload(0.0).setpoint(SetpointFields::ALL))
}

/// Nominal limits: ±2π rad, π rad/s. The peer states the real ones.
fn limits(dof: usize) -> JointLimits {
    JointLimits::uniform(dof, 2.0 * PI, PI)
}

/// The subset of [`MODES`] with the same modes as `given`, whatever their order.
fn same_modes(given: &[ControlMode]) -> &'static [ControlMode] {
    use ControlMode::{Impedance, Position, ServoPosition, Velocity};
    const SUBSETS: [&[ControlMode]; 16] = [
        &[],
        &[Position],
        &[ServoPosition],
        &[Position, ServoPosition],
        &[Velocity],
        &[Position, Velocity],
        &[ServoPosition, Velocity],
        USUAL_MODES,
        &[Impedance],
        &[Position, Impedance],
        &[ServoPosition, Impedance],
        &[Position, ServoPosition, Impedance],
        &[Velocity, Impedance],
        &[Position, Velocity, Impedance],
        &[ServoPosition, Velocity, Impedance],
        MODES,
    ];
    let bits = MODES.iter().enumerate().map(|(i, mode)| usize::from(given.contains(mode)) << i);
    SUBSETS.get(bits.sum::<usize>()).copied().unwrap_or(USUAL_MODES)
}

/// What a blueprint may set of a remote arm.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Settings of the emulator. It starts at zero where `initial_positions` is empty.
    pub sim: SimOptions,
}

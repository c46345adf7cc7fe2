//! An ideal arm in memory, for trying things out and for tests: no wire, but a real plant and scripted faults.

mod adapter;
mod device;
mod options;
#[cfg(test)]
mod tests;

pub use adapter::MockArm;
pub use options::Options;

use std::time::Duration;

use dimos_core::arm::{AfterGap, Impedance, SetpointFields, Topology};
use dimos_core::joint::{ControlMode, JointLimits, MAX_DOF};
use dimos_hardware::check::{Checked, ConfigError};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, AddressForm, Level, OptionsSpec, Teach};
use dimos_hardware::sim::io::SimIo;
use std::f64::consts::PI;

/// The modes of the mock arm.
const MODES: &[ControlMode] =
    &[ControlMode::Position, ControlMode::ServoPosition, ControlMode::Velocity, ControlMode::Impedance];

/// How it is held in impedance mode, and what it takes at most [Nm/rad, Nm·s/rad].
const IMPEDANCE: Impedance = Impedance::uniform((100.0, 5.0), (1000.0, 100.0));

/// How often the mock arm can deliver its state [Hz].
const NATIVE_RATE: f64 = 1000.0;

/// The mock arm's row in the adapter table.
pub const SPEC: AdapterSpec = AdapterSpec {
    name: "mock",
    about: "an ideal arm in memory, 1 to 16 joints",
    level: Level::Emulated,
    transport: "memory",
    dof: (1, MAX_DOF),
    modes: MODES,
    wire_units: "rad, m",
    native_rate: NATIVE_RATE,
    accuracy: 0.001,
    resolution: 1e-9,
    error_code: 2,
    lag: 0.02,
    stale_after: Duration::from_millis(50),
    // Its plant rests where it is sent, and its own stop where it is.
    droop: 0.0,
    relief: 0.0,
    outside: 0.02,
    gap_tolerance: Duration::from_millis(20),
    after_gap: AfterGap::RestsAtSetpoint,
    topology: Topology::MultiTurn,
    address: AddressForm { form: "none", required: false, check: |address| Ok(address.to_owned()) },
    holds_when_disabled: true,
    teach: Teach::HandGuiding,
    gripper: true,
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(MockArm::new(config)?)),
    emulate: None,
    service: None,
    wire: None,
};

fn check(config: &AdapterConfig) -> Result<Checked, ConfigError> {
    config.check_dof("a mock arm", SPEC.dof)?;
    config.options::<Options>()?.check(config.dof)?;
    let checked = Checked::new(limits(config.dof)).digital_inputs(SimIo::INFO.digital_inputs);
    Ok(checked.setpoint(SetpointFields::ALL).impedance(IMPEDANCE))
}

/// ±2π rad, π rad/s, 10 rad/s², 100 rad/s³ for every joint.
fn limits(dof: usize) -> JointLimits {
    JointLimits {
        acceleration_max: vec![10.0; dof],
        jerk_max: vec![100.0; dof],
        ..JointLimits::uniform(dof, 2.0 * PI, PI)
    }
}

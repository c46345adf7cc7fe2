//! YourArm, a made-up 6-joint arm on TCP: the annotated example of an adapter with a gripper, Cartesian moves and
//! options. It is not a template: `dimos adapter new` writes the start of an adapter for your arm.
//!
//! `frame.rs` and `protocol.rs` have the bytes, `adapter.rs` the units and the lifecycle, `emulator/` the controller's
//! side of the protocol.

pub mod adapter;
pub mod emulator;
pub mod frame;
#[cfg(test)]
mod golden;
mod messages;
pub mod protocol;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_report;

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_core::arm::{AfterGap, Impedance, SetpointFields, Topology};
use dimos_core::joint::{ControlMode, JointLimits};
use dimos_hardware::adapter_util::fraction;
use dimos_hardware::check::{Checked, ConfigError, ToolFacts};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, AddressForm, Level, OptionsSpec, Teach};
use dimos_hardware::sim::arm::{ControllerOptions, SimOptions, check_range};
use dimos_hardware::sim::faults::Fault;
use dimos_hardware::sim::io::PLAYABLE;
use dimos_hardware::sim::physics::PhysicsOptions;
use dimos_hardware::transport::tcp::Endpoint;

/// The modes of the arm, in the order of their numbers on the wire.
const MODES: &[ControlMode] =
    &[ControlMode::Position, ControlMode::ServoPosition, ControlMode::Velocity, ControlMode::Impedance];

/// Rate of the controller's measurements [Hz].
const NATIVE_RATE: f64 = 500.0;

/// Whether the arm keeps its pose when its motors are off: it has brakes.
const HOLDS_WHEN_DISABLED: bool = true;

/// Rated payload [kg].
const PAYLOAD: f64 = 5.0;
/// Maximum opening of the gripper [m].
const GRIPPER_MAX: f64 = 0.08;
/// Smallest and largest force of the gripper [N].
const GRIPPER_FORCE: (f64, f64) = (1.0, 60.0);

/// How it is held in impedance mode, and what it takes at most (§3 of the sheet) [Nm/rad, Nm·s/rad].
const IMPEDANCE: Impedance = Impedance::uniform((150.0, 8.0), (500.0, 50.0));

/// YourArm's row in the adapter table.
pub const SPEC: AdapterSpec = AdapterSpec {
    name: "yourarm",
    about: "YourArm YA6, the annotated example",
    level: Level::Emulated,
    transport: "tcp",
    dof: (protocol::DOF, protocol::DOF),
    modes: MODES,
    wire_units: "deg, mm",
    native_rate: NATIVE_RATE,
    accuracy: 0.002,
    resolution: 1e-6, // degrees in f32
    error_code: 2,
    lag: 0.03,
    stale_after: Duration::from_millis(50),
    // yourarm-protocol.md: setpoints up to two periods apart are interpolated, then the arm returns to the last one;
    // its stop rests where it is.
    droop: 0.0,
    relief: 0.0,
    outside: 0.02,
    gap_tolerance: Duration::from_millis(20),
    after_gap: AfterGap::RestsAtSetpoint,
    topology: Topology::MultiTurn,
    address: AddressForm {
        form: "HOST[:PORT]",
        required: true,
        check: |address| Endpoint::parse(address, protocol::PORT).map(|endpoint| endpoint.to_string()),
    },
    holds_when_disabled: HOLDS_WHEN_DISABLED,
    teach: Teach::No("its protocol has no hand guiding, and without its motors its brakes hold it"),
    gripper: true,
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(adapter::YourArmAdapter::new(config)?)),
    emulate: Some(|config, place| Ok(Box::new(emulator::YourArmEmulator::start(config, place)?))),
    service: None,
    wire: Some(messages::WIRE),
};

/// The data sheet's joint limits: minimum and maximum position [deg], maximum speed [deg/s].
const DATA_SHEET: [(f64, f64, f64); protocol::DOF] = [
    (-170.0, 170.0, 180.0),
    (-100.0, 130.0, 180.0),
    (-70.0, 150.0, 180.0),
    (-175.0, 175.0, 360.0),
    (-100.0, 120.0, 360.0),
    (-270.0, 270.0, 360.0),
];
/// Maximum acceleration [rad/s²] and jerk [rad/s³] of every joint.
const ACCELERATION: f64 = 10.0;
const JERK: f64 = 100.0;

/// Checks the number of joints and the options, and returns the joint limits. If an option changes the limits (a
/// model, for example), apply it here.
fn check(config: &AdapterConfig) -> Result<Checked, ConfigError> {
    config.check_dof("yourarm", SPEC.dof)?;
    let (options, limits) = (config.options::<Options>()?, limits());
    options.sim.kit().check("yourarm", &limits, PLAYABLE)?;
    check_range("servo_stiffness", options.sim.servo_stiffness, 0.0..=MAX_SERVO_STIFFNESS, "Nm/rad")?;
    let tool = ToolFacts { model: Some(("yourarm", "flange")), ..ToolFacts::default() };
    let checked = Checked::new(limits).digital_inputs(protocol::DIGITAL).max_payload(PAYLOAD).tool(tool);
    // SETPOINT has all of it.
    Ok(checked.setpoint(SetpointFields::ALL).impedance(IMPEDANCE))
}

/// Returns the joint limits in SI units.
fn limits() -> JointLimits {
    JointLimits {
        acceleration_max: vec![ACCELERATION; protocol::DOF],
        jerk_max: vec![JERK; protocol::DOF],
        ..JointLimits::of_degrees(&DATA_SHEET)
    }
}

/// What a blueprint may set of a YourArm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Scales the speed of moves that the controller plans (0–1].
    #[serde(deserialize_with = "fraction")]
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 1))]
    pub speed_scale: f64,
    /// Whether to use the gripper.
    pub gripper: bool,
    /// Settings of the emulator.
    pub sim: Sim,
}

impl Default for Options {
    fn default() -> Self {
        Self { speed_scale: 1.0, gripper: true, sim: Sim::default() }
    }
}

/// Largest stiffness of the emulated position control [Nm/rad].
const MAX_SERVO_STIFFNESS: f64 = 1e5;

/// Settings of the emulator of a YourArm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Sim {
    /// Joint positions at power-up [rad], one per joint; empty for the arm's default pose.
    pub initial_positions: Vec<f64>,
    /// Lag of the joints behind their servo setpoints, 0 to 0.5 [s].
    #[schemars(range(min = 0, max = 0.5))]
    pub lag: f64,
    /// Droop of the joints below their targets at rest under load, 0 to 0.2 [rad].
    #[schemars(range(min = 0, max = 0.2))]
    pub droop: f64,
    /// Faults, and when they begin (seconds after the first connection).
    pub faults: Vec<Fault>,
    /// What the controller does otherwise than its documents say.
    pub controller: ControllerOptions,
    /// A body with mass, by MuJoCo: `{}`, or with a seed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub physics: Option<PhysicsOptions>,
    /// Stiffness of the position control [Nm/rad]: the arm, which has the masses of `builtin:yourarm`, sags by its
    /// weight / stiffness; 0: its control has an integral part, and the arm does not sag.
    #[schemars(range(min = 0, max = 100000))]
    pub servo_stiffness: f64,
}

impl Default for Sim {
    fn default() -> Self {
        Self::from(SimOptions::default())
    }
}

impl From<SimOptions> for Sim {
    fn from(kit: SimOptions) -> Self {
        let SimOptions { initial_positions, lag, droop, faults, controller, physics } = kit;
        Self { initial_positions, lag, droop, faults, controller, physics, servo_stiffness: 0.0 }
    }
}

impl Sim {
    /// Returns those that all emulators have.
    fn kit(&self) -> SimOptions {
        let Self { initial_positions, lag, droop, faults, controller, physics, .. } = self.clone();
        SimOptions { initial_positions, lag, droop, faults, controller, physics }
    }
}

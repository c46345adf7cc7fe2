//! Universal Robots: CB3, e-Series, UR-Series, with PolyScope and PolyScope X.
//!
//! `protocol/` has the bytes, `rtde`, `primary` and `dashboard` the connections, `control.script` the program that runs
//! on the controller and `script/` its language, `session` and `safety` the state of the arm, `power` and `motion` what
//! is ordered of it, `adapter` the adapter trait, `emulator/` the controller's side.

pub mod adapter;
pub mod address;
mod condition;
mod connect;
mod dashboard;
pub mod emulator;
#[cfg(test)]
mod golden;
mod io;
mod messages;
pub mod model;
mod motion;
mod outputs;
mod power;
mod primary;
pub mod program;
pub mod protocol;
mod robot_api;
mod rtde;
mod safety;
mod script;
mod session;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_others;
#[cfg(test)]
mod tests_poses;
#[cfg(test)]
mod tests_power;
#[cfg(test)]
mod tests_speed;
#[cfg(test)]
mod tests_stream;
mod tool_line;

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use address::Address;
use dimos_core::arm::{AfterGap, Field, SetpointFields, Topology};
use dimos_core::joint::{ControlMode, JointLimits};
use dimos_hardware::check::{Checked, ConfigError, ToolFacts, in_range};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, AddressForm, Level, OptionsSpec, Teach};
use model::Model;
pub use tool_line::ToolLine;

/// Number of joints.
pub const DOF: usize = 6;
/// The modes. There is none in which the controller plans: its program ends when orders no longer come.
const MODES: &[ControlMode] = &[ControlMode::ServoPosition, ControlMode::Velocity];
/// Rate of the state of an e-Series controller [Hz]; a CB3 controller has 125 Hz.
const NATIVE_RATE: f64 = 500.0;
/// Whether the arm keeps its pose when its motors are off: it has brakes.
const HOLDS_WHEN_DISABLED: bool = true;

/// Highest speed of tool, flange and elbow [m/s] with the default preset of the safety settings. The controller has no
/// interface that reports them.
const TOOL_SPEED: f64 = 1.5;

/// The row in the adapter table.
pub const SPEC: AdapterSpec = AdapterSpec {
    name: "ur",
    about: "Universal Robots UR3 to UR30, UR8 Long: CB3, e-Series, UR-Series",
    level: Level::Emulated,
    transport: "tcp",
    dof: (DOF, DOF),
    modes: MODES,
    wire_units: "rad, m",
    native_rate: NATIVE_RATE,
    accuracy: 0.002,
    resolution: 1e-9,
    error_code: 2,
    lag: 0.07,
    stale_after: Duration::from_millis(50),
    // The controller corrects its position with an integral part, and stopj rests where it decelerates to.
    droop: 0.0,
    relief: 0.0,
    outside: 0.02,
    // What `control.script` bridges: it keeps the velocity for this time, then decelerates along it.
    gap_tolerance: Duration::from_millis(20),
    after_gap: AfterGap::Decelerates,
    // The controller keeps the number of turns; wrist 3 of UR3 and UR3e is endless.
    topology: Topology::MultiTurn,
    address: AddressForm {
        form: "HOST[:FIRST_PORT]",
        required: true,
        check: |address| Address::parse(address).map(|address| address.to_string()),
    },
    holds_when_disabled: HOLDS_WHEN_DISABLED,
    teach: Teach::No("its freedrive is begun on the teach pendant, while no program controls it"),
    gripper: false,
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(adapter::UrAdapter::new(config)?)),
    service: None,
    wire: Some(messages::WIRE),
    emulate: Some(|config, place| Ok(Box::new(emulator::UrEmulator::start(config, place)?))),
};

/// What a blueprint may set of a Universal Robots arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Which arm it is: `ur3`, `ur3e`, `ur5`, `ur5e`, `ur7e`, `ur8long`, `ur10`, `ur10e`, `ur12e`, `ur15`, `ur16e`,
    /// `ur18`, `ur20` or `ur30`. An arm that is another model is refused.
    pub model: Model,
    /// Time over which the controller smooths setpoints, 0.03 to 0.2 [s]: longer is smoother and later.
    #[schemars(range(min = 0.03, max = 0.2))]
    pub lookahead_time: f64,
    /// Gain with which the controller follows setpoints, 100 to 2000: higher is stiffer, and may vibrate.
    #[schemars(range(min = 100, max = 2000))]
    pub gain: f64,
    /// Deceleration of a stop, of a hold and after a gap, 1 to 40 [rad/s²]. Setpoints are followed with at most this.
    #[schemars(range(min = 1, max = 40))]
    pub stop_deceleration: f64,
    /// RS-485 at the tool connector: set whenever the arm is enabled. `null`: as set at the pendant.
    pub tool_line: Option<ToolLine>,
    /// Whether to read force and torque at the TCP. An e-Series arm measures them; a CB3 arm estimates them from its
    /// currents.
    pub force_torque: bool,
    /// Settings of the emulator.
    pub sim: emulator::SimOptions,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            model: Model::default(),
            lookahead_time: 0.05,
            gain: 500.0,
            stop_deceleration: 8.0,
            tool_line: None,
            force_torque: false,
            sim: emulator::SimOptions::default(),
        }
    }
}

impl Options {
    /// Returns the limits of the configured model. No joint accelerates faster than the arm decelerates: what is
    /// commanded stops within the way that these limits imply.
    fn limits(&self) -> JointLimits {
        let mut limits = self.model.limits();
        limits.acceleration_max.iter_mut().for_each(|most| *most = most.min(self.stop_deceleration));
        limits
    }
}

/// What `servoj` has besides positions: gain and lookahead time of its own law, without a unit of stiffness.
const SETPOINT: SetpointFields = SetpointFields {
    velocity: Field::Refused("servoj does not use its argument v: URScript manual"),
    acceleration: Field::Refused("servoj does not use its argument a: URScript manual"),
    effort: Field::Withheld("servoj has none; direct_torque of PolyScope 5.23 and newer has, and is not used"),
    at: Field::Refused("servoj has no time of a setpoint: URScript manual"),
    expires: Field::Withheld("the program on the controller counts its own cycles without a setpoint"),
    ..SetpointFields::each_as(Field::Refused("servoj has a gain without unit, 100 to 2000: URScript manual"))
};

/// Returns the limits of the configured model.
fn check(config: &AdapterConfig) -> Result<Checked, ConfigError> {
    config.check_dof("ur", SPEC.dof)?;
    let options: Options = config.options()?;
    in_range("lookahead_time", options.lookahead_time, (0.03, 0.2))?;
    in_range("gain", options.gain, (100.0, 2000.0))?;
    in_range("stop_deceleration", options.stop_deceleration, (1.0, 40.0))?;
    options.tool_line.iter().try_for_each(|line| line.check(options.model))?;
    let limits = options.limits();
    options.sim.check(&limits)?;
    let topology = |joint| if options.model.is_endless(joint) { Topology::Endless } else { SPEC.topology };
    Ok(Checked::new(limits)
        .digital_inputs(io::DIGITAL)
        .max_payload(io::max_payload(options.model))
        .topology((0..DOF).map(topology).collect())
        .setpoint(SETPOINT)
        .tool(ToolFacts {
            velocity: Some(TOOL_SPEED),
            is_setting: true,
            model: (options.model == Model::Ur5e).then_some(("ur5e", "tool0")),
            also: &["forearm_link", "link3"],
        }))
}

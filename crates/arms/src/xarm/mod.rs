//! UFACTORY's arms behind a control box on TCP: xArm 5, 6 and 7, Lite 6, 850. `docs/arms/xarm.md` is for users.
//!
//! ```text
//!  adapter ──▶ session ──▶ control   port 502: requests, responses matched by number; port 503: the gripper
//!   (SI)       (state)  ◀── stream    ports 30000 or 30003: joints; 30002: motors, error
//!                 ├── motion_commands, state_commands (motors, mode, stop), other_clients
//!                 └── mode, condition, gripper: state machines that never wait
//! ```

pub mod adapter;
pub mod address;
mod condition;
mod connect;
mod control;
pub mod emulator;
pub mod errors;
#[cfg(test)]
mod golden;
mod gripper;
mod messages;
mod mode;
pub mod model;
mod motion_commands;
mod other_clients;
mod output_gripper;
pub mod protocol;
mod reduced_mode;
mod report_validity;
mod session;
mod state_commands;
mod stream;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_models;
#[cfg(test)]
mod tests_other_clients;
#[cfg(test)]
mod tests_outputs;
#[cfg(test)]
mod tests_reduced;
#[cfg(test)]
mod tests_slow;

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use address::Address;
use dimos_core::arm::{AfterGap, Field, SetpointFields, Topology};
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter_util::fraction;
use dimos_hardware::check::{Checked, ConfigError, ToolFacts};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, AddressForm, Level, OptionsSpec, Teach};
use model::Model;
use protocol::gripper::GripperKind;

/// The modes of the arm.
const MODES: &[ControlMode] = &[ControlMode::Position, ControlMode::ServoPosition, ControlMode::Velocity];

/// Modes of firmware before 1.8.0, which does not end a velocity after a time.
const MODES_WITHOUT_VELOCITY: &[ControlMode] = &[ControlMode::Position, ControlMode::ServoPosition];

/// Rate of the reports with firmware 2.1.0 or newer [Hz]. Older ones report at 100 Hz.
const NATIVE_RATE: f64 = 250.0;

/// Whether the arm keeps its pose when its motors are off: it has brakes.
const HOLDS_WHEN_DISABLED: bool = true;

/// The row in the adapter table.
pub const SPEC: AdapterSpec = AdapterSpec {
    name: "xarm",
    about: "UFACTORY xArm 5, 6, 7, Lite 6, 850",
    level: Level::Emulated,
    transport: "tcp",
    dof: (5, 7),
    modes: MODES,
    wire_units: "rad, mm",
    native_rate: NATIVE_RATE,
    accuracy: 0.002,
    resolution: 1e-6, // rad in f32
    error_code: 2,
    lag: 0.05,
    stale_after: Duration::from_millis(50),
    // Positions are controlled with an integral part, and state 4 rests where the arm is.
    droop: 0.0,
    relief: 0.0,
    outside: 0.02,
    // No document says what servo mode bridges: the period between two setpoints that the vendor's examples use, until
    // it is measured.
    gap_tolerance: Duration::from_millis(20),
    after_gap: AfterGap::RestsAtSetpoint,
    // Ranges of ±2π: the controller keeps the number of turns.
    topology: Topology::MultiTurn,
    address: AddressForm {
        form: "HOST[:CONTROL_PORT[:REPORT_PORT]]",
        required: true,
        check: |address| Address::parse(address).map(|address| address.to_string()),
    },
    holds_when_disabled: HOLDS_WHEN_DISABLED,
    teach: Teach::HandGuiding,
    gripper: true,
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(adapter::XArmAdapter::new(config)?)),
    emulate: Some(|config, place| Ok(Box::new(emulator::XArmEmulator::start(config, place)?))),
    service: None,
    wire: Some(messages::WIRE),
};

/// What a blueprint may set of an xArm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Which arm it is: `xarm5`, `xarm6`, `xarm7`, `lite6` or `xarm850`. By default the xArm with that number of
    /// joints. An arm that is another model is refused.
    pub model: Option<Model>,
    /// The gripper at the tool flange: `xarm`, `xarm_g2`, `lite6`, `vacuum`, or `none`.
    pub gripper: GripperKind,
    /// Whether to use the force/torque sensor. It is switched on with the motors.
    pub force_torque: bool,
    /// Scales the speed of moves that the controller plans (0–1].
    #[serde(deserialize_with = "fraction")]
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 1))]
    pub speed_scale: f64,
    /// Settings of the emulator.
    pub sim: emulator::SimOptions,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            model: None,
            gripper: GripperKind::None,
            force_torque: false,
            speed_scale: 1.0,
            sim: emulator::SimOptions::default(),
        }
    }
}

/// What `servo_j` has besides positions. Its slots for speed, acceleration and time are ignored by the firmware
/// (developer manual, register 29), and there is no mode with torques: mode 6 is a planned one (register 19).
const SETPOINT: SetpointFields = SetpointFields {
    velocity: Field::Refused("servo_j (register 29) ignores its speed: UFACTORY's developer manual"),
    acceleration: Field::Refused("servo_j (register 29) ignores its acceleration: UFACTORY's developer manual"),
    at: Field::Refused("servo_j (register 29) ignores its time: UFACTORY's developer manual"),
    expires: Field::Refused("servo_j (register 29) has no such value: UFACTORY's developer manual"),
    ..SetpointFields::each_as(Field::Refused("no mode of the control box takes torques: UFACTORY's developer manual"))
};

/// Returns the limits of the configured model.
fn check(config: &AdapterConfig) -> Result<Checked, ConfigError> {
    let options: Options = config.options()?;
    let model = model_of(&options, config.dof)?;
    let limits = model.limits();
    options.sim.check(&limits)?;
    let tool = ToolFacts {
        velocity: Some(model.tool_speed()),
        model: Some((model.option(), "link_eef")),
        ..ToolFacts::default()
    };
    Ok(Checked::new(limits).digital_inputs(0).max_payload(model.payload()).tool(tool).setpoint(SETPOINT))
}

/// Returns the model of options and number of joints, or why they conflict.
fn model_of(options: &Options, dof: usize) -> Result<Model, ConfigError> {
    let model = options.model.or(Model::of_dof(dof));
    let model = model.ok_or_else(|| ConfigError::new("", format!("no xArm has {dof} joints")))?;
    match model.axes() {
        axes if axes == dof => Ok(model),
        axes => Err(ConfigError::new("model", format!("{} has {axes} joints, not {dof}", model.name()))
            .hint(format!("give the arm {axes} joints, or leave `model` out for the xArm with {dof}"))),
    }
}

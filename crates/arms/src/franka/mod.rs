//! Franka Robotics: FR3, and FER (Panda).
//!
//! The controller is the clock: it sends its state every millisecond, and takes one command in answer to each.
//! `protocol/` has the bytes, `connect`, `session` and `motion` the connection and what is ordered, `follower` and
//! `smoothing` make one value for each state from the tick's setpoints, `shaping` is what the vendor's client does to
//! each command, `gripper` the hand, `adapter` the adapter trait, `emulator/` the controller's side.

pub mod adapter;
mod catching_up;
mod ceiling;
mod connect;
mod description;
mod desired;
pub mod emulator;
mod follower;
#[cfg(test)]
mod golden;
mod gripper;
mod messages;
pub mod model;
mod motion;
pub mod protocol;
pub mod session;
pub mod shaping;
mod smoothing;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_commanded;

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_core::arm::{AfterGap, Field, SetpointFields, Topology};
use dimos_core::joint::ControlMode;
use dimos_hardware::check::{Checked, ConfigError, ToolFacts, in_range};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, AddressForm, Level, OptionsSpec, Teach};
use dimos_hardware::transport::tcp::Endpoint;
use model::Model;
use protocol::{DOF, PORT};

/// The modes. There is none in which the controller plans: it wants a command every millisecond.
const MODES: &[ControlMode] = &[ControlMode::ServoPosition, ControlMode::Velocity];
/// Rate of the states, and of the commands that answer them [Hz].
const NATIVE_RATE: f64 = 1000.0;
/// Whether the arm keeps its pose when it is disabled: its own control holds it then, and brakes without power.
const HOLDS_WHEN_DISABLED: bool = true;

/// The row in the adapter table.
pub const SPEC: AdapterSpec = AdapterSpec {
    name: "franka",
    about: "Franka Robotics FR3, FER (Panda)",
    level: Level::Emulated,
    transport: "tcp",
    dof: (DOF, DOF),
    modes: MODES,
    wire_units: "rad, m",
    native_rate: NATIVE_RATE,
    accuracy: 0.005,
    resolution: 1e-9,
    error_code: 2,
    lag: 0.045,
    stale_after: Duration::from_millis(50),
    // libfranka's impedance control has an integral part; its stop rests where the arm is.
    droop: 0.0,
    relief: 0.0,
    outside: 0.02,
    // Franka's FCI documentation: up to 19 lost commands are extrapolated with constant acceleration, the twentieth
    // ends the motion.
    gap_tolerance: Duration::from_millis(19),
    after_gap: AfterGap::Faults,
    topology: Topology::MultiTurn,
    address: AddressForm {
        form: "HOST[:PORT]",
        required: true,
        check: |address| Endpoint::parse(address, PORT).map(|address| address.to_string()),
    },
    holds_when_disabled: HOLDS_WHEN_DISABLED,
    teach: Teach::No("its controller guides it only with the buttons at its wrist, while no program controls it"),
    gripper: true,
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(adapter::FrankaAdapter::new(config)?)),
    service: None,
    wire: Some(messages::WIRE),
    emulate: Some(|config, place| Ok(Box::new(emulator::FrankaEmulator::start(config, place)?))),
};

/// Rated payload of an FR3 and an FER, of their data sheets [kg].
const PAYLOAD: f64 = 3.0;

/// What a blueprint may set of a Franka arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Which arm it is: `fr3` or `fer`. An arm that is another model is refused.
    pub model: Model,
    /// Whether joints may go to the ends of their ranges, where an FR3 allows little speed. Otherwise an FR3 has the
    /// range and the speeds that its vendor suggests for planners.
    pub full_range: bool,
    /// Cutoff frequency of the low-pass filter for commands, 1 to 1000 [Hz]; 1000 switches it off.
    #[schemars(range(min = 1, max = 1000))]
    pub cutoff_frequency: f64,
    /// Whether to limit velocity, acceleration and jerk of every command to what the controller takes.
    pub limit_rate: bool,
    /// Stiffness of the joints, seven values from 0 to 14250 [Nm/rad]; the controller's own when empty.
    pub joint_impedance: Vec<f64>,
    /// External torques that stop the arm, one per joint [Nm]; the controller's own when empty. Needs
    /// `collision_forces`.
    pub collision_torques: Vec<f64>,
    /// External forces and torques at the end effector that stop the arm: x, y, z [N], then about x, y, z [Nm]; the
    /// controller's own when empty. Needs `collision_torques`.
    pub collision_forces: Vec<f64>,
    /// Whether to read the estimated external force and torque at the end effector.
    pub force_torque: bool,
    /// Whether the arm has the vendor's hand.
    pub gripper: bool,
    /// Speed of the fingers, above 0 to 0.1 [m/s].
    #[schemars(range(min = 0, max = 0.1))]
    pub gripper_speed: f64,
    /// Force of a hand that is closed, up to 70 [N]; 0 closes it without grasping.
    #[schemars(range(min = 0, max = 70))]
    pub gripper_force: f64,
    /// Settings of the emulator.
    pub sim: emulator::SimOptions,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            model: Model::default(),
            full_range: false,
            cutoff_frequency: 100.0,
            limit_rate: true,
            joint_impedance: Vec::new(),
            collision_torques: Vec::new(),
            collision_forces: Vec::new(),
            force_torque: false,
            gripper: false,
            gripper_speed: 0.1,
            gripper_force: 20.0,
            sim: emulator::SimOptions::default(),
        }
    }
}

/// What a motion generator of joint positions has besides them. Torques have a controller of their own, which would
/// take the place of the robot's position control.
const SETPOINT: SetpointFields = SetpointFields {
    velocity: Field::Refused("a generator of joint positions takes those alone: FCI documentation"),
    acceleration: Field::Refused("the command has no accelerations: FCI documentation"),
    effort: Field::Withheld("torques replace the robot's own control, and an external controller is not written yet"),
    at: Field::Refused("the command has the number of a state, no time: FCI documentation"),
    expires: Field::Refused("the command has no such value: FCI documentation"),
    ..SetpointFields::each_as(Field::Withheld(
        "the robot sets its joint impedance at rest, not per setpoint; an external controller is not \
        written yet",
    ))
};

/// Returns the limits of the configured model.
fn check(config: &AdapterConfig) -> Result<Checked, ConfigError> {
    config.check_dof("franka", SPEC.dof)?;
    let options: Options = config.options()?;
    in_range("cutoff_frequency", options.cutoff_frequency, (1.0, 1000.0))?;
    in_range("gripper_speed", options.gripper_speed, (0.001, 0.1))?;
    in_range("gripper_force", options.gripper_force, (0.0, 70.0))?;
    let lists = [
        ("joint_impedance", &options.joint_impedance, DOF, (0.0, 14250.0)),
        ("collision_torques", &options.collision_torques, DOF, (0.0, 1000.0)),
        ("collision_forces", &options.collision_forces, 6, (0.0, 1000.0)),
    ];
    for (name, values, count, range) in lists {
        if !values.is_empty() && values.len() != count {
            return Err(ConfigError::new(name, format!("{name} has {count} values, not {}", values.len())));
        }
        values.iter().try_for_each(|value| in_range(name, *value, range))?;
    }
    if options.collision_torques.is_empty() != options.collision_forces.is_empty() {
        let what = "collision_torques and collision_forces belong together: set both, or neither";
        return Err(ConfigError::new("collision_forces", what));
    }
    let limits = options.model.limits(options.full_range);
    options.sim.check(&limits)?;
    let tool = ToolFacts {
        velocity: Some(options.model.tool_speed()),
        model: Some((options.model.option(), "flange")),
        ..ToolFacts::default()
    };
    Ok(Checked::new(limits).digital_inputs(0).max_payload(PAYLOAD).tool(tool).setpoint(SETPOINT))
}

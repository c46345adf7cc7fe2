//! AgileX Piper: 6 joints and a gripper on a CAN bus. `docs/arms/piper.md` is for those who run one.

pub mod adapter;
mod controller_limits;
pub mod emulator;
pub mod feedback;
#[cfg(test)]
mod golden;
mod guard;
mod hold;
mod jump_filter;
mod messages;
pub mod model;
pub mod protocol;
mod session;
#[cfg(test)]
mod tests;
#[cfg(test)]
mod tests_bus;
#[cfg(test)]
mod tests_faults;
#[cfg(test)]
mod tests_holds;
#[cfg(test)]
mod tests_other_clients;
mod wire;

use std::time::Duration;

use schemars::JsonSchema;
use serde::{Deserialize, Deserializer, Serialize};

use dimos_core::arm::{AfterGap, Field, SetpointFields, Topology};
use dimos_core::joint::ControlMode;
use dimos_hardware::adapter_util::{above_zero, fraction};
use dimos_hardware::check::{Checked, ConfigError, ToolFacts};
use dimos_hardware::registry::{AdapterConfig, AdapterSpec, AddressForm, Level, OptionsSpec, Teach};
use dimos_hardware::transport::can::{self, address::FORMS};
use model::{Model, SPEED};

/// The modes of the arm. It has no velocity mode.
const MODES: &[ControlMode] = &[ControlMode::Position, ControlMode::ServoPosition];

/// How often the arm sends its positions [Hz].
const NATIVE_RATE: f64 = 200.0;

/// The arm has no brakes: without power on its motors it falls.
const HOLDS_WHEN_DISABLED: bool = false;

/// The Piper's row in the adapter table.
pub const SPEC: AdapterSpec = AdapterSpec {
    name: "piper",
    about: "AgileX Piper, Piper-H, -L, -X, 6 joints and gripper",
    level: Level::Emulated,
    transport: "can",
    dof: (protocol::DOF, protocol::DOF),
    modes: MODES,
    wire_units: "0.001 deg, 0.001 mm",
    native_rate: NATIVE_RATE,
    accuracy: 0.01,
    resolution: 1.75e-5, // 0.001 deg
    error_code: 2,
    lag: 0.05,
    stale_after: Duration::from_millis(50),
    droop: 0.0,
    // It has goals, no stop of its own: a blocked joint presses on with its torque limit.
    relief: 0.04,
    // Gravity parks J2 and J3 at -1.999° and +1.971°, 0.035 rad outside their ranges (recorded on an arm).
    outside: 0.06,
    // MOVE J continues to the last goal; two periods of setpoints at 100 Hz.
    gap_tolerance: Duration::from_millis(20),
    after_gap: AfterGap::RestsAtSetpoint,
    topology: Topology::MultiTurn,
    address: AddressForm { form: FORMS, required: true, check: can::check },
    holds_when_disabled: HOLDS_WHEN_DISABLED,
    teach: Teach::No("its drag-teaching is begun with the button on the arm, and the arm falls without its motors"),
    gripper: true,
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(adapter::PiperAdapter::new(config)?)),
    emulate: Some(|config, place| Ok(Box::new(emulator::PiperEmulator::start(config, place)?))),
    service: None,
    wire: Some(messages::WIRE),
};

/// What a setpoint has besides positions. MOVE J has nothing else; the frames of MIT mode have more.
const SETPOINT: SetpointFields = SetpointFields {
    acceleration: Field::Refused("no frame has accelerations of a setpoint: CAN protocol V2"),
    at: Field::Refused("no frame has a time: CAN protocol V2"),
    expires: Field::Refused("no frame has a time: CAN protocol V2"),
    ..SetpointFields::each_as(Field::Withheld("MIT mode (frames 0x15A to 0x15F) has it and is not written yet"))
};

/// All arms of a model have the same limits; a connected one may have been given narrower ones.
fn check(config: &AdapterConfig) -> Result<Checked, ConfigError> {
    config.check_dof("piper", SPEC.dof)?;
    let options = config.options::<Options>()?;
    options.sim.check(options.model, emulator::PLAYABLE)?;
    let model = (options.model == Model::Piper).then_some(("piper", "link6"));
    let tool = ToolFacts { model, ..ToolFacts::default() };
    Ok(Checked::new(options.model.limits()).digital_inputs(0).max_payload(0.0).tool(tool).setpoint(SETPOINT))
}

/// Which gripper is fitted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum GripperKind {
    /// None, or one that is not to be used.
    None,
    /// Opens to 70 mm.
    #[default]
    Small,
    /// Opens to 100 mm.
    Large,
}

impl GripperKind {
    /// Widest opening [m].
    pub fn stroke(self) -> Option<f64> {
        match self {
            Self::None => None,
            Self::Small => Some(0.070),
            Self::Large => Some(0.100),
        }
    }
}

/// How streamed positions are followed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Follow {
    /// The controller smooths the way to each setpoint.
    #[default]
    Smooth,
    /// The controller hands each setpoint to the motors as it is: very stiff.
    Direct,
}

/// What a blueprint may set of a Piper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Which arm it is: `piper`, `piper_h`, `piper_l` or `piper_x`. The arm does not say.
    pub model: Model,
    /// Scales the speed of moves that the controller plans (0–1].
    #[serde(deserialize_with = "fraction")]
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 1))]
    pub speed_scale: f64,
    /// How streamed positions are followed (mode `servo_position`).
    pub follow: Follow,
    /// Which gripper is fitted.
    pub gripper: GripperKind,
    /// Maximum torque of the closing gripper (0–5] [Nm].
    #[serde(deserialize_with = "torque")]
    #[schemars(extend("exclusiveMinimum" = 0, "maximum" = 5))]
    pub gripper_torque: f64,
    /// Settings of the emulator.
    pub sim: emulator::SimOptions,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            model: Model::default(),
            speed_scale: 1.0,
            follow: Follow::default(),
            gripper: GripperKind::default(),
            gripper_torque: 1.0,
            sim: emulator::SimOptions::default(),
        }
    }
}

/// Reads a torque above 0 and at most 5 Nm.
fn torque<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    above_zero(deserializer, 5.0)
}

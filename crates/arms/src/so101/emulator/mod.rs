//! The servos of an SO-101, emulated on a pseudo-terminal: for `address: sim`, for tests, and for the vendor's SDK.
//!
//! Written from the memory table, and shares no code with the adapter: two sides that share an encoder share its
//! mistakes.

mod servos;
mod wire;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::JointLimits;
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::check::ConfigError;
use dimos_hardware::registry::{AdapterConfig, EmulatorAddress};
use dimos_hardware::sim::arm;
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::physics::PhysicsOptions;
use dimos_hardware::sim::serial_server::SerialServer;
pub use servos::Servos;

/// The faults that the servos can play.
const PLAYABLE: &[FaultKind] = &[
    FaultKind::Stall,
    FaultKind::Silent,
    FaultKind::LostCommand,
    FaultKind::Disconnect,
    FaultKind::ErrorCode,
    FaultKind::PowerLoss,
    FaultKind::Garbage,
    FaultKind::Corrupt,
    FaultKind::Truncated,
    FaultKind::WrongModel,
    FaultKind::Misread,
    FaultKind::Blocked,
    FaultKind::Pushed,
    FaultKind::Nudged,
    FaultKind::MotorOff,
];
/// Ranges of the joints and of the gripper [rad], and their speed [rad/s] and acceleration [rad/s²].
const RANGES: [(f64, f64); 6] =
    [(-1.92, 1.92), (-1.745, 1.745), (-1.69, 1.69), (-1.658, 1.658), (-2.744, 2.841), (-0.175, 1.745)];
const SPEED: f64 = 4.7;
const ACCELERATION: f64 = 30.0;

/// Settings of the emulator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SimOptions {
    /// Positions of the joints and the gripper at power-up [rad], zero in the middle of a servo's turn; empty for a
    /// pose without zeros.
    pub initial_positions: Vec<f64>,
    /// Lag of the servos behind their goals, 0 to 0.5 [s].
    #[schemars(range(min = 0, max = 0.5))]
    pub lag: f64,
    /// How far a joint rests below its goal under load, 0 to 0.2 [rad].
    #[schemars(range(min = 0, max = 0.2))]
    pub droop: f64,
    /// Whether the line returns what is sent on it.
    pub echo: bool,
    /// Numbers of the servos, from the base; 0 for one that is not on the line. Empty: those of the arm. New servos all
    /// have 1. Those after six are a second arm on the same line.
    pub ids: Vec<u8>,
    /// Whether the servos have the settings of the factory instead of those of an arm that is set up.
    pub factory: bool,
    /// Supply voltage, 4 to 14 [V].
    #[schemars(range(min = 4, max = 14))]
    pub voltage: f64,
    /// Faults, and when they begin (seconds after the first request).
    pub faults: Vec<Fault>,
    /// What the controller does otherwise than its documents say.
    pub controller: arm::ControllerOptions,
    /// A body with mass, by MuJoCo: `{}`, or with a seed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub physics: Option<PhysicsOptions>,
}

impl Default for SimOptions {
    fn default() -> Self {
        Self {
            initial_positions: Vec::new(),
            lag: 0.03,
            droop: 0.0,
            echo: false,
            ids: Vec::new(),
            factory: false,
            voltage: 12.0,
            faults: Vec::new(),
            controller: arm::ControllerOptions::default(),
            physics: None,
        }
    }
}

impl SimOptions {
    fn common(&self) -> arm::SimOptions {
        let Self { initial_positions, lag, droop, faults, controller, physics, .. } = self.clone();
        arm::SimOptions { initial_positions, lag, droop, faults, controller, physics }
    }

    /// Returns an error for values that the emulator cannot have.
    pub(super) fn check(&self) -> Result<(), ConfigError> {
        arm::check_range("voltage", self.voltage, 4.0..=14.0, "V")?;
        if self.ids.len() > 2 * RANGES.len() || self.ids.iter().any(|id| *id > 252) {
            return Err(ConfigError::new("sim.ids", "at most twelve servos have a number, 0 to 252"));
        }
        self.common().check("so101", &limits(), PLAYABLE)
    }
}

/// Returns the limits of the six servos as they are mounted.
fn limits() -> JointLimits {
    let (position_lower, position_upper) = RANGES.into_iter().unzip();
    JointLimits {
        position_lower,
        position_upper,
        velocity_max: vec![SPEED; RANGES.len()],
        acceleration_max: vec![ACCELERATION; RANGES.len()],
        jerk_max: Vec::new(),
    }
}

/// Starts an emulator at `place`, with the `sim` part of the arm's options. It runs until it is dropped.
pub fn start(config: &AdapterConfig, place: &EmulatorAddress) -> AdapterResult<SerialServer<Servos>> {
    config.check(super::check)?;
    let options = config.options::<super::Options>()?;
    let mut sim = options.sim.clone();
    if sim.ids.is_empty() {
        sim.ids = (options.first_id..).take(RANGES.len()).collect();
    }
    SerialServer::start("so101", Servos::new(&sim, MonotonicClock.now())?, place)
}

//! Options of every emulated arm: the `sim` part of its options.

use std::ops::RangeInclusive;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::faults::{Fault, FaultKind, check_script};
use super::physics::PhysicsOptions;
use crate::check::ConfigError;
use dimos_core::joint::JointLimits;

/// Default of [`SimOptions::lag`] [s].
const LAG: f64 = 0.01;
/// Largest lag that an emulator can have [s].
const MAX_LAG: f64 = 0.5;
/// Largest droop that an emulator can have [rad].
const MAX_DROOP: f64 = 0.2;

/// Settings of an emulator: the `sim` part of an arm's options. Arms with more settings there have these too.
// Arms with more settings repeat these fields instead of using serde's `flatten`, which would lose the position of a
// mistake in the blueprint and the arm's own defaults, and does not work with `deny_unknown_fields`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct SimOptions {
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
}

/// Where an emulated controller differs from its documents: what `dimos adapter test --first-day` must find.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ControllerOptions {
    /// Deceleration of the joints, 0.1 to 1000 [rad/s²]; 0 for the arm's own.
    #[schemars(range(min = 0, max = 1000))]
    pub deceleration: f64,
    /// How long it continues at the velocity of the last setpoints when none follows, 0 to 1 [s]; then it decelerates.
    /// 0 for its own behaviour. Only where joints follow setpoints that arrive as such.
    #[schemars(range(min = 0, max = 1))]
    pub gap_tolerance: f64,
    /// Whether it reports its own setpoints as joint positions, instead of measurements.
    pub reports_commanded: bool,
}

impl ControllerOptions {
    fn check(&self) -> Result<(), ConfigError> {
        if self.deceleration != 0.0 {
            check_range("controller.deceleration", self.deceleration, 0.1..=1000.0, "rad/s²")?;
        }
        check_range("controller.gap_tolerance", self.gap_tolerance, 0.0..=1.0, "s")
    }
}

impl Default for SimOptions {
    fn default() -> Self {
        Self {
            initial_positions: Vec::new(),
            lag: LAG,
            droop: 0.0,
            faults: Vec::new(),
            controller: ControllerOptions::default(),
            physics: None,
        }
    }
}

impl SimOptions {
    /// Uses this pose [rad] at power-up if the options give none.
    pub fn starting_at(mut self, pose: &[f64]) -> Self {
        if self.initial_positions.is_empty() {
            self.initial_positions = pose.to_vec();
        }
        self
    }

    /// Returns an error for a pose outside `limits`, values out of range, and faults that are not in `playable`. `name`
    /// is the name of the adapter.
    pub fn check(&self, name: &str, limits: &JointLimits, playable: &[FaultKind]) -> Result<(), ConfigError> {
        check_script(&format!("the {name} emulator"), &self.faults, playable)
            .and_then(|()| check_pose(&self.initial_positions, limits))
            .map_err(|error| error.within("sim"))
            .and_then(|()| check_range("lag", self.lag, 0.0..=MAX_LAG, "s"))
            .and_then(|()| check_range("droop", self.droop, 0.0..=MAX_DROOP, "rad"))
            .and_then(|()| self.controller.check())
    }
}

/// Returns an error for `initial_positions` [rad] that are neither empty nor a pose within `limits`.
pub fn check_pose(positions: &[f64], limits: &JointLimits) -> Result<(), ConfigError> {
    let (dof, given) = (limits.position_lower.len(), positions.len());
    let needed = format!("initial_positions must be {dof} positions [rad] within the joint limits");
    if given != 0 && given != dof {
        return Err(ConfigError::new("initial_positions", format!("{needed}, not {given}")));
    }
    let mut range = limits.position_lower.iter().zip(&limits.position_upper).zip(positions).enumerate();
    match range.find(|(_, ((lower, upper), value))| !(**lower..=**upper).contains(value)) {
        None => Ok(()),
        Some((joint, ((lower, upper), value))) => {
            let what = format!("{needed}: joint {} goes from {lower:.4} to {upper:.4}, not to {value}", joint + 1);
            Err(ConfigError::new(format!("initial_positions.{joint}"), what))
        }
    }
}

/// Returns an error for a setting of the `sim` part outside `range`. `unit` is for the message, empty for a number.
pub fn check_range(name: &str, value: f64, range: RangeInclusive<f64>, unit: &str) -> Result<(), ConfigError> {
    if range.contains(&value) {
        return Ok(());
    }
    let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
    let what = format!("{name} must be {} to {}{unit}, not {value}{unit}", range.start(), range.end());
    Err(ConfigError::new(format!("sim.{name}"), what))
}

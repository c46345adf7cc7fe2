//! Checks whether an arm's number of joints and options are consistent, and derives its limits, without the device.
//! Each row provides this as [`AdapterSpec::check`](super::registry::AdapterSpec); `dimos check` reports an error at
//! its position in the blueprint, and no adapter or emulator is created from such a configuration.

use std::fmt;

use serde::de::DeserializeOwned;

use super::adapter::{AdapterError, AdapterResult};
use super::registry::AdapterConfig;
use dimos_core::arm::{Impedance, SetpointFields, Topology};
use dimos_core::joint::JointLimits;
use dimos_core::message::Message;

/// What a valid configuration implies.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Checked {
    /// Nominal joint limits. A connected arm may narrow them.
    pub limits: JointLimits,
    /// Number of digital inputs; `None`: known once connected.
    pub digital_inputs: Option<u8>,
    /// Largest mass at the flange that the controller takes [kg], 0 if it takes neither a load nor a mounting; `None`:
    /// known once connected.
    pub max_payload: Option<f64>,
    /// How each joint's reading counts turns; empty: all as in the row.
    pub topology: Vec<Topology>,
    /// What limits the speed of the tool.
    pub tool: ToolFacts,
    /// What it takes of its line, if other arms may be on it.
    pub line: Option<LineShare>,
    /// What its adapter passes on of setpoints besides positions.
    pub setpoint: SetpointFields,
    /// How it is held in impedance mode, if it has that.
    pub impedance: Option<Impedance>,
}

/// What an arm takes of a line that several arms may share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LineShare {
    /// First and last number of its devices on the line.
    pub numbers: (u8, u8),
    /// The option that sets them.
    pub option: &'static str,
    /// Share of the line's time that its messages take at the arm's own rate.
    pub load: f64,
}

impl LineShare {
    /// Highest sum of the loads of a line: the rest is for the gaps between messages, and for those that are repeated.
    pub const MAX_LOAD: f64 = 0.8;

    /// Returns whether both arms can be on one line: no device of theirs has the same number.
    pub fn is_beside(&self, other: &Self) -> bool {
        self.numbers.1 < other.numbers.0 || other.numbers.1 < self.numbers.0
    }
}

/// What is known of an arm's tool without the arm.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ToolFacts {
    /// Highest speed of the tool that the controller takes, by its manual [m/s].
    pub velocity: Option<f64>,
    /// Whether that is a setting of the controller, so that a blueprint may also raise it.
    pub is_setting: bool,
    /// A built-in model of the arm, and its flange.
    pub model: Option<(&'static str, &'static str)>,
    /// Links besides flange and tool whose speed is limited, by the names that models give them.
    pub also: &'static [&'static str],
}

impl Checked {
    /// Creates the result for an arm of which only the limits are known before it is connected.
    pub fn new(limits: JointLimits) -> Self {
        Self { limits, ..Self::default() }
    }

    /// Says that the arm has these digital inputs.
    pub fn digital_inputs(self, number: u8) -> Self {
        Self { digital_inputs: Some(number), ..self }
    }

    /// Says that the controller takes loads up to this mass [kg]; 0: none.
    pub fn max_payload(self, mass: f64) -> Self {
        Self { max_payload: Some(mass), ..self }
    }

    /// Says what limits the speed of the tool.
    pub fn tool(self, tool: ToolFacts) -> Self {
        Self { tool, ..self }
    }

    /// Says what the arm takes of its line.
    pub fn line(self, line: LineShare) -> Self {
        Self { line: Some(line), ..self }
    }

    /// Says what its adapter passes on of setpoints besides positions.
    pub fn setpoint(self, fields: SetpointFields) -> Self {
        Self { setpoint: fields, ..self }
    }

    /// Says how it is held in impedance mode.
    pub fn impedance(self, impedance: Impedance) -> Self {
        Self { impedance: Some(impedance), ..self }
    }

    /// Says how each joint's reading counts turns.
    pub fn topology(self, topology: Vec<Topology>) -> Self {
        Self { topology, ..self }
    }
}

/// An invalid configuration and its location. `Display` prints `what`, without the hint.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ConfigError {
    /// The option, as a path with dots: `model`, `sim.faults.0.kind`. Empty for the number of joints, or for all
    /// options.
    pub option: String,
    /// What is wrong: a sentence without full stop.
    pub what: String,
    /// What to do.
    pub hint: Option<String>,
}

impl ConfigError {
    /// Creates an error at an option.
    pub fn new(option: impl Into<String>, what: impl Into<String>) -> Self {
        Self { option: option.into(), what: what.into(), hint: None }
    }

    /// Adds a hint.
    pub fn hint(mut self, hint: impl Into<String>) -> Self {
        self.hint = Some(hint.into());
        self
    }

    /// Puts the option into the group `group`: `faults.0` of `sim` becomes `sim.faults.0`.
    pub fn within(mut self, group: &str) -> Self {
        self.option = format!("{group}.{}", self.option);
        self
    }
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.what)
    }
}

impl From<ConfigError> for AdapterError {
    fn from(error: ConfigError) -> Self {
        Self::Rejected(Message { what: error.what, hint: error.hint }.to_string())
    }
}

impl AdapterConfig {
    /// Returns the options as the adapter's own type.
    pub fn options<T: DeserializeOwned>(&self) -> Result<T, ConfigError> {
        let given = if self.options.is_null() { serde_json::json!({}) } else { self.options.clone() };
        serde_json::from_value(given).map_err(|e| ConfigError::new("", format!("options: {e}")))
    }

    /// Returns an error for a number of joints that the adapter `name` cannot have.
    pub fn check_dof(&self, name: &str, (fewest, most): (usize, usize)) -> Result<(), ConfigError> {
        match self.dof {
            dof if (fewest..=most).contains(&dof) => Ok(()),
            dof if fewest == most => Err(ConfigError::new("", format!("{name} has {most} joints, not {dof}"))),
            dof => Err(ConfigError::new("", format!("{name} has {fewest} to {most} joints, not {dof}"))),
        }
    }

    /// Runs `check`; the error names the arm.
    pub fn check(&self, check: fn(&Self) -> Result<Checked, ConfigError>) -> AdapterResult<Checked> {
        check(self)
            .map_err(|error| ConfigError { what: format!("{}: {}", self.hardware_id, error.what), ..error }.into())
    }
}

/// Returns an error for a value of an option that is not within its range.
pub fn in_range(option: &str, value: f64, (least, most): (f64, f64)) -> Result<(), ConfigError> {
    if (least..=most).contains(&value) {
        return Ok(());
    }
    Err(ConfigError::new(option, format!("{option} is {least} to {most}, not {value}")))
}

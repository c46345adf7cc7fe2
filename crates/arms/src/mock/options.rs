//! What a blueprint may set of a mock arm.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::limits;
use dimos_hardware::check::ConfigError;
use dimos_hardware::sim::arm::{SimOptions, check_pose};
use dimos_hardware::sim::faults::{Fault, FaultKind, check_script};

/// The faults that a mock arm can play.
pub(super) const PLAYABLE: &[FaultKind] = &[
    FaultKind::ReadError,
    FaultKind::WriteError,
    FaultKind::Stall,
    FaultKind::Disconnect,
    FaultKind::ErrorCode,
    FaultKind::Estop,
    FaultKind::PowerLoss,
    FaultKind::Panic,
    FaultKind::Nan,
    FaultKind::ZeroState,
    FaultKind::WrongDof,
    FaultKind::Misread,
    FaultKind::Frozen,
    FaultKind::Sag,
    FaultKind::Blocked,
    FaultKind::InputLow,
    FaultKind::Object,
    FaultKind::GripperBlocked,
];

/// Options of a mock arm.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// Joint positions at the start [rad], one per joint; all zero when empty.
    pub initial_positions: Vec<f64>,
    /// How long every read and every write takes [ms of real time].
    #[schemars(range(min = 0, max = 10000))]
    pub latency_ms: f64,
    /// Time constant with which joints follow what is commanded [s]; 0 = at once.
    #[schemars(range(min = 0, max = 10))]
    pub lag: f64,
    /// Whether it has a gripper (0 to 0.08 m, 1 to 40 N).
    pub gripper: bool,
    /// Whether it reports joint velocities.
    pub velocity_feedback: bool,
    /// Whether it reports joint torques.
    pub effort_feedback: bool,
    /// Whether it has a force/torque sensor. It feels nothing: all values are zero.
    pub force_torque: bool,
    /// Whether it has brakes. Without, it sinks at 0.2 rad/s while its motors are disabled.
    pub brakes: bool,
    /// What goes wrong, and when.
    pub faults: Vec<Fault>,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            initial_positions: Vec::new(),
            latency_ms: 0.0,
            lag: 0.0,
            gripper: true,
            velocity_feedback: true,
            effort_feedback: false,
            force_torque: false,
            brakes: true,
            faults: Vec::new(),
        }
    }
}

impl Options {
    /// Says what is wrong with the values for an arm of `dof` joints.
    pub(super) fn check(&self, dof: usize) -> Result<(), ConfigError> {
        let given = self.initial_positions.len();
        if given != 0 && given != dof {
            let what = format!("initial_positions has {given} values for {dof} joints");
            return Err(ConfigError::new("initial_positions", what));
        }
        check_pose(&self.initial_positions, &limits(dof))?;
        for (name, value, max) in [("latency_ms", self.latency_ms, 10_000.0), ("lag", self.lag, 10.0)] {
            if !(0.0..=max).contains(&value) {
                return Err(ConfigError::new(name, format!("{name}: {value} is not between 0 and {max}")));
            }
        }
        check_script("mock", &self.faults, PLAYABLE)
    }

    /// What all simulated arms have.
    pub(super) fn sim(&self) -> SimOptions {
        let (initial_positions, faults) = (self.initial_positions.clone(), self.faults.clone());
        SimOptions { initial_positions, faults, ..SimOptions::default() }
    }
}

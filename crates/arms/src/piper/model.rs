//! The models: their ranges. They speak one protocol, which does not say which one an arm is.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::protocol::DOF;
use dimos_core::joint::JointLimits;

/// Highest speed [rad/s] and acceleration [rad/s²] of every joint.
pub const SPEED: f64 = 3.0;
const ACCELERATION: f64 = 5.0;

/// Lowest and highest position of each joint [rad].
type Ranges = [(f64, f64); DOF];

/// The arms that this adapter knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Model {
    /// Piper.
    #[default]
    Piper,
    /// Piper-H: a larger wrist.
    PiperH,
    /// Piper-L: longer links.
    PiperL,
    /// Piper-X: another wrist.
    PiperX,
}

impl Model {
    /// Returns the lowest and highest position of each joint [rad], by the vendor's data sheet and SDK (pyAgxArm).
    #[expect(clippy::approx_constant, reason = "the vendor's figure for joint 2, which is not π")]
    pub fn ranges(self) -> Ranges {
        let (wrist, tilt) = match self {
            Self::Piper => (1.745, 1.22),
            Self::PiperH => (2.356, 1.562),
            Self::PiperL => (2.2165, 1.562),
            Self::PiperX => (1.5533, 1.5533),
        };
        [(-2.6179, 2.6179), (0.0, 3.14), (-2.967, 0.0), (-wrist, wrist), (-tilt, tilt), (-2.09439, 2.09439)]
    }

    /// Returns the joint limits of the data sheet.
    pub fn limits(self) -> JointLimits {
        let ranges = self.ranges();
        JointLimits {
            position_lower: ranges.iter().map(|range| range.0).collect(),
            position_upper: ranges.iter().map(|range| range.1).collect(),
            velocity_max: vec![SPEED; DOF],
            acceleration_max: vec![ACCELERATION; DOF],
            jerk_max: Vec::new(),
        }
    }

    /// Returns the vendor's name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Piper => "Piper",
            Self::PiperH => "Piper-H",
            Self::PiperL => "Piper-L",
            Self::PiperX => "Piper-X",
        }
    }
}

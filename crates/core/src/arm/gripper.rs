//! What is known of an arm's gripper: units and ranges of its position and force.

use serde::{Deserialize, Serialize};

use crate::named::named;

named! {
    /// Unit of a gripper's position.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    pub enum GripperUnit {
        /// Opening between the fingers [m].
        #[default]
        #[serde(rename = "m")]
        Meters = "m",
        /// Angle of a rotary gripper's jaw [rad].
        #[serde(rename = "rad")]
        Radians = "rad",
        /// One that only opens and closes: 0 closed, or suction on; 1 open, or suction off. Nothing measures its
        /// fingers: its position is the order, as the device confirms it.
        #[serde(rename = "on_off")]
        OnOff = "on_off",
    }
}

impl GripperUnit {
    /// Returns whether there is such a position in this unit: one that only opens and closes has two.
    pub fn has(self, position: f64) -> bool {
        self != Self::OnOff || position == 0.0 || position == 1.0
    }
}

named! {
    /// Unit of a gripper's force.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
    pub enum ForceUnit {
        /// Force between the fingers [N].
        #[default]
        #[serde(rename = "N")]
        Newtons = "N",
        /// Torque of the jaw, or of the motor that drives the fingers [Nm].
        #[serde(rename = "Nm")]
        NewtonMeters = "Nm",
        /// Part of the device's largest force, which its vendor does not state [%].
        #[serde(rename = "%")]
        Percent = "%",
    }
}

/// Units and ranges of a gripper.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct GripperInfo {
    /// Unit of positions.
    pub unit: GripperUnit,
    /// Position when closed and when open, if known.
    pub range: Option<(f64, f64)>,
    /// Unit of forces.
    pub force_unit: ForceUnit,
    /// Smallest and largest force that can be commanded; `None` without force control.
    pub force_range: Option<(f64, f64)>,
    /// Whether a command may have a speed.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub has_speed: bool,
}

//! Parameters and replies of the methods for arms: stop, reset, enable, disable, leases, gripper.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::api::{Method, finite};

/// Parameters of `stop`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Stop {
    /// The arm to stop; default: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
}

/// Reply to `stop`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StopReply {
    /// Confirmation per arm.
    pub arms: BTreeMap<String, Confirmation>,
}

/// Whether an arm has received a stop.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Confirmation {
    /// The device confirmed the stop.
    Confirmed,
    /// It was sent, but the device did not confirm it in time, or cannot.
    SentNotConfirmed,
    /// The device could not be reached.
    NotSent,
}

impl Confirmation {
    /// Returns the text for tables and messages.
    pub fn text(self) -> &'static str {
        match self {
            Self::Confirmed => "confirmed",
            Self::SentNotConfirmed => "sent, not confirmed",
            Self::NotSent => "not sent: the arm cannot be reached",
        }
    }
}

/// Parameters of `arm_reset`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmReset {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Parameters of `arm_enable`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmEnable {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Parameters of `arm_disable`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmDisable {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Disables the motors at once, even while the arm moves; default: the arm decelerates to rest first.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub now: bool,
}

/// Reply to `arm_reset`, `arm_enable` and `arm_disable`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ArmReply {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Its phase now.
    pub phase: String,
    /// Further information for people.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

/// Parameters of `lease`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Lease {
    /// The arm; default: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
}

/// Parameters of `release`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Release {
    /// The arm; default: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
}

/// Reply to `lease` and `release`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct LeaseReply {
    /// The arms that this connection now holds, or has released.
    pub arms: Vec<String>,
}

impl Method for Lease {
    const NAME: &'static str = "lease";
    type Reply = LeaseReply;
}

impl Method for Release {
    const NAME: &'static str = "release";
    type Reply = LeaseReply;
}

/// Parameters of `gripper`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Gripper {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Position: the opening [m], or the angle [rad] of a rotary gripper (`gripper_unit` in `status`).
    pub position: f64,
    /// Largest force [`gripper_force_unit` in `status`]; default: the one set in the device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force: Option<f64>,
}

/// Reply to `gripper`: what was commanded.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct GripperReply {
    /// Position [`unit`].
    pub position: f64,
    /// Unit of the position: `m` of opening, or `rad` of a rotary jaw.
    pub unit: String,
    /// Largest force [`force_unit`]; absent: the one set in the device.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force: Option<f64>,
    /// Unit of the force: `N`, `Nm` or `%`; absent without a force.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub force_unit: Option<String>,
}

impl Gripper {
    pub(super) fn valid(&self) -> Result<(), String> {
        finite("position", &[self.position])?;
        finite("force", self.force.as_slice())
    }
}

//! Parameters and replies of the methods that change what an arm is ready for.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::api::{Method, finite};

/// Parameters of `stop`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Stop {
    /// Stops this arm only; without it, all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
}

/// What `stop` achieved, per arm.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StopReply {
    /// Confirmation per arm.
    pub arms: BTreeMap<String, Confirmation>,
}

/// How far a stop is known to have reached the arm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Confirmation {
    /// The device answered that it stops.
    Confirmed,
    /// It was sent, but the device has not confirmed it (or has no way to).
    SentNotConfirmed,
    /// The device could not be reached.
    NotSent,
}

impl Confirmation {
    /// The words used in tables.
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
    /// Switches the motors off at once, also while the arm moves. Without it the arm is brought to rest first.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub now: bool,
}

/// An arm after `arm_reset`, `arm_enable` or `arm_disable`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ArmReply {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Its phase now.
    pub phase: String,
    /// What else there is to say about it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
}

/// Parameters of `lease`: takes the right to move one arm, or all, for this connection.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Lease {
    /// This arm only; without it, all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
}

/// Parameters of `release`: gives back what this connection took.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Release {
    /// This arm only; without it, all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub arm: Option<String>,
}

/// Reply to `lease` and `release`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct LeaseReply {
    /// The arms that were taken, or given back.
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
    /// Opening [m].
    pub position: f64,
}

impl Gripper {
    pub(super) fn valid(&self) -> Result<(), String> {
        finite("position", &[self.position])?;
        if self.position < 0.0 { Err(format!("position is {}, and cannot be negative", self.position)) } else { Ok(()) }
    }
}

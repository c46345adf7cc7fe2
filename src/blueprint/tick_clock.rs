//! `coordinator.clock`: what starts a tick.

use std::fmt;
use std::str::FromStr;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::{Deserialize, Serialize};

use crate::blueprint::arms::Hardware;
use crate::blueprint::resolve::Checker;
use dimos_yaml::{Diag, quote};

/// What starts a tick.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(try_from = "String", into = "String")]
pub enum TickClock {
    /// The clock of this computer.
    #[default]
    Host,
    /// The states that the arm with this `hardware_id` streams.
    Device(String),
}

impl fmt::Display for TickClock {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Host => f.write_str("host"),
            Self::Device(arm) => write!(f, "device({arm})"),
        }
    }
}

impl FromStr for TickClock {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let arm = text.strip_prefix("device(").and_then(|rest| rest.strip_suffix(')')).map(str::trim);
        match (text, arm) {
            ("host", _) => Ok(Self::Host),
            (_, Some(arm)) if !arm.is_empty() => Ok(Self::Device(arm.to_owned())),
            _ => {
                Err(format!("{} is no clock\nhint: write host, or device(ARM) with an arm's hardware_id", quote(text)))
            }
        }
    }
}

impl TryFrom<String> for TickClock {
    type Error = String;

    fn try_from(text: String) -> Result<Self, String> {
        text.parse()
    }
}

impl From<TickClock> for String {
    fn from(clock: TickClock) -> Self {
        clock.to_string()
    }
}

impl JsonSchema for TickClock {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "TickClock".into()
    }

    fn inline_schema() -> bool {
        true
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        json_schema!({ "type": "string", "pattern": r"^(host|device\(.+\))$" })
    }
}

/// Checks that the arm of a clock is in the blueprint. Whether it can be the clock shows when it is connected.
pub(super) fn check(checker: &mut Checker<'_>, clock: &TickClock, hardware: &Hardware) {
    let TickClock::Device(arm) = clock else { return };
    if checker.list_lost("hardware") || hardware.arms.iter().any(|a| a.hardware_id == *arm) {
        return;
    }
    let at = checker.tree.entry(checker.root, "coordinator").and_then(|(_, node)| checker.tree.entry(node, "clock"));
    let known: Vec<String> = hardware.arms.iter().map(|a| format!("device({})", a.hardware_id)).collect();
    let diag = Diag::error(format!("no arm is named {}", quote(arm)));
    checker.error(at.map_or(checker.root, |(_, node)| node), diag.hint(format!("write {}", known.join(" or "))));
}

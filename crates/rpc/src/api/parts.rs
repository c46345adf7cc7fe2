//! Parameters and replies of the methods for an arm's optional parts: inputs and outputs, the load at the flange, the
//! tool.

use std::collections::BTreeMap;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::api::finite;
use crate::api::planner::PoseSpec;
use crate::report::TcpReport;
use dimos_core::arm::{Load, OutputValue, channel};

/// Parameters of `arm_io`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmIo {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Parameters of `arm_io_set`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmIoSet {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// New values by channel: 0 or 1 for `do0`, `do1`, …; the value in the channel's unit for `ao0`, `ao1`, …
    pub outputs: BTreeMap<String, f64>,
}

/// Reply to `arm_io` and `arm_io_set`: the levels now.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct IoReport {
    /// Digital inputs `di0`, `di1`, …: whether each is high.
    pub digital_inputs: Vec<bool>,
    /// Digital outputs `do0`, `do1`, …
    pub digital_outputs: Vec<bool>,
    /// Analogue inputs `ai0`, `ai1`, …
    pub analog_inputs: Vec<AnalogReport>,
    /// Analogue outputs `ao0`, `ao1`, …
    pub analog_outputs: Vec<AnalogReport>,
    /// The input that stops the arm; absent if the blueprint names none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub stop_input: Option<StopInputReport>,
}

/// An analogue channel.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct AnalogReport {
    /// Its value.
    pub value: f64,
    /// Unit of the value: `V` or `A`.
    pub unit: String,
}

/// The digital input that stops the arm.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
pub struct StopInputReport {
    /// Its name: `di0`.
    pub input: String,
    /// Whether it is open: the arm is held.
    pub open: bool,
}

/// Parameters of `arm_payload`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmPayload {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Parameters of `arm_payload_set`: the load at the flange.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmPayloadSet {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Mass of tool and workpiece together [kg].
    pub mass: f64,
    /// Centre of mass in the flange frame [m].
    #[serde(default)]
    pub center: [f64; 3],
    /// Inertia about the centre of mass, along the axes of the flange frame: xx, xy, xz, yy, yz, zz [kg·m²].
    #[serde(default)]
    pub inertia: [f64; 6],
}

/// Parameters of `arm_tare`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmTare {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Reply to `arm_tare`.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct TareReply {
    /// What is zero now: force and torque as the arm's controller reports them [N, N, N, Nm, Nm, Nm].
    pub wrench: [f64; 6],
}

/// Parameters of `arm_payload_find`: efforts of the arm at rest, with the load and, if known, without it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmPayloadFind {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Places and efforts with the load, 1 to 200. Friction is left out if each place is reached from both sides and
    /// its efforts are the mean.
    pub loaded: Vec<RestingEffort>,
    /// The same places without the load: then errors of the model do not count.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub unloaded: Vec<RestingEffort>,
}

/// Efforts of an arm at rest.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RestingEffort {
    /// Positions of its joints [rad or m].
    pub position: Vec<f64>,
    /// Efforts of its joints [Nm or N].
    pub effort: Vec<f64>,
}

impl ArmPayloadFind {
    pub(crate) fn valid(&self) -> Result<(), String> {
        match (self.loaded.len(), self.unloaded.len()) {
            (1..=200, 0) => Ok(()),
            (loaded @ 1..=200, unloaded) if loaded == unloaded => Ok(()),
            (loaded, 0) => Err(format!("{loaded} places, may be 1 to 200")),
            (loaded, unloaded) => Err(format!("{loaded} places with the load and {unloaded} without it")),
        }
    }
}

/// Reply to `arm_payload_find`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct FoundPayload {
    /// Mass of all at the flange beyond the arm's model [kg].
    pub mass: f64,
    /// Its centre in the flange frame [m]; null below 20 g.
    pub center: Option<[f64; 3]>,
    /// What is left of each joint's efforts, root mean square [Nm or N].
    pub residual: Vec<f64>,
}

/// Reply to `arm_payload` and `arm_payload_set`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct PayloadReply {
    /// The load that the controller reports; null if it reports none.
    pub payload: Option<LoadReport>,
}

/// A load at the flange.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct LoadReport {
    /// Mass [kg].
    pub mass: f64,
    /// Centre of mass in the flange frame [m].
    pub center: [f64; 3],
    /// Inertia about the centre of mass: xx, xy, xz, yy, yz, zz [kg·m²]; zeros if unknown.
    pub inertia: [f64; 6],
}

/// Parameters of `arm_tool`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmTool {
    /// The arm's `hardware_id`.
    pub arm: String,
}

/// Farthest tool centre point along an axis of its link [m]: more is a length in mm.
const MAX_TOOL: f64 = 5.0;

/// Parameters of `arm_tool_set`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct ArmToolSet {
    /// The arm's `hardware_id`.
    pub arm: String,
    /// Pose of the tool centre point in the frame of the end-effector link, at most 5 m along each axis; null: no tool.
    pub tool: Option<PoseSpec>,
}

impl ArmToolSet {
    pub(crate) fn valid(&self) -> Result<(), String> {
        let Some(tool) = self.tool else { return Ok(()) };
        tool.valid("tool")?;
        match tool.xyz.iter().find(|v| v.abs() > MAX_TOOL) {
            Some(far) => Err(format!("tool.xyz has {far} m, must be within ±{MAX_TOOL} m")),
            None => Ok(()),
        }
    }
}

/// Reply to `arm_tool` and `arm_tool_set`.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize, JsonSchema)]
pub struct ArmToolReply {
    /// The arm.
    pub arm: String,
    /// Its tool centre point.
    pub tcp: TcpReport,
}

impl From<Load> for LoadReport {
    fn from(load: Load) -> Self {
        Self { mass: load.mass, center: load.center, inertia: load.inertia }
    }
}

impl From<LoadReport> for Load {
    fn from(load: LoadReport) -> Self {
        Self { mass: load.mass, center: load.center, inertia: load.inertia }
    }
}

impl ArmPayloadSet {
    /// Returns the load.
    pub fn load(&self) -> Load {
        Load { mass: self.mass, center: self.center, inertia: self.inertia }
    }

    pub(crate) fn valid(&self) -> Result<(), String> {
        self.load().check()
    }
}

impl ArmIoSet {
    pub(crate) fn valid(&self) -> Result<(), String> {
        if self.outputs.is_empty() {
            return Err("outputs is empty".into());
        }
        self.values().map(drop)
    }

    /// Returns the values in the order of their names; the error names the wrong one.
    pub fn values(&self) -> Result<Vec<OutputValue>, String> {
        let value = |(name, value): (&String, &f64)| {
            finite(name, &[*value])?;
            match (channel(name, "do"), channel(name, "ao")) {
                (Some(output), _) if *value == 0.0 || *value == 1.0 => Ok(OutputValue::Digital(output, *value == 1.0)),
                (Some(_), _) => Err(format!("{name} is a digital output: it can be 0 or 1, not {value}")),
                (_, Some(output)) => Ok(OutputValue::Analog(output, *value)),
                _ => Err(format!("{name} is not an output: outputs are do0, do1, … and ao0, ao1, …")),
            }
        };
        self.outputs.iter().map(value).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn outputs_are_checked_by_name_and_value() {
        let set = |name: &str, value: f64| {
            ArmIoSet { arm: "arm".into(), outputs: BTreeMap::from([(name.to_owned(), value)]) }.values()
        };
        assert_eq!(set("do3", 1.0), Ok(vec![OutputValue::Digital(3, true)]));
        assert_eq!(set("ao1", 2.5), Ok(vec![OutputValue::Analog(1, 2.5)]));
        for (name, value) in [("do3", 0.5), ("di3", 1.0), ("do", 1.0), ("do99", 1.0), ("ao0", f64::NAN)] {
            assert!(set(name, value).unwrap_err().contains(name), "{name}");
        }
        assert!(ArmIoSet::default().valid().is_err());
    }
}

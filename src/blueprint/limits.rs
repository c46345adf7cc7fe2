//! `hardware[].limits`: limits narrower than the arm's own, as written and resolved per joint.

use std::fmt;

use schemars::{JsonSchema, Schema, SchemaGenerator, json_schema};
use serde::de::{Deserializer, Error, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Serialize};

use crate::blueprint::resolve::Checker;
use dimos_core::joint::JointLimits;
use dimos_yaml::{Diag, Keyed, Located, NodeId, did_you_mean, quote};

/// Limits narrower than the arm's own.
#[derive(Debug, Clone, Default, Deserialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LimitsEntry {
    /// Lowest and highest position [rad]: `[-1, 1]` for all joints, or by joint: `{arm_joint2: [-1, 1]}`.
    pub position: Option<Located<Positions>>,
    /// Highest speed [rad/s]: a number for all joints, a list, or by joint: `{arm_joint2: 0.5}`.
    pub velocity: Option<Located<PerJoint>>,
    /// Highest acceleration [rad/s²], in the same forms. Default: the arm's own, else 2.
    pub acceleration: Option<Located<PerJoint>>,
    /// Highest jerk [rad/s³], in the same forms. Default: the arm's own, else 20.
    pub jerk: Option<Located<PerJoint>>,
    /// Highest effort of commands [Nm, N for a linear joint], in the same forms. Default: that of the arm's model.
    pub effort: Option<Located<PerJoint>>,
    /// Highest change of that effort [Nm/s, N/s], in the same forms. Default: all of `effort` within 0.1 s.
    pub effort_rate: Option<Located<PerJoint>>,
    /// Highest speed of tool centre point and flange [m/s]. Default: the vendor's, in the arm's page.
    #[schemars(extend("exclusiveMinimum" = 0))]
    pub tcp_velocity: Option<Located<f64>>,
}

/// Position limits: one pair for all joints, or pairs by joint name.
#[derive(Debug, Clone)]
pub enum Positions {
    /// Lowest and highest, for all joints.
    All(f64, f64),
    /// By joint.
    Named(Keyed<Located<(f64, f64)>>),
}

/// A number for all joints, a list with one for each, or numbers by joint name.
#[derive(Debug, Clone)]
pub enum PerJoint {
    /// For all joints.
    All(f64),
    /// One for each joint.
    Each(Vec<Located<f64>>),
    /// By joint.
    Named(Keyed<Located<f64>>),
}

impl<'de> Deserialize<'de> for Positions {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(PositionsVisitor)
    }
}

struct PositionsVisitor;

impl<'de> Visitor<'de> for PositionsVisitor {
    type Value = Positions;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("[LOWEST, HIGHEST] or {JOINT: [LOWEST, HIGHEST]}")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<Positions, A::Error> {
        let mut numbers = Vec::new();
        while let Some(number) = seq.next_element::<f64>()? {
            numbers.push(number);
        }
        match numbers[..] {
            [lower, upper] => Ok(Positions::All(lower, upper)),
            _ => Err(A::Error::custom(format!(
                "expected two numbers, found {}\nhint: write [lowest, highest], in radians",
                numbers.len()
            ))),
        }
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Positions, A::Error> {
        let mut entries = Vec::new();
        while let Some(entry) = map.next_entry()? {
            entries.push(entry);
        }
        Ok(Positions::Named(Keyed(entries)))
    }
}

impl JsonSchema for Positions {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "Positions".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let pair = || json_schema!({ "type": "array", "items": { "type": "number" }, "minItems": 2, "maxItems": 2 });
        json_schema!({ "anyOf": [pair(), { "type": "object", "additionalProperties": pair() }] })
    }
}

impl<'de> Deserialize<'de> for PerJoint {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(PerJointVisitor)
    }
}

struct PerJointVisitor;

impl<'de> Visitor<'de> for PerJointVisitor {
    type Value = PerJoint;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a number, a list of numbers or {JOINT: NUMBER}")
    }

    fn visit_f64<E>(self, value: f64) -> Result<PerJoint, E> {
        Ok(PerJoint::All(value))
    }

    fn visit_i64<E>(self, value: i64) -> Result<PerJoint, E> {
        Ok(PerJoint::All(value as f64))
    }

    fn visit_u64<E>(self, value: u64) -> Result<PerJoint, E> {
        Ok(PerJoint::All(value as f64))
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut seq: A) -> Result<PerJoint, A::Error> {
        let mut values = Vec::new();
        while let Some(value) = seq.next_element()? {
            values.push(value);
        }
        Ok(PerJoint::Each(values))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<PerJoint, A::Error> {
        let mut entries = Vec::new();
        while let Some(entry) = map.next_entry()? {
            entries.push(entry);
        }
        Ok(PerJoint::Named(Keyed(entries)))
    }
}

impl JsonSchema for PerJoint {
    fn schema_name() -> std::borrow::Cow<'static, str> {
        "PerJoint".into()
    }

    fn json_schema(_: &mut SchemaGenerator) -> Schema {
        let number = || json_schema!({ "type": "number", "exclusiveMinimum": 0 });
        json_schema!({ "anyOf": [
            number(), { "type": "array", "items": number() }, { "type": "object", "additionalProperties": number() }
        ] })
    }
}

/// Limits of one joint in the blueprint; `None`: the arm's own limit applies.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct JointOverride {
    /// Lowest position [rad].
    pub position_lower: Option<f64>,
    /// Highest position [rad].
    pub position_upper: Option<f64>,
    /// Highest speed [rad/s].
    pub velocity: Option<f64>,
    /// Highest acceleration [rad/s²].
    pub acceleration: Option<f64>,
    /// Highest jerk [rad/s³].
    pub jerk: Option<f64>,
    /// Highest effort of commands [Nm or N].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub effort: Option<f64>,
    /// Highest change of that [Nm/s or N/s].
    #[serde(skip_serializing_if = "Option::is_none")]
    pub effort_rate: Option<f64>,
}

/// Checks the limits of an arm against its own, and returns them per joint.
pub(super) fn resolve(
    checker: &mut Checker<'_>,
    entry: &LimitsEntry,
    joints: &[String],
    own: Option<&JointLimits>,
) -> Vec<JointOverride> {
    let mut out = vec![JointOverride::default(); joints.len()];
    if let Some(position) = &entry.position {
        for (joint, (lower, upper), at) in spread_positions(checker, position, joints) {
            let arms = own.and_then(|o| Some((*o.position_lower.get(joint)?, *o.position_upper.get(joint)?)));
            if checker.lost.contains(at) {
                continue;
            }
            if lower >= upper {
                let diag = Diag::error(format!("the lowest position {lower} is not below the highest, {upper}"));
                checker.error(at, diag.hint("write [lowest, highest], in radians"));
            } else if let Some((low, high)) = arms
                && (lower < low || upper > high)
            {
                let name = joints.get(joint).map_or("", String::as_str);
                let diag = Diag::error(format!("`{name}`: [{lower}, {upper}] is wider than the arm's own range"));
                let diag = diag.note(format!("the arm's own range is {low} to {high} rad"));
                checker.error(at, diag.hint("limits can only narrow the arm's own; omit them to use the full range"));
            }
            if let Some(slot) = out.get_mut(joint) {
                (slot.position_lower, slot.position_upper) = (Some(lower), Some(upper));
            }
        }
    }
    /// Name, unit, limit in the blueprint, the arm's own limits, and the field to set.
    type Top<'e> =
        (&'e str, &'e str, &'e Option<Located<PerJoint>>, &'e [f64], fn(&mut JointOverride) -> &mut Option<f64>);
    let none: &[f64] = &[];
    let tops: [Top<'_>; 5] = [
        ("speed", "rad/s", &entry.velocity, own.map_or(none, |o| &o.velocity_max), |o| &mut o.velocity),
        ("acceleration", "rad/s²", &entry.acceleration, own.map_or(none, |o| &o.acceleration_max), |o| {
            &mut o.acceleration
        }),
        ("jerk", "rad/s³", &entry.jerk, own.map_or(none, |o| &o.jerk_max), |o| &mut o.jerk),
        ("effort", "Nm", &entry.effort, none, |o| &mut o.effort),
        ("rate of the effort", "Nm/s", &entry.effort_rate, none, |o| &mut o.effort_rate),
    ];
    for (what, unit, given, own, slot) in tops {
        let Some(given) = given else { continue };
        for (joint, value, at) in spread(checker, given, joints) {
            let top = own.get(joint).copied();
            if value <= 0.0 {
                let diag = Diag::error(format!("the {what} limit must be above 0, not {value}"));
                checker.error(at, diag.hint(format!("give it in {unit}, or omit it to use the arm's own limit")));
            } else if let Some(top) = top.filter(|top| value > *top) {
                let name = joints.get(joint).map_or("", String::as_str);
                let diag = Diag::error(format!("`{name}`: {value} {unit} is above the arm's own {what} limit"));
                let diag = diag.note(format!("the arm's own limit is {top} {unit}"));
                checker.error(at, diag.hint("limits can only narrow the arm's own; omit this one to use that"));
            }
            if let Some(joint) = out.get_mut(joint) {
                *slot(joint) = Some(value);
            }
        }
    }
    out
}

/// Returns the position limits by joint index, each with its node.
fn spread_positions(
    checker: &mut Checker<'_>,
    given: &Located<Positions>,
    joints: &[String],
) -> Vec<(usize, (f64, f64), NodeId)> {
    match &given.value {
        Positions::All(lower, upper) => (0..joints.len()).map(|i| (i, (*lower, *upper), given.at)).collect(),
        Positions::Named(named) => {
            let found = named.0.iter().map(|(name, pair)| (joint_index(checker, name, joints), pair));
            found.filter_map(|(joint, pair)| Some((joint?, pair.value, pair.at))).collect()
        }
    }
}

/// Returns the values by joint index, each with its node.
fn spread(checker: &mut Checker<'_>, given: &Located<PerJoint>, joints: &[String]) -> Vec<(usize, f64, NodeId)> {
    match &given.value {
        PerJoint::All(value) => (0..joints.len()).map(|i| (i, *value, given.at)).collect(),
        PerJoint::Each(values) => {
            if values.len() != joints.len() && !checker.lost.contains(given.at) && !joints.is_empty() {
                let diag = Diag::error(format!("{} values for {} joints", values.len(), joints.len()));
                checker.error(given.at, diag.hint("give one for each joint, or name the joints: {JOINT: NUMBER}"));
            }
            values.iter().enumerate().map(|(i, value)| (i, value.value, value.at)).collect()
        }
        PerJoint::Named(named) => {
            let found = named.0.iter().map(|(name, value)| (joint_index(checker, name, joints), value));
            found.filter_map(|(joint, value)| Some((joint?, value.value, value.at))).collect()
        }
    }
}

fn joint_index(checker: &mut Checker<'_>, name: &Located<String>, joints: &[String]) -> Option<usize> {
    let found = joints.iter().position(|joint| *joint == name.value);
    // A mistake in the joints has been reported.
    if found.is_none() && !joints.is_empty() {
        let diag = Diag::error(format!("this arm has no joint {}", quote(name)));
        let hint = did_you_mean(name, joints.iter().map(String::as_str), "its joints");
        checker.error(name.at, diag.maybe_hint(hint));
    }
    found
}

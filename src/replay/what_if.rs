//! What would have been: the recorded states and requests of a run with a changed configuration. The states are those
//! of the log: how the arms would have followed other commands is unknown.

use std::path::Path;

use serde::Serialize;
use serde_json::Value;

use super::compare::{Comparison, Difference};
use super::recorded::{Recorded, RecordedError};
use super::verify::{Finding, Rerun};
use dimos_control::config::CoordinatorConfig;
use dimos_control::task_spec::TaskTable;

/// Maximum number of events that are kept.
const MAX_EVENTS: usize = 1000;

/// The differences between a log and its replay with another configuration.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct WhatIf {
    /// Ticks replayed, and those whose commands or events differ.
    pub ticks: u64,
    /// See `ticks`.
    pub different: u64,
    /// Time from the first to the last tick [s].
    pub length: f64,
    /// The first difference.
    pub first: Option<Difference>,
    /// The joints whose commands differ.
    pub joints: Vec<JointChange>,
    /// Events that only one of both has; the first 1000.
    pub events: Vec<EventChange>,
    /// Why not all of the log was replayed.
    pub incomplete: Option<String>,
}

/// How the commands of a joint differ.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct JointChange {
    /// The joint.
    pub joint: String,
    /// Number of ticks in which they do.
    pub ticks: u64,
    /// Largest difference [rad, rad/s or Nm]; 0 if there is never a command in both.
    pub largest: f64,
    /// Time of the largest difference [s after the first tick].
    pub time: f64,
    /// The command in the log then.
    pub logged: Option<f64>,
    /// The command of the replay then.
    pub rerun: Option<f64>,
}

/// An event that only one of both has.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EventChange {
    /// Time [s after the first tick].
    pub time: f64,
    /// Whether it is the log that has it.
    pub logged: bool,
    /// The event.
    pub text: String,
}

/// A command that differs.
#[derive(Debug, Clone, Copy)]
pub struct Row<'a> {
    /// Index of the tick.
    pub tick: u64,
    /// Time [s after the first tick].
    pub time: f64,
    /// The joint.
    pub joint: &'a str,
    /// Command in the log, NaN if there is none.
    pub logged: f64,
    /// Command of the replay, NaN if there is none.
    pub rerun: f64,
}

/// Replays a log with changed values of its `coordinator.json`; `each` gets every command that differs, and
/// `progress` how much of how much is read [bytes].
///
/// # Errors
/// The log cannot be verified, a path does not exist, or a value does not fit.
pub fn what_if(
    path: &Path,
    table: &TaskTable,
    changes: &[(String, String)],
    mut each: impl FnMut(Row<'_>),
    progress: &mut dyn FnMut(u64, u64),
) -> Result<WhatIf, RecordedError> {
    let recorded = Recorded::open(path)?;
    recorded.check_version()?;
    let unfit = |what| RecordedError::Change { what };
    let config = changed(&recorded, changes).map_err(unfit)?;
    recorded.check(&config).map_err(unfit)?;
    let tasks = table.build(&config.tasks).map_err(unfit)?;
    let comparison = Comparison::new(&recorded);
    let mut found = WhatIf::default();
    let mut joints: Vec<JointChange> = Vec::new();
    let mut see = |logged: &super::inputs::LoggedTick, output: &_, ns: u64| {
        let (tick, time) = (logged.tick.tick, ns as f64 * 1e-9);
        let Some(difference) = comparison.compare(logged, output, ns) else { return };
        found.different += 1;
        found.first.get_or_insert(difference);
        comparison.commands(logged, output, |index, joint, logged, rerun| {
            if logged.to_bits() == rerun.to_bits() || logged.is_nan() && rerun.is_nan() {
                return;
            }
            each(Row { tick, time, joint, logged, rerun });
            joints.resize(joints.len().max(index + 1), JointChange::default());
            let Some(change) = joints.get_mut(index) else { return };
            change.ticks += 1;
            let by = (rerun - logged).abs();
            let known = |value: f64| Some(value).filter(|value| value.is_finite());
            if change.ticks == 1 || by > change.largest {
                let largest = if by.is_finite() { by } else { 0.0 };
                let (joint, ticks) = (joint.to_owned(), change.ticks);
                *change = JointChange { joint, ticks, largest, time, logged: known(logged), rerun: known(rerun) };
            }
        });
        let (then, now) = comparison.other_events(&logged.events, output);
        let both = then.into_iter().map(|text| (true, text)).chain(now.into_iter().map(|text| (false, text)));
        let room = MAX_EVENTS.saturating_sub(found.events.len());
        found.events.extend(both.take(room).map(|(logged, text)| EventChange { time, logged, text }));
    };
    let mut run = Rerun::new(&recorded, &config, tasks).seen_by(&mut see);
    let cut = run.read(path, progress)?;
    let ran = run.finish(cut);
    (found.ticks, found.length) = (ran.ticks, ran.length);
    found.joints = joints.into_iter().filter(|change| change.ticks > 0).collect();
    if let Finding::Incomplete { tick, why } = ran.finding {
        found.incomplete = Some(format!("nothing is known from tick {tick} on: {why}"));
    }
    Ok(found)
}

/// Returns the configuration of a run with other values.
fn changed(recorded: &Recorded, changes: &[(String, String)]) -> Result<CoordinatorConfig, String> {
    let mut config = serde_json::to_value(&recorded.config).map_err(|e| e.to_string())?;
    for (path, text) in changes {
        let mut at = &mut config;
        let mut joints: &[String] = &[];
        for key in path.split('.') {
            let known = keys(at, joints);
            let next = child(at, key, joints);
            at = next.ok_or_else(|| format!("{path}: there is no {key}\nhint: {}", known.join(", ")))?;
            if let Some(arm) = recorded.names.arms.iter().find(|arm| arm.hardware_id == key) {
                joints = &arm.joints;
            }
        }
        let value: Value = serde_json::from_str(text).unwrap_or_else(|_| Value::from(text.as_str()));
        set(at, value).map_err(|what| format!("{path}={text}: {what}"))?;
    }
    serde_json::from_value(config).map_err(|e| e.to_string())
}

/// Returns what a key selects: a field, here or, if there is only one, further inside; an arm or task by its name; an
/// entry of a list by its number from 0 or its joint.
fn child<'a>(at: &'a mut Value, key: &str, joints: &[String]) -> Option<&'a mut Value> {
    match at {
        Value::Object(fields) => {
            if fields.contains_key(key) {
                return fields.get_mut(key);
            }
            let has = |value: &Value| value.is_object() && holds(value, key) == 1;
            let mut inside = fields.values_mut().filter(|value| has(value));
            let only = inside.next()?;
            if inside.next().is_some() { None } else { child(only, key, joints) }
        }
        Value::Array(list) => {
            let named = list.iter().position(|entry| entry["name"] == *key);
            let joint = || joints.iter().position(|joint| joint == key);
            list.get_mut(named.or_else(joint).or_else(|| key.parse().ok())?)
        }
        _ => None,
    }
}

/// Returns how often a field is in an object.
fn holds(value: &Value, key: &str) -> usize {
    let Value::Object(fields) = value else { return 0 };
    usize::from(fields.contains_key(key)) + fields.values().map(|inner| holds(inner, key)).sum::<usize>()
}

fn keys(at: &Value, joints: &[String]) -> Vec<String> {
    match at {
        Value::Object(fields) => fields.keys().cloned().collect(),
        Value::Array(list) if list.iter().any(|entry| entry["name"].is_string()) => {
            list.iter().filter_map(|entry| Some(entry["name"].as_str()?.to_owned())).collect()
        }
        Value::Array(list) => joints.iter().take(list.len()).cloned().collect(),
        _ => vec!["it is a value".to_owned()],
    }
}

/// Replaces a value by one of its kind; a number fills a list of numbers, and is the seconds of a span of time.
fn set(at: &mut Value, value: Value) -> Result<(), String> {
    match at {
        Value::Array(list) if value.is_number() => list.fill(value),
        Value::Object(span) if span.contains_key("nanos") && value.is_number() => {
            let seconds = value.as_f64().filter(|s| (0.0..=1e9).contains(s)).ok_or("a time in seconds is expected")?;
            *at = serde_json::json!({"secs": seconds as u64, "nanos": (seconds.fract() * 1e9) as u32});
        }
        Value::Object(fields) => {
            let keys: Vec<&str> = fields.keys().map(String::as_str).collect();
            return Err(format!("it has several values\nhint: {}", keys.join(", ")));
        }
        _ if at.is_null() || std::mem::discriminant(at) == std::mem::discriminant(&value) => *at = value,
        _ => return Err(format!("the value is {at} now, and needs another of its kind")),
    }
    Ok(())
}

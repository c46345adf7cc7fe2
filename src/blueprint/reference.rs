//! Writes `docs/blueprint-reference.md` from the JSON Schema, so that it never differs from what is accepted.

use std::fmt::Write;

use serde::de::{Deserialize, Deserializer, Visitor};
use serde_json::Value;

use crate::blueprint::json_schema::full_schema;
use crate::blueprint::limits::LimitsEntry;
use crate::blueprint::params::{CartesianParams, ServoParams, TrajectoryParams, VelocityParams};
use crate::blueprint::planner::{GripperJointEntry, ObjectEntry, PlannerConfig, PoseEntry, RobotConfig, ViewConfig};
use crate::blueprint::schema::{
    AssetEntry, BlueprintFile, CoordinatorConfig, CountedJoints, HardwareEntry, RecordingConfig, RpcConfig, TaskEntry,
};
use crate::hardware::registry::Registry;

const INTRODUCTION: &str = "\
# Blueprint reference

A blueprint is a YAML file that says which arms there are and what is done with them. `dimos run NAME|PATH` runs one,
`dimos check NAME|PATH` finds every mistake in it, `dimos list-blueprints` shows those that can be run by name:
from `./blueprints`, the folders in `$DIMOS_BLUEPRINT_PATH`, `~/.config/dimos/blueprints`, and the binary itself, in this
order. Units are SI: rad, rad/s, m, s, Hz.

`--set path=value` changes one value for one run; entries of lists are addressed by their id:
`--set hardware.arm.address=192.168.1.100`, `--set coordinator.tick_rate=250`. `--sim` gives every arm its emulator.

YAML is read by version 1.2: booleans are `true` and `false` (`yes` is a text), keys are given once, numbers are finite.
A file has at most 1 MiB.

This page is generated. Regenerate it with `DIMOS_REGENERATE=1 cargo test --lib blueprint`.

";

/// A section of the page.
struct Section {
    title: &'static str,
    /// What comes first; where empty, the type's own description.
    first: &'static str,
    /// Where its keys are in the schema.
    pointer: &'static str,
    /// Its keys in the order of the type.
    keys: fn() -> &'static [&'static str],
}

const fn section(title: &'static str, first: &'static str, pointer: &'static str, keys: fn() -> Keys) -> Section {
    Section { title, first, pointer, keys }
}

const ARMS: &str = "A list of arms, merged by `hardware_id` when blueprints are included.";
const TASKS: &str = "A list of tasks, merged by `name` when blueprints are included.";

const SECTIONS: [Section; 19] = [
    section("Top level", "", "", keys::<BlueprintFile>),
    section("`coordinator`", "", "/$defs/CoordinatorConfig", keys::<CoordinatorConfig>),
    section("`hardware[]`", ARMS, "/$defs/HardwareEntry", keys::<HardwareEntry>),
    section("`hardware[].joints`, short form", "", "/$defs/CountedJoints", keys::<CountedJoints>),
    section("`hardware[].limits`", "", "/$defs/LimitsEntry", keys::<LimitsEntry>),
    section("`tasks[]`", TASKS, "/$defs/TaskEntry", keys::<TaskEntry>),
    section("`params` of `trajectory`", "", "/$defs/TrajectoryParams", keys::<TrajectoryParams>),
    section("`params` of `servo`", "", "/$defs/ServoParams", keys::<ServoParams>),
    section("`params` of `velocity`", "", "/$defs/VelocityParams", keys::<VelocityParams>),
    section("`params` of `cartesian_ik` and `eef_twist`", "", "/$defs/CartesianParams", keys::<CartesianParams>),
    section("`planner`", "", "/$defs/PlannerConfig", keys::<PlannerConfig>),
    section("`planner.robots[]`", "A list of robots, merged by `name`.", "/$defs/RobotConfig", keys::<RobotConfig>),
    section("`planner.robots[].gripper_joint`", "", "/$defs/GripperJointEntry", keys::<GripperJointEntry>),
    section("`planner.robots[].base_pose`", "", "/$defs/PoseEntry", keys::<PoseEntry>),
    section("`planner.world`", "A group of obstacles by name.", "/$defs/ObjectEntry", keys::<ObjectEntry>),
    section("`view`", "", "/$defs/ViewConfig", keys::<ViewConfig>),
    section("`recording`", "", "/$defs/RecordingConfig", keys::<RecordingConfig>),
    section("`rpc`", "", "/$defs/RpcConfig", keys::<RpcConfig>),
    section("`assets`", "A group of files by name.", "/$defs/AssetEntry", keys::<AssetEntry>),
];

type Keys = &'static [&'static str];

/// The keys of a type in the order of its fields, which the schema does not keep.
fn keys<T: Deserialize<'static>>() -> Keys {
    match T::deserialize(AskKeys) {
        Err(Asked(keys)) => keys,
        Ok(_) => &[],
    }
}

/// Is told the keys of the type that is read from it, and gives them as its error.
struct AskKeys;

#[derive(Debug)]
struct Asked(Keys);

impl std::fmt::Display for Asked {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{:?}", self.0)
    }
}

impl std::error::Error for Asked {}

impl serde::de::Error for Asked {
    fn custom<T: std::fmt::Display>(_: T) -> Self {
        Self(&[])
    }
}

impl Deserializer<'static> for AskKeys {
    type Error = Asked;

    fn deserialize_any<V: Visitor<'static>>(self, _visitor: V) -> Result<V::Value, Asked> {
        Err(Asked(&[]))
    }

    fn deserialize_struct<V: Visitor<'static>>(
        self,
        _name: &'static str,
        fields: Keys,
        _visitor: V,
    ) -> Result<V::Value, Asked> {
        Err(Asked(fields))
    }

    serde::forward_to_deserialize_any! {
        <V: Visitor<'static>>
        bool i8 i16 i32 i64 i128 u8 u16 u32 u64 u128 f32 f64 char str string bytes byte_buf option unit unit_struct
        newtype_struct seq tuple tuple_struct map enum identifier ignored_any
    }
}

/// The page `docs/blueprint-reference.md`, with the adapters' own options.
pub fn reference(adapters: &Registry) -> String {
    let schema = full_schema(adapters);
    let mut page = INTRODUCTION.to_owned();
    for Section { title, first, pointer, keys } in SECTIONS {
        let Some(group) = schema.pointer(pointer) else { continue };
        let first = if first.is_empty() { text(group, "description") } else { first.to_owned() };
        write_section(&mut page, title, &first, keys(), group, &schema);
    }
    for row in adapters.rows() {
        let title = format!("`options` of `{}`", row.name);
        let rules = schema.pointer("/$defs/HardwareEntry/allOf").and_then(Value::as_array);
        let rule = rules
            .into_iter()
            .flatten()
            .find(|rule| rule.pointer("/if/properties/adapter_type/const").and_then(Value::as_str) == Some(row.name));
        let options = rule.and_then(|rule| rule.pointer("/then/properties/options/anyOf/0"));
        if let Some(options) = options.map(|options| follow(options, &schema)) {
            let form = format!("{}. Address: `{}`.", row.about.trim_end_matches('.'), row.address.form);
            write_section(&mut page, &title, &form, &[], options, &schema);
        }
    }
    page.truncate(page.trim_end().len());
    page.push('\n');
    page
}

fn write_section(page: &mut String, title: &str, first: &str, order: Keys, group: &Value, schema: &Value) {
    let _ = write!(page, "## {title}\n\n{}\n", first.replace('\n', " "));
    let keys = group.get("properties").and_then(Value::as_object);
    let Some(keys) = keys.filter(|keys| !keys.is_empty()) else {
        page.push_str("\nIt has no keys.\n\n");
        return;
    };
    page.push_str("\n| key | value | default | meaning |\n|---|---|---|---|\n");
    let required: Vec<&str> =
        group.get("required").and_then(Value::as_array).into_iter().flatten().filter_map(Value::as_str).collect();
    let mut keys: Vec<(&String, &Value)> = keys.iter().collect();
    keys.sort_by_key(|(key, _)| order.iter().position(|k| k == key).unwrap_or(usize::MAX));
    for (key, value) in keys {
        let default = match value.get("default") {
            _ if required.contains(&key.as_str()) => "**required**".to_owned(),
            Some(Value::Null) | None => String::new(),
            Some(Value::Object(_)) => String::new(),
            Some(Value::String(default)) if default.is_empty() => String::new(),
            Some(default) => format!("`{}`", default.to_string().trim_matches('"')),
        };
        let meaning = text(value, "description").replace('\n', " ").replace('|', "\\|");
        let _ = writeln!(page, "| `{key}` | {} | {default} | {meaning} |", kind(value, schema).replace('|', "\\|"));
    }
    page.push('\n');
}

fn text(value: &Value, key: &str) -> String {
    value.get(key).and_then(Value::as_str).unwrap_or_default().to_owned()
}

/// The schema that a reference stands for.
fn follow<'s>(value: &'s Value, schema: &'s Value) -> &'s Value {
    let target = value.get("$ref").and_then(Value::as_str).and_then(|r| r.strip_prefix('#'));
    target.and_then(|pointer| schema.pointer(pointer)).unwrap_or(value)
}

/// What may stand there, in few words.
fn kind(value: &Value, schema: &Value) -> String {
    if let Some(target) = value.get("$ref").and_then(Value::as_str) {
        let name = target.rsplit('/').next().unwrap_or_default();
        return match name {
            "Joints" | "JointNames" => "list or group".to_owned(),
            "PerJoint" => "number, list or group".to_owned(),
            "Positions" => "pair or group".to_owned(),
            _ => kind(follow(value, schema), schema),
        };
    }
    let words = |list: &Value| -> String {
        let words: Vec<String> =
            list.as_array().into_iter().flatten().filter_map(|w| w.as_str().map(|w| format!("`{w}`"))).collect();
        words.join(", ")
    };
    if let Some(list) = value.get("enum") {
        return words(list);
    }
    if let Some(choices) = value.get("oneOf").or_else(|| value.get("anyOf")).and_then(Value::as_array) {
        let kinds = choices.iter().map(|choice| match choice.get("const").and_then(Value::as_str) {
            Some(word) => format!("`{word}`"),
            None => kind(choice, schema),
        });
        let mut kinds: Vec<String> = kinds.filter(|kind| !kind.is_empty()).collect();
        kinds.dedup();
        return kinds.join(", ");
    }
    let name = match value.get("type") {
        Some(Value::String(name)) => name.as_str(),
        Some(Value::Array(names)) => names.iter().filter_map(Value::as_str).find(|n| *n != "null").unwrap_or_default(),
        _ if value.get("properties").is_some() => "object",
        _ => return "anything".to_owned(),
    };
    let bound = |key: &str| value.get(key).and_then(Value::as_f64);
    match name {
        "string" => "text".to_owned(),
        "boolean" => "true, false".to_owned(),
        "array" if value.get("prefixItems").is_some() => "list".to_owned(),
        "array" => match value.get("items") {
            Some(items) => format!("list of {}", plural(&kind(items, schema))),
            None => "list".to_owned(),
        },
        "object" => "group".to_owned(),
        "null" => String::new(),
        "number" | "integer" => {
            let name = if name == "integer" { "whole number" } else { "number" };
            match (bound("minimum"), bound("maximum"), bound("exclusiveMinimum")) {
                (Some(low), Some(high), _) => format!("{name} {low} to {high}"),
                (Some(0.0), None, _) => format!("{name}, 0 or more"),
                (None, None, Some(_)) => format!("{name} above 0"),
                _ => name.to_owned(),
            }
        }
        other => other.to_owned(),
    }
}

fn plural(kind: &str) -> String {
    match kind {
        "text" | "number" | "group" | "pair" | "list" => format!("{kind}s"),
        other => other.to_owned(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blueprint::json_schema::json_schema;

    /// Compares a generated file with the committed one.
    fn check(path: &str, generated: &str) {
        let file = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
        if std::env::var_os("DIMOS_REGENERATE").is_some() {
            std::fs::write(&file, generated).unwrap();
        }
        let committed = std::fs::read_to_string(&file).unwrap_or_default();
        assert!(
            committed == generated,
            "{path} is out of date; write it anew with: DIMOS_REGENERATE=1 cargo test --lib blueprint"
        );
    }

    #[test]
    fn the_committed_reference_is_up_to_date() {
        check("docs/blueprint-reference.md", &reference(&Registry::builtin()));
    }

    #[test]
    fn the_committed_schema_is_up_to_date() {
        let schema = serde_json::to_string_pretty(&json_schema(&Registry::builtin())).unwrap();
        check("assets/blueprint.schema.json", &format!("{schema}\n"));
    }

    #[test]
    fn the_reference_names_every_key_of_the_schema() {
        let schema = json_schema(&Registry::default());
        let page = reference(&Registry::default());
        let groups = schema["$defs"].as_object().unwrap().values().chain([&schema]);
        for key in groups.filter_map(|g| g.get("properties")?.as_object()).flat_map(|keys| keys.keys()) {
            assert!(page.contains(&format!("`{key}`")), "{key} is not in the reference");
        }
    }
}

//! The JSON Schema of blueprints, for editors: the types of `schema.rs`, joined with the adapters' options and the
//! task types' parameters.

use std::collections::BTreeMap;
use std::sync::OnceLock;

use schemars::generate::SchemaSettings;
use serde_json::{Value, json};

use crate::blueprint::catalog::Catalog;
use crate::blueprint::schema::BlueprintFile;
use dimos_hardware::registry::Registry;

/// Returns the JSON Schema (draft 2020-12) of blueprints with the adapters and task types of the catalog.
pub fn json_schema<'a>(catalog: impl Into<Catalog<'a>>) -> Value {
    let mut schema = full_schema(catalog);
    allow_partial_entries(&mut schema);
    schema
}

/// Returns the JSON Schema of a blueprint without includes: every necessary key is required.
pub fn full_schema<'a>(catalog: impl Into<Catalog<'a>>) -> Value {
    let Catalog { adapters, tasks } = catalog.into();
    let mut generator = SchemaSettings::draft2020_12().into_generator();
    // One generator for all: it distinguishes types of the same name.
    let options: Vec<(&str, Value)> =
        adapters.rows().iter().map(|row| (row.name, (row.options.schema)(&mut generator).to_value())).collect();
    let own: Vec<(&str, Value)> =
        adapters.peripherals().iter().map(|row| (row.name, (row.options.schema)(&mut generator).to_value())).collect();
    let params: Vec<(&str, Value)> =
        tasks.rows().map(|row| (row.name, (row.params.schema)(&mut generator).to_value())).collect();
    let mut schema = generator.into_root_schema_for::<BlueprintFile>().to_value();
    let names: Vec<&str> = adapters.names();
    if let Some(hardware) = schema.pointer_mut("/$defs/HardwareEntry") {
        join(hardware, "adapter_type", "options", options);
        if let Some(adapter) = hardware.pointer_mut("/properties/adapter_type").and_then(Value::as_object_mut)
            && !names.is_empty()
        {
            adapter.insert("enum".to_owned(), json!(names));
        }
    }
    if let Some(peripheral) = schema.pointer_mut("/$defs/PeripheralEntry") {
        let names: Vec<&str> = own.iter().map(|(name, _)| *name).collect();
        if let Some(adapter) = peripheral.pointer_mut("/properties/adapter_type").and_then(Value::as_object_mut)
            && !names.is_empty()
        {
            adapter.insert("enum".to_owned(), json!(names));
        }
        join(peripheral, "adapter_type", "options", own);
    }
    if let Some(task) = schema.pointer_mut("/$defs/TaskEntry") {
        join(task, "type", "params", params);
        if let Some(kind) = task.pointer_mut("/properties/type").and_then(Value::as_object_mut) {
            let about: Vec<String> = tasks.rows().map(|row| format!("`{}` {}", row.name, row.about)).collect();
            kind.insert("description".to_owned(), json!(format!("Type of the task: {}.", about.join(", "))));
            kind.insert("enum".to_owned(), json!(tasks.names()));
        }
    }
    schema
}

/// Keys of earlier versions, and what took their place.
const GONE: [(&str, &str); 1] = [(
    "python_dimos",
    "the coordinator of Python dimos is a bridge now: python3 -m dimos_client.python_dimos --command \
     (docs/from-python-dimos.md)",
)];

/// Returns what to say of an unknown key: what took its place, or the group that it belongs to.
pub(super) fn hint_of(key: &str) -> Option<String> {
    if let Some((_, hint)) = GONE.iter().find(|(gone, _)| *gone == key) {
        return Some((*hint).to_owned());
    }
    home_of(key).map(|home| match home.is_empty() {
        true => format!("`{key}` belongs at the top of the file, without indentation"),
        false => format!("`{key}` belongs under `{home}`"),
    })
}

/// Returns the group that a key belongs to: `coordinator` for `tick_rate`, an empty name for the top level. Returns
/// `None` if no group has it, or several.
fn home_of(key: &str) -> Option<String> {
    static HOMES: OnceLock<BTreeMap<String, Vec<&'static str>>> = OnceLock::new();
    let homes = HOMES.get_or_init(|| {
        let mut homes: BTreeMap<String, Vec<&'static str>> = BTreeMap::new();
        let schema = full_schema(&Registry::default());
        for (pointer, name) in GROUPS {
            let keys = schema.pointer(&format!("{pointer}/properties")).and_then(Value::as_object);
            for key in keys.into_iter().flat_map(|keys| keys.keys()) {
                homes.entry(key.clone()).or_default().push(name);
            }
        }
        homes
    });
    match homes.get(key).map(Vec::as_slice) {
        Some([home]) => Some((*home).to_owned()),
        _ => None,
    }
}

/// Groups of the schema, and their paths in a blueprint.
const GROUPS: [(&str, &str); 14] = [
    ("", ""),
    ("/$defs/CoordinatorConfig", "coordinator"),
    ("/$defs/HardwareEntry", "hardware"),
    ("/$defs/LimitsEntry", "limits"),
    ("/$defs/TaskEntry", "tasks"),
    ("/$defs/TrajectoryParams", "params"),
    ("/$defs/PlannerEntry", "planner"),
    ("/$defs/RobotEntry", "planner.robots"),
    ("/$defs/RecordingConfig", "recording"),
    ("/$defs/ViewConfig", "view"),
    ("/$defs/FoxgloveConfig", "view.foxglove"),
    ("/$defs/MetricsConfig", "metrics"),
    ("/$defs/ShareEntry", "share"),
    ("/$defs/RosEntry", "share.ros"),
];

/// Makes all keys of a list entry optional except its id: a blueprint with includes may contain parts of entries. A
/// rule at the top level requires the other keys if there is no `include`.
fn allow_partial_entries(schema: &mut Value) {
    let mut without_include = json!({});
    for (definition, id, pointer) in [
        ("HardwareEntry", "hardware_id", &["hardware"][..]),
        ("TaskEntry", "name", &["tasks"]),
        ("RobotEntry", "name", &["planner", "robots"]),
    ] {
        let Some(group) = schema.pointer_mut(&format!("/$defs/{definition}")).and_then(Value::as_object_mut) else {
            continue;
        };
        let Some(needed) = group.insert("required".to_owned(), json!([id])) else { continue };
        let entry = json!({ "items": { "required": needed } });
        let rule = pointer.iter().rev().fold(entry, |inner, key| json!({ "properties": { *key: inner } }));
        let (Some(all), Some(more)) = (without_include.as_object_mut(), rule["properties"].as_object()) else {
            continue;
        };
        let properties = all.entry("properties").or_insert_with(|| json!({}));
        if let Some(properties) = properties.as_object_mut() {
            properties.extend(more.clone());
        }
    }
    if let Some(root) = schema.as_object_mut() {
        root.insert("if".to_owned(), json!({ "not": { "required": ["include"] } }));
        root.insert("then".to_owned(), without_include);
    }
}

/// Adds a rule for each word: if the key `by` is this word, the key `what` has that type. `required` disables the rule
/// if `by` is absent.
fn join<'w>(group: &mut Value, by: &str, what: &str, types: impl IntoIterator<Item = (&'w str, Value)>) {
    let rules: Vec<Value> = types
        .into_iter()
        .map(|(word, schema)| {
            json!({
                "if": { "properties": { by: { "const": word } }, "required": [by] },
                "then": { "properties": { what: { "anyOf": [schema, { "type": "null" }] } } }
            })
        })
        .collect();
    if let Some(group) = group.as_object_mut()
        && !rules.is_empty()
    {
        group.insert("allOf".to_owned(), Value::Array(rules));
    }
}

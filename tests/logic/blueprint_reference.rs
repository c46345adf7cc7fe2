//! `docs/blueprint-reference.md`, `assets/blueprint.schema.json` and `assets/rpc.schema.json` are generated, so that
//! they never differ from what is accepted. `DIMOS_REGENERATE=1 cargo test --test logic blueprint_reference` writes
//! them.

use std::fmt::Write;
use std::path::Path;

use dimos::blueprint::planner::{GripperJointEntry, ObjectEntry, PlannerEntry, PoseEntry, RobotEntry, ViewConfig};
use dimos::blueprint::schema::{AssetEntry, BlueprintFile, CountedJoints, HardwareEntry, TaskEntry};
use dimos::blueprint::share::{IdentityEntry, RosEntry, ShareEntry};
use dimos::blueprint::{
    Catalog, CoordinatorConfig, FoxgloveConfig, GuardConfig, LimitsEntry, MetricsConfig, MountingEntry, PayloadEntry,
    PeripheralEntry, RecordingConfig, RpcConfig, StopInputEntry, full_schema, json_schema,
};
use dimos::control::task_spec::{TaskSpec, TaskTable};
use dimos::hardware::registry::Registry;
use dimos::yaml::keys;
use serde_json::Value;

const INTRODUCTION: &str = "\
# Blueprint reference

A blueprint is a YAML file that defines the arms, tasks, planner and log of a run. `dimos run NAME|PATH` runs one,
`dimos check NAME|PATH` reports every mistake in it, `dimos list-blueprints` lists those that can be run by name: from
`./blueprints`, the folders of `$DIMOS_BLUEPRINT_PATH`, `~/.config/dimos/blueprints` and the binary, in this order.
Units are SI: rad, rad/s, m, s, Hz.

Every shipped blueprint has `address: sim`: it runs on the arms' emulators, and the banner says SIMULATED. `--address
arm=192.168.1.185` uses the arm `arm` at this address for one run (repeatable; the same as `--set
hardware.arm.address=192.168.1.185`); the banner then says `REAL ARM at 192.168.1.185`. For good, give the address in a
blueprint of your own: it wins over that of an included one, also over `sim`.

```yaml
include: [coordinator-xarm6]
hardware: [{hardware_id: arm, address: 192.168.1.185}]
```

`--set path=value` changes one value for one run; entries of lists are addressed by their id: `--set
coordinator.tick_rate=250`. `--sim` uses every arm's emulator, whatever the blueprint says. No environment variable
changes an address.

Blueprints are YAML 1.2: booleans are `true` and `false` (`yes` is a text). Keys must be unique, numbers finite, and a
file has at most 1 MiB.

This page is generated. Regenerate it with `DIMOS_REGENERATE=1 cargo test --test logic blueprint_reference`.

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

const SECTIONS: [Section; 10] = [
    section("Top level", "", "", keys::<BlueprintFile>),
    section("`coordinator`", "", "/$defs/CoordinatorConfig", keys::<CoordinatorConfig>),
    section("`hardware[]`", ARMS, "/$defs/HardwareEntry", keys::<HardwareEntry>),
    section("`hardware[].joints`, short form", "", "/$defs/CountedJoints", keys::<CountedJoints>),
    section("`hardware[].limits`", "", "/$defs/LimitsEntry", keys::<LimitsEntry>),
    section("`hardware[].stop_input`", "", "/$defs/StopInputEntry", keys::<StopInputEntry>),
    section("`hardware[].payload`", "", "/$defs/PayloadEntry", keys::<PayloadEntry>),
    section("`hardware[].mounting`", "", "/$defs/MountingEntry", keys::<MountingEntry>),
    section(
        "`hardware[].gripper` and `hardware[].force_torque`",
        "",
        "/$defs/PeripheralEntry",
        keys::<PeripheralEntry>,
    ),
    section("`tasks[]`", TASKS, "/$defs/TaskEntry", keys::<TaskEntry>),
];
/// Those behind the parameters of the task types.
const SECTIONS_AFTER_TASKS: [Section; 15] = [
    section("`planner`", "", "/$defs/PlannerEntry", keys::<PlannerEntry>),
    section("`planner.robots[]`", "A list of robots, merged by `name`.", "/$defs/RobotEntry", keys::<RobotEntry>),
    section("`planner.robots[].gripper_joint`", "", "/$defs/GripperJointEntry", keys::<GripperJointEntry>),
    section("`planner.robots[].base_pose`", "", "/$defs/PoseEntry", keys::<PoseEntry>),
    section("`planner.world`", "A group of obstacles by name.", "/$defs/ObjectEntry", keys::<ObjectEntry>),
    section("`guard`", "", "/$defs/GuardConfig", keys::<GuardConfig>),
    section("`view`", "", "/$defs/ViewConfig", keys::<ViewConfig>),
    section("`view.foxglove`", "", "/$defs/FoxgloveConfig", keys::<FoxgloveConfig>),
    section("`recording`", "", "/$defs/RecordingConfig", keys::<RecordingConfig>),
    section("`rpc`", "", "/$defs/RpcConfig", keys::<RpcConfig>),
    section("`metrics`", "", "/$defs/MetricsConfig", keys::<MetricsConfig>),
    section("`share`", "", "/$defs/ShareEntry", keys::<ShareEntry>),
    section("`share.identity`", "", "/$defs/IdentityEntry", keys::<IdentityEntry>),
    section("`share.ros`", "", "/$defs/RosEntry", keys::<RosEntry>),
    section("`assets`", "A group of files by name.", "/$defs/AssetEntry", keys::<AssetEntry>),
];

type Keys = &'static [&'static str];

/// The page `docs/blueprint-reference.md`, with the adapters' own options and the task types' parameters.
pub fn reference<'a>(catalog: impl Into<Catalog<'a>>) -> String {
    let catalog = catalog.into();
    let schema = full_schema(catalog);
    let mut page = INTRODUCTION.to_owned();
    write_sections(&mut page, &SECTIONS, &schema);
    write_params(&mut page, catalog.tasks, &schema);
    write_sections(&mut page, &SECTIONS_AFTER_TASKS, &schema);
    let arms = catalog.adapters.rows().iter().map(|row| ("HardwareEntry", row.name, row.about, row.address.form));
    let peripherals = catalog.adapters.peripherals().iter();
    let peripherals = peripherals.map(|row| ("PeripheralEntry", row.name, row.about, row.address.form));
    for (entry, name, about, form) in arms.chain(peripherals) {
        let title = format!("`options` of `{name}`");
        let rules = schema.pointer(&format!("/$defs/{entry}/allOf")).and_then(Value::as_array);
        let is_its =
            |rule: &&Value| rule.pointer("/if/properties/adapter_type/const").and_then(Value::as_str) == Some(name);
        let rule = rules.into_iter().flatten().find(is_its);
        let options = rule.and_then(|rule| rule.pointer("/then/properties/options/anyOf/0"));
        if let Some(options) = options.map(|options| follow(options, &schema)) {
            let first = format!("{}. Address: `{form}`.", about.trim_end_matches('.'));
            write_section(&mut page, &title, &first, &[], options, &schema);
        }
    }
    page.truncate(page.trim_end().len());
    page.push('\n');
    page
}

fn write_sections(page: &mut String, sections: &[Section], schema: &Value) {
    for Section { title, first, pointer, keys } in sections {
        let Some(group) = schema.pointer(pointer) else { continue };
        let first = if first.is_empty() { text(group, "description") } else { (*first).to_owned() };
        write_section(page, title, &first, keys(), group, schema);
    }
}

/// A section for each kind of parameters; types may share theirs.
fn write_params(page: &mut String, tasks: &TaskTable, schema: &Value) {
    let group = |row: &TaskSpec| {
        let mut rules = schema.pointer("/$defs/TaskEntry/allOf")?.as_array()?.iter();
        let of = |rule: &&Value| rule.pointer("/if/properties/type/const").and_then(Value::as_str) == Some(row.name);
        let params = rules.find(of)?.pointer("/then/properties/params/anyOf/0")?;
        Some(follow(params, schema))
    };
    let rows: Vec<&TaskSpec> = tasks.rows().collect();
    for (number, row) in rows.iter().enumerate() {
        let Some(params) = group(row) else { continue };
        let same = |other: &&&TaskSpec| group(other).is_some_and(|theirs| std::ptr::eq(theirs, params));
        if rows.iter().take(number).any(|other| same(&other)) {
            continue;
        }
        let names: Vec<String> = rows.iter().filter(same).map(|row| format!("`{}`", row.name)).collect();
        let title = format!("`params` of {}", names.join(" and "));
        write_section(page, &title, &text(params, "description"), (row.params.keys)(), params, schema);
    }
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

/// Returns the schema that a reference points to.
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

/// Compares a generated file with the committed one.
fn check(path: &str, generated: &str) {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(path);
    if std::env::var_os("DIMOS_REGENERATE").is_some() {
        std::fs::write(&file, generated).unwrap();
    }
    let committed = std::fs::read_to_string(&file).unwrap_or_default();
    assert!(
        committed == generated,
        "{path} is out of date; regenerate it with: DIMOS_REGENERATE=1 cargo test --test logic blueprint_reference"
    );
}

#[test]
fn the_committed_reference_is_up_to_date() {
    check("docs/blueprint-reference.md", &reference(&dimos::arms::registry()));
}

#[test]
fn the_committed_schema_is_up_to_date() {
    let schema = serde_json::to_string_pretty(&json_schema(&dimos::arms::registry())).unwrap();
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

#[test]
fn the_schema_of_the_protocol_is_current() {
    check("assets/rpc.schema.json", &format!("{}\n", dimos::rpc::api::schema::json_schema()));
}

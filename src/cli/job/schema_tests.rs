//! `assets/job.schema.json` is made of the reader's keys, takes each job of the page, and refuses what the reader
//! refuses for its form.

use std::path::Path;

use serde_json::{Value as Json, json};

use super::keys::{Group, JOB, STEPS, Value};
use dimos_yaml::{Kind, NodeId, Tree};

fn group(group: &Group) -> Json {
    let properties: serde_json::Map<_, _> = group.keys.iter().map(|(name, v)| ((*name).into(), value(v))).collect();
    let mut schema = json!({"type": "object", "properties": properties, "additionalProperties": false});
    if !group.required.is_empty() {
        schema["required"] = json!(group.required);
    }
    schema
}

fn value(of: &Value) -> Json {
    match of {
        Value::Text => json!({"type": "string", "minLength": 1}),
        Value::Flag => json!({"type": "boolean"}),
        Value::Number => json!({"type": "number"}),
        Value::Speed => json!({"type": ["number", "string"], "pattern": "^[0-9.]+%?$"}),
        Value::Time => json!({"type": ["number", "string"], "pattern": "^[0-9]"}),
        Value::Numbers(0) => json!({"type": "array", "items": {"type": "number"}, "minItems": 1}),
        Value::Numbers(n) => json!({"type": "array", "items": {"type": "number"}, "minItems": n, "maxItems": n}),
        Value::Opening => json!({"anyOf": [{"enum": ["open", "close"]}, {"type": "number"}]}),
        Value::Level => json!({"enum": ["high", "low", 0, 1, true, false]}),
        Value::Input => json!({"type": "string", "pattern": "^di[0-9]+$"}),
        Value::Times => json!({"type": "integer", "minimum": 1}),
        Value::Word(word) => json!({"enum": [word]}),
        Value::Names => json!({"type": "array", "items": value(&Value::Text)}),
        Value::Outputs => json!({"type": "object", "minProperties": 1, "properties": {"arm": value(&Value::Text)},
            "patternProperties": {"^do[0-9]+$": value(&Value::Level), "^ao[0-9]+$": value(&Value::Number)},
            "additionalProperties": false}),
        Value::Steps => json!({"type": "array", "items": {"$ref": "#/$defs/step"}, "minItems": 1}),
        Value::Waypoints(point) => {
            let point = json!({"anyOf": [value(&Value::Text), group(point)]});
            json!({"type": "array", "items": point, "minItems": 2})
        }
        Value::Acts(keys) => json!({"type": "array", "items": group(keys), "minItems": 1}),
        Value::Keys(keys) => group(keys),
        Value::Either(values) => json!({"anyOf": values.iter().map(value).collect::<Vec<_>>()}),
    }
}

fn schema() -> Json {
    let mut schema = group(&JOB);
    let mut step = group(&STEPS);
    (step["minProperties"], step["maxProperties"]) = (json!(1), json!(1));
    schema["$schema"] = json!("https://json-schema.org/draft/2020-12/schema");
    schema["title"] = json!("A job of dimos");
    schema["$defs"] = json!({"step": {"anyOf": [{"enum": ["reset", "enable"]}, step]}});
    schema
}

/// Whether a value has the form of a schema, as far as these schemas go.
fn fits(schema: &Json, root: &Json, value: &Json) -> bool {
    let number = |key: &str| schema[key].as_u64().map(|n| n as usize);
    let is = |kind: &Json| match kind.as_str().unwrap() {
        "object" => value.is_object(),
        "array" => value.is_array(),
        "string" => value.is_string(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_u64(),
        _ => value.is_number(),
    };
    let kinds = match &schema["type"] {
        Json::Null => true,
        Json::Array(kinds) => kinds.iter().any(is),
        kind => is(kind),
    };
    let text = value.as_str().unwrap_or_default();
    let matches = |pattern: &str| match pattern {
        "^[0-9.]+%?$" => text.trim_end_matches('%').parse::<f64>().is_ok(),
        "^[0-9]" => text.starts_with(|c: char| c.is_ascii_digit()),
        other => named(other, text),
    };
    let entries = value.as_object();
    let properties = entries.into_iter().flatten().all(|(key, value)| {
        let by_pattern = schema["patternProperties"].as_object().into_iter().flatten().find(|(p, _)| named(p, key));
        match schema["properties"].get(key).or(by_pattern.map(|(_, schema)| schema)) {
            Some(schema) => fits(schema, root, value),
            None => schema["additionalProperties"] != json!(false),
        }
    });
    kinds
        && schema["$ref"].as_str().is_none_or(|path| fits(root.pointer(&path[1..]).unwrap(), root, value))
        && schema["enum"].as_array().is_none_or(|values| values.contains(value))
        && schema["anyOf"].as_array().is_none_or(|any| any.iter().any(|schema| fits(schema, root, value)))
        && (!value.is_string() || schema["pattern"].as_str().is_none_or(matches))
        && (!value.is_string() || number("minLength").is_none_or(|least| text.len() >= least))
        && value.as_u64().is_none_or(|n| number("minimum").is_none_or(|least| n as usize >= least))
        && value.as_array().is_none_or(|items| {
            number("minItems").is_none_or(|least| items.len() >= least)
                && number("maxItems").is_none_or(|most| items.len() <= most)
                && (schema["items"].is_null() || items.iter().all(|item| fits(&schema["items"], root, item)))
        })
        && entries.is_none_or(|entries| {
            number("minProperties").is_none_or(|least| entries.len() >= least)
                && number("maxProperties").is_none_or(|most| entries.len() <= most)
                && schema["required"]
                    .as_array()
                    .is_none_or(|keys| keys.iter().all(|k| entries.contains_key(k.as_str().unwrap())))
        })
        && properties
}

/// Whether a name is a number behind the letters of a pattern such as `^di[0-9]+$`.
fn named(pattern: &str, text: &str) -> bool {
    let digits = text.strip_prefix(&pattern[1..3]);
    digits.is_some_and(|digits| !digits.is_empty() && digits.bytes().all(|byte| byte.is_ascii_digit()))
}

/// The file as a value.
fn of_yaml(tree: &Tree, node: NodeId) -> Json {
    match &tree.node(node).unwrap().kind {
        Kind::Map(_) => {
            let entry = |(key, value): &(NodeId, NodeId)| (tree.text(*key).unwrap().to_owned(), of_yaml(tree, *value));
            Json::Object(tree.entries(node).iter().map(entry).collect())
        }
        _ => match tree.text(node) {
            Some(text) => {
                serde_json::from_str(text).ok().filter(|v: &Json| !v.is_string()).unwrap_or_else(|| text.into())
            }
            None => tree.items(node).iter().map(|item| of_yaml(tree, *item)).collect(),
        },
    }
}

fn parsed(text: &str) -> Json {
    let mut tree = Tree::new();
    let source = tree.add_bytes("job.yaml", text.as_bytes()).unwrap();
    let root = tree.parse(source).unwrap();
    of_yaml(&tree, root)
}

fn file(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name).display().to_string()
}

#[test]
fn the_committed_schema_is_made_of_the_readers_keys() {
    let (path, generated) = (file("assets/job.schema.json"), format!("{}\n", schema()));
    if std::env::var_os("DIMOS_REGENERATE").is_some() {
        std::fs::write(&path, &generated).unwrap();
    }
    let committed = std::fs::read_to_string(&path).unwrap_or_default();
    assert!(committed == generated, "out of date: DIMOS_REGENERATE=1 cargo test --lib job::schema_tests");
}

#[test]
fn every_job_of_the_page_fits_and_what_the_reader_refuses_for_its_form_does_not() {
    let (schema, page) = (schema(), std::fs::read_to_string(file("docs/jobs.md")).unwrap());
    let jobs = page.split("```yaml\n").skip(1).map(|rest| rest.split("```").next().unwrap());
    assert!(jobs.clone().count() >= 2);
    for job in jobs {
        let job = parsed(job);
        assert!(fits(&schema, &schema, &job), "{job:#}");
    }
    // Each row of its table of steps, as it is written there.
    for step in [
        "move: home",
        "move: {by: {xyz: [0, 0, 0.1]}, frame: tool, linear: true, speed: 0.3}",
        "through: [above, {joints: [0.1, 2]}, {pose: {xyz: [0.3, 0, 0.3], quat: [0, 0, 0, 1]}}]",
        "gripper: 0.04",
        "gripper: {to: close, force: 20, object: true, timeout: 5s}",
        "wait: 500ms",
        "wait: {input: di0, is: high, timeout: 5s}",
        "output: {do0: high, ao0: 2.5}",
        "repeat: {times: 3, steps: [reset, {enable: left}]}",
        "attach: {object: part, touch: [link6], link: tool, mass: 0.2}",
        "detach: part",
        "reset",
    ] {
        let job = parsed(&format!("repeat: forever\non_fault: stop\nsteps:\n  - {step}\n"));
        assert!(fits(&schema, &schema, &job), "{step}");
    }
    for wrong in [
        "repeet: 10\nsteps: [reset]",
        "repeat: 2",
        "steps: []",
        "steps: [{move: {joints: [1, x]}}]",
        "steps: [{move: {joints: [1], speeed: 30%}}]",
        "steps: [{gripper: closed}]",
        "steps: [{wait: {input: do0}}]",
        "steps: [{wait: soon}]",
        "steps: [{mov: home}]",
        "steps: [{through: [home]}]",
        "steps: [{output: {do0: 2}}]",
        "steps: [{output: {x0: 1}}]",
        "steps: [{repeat: {times: 0, steps: [reset]}}]",
        "steps: [{move: {pose: {xyz: [1, 2]}}}]",
        "steps: [move]",
        "steps: [{reset: a, enable: a}]",
    ] {
        assert!(!fits(&schema, &schema, &parsed(wrong)), "{wrong}");
    }
}

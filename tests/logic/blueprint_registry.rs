//! Names to files, what `list-blueprints` and `check` show, and the JSON Schema.

use std::fs;
use std::path::Path;

use dimos::blueprint::{Found, Origin, Overrides, SearchPath, Source, Summary, find, json_schema, load_from};
use dimos::hardware::registry::{Absent, Registry};

use super::blueprint_reference::reference;
use crate::support::fake_arms;

/// Two folders: the first has `one` and a broken one, the second has another `one` and `two`.
fn folders() -> (tempfile::TempDir, SearchPath) {
    let dir = tempfile::tempdir().unwrap();
    let (first, second) = (dir.path().join("first"), dir.path().join("second"));
    for folder in [&first, &second] {
        fs::create_dir(folder).unwrap();
    }
    let arm = "hardware: [{hardware_id: arm, adapter_type: mock, joints: [a, b]}]\n\
               tasks: [{name: t, type: trajectory, joint_names: {hardware: arm}}]\n";
    fs::write(first.join("one.yaml"), format!("description: the first\n{arm}")).unwrap();
    fs::write(first.join("broken.yaml"), "hardwar: []\n").unwrap();
    fs::write(second.join("one.yaml"), format!("description: hidden\n{arm}")).unwrap();
    fs::write(second.join("two.yml"), "include: [one]\ndescription: the second\ncoordinator: {tick_rate: 50}\n")
        .unwrap();
    (dir, SearchPath { folders: vec![first, second] })
}

#[test]
fn the_first_folder_wins() {
    let (dir, search) = folders();
    let found = search.find("one").unwrap();
    assert_eq!(found.source, Source::Path(dir.path().join("first/one.yaml")));
    let by_path = search.find(dir.path().join("second/one.yaml").to_str().unwrap()).unwrap();
    assert!(String::from_utf8_lossy(&by_path.bytes).contains("hidden"));
    assert_eq!(search.find("coordinator-mock").unwrap().source, Source::Embedded);
}

#[test]
fn an_include_looks_beside_its_file_first() {
    let (_dir, search) = folders();
    let loaded = load_from(&search, &search.find("two").unwrap(), &Overrides::default(), &fake_arms::registry());
    assert_eq!(loaded.render(false), "");
    let blueprint = loaded.blueprint.unwrap();
    assert_eq!((blueprint.name.as_str(), blueprint.description.as_str()), ("two", "the second"));
    assert_eq!((blueprint.coordinator.tick_rate, blueprint.arms.len()), (50.0, 1));
    assert_eq!(blueprint.sources.len(), 2);
    assert!(blueprint.sources[1].0.contains("second"), "{:?}", blueprint.sources[1].0);
}

#[test]
fn unknown_names_get_a_hint() {
    let (dir, search) = folders();
    let error = search.find("coordinator-yuorarm").unwrap_err();
    assert_eq!(
        error.to_string(),
        "there is no blueprint `coordinator-yuorarm`\nhint: did you mean `coordinator-yourarm`?"
    );
    let error = search.find("./one.yaml").unwrap_err();
    assert_eq!(
        error.to_string(),
        "cannot open `./one.yaml`: there is no such file\nhint: there is a blueprint of that name: use `one`"
    );
    let error = search.find(&format!("{}/", dir.path().display())).unwrap_err();
    assert!(error.message.contains("it is a folder"), "{error}");
    assert!(find("no-such-blueprint-anywhere").unwrap_err().hint.contains("`dimos list-blueprints`"));
    assert!(find("no-such-file.md").unwrap_err().hint.contains("a YAML file"));
}

#[test]
fn the_list_shows_sources_arms_and_problems() {
    let (dir, search) = folders();
    let list = search.list(&fake_arms::registry());
    let names: Vec<&str> = list.iter().map(|l| l.name.as_str()).collect();
    for name in ["broken", "coordinator-dual-mock", "coordinator-mock", "coordinator-yourarm", "one", "two"] {
        assert!(names.contains(&name), "{names:?}");
    }
    let of = |name: &str| list.iter().find(|l| l.name == name).unwrap();
    assert_eq!(of("one").description, "the first");
    assert_eq!(of("one").source, Source::Path(dir.path().join("first/one.yaml")));
    assert_eq!(of("one").arms, ["arm (mock, 2 joints)"]);
    assert_eq!(of("broken").problem.as_deref(), Some("1:1: unknown key `hardwar`"));
    assert_eq!(of("coordinator-dual-mock").arms.len(), 2);
    assert_eq!(of("coordinator-dual-mock").problem, None);
}

#[test]
fn the_summary_says_where_limits_come_from() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/blueprints");
    let search = SearchPath { folders: vec![folder] };
    let found = search.find("full").unwrap();
    let blueprint = load_from(&search, &found, &Overrides::default(), &fake_arms::registry()).blueprint.unwrap();
    let summary = Summary::of(&blueprint);
    let joint = &summary.arms[0].joints[0];
    let lower = joint.position_lower.unwrap();
    assert_eq!((lower.value, lower.from), (-1.0, Origin::Blueprint));
    assert_eq!((joint.jerk.value, joint.jerk.from), (20.0, Origin::Default));
    let other = &summary.arms[0].joints[5];
    assert_eq!(other.position_lower.unwrap().from, Origin::Adapter);
    assert_eq!((other.jerk.value, other.jerk.from), (5.0, Origin::Blueprint));
    assert_eq!(summary.arms[0].on_exit_from, Origin::Blueprint);
    let json = serde_json::to_value(&summary).unwrap();
    assert_eq!(json["tasks"][1]["type"], "servo");
    assert_eq!(json["arms"][0]["joints"][0]["velocity"], serde_json::json!({"value": 1.5, "from": "blueprint"}));
}

#[test]
fn the_schema_joins_options_and_params() {
    let schema = json_schema(&fake_arms::registry());
    assert_eq!(schema["$schema"], "https://json-schema.org/draft/2020-12/schema");
    let hardware = &schema["$defs"]["HardwareEntry"];
    let rule = hardware["allOf"]
        .as_array()
        .unwrap()
        .iter()
        .find(|r| r["if"]["properties"]["adapter_type"]["const"] == "yourarm");
    let rule = rule.unwrap();
    assert_eq!(rule["if"]["required"], serde_json::json!(["adapter_type"]));
    assert!(rule["then"]["properties"]["options"].to_string().contains("tool"));
    assert_eq!(schema["$defs"]["TaskEntry"]["allOf"].as_array().unwrap().len(), 7);
    assert_references(&schema, &schema);
}

/// Every `$ref` leads somewhere.
fn assert_references(part: &serde_json::Value, schema: &serde_json::Value) {
    match part {
        serde_json::Value::Object(map) => {
            if let Some(target) = map.get("$ref").and_then(|r| r.as_str()) {
                assert!(schema.pointer(target.trim_start_matches('#')).is_some(), "{target}");
            }
            map.values().for_each(|v| assert_references(v, schema));
        }
        serde_json::Value::Array(items) => items.iter().for_each(|v| assert_references(v, schema)),
        _ => {}
    }
}

#[test]
fn the_reference_has_the_adapters_options() {
    let page = reference(&fake_arms::registry());
    assert!(page.contains("## `options` of `yourarm`") && page.contains("How long to wait for an answer [s]."));
    assert!(page.contains("## `options` of `mock`\n\nan arm in memory. Address: `none`.\n\nIt has no keys."), "{page}");
    assert!(!reference(&Registry::default()).contains("`options` of"));
}

#[test]
fn an_adapter_of_another_build_is_refused_with_a_hint() {
    let absent = Absent { name: "servobot", about: "a serial arm", remedy: "build with --features servobot" };
    let text = "hardware: [{hardware_id: arm, adapter_type: servobot, joints: {prefix: arm, count: 6}}]\n\
                tasks: [{name: t, type: trajectory, joint_names: {hardware: arm}}]\n";
    let answer = |registry: &Registry| {
        let found = Found { name: "absent".to_owned(), source: Source::Embedded, bytes: text.as_bytes().to_vec() };
        load_from(&SearchPath::default(), &found, &Overrides::default(), registry).render(false)
    };
    let said = answer(&dimos::arms::registry().lacking(&[absent]));
    assert!(said.contains("error: adapter `servobot` is not in this build"), "{said}");
    assert!(said.contains("hint: build with --features servobot"), "{said}");
    assert!(said.ends_with("1 error\n"), "nothing else: {said}");
    assert!(answer(&dimos::arms::registry()).contains("there is no adapter `servobot`"));
    let there = fake_arms::registry().lacking(&[absent]);
    assert_eq!(there.absent().count(), 0, "a row is a row");
}

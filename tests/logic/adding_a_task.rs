//! `docs/adding-a-task.md`: its task is the file beside it, which conforms, is configured by blueprints, moves an arm,
//! and comes out of its log the same again.

use std::path::Path;

use dimos::blueprint::{self, Catalog, Found, Loaded, Overrides, Source};
use dimos::control::config::{TaskConfig, TaskKind};
use dimos::control::request::Request;
use dimos::control::task_spec::{TaskSpec, TaskTable};
use dimos::joint::joints_of;
use dimos::replay::verify::{Finding, verify};
use dimos::telemetry::{Reason, TaskState};

use super::blueprint_reference::reference;
use super::task_conformance::failures;
use crate::support::rig::{Rig, arm};
use crate::support::virtual_run::{VirtualRun, one_arm};

#[path = "../../docs/examples/joystick.rs"]
mod joystick;

use joystick::SPEC;

fn file(path: &str) -> String {
    std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join(path)).unwrap()
}

#[test]
fn the_page_shows_the_file_that_is_tested_here() {
    let (page, code) = (file("docs/adding-a-task.md"), file("docs/examples/joystick.rs"));
    assert!(
        page.contains(&format!("```rust\n{code}```\n")),
        "docs/adding-a-task.md differs from docs/examples/joystick.rs"
    );
    for check in dimos::control::conformance::checks() {
        assert!(page.contains(&format!("| `{}` | {} |", check.name, check.about)), "{} is not on the page", check.name);
    }
}

#[test]
fn the_task_conforms() {
    let failures = failures(&SPEC);
    assert!(failures.is_empty(), "{failures:?}");
}

fn check(params: &str, types: &[TaskSpec]) -> Loaded {
    let text = format!(
        "hardware:\n  - {{hardware_id: arm, adapter_type: mock, joints: {{prefix: arm, count: 6}}}}\n\
         tasks:\n  - {{name: stick, type: joystick, joint_names: {{hardware: arm}}, params: {params}}}\n"
    );
    let found = Found { name: "stick".into(), source: Source::Embedded, bytes: text.into_bytes() };
    let (adapters, tasks) = (dimos::arms::registry(), TaskTable::with(types));
    blueprint::load(&found, &Overrides::default(), Catalog { adapters: &adapters, tasks: &tasks })
}

#[test]
fn blueprints_are_checked_against_its_row() {
    let good = check("{acceleration: 2.5}", &[SPEC]);
    let blueprint = good.blueprint.clone().unwrap_or_else(|| panic!("{}", good.render(false)));
    let params = serde_json::json!({"timeout": 0.2, "dead_band": 0.02, "acceleration": 2.5});
    assert_eq!((blueprint.tasks[0].spec.name, &blueprint.tasks[0].params), ("joystick", &params));
    let wrong = check("{acceleration: -1.0, timeuot: 3}", &[SPEC]).render(false);
    assert!(wrong.contains("-1 is out of range") && wrong.contains("did you mean `timeout`?"), "{wrong}");
    let unknown = check("{}", &[]).render(false);
    assert!(unknown.contains("there is no task type `joystick`"), "{unknown}");
}

#[test]
fn the_schema_and_the_reference_have_its_parameters() {
    let (adapters, tasks) = (dimos::arms::registry(), TaskTable::with(&[SPEC]));
    let catalog = Catalog { adapters: &adapters, tasks: &tasks };
    let schema = blueprint::json_schema(catalog);
    let types = &schema["$defs"]["TaskEntry"]["properties"]["type"];
    assert!(types["enum"].as_array().unwrap().contains(&"joystick".into()));
    assert!(
        types["description"].as_str().unwrap().ends_with("`joystick` follows the velocities of a stick, in positions.")
    );
    let page = reference(catalog);
    let section = page.split("## `params` of `joystick`\n").nth(1).unwrap().split("\n## ").next().unwrap();
    let keys: Vec<usize> =
        ["timeout", "dead_band", "acceleration"].map(|k| section.find(&format!("`{k}`")).unwrap()).to_vec();
    assert!(keys.is_sorted(), "{section}");
    assert!(section.contains("| `acceleration` | number above 0 | `1.0` |"), "{section}");
}

fn task() -> TaskConfig {
    let kind = TaskKind::new("joystick", &joystick::JoystickParams::default());
    TaskConfig { name: "stick".into(), kind, joints: (0..6).collect(), priority: 20, auto_start: false }
}

#[test]
fn it_moves_an_arm_and_stops_at_the_end_of_a_joint() {
    let mut rig = Rig::with_types(&TaskTable::with(&[SPEC]), 100.0, vec![arm("arm", 6)], vec![task()]);
    rig.make_ready();
    let stick = |rig: &mut Rig, seconds: f64, speeds: [f64; 6]| {
        for _ in 0..(seconds * 100.0) as u32 {
            rig.velocity(0, &speeds);
            rig.tick();
        }
    };
    stick(&mut rig, 1.0, [0.5, -0.5, 0.01, 0.0, 0.0, 0.0]);
    assert!((rig.speed(0) - 0.5).abs() < 1e-9, "{}", rig.speed(0));
    let q = rig.arms[0].q.clone();
    // 0.5 s of acceleration at 1 rad/s², and 0.5 s at 0.5 rad/s.
    assert!((q[0] - 0.375).abs() < 0.01 && (q[1] + 0.375).abs() < 0.01, "{q:?}");
    assert_eq!(q[2], 0.0, "inside of the dead band");
    let stopped = rig.run_until(2.0, |rig| rig.tasks[0].state == TaskState::Idle);
    assert_eq!(rig.tasks[0].reason, Reason::Timeout);
    assert!((0.6..0.8).contains(&stopped), "{stopped}");
    stick(&mut rig, 5.0, [0.9, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!((rig.speed(0), rig.tasks[0].state), (0.0, TaskState::Executing));
    assert!(rig.arms[0].q[0] > 1.9, "{:?}", rig.arms[0].q);
    stick(&mut rig, 0.5, [-0.5, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert!(rig.arms[0].q[0] < 1.9, "it comes back from the end at once");
}

#[test]
fn its_log_comes_out_the_same_again_and_is_refused_without_its_row() {
    let folder = tempfile::tempdir().unwrap();
    let (log, table) = (folder.path().join("stick.mcap"), TaskTable::with(&[SPEC]));
    let mut config = one_arm(6);
    config.tasks.push(task());
    let mut run = VirtualRun::start_with(&table, &config, &log);
    run.step();
    run.ask(Request::Enabled { arm: 0, outside: false });
    (0..40).for_each(|_| run.step());
    for k in 0..120u32 {
        if k % 2 == 0 && k < 60 {
            run.ask(Request::Velocity {
                task: 1,
                target: joints_of(&[0.3, -0.2, 0.1 + 0.2, 0.001, f64::from(k), 0.0]),
            });
        }
        if k == 50 {
            run.ask(Request::Cancel { task: Some(1) });
        }
        run.step();
    }
    assert!(run.states[0].position[0] > 0.05, "nothing moved: {:?}", run.states[0].position);
    run.finish();
    let found = verify(&log, &table).unwrap();
    assert_eq!((found.finding, found.requests), (Finding::Reproducible, 32));
    let refused = verify(&log, &TaskTable::builtin()).unwrap_err().to_string();
    assert!(refused.contains("task stick") && refused.contains("no task type `joystick`"), "{refused}");
}

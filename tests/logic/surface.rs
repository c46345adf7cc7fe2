//! All that users touch, written down: blueprint keys, rpc, command line, logs, exit codes, the Python client, the
//! trait of an adapter. Scripts, cells and adapters of users depend on every line, so a line changes on purpose or not
//! at all.

mod schema;
mod source;

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;
use std::{env, fs};

use clap::{ArgAction, Command};
use dimos::blueprint::{Overrides, find, load};
use dimos::cli::exit::Exit;
use dimos::clock::Mono;
use dimos::joint::make_joints;
use dimos::planning::scene::planning_scene::PlanningScene;
use dimos::recording::recorder::Note;
use dimos::recording::robots::{LoggedRobot, LoggedRobots};
use dimos::recording::tcp_log::TcpChain;
use dimos::robot::Source;
use dimos::trajectory::{JointTrajectory, TrajectoryPoint};
use nalgebra::Isometry3;

use crate::support::virtual_run::{VirtualRun, one_arm};

/// Compares lines with those of `tests/fixtures/surface/NAME.txt`.
#[track_caller]
fn unchanged(name: &str, lines: &[String]) {
    let path = format!("tests/fixtures/surface/{name}.txt");
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join(&path);
    let text: String = lines.iter().map(|line| format!("{line}\n")).collect();
    if env::var_os("DIMOS_REGENERATE").is_some() {
        fs::write(&file, &text).unwrap();
    }
    let committed = fs::read_to_string(&file).unwrap_or_default();
    let changes = changes(&committed, &text);
    assert!(
        changes.is_empty() && committed == text,
        "{path}: what users touch has changed:\n{changes}\
         An issue must ask for that, and the commit message must name it. Then write the file again:\n\
         DIMOS_REGENERATE=1 cargo test --test logic surface"
    );
}

/// The tool centre point of a YourArm.
fn tcp() -> TcpChain {
    let loaded = load(&find("yourarm-planner").unwrap(), &Overrides::default(), &dimos::arms::registry());
    let robot = PlanningScene::load(&loaded.blueprint.unwrap().planner.unwrap()).unwrap().robots.remove(0);
    let (kinematics, root) = (robot.body.kinematics.clone(), robot.body.base);
    TcpChain { joints: (0..6).collect(), kinematics, link: robot.end_effector, root, tool: None }
}

/// The lines that only one of the texts has.
fn changes(before: &str, after: &str) -> String {
    let only = |sign: &str, of: &str, other: &str| -> String {
        let lines = of.lines().filter(|line| !other.lines().any(|o| o == *line));
        lines.map(|line| format!("{sign} {line}\n")).collect()
    };
    only("-", before, after) + &only("+", after, before)
}

#[test]
fn a_change_is_shown_as_lines() {
    assert_eq!(changes("a\nb\n", "b\nc\n"), "- a\n+ c\n");
    assert_eq!(changes("a\n", "a\n"), "");
}

#[test]
#[cfg(feature = "can")]
fn blueprint_keys() {
    let schema = dimos::blueprint::json_schema(&dimos::arms::registry());
    unchanged("blueprint", &schema::lines(&schema, &schema, ""));
}

#[test]
fn rpc_methods() {
    let schema = dimos::rpc::api::schema::json_schema();
    let mut lines = Vec::new();
    for (table, parts) in
        [("methods", &["params", "result"][..]), ("planner_requests", &["params", "result"]), ("streams", &["data"])]
    {
        for (name, row) in schema[table].as_object().unwrap() {
            lines.push(format!("{table} {name}"));
            parts.iter().for_each(|part| lines.extend(schema::lines(&schema, &row[part], &format!("  {part} "))));
        }
    }
    lines.push("error".to_owned());
    lines.extend(schema::lines(&schema, &schema["error"], "  "));
    unchanged("rpc", &lines);
}

#[test]
fn command_line() {
    let mut lines = Vec::new();
    let mut program = dimos::cli::command();
    program.build();
    verbs(&program, "dimos", &mut lines);
    unchanged("command-line", &lines);
}

/// A line per verb and per argument, in the order of the help.
fn verbs(command: &Command, path: &str, lines: &mut Vec<String>) {
    lines.push(path.to_owned());
    for arg in command.get_arguments().filter(|arg| !["help", "version"].contains(&arg.get_id().as_str())) {
        let mut words: Vec<String> = Vec::new();
        words.extend(arg.get_short_and_visible_aliases().into_iter().flatten().map(|c| format!("-{c}")));
        words.extend(arg.get_long_and_visible_aliases().into_iter().flatten().map(|l| format!("--{l}")));
        let takes_value = matches!(arg.get_action(), ArgAction::Set | ArgAction::Append);
        let names = arg.get_value_names().unwrap_or_default().iter().filter(|_| takes_value);
        words.extend(names.map(|name| format!("<{name}>")));
        if let Some(count) = arg.get_num_args().filter(|count| takes_value && count.to_string() != "1") {
            words.push(format!("values {count}"));
        }
        let flags = [
            ("required", arg.is_required_set()),
            ("repeatable", matches!(arg.get_action(), ArgAction::Append | ArgAction::Count)),
            ("hidden", arg.is_hide_set()),
        ];
        words.extend(flags.iter().filter(|(_, set)| *set).map(|(word, _)| (*word).to_owned()));
        let defaults: Vec<_> = arg.get_default_values().iter().map(|v| v.to_string_lossy()).collect();
        words.extend((!defaults.is_empty() && takes_value).then(|| format!("default {}", defaults.join(" "))));
        let possible = arg.get_possible_values();
        let possible: Vec<_> = possible.iter().map(|value| value.get_name()).collect();
        words.extend((!possible.is_empty() && takes_value).then(|| format!("one of {}", possible.join(" "))));
        words.extend(arg.get_env().map(|name| format!("env {}", name.to_string_lossy())));
        let others = command.get_arg_conflicts_with(arg);
        let others: Vec<_> = others.iter().map(|other| other.get_id().as_str()).collect();
        words.extend((!others.is_empty()).then(|| format!("not with {}", others.join(" "))));
        lines.push(format!("{path}  {}", words.join(" ")));
    }
    for verb in command.get_subcommands().filter(|verb| verb.get_name() != "help") {
        let hidden = if verb.is_hide_set() { " (hidden)" } else { "" };
        verbs(verb, &format!("{path} {}{hidden}", verb.get_name()), lines);
    }
}

#[test]
fn log_topics() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("run.mcap");
    let mut run = VirtualRun::start(&one_arm(6), &log);
    (run.states[0].gripper, run.states[0].wrench) = (Some(0.04), Some([0.0; 6]));
    let point = |time_from_start, position: f64| TrajectoryPoint {
        time_from_start,
        positions: [position; 6][..].into(),
        ..TrajectoryPoint::default()
    };
    let motion = JointTrajectory { joint_names: make_joints("arm", 6), points: vec![point(0.0, 0.0), point(0.5, 0.1)] };
    *run.tcps.lock().unwrap() = vec![Some(tcp())];
    let model = dimos::robot::load(&Source::new("builtin:yourarm")).into_model().unwrap();
    let joint = |i: usize| (model.joint_index(&format!("joint{}", i + 1)).unwrap(), i, format!("arm_joint{}", i + 1));
    let robot = LoggedRobot {
        name: "arm".into(),
        root: Isometry3::identity(),
        joints: (0..6).map(joint).collect(),
        rest: Vec::new(),
        moved_by_others: Vec::new(),
        gripper: None,
        end_effector: model.links.len() - 1,
        model,
    };
    let (stamp, robots) = (Mono(0), Arc::new(LoggedRobots::new(vec![robot])));
    run.notes.send(Note::Robots { stamp, robots, description: "<robot/>".into() }).unwrap();
    (0..20).for_each(|_| run.step());
    // What a run notes of its first request, if that is a trajectory.
    let trajectory = Arc::new(motion.clone());
    run.notes.send(Note::Execute { id: 1, stamp, origin: None, task: 0, motion: 1, trajectory, until: None }).unwrap();
    run.execute(0, &motion);
    (0..20).for_each(|_| run.step());
    run.finish();

    let bytes = fs::read(&log).unwrap();
    let summary = mcap::Summary::read(&bytes).unwrap().unwrap();
    let (mut topics, mut schemas) = (BTreeMap::new(), BTreeMap::new());
    for channel in summary.channels.values() {
        let schema = channel.schema.as_ref().unwrap();
        let topic = channel.topic.replace("/arm", "/<arm>").replace("/<arm>_status", "/arm_status");
        topics.insert(topic, format!("{} {} {}", channel.message_encoding, schema.encoding, schema.name));
        schemas.insert(schema.name.clone(), String::from_utf8(schema.data.to_vec()).unwrap());
    }
    let mut lines: Vec<String> = topics.iter().map(|(topic, form)| format!("topic {topic}  {form}")).collect();
    for (name, text) in schemas {
        lines.push(format!("message {name}"));
        let fields = text.lines().filter(|line| !line.is_empty() && !line.starts_with(['#', '=']));
        lines.extend(fields.map(|field| format!("  {field}")));
    }
    unchanged("log", &lines);
}

#[test]
fn exit_codes() {
    let contract = (0..=u8::MAX).filter(|code| Exit::of(*code) as u8 == *code);
    let lines: Vec<String> = contract.map(|code| format!("{code} {:?}", Exit::of(code))).collect();
    unchanged("exit-codes", &lines);
}

#[test]
fn python_client() {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/python/dimos_client");
    let files = ["errors", "records", "live_runs", "connection", "streams", "planning", "client", "own_run"];
    let text = |name: &str| fs::read_to_string(folder.join(name).with_extension("py")).unwrap();
    let lines: Vec<String> = files.iter().flat_map(|name| source::python(&text(name))).collect();
    unchanged("python", &lines);
}

/// What an adapter implements.
const ADAPTER_TRAITS: [&str; 4] = ["ManipulatorAdapter", "Gripper", "ForceTorque", "Cartesian"];

#[test]
fn methods_of_an_adapter() {
    let mut lines = source::traits(&Path::new(env!("CARGO_MANIFEST_DIR")).join("crates/hardware/src"));
    lines.retain(|(name, _)| ADAPTER_TRAITS.contains(&name.as_str()));
    let names: Vec<_> = lines.iter().map(|(name, _)| name.as_str()).collect();
    assert_eq!(names, ADAPTER_TRAITS, "the traits of an adapter, in one file of crates/hardware/src");
    unchanged("adapter", &lines.into_iter().flat_map(|(_, lines)| lines).collect::<Vec<_>>());
}

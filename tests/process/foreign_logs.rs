//! Logs of other programs, whole and damaged: every verb gives what PyPI mcap and pandas read, or says what it lacks
//! and does not exit with 0.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::{Value, json};

use crate::support::program::Home;
use crate::support::skip::skip_tool;

const HOME: [f64; 6] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];
/// Kinds of which other readers read the same as is written.
const WHOLE: [&str; 22] = [
    "plain",
    "lz4",
    "raw",
    "no_chunks",
    "out_of_order",
    "out_of_order_no_chunks",
    "other_order",
    "other_joints",
    "growing",
    "in_parts",
    "two_publishers",
    "elsewhere",
    "times",
    "giant",
    "split",
    "slow_publishers",
    "two_channels",
    "restarted",
    "disordered_chunks",
    "wrong_map",
    "no_profile",
    "equal_attachments",
];
/// Whole ones whose messages are not in order of time.
const DISORDERED: [&str; 3] = ["out_of_order", "out_of_order_no_chunks", "disordered_chunks"];
/// Damaged ones, and how many of their messages are left.
const DAMAGED: [(&str, usize); 15] = [
    ("chunk_crc", 200),
    ("first_crc", 200),
    ("flipped", 200),
    ("broken", 181),
    ("first_broken", 183),
    ("length", 181),
    ("cut", 112),
    ("bad_message", 200),
    ("bad_attachment", 200),
    ("split_missing", 400),
    ("split_empty", 400),
    ("split_no_log", 400),
    ("partly", 191),
    ("swallowed", 199),
    ("hidden", 181),
];

/// A message: topic, log time, publish time, positions by joint.
type Message = (String, u64, u64, BTreeMap<String, f64>);

fn python() -> Option<PathBuf> {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv/bin/python");
    python.exists().then_some(python)
}

fn tool(script: &str, arguments: &[&str]) -> Value {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests").join(script);
    let output = Command::new(python().unwrap()).arg(script).args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// The logs in a home, by name; `None` without the tools.
pub fn made() -> Option<(Home, Vec<String>)> {
    if python().is_none() {
        skip_tool("PyPI mcap in .venv");
        return None;
    }
    let home = Home::new();
    let folder = home.path().join("in");
    std::fs::create_dir(&folder).unwrap();
    let joints: Vec<String> = (1..=6).map(|i| format!("arm_joint{i}")).collect();
    let names =
        tool("python/make_logs.py", &[folder.to_str().unwrap(), &json!(joints).to_string(), &json!(HOME).to_string()]);
    let names = serde_json::from_value(names).unwrap();
    Some((home, names))
}

pub fn place(home: &Home, kind: &str) -> String {
    let folder = home.path().join("in").join(kind);
    if folder.is_dir() { format!("in/{kind}") } else { format!("in/{kind}.mcap") }
}

/// What other people's reader reads.
fn judged(home: &Home, log: &str) -> Vec<Message> {
    let read = tool("readers/read_foreign.py", &[home.path().join(log).to_str().unwrap()]);
    let message = |m: &Value| {
        let positions: Option<BTreeMap<String, f64>> = serde_json::from_value(m[3].clone()).unwrap();
        (
            m[0].as_str().unwrap().to_owned(),
            m[1].as_u64().unwrap(),
            m[2].as_u64().unwrap(),
            positions.unwrap_or_default(),
        )
    };
    sorted(read.as_array().unwrap().iter().map(message).collect())
}

fn sorted(mut messages: Vec<Message>) -> Vec<Message> {
    messages.sort_by(|a, b| (a.1, &a.0, a.3.keys().next()).cmp(&(b.1, &b.0, b.3.keys().next())));
    messages
}

/// What `dimos log cat` prints; publish times are not printed.
fn printed(text: &str) -> Vec<Message> {
    let message = |line: &str| {
        let m: Value = serde_json::from_str(line).unwrap();
        let list = |key: &str| m["data"][key].as_array().cloned().unwrap_or_default();
        let names = list("name").into_iter().map(|name| name.as_str().unwrap().to_owned());
        let positions =
            names.filter(|name| name.len() < 100).zip(list("position").into_iter().map(|q| q.as_f64().unwrap()));
        (m["topic"].as_str().unwrap().to_owned(), m["log_time"].as_u64().unwrap(), 0, positions.collect())
    };
    text.lines().map(message).collect()
}

fn without_publish_times(messages: &[Message]) -> Vec<Message> {
    messages.iter().map(|(topic, time, _, positions)| (topic.clone(), *time, 0, positions.clone())).collect()
}

/// Judges cat, export, recover, cut and rosbag2 of a log against the same messages.
fn judge(home: &Home, kind: &str, expected: &[Message], code: i32) {
    let log = place(home, kind);
    let cat = home.dimos(&format!("log cat {log} --json")).with(code);
    let cat = printed(&cat.out);
    assert!(cat.is_sorted_by_key(|m| m.1), "{kind}: in order of time");
    assert!(sorted(cat) == without_publish_times(expected), "{kind}: other messages");
    // What differs between these is the index alone.
    if kind.starts_with("index_") && !kind.ends_with("11") {
        return;
    }

    for (verb, written) in [
        (format!("log recover {log} -o out/{kind}.mcap"), format!("out/{kind}.mcap")),
        (format!("log cut {log} -o out/{kind}-cut.mcap"), format!("out/{kind}-cut.mcap")),
        (format!("log export {log} --rosbag2 out/{kind}-bag"), format!("out/{kind}-bag")),
    ] {
        home.dimos(&verb).with(code);
        assert!(judged(home, &written) == expected, "{verb}: other messages");
    }
    let bag = home.path().join(format!("out/{kind}-bag"));
    let read = tool("readers/read_foreign.py", &["--bag", bag.to_str().unwrap()]);
    let mut counts = BTreeMap::<&str, u64>::new();
    expected.iter().for_each(|message| *counts.entry(&message.0).or_default() += 1);
    assert_eq!(read, json!(counts), "{kind}: rosbags reads other messages");

    let states: Vec<&Message> = expected.iter().filter(|m| m.0 == "/joint_states" && !m.3.is_empty()).collect();
    if states.is_empty() {
        let export = home.dimos(&format!("log export {log} -o out/{kind}.csv"));
        export.with(2).says(&["no /joint_states", "joint states are on /robot/joint_states", "hint: "]);
        return;
    }
    home.dimos(&format!("log export {log} -o out/{kind}.csv")).with(code);
    let table =
        tool("readers/read_foreign.py", &["--csv", home.path().join(format!("out/{kind}.csv")).to_str().unwrap()]);
    let rows: Vec<(f64, BTreeMap<String, f64>)> = serde_json::from_value(table).unwrap();
    assert_eq!(rows.len(), states.len(), "{kind}");
    let began = 1_800_000_000_000_000_000;
    for (time, row) in &rows {
        // Messages of one time may be in either order.
        let same = states.iter().any(|m| {
            let is_then = ((m.1 - began) as f64 * 1e-9 - time).abs() < 1e-9;
            let positions: BTreeMap<String, f64> = m.3.iter().map(|(n, q)| (format!("{n}.position"), *q)).collect();
            is_then && positions == *row
        });
        assert!(same, "{kind}: {time} {row:?}");
    }
    let doctor = home.dimos(&format!("log doctor {log}")).with(code);
    if code != 0 {
        doctor.shows(&["not whole"]);
        let info = home.dimos(&format!("log info {log} --json")).with(code).json();
        assert!(info["loss"].is_string() && info["state"] != "complete", "{kind}: {info}");
    } else {
        home.dimos(&format!("log info {log}")).with(0).shows(&["complete"]);
        doctor.shows(&[if DISORDERED.contains(&kind) { "out of order" } else { "healthy" }]);
    }
}

/// Judges a third of the whole logs.
fn judge_whole(third: usize) {
    let Some((home, names)) = made() else { return };
    std::fs::create_dir(home.path().join("out")).unwrap();
    let indexes = names.iter().filter(|name| name.starts_with("index_")).map(|name| name.trim_end_matches(".mcap"));
    let kinds: Vec<&str> = WHOLE.into_iter().chain(indexes).collect();
    assert_eq!(kinds.len(), WHOLE.len() + 16);
    for kind in kinds.into_iter().skip(third).step_by(3) {
        let expected = judged(&home, &place(&home, kind));
        let least = if kind.contains("index_") { 250 } else { 200 };
        assert!(expected.len() >= least, "{kind}: {}", expected.len());
        judge(&home, kind, &expected, 0);
    }
}

#[test]
fn whole_logs_of_other_writers_are_read_as_others_read_them() {
    judge_whole(0);
}

#[test]
fn whole_logs_in_another_order_are_read_as_others_read_them() {
    judge_whole(1);
}

#[test]
fn whole_logs_with_other_indexes_are_read_as_others_read_them() {
    judge_whole(2);
}

#[test]
fn times_profiles_and_topics_of_other_writers_are_kept() {
    let Some((home, _)) = made() else { return };
    std::fs::create_dir(home.path().join("out")).unwrap();
    home.dimos("log recover in/times.mcap -o out/times.mcap").with(0);
    let times = judged(&home, "out/times.mcap");
    assert!(times.iter().all(|m| m.1 - m.2 == 5_000_000), "publish times are kept");
    let about = |log: &str| tool("readers/read_foreign.py", &["--about", home.path().join(log).to_str().unwrap()]);
    assert_eq!(about("out/times.mcap")["profile"], "ros1");
    // A window of the page is read by the same index; topics alone too.
    for kind in ["index_300", "index_200", "index_100", "index_001", "out_of_order", "split", "wrong_map"] {
        let topic = home.dimos(&format!("log cat {} --json --topics /joint_states", place(&home, kind))).with(0);
        assert_eq!(topic.out.lines().count(), 200, "{kind}");
    }
    home.dimos("log cat in/unrelated").with(2).says(&["several logs", "a.mcap and b.mcap", "hint: "]);
}

#[test]
fn damaged_logs_give_all_that_is_left_and_say_what_is_missing() {
    let Some((home, _)) = made() else { return };
    std::fs::create_dir(home.path().join("out")).unwrap();
    let whole = judged(&home, "in/plain.mcap");
    for (kind, left) in DAMAGED {
        let mut expected = judged(&home, &place(&home, kind));
        if kind == "length" {
            // The reader ends there; what comes after is known.
            expected =
                whole.iter().filter(|m| expected.contains(m) || m.1 > expected.last().unwrap().1).cloned().collect();
            expected.retain(|m| !(55..74).contains(&((m.1 - whole[0].1) / 10_000_000)));
        }
        if kind == "partly" {
            // That reader takes the message with the wrong length for the rest of the chunk.
            expected.retain(|m| m.1 != whole[65].1);
        }
        assert_eq!(expected.len(), left, "{kind}");
        if kind == "bad_message" || kind == "bad_attachment" {
            // Copies have every byte: what is damaged in them is said by who reads it.
            let log = place(&home, kind);
            let verb = if kind == "bad_message" { "cat" } else { "recover -o out/copy.mcap" };
            let (verb, options) = verb.split_once(' ').unwrap_or((verb, ""));
            home.dimos(&format!("log {verb} {log} {options}")).with(5).says(&["the log is not whole"]);
            continue;
        }
        judge(&home, kind, &expected, 5);
        let loss = home.dimos(&format!("log recover {} -o out/{kind}-2.mcap --json", place(&home, kind))).with(5);
        let loss = loss.json()["loss"].as_str().unwrap().to_owned();
        if !matches!(kind, "cut" | "hidden") && !kind.starts_with("split_") {
            assert!(loss.contains("byte") && loss.contains(" s to "), "{kind}: {loss}");
        }
        if matches!(kind, "broken" | "first_broken" | "length" | "hidden") {
            assert!(loss.contains(&format!("{} of 200 messages are missing", 200 - left)), "{kind}: {loss}");
        }
    }
    for (kind, kept) in [("flipped", "its messages are kept"), ("partly", "some of its"), ("swallowed", "some of its")]
    {
        home.dimos(&format!("log info in/{kind}.mcap")).with(5).says(&[kept]);
    }
    home.dimos("log info in/split_empty").with(5).says(&["split_empty_2.mcap is empty"]);
    home.dimos("log info in/split_no_log").with(5).says(&["split_no_log_2.mcap is not an MCAP file"]);
    // A copy that is copied again, by each way of copying.
    home.dimos("log recover out/copy.mcap -o out/copy-2.mcap").with(5).says(&["a.txt"]);
    home.dimos("log export out/copy-2.mcap --rosbag2 out/copy-3").with(5).says(&["a.txt"]);
    home.dimos("log doctor out/copy-3").with(5).shows(&["a.txt"]);
    home.dimos("log info in/bad_attachment.mcap").with(5).shows(&["damaged"]).says(&["a.txt"]);
    home.dimos("log info out/copy.mcap").with(5).says(&["a.txt"]);
    home.dimos("log doctor in/raw.mcap").with(0).shows(&["healthy"]);
    home.dimos("log doctor in/flipped.mcap").with(5).shows(&["CRC"]);
}

#[test]
fn attachments_metadata_and_silent_channels_are_copied() {
    let Some((home, _)) = made() else { return };
    let about = |log: &str| tool("readers/read_foreign.py", &["--about", home.path().join(log).to_str().unwrap()]);
    let whole = about("in/attached.mcap");
    assert_eq!(whole["attachments"].as_object().unwrap().len(), 3, "{whole}");
    home.dimos("log recover in/attached.mcap -o a.mcap").with(0);
    home.dimos("log cut in/attached.mcap --to 0.5 -o b.mcap").with(0);
    home.dimos("log export in/attached.mcap --rosbag2 c").with(0);
    for copy in ["a.mcap", "b.mcap", "c/c_0.mcap"] {
        assert_eq!(about(copy), whole, "{copy}");
    }
    // Equal ones of one file are two; those that every file of a log repeats are one.
    home.dimos("log recover in/equal_attachments.mcap -o twice.mcap").with(0);
    let info = home.dimos("log info twice.mcap --json").with(0).json();
    assert_eq!(info["attachments"].as_array().unwrap().len(), 2, "{info}");
    home.dimos("log info in/attached.mcap").with(0).shows(&["late.txt (4 B)", "big.bin (17825792 B)", "/silent"]);
}

#[test]
fn joints_twice_gaps_and_many_files_are_handled() {
    let Some((home, _)) = made() else { return };
    for verb in ["export -o a.csv", "export --parquet a.parquet", "plot -o a.svg"] {
        home.dimos(&format!("log {verb} in/joint_twice.mcap")).with(5).says(&["2 messages have arm_joint3 twice"]);
    }
    let table = std::fs::read_to_string(home.path().join("a.csv")).unwrap();
    let row: Vec<&str> = table.lines().nth(71).unwrap().split(',').collect();
    assert!(!row[1].is_empty() && row[9].is_empty(), "all but the doubled one: {row:?}");
    // Neither before the first message of a topic nor between two is an hour waited for.
    for topics in ["", "--topics /joint_states"] {
        let played = home.dimos(&format!("replay in/late.mcap {topics}")).with(0);
        assert!(played.took.as_secs_f64() < 10.0, "{:?}", played.took);
        played.says(&["the log has nothing for 2 h: that is not waited for"]);
    }
    // More files than a process may open.
    std::fs::create_dir(home.path().join("many")).unwrap();
    for k in 0..300 {
        std::fs::hard_link(home.path().join("in/late.mcap"), home.path().join(format!("many/{k:03}.mcap"))).unwrap();
    }
    for verb in ["log info many", "log export many -o many.csv", "log recover many -o many.mcap"] {
        let mut limited = Command::new("sh");
        limited.arg("-c").arg(format!("ulimit -n 100 && exec {} {verb}", env!("CARGO_BIN_EXE_dimos")));
        let output = home.settle(&mut limited).output().unwrap();
        assert!(output.status.success(), "{verb}: {}", String::from_utf8_lossy(&output.stderr));
    }
    assert_eq!(judged(&home, "many.mcap").len(), 300 * 21);
}

//! How logs are stored: in several files, without compression, and what is kept of a run without a log. Runs on a
//! virtual clock, with the real recorder.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use dimos::control::point_to_point::point_to_point;
use dimos::control::request::Request;
use dimos::control::task_spec::TaskTable;
use dimos::joint::{JointLimits, make_joints};
use dimos::recording::display_messages::{Marker, MarkerArray};
use dimos::recording::files;
use dimos::recording::notes::Note;
use dimos::recording::records::{RecordReader, check_sections};
use dimos::recording::replay::{LogReader, Payload, Selection};
use dimos::recording::scan::{Item, Scan};
use dimos::recording::storage::{FaultLog, Storage};
use dimos::replay::recorded::RecordedError;
use dimos::replay::verify::{Finding, verify};
use dimos::replay::what_if::{Row, what_if};
use dimos::telemetry::TaskState;

use crate::support::virtual_run::{VirtualRun, one_arm};
use crate::verify::reproducible;

fn parts(after: u64) -> Storage {
    Storage { split_after: Some(Duration::from_secs(after)), ..Storage::default() }
}

/// Runs for this many ticks, back and forth all the time.
fn swing(run: &mut VirtualRun, ticks: u64) {
    let (names, limits) = (make_joints("arm", 6), JointLimits::uniform(6, 3.0, 2.0).with_defaults());
    let end = run.tick + ticks;
    while run.tick < end {
        if run.tick > 60 && run.tasks[0].state != TaskState::Executing {
            let from = run.states[0].position[..6].to_vec();
            let to = if from[0] > 0.3 { [0.0; 6] } else { [0.7; 6] };
            run.execute(0, &point_to_point(&names, &from, &to, &limits, 0.7).unwrap());
        }
        run.step();
    }
}

fn begin(log: Option<&Path>, storage: Storage) -> VirtualRun {
    let mut run = VirtualRun::start_stored(&TaskTable::builtin(), &one_arm(6), log, storage);
    let stamp = run.now();
    let note = |note| run.notes.send(note).unwrap();
    note(Note::Robots { stamp, robots: Arc::default(), description: "<robot name=\"r\"/>".into() });
    let object = |name: &str, action| Marker { ns: format!("world/{name}"), action, ..Marker::default() };
    note(Note::Markers { stamp, markers: MarkerArray { markers: vec![object("wall", 0), object("box", 0)] } });
    note(Note::Markers { stamp, markers: MarkerArray { markers: vec![object("box", 2)] } });
    note(Note::Payload { arm: 0, stamp, load: Default::default() });
    run.step();
    run.ask(Request::Enabled { arm: 0, outside: false });
    run
}

/// Ticks in a log, in the order read.
fn ticks(log: &mut LogReader, from: u64) -> Vec<u64> {
    log.select(Selection { topics: vec!["/dimos/tick".into()], from, to: u64::MAX }).unwrap();
    let entries = std::iter::from_fn(|| log.next_entry().unwrap());
    entries.map(|entry| if let Payload::Tick(tick) = entry.data { tick.tick } else { panic!("{entry:?}") }).collect()
}

fn messages(path: &Path) -> u64 {
    let (mut scan, mut count) = (Scan::open(path).unwrap(), 0);
    while let Some(item) = scan.next_item().unwrap() {
        count += if let Item::Messages = item { scan.messages().count() as u64 } else { 0 };
    }
    assert!(scan.is_complete() && scan.loss().text().is_none());
    assert_eq!(scan.statistics().map(|(counted, _)| counted), Some(count));
    count
}

#[test]
fn a_log_in_several_files_is_read_and_verified_as_one() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("run.mcap");
    let mut run = begin(Some(&log), parts(10));
    swing(&mut run, 3499);
    run.finish();
    let others: Vec<PathBuf> = files::further_parts(&log).collect();
    assert_eq!(others, [1, 2, 3].map(|n| folder.path().join(format!("run_{n}.mcap"))));
    let found = reproducible(&log);
    assert!((found.ticks, found.length) == (3500, 34.99) && found.requests > 4, "{found:?}");
    let mut whole = LogReader::open(&log).unwrap();
    assert_eq!(ticks(&mut whole, 0), (0..3500).collect::<Vec<_>>());
    let (start, end) = whole.info().span.unwrap();
    assert!(whole.info().complete && end - start >= 34_990_000_000);
    // From the middle, to the beginning again, and the very end.
    assert_eq!(ticks(&mut whole, start + 25_000_000_000).first(), Some(&2500));
    assert_eq!(ticks(&mut whole, start + 3_000_000_000).len(), 3200);
    assert_eq!(ticks(&mut whole, end).len(), 1);
    let all = messages(&log);
    assert_eq!(all, messages_of_one(&log) + others.iter().map(|part| messages(part)).sum::<u64>());
    // Another run's file of such a name is no part of it.
    let other = folder.path().join("other.mcap");
    let mut run = begin(Some(&other), parts(1));
    swing(&mut run, 400);
    run.finish();
    std::fs::rename(files::part(&other, 1), files::part(&log, 4)).unwrap();
    assert_eq!(reproducible(&log).ticks, 3500);
    // A missing one ends it, and is said.
    std::fs::remove_file(&others[1]).unwrap();
    let found = verify(&log, &TaskTable::builtin()).unwrap();
    let Finding::Incomplete { why, .. } = &found.finding else { panic!("{found:?}") };
    assert!(why.contains("run_2.mcap is missing: the log continues in run_3.mcap") && found.ticks == 2001, "{found:?}");
}

/// Messages of the first file alone.
fn messages_of_one(log: &Path) -> u64 {
    let alone = log.with_file_name("alone.mcap");
    std::fs::copy(log, &alone).unwrap();
    messages(&alone)
}

#[test]
fn each_file_of_a_log_opens_alone() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("run.mcap");
    let mut run = begin(Some(&log), parts(2));
    swing(&mut run, 700);
    run.finish();
    for part in files::further_parts(&log) {
        assert!(dimos::recording::replay::attachment(&part, "coordinator.json").unwrap().is_some());
        let mut alone = LogReader::open(&part).unwrap();
        let first = ticks(&mut alone, 0)[0];
        alone.select(Selection::default()).unwrap();
        let mut before = Vec::new();
        while let Some(entry) = alone.next_entry().unwrap() {
            before.push(entry.topic.clone());
            if entry.topic == "/markers" {
                let text = serde_json::to_string(&entry.data).unwrap();
                assert!(text.contains("world/wall") && !text.contains("world/box"), "{text}");
            }
            if entry.topic == "/dimos/tick" {
                break;
            }
        }
        let wanted = ["/robot_description", "/tf_static", "/markers", "/payload/arm", "/joint_states", "/diagnostics"];
        let of_arm = ["/dimos/inputs/arm", "/dimos/outputs/arm", "/arm_status/arm"];
        assert!(wanted.iter().chain(&of_arm).all(|topic| before.iter().any(|b| b == topic)), "{first}: {before:?}");
        assert_eq!(before[0], "/robot_description");
        let refused = verify(&part, &TaskTable::builtin()).unwrap_err();
        assert!(matches!(refused, RecordedError::Part { .. }), "{refused}");
        assert!(refused.to_string().contains("is a part of run.mcap"), "{refused}");
    }
    assert_eq!(files::further_parts(&log).count(), 3);
}

#[test]
fn a_log_is_split_by_size_and_stored_without_compression() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("run.mcap");
    let storage = Storage { split_size: Some(1_000_000), compress: false, sync_every: None, ..Storage::default() };
    let mut run = begin(Some(&log), storage);
    swing(&mut run, 6000);
    run.finish();
    let parts: Vec<PathBuf> = std::iter::once(log.clone()).chain(files::further_parts(&log)).collect();
    assert!(parts.len() > 2, "{parts:?}");
    for part in &parts {
        // A chunk more, at most.
        assert!(std::fs::metadata(part).unwrap().len() < 2_000_000);
        let mut records = RecordReader::open(part).unwrap();
        let all = std::iter::from_fn(|| records.next_record().unwrap());
        let chunks = all.filter(|record| record.opcode == mcap::records::op::CHUNK);
        let compression = |body: &[u8]| match mcap::parse_record(mcap::records::op::CHUNK, body).unwrap() {
            mcap::records::Record::Chunk { header, .. } => header.compression,
            other => panic!("{other:?}"),
        };
        let kinds: Vec<String> = chunks.map(|chunk| compression(&chunk.body)).collect();
        assert!(!kinds.is_empty() && kinds.iter().all(String::is_empty), "{kinds:?}");
    }
    assert_eq!(reproducible(&log).ticks, 6001);
}

#[test]
fn a_closed_log_is_not_live_while_its_last_sync_still_has_the_lock() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("run.mcap");
    let mut run = begin(Some(&log), Storage::default());
    swing(&mut run, 200);
    run.finish();
    let syncing = std::fs::File::open(&log).unwrap();
    files::mark_as_being_written(&syncing);
    let found = reproducible(&log);
    assert!(!found.live && found.ticks > 200, "{found:?}");
    assert!(!LogReader::open(&log).unwrap().info().live);
}

/// A run without a log, in whose ring are 30 s. Waits for the log of its fault, which the recorder's thread writes.
fn faulty(folder: &Path, before: u64) -> PathBuf {
    let fault_log = Some(FaultLog { folder: folder.to_owned(), keep: 0 });
    let mut run = begin(None, Storage { fault_log, ..Storage::default() });
    swing(&mut run, before - 2);
    assert_eq!(files::all(folder).unwrap(), <[PathBuf; 0]>::default(), "nothing is written before a fault");
    run.states[0].error = 22;
    run.step();
    run.step();
    let logs = || files::all(folder).unwrap();
    while logs().is_empty() {
        std::thread::sleep(Duration::from_millis(5));
    }
    (0..1000).for_each(|_| run.step());
    run.finish();
    assert_eq!(logs().len(), 1);
    logs().remove(0)
}

#[test]
fn a_fault_of_a_run_without_a_log_is_kept_and_verified_from_the_start_of_the_run() {
    let folder = tempfile::tempdir().unwrap();
    let log = faulty(folder.path(), 1500);
    assert!(log.file_name().unwrap().to_str().unwrap().starts_with("virtual-fault-"), "{}", log.display());
    let found = reproducible(&log);
    // The tick of the fault, and 5 s.
    assert!((2000..=2003).contains(&found.ticks), "{found:?}");
    assert_eq!(check_sections(&log).unwrap().map(|e| e.to_string()), None);
    assert!(LogReader::open(&log).unwrap().info().complete);
}

#[test]
fn of_a_long_run_without_a_log_30_s_before_a_fault_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let log = faulty(folder.path(), 9000);
    let mut reader = LogReader::open(&log).unwrap();
    let ticks = ticks(&mut reader, 0);
    let (first, last) = (ticks[0], *ticks.last().unwrap());
    // Events take a few of the places for ticks.
    assert!((5400..=6000).contains(&first) && (9499..=9503).contains(&last), "{first} to {last}");
    assert!(ticks.iter().zip(first..).all(|(tick, expected)| *tick == expected));
    for topic in ["/robot_description", "/tf_static", "/markers", "/payload/arm", "/dimos/requests"] {
        reader.select(Selection { topics: vec![topic.into()], ..Selection::default() }).unwrap();
        assert!(reader.next_entry().unwrap().is_some(), "{topic}");
    }
    let refused = verify(&log, &TaskTable::builtin()).unwrap_err().to_string();
    assert!(refused.contains("is a part of a run whose beginning was not kept"), "{refused}");
}

#[test]
fn what_if_a_limit_were_lower() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("run.mcap");
    let mut run = begin(Some(&log), parts(3));
    swing(&mut run, 500);
    assert_eq!(run.tasks[0].state, TaskState::Executing);
    // Off the path for a moment.
    run.states[0].position[2] += 0.02;
    swing(&mut run, 400);
    run.finish();
    assert_eq!(verify(&log, &TaskTable::builtin()).unwrap().finding, Finding::Reproducible);
    let with = |path: &str, value: &str| {
        let mut rows = Vec::new();
        let changes = [(path.to_owned(), value.to_owned())];
        let mut read = Vec::new();
        let each = |row: Row<'_>| rows.push((row.tick, row.joint.to_owned(), row.logged, row.rerun));
        let found = what_if(&log, &TaskTable::builtin(), &changes, each, &mut |at, of| read.push((at, of)));
        // The summary at the end is not read.
        let most = read.last().is_some_and(|(at, of)| at <= of && 10 * at > 9 * of);
        assert!(found.is_err() || read.is_sorted() && most, "{read:?}");
        (found, rows)
    };
    // The same values change nothing.
    let (same, rows) = with("arms.arm.limits.velocity_max", "3.0");
    let same = same.unwrap();
    assert!(same.first.is_none() && rows.is_empty() && same.ticks == 901, "{same:?}");
    let (slow, rows) = with("arms.arm.velocity_max.arm_joint2", "0.4");
    let slow = slow.unwrap();
    let first = slow.first.clone().unwrap();
    assert_eq!((first.what, first.joint.as_deref()), ("position command", Some("arm_joint2")), "{first:?}");
    assert_eq!((rows[0].0, rows[0].1.as_str()), (first.tick, "arm_joint2"));
    assert!(slow.joints.iter().any(|joint| joint.joint == "arm_joint2" && joint.largest > 0.01), "{:?}", slow.joints);
    assert!(slow.events.iter().any(|event| !event.logged && event.text.contains("limited in velocity")));
    let (strict, _) = with("tasks.traj_arm.path_tolerance", "0.01");
    let strict = strict.unwrap();
    assert!(strict.events.iter().any(|event| !event.logged && event.text.contains("ABORTED")), "{:?}", strict.events);
    for (path, value, says) in [
        ("arms.elbow.velocity_max", "1", "there is no elbow\nhint: arm"),
        ("arms.arm.limits.speed", "1", "position_lower, position_upper, velocity_max"),
        ("arms.arm.limits.velocity_max", "-1", "leave no room to move"),
        ("arms.arm.limits", "1", "it has several values"),
        ("rate", "fast", "needs another of its kind"),
    ] {
        let refused = with(path, value).0.unwrap_err().to_string();
        assert!(refused.contains(says), "{path}: {refused}");
    }
}

#[test]
fn a_changed_byte_anywhere_is_noticed_by_the_checksums_of_the_sections() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("run.mcap");
    let mut run = begin(Some(&log), Storage::default());
    swing(&mut run, 200);
    run.finish();
    assert_eq!(check_sections(&log).unwrap().map(|e| e.to_string()), None);
    let bytes = std::fs::read(&log).unwrap();
    let find =
        |text: &str, from: usize| from + bytes[from..].windows(text.len()).position(|w| w == text.as_bytes()).unwrap();
    // The metadata in the data section; the name of a topic in the summary.
    let last = bytes.len() - 4000;
    for (at, says) in [(find("wall_offset_ns", 0), "Data section"), (find("/dimos/tick", last), "Summary")] {
        let mut changed = bytes.clone();
        changed[at] ^= 1;
        std::fs::write(&log, changed).unwrap();
        let wrong = check_sections(&log).unwrap().map(|e| e.to_string()).unwrap_or_default();
        assert!(wrong.contains(says), "{wrong}");
    }
}

#[test]
fn a_long_log_starts_at_its_end_without_reading_the_rest() {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("run.mcap");
    let mut run = begin(Some(&log), Storage::default());
    swing(&mut run, 20_000);
    run.finish();
    let (start, end) = LogReader::open(&log).unwrap().info().span.unwrap();
    // A reader that unpacks one of the other chunks finds it damaged.
    let mut bytes = std::fs::read(&log).unwrap();
    let mut records = RecordReader::open(&log).unwrap();
    let chunks = std::iter::from_fn(|| records.next_record().unwrap());
    let chunks: Vec<_> = chunks.filter(|record| record.opcode == mcap::records::op::CHUNK).collect();
    let latest = |chunk: &[u8]| u64::from_le_bytes(chunk[8..16].try_into().unwrap());
    let is_late = |chunk: &[u8]| latest(chunk) >= end - 10_000_000;
    for chunk in chunks.iter().filter(|chunk| !is_late(&chunk.body)) {
        bytes[chunk.at as usize + 9 + chunk.body.len() - 3] ^= 0xff;
    }
    std::fs::write(&log, bytes).unwrap();
    let mut reader = LogReader::open(&log).unwrap();
    assert_eq!(reader.info().span, Some((start, end)));
    assert_eq!(ticks(&mut reader, end - 5_000_000), [20_000]);
    reader.select(Selection::default()).unwrap();
    assert!(std::iter::from_fn(|| reader.next_entry().transpose()).any(|entry| entry.is_err()), "they are damaged");
}

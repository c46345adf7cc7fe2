//! Logs of earlier versions: every verb still reads them; `replay --verify` refuses those whose config version differs.
//! `tests/fixtures/logs/d8e75b9.mcap` was recorded with the program of that commit: `coordinator-mock`, a move to
//! 0.05 and −0.03 rad.

use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::process::Command;

use dimos::control::config::CONFIG_VERSION;
use dimos::control::task_spec::TaskTable;
use dimos::recording::replay::{LogReader, Payload, attachment};
use dimos::replay::motion::RecordedMotion;
use dimos::replay::recorded::RecordedError;
use dimos::replay::verify::verify;

use crate::support::virtual_run::{VirtualRun, one_arm};

fn fixture() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/fixtures/logs/d8e75b9.mcap")
}

/// Runs `dimos replay`. Returns exit code, stdout and stderr.
fn replay(log: &Path, arguments: &[&str]) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_dimos")).arg("replay").arg(log).args(arguments).output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code().unwrap(), text(&output.stdout), text(&output.stderr))
}

#[test]
fn an_older_log_plays_without_warnings() {
    let (code, out, err) = replay(&fixture(), &["--rate", "1000", "--json"]);
    assert_eq!(code, 0, "{err}");
    assert!(!err.contains("warning"), "{err}");
    let ticks = out.lines().filter(|line| line.contains(r#""topic":"/dimos/tick""#)).count();
    assert_eq!(ticks, 188);
    let (code, out, err) = replay(&fixture(), &["--rate", "1000"]);
    assert_eq!(code, 0, "{err}");
    assert!(out.contains("arm_joint1 0.0266 rad") && out.contains("task traj_arm is COMPLETED"), "{out}");
}

#[test]
fn fields_that_an_older_log_lacks_have_their_defaults() {
    let mut log = LogReader::open(&fixture()).unwrap();
    let mut inputs = 0;
    while let Some(entry) = log.next_entry().unwrap() {
        match entry.data {
            Payload::ArmInput(input) => {
                assert_eq!((input.interference.as_str(), input.own_delay_ns), ("", 0));
                assert!(input.stamp_ns > 0 && input.link == "up", "{input:?}");
                inputs += 1;
            }
            Payload::ArmOutput(output) => assert!(output.start_seq == 0 && output.next_tick_ns > 0, "{output:?}"),
            Payload::Unknown { .. } | Payload::Damaged { .. } => panic!("{entry:?}"),
            _ => {}
        }
    }
    assert!(inputs > 100, "{inputs}");
}

#[test]
fn the_motion_of_an_older_log_can_be_repeated() {
    let motion = RecordedMotion::read(&fixture(), 0, u64::MAX).unwrap();
    let last = motion.rows.last().unwrap();
    assert!((last[0] - 0.05).abs() < 1e-6 && (last[3] + 0.03).abs() < 1e-6 && motion.lost == 0, "{last:?}");
}

#[test]
fn verification_of_an_older_log_is_refused_with_both_versions() {
    let error = verify(&fixture(), &TaskTable::builtin()).unwrap_err();
    assert!(matches!(error, RecordedError::Version { found: 1, .. }), "{error:?}");
    let (code, out, err) = replay(&fixture(), &["--verify"]);
    assert_eq!((code, out.as_str()), (2, ""), "{err}");
    let needed = format!("config version {CONFIG_VERSION}");
    for part in ["dimos 0.1.0 (d8e75b98)", "config version 1", &needed, "\nhint: "] {
        assert!(err.contains(part), "{part}: {err}");
    }
}

#[test]
fn the_page_names_the_config_version() {
    let page = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/log-format.md")).unwrap();
    assert!(page.contains(&format!("This program has config version {CONFIG_VERSION}.")));
}

/// Copies a log with another config version in its metadata, and another `coordinator.json`.
fn with_version(from: &Path, to: &Path, version: Option<&str>, coordinator: &[u8]) {
    let mut metadata = LogReader::open(from).unwrap().info().metadata.clone();
    metadata.remove("config_version");
    metadata.extend(version.map(|version| ("config_version".to_owned(), version.to_owned())));
    let mut writer = mcap::Writer::new(std::fs::File::create(to).unwrap()).unwrap();
    let (name, media_type) = ("coordinator.json".to_owned(), "application/json".to_owned());
    let data = Cow::Borrowed(coordinator);
    writer.attach(&mcap::Attachment { log_time: 0, create_time: 0, name, media_type, data }).unwrap();
    writer.write_metadata(&mcap::records::Metadata { name: "dimos".into(), metadata }).unwrap();
    let bytes = std::fs::read(from).unwrap();
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        writer.write(&message.unwrap()).unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn the_version_in_the_metadata_decides_before_the_configuration_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let (log, copy) = (folder.path().join("now.mcap"), folder.path().join("copy.mcap"));
    let mut run = VirtualRun::start(&one_arm(2), &log);
    (0..20).for_each(|_| run.step());
    run.finish();
    let table = TaskTable::builtin();
    let found = |log: &Path| match verify(log, &table) {
        Ok(_) => CONFIG_VERSION,
        Err(RecordedError::Version { found, .. }) => found,
        Err(other) => panic!("{other}"),
    };
    let json = attachment(&log, "coordinator.json").unwrap().unwrap();
    assert_eq!(LogReader::open(&log).unwrap().info().metadata["config_version"], CONFIG_VERSION.to_string());
    assert_eq!(found(&log), CONFIG_VERSION);
    // Without an entry in the metadata, the version in `coordinator.json` counts.
    with_version(&log, &copy, None, &json);
    assert_eq!(found(&copy), CONFIG_VERSION);
    let next = CONFIG_VERSION + 1;
    with_version(&log, &copy, Some(&next.to_string()), &json);
    assert_eq!(found(&copy), next);
    // A configuration in a form of the future is no damaged one.
    with_version(&log, &copy, Some(&next.to_string()), br#"{"rate": "100 Hz"}"#);
    assert_eq!(found(&copy), next);
    let (code, _, err) = replay(&copy, &["--onto", "coordinator-mock"]);
    assert!(code == 2 && err.contains(&format!("config version {next}")), "{code}: {err}");
}

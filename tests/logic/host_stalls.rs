//! `make test` repeats a test only if this computer was stalled while it ran, or with `DIMOS_REPEAT` (tests/suite.py).
//! Cargo is replaced by a script that reports one failure; a stall is a suite that is stopped by a signal.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::process::Command;

use crate::support::skip;

/// Reports that `logic one` failed in the last second; before, the suite is stalled if `$STALL` is set. What is
/// run again passes, but for run number `$FAILS`.
const CARGO: &str = r#"#!/bin/sh
echo "$*" >>runs
count=$(wc -l <runs)
[ "$count" = 1 ] || [ "$count" = "$FAILS" ] || exit 0
[ -z "$STALL" ] || { kill -STOP $PPID; sleep 0.3; kill -CONT $PPID; }
sleep 0.1
mkdir -p target/nextest/default
cat >target/nextest/default/junit.xml <<END
<testsuites><testsuite name="dimos::logic">
<testcase name="other" timestamp="$(date -d '-1 sec' --iso-8601=ns | tr , .)" time="9"/>
<testcase name="one" timestamp="$(date -d '-1 sec' --iso-8601=ns | tr , .)" time="1.5"><failure/></testcase>
</testsuite></testsuites>
END
exit 100
"#;

/// Exit code and output of the suite, and what cargo was asked to run.
fn suite(stall: bool, repeat: &str, fails: &str) -> (Option<i32>, String, String) {
    let folder = tempfile::tempdir().unwrap();
    let cargo = folder.path().join("cargo");
    fs::write(&cargo, CARGO).unwrap();
    fs::set_permissions(&cargo, fs::Permissions::from_mode(0o755)).unwrap();
    let path = format!("{}:{}", folder.path().display(), std::env::var("PATH").unwrap());
    let mut command = Command::new("python3");
    command.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/suite.py")).current_dir(folder.path());
    command
        .env("PATH", path)
        .env_remove("CARGO_TARGET_DIR")
        .env_remove("FEATURES")
        .env("STALL", if stall { "yes" } else { "" })
        .env("DIMOS_REPEAT", repeat)
        .env("FAILS", fails);
    let output = command.output().unwrap();
    let runs = fs::read_to_string(folder.path().join("runs")).unwrap();
    (output.status.code(), String::from_utf8(output.stdout).unwrap(), runs)
}

#[test]
fn what_a_stall_interrupted_is_run_again_and_nothing_else() {
    if Command::new("python3").arg("--version").output().is_err() {
        return skip::skip_tool("python3");
    }
    let (code, output, runs) = suite(false, "0", "");
    assert_eq!((code, output.contains("INTERRUPTED"), runs.lines().count()), (Some(100), false, 1), "{output}{runs}");

    // Only a thread with a real-time priority can say that it was not merely kept waiting.
    let realtime = Command::new("chrt").args(["-f", "99", "true"]).status().is_ok_and(|status| status.success());
    let (code, output, runs) = suite(true, "0", "");
    if realtime {
        assert_eq!((code, runs.lines().count()), (Some(0), 2), "{output}{runs}");
        assert!(output.contains("INTERRUPTED: dimos::logic one: this computer was stalled for"), "{output}");
        let again = "nextest run --workspace --locked --test-threads 1 -E (binary_id(=dimos::logic) & test(=one))";
        assert_eq!(runs.lines().nth(1), Some(again), "{runs}");
    } else {
        assert_eq!((code, runs.lines().count()), (Some(100), 1), "{output}{runs}");
    }
}

#[test]
fn what_fails_beside_others_must_pass_each_time_alone() {
    if Command::new("python3").arg("--version").output().is_err() {
        return skip::skip_tool("python3");
    }
    let again = "nextest run --workspace --locked --test-threads 1 -E (binary_id(=dimos::logic) & test(=one))";
    for (fails, ends, count) in [("", 0, 3), ("2", 100, 2), ("3", 100, 3)] {
        let (code, output, runs) = suite(false, "2", fails);
        assert_eq!((code, runs.lines().count()), (Some(ends), count), "{fails}: {output}{runs}");
        assert!(runs.lines().skip(1).all(|run| run == again), "{runs}");
        assert_eq!(output.contains("FLAKY: dimos::logic one: failed beside others"), ends == 0, "{output}");
    }
}

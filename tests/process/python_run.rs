//! `dimos_client.run`: a run that a Python program starts ends with it, however it ends.

use std::path::Path;
use std::process::{Command, Stdio};

use rustix::process::Signal;

use crate::support::program::{Home, Started, eventually};
use crate::support::skip::skip_tool;

/// Starts a script that may import the client; `None` where there is no Python.
fn start(home: &Home, script: &str) -> Option<Started> {
    let python = Path::new(env!("CARGO_MANIFEST_DIR")).join(".venv/bin/python");
    if !python.exists() {
        skip_tool("Python");
        return None;
    }
    let mut command = Command::new(python);
    let assets = Path::new(env!("CARGO_MANIFEST_DIR")).join("assets/python");
    command.args(["-u", "-c", script]).env("PYTHONPATH", assets).env("PYTHONPYCACHEPREFIX", home.path());
    command.env("DIMOS", env!("CARGO_BIN_EXE_dimos"));
    Some(Started::of(home.settle(&mut command).stdin(Stdio::null())))
}

fn live(home: &Home) -> usize {
    home.runs().runs().unwrap().len()
}

/// What the text log of the run says of its end.
fn end(home: &Home, run: &str) -> String {
    let record = home.path().join("state/dimos").join(run).with_extension("json");
    let ended = || serde_json::from_slice::<serde_json::Value>(&std::fs::read(&record).ok()?).ok();
    eventually("its end is recorded", || ended().is_some_and(|record| record["end"].is_object()));
    ended().unwrap()["end"]["why"].as_str().unwrap().to_owned()
}

const WAITS: &str = "print('up', flush=True)\nimport time\ntime.sleep(60)";

#[test]
fn the_run_ends_with_the_program_or_with_its_block() {
    let home = Home::new();
    let script = "\
import dimos_client as d
robot = d.run('coordinator-yourarm', set=['coordinator.tick_rate=50'], name='own')
status = robot.status()
assert (status['run'], status['tick_rate'], status['simulated']) == ('own', 50.0, True), status
print(robot.move('arm', [0.2, -0.3, 0.6, 0, 0.8, 0])['state'])
with d.run('coordinator-mock') as other:
    assert sorted(d.runs()) == ['coordinator-mock', 'own']
assert sorted(d.runs()) == ['own'], d.runs()
other.close()
print('done')";
    let Some(script) = start(&home, script) else { return };
    assert_eq!(script.wait().with(0).out, "COMPLETED\ndone\n");
    assert_eq!(live(&home), 0, "it has ended before the program has");
    assert_eq!(end(&home, "own"), "shutdown requested");
}

#[test]
fn a_killed_program_takes_its_run_with_it_unless_it_is_kept() {
    let home = Home::new();
    let Some(kept) =
        start(&home, &format!("import dimos_client as d\nd.run('coordinator-mock', name='kept', keep=True)\n{WAITS}"))
    else {
        return;
    };
    // A child that the program forks keeps the run no longer up than the program itself.
    let forks = "import os\nif os.fork() == 0:\n    time.sleep(5)\n    os._exit(0)";
    let script = format!("import dimos_client as d, time\nd.run('coordinator-mock', name='own')\n{forks}\n{WAITS}");
    let own = start(&home, &script).unwrap();
    kept.until("up");
    own.until("up");
    assert_eq!(live(&home), 2);
    own.signal(Signal::KILL);
    assert_eq!(end(&home, "own"), "the process of --end-with has ended");
    kept.signal(Signal::KILL);
    let runs = home.runs().runs().unwrap();
    assert_eq!(runs.iter().map(|run| run.name.as_str()).collect::<Vec<_>>(), ["kept"]);
    // A copy of the client in a fork ends no run.
    let forked = "import dimos_client as d, os, sys\nrobot = d.run('coordinator-mock', name='forked')\n\
                  if os.fork() == 0:\n    sys.exit()\nos.wait()\nprint(robot.status()['run'])";
    assert_eq!(start(&home, forked).unwrap().wait().with(0).out, "forked\n");
    home.dimos("down kept").with(0);
}

#[test]
fn what_prevents_a_run_is_raised_and_leaves_none() {
    let home = Home::new();
    home.write("bad.yaml", "hardware: [{hardware_id: arm, adapter_type: mokc, joints: {prefix: arm, count: 2}}]");
    let tries = "\
import dimos_client as d, os
def fails(*arguments, **keywords):
    try:
        d.run(*arguments, **keywords)
    except d.NoRun as error:
        print(error.code, '|', error.message.replace('\\n', ' '), '|', error.hint)
fails('bad.yaml')
fails('nothing')
fails('coordinator-yourarm', set=['hardware.arm.options.sim.faults=[{at: 0, fault: nonsense}]'])
fails('coordinator-yourarm', sim=False, set=['hardware.arm.address=127.0.0.9:1'])
os.environ['DIMOS'] = '/nonexistent/dimos'
fails('coordinator-mock')";
    let Some(script) = start(&home, tries) else { return };
    let out = script.wait().with(0).out;
    let lines: Vec<&str> = out.lines().collect();
    let expected = [
        ("USAGE", "bad.yaml:1"),
        ("USAGE", "nothing"),
        ("USAGE", "nonsense"),
        ("HARDWARE", "arm"),
        ("NO_PROGRAM", "DIMOS"),
    ];
    assert_eq!(lines.len(), expected.len(), "{out}");
    for (line, (code, part)) in lines.iter().zip(expected) {
        assert!(line.starts_with(code) && line.contains(part), "{part}: {line}");
    }
    assert_eq!(live(&home), 0);
}

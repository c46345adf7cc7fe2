//! `adapter_type: remote` with the Python shim: the conformance suite against an adapter in the form of the guide's
//! skeleton, whole runs with it, and how a run reports a shim that dies or hangs.

use std::io::{BufRead, BufReader, Write};
use std::net::{IpAddr, Ipv4Addr};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::process::{Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use dimos::arms::remote::SPEC;
use dimos::arms::xarm::emulator::XArmEmulator;
use dimos::hardware::conformance::{Check, Outcome, checks, run};
use dimos::hardware::registry::{AdapterConfig, AdapterSpec, Emulator, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use rustix::process::Signal;

use crate::support::program::{Home, Started, eventually};
use crate::support::python::python_with;
use crate::support::skip::{skip, skip_port_502};

pub(super) const BLUEPRINT: &str = "
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: remote, address: 'ADDRESS', accept_zero_pose: true}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
";

fn in_tree(name: &str) -> String {
    Path::new(env!("CARGO_MANIFEST_DIR")).join(name).display().to_string()
}

/// Whether there is a Python; without one a test ends.
pub(super) fn has_python() -> bool {
    let found = Command::new("python3").arg("--version").stdout(Stdio::null()).status().is_ok();
    if !found {
        skip("python3");
    }
    found
}

/// The shim around a class of `tests/python`, at the address `at`.
pub(super) fn shim_of(python: &str, class: &str, home: &Home, at: &str, arguments: &[&str]) -> Command {
    let mut command = Command::new(python);
    command.args([&in_tree("assets/python/dimos_shim.py"), class, "--at", at]);
    home.settle(command.args(arguments).stdin(Stdio::null()));
    command.current_dir(in_tree("tests/python")).env("PYTHONPYCACHEPREFIX", home.path());
    command.env_remove("PYTHONDONTWRITEBYTECODE");
    command
}

/// The shim around the simulated arm.
fn shim(home: &Home, at: &str, arguments: &[&str], environment: &[(&str, &str)]) -> Started {
    let mut command = shim_of("python3", "sim_arm:SimArmAdapter", home, at, &["--address", "sim"]);
    Started::of(command.args(arguments).envs(environment.iter().copied()))
}

/// The address of a shim in a test.
pub(super) fn socket(home: &Home) -> String {
    format!("unix:{}/arm.sock", home.path().display())
}

/// Waits until a shim serves, and writes the blueprint `remote.yaml` of an arm behind it.
pub(super) fn serving(home: &Home, shim: Started) -> Started {
    shim.until("Ctrl-C ends it");
    home.write("remote.yaml", &BLUEPRINT.replace("ADDRESS", &socket(home)));
    shim
}

/// A shim that serves the simulated arm.
fn served(home: &Home, environment: &[(&str, &str)]) -> Started {
    serving(home, shim(home, &socket(home), &["--dof", "6"], environment))
}

/// An arm behind a shim, a run of it, and the arm on its way far away; `None` without Python.
fn on_its_way() -> Option<(Home, Started, Started)> {
    if !has_python() {
        return None;
    }
    let home = Home::new();
    let shim = served(&home, &[]);
    let run = home.run("remote.yaml");
    home.dimos("move arm 2.5 0 0 0 0 0 --speed 0.3 --no-wait").with(0);
    eventually("it moves", || home.positions("arm")[0] > 0.1);
    Some((home, shim, run))
}

/// Makes a held arm ready, and moves it.
fn moves_again(home: &Home, to: &str) {
    home.dimos("arm reset arm").with(0);
    home.dimos("arm enable arm").with(0);
    home.dimos(&format!("move arm {to}")).with(0);
}

// --- The conformance suite ---

/// The shim with its simulated arm, as an emulator.
struct PythonArm {
    shim: Started,
    address: String,
    _home: Home,
}

impl Emulator for PythonArm {
    fn address(&self) -> String {
        self.address.clone()
    }

    fn inject(&self, fault: Fault) -> Result<(), String> {
        let signal = match fault.kind {
            FaultKind::ErrorCode => Signal::USR1,
            FaultKind::Silent => Signal::STOP,
            kind => return Err(format!("{kind:?} cannot be played in Python")),
        };
        if fault.at == 0.0 {
            self.shim.signal(signal);
        }
        Ok(())
    }
}

/// The row, with the shim in place of the peer in Rust.
fn python_row() -> AdapterSpec {
    AdapterSpec {
        emulate: Some(|config, _| {
            let home = Home::new();
            let address = socket(&home);
            let shim = shim(&home, &address, &["--dof", &config.dof.to_string()], &[]);
            shim.until("Ctrl-C ends it");
            Ok(Box::new(PythonArm { shim, address, _home: home }))
        }),
        ..SPEC
    }
}

#[test]
fn an_adapter_of_the_guide_conforms_behind_the_shim() {
    if !has_python() {
        return;
    }
    let (row, next, all): (_, _, Vec<&Check>) = (python_row(), AtomicUsize::new(0), checks().collect());
    let outcomes: Vec<(&Check, Outcome)> = std::thread::scope(|scope| {
        let lane = || {
            let mine = std::iter::from_fn(|| all.get(next.fetch_add(1, Ordering::Relaxed)).copied());
            mine.map(|check| (check, run(&row, check, None))).collect::<Vec<_>>()
        };
        let lanes: Vec<_> = (0..5).map(|_| scope.spawn(lane)).collect();
        lanes.into_iter().flat_map(|lane| lane.join().unwrap()).collect()
    });
    let mut failures = Vec::new();
    let passed = outcomes.iter().filter(|(_, outcome)| *outcome == Outcome::Passed).count();
    for (check, outcome) in outcomes {
        match outcome {
            Outcome::Passed => println!("{:32} passed", check.name),
            Outcome::Skipped(why) => println!("{:32} does not apply: {why}", check.name),
            Outcome::Failed(why) => failures.push(format!("{}: {why}", check.name)),
        }
    }
    assert!(failures.is_empty(), "\n{}", failures.join("\n"));
    assert!(passed >= 20, "{passed} checks passed");
}

// --- Whole runs ---

#[test]
fn a_run_moves_reads_and_stops_an_arm_behind_the_shim() {
    if !has_python() {
        return;
    }
    let home = Home::new();
    let shim = served(&home, &[]);
    let mode = std::fs::metadata(home.path().join("arm.sock")).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600, "for its user only");
    let run = home.run("remote.yaml");
    home.dimos("move arm 0.3 -0.2 0.5 0 0.4 0").with(0);
    for (now, then) in home.positions("arm").iter().zip([0.3, -0.2, 0.5, 0.0, 0.4, 0.0]) {
        assert!((now - then).abs() < 0.01, "{now} {then}");
    }
    let status = home.status();
    assert_eq!((&status["arms"][0]["phase"], &status["simulated"]), (&"ready".into(), &false.into()), "{status}");
    home.dimos("stop --json").with(0);
    run.end(Signal::INT).with(130);
    // It still serves: the next run needs no new shim.
    let again = home.run("remote.yaml");
    assert!(home.positions("arm")[0] > 0.2);
    again.end(Signal::INT).with(130);
    shim.end(Signal::INT).with(0);
}

#[test]
fn a_shim_killed_in_motion_is_reported_and_the_arm_is_held() {
    let Some((home, shim, run)) = on_its_way() else { return };
    drop(shim.end(Signal::KILL));
    run.until("closed the connection");
    eventually("it is latched", || home.status()["arms"][0]["phase"] != "ready");
    home.dimos("move arm 0 0 0 0 0 0").with(1);
    // A new shim takes the dead one's place, and the run reconnects automatically, but nothing moves without `enable`.
    let again = served(&home, &[]);
    eventually("the link is up again", || home.status()["arms"][0]["link"] == "up");
    assert!(home.positions("arm")[0].abs() < 0.01, "a new simulated arm, at rest");
    moves_again(&home, "0.1 0 0 0 0 0");
    run.end(Signal::INT).with(130);
    drop(again);
}

#[test]
fn a_shim_that_hangs_is_reported_and_stops_the_arm_when_it_continues() {
    let Some((home, shim, run)) = on_its_way() else { return };
    shim.signal(Signal::STOP);
    run.until("setpoints are not acknowledged");
    run.until("is held (");
    shim.signal(Signal::CONT);
    shim.until("stopping the arm");
    eventually("the link is up again", || home.status()["arms"][0]["link"] == "up");
    let held = home.positions("arm");
    std::thread::sleep(Duration::from_millis(300));
    assert!((home.positions("arm")[0] - held[0]).abs() < 0.01, "it stays where it was stopped");
    run.end(Signal::INT).with(130);
}

#[test]
fn an_arm_whose_run_is_killed_is_stopped_by_the_shim() {
    let Some((home, shim, run)) = on_its_way() else { return };
    drop(run.end(Signal::KILL));
    shim.until("the client's connection ended");
    assert!(!shim.out().contains("the stop failed"), "{}", shim.out());
    let run = home.run("remote.yaml --name second");
    let held = home.dimos("state --json --run second").with(0).json();
    let first = held["arms"][0]["joints"][0]["position"].as_f64().unwrap();
    assert!(first > 0.1 && first < 2.4, "it did not go to its end: {first}");
    run.end(Signal::INT).with(130);
}

#[test]
fn a_frozen_run_is_noticed_by_the_shim() {
    let Some((home, shim, run)) = on_its_way() else { return };
    run.signal(Signal::STOP);
    shim.until("no request came for 0.5 s: stopping the arm");
    run.signal(Signal::CONT);
    eventually("its commands are refused", || home.status()["arms"][0]["phase"] != "ready");
    moves_again(&home, "0 0 0 0 0 0");
    run.end(Signal::INT).with(130);
}

#[test]
fn a_slow_sdk_keeps_its_own_pace() {
    if !has_python() {
        return;
    }
    let home = Home::new();
    // 30 ms a call: a command and two reads fill a period of 100 ms, and all reads in each cycle would not.
    let slow = shim(&home, &socket(&home), &["--dof", "6", "--hz", "10"], &[("ROUND_TRIP", "0.03")]);
    let _shim = serving(&home, slow);
    let run = home.run("remote.yaml");
    home.dimos("move arm 0.3 0 0 0 0 0 --speed 0.2").with(0);
    assert!((home.positions("arm")[0] - 0.3).abs() < 0.02);
    let rate = home.status()["arms"][0]["measured_rate_hz"].as_f64().unwrap();
    assert!((1.0..25.0).contains(&rate), "{rate}");
    run.end(Signal::INT).with(130);
}

#[test]
fn the_vendors_sdk_in_an_adapter_of_the_guide_runs_an_xarm() {
    let Some(python) = python_with(&["xarm"]) else { return };
    let (ip, options) = (IpAddr::V4(Ipv4Addr::new(127, 0, 7, 2)), serde_json::json!({}));
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 6, options };
    let emulator = match XArmEmulator::start(&config, &EmulatorAddress::Bind(ip)) {
        Ok(emulator) => emulator,
        Err(error) if error.to_string().contains(":502: ") => {
            return skip_port_502();
        }
        Err(error) => panic!("{error}"),
    };
    let start = emulator.joints().0;
    let home = Home::new();
    let arguments = ["--address", &ip.to_string(), "--dof", "6", "--hz", "20"];
    let mut command = shim_of(python.to_str().unwrap(), "xarm_guide:XArmAdapter", &home, &socket(&home), &arguments);
    let shim = serving(&home, Started::of(&mut command));
    let run = home.run("remote.yaml");
    assert_eq!(home.positions("arm").len(), 6);
    for (now, then) in emulator.joints().0.iter().zip(start) {
        assert!((now - then).abs() < 1e-3, "starting moves nothing");
    }
    home.dimos("move arm 0.3 -0.5 -0.9 0.1 1.3 -0.1 --speed 0.3").with(0);
    let there = [0.3, -0.5, -0.9, 0.1, 1.3, -0.1];
    for ((now, plant), then) in home.positions("arm").iter().zip(emulator.joints().0).zip(there) {
        assert!((now - then).abs() < 0.01 && (plant - then).abs() < 0.01, "{now} {plant} {then}");
    }
    home.dimos("move arm 2.0 -0.5 -0.9 0.1 1.3 -0.1 --speed 0.2 --no-wait").with(0);
    eventually("it moves", || emulator.joints().0[0] > 0.5);
    home.dimos("stop --json").with(0);
    eventually("it is at rest", || emulator.joints().1.iter().all(|v| v.abs() < 1e-3));
    let stopped = emulator.joints().0[0];
    assert!(stopped < 1.9, "{stopped}");
    run.end(Signal::INT).with(130);
    assert!((emulator.joints().0[0] - stopped).abs() < 0.01, "leaving moves nothing");
    shim.end(Signal::INT).with(0);
}

// --- What is not right ---

#[test]
fn errors_of_the_adapter_are_reported_before_anything_moves() {
    if !has_python() {
        return;
    }
    for (trouble, parts) in [
        ("nan", &["error: arm: ", "read_joint_positions() answers nan for joint 3"][..]),
        ("short", &["error: arm: ", "read_joint_positions() answers 5 values for 6 joints"]),
        ("read_enabled", &["cannot be enabled: the motors did not come on within 1 s"]),
    ] {
        let home = Home::new();
        let _shim = served(&home, &[("TROUBLE", trouble)]);
        let ended = home.dimos("run remote.yaml").with(3).says(parts);
        assert_eq!(ended.err.lines().filter(|l| l.starts_with("error: ")).count(), 1, "{}", ended.err);
    }
    let home = Home::new();
    let fails = |at: &str, environment: &[(&str, &str)], part: &str| {
        let ended = shim(&home, at, &["--dof", "6"], environment).wait().with(1);
        assert!(ended.err.starts_with(&format!("error: sim_arm:SimArmAdapter --at {at}: ")), "{}", ended.err);
        assert!(ended.err.contains(part) && ended.err.lines().count() == 1, "{}", ended.err);
    };
    for at in ["tcp:0.0.0.0:7450", "nonsense", "tcp:127.0.0.1:x"] {
        fails(at, &[], "not a loopback address");
    }
    home.write("notes", "kept");
    let at = format!("unix:{}/notes", home.path().display());
    fails(&at, &[], "Address already in use");
    assert_eq!(std::fs::read_to_string(home.path().join("notes")).unwrap(), "kept");
    fails(&socket(&home), &[("TROUBLE", "connect")], "connect() said no");
    fails(&socket(&home), &[("TROUBLE", "infinite")], "read_joint_velocities() answers -inf for joint 2");
}

/// A client that speaks the protocol itself.
struct Client(BufReader<UnixStream>, u32);

impl Client {
    fn connect(home: &Home) -> Self {
        let stream = UnixStream::connect(home.path().join("arm.sock")).unwrap();
        stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
        Self(BufReader::new(stream), 0)
    }

    fn say(&mut self, line: &str) -> String {
        self.0.get_mut().write_all(format!("{line}\n").as_bytes()).unwrap();
        let mut reply = String::new();
        self.0.read_line(&mut reply).unwrap();
        reply
    }

    fn ask(&mut self, rest: &str) -> String {
        self.1 += 1;
        self.say(&format!(r#"{{"id":{},"do":{rest}}}"#, self.1))
    }

    /// Begins a motion.
    fn command(&mut self) {
        for request in [
            r#""hello","version":1,"dof":6"#,
            r#""activate","args":[]"#,
            r#""set_control_mode","args":["servo_position"]"#,
            r#""cycle","command":{"mode":"servo_position","values":[0.1,0,0,0,0,0],"velocity":1.0}"#,
        ] {
            let reply = self.ask(request);
            assert!(!reply.contains("error\":\"") && !reply.contains("refused\":\""), "{request}: {reply}");
        }
    }
}

#[test]
fn other_connections_and_malformed_requests_leave_no_arm_in_motion() {
    if !has_python() {
        return;
    }
    let home = Home::new();
    let shim = served(&home, &[]);
    let mut client = Client::connect(&home);
    let held = client.ask(r#""write_joint_velocities","args":[[1,0,0,0,0,0]]"#);
    assert!(held.contains("write_joint_velocities is not for clients"), "{held}");
    client.command();
    for _ in 0..50 {
        drop(UnixStream::connect(home.path().join("arm.sock")).unwrap());
    }
    let cycle = client.ask(r#""cycle""#);
    assert!(cycle.contains("read_joint_positions"), "it continues: {cycle}");
    // Others that knock are no sign of life of the client.
    let knocking = std::thread::scope(|scope| {
        let knock = || {
            (0..200).take_while(|_| !shim.out().contains("no request came for 0.5 s: stopping the arm")).for_each(
                |_| {
                    drop(UnixStream::connect(home.path().join("arm.sock")).unwrap());
                    std::thread::sleep(Duration::from_millis(100));
                },
            );
        };
        scope.spawn(knock).join()
    });
    assert!(knocking.is_ok());
    assert!(shim.out().contains("no request came for 0.5 s: stopping the arm"), "{}", shim.out());
    for nonsense in ["null", "[]", "{}", "7", "GET / HTTP/1.1"] {
        drop(client);
        client = Client::connect(&home);
        client.command();
        let before = shim.out().matches("stopping the arm").count();
        assert_eq!(client.say(nonsense), "", "{nonsense} ends the connection");
        eventually("the arm is stopped", || shim.out().matches("stopping the arm").count() > before);
    }
    shim.end(Signal::INT).with(0);
}

#[test]
fn an_import_error_is_one_line_with_a_hint() {
    if !has_python() {
        return;
    }
    for (class, what) in [
        ("nosuch:Arm", "No module named 'nosuch'\n"),
        ("sim_arm:NoArm", "module 'sim_arm' has no attribute 'NoArm'\n"),
        ("sim_arm", "module 'sim_arm' has no attribute ''\n"),
    ] {
        let home = Home::new();
        let ended = Started::of(&mut shim_of("python3", class, &home, &socket(&home), &[])).wait().with(1);
        let what = format!("error: {class} --at {}: {what}", socket(&home));
        let hint = ended.err.strip_prefix(&what).unwrap_or_else(|| panic!("{}", ended.err));
        assert!(hint.starts_with("hint: give MODULE:CLASS") && hint.lines().count() == 1, "{}", ended.err);
    }
}

#[test]
fn folders_that_an_adapter_creates_can_be_entered() {
    if !has_python() {
        return;
    }
    let home = Home::new();
    let _shim = served(&home, &[]);
    // Python caches the adapter's module in a folder that it creates.
    let cache = home.path().join(in_tree("tests/python").trim_start_matches('/'));
    assert_eq!(std::fs::metadata(cache).unwrap().permissions().mode() & 0o700, 0o700);
}

#[test]
fn one_client_at_a_time() {
    if !has_python() {
        return;
    }
    let home = Home::new();
    let _shim = served(&home, &[]);
    let first = UnixStream::connect(home.path().join("arm.sock")).unwrap();
    home.dimos("run remote.yaml").with(3).says(&["error: arm: ", "it serves another client already"]);
    drop(first);
    home.run("remote.yaml").end(Signal::INT).with(130);
    home.write(
        "seven.yaml",
        &std::fs::read_to_string(home.path().join("remote.yaml")).unwrap().replace("count: 6", "count: 7"),
    );
    home.dimos("run seven.yaml").with(3).says(&["expected 7 joints, the arm says 6", "hint: ", "--dof 7"]);
}

#[test]
fn a_rotary_gripper_is_in_radians() {
    if !has_python() {
        return;
    }
    let home = Home::new();
    let at = socket(&home);
    let mut shim = shim_of("python3", "sim_arm:RotaryGripperAdapter", &home, &at, &["--address", "sim"]);
    let _shim = serving(&home, Started::of(shim.args(["--dof", "6"])));
    let _run = home.run("remote.yaml");
    home.dimos("arm gripper arm 0.05").with(0).shows(&["arm: gripper reached 0.05", " rad, after "]);
    assert_eq!(home.dimos("state --json").with(0).json()["arms"][0]["gripper_unit"], "rad");
    home.dimos("arm gripper arm 0.05 --force 1").with(1).says(&["no force control", "[UNSUPPORTED]"]);
}

#[test]
fn the_shim_is_python_3_9_of_bounded_length() {
    if !has_python() {
        return;
    }
    let file = in_tree("assets/python/dimos_shim.py");
    let check = "import ast, sys; ast.parse(open(sys.argv[1]).read(), feature_version=(3, 9))";
    assert!(Command::new("python3").args(["-c", check, &file]).status().unwrap().success());
    let text = std::fs::read_to_string(&file).unwrap();
    assert!(text.lines().count() <= 340 && text.lines().all(|line| line.len() <= 120), "one file that can be read");
}

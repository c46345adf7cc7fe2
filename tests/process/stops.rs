//! A stop always gets through, and a request that is refused leaves nothing behind: the real binary, judged on its
//! socket and by its words.

use std::io::{BufRead, BufReader, Write};
use std::net::IpAddr;
use std::os::unix::net::{UnixListener, UnixStream};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock};
use std::thread::JoinHandle;
use std::time::Duration;

use dimos::arms::yourarm;
use dimos::arms::yourarm::emulator::wire::Request;
use dimos::arms::yourarm::emulator::{SimOptions, YourArmEmulator};
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::rpc::Code;
use dimos::rpc::api::{
    ArmEnable, ArmReset, Confirmation, Execute, Point, Servo, State, Status, Stop, Trajectory, Velocity,
};
use dimos::rpc::client::{Client, ClientError};
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Record, Run};
use dimos::testing::{Call, MockAdapter};
use rustix::thread::CapabilitySet;
use serde_json::{Value, json};

use crate::support::loopback::own_address;
use crate::support::program::{Home, Started, eventually};
use crate::support::skip::skip_privileged;

const BLUEPRINT: &str = "
hardware:
  - {hardware_id: arm, joints: {prefix: arm, count: 6}, adapter_type: mock}
tasks:
  - {name: traj_arm, type: trajectory, joint_names: {hardware: arm}}
  - {name: velocity_arm, type: velocity, joint_names: {hardware: arm}, priority: 20}
";

fn up(arguments: &str) -> (Home, Started) {
    let home = Home::new();
    home.write("streams.yaml", BLUEPRINT);
    let run = home.run(&format!("streams.yaml {arguments}"));
    (home, run)
}

fn raw(home: &Home) -> UnixStream {
    UnixStream::connect(home.path().join("run/dimos/streams.sock")).unwrap()
}

/// A trajectory with this number of points that does not begin at the arm's position.
fn elsewhere(points: usize) -> Trajectory {
    let joint_names = (1..=6).map(|j| format!("arm_joint{j}")).collect();
    let point = |i: usize| Point {
        time_from_start: i as f64,
        positions: (0..6).map(|j| 1.5 + 1e-6 * f64::from(j)).collect(),
        ..Point::default()
    };
    Trajectory { joint_names, points: (0..points).map(point).collect() }
}

/// Brings a stopped arm back to ready.
fn make_ready(client: &mut Client) {
    eventually("the arm is ready again", || {
        let ready = |c: &mut Client| -> Result<bool, ClientError> {
            c.call(ArmReset { arm: "arm".into() })?;
            Ok(c.call(ArmEnable::new("arm"))?.phase == "ready")
        };
        ready(client).unwrap_or(false)
    });
}

fn refusal<T: std::fmt::Debug>(result: Result<T, ClientError>) -> dimos::rpc::RpcError {
    match result {
        Err(ClientError::Refused(error)) => error,
        other => panic!("not refused: {other:?}"),
    }
}

#[test]
fn idle_connections_do_not_lock_out_a_stop() {
    let (home, _run) = up("--no-record");
    let idle: Vec<UnixStream> = (0..160).map(|_| raw(&home)).collect();
    // Some of them have asked something before, and hold a place for good.
    for stream in &idle {
        let _ = (&mut &*stream).write_all(b"{\"id\":1,\"method\":\"state\"}\n");
    }
    let stopped = home.dimos("stop").with(0).out;
    assert!(stopped.contains("confirmed"), "{stopped}");
    home.dimos("cancel").with(0);
    home.dimos("status").with(0);
    home.dimos("state").with(0);
    home.dimos("arm reset arm").with(0);
    home.dimos("down").with(0);
    drop(idle);
}

#[test]
fn connections_that_are_in_use_stay_when_others_make_room() {
    let (home, _run) = up("--no-record");
    let mut holder = home.client();
    holder.call(dimos::rpc::api::Lease::default()).unwrap();
    let subscriber = raw(&home);
    let ask = b"{\"id\":1,\"method\":\"subscribe\",\"params\":{\"stream\":\"coordinator_joint_state\",\"rate\":5}}\n";
    (&subscriber).write_all(ask).unwrap();
    let mut messages = BufReader::new(subscriber.try_clone().unwrap());
    messages.read_line(&mut String::new()).unwrap();
    let connected = |_| {
        let mut client = home.client();
        client.call(State {}).unwrap();
        client
    };
    let mut idle: Vec<Client> = (0..160).map(connected).collect();
    holder.call(State {}).unwrap();
    assert_eq!(
        holder.call(Status {}).unwrap().arms[0].commander.as_ref().map(|c| c.pid),
        Some(Some(std::process::id() as i32))
    );
    for _ in 0..20 {
        let mut line = String::new();
        messages.read_line(&mut line).unwrap();
        assert!(line.contains("\"stream\""), "{line}");
    }
    // The connection that was closed to make room gets the reason.
    let first = refusal(idle[0].call(State {}));
    assert_eq!(first.code, Code::TooManyConnections);
    assert!(first.message.contains("make room"), "{first:?}");
}

#[test]
fn a_connection_that_was_silent_goes_on_where_it_was() {
    let (home, run) = up("--no-record");
    let threads = || {
        let all = std::fs::read_dir(format!("/proc/{}/task", run.pid())).unwrap();
        let names = all.filter_map(|task| std::fs::read_to_string(task.unwrap().path().join("comm")).ok());
        names.filter(|name| name.trim() == "rpc-client").count()
    };
    let mut client = home.client();
    client.call(dimos::rpc::api::Lease::default()).unwrap();
    let us = Some(Some(std::process::id() as i32));
    for _ in 0..3 {
        client.call(State {}).unwrap();
        eventually("its thread has ended", || threads() == 0);
        // What it is asked now is answered by the thread that takes stops; the lease is still its own.
        assert_eq!(client.call(Status {}).unwrap().arms[0].commander.as_ref().map(|c| c.pid), us);
        assert_eq!(client.call(Stop { arm: None }).unwrap().arms["arm"], Confirmation::Confirmed);
        assert_eq!(threads(), 0);
        make_ready(&mut client);
    }
}

/// Everything that clients do to a run beside a stop, until it is dropped.
struct Flood {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Flood {
    fn begin(home: &Home) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let execute =
            json!({"id": 1, "method": "execute", "params": {"trajectory": elsewhere(2000)}}).to_string() + "\n";
        let socket = home.path().join("run/dimos/streams.sock");
        let threads = (0..24).map(|i| {
            let (stop, socket, execute) = (stop.clone(), socket.clone(), execute.clone());
            std::thread::spawn(move || {
                while !stop.load(Ordering::Relaxed) {
                    let Ok(stream) = UnixStream::connect(&socket) else { return };
                    let _ = stream.set_read_timeout(Some(Duration::from_secs(1)));
                    let _ = stream.set_write_timeout(Some(Duration::from_millis(100)));
                    flood(i % 8, stream, &execute, &stop);
                }
            })
        });
        Self { threads: threads.collect(), stop }
    }
}

/// Leaves a connection open for a while.
fn waits() -> bool {
    std::thread::sleep(Duration::from_millis(50));
    true
}

/// One client of the flood, of one of eight kinds.
fn flood(kind: usize, stream: UnixStream, execute: &str, stop: &AtomicBool) {
    let mut replies = BufReader::new(stream.try_clone().unwrap());
    let mut ask = |line: &[u8]| {
        let mut reply = String::new();
        (&stream).write_all(line).is_ok() && replies.read_line(&mut reply).is_ok_and(|n| n > 0)
    };
    while !stop.load(Ordering::Relaxed) {
        let goes_on = match kind {
            0 => ask(b"{\"id\":1,\"method\":\"status\"}\n"),
            1 => ask(b"{\"id\":1,\n"),
            2 => ask(execute.as_bytes()),
            // Never reads.
            3 => (&stream).write_all(b"{\"id\":1,\"method\":\"status\"}\n").is_ok(),
            // A line that never ends, byte by byte.
            4 => {
                (&stream).write_all(b"{").is_ok() && {
                    std::thread::sleep(Duration::from_millis(5));
                    true
                }
            }
            // Half a stop.
            5 => (&stream).write_all(b"{\"id\":1,\"method\":\"stop\",\"params\":{").is_ok() && waits(),
            // Nothing.
            6 => waits(),
            // A line that is too long.
            _ => ask(&vec![b' '; 300 * 1024]),
        };
        if !goes_on {
            return;
        }
    }
}

impl Drop for Flood {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

#[test]
fn every_stop_beside_a_flood_is_answered_and_confirmed() {
    let (home, _run) = up("--no-record");
    let mut client = home.client();
    let _flood = Flood::begin(&home);
    for n in 0..15 {
        // In turns over a connection that asks other things too, and as a user types it.
        if n % 3 == 0 {
            let stopped = home.dimos("stop").with(0).out;
            assert!(stopped.contains("confirmed"), "{stopped}");
        } else {
            let reply = client.call(Stop { arm: None }).unwrap();
            assert_eq!(reply.arms["arm"], Confirmation::Confirmed, "stop {n}");
        }
        make_ready(&mut client);
    }
}

#[test]
fn stop_stops_every_arm_of_every_run() {
    let home = Home::new();
    home.write("streams.yaml", BLUEPRINT);
    home.write(
        "other.yaml",
        &BLUEPRINT.replace("hardware_id: arm", "hardware_id: left").replace("hardware: arm", "hardware: left"),
    );
    let _one = home.run("streams.yaml --no-record --name one");
    let _two = home.run("streams.yaml --no-record --name two");
    let _three = home.run("other.yaml --no-record --name three");
    let phases = || {
        let status = home.dimos("status --json").with(0).json();
        let runs = status.as_array().unwrap().iter();
        runs.map(|r| (r["run"].as_str().unwrap().to_owned(), r["arms"][0]["phase"].clone())).collect::<Vec<_>>()
    };
    let held = |names: &[&str]| phases().iter().all(|(run, phase)| (phase == "held") == names.contains(&run.as_str()));
    let stopped = home.dimos("stop left").with(0).out;
    assert!(stopped.contains("three") && !stopped.contains("one"), "{stopped}");
    assert!(held(&["three"]), "{:?}", phases());
    let stopped = home.dimos("stop arm --run one").with(0).out;
    assert!(stopped.contains("one") && !stopped.contains("two"), "{stopped}");
    assert!(held(&["three", "one"]), "{:?}", phases());
    let stopped = home.dimos("stop arm").with(0).out;
    assert!(stopped.contains("one") && stopped.contains("two") && !stopped.contains("three"), "{stopped}");
    home.dimos("arm reset arm --run one").with(0);
    let stopped = home.dimos("stop").with(0).out;
    assert!(["one", "two", "three"].iter().all(|run| stopped.contains(run)), "{stopped}");
    assert!(held(&["one", "two", "three"]), "{:?}", phases());
    home.dimos("stop rihgt").with(2).says(&["no arm named `rihgt`", "hint: "]);
}

#[test]
fn runs_of_other_users_are_named_as_not_stopped() {
    let (home, _run) = up("--no-record");
    let folder = home.path().join("theirs/dimos");
    std::fs::create_dir_all(&folder).unwrap();
    let socket = folder.join("their-cell.sock");
    let _theirs = UnixListener::bind(&socket).unwrap();
    if let Err(error) = std::os::unix::fs::chown(&socket, Some(65534), None) {
        return skip_privileged(&format!("a socket of another user: {error}"), CapabilitySet::CHOWN);
    }
    // In the open world. No run there has such an arm, so none is stopped.
    let open = |arguments: &str| Started::of(home.command(arguments).env_remove("DIMOS_WORLD")).wait();
    let stopped = open("stop arm-of-no-run").says(&["not stopped: run their-cell of user "]);
    assert!(!stopped.out.contains("their-cell"), "{}", stopped.out);
    open("status").says(&["note: run their-cell of user "]);
    assert!(!home.dimos("stop").with(0).err.contains("their-cell"), "the world of this test is closed");
}

#[test]
fn a_stop_that_arrives_after_the_reconnect_is_reported() {
    let home = Home::new();
    // A fixed address, where the arm can come back.
    let ip = IpAddr::from(own_address());
    let power_on = || {
        let config = AdapterConfig { hardware_id: "arm".into(), address: ip.to_string(), dof: 6, options: json!({}) };
        (yourarm::SPEC.emulate.unwrap())(&config, &EmulatorAddress::Bind(ip)).unwrap()
    };
    let arm = power_on();
    let run = home.run(&format!("coordinator-yourarm --no-record --set hardware.arm.address={ip}"));
    drop(arm);
    eventually("the link is lost", || home.status()["arms"][0]["link"] != "up");
    let refused = home.dimos("stop").with(1);
    assert!(refused.out.contains("not sent"), "{}", refused.out);
    assert_eq!(home.status()["arms"][0]["stop_pending"], true);
    let _arm = power_on();
    run.until("the stop of arm was delivered after the reconnect");
    assert_eq!(home.status()["arms"][0].get("stop_pending"), None);
}

#[test]
fn a_refused_request_takes_no_lease() {
    let (home, _run) = up("--no-record");
    let (mut one, mut two) = (home.client(), home.client());
    let mismatch = refusal(one.call(Execute { trajectory: elsewhere(2), task: None, retraces_to: None }));
    assert_eq!(mismatch.code, Code::StartStateMismatch);
    assert!(two.call(Status {}).unwrap().arms[0].commander.is_none(), "the refused request kept the lease");
    let far = dimos::rpc::api::Move::new("arm", [99.0; 6], 1.0);
    assert_eq!(refusal(one.call(far)).code, Code::OutOfLimits);
    let wrong = Servo::new("velocity_arm", vec![0.0; 6]);
    assert_eq!(refusal(one.call(wrong)).code, Code::WrongTask);
    assert!(two.call(Status {}).unwrap().arms[0].commander.is_none(), "the refused request kept the lease");
    // A lease that was held before stays.
    one.call(dimos::rpc::api::Lease::default()).unwrap();
    refusal(one.call(Execute { trajectory: elsewhere(2), task: None, retraces_to: None }));
    assert!(two.call(Status {}).unwrap().arms[0].commander.is_some());
}

#[test]
fn a_servo_target_for_a_velocity_task_is_for_the_wrong_task() {
    let (home, _run) = up("--no-record");
    let wrong = Servo::new("velocity_arm", vec![1.0; 6]);
    assert_eq!(refusal(home.client().call(wrong)).code, Code::WrongTask);
}

#[test]
fn absurd_durations_are_refused() {
    let (home, _run) = up("--no-record");
    let mut trajectory = elsewhere(2);
    trajectory.points.iter_mut().for_each(|p| p.positions = vec![0.0; 6]);
    trajectory.points[1].time_from_start = 1e308;
    let refused = refusal(home.client().call(Execute { trajectory, task: None, retraces_to: None }));
    assert_eq!(refused.code, Code::InvalidParams);
    assert!(refused.message.contains("24 h"), "{refused:?}");
    home.write("long.csv", "time,arm_joint1\n0,0\n1e308,0\n");
    home.dimos("execute long.csv").with(2).says(&["long.csv:3:1", "24 h"]);
}

#[test]
fn an_enable_that_a_stop_overtakes_is_an_error() {
    let (home, _run) = up("--no-record --set hardware.arm.auto_enable=false");
    let (mut one, mut two) = (home.client(), home.client());
    let mut refused = None;
    // The stop has to come between the first and the last tick of the activation.
    for _ in 0..20 {
        let enable = std::thread::spawn({
            let mut client = home.client();
            move || client.call(ArmEnable::new("arm"))
        });
        eventually("it is being enabled", || {
            one.call(Status {}).unwrap().arms[0].phase == "activating" || enable.is_finished()
        });
        two.call(Stop { arm: None }).unwrap();
        match enable.join().unwrap() {
            Err(ClientError::Refused(error)) => {
                refused = Some(error);
                break;
            }
            Ok(reply) => assert_eq!(reply.phase, "ready", "overtaken, and a result all the same"),
            Err(error) => panic!("{error}"),
        }
        two.call(ArmReset { arm: "arm".into() }).unwrap();
        home.dimos("arm disable arm").with(0);
    }
    assert_eq!(refused.expect("one of the stops came in time").code, Code::ArmLatched);
}

#[test]
fn refused_executes_are_not_logged_whole() {
    let (home, run) = up("");
    let mut client = home.client();
    for _ in 0..40 {
        refusal(client.call(Execute { trajectory: elsewhere(1500), task: None, retraces_to: None }));
    }
    run.end(rustix::process::Signal::TERM);
    let log = home.logs().pop().unwrap();
    let replies =
        home.dimos(&format!("replay {} --json --rate 1000000 --topics /dimos/requests", log.display())).with(0).out;
    let refusals: Vec<Value> = replies.lines().map(|l| serde_json::from_str(l).unwrap()).collect();
    assert!(refusals.len() >= 40, "every refusal is in the log");
    assert!(replies.len() < 40 * 1000, "{} bytes for 40 refusals", replies.len());
    home.dimos(&format!("replay {} --verify", log.display())).with(0);
}

/// A velocity task that moves joint 6 at this speed [rad/s] until the arm does, then the end of its stream.
fn let_go_at(home: &Home, speed: f64, measured: f64) {
    let mut client = home.client();
    eventually("it moves", || {
        let velocities = vec![0.0, 0.0, 0.0, 0.0, 0.0, speed];
        client.call(Velocity { task: "velocity_arm".into(), velocities }).unwrap();
        let state = client.call(State {}).unwrap();
        state.arms[0].joints[5].velocity.is_some_and(|v| v >= measured)
    });
}

#[test]
fn disable_switches_off_an_arm_at_rest_however_long_it_brakes() {
    let home = Home::new();
    let arm = YourArmEmulator::with(&SimOptions::default()).unwrap();
    home.write(
        "streams.yaml",
        "
include: [coordinator-yourarm]
tasks:
  - {name: velocity_arm, type: velocity, joint_names: {hardware: arm}, priority: 20}
",
    );
    // From 0.8 rad/s to rest in 4 s.
    let limits = "--set hardware.arm.limits.acceleration=0.2";
    let _run = home.run(&format!("streams.yaml --no-record --set hardware.arm.address={} {limits}", arm.address()));
    let_go_at(&home, 0.8, 0.75);
    arm.record();
    home.dimos("arm disable arm").with(0);
    let trace = arm.trace();
    let off = trace.iter().position(|r| r.request == Request::Enable(false)).expect("the motors were switched off");
    let last = trace[..off].iter().rev().find_map(|r| match r.request {
        Request::VelocityJoints(velocities) => Some(velocities[5].to_radians()),
        _ => None,
    });
    let last = last.expect("it was braked by velocities");
    assert!(last.abs() < 0.01, "the motors went off at {last} rad/s");
}

/// An arm that always reports motion.
static RUNAWAY: LazyLock<MockAdapter> = LazyLock::new(|| MockAdapter::new(7).positions(&[0.1; 7]));

#[test]
fn an_arm_that_does_not_come_to_rest_keeps_its_motors_unless_now_is_said() {
    let mut row = *dimos::arms::registry().get("mock").unwrap();
    row.create = |_| Ok(Box::new(RUNAWAY.clone()));
    let folder = tempfile::tempdir().unwrap();
    let run = Run::from_name("coordinator-mock").unwrap().record(Record::Off).folder(RunDir::closed(folder.path()));
    let run = run.adapters(&[row]).start().unwrap();
    let _moving = RUNAWAY.clone().velocities(Some(&[0.0, 0.3, 0.0, 0.0, 0.0, 0.0, 0.0]));
    eventually("it moves", || run.state().arms[0].joints[1].velocity.is_some_and(|v| v > 0.2));
    let switched_off = || RUNAWAY.calls().contains(&Call::WriteEnable(false));
    let refused = run.disable("arm").unwrap_err();
    assert_eq!(refused.code, Code::ArmNotReady);
    assert!(refused.message.contains("arm still moves at 0.30 rad/s"), "{refused}");
    assert!(refused.hint.is_some_and(|hint| hint.contains("--now")));
    assert!(!switched_off(), "its motors stay on");
    let note = run.disable_now("arm").unwrap().note;
    assert_eq!(note.as_deref(), Some("the motors were switched off at once, while it moved at 0.30 rad/s"));
    assert!(switched_off());
}

#[test]
fn disable_now_says_so() {
    let (home, _run) = up("--no-record");
    let cut = home.dimos("arm disable --now arm").with(0);
    assert!(cut.out == "arm: disabled\n" && cut.err.contains("switched off at once"), "{}{}", cut.out, cut.err);
}

//! `replay --verify` of real runs: threads, devices and a socket. What comes of a run depends on the machine; its log
//! comes out the same again.

use std::path::Path;
use std::time::Duration;

use dimos::blueprint::{Blueprint, Overrides};
use dimos::recording::files;
use dimos::rpc::api;
use dimos::rpc::client::Client;
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Options, Record, Run};

use crate::verify::reproducible;

fn blueprint(name: &str, set: &[&str]) -> Blueprint {
    let set = set.iter().map(|s| (*s).to_owned()).collect();
    let registry = dimos::arms::registry();
    let found = dimos::blueprint::find(name).unwrap_or_else(|e| panic!("{}", e.message));
    let loaded = dimos::blueprint::load(&found, &Overrides { set, ..Overrides::default() }, &registry);
    loaded.blueprint.clone().unwrap_or_else(|| panic!("{}", loaded.render(false)))
}

/// Starts a real run: threads, devices, socket.
fn start(folder: &Path, blueprint: &Blueprint, probe: Option<dimos::control::tick_loop::Probe>) -> (Run, Client) {
    let options = Options {
        record: Record::To(folder.join("real.mcap")),
        folder: RunDir::closed(folder.join("runs")),
        probe,
        hold_latency: false,
        ..Options::default()
    };
    let run = Run::start(blueprint, options).unwrap();
    let client = Client::connect("real", run.socket().unwrap()).unwrap();
    (run, client)
}

fn wait_for_end(client: &mut Client, motion: u64) -> String {
    for _ in 0..600 {
        let report = client.call(api::Motion { motion }).unwrap();
        if report.done {
            return report.state;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    panic!("the motion does not end");
}

/// Moves, cancel, stop, reset, enable, gripper, on a loop that now and then is late. What comes of all that depends
/// on the machine; what matters is that it comes out the same again.
fn exercise(name: &str, dof: usize) {
    let folder = tempfile::tempdir().unwrap();
    let probe = Box::new(|tick| {
        if tick == 40 || tick == 90 || tick == 91 {
            std::thread::sleep(Duration::from_millis(27));
        }
    });
    let (run, mut client) = start(folder.path(), &blueprint(name, &[]), Some(probe));
    let begin = |client: &mut Client, target: Vec<f64>| {
        client.call(api::Move::new("arm", target, 0.8)).ok().map(|begun| begun.motion)
    };
    let goal: Vec<f64> = (0..dof).map(|j| 0.1 + 0.02 * j as f64).collect();
    let motion = begin(&mut client, goal.clone()).expect("the arm is ready");
    wait_for_end(&mut client, motion);
    let motion = begin(&mut client, vec![0.0; dof]);
    client.call(api::Cancel::default()).unwrap();
    motion.map(|motion| wait_for_end(&mut client, motion));
    let _ = client.call(api::Gripper { arm: "arm".into(), position: 0.03, force: Some(7.5), ..Default::default() });
    begin(&mut client, vec![0.25; dof]);
    client.call(api::Stop { arm: None }).unwrap();
    let _ = client.call(api::ArmReset { arm: "arm".into() });
    let _ = client.call(api::ArmEnable::new("arm"));
    begin(&mut client, goal).map(|motion| wait_for_end(&mut client, motion));
    // The run ends in mid-motion.
    begin(&mut client, vec![0.0; dof]);
    let ended = run.stop();
    let found = reproducible(&ended.log.unwrap());
    assert!(found.ticks > 40 && found.requests >= 6 && found.events > 12, "{found:?}");
}

#[test]
fn a_run_of_yourarm_is_reproducible() {
    exercise("coordinator-yourarm", 6);
}

#[test]
fn a_run_of_mock_is_reproducible() {
    exercise("coordinator-mock", 7);
}

const STREAMED: &str = "
name: streamed
coordinator: {tick_rate: 200}
hardware:
  - hardware_id: arm
    joints: {prefix: arm, count: 3}
    adapter_type: mock
    options: {velocity_feedback: false, faults: [{kind: error_code, at: 1.2, code: 22}]}
tasks:
  - {name: servo, type: servo, joint_names: {hardware: arm}}
  - {name: velocity, type: velocity, joint_names: {hardware: arm}, priority: 5}
";

#[test]
fn a_fault_of_a_run_that_is_not_recorded_is_logged() {
    let folder = tempfile::tempdir().unwrap();
    let (path, logs) = (folder.path().join("streamed.yaml"), folder.path().join("logs"));
    std::fs::write(&path, STREAMED).unwrap();
    let directory = format!("recording.directory={}", logs.display());
    let blueprint = blueprint(path.to_str().unwrap(), &[&directory]);
    let options = |record| Options {
        record,
        folder: RunDir::closed(folder.path().join("runs")),
        hold_latency: false,
        ..Options::default()
    };
    let run = Run::start(&blueprint, options(Record::Faults)).unwrap();
    for _ in 0..500 {
        if !files::all(&logs).unwrap().is_empty() {
            break;
        }
        std::thread::sleep(Duration::from_millis(20));
    }
    // The run ends before the 5 s after the fault are over.
    assert_eq!(run.stop().log, None);
    let found = files::all(&logs).unwrap();
    assert_eq!(found.len(), 1, "the fault did not come");
    assert!(reproducible(&found[0]).ticks > 200);
}

#[test]
fn streams_and_an_arm_fault_are_reproducible() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("streamed.yaml");
    std::fs::write(&path, STREAMED).unwrap();
    let (run, mut client) = start(folder.path(), &blueprint(path.to_str().unwrap(), &[]), None);
    // Until the fault comes, and refused from then on.
    let mut refused = 0;
    for k in 0..400 {
        let x = 0.1 * (f64::from(k) * 0.02).sin();
        let sent = client.call(api::Servo::new("servo", vec![x, -x, x / 3.0]));
        refused += u32::from(sent.is_err());
        if refused > 20 {
            break;
        }
        std::thread::sleep(Duration::from_millis(7));
    }
    assert!(refused > 20, "the fault did not come");
    let ended = run.stop();
    let found = reproducible(&ended.log.unwrap());
    assert!(found.requests > 40, "{found:?}");
}

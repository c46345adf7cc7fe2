//! An adapter in Python that takes setpoints with torques, in its own process behind the shim: judged by what it gets.

use std::time::Duration;

use dimos::rpc::api::State;
use serde_json::Value;

use super::remote_shim::{has_python, serving, shim_of, socket};
use crate::support::program::{Home, Started, eventually};

/// Torque of the shoulder and the elbow of `builtin:yourarm` with all joints at zero [Nm]: its forearm is horizontal.
const WEIGHT: f64 = 9.80665 * (2.0 * 0.125 + 0.5 * 0.265 + 0.7 * 0.3 + 0.4 * 0.37);

/// A shim with an arm that records its setpoints, and the blueprint of a run with its weight fed forward.
fn recording(home: &Home) -> Started {
    let record = home.path().join("record.jsonl");
    std::fs::write(&record, "").unwrap();
    let mut command =
        shim_of("python3", "setpoint_arm:SetpointArmAdapter", home, &socket(home), &["--address", "sim", "--dof", "6"]);
    let shim = serving(home, Started::of(command.env("RECORD", record)));
    let fed = "accept_zero_pose: true, feed_forward: gravity, model_path: 'builtin:yourarm', limits: {effort: 60}}";
    let blueprint = read(home, "remote.yaml").replace("accept_zero_pose: true}", fed);
    home.write("remote.yaml", &blueprint);
    shim
}

fn read(home: &Home, name: &str) -> String {
    std::fs::read_to_string(home.path().join(name)).unwrap()
}

fn got(home: &Home) -> Vec<Value> {
    let text = read(home, "record.jsonl");
    text.lines().filter_map(|line| serde_json::from_str(line).ok()).collect()
}

#[test]
fn a_python_adapter_gets_velocities_torques_and_times_and_none_of_what_it_does_not_take() {
    if !has_python() {
        return;
    }
    let home = Home::new();
    let _shim = recording(&home);
    let _run = home.run("remote.yaml");
    eventually("it is streamed to", || got(&home).len() > 20);
    for setpoint in got(&home) {
        let torques: Vec<f64> = serde_json::from_value(setpoint["effort"].clone()).expect("its weight");
        assert!((torques[1] + WEIGHT).abs() < 0.01 && (torques[2] + WEIGHT).abs() < 0.01, "{torques:?}");
        assert_eq!((torques.len(), setpoint["velocity"].as_array().unwrap().len()), (6, 6));
    }
    home.dimos("move arm 0.3 0 0 0 0 0 --speed 0.5").with(0);
    let all = got(&home);
    let times: Vec<u64> = all.iter().map(|setpoint| setpoint["at"].as_u64().unwrap()).collect();
    assert!(times.windows(2).all(|pair| pair[0] < pair[1]), "each tick has its time");
    assert!(all.iter().all(|setpoint| setpoint["expires"].as_f64().is_some_and(|time| (0.01..1.0).contains(&time))));
    let fastest = all.iter().filter_map(|setpoint| setpoint["velocity"][0].as_f64()).fold(0.0, f64::max);
    assert!(fastest > 0.1, "{fastest} rad/s");
}

#[test]
fn a_joint_that_does_not_answer_is_lost_by_name() {
    if !has_python() {
        return;
    }
    let home = Home::new();
    let _shim = recording(&home);
    let _run = home.run("remote.yaml");
    eventually("it is streamed to", || got(&home).len() > 5);
    home.write("record.jsonl.lost", "3");
    eventually("it is held", || home.dimos("status").out.contains("joint 4 no longer answers"));
    let arm = home.client().call(State::default()).unwrap().arms.remove(0);
    let known: Vec<bool> = arm.joints.iter().map(|joint| joint.position.is_some()).collect();
    assert_eq!(known, [true, true, true, false, true, true]);
    assert_eq!(arm.effort_kind, None, "it reports no efforts");
    std::thread::sleep(Duration::from_millis(300));
    home.dimos("arm reset arm").says(&["joint 4 no longer answers"]);
    std::fs::remove_file(home.path().join("record.jsonl.lost")).unwrap();
    eventually("it is reset", || home.dimos("arm reset arm").code == Some(0));
    home.dimos("arm enable arm").with(0);
}

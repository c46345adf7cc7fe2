//! Faults of `docs/faults.md` that need whole runs but no real-time scheduling.

use dimos::rpc::api::Move;
use rustix::process::Signal;

use crate::support::program::{Home, eventually};

#[test]
fn f03_an_adapter_that_panics_costs_its_own_arm_only() {
    let home = Home::new();
    home.write(
        "two.yaml",
        "hardware:\n\
         - {hardware_id: a, adapter_type: mock, joints: {prefix: a, count: 2}, options: {faults: [{at: 1.5, kind: panic}]}}\n\
         - {hardware_id: b, adapter_type: mock, joints: {prefix: b, count: 2}}\n\
         tasks:\n\
         - {name: ta, type: trajectory, joint_names: {hardware: a}}\n\
         - {name: tb, type: trajectory, joint_names: {hardware: b}}\n",
    );
    let run = home.run("two.yaml --no-record");
    for arm in ["a", "b"] {
        home.client().call(Move::new(arm, [1.5, 0.0], 0.15)).unwrap();
    }
    eventually("arm a is held", || home.status()["arms"][0]["phase"] == "held");
    eventually("its link is faulted", || home.status()["arms"][0]["link"] == "faulted");
    let status = home.status();
    assert_eq!(status["tasks"][0]["state"], "ABORTED", "{status}");
    assert_eq!((&status["arms"][1]["phase"], &status["tasks"][1]["state"]), (&"ready".into(), &"EXECUTING".into()));
    home.dimos("arm reset a").with(1);
    home.dimos("arm enable a").with(1);
    eventually("arm b is at its goal", || home.status()["tasks"][1]["state"] == "COMPLETED");
    assert!((home.positions("b")[0] - 1.5).abs() < 0.01);
    run.end(Signal::INT).says(&["the adapter panicked"]);
}

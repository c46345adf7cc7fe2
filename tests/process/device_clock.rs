//! `coordinator.clock: device(ARM)`: ticks begin with the states of an emulated UR, as its log shows.

use dimos::arms::ur::emulator::UrEmulator;
use dimos::clock::{Clock, MonotonicClock};
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use dimos::recording::replay::{LogReader, Payload};

use crate::support::program::{Home, eventually};

/// A run whose second arm follows.
const CELL: &str = "
name: clocked
include: [coordinator-ur5e]
coordinator: {tick_rate: 125, clock: device(arm)}
hardware:
  - {hardware_id: follower, adapter_type: mock, joints: {prefix: f, count: 2}}
tasks:
  - {name: traj_follower, type: trajectory, joint_names: {hardware: follower}}
";

#[test]
fn ticks_begin_with_the_states_of_the_arm_and_continue_without_them() {
    let home = Home::new();
    let config = AdapterConfig {
        hardware_id: "arm".into(),
        address: String::new(),
        dof: 6,
        options: serde_json::json!({"model": "ur5e"}),
    };
    let arm = UrEmulator::start(&config, &EmulatorAddress::InProcess).unwrap();
    home.write("cell.yaml", CELL);
    let run = home.run(&format!("cell.yaml --set hardware.arm.address={}", arm.address()));
    run.until("125 Hz, clock: device(arm)");
    home.dimos("move follower 0.2 0.1").with(0).shows(&["COMPLETED"]);
    let before = home.status()["ticks"].clone();
    assert_eq!(before["clock"], "device(arm)");

    // Without its states this computer's clock continues: the other arm still moves.
    let silence = MonotonicClock.now();
    arm.inject(Fault::new(FaultKind::Stall).lasting(0.4)).unwrap();
    home.dimos("move follower 0 0").with(0).shows(&["COMPLETED"]);
    eventually("its states come again", || {
        let arm = &home.status()["arms"][0];
        arm["link"] == "up" && arm["state_age_ms"].as_f64().is_some_and(|age| age < 100.0)
    });
    let lost = home.status()["ticks"]["without_state"].as_u64().unwrap() - before["without_state"].as_u64().unwrap();
    assert!(lost >= 25, "{lost} ticks without a state in 0.4 s");
    home.dimos("status").with(0).shows(&["125 Hz, device(arm)", "ticks without a state of the arm that clocks them"]);
    home.dimos("down").with(0);
    drop(run);

    let [log] = &home.logs()[..] else { panic!("one log") };
    home.dimos(&format!("replay {} --verify", log.display())).with(0).shows(&["reproducible"]);
    let (mut reader, mut stamps, mut ticks) = (LogReader::open(log).unwrap(), Vec::new(), Vec::new());
    while let Some(entry) = reader.next_entry().unwrap() {
        match entry.data {
            Payload::ArmInput(input) if entry.topic == "/dimos/inputs/arm" => stamps.push(input.stamp_ns),
            Payload::Tick(tick) => ticks.push(tick.deadline_ns),
            _ => {}
        }
    }
    let clocked = ticks.iter().filter(|tick| stamps.binary_search(tick).is_ok());
    let (mut by_states, mut by_clock) = (0, 0);
    for tick in clocked {
        *(if *tick < silence.0 { &mut by_states } else { &mut by_clock }) += 1;
    }
    let early = ticks.iter().filter(|tick| **tick < silence.0).count();
    assert!(by_states * 10 > early * 7, "{by_states} of {early} ticks began with a state; {by_clock} later");
}

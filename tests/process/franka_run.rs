//! A run with an arm whose controller is the clock, and judges every command.

use dimos::arms::franka::emulator::FrankaEmulator;
use dimos::hardware::registry::{AdapterConfig, Emulator, EmulatorAddress};
use dimos::hardware::sim::faults::{Fault, FaultKind};
use rustix::process::Signal;

use crate::support::program::Home;

/// A controller that waits for late commands: the computer of a test may be busy.
fn emulator() -> FrankaEmulator {
    let options = serde_json::json!({"sim": {"command_wait": 0.02}});
    let config = AdapterConfig { hardware_id: "arm".into(), address: String::new(), dof: 7, options };
    FrankaEmulator::start(&config, &EmulatorAddress::InProcess).unwrap()
}

/// Moves there and back at a tick rate. Returns the share of the states without a command in time.
fn lost_at(tick_rate: f64) -> f64 {
    let (home, emulator) = (Home::new(), emulator());
    let options = format!("--set hardware.arm.address={} --set coordinator.tick_rate={tick_rate}", emulator.address());
    let run = home.run(&format!("coordinator-fr3 {options} --no-record"));
    for target in ["0.4 -0.4 -0.2 -2.1 0.2 1.9 0.6", "0.2 -0.6 0.1 -1.9 -0.15 1.7 0.8"] {
        let moved = home.dimos(&format!("move arm {target} --speed 1")).with(0);
        assert!(moved.out.contains("COMPLETED"), "{}", moved.out);
    }
    let figures = emulator.figures();
    println!("{tick_rate} Hz: {figures:?}");
    run.end(Signal::INT).with(130);
    let here = emulator.true_positions().unwrap();
    assert!((here[0] - 0.2).abs() < 2e-3 && (here[3] + 1.9).abs() < 2e-3, "{here:?}");
    figures.lost as f64 / figures.moved as f64
}

#[test]
fn runs_at_any_rate_move_an_arm_that_wants_a_command_every_millisecond() {
    for tick_rate in [1000.0, 250.0, 100.0] {
        let lost = lost_at(tick_rate);
        assert!(lost < 0.2, "{lost} at {tick_rate} Hz");
    }
}

#[test]
fn zeros_without_a_pose_inside_the_range_are_not_enabled() {
    let (home, emulator) = (Home::new(), emulator());
    emulator.inject(Fault::new(FaultKind::ZeroState).lasting(60.0)).unwrap();
    let options = format!("--set hardware.arm.address={} --no-record", emulator.address());
    let ended = home.start(&format!("run coordinator-fr3 {options}")).wait();
    assert!(ended.code != Some(0) && ended.err.contains("every joint reads exactly 0"), "{}", ended.err);
    assert_eq!(emulator.figures().moved, 0, "nothing is written");
}

//! `docs/examples/compliant.rs` and `feed_forward`, judged at an arm with a weight: by what its emulator receives, and
//! by where its joints are.

use std::path::Path;
use std::time::Duration;

use dimos::arms::yourarm::emulator::wire::{Request, SetpointRequest};
use dimos::arms::yourarm::emulator::{Sim, YourArmEmulator};
use dimos::hardware::registry::Emulator;
use dimos::rpc::run_dir::RunDir;
use dimos::runtime::{Record, Run};

use crate::support::program::eventually;

#[path = "../../docs/examples/compliant.rs"]
mod compliant;

/// A pose in which the shoulder and the elbow carry the arm's weight [rad].
const POSE: [f64; 6] = [0.2, 0.4, 0.5, 0.0, 0.3, 0.0];

/// An arm whose own position control has this stiffness [Nm/rad].
fn arm(servo_stiffness: f64) -> YourArmEmulator {
    YourArmEmulator::of(&Sim { initial_positions: POSE.to_vec(), servo_stiffness, ..Sim::default() }).unwrap()
}

fn run(folder: &Path, arm: &YourArmEmulator, own: &str, params: &str) -> Run {
    let blueprint = format!(
        "hardware:\n  - {{hardware_id: arm, adapter_type: yourarm, address: {:?}, joints: {{prefix: arm, count: 6}}, \
         {own}}}\ntasks:\n  - {{name: soft, type: compliant, joint_names: {{hardware: arm}}, params: {{{params}}}}}\n",
        arm.address()
    );
    let run = Run::from_yaml("soft", &blueprint).folder(RunDir::closed(folder)).record(Record::Off);
    run.tasks(&[compliant::SPEC]).start().unwrap()
}

/// Streams a target for this time [s].
fn stream(run: &Run, target: &[f64; 6], seconds: f64) {
    for _ in 0..(seconds * 50.0) as u32 {
        run.servo("soft", target).unwrap();
        std::thread::sleep(Duration::from_millis(20));
    }
}

/// How far each joint is from a target [rad].
fn off(arm: &YourArmEmulator, target: &[f64; 6]) -> [f64; 6] {
    let at = arm.joints().0;
    std::array::from_fn(|j| at[j] - target[j])
}

fn furthest(off: [f64; 6]) -> f64 {
    off.iter().fold(0.0, |most, by| by.abs().max(most))
}

fn received(arm: &YourArmEmulator) -> Vec<SetpointRequest> {
    let setpoint = |request| match request {
        Request::Setpoint(setpoint) => Some(setpoint),
        _ => None,
    };
    arm.trace().into_iter().filter_map(|received| setpoint(received.request)).collect()
}

#[test]
fn a_compliant_task_sags_by_the_weight_over_its_stiffness_and_not_at_all_with_it_fed_forward() {
    let (soft, target) = ("stiffness: 150, damping: 15", POSE);
    let mut sagged = 0.0;
    for (own, carried) in [("limits: {effort: 80}", false), ("limits: {effort: 80}, feed_forward: gravity", true)] {
        let (folder, arm) = (tempfile::tempdir().unwrap(), arm(20_000.0));
        let run = run(folder.path(), &arm, own, soft);
        arm.record();
        stream(&run, &target, 2.0);
        let off = off(&arm, &target);
        let last = *received(&arm).last().unwrap();
        let [stiffness, damping] = last.gains.expect("impedance has gains");
        assert!(stiffness == [150.0; 6] && damping == [15.0; 6], "{stiffness:?} {damping:?}");
        let torques = last.torques.expect("they are part of the law").map(f64::from);
        if carried {
            assert!(furthest(off) < 0.002, "{off:?}");
            let predicted = 150.0 * sagged;
            assert!((torques[1].abs() - predicted).abs() < 1.0, "{torques:?} for a sag of {sagged} rad");
        } else {
            assert!(torques.iter().all(|torque| *torque == 0.0) && furthest(off) > 0.03, "{off:?} with {torques:?}");
            sagged = off[1].abs();
        }
        run.stop();
    }
}

#[test]
fn an_effort_of_a_task_presses_and_its_change_keeps_the_rate() {
    let (folder, arm) = (tempfile::tempdir().unwrap(), arm(20_000.0));
    let own = "limits: {effort: 80, effort_rate: 40}, feed_forward: dynamics";
    let run = run(folder.path(), &arm, own, "stiffness: 100, damping: 15, effort: [10, 0, 0, 0, 0, 0]");
    arm.record();
    stream(&run, &POSE, 2.0);
    // 10 Nm against 100 Nm/rad.
    let off = off(&arm, &POSE);
    assert!((off[0] - 0.1).abs() < 0.005 && furthest([0.0, off[1], off[2], off[3], off[4], off[5]]) < 0.003, "{off:?}");
    let torques: Vec<f64> =
        received(&arm).iter().filter_map(|setpoint| setpoint.torques).map(|t| t[0].into()).collect();
    let steepest = torques.windows(2).map(|pair| (pair[1] - pair[0]).abs()).fold(0.0, f64::max);
    // 0.4 Nm a tick, and where one setpoint was late the next has two.
    assert!(torques.last().is_some_and(|last| (last - 10.0).abs() < 0.05) && steepest < 0.81, "{steepest} Nm");
    run.stop();
}

/// Its own position control sags, too, and gets the weight before that shows.
#[test]
fn an_arm_in_position_control_is_carried_as_well() {
    for (own, least, most) in [
        ("limits: {effort: 80}", 0.003, 0.02),
        ("limits: {effort: 80}, feed_forward: gravity", 0.0, 0.0005),
        ("limits: {effort: 80}, feed_forward: dynamics", 0.0, 0.0005),
    ] {
        let (folder, arm) = (tempfile::tempdir().unwrap(), arm(3000.0));
        let run = run(folder.path(), &arm, own, "");
        arm.record();
        let sag = || furthest(off(&arm, &POSE));
        eventually("it rests", || (least..=most).contains(&sag()));
        std::thread::sleep(Duration::from_millis(300));
        assert!((least..=most).contains(&sag()), "{own}: {} rad", sag());
        let all = received(&arm);
        assert!(all.iter().all(|setpoint| setpoint.gains.is_none()), "gains belong to impedance mode");
        let fed = all.iter().filter(|setpoint| setpoint.torques.is_some()).count();
        assert_eq!(fed, if most < 0.001 { all.len() } else { 0 }, "what is not commanded is not sent");
        assert!(all.len() > 20, "{} setpoints", all.len());
        run.stop();
    }
}

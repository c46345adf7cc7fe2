//! Encoders that give wrong positions with valid checksums: no goal moves a joint. Judged by the goals in the servos.

use std::f64::consts::TAU;
use std::time::Duration;

use serde_json::json;

use super::adapter::So101Adapter;
use super::emulator::Servos;
use super::tests::{arm, goals, positions};
use dimos_core::arm::StopPoint;
use dimos_core::joint::{Joints, joints_of};
use dimos_hardware::adapter::{Gripper, ManipulatorAdapter};
use dimos_hardware::registry::Emulator;
use dimos_hardware::sim::faults::{Fault, FaultKind};
use dimos_hardware::sim::serial_server::SerialServer;

/// Furthest that a goal may move [counts]: the relief, 0.04 rad.
const RELIEF: i32 = 26;
/// Runs of wrong readings: once, in threes, in tens, for good.
const RUNS: [u32; 4] = [1, 3, 10, u32::MAX];

fn enabled() -> (So101Adapter, SerialServer<Servos>, StopPoint) {
    let (mut adapter, servos) = arm(json!({}));
    adapter.connect().unwrap();
    adapter.activate().unwrap();
    let point = StopPoint { position: Some(commanded(&mut adapter)) };
    (adapter, servos, point)
}

/// What the servos are commanded.
fn commanded(adapter: &mut So101Adapter) -> Joints {
    let mut reading = Default::default();
    adapter.read_joints(&mut reading).unwrap();
    reading.commanded.unwrap().position
}

fn furthest(a: [u16; 6], b: [u16; 6]) -> i32 {
    a.iter().zip(b).map(|(a, b)| (i32::from(*a) - i32::from(b)).abs()).max().unwrap()
}

#[test]
fn stop_reset_and_enable_move_no_goal_whatever_a_servo_of_an_arm_under_power_reads() {
    for servo in 0..6 {
        for run in RUNS {
            let (mut adapter, servos, rest) = enabled();
            let held = goals(&servos);
            for by in [900, -900, 200, 2048] {
                for act in 0..3 {
                    servos.with(|servos, _| servos.misread(servo, by, run));
                    match act {
                        0 => drop(adapter.write_stop(&rest).unwrap()),
                        1 => adapter.write_clear_errors().unwrap(),
                        _ => adapter.write_enable(true).unwrap(),
                    }
                    for _ in 0..12 {
                        positions(&mut adapter);
                    }
                    assert_eq!(goals(&servos), held, "servo {servo}, {run} readings off by {by}, act {act}");
                }
                servos.with(|servos, _| servos.misread(servo, by, 0));
            }
        }
    }
}

#[test]
fn motors_come_on_where_the_joints_are_or_not_at_all() {
    for (servo, run, late) in [(1, 1, 0), (1, 1, 3), (2, 3, 2), (5, 10, 0), (0, 10, 4), (5, 1, 5), (4, 3, 1)] {
        let (mut adapter, servos) = arm(json!({}));
        adapter.connect().unwrap();
        for _ in 0..20 {
            positions(&mut adapter);
            std::thread::sleep(Duration::from_millis(5));
        }
        let truth = servos.true_positions().unwrap();
        std::thread::scope(|scope| {
            scope.spawn(|| {
                std::thread::sleep(Duration::from_millis(late * 10));
                servos.with(|servos, _| servos.misread(servo, 900, run));
            });
            let _ = adapter.activate();
        });
        servos.with(|servos, _| servos.misread(servo, 0, 0));
        std::thread::sleep(Duration::from_millis(30));
        positions(&mut adapter);
        let now = servos.true_positions().unwrap();
        let moved = now.iter().zip(&truth).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(moved < 0.01, "servo {servo}, {run} readings after {late} periods: moved by {moved:.3} rad");
    }
}

#[test]
fn positions_that_contradict_each_other_are_refused_with_their_figures() {
    let (mut adapter, servos) = arm(json!({}));
    adapter.connect().unwrap();
    let done = std::sync::atomic::AtomicBool::new(false);
    let refused = std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(std::sync::atomic::Ordering::Relaxed) {
                servos.with(|servos, _| servos.misread(1, 900, 1));
                std::thread::sleep(Duration::from_millis(25));
            }
        });
        let refused = adapter.activate();
        done.store(true, std::sync::atomic::Ordering::Relaxed);
        refused.unwrap_err().to_string()
    });
    assert!(refused.starts_with("the positions of servo 2 (shoulder_lift) contradict each other"), "{refused}");
    assert!(refused.contains("not enabled\nhint: ") && !adapter.read_enabled().unwrap(), "{refused}");
}

#[test]
fn a_stop_leaves_the_goals_of_an_arm_that_was_not_commanded() {
    let (mut adapter, servos, _) = enabled();
    let held = goals(&servos);
    adapter.write_gripper_position(1.0).unwrap();
    adapter.write_stop(&StopPoint::default()).unwrap();
    assert_eq!(goals(&servos)[..5], held[..5]);
    // Setpoints that are no numbers, or outside the range, make no goals there.
    let mut odd = [f64::NAN; 5];
    odd[0] = 9.0;
    adapter.write_stop(&StopPoint { position: Some(joints_of(&odd)) }).unwrap();
    assert_eq!((goals(&servos)[0], &goals(&servos)[1..5]), (3299, &held[1..5]));
}

#[test]
fn a_motor_that_is_off_gets_no_goal_from_a_stop() {
    let (mut adapter, servos, rest) = enabled();
    servos.inject(Fault { joint: 3, ..Fault::new(FaultKind::MotorOff) }).unwrap();
    positions(&mut adapter);
    let held = goals(&servos);
    let mut moved = rest.position.unwrap();
    (moved[0], moved[2]) = (moved[0] + 0.2, moved[2] + 0.2);
    adapter.write_stop(&StopPoint { position: Some(moved) }).unwrap();
    let now = goals(&servos);
    assert!(now[0] > held[0] + 100 && now[1..] == held[1..], "{now:?} {held:?}");
}

#[test]
fn an_overload_takes_a_goal_back_by_the_relief_at_most_however_often_it_is_reset() {
    for (servo, by) in [(1, 900), (0, -900), (5, 400)] {
        let (mut adapter, servos, _) = enabled();
        let held = goals(&servos);
        let fault = Fault { joint: servo + 1, ..Fault::new(FaultKind::ErrorCode).code(0x20) };
        servos.inject(fault).unwrap();
        servos.with(|servos, _| servos.misread(servo, by, u32::MAX));
        for _ in 0..5 {
            let _ = adapter.write_clear_errors();
            let now = goals(&servos);
            assert!(furthest(now, held) <= RELIEF, "{now:?} {held:?}");
        }
    }
}

#[test]
fn an_overload_that_needs_more_than_the_relief_is_refused_with_a_hint() {
    let (mut adapter, servos, _) = enabled();
    servos.inject(Fault { joint: 1, ..Fault::new(FaultKind::Blocked).lasting(60.0) }).unwrap();
    positions(&mut adapter);
    let mut goal = positions(&mut adapter);
    goal[0] += 0.3;
    adapter.write_joint_positions(&goal, 1.0).unwrap();
    servos.inject(Fault { joint: 1, ..Fault::new(FaultKind::ErrorCode).code(0x20) }).unwrap();
    positions(&mut adapter);
    let pressing = goals(&servos);
    let refused = adapter.write_clear_errors().unwrap_err().to_string();
    assert!(refused.starts_with("servo 1 (shoulder_pan): overload, still\nhint: support the arm"), "{refused}");
    assert_eq!(pressing[0] - goals(&servos)[0], 26, "towards the joint by {:.3} rad", 26.0 * TAU / 4096.0);
}

#[test]
fn what_the_servos_are_commanded_is_read_from_them() {
    let (mut adapter, _servos, _) = enabled();
    let mut goal = positions(&mut adapter);
    goal[3] += 0.5;
    adapter.write_joint_positions(&goal, 0.5).unwrap();
    let found = commanded(&mut adapter);
    assert!((found[3] - goal[3]).abs() < 2e-3 && (positions(&mut adapter)[3] - goal[3]).abs() > 0.1);
    adapter.write_enable(false).unwrap();
    let mut reading = Default::default();
    adapter.read_joints(&mut reading).unwrap();
    assert_eq!(reading.commanded, None, "the motors are off");
}

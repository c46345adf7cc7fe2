//! Moves in all their forms, and what the box's supervision stops.

use std::time::Duration;

use super::controller::Controller;
use super::tests::{ask, controller, ready};
use super::*;
use dimos_core::clock::Mono;
use dimos_hardware::sim::stream::Controller as _;
use dimos_hardware::transport::tcp::Scan;

fn floats(values: &[f32], bytes: &[u8]) -> Vec<u8> {
    values.iter().flat_map(|value| value.to_le_bytes()).chain(bytes.iter().copied()).collect()
}

fn at(seconds: f64) -> Mono {
    Mono(1).after(Duration::from_secs_f64(seconds))
}

/// The tool's position in the base [mm].
fn place(arm: &Controller<SimArm>) -> [f64; 3] {
    arm.pose().unwrap().translation.vector.map(|v| v * 1000.0).into()
}

fn goes_by(arm: &mut Controller<SimArm>, register: u8, payload: &[u8], way: [f64; 3], seconds: &mut f64) {
    let before = place(arm);
    let (status, queued) = ask(arm, register, payload, *seconds);
    assert_eq!((status, &queued[..2]), (0, &[0, 1][..]), "{register}");
    *seconds += 5.0;
    arm.advance(at(*seconds));
    let after = place(arm);
    assert!((0..3).all(|i| (after[i] - before[i] - way[i]).abs() < 0.1), "{register}: {before:?} to {after:?}");
}

#[test]
fn the_last_bytes_of_a_move_say_what_its_numbers_mean() {
    let mut arm = controller();
    ready(&mut arm, 0);
    let (mut now, tail) = (0.0, [100.0, 2000.0, 0.0, -1.0]);
    let along = |z: f32, tail: &[f32], bytes: &[u8]| floats(&[&[0.0, 0.0, z, 0.0, 0.0, 0.0], tail].concat(), bytes);
    let axis = arm.pose().unwrap().rotation * nalgebra::Vector3::z() * 20.0;
    let axis: [f64; 3] = axis.into();
    goes_by(&mut arm, 21, &along(20.0, &tail, &[1, 0, 0]), axis, &mut now); // the tool's frame
    goes_by(&mut arm, 21, &along(-20.0, &tail, &[1, 1, 0]), axis.map(|v| -v), &mut now); // as a rotation vector
    goes_by(&mut arm, 28, &along(20.0, &tail[..3], &[]), axis, &mut now); // the older request
    let seven = [&[0.0, 0.0, -15.0, 0.0, 0.0, 0.0, 0.0][..], &tail].concat();
    goes_by(&mut arm, 83, &floats(&seven, &[0, 0]), [0.0, 0.0, -15.0], &mut now);
    goes_by(&mut arm, 83, &floats(&seven, &[0, 1]), [0.0, 0.0, -15.0], &mut now);
    goes_by(&mut arm, 92, &along(15.0, &tail[..3], &[0, 1]), [0.0, 0.0, 15.0], &mut now);
    // Infinite values stay; a rotation vector in the base.
    let mut kept = [f32::INFINITY; 10];
    kept[6..].copy_from_slice(&tail);
    kept[1] = place(&arm)[1] as f32 + 30.0;
    goes_by(&mut arm, 21, &floats(&kept, &[0, 0, 0]), [0.0, 30.0, 0.0], &mut now);
    let mut there: Vec<f32> = kinematics::to_wire_axis_angle(&arm.pose().unwrap()).to_vec();
    there[0] += 10.0;
    there.extend(tail);
    goes_by(&mut arm, 21, &floats(&there, &[0, 1, 0]), [10.0, 0.0, 0.0], &mut now);
    // Joints by a difference, from the end of the move before.
    let start = arm.seven();
    let change = floats(&[0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 10.0, 0.0, -1.0], &[1, 0]);
    assert_eq!(ask(&mut arm, 83, &change, now), (0, vec![0, 1]));
    assert_eq!(ask(&mut arm, 83, &change, now), (0, vec![0, 2]));
    arm.advance(at(now + 5.0));
    assert!((arm.seven()[0] - start[0] - 0.2).abs() < 1e-4, "{start:?} to {:?}", arm.seven());
    let mut one = [f32::INFINITY; 11];
    one[1] = 0.1;
    one[7..].copy_from_slice(&[1.0, 10.0, 0.0, -1.0]);
    assert_eq!(ask(&mut arm, 83, &floats(&one, &[1, 0]), now + 5.0).0, 0, "one joint");
    arm.advance(at(now + 10.0));
    assert!((arm.seven()[1] - start[1] - 0.1).abs() < 1e-4 && (arm.seven()[2] - start[2]).abs() < 1e-4);
}

#[test]
fn a_check_moves_nothing_and_gives_its_result() {
    let mut arm = controller();
    ready(&mut arm, 0);
    let start = arm.seven();
    let mut pose: Vec<f32> = kinematics::to_wire(&arm.pose().unwrap()).to_vec();
    pose[2] += 20.0;
    pose.extend([100.0, 2000.0, 0.0, -1.0]);
    assert_eq!(ask(&mut arm, 21, &floats(&pose, &[0, 0, 1]), 0.0), (0, vec![0, 0, 0]));
    pose[0] = 5000.0;
    assert_eq!(ask(&mut arm, 21, &floats(&pose, &[0, 0, 1]), 0.0), (0, vec![0, 0, 40]), "out of reach");
    let beyond = floats(&[9.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 10.0, 0.0], &[1]);
    assert_eq!(ask(&mut arm, 23, &beyond, 0.0), (0, vec![0, 0, 23]));
    arm.advance(at(2.0));
    assert_eq!((arm.error(), arm.seven()), (0, start));
}

#[test]
fn a_jump_of_the_setpoint_is_over_the_speed_limit() {
    let mut arm = controller();
    ready(&mut arm, 1);
    let mut target: Vec<f32> = arm.seven().iter().map(|q| *q as f32).chain([0.0; 3]).collect();
    assert_eq!(ask(&mut arm, 29, &floats(&target, &[]), 0.1).0, 0);
    target[0] += 40_f32.to_radians();
    assert_eq!(ask(&mut arm, 29, &floats(&target, &[]), 1.0).0, 0x50);
    assert_eq!(ask(&mut arm, 15, &[], 1.0).1, [24, 0]);
    let start = arm.seven();
    arm.advance(at(2.0));
    assert!((arm.seven()[0] - start[0]).abs() < 0.01, "it has not jumped");
}

/// Swings the stretched arm about its base at a speed [rad/s] of joint 1, in servo mode; the error, and the highest
/// speed of the tool [m/s].
fn swing(firmware: [u16; 3], speed: f64) -> (u8, f64) {
    let options = SimOptions { initial_positions: vec![-1.5, 0.9, -2.2, 0.0, 0.0, 0.0], ..SimOptions::default() };
    let mut arm = Controller::new(Model::Xarm6, firmware, GripperKind::None, &options, Mono(1)).unwrap();
    ask(&mut arm, 35, &floats(&[0.0, 0.0, 172.0, 0.0, 0.0, 0.0], &[]), 0.0);
    ready(&mut arm, 1);
    let (mut joint, mut rate, mut fastest) = (-1.5, 0.0_f64, 0.0_f64);
    for tick in 0..250 {
        let now = 0.1 + 0.008 * f64::from(tick);
        rate = (rate + 6.0 * 0.008).min(speed);
        joint += rate * 0.008;
        ask(&mut arm, 29, &floats(&[joint as f32, 0.9, -2.2, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], &[]), now);
        let reach = arm.pose().unwrap().translation.vector.xy().norm();
        fastest = fastest.max(reach * arm.arm.joints().1[0].abs());
    }
    (arm.error(), fastest)
}

#[test]
fn a_tool_that_is_too_fast_in_servo_mode_stops_the_arm() {
    let (error, fastest) = swing([2, 5, 1], 1.1);
    assert!(error == 0 && (0.8..1.0).contains(&fastest), "{error} at {fastest} m/s");
    let (error, fastest) = swing([2, 5, 1], 2.2);
    assert!(error == 60 && (1.15..1.3).contains(&fastest), "{error} at {fastest} m/s");
    let (error, fastest) = swing([2, 2, 2], 2.2);
    assert!(error == 24 && (0.95..1.1).contains(&fastest), "{error} at {fastest} m/s: older firmware");
}

#[test]
fn a_blocked_joint_is_a_collision_unless_detection_is_off() {
    for (sensitivity, expected) in [(3, 31), (0, 0)] {
        let mut arm = controller();
        ask(&mut arm, 37, &[sensitivity], 0.0);
        ready(&mut arm, 4);
        arm.arm.client_came();
        arm.arm.inject(Fault::new(FaultKind::Blocked).lasting(3.0), at(0.0)).unwrap();
        ask(&mut arm, 81, &floats(&[0.3, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], &[1]), 0.1);
        for tick in 0..100 {
            arm.advance(at(0.1 + 0.01 * f64::from(tick)));
        }
        assert_eq!(arm.error(), expected, "sensitivity {sensitivity}");
    }
}

#[test]
fn a_pause_delays_the_move_behind_it() {
    let mut arm = controller();
    ready(&mut arm, 0);
    let start = arm.seven()[0];
    assert_eq!(ask(&mut arm, 26, &floats(&[0.5], &[]), 0.0), (0, vec![0, 1]));
    let change = floats(&[0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 10.0, 0.0, -1.0], &[1, 0]);
    assert_eq!(ask(&mut arm, 83, &change, 0.0), (0, vec![0, 2]));
    arm.advance(at(0.45));
    assert_eq!((arm.seven()[0], arm.reported_state()), (start, 1));
    arm.advance(at(2.0));
    assert!((arm.seven()[0] - start - 0.1).abs() < 1e-4 && arm.reported_state() == 2);
}

#[test]
fn standard_modbus_gets_an_exception() {
    let (mut arm, mut answer) = (controller(), Vec::new());
    let request = [0, 7, 0, 0, 0, 6, 1, 3, 0, 0, 0, 1];
    assert!(matches!(arm.serve(&request, Mono(1), &mut answer), Scan::Take(12, _)));
    assert_eq!(answer, [0, 7, 0, 0, 0, 3, 1, 0x83, 1]);
}

//! What the coordinator does with trajectories, streams, stops and arms, on a virtual clock.

use dimos::arm::{GripperUnit, VelocitySource};
use dimos::control::config::*;
use dimos::control::request::Request;
use dimos::joint::ControlMode;
use dimos::telemetry::{Bound, Cause, Event, Outcome, Phase, Reason, TaskState};

use crate::support::rig::*;

fn params(change: impl FnOnce(&mut TrajectoryParams)) -> TaskKind {
    let mut p = TrajectoryParams { path_tolerance: 0.1, ..TrajectoryParams::default() };
    change(&mut p);
    TaskKind::new("trajectory", &p)
}

#[test]
fn a_trajectory_is_accepted_followed_and_completed_on_arrival() {
    let mut rig = Rig::one_arm(one(trajectory()));
    rig.arms[0].lag = 0.05;
    assert_eq!(rig.execute(0, sweep(7, 0..6, 0.0, 1.0, 2.0)), Outcome::Accepted);
    assert_eq!(rig.tasks[0].motion, 7);
    assert_eq!(rig.execute(0, sweep(8, 0..6, 0.0, 1.0, 2.0)), Outcome::AlreadyExecuting(0));
    assert_eq!(rig.retired, [8], "a refused motion is given back");
    let took = rig.run_until(4.0, |r| r.tasks[0].state == TaskState::Completed);
    assert!((1.9..2.6).contains(&took), "{took}");
    assert!(rig.arms[0].q.iter().all(|q| (q - 1.0).abs() <= 0.01), "{:?}", rig.arms[0].q);
    assert_eq!((rig.tasks[0].progress, rig.tasks[0].remaining), (1.0, 0.0));
    assert_eq!(rig.retired, [8, 7]);
    rig.run_for(1.0);
    assert!(rig.arms[0].q.iter().all(|q| (q - 1.0).abs() <= 1e-3), "the goal is held");
}

#[test]
fn it_does_not_complete_by_the_clock() {
    let mut rig = Rig::one_arm(one(params(|p| p.path_tolerance = 0.0)));
    rig.execute(0, sweep(1, 0..6, 0.0, 0.3, 1.0));
    rig.run_for(0.5);
    rig.arms[0].blocked = true;
    let stuck_at = rig.arms[0].q[0];
    let took = rig.run_until(5.0, |r| r.tasks[0].state == TaskState::Aborted);
    assert!((2.4..2.7).contains(&took), "goal time of 2 s after the end: {took}");
    match rig.tasks[0].reason {
        Reason::GoalTolerance(0, error) => assert!((error - (stuck_at - 0.3)).abs() < 1e-9, "{error}"),
        other => panic!("{other:?}"),
    }
}

#[test]
fn leaving_the_path_aborts_with_joint_and_error() {
    let mut rig = Rig::one_arm(one(params(|p| p.path_tolerance = 0.05)));
    rig.execute(0, sweep(1, 0..6, 0.0, 1.0, 2.0));
    rig.run_for(0.5);
    rig.arms[0].blocked = true;
    rig.run_until(1.0, |r| r.tasks[0].state == TaskState::Aborted);
    assert!(matches!(rig.tasks[0].reason, Reason::PathTolerance(0, e) if e < -0.05 && e > -0.08), "{:?}", rig.tasks[0]);
    assert_eq!(rig.phase(0), Phase::Ready);
    rig.run_for(1.0);
    assert_eq!(rig.speed(0), 0.0);
}

#[test]
fn cancel_slows_down_along_the_path() {
    let mut rig = Rig::one_arm(one(trajectory()));
    let joints: Vec<u16> = (0..6).collect();
    // Joint k goes k + 1 times as far as joint 0: a straight line, which the cancel must not leave.
    let goal: Vec<f64> = (1..=6).map(|k| 0.25 * k as f64).collect();
    rig.execute(0, motion(1, &joints, &[(0.0, &[0.0; 6]), (2.5, &goal)]));
    rig.run_for(1.2);
    let speed = rig.speed(0);
    assert!(speed > 0.8, "{speed}");
    assert_eq!(rig.ask(Request::Cancel { task: Some(0) }), Outcome::Cancelled);
    assert_eq!(rig.tasks[0].state, TaskState::Cancelling);
    assert_eq!(rig.ask(Request::Cancel { task: None }), Outcome::Cancelled, "again, on the way");
    let mut ticks = 0;
    while rig.speed(0) > 0.0 {
        rig.tick();
        let q = rig.commanded(0);
        for k in 1..6 {
            let off = q[k] - q[0] * (k + 1) as f64;
            assert!(off.abs() < 1e-3, "joint {k} is off the path by {off}");
        }
        ticks += 1;
        assert!(ticks < 100);
    }
    let took = (ticks + 2) as f64 * rig.dt();
    assert!(took >= speed / A_MAX - 0.03 && took <= 1.6 * speed / A_MAX, "{took} s from {speed} rad/s");
    assert_eq!((rig.tasks[0].state, rig.tasks[0].reason), (TaskState::Aborted, Reason::Cancelled));
    assert_eq!(rig.retired, [1]);
    assert_eq!(rig.ask(Request::Cancel { task: Some(0) }), Outcome::AlreadyStopped);
    assert_eq!(rig.ask(Request::Cancel { task: Some(1) }), Outcome::WrongTask(1), "there is one task");
    assert_eq!(rig.execute(0, sweep(2, 0..6, 5.0, 0.0, 1.0)).name(), "START_STATE_MISMATCH");
}

#[test]
fn cancel_is_the_ordinary_end_of_a_stream() {
    let mut rig = Rig::one_arm(vec![task("v", velocity(), 0..6, 5)]);
    for _ in 0..4 {
        rig.velocity(0, &[0.3; 6]);
        rig.run_for(0.1);
    }
    assert_eq!((rig.tasks[0].state, rig.tasks[0].reason), (TaskState::Executing, Reason::None));
    assert_eq!(rig.ask(Request::Cancel { task: Some(0) }), Outcome::Cancelled);
    assert_eq!((rig.tasks[0].state, rig.tasks[0].reason), (TaskState::Idle, Reason::StreamEnded));
    rig.run_for(0.5);
    assert_eq!((rig.tasks[0].state, rig.speed(0)), (TaskState::Idle, 0.0), "at rest, and it stays so");
}

#[test]
fn cancel_ends_a_trajectory_that_has_not_begun_to_move() {
    let mut rig = Rig::one_arm(vec![task("v", velocity(), 0..6, 5), task("t", trajectory(), 0..6, 10)]);
    rig.velocity(0, &[0.3; 6]);
    rig.run_for(0.3);
    rig.arms[0].mode_delay = u32::MAX; // It never takes up another mode again.
    let start = rig.arms[0].q[0];
    assert_eq!(rig.execute(1, sweep(1, 0..6, start, 0.5, 1.0)), Outcome::Accepted);
    rig.run_for(0.5);
    assert_eq!(rig.tasks[1].state, TaskState::Executing);
    rig.ask(Request::Cancel { task: Some(1) });
    rig.run(3);
    assert_eq!((rig.tasks[1].state, rig.tasks[1].reason), (TaskState::Aborted, Reason::Cancelled));
}

#[test]
fn a_trajectory_that_takes_over_from_a_velocity_does_not_fault() {
    let mut rig = Rig::one_arm(vec![task("v", velocity(), 0..6, 5), task("t", trajectory(), 0..6, 10)]);
    for _ in 0..50 {
        rig.velocity(0, &[1.4; 6]);
        rig.tick();
    }
    let start = rig.arms[0].q[0];
    // By the time the arm is at rest it is 0.25 rad further, too far from the trajectory's start.
    assert_eq!(rig.execute(1, sweep(1, 0..6, start, 1.5, 2.0)), Outcome::Accepted);
    rig.run_for(1.0);
    assert_eq!(rig.phase(0), Phase::Ready, "{:?}", rig.events);
    assert_eq!(rig.tasks[1].state, TaskState::Aborted);
    assert!(matches!(rig.tasks[1].reason, Reason::PathTolerance(0, e) if e > 0.05), "{:?}", rig.tasks[1]);
}

#[test]
fn a_motion_begins_when_the_first_setpoint_of_its_start_is_written() {
    let mut rig = Rig::one_arm(vec![task("t", trajectory(), 0..6, 10), task("v", velocity(), 0..6, 5)]);
    rig.velocity(1, &[0.0; 6]);
    rig.run(5);
    // The arm changes its mode, and takes no setpoint.
    rig.arms[0].deaf = true;
    assert_eq!(rig.execute(0, sweep(1, 0..6, 0.0, 0.5, 1.0)), Outcome::Accepted);
    rig.arms[0].mode = rig.commands[0].mode.unwrap();
    rig.run(5);
    assert_eq!((rig.tasks[0].elapsed, rig.commanded(0)), (0.0, vec![0.0; 6]));
    rig.arms[0].deaf = false;
    rig.run_until(2.0, |r| r.tasks[0].state == TaskState::Completed);
}

#[test]
fn two_trajectory_tasks_on_two_arms_run_at_once() {
    let mut rig = Rig::two_arms(vec![task("l", trajectory(), 0..7, 10), task("r", trajectory(), 7..13, 10)]);
    assert_eq!(rig.execute(0, sweep(1, 0..7, 0.0, 0.5, 1.0)), Outcome::Accepted);
    assert_eq!(rig.execute(1, sweep(2, 7..13, 0.0, -0.5, 1.5)), Outcome::Accepted);
    rig.run_until(2.0, |r| r.tasks[0].state == TaskState::Completed);
    assert_eq!(rig.tasks[1].state, TaskState::Executing);
    rig.run_until(2.0, |r| r.tasks[1].state == TaskState::Completed);
    assert!((rig.arms[0].q[6] - 0.5).abs() < 0.01 && (rig.arms[1].q[5] + 0.5).abs() < 0.01);
}

#[test]
fn one_trajectory_moves_both_arms_and_ends_when_one_of_them_faults() {
    let mut rig = Rig::two_arms(vec![task("both", trajectory(), 0..13, 10)]);
    rig.execute(0, sweep(1, 0..13, 0.0, 1.0, 2.0));
    rig.run_for(1.0);
    assert!(rig.speed(0) > 0.4 && (rig.speed(0) - rig.speed(1)).abs() < 1e-9);
    rig.arms[1].error = 17;
    rig.tick();
    assert_eq!((rig.phase(0), rig.phase(1)), (Phase::Ready, Phase::Held));
    let reason = Reason::ArmHeld(1, Cause::Fault(17));
    assert_eq!((rig.tasks[0].state, rig.tasks[0].reason), (TaskState::Aborted, reason));
    rig.run_for(0.5);
    assert_eq!((rig.speed(0), rig.speed(1)), (0.0, 0.0));
    assert_eq!(rig.execute(0, sweep(2, 0..13, 0.5, 1.0, 2.0)), Outcome::ArmLatched(1, Cause::Fault(17)));
    assert_eq!(rig.ask(Request::Reset { arm: 1 }), Outcome::StillFaulted(1, Cause::Fault(17)));
}

#[test]
fn a_waiting_arm_makes_the_other_one_wait_too() {
    let mut rig = Rig::two_arms(vec![task("both", trajectory(), 0..13, 10), task("v", velocity(), 7..13, 5)]);
    rig.arms[1].mode_delay = 30;
    rig.velocity(1, &[0.0; 6]);
    rig.run_for(0.6);
    assert_eq!(rig.arms[1].mode, ControlMode::Velocity);
    rig.execute(0, sweep(1, 0..13, 0.0, 0.5, 1.0));
    for _ in 0..200 {
        rig.tick();
        let (a, b) = (rig.samples[0].command.values[0], rig.arms[1].q[0]);
        assert!((a - b).abs() < 0.02, "apart: {a} and {b}");
    }
    assert_eq!(rig.tasks[0].state, TaskState::Completed);
}

#[test]
fn a_start_up_to_the_tolerance_away_is_faded_out_within_limits() {
    for offset in [0.0, 0.01, -0.03, 0.049] {
        let mut rig = Rig::one_arm(one(trajectory()));
        assert_eq!(rig.execute(0, sweep(1, 0..6, offset, 0.8, 1.5)), Outcome::Accepted);
        rig.run_until(3.0, |r| r.tasks[0].state == TaskState::Completed);
        let limited = rig.count(|e| matches!(e, Event::Limited(..)));
        assert_eq!(limited, 0, "{offset}: {:?}", rig.events);
    }
    let mut rig = Rig::one_arm(one(trajectory()));
    let refused = rig.execute(0, sweep(1, 0..6, 0.051, 0.8, 1.2));
    assert!(matches!(refused, Outcome::StartStateMismatch(0, by) if (by - 0.051).abs() < 1e-12));
}

#[test]
fn a_fade_takes_a_quarter_of_a_joints_speed() {
    let mut slow = arm("arm", 6);
    slow.limits.velocity_max = vec![0.1; 6];
    let mut rig = Rig::new(100.0, vec![slow], one(trajectory()));
    rig.make_ready();
    // Exactly the start tolerance away.
    assert_eq!(rig.execute(0, sweep(1, 0..6, 0.05, 0.05, 5.0)), Outcome::Accepted);
    let mut fastest = 0.0f64;
    let took = rig.run_until(6.0, |rig| {
        fastest = fastest.max(rig.speed(0));
        (rig.commanded(0)[0] - 0.05).abs() < 1e-9
    });
    // A quintic step is 1.875 times as fast as its mean.
    assert!((0.0249..=0.02501).contains(&fastest), "{fastest} rad/s");
    assert!((took - 1.875 * 0.05 / 0.025).abs() < 0.1, "{took} s");
}

#[test]
fn a_trajectory_shorter_than_its_fade_still_arrives() {
    let mut rig = Rig::one_arm(one(trajectory()));
    assert_eq!(rig.execute(0, sweep(1, 0..6, 0.04, 0.041, 0.02)), Outcome::Accepted);
    rig.run_until(2.0, |r| r.tasks[0].state == TaskState::Completed);
    assert!((rig.arms[0].q[0] - 0.041).abs() < 0.01);
}

#[test]
fn velocities_are_estimated_and_marked_where_the_arm_has_none() {
    let mut rig = Rig::one_arm(one(trajectory()));
    rig.arms[0].reports_velocity = false;
    rig.execute(0, sweep(1, 0..6, 0.0, 1.0, 2.0));
    rig.run_for(1.0);
    let state = rig.samples[0].state;
    assert_eq!(state.velocity_source, VelocitySource::Estimated);
    assert!((state.velocity[0] - rig.arms[0].v[0]).abs() < 0.05, "{}", state.velocity[0]);
    rig.run_until(3.0, |r| r.tasks[0].state == TaskState::Completed);
}

#[test]
fn a_slow_servo_stream_makes_a_smooth_motion() {
    // 50 Hz and 30 Hz into a 100 Hz tick: the second one never falls on the same tick of its period.
    for (rate, jitter) in [(50.0, false), (30.0, false), (50.0, true)] {
        let mut rig = Rig::one_arm(one(servo()));
        let wave = |t: f64| 0.6 * (1.0 - (1.2 * t).cos());
        let (mut due, mut worst, mut slowest, mut k) = (0.0, 0.0f64, f64::MAX, 0u64);
        for tick in 0..500 {
            let t = tick as f64 * rig.dt();
            if t + 1e-9 >= due {
                rig.servo(0, &[wave(t); 6]);
                k += 1;
                let late = if jitter && k % 3 == 0 { 0.008 } else { 0.0 };
                due = k as f64 / rate + late;
            }
            rig.tick();
            let q = rig.commanded(0)[0];
            if tick > 50 {
                worst = worst.max((q - wave(t)).abs());
                let true_v: f64 = 0.72 * (1.2 * t).sin();
                if true_v > 0.3 {
                    slowest = slowest.min(rig.speed(0) / true_v);
                }
            }
        }
        assert!(worst < 0.72 * 2.5 / rate, "{rate} Hz: off by {worst} rad");
        assert!(slowest > 0.85, "{rate} Hz, jitter {jitter}: down to {slowest} of the speed: stop and go");
    }
}

#[test]
fn a_servo_stream_that_starts_at_speed_is_caught_up_with() {
    for speed in [0.3, 0.8, 1.4] {
        let mut rig = Rig::one_arm(one(servo()));
        for k in 1..120 {
            let id = rig.servo(0, &[speed * k as f64 * 0.01; 6]);
            rig.tick();
            assert_eq!(rig.outcome(id), Outcome::Accepted);
        }
        assert_eq!(rig.phase(0), Phase::Ready, "{speed}: {:?}", rig.events);
        let behind = (speed * 119.0 * 0.01 - rig.commanded(0)[0]).abs();
        assert!(behind < if speed > 1.3 { 0.25 } else { 1e-6 }, "{speed}: {behind}");
    }
}

#[test]
fn grippers_open_on_request_and_only_where_there_is_one() {
    let mut with = arm("arm", 6);
    let mut without = arm("bare", 6);
    (with.gripper, without.gripper) = (true, false);
    let mut rig = Rig::new(100.0, vec![with, without], one(trajectory()));
    assert_eq!(rig.ask(Request::Gripper { arm: 0, opening: 0.04, force: None, speed: None }).name(), "ARM_NOT_READY");
    rig.make_ready();
    assert_eq!(rig.ask(Request::Gripper { arm: 0, opening: 0.04, force: None, speed: None }), Outcome::Accepted);
    assert_eq!((rig.arms[0].gripper, rig.commands[0].gripper_seq), (0.04, 1));
    assert_eq!(
        rig.ask(Request::Gripper { arm: 0, opening: 0.0, force: None, speed: None }),
        Outcome::Accepted,
        "closed"
    );
    assert_eq!(rig.ask(Request::Gripper { arm: 0, opening: 0.04, force: None, speed: None }), Outcome::Accepted);
    assert_eq!(rig.ask(Request::Gripper { arm: 1, opening: 0.04, force: None, speed: None }), Outcome::NoGripper(1));
    for unfit in [f64::NAN, f64::INFINITY, -0.1] {
        assert_eq!(
            rig.ask(Request::Gripper { arm: 0, opening: unfit, force: None, speed: None }).name(),
            "OUT_OF_LIMITS"
        );
    }
    // The gripper is refused, not a joint of the arm.
    let negative = rig.ask(Request::Gripper { arm: 0, opening: -0.1, force: None, speed: None });
    assert_eq!(negative, Outcome::GripperOutOfLimits(0, -0.1));
    assert_eq!(rig.arms[0].gripper, 0.04);
}

#[test]
fn a_gripper_takes_forces_within_its_range_and_a_rotary_one_any_angle() {
    let (mut strong, mut rotary) = (arm("strong", 6), arm("rotary", 6));
    (strong.gripper, rotary.gripper) = (true, true);
    strong.gripper_info.force_range = Some((1.0, 40.0));
    rotary.gripper_info.unit = GripperUnit::Radians;
    let mut rig = Rig::new(100.0, vec![strong, rotary], one(trajectory()));
    rig.make_ready();
    let grip = |arm, opening, force| Request::Gripper { arm, opening, force, speed: None };
    assert_eq!(rig.ask(grip(0, 0.04, Some(40.0))), Outcome::Accepted);
    let command = rig.commands[0];
    assert_eq!((command.gripper, command.gripper_force, command.gripper_seq), (0.04, Some(40.0), 1));
    for force in [0.9, 40.1, -2.0, f64::INFINITY] {
        assert_eq!(rig.ask(grip(0, 0.02, Some(force))), Outcome::GripperForceOutOfLimits(0, force));
    }
    assert_eq!(rig.ask(grip(0, 0.02, Some(f64::NAN))).name(), "OUT_OF_LIMITS");
    assert_eq!((rig.commands[0].gripper, rig.commands[0].gripper_seq), (0.04, 1), "a refused one moves nothing");
    assert_eq!(rig.ask(grip(0, 0.02, None)), Outcome::Accepted);
    assert_eq!(rig.commands[0].gripper_force, None, "a force is that of its command only");
    assert_eq!(rig.ask(grip(1, -0.3, None)), Outcome::Accepted);
    assert_eq!(rig.commands[1].gripper, -0.3);
    assert_eq!(rig.ask(grip(1, -0.2, Some(1.0))), Outcome::NoGripperForce(1));
    assert_eq!(rig.ask(grip(1, f64::NAN, None)).name(), "OUT_OF_LIMITS");
    assert_eq!((rig.commands[1].gripper, rig.commands[1].gripper_seq), (-0.3, 1));
}

#[test]
fn a_gripper_takes_a_speed_above_zero_up_to_one_if_it_has_speed_control() {
    let (mut quick, mut plain) = (arm("quick", 6), arm("plain", 6));
    (quick.gripper, plain.gripper) = (true, true);
    quick.gripper_info.has_speed = true;
    let mut rig = Rig::new(100.0, vec![quick, plain], one(trajectory()));
    rig.make_ready();
    let grip = |arm, speed| Request::Gripper { arm, opening: 0.02, force: None, speed };
    for speed in [0.0, -0.1, 1.1, f64::NAN] {
        assert_eq!(rig.ask(grip(0, Some(speed))), Outcome::NoGripperSpeed(0), "{speed}");
    }
    assert_eq!(rig.ask(grip(1, Some(0.5))), Outcome::NoGripperSpeed(1));
    assert_eq!((rig.commands[0].gripper_seq, rig.commands[1].gripper_seq), (0, 0), "refused ones move nothing");
    for speed in [0.01, 1.0] {
        assert_eq!(rig.ask(grip(0, Some(speed))), Outcome::Accepted, "{speed}");
        assert_eq!(rig.commands[0].gripper_speed, Some(speed));
    }
    assert_eq!(rig.ask(grip(1, None)), Outcome::Accepted);
}

#[test]
fn a_motion_needs_only_the_arms_that_it_moves() {
    let mut rig = Rig::two_arms(vec![task("both", trajectory(), 0..13, 10)]);
    assert_eq!(rig.ask(Request::Stop { arm: Some(1) }), Outcome::Accepted);
    assert_eq!(rig.phase(1), Phase::Held);
    assert_eq!(rig.execute(0, sweep(1, 0..7, 0.0, 0.3, 1.0)), Outcome::Accepted);
    rig.run_until(3.0, |rig| rig.tasks[0].state == TaskState::Completed);
    assert_eq!(rig.execute(0, sweep(2, 5..9, 0.0, 0.3, 1.0)), Outcome::ArmLatched(1, Cause::Operator));
}

#[test]
fn requests_for_what_does_not_exist_are_refused() {
    let mut rig = Rig::one_arm(one(trajectory()));
    assert_eq!(rig.execute(9, sweep(1, 0..6, 0.0, 0.1, 1.0)), Outcome::WrongTask(9));
    assert_eq!(rig.execute(0, sweep(1, 3..9, 0.0, 0.1, 1.0)), Outcome::WrongTask(0));
    assert_eq!(rig.ask(Request::Servo { task: 0, target: [0.0; 16] }), Outcome::WrongTask(0));
    assert_eq!(rig.ask(Request::Velocity { task: 4, target: [0.0; 16] }), Outcome::WrongTask(4));
    for request in
        [Request::Stop { arm: Some(5) }, Request::Reset { arm: 5 }, Request::Enabled { arm: 5, outside: false }]
    {
        assert_ne!(rig.ask(request), Outcome::Accepted);
    }
    assert_eq!(rig.ask(Request::Cancel { task: Some(5) }), Outcome::WrongTask(5));
    assert_eq!(rig.tasks[0].state, TaskState::Idle);
}

#[test]
fn shutdown_brings_everything_to_rest_and_takes_nothing_more() {
    let tasks = vec![task("t", trajectory(), 0..7, 10), task("v", velocity(), 7..13, 10)];
    let mut rig = Rig::two_arms(tasks);
    rig.execute(0, sweep(1, 0..7, 0.0, 1.2, 1.8));
    for _ in 0..90 {
        rig.velocity(1, &[0.8; 6]);
        rig.tick();
    }
    assert!(!rig.coordinator.at_rest());
    assert_eq!(rig.ask(Request::Shutdown), Outcome::Cancelled);
    let took = rig.run_until(2.0, |r| r.coordinator.at_rest());
    assert!(took < 1.0, "{took}");
    assert_eq!((rig.speed(0), rig.speed(1)), (0.0, 0.0));
    assert_eq!(rig.execute(0, sweep(2, 0..7, 0.5, 1.2, 1.8)), Outcome::ShuttingDown);
    assert_eq!(rig.ask(Request::Servo { task: 1, target: [0.0; 16] }), Outcome::ShuttingDown);
    assert_eq!(rig.retired, [1, 2]);
}

#[test]
fn a_servo_task_with_a_default_begins_by_itself() {
    let at = |q: f64| TaskKind::new("servo", &ServoParams { timeout: 0.0, default_positions: Some(vec![q; 6]) });
    let mut config = task("home", at(0.15), 0..6, 10);
    config.auto_start = true;
    let mut rig = Rig::one_arm(vec![config]);
    rig.run_for(1.0);
    assert!((rig.arms[0].q[0] - 0.15).abs() < 1e-9 && rig.tasks[0].state == TaskState::Executing);
}

#[test]
fn a_burst_of_requests_is_answered_within_a_few_ticks_and_a_stop_in_it_is_not_kept_waiting() {
    let mut rig = Rig::one_arm(vec![task("s", servo(), 0..6, 10)]);
    let ids: Vec<u64> = (0..255).map(|k| rig.servo(0, &[1e-4 * k as f64; 6])).collect();
    let stop = rig.send(Request::Stop { arm: None });
    rig.tick();
    assert_eq!(rig.outcome(stop), Outcome::Accepted);
    assert_eq!(rig.phase(0), Phase::Held);
    ids.iter().for_each(|id| assert_eq!(rig.outcome(*id), Outcome::Accepted));
}

#[test]
fn a_stream_that_is_limited_says_by_what_as_long_as_it_is() {
    let mut rig = Rig::one_arm(one(servo()));
    rig.run_for(0.5);
    assert_eq!(rig.tasks[0].bound, Bound::None);
    // Twice the velocity limit, then on the spot.
    let mut target = rig.commanded(0);
    let mut seen = Vec::new();
    for _ in 0..40 {
        target[1] += 2.0 * V_MAX * rig.dt();
        target[1] = target[1].min(rig.commanded(0)[1] + 0.15);
        rig.servo(0, &target);
        rig.tick();
        seen.push(rig.tasks[0].bound);
    }
    assert_eq!(rig.tasks[0].state, TaskState::Executing);
    assert!(seen.ends_with(&[Bound::Velocity(1); 10]), "{seen:?}");
    let rest = rig.commanded(0);
    for _ in 0..100 {
        rig.servo(0, &rest);
        rig.tick();
    }
    assert_eq!(rig.tasks[0].bound, Bound::None);
}

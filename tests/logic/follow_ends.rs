//! How a follower starts, pauses, ends, and continues after a gap; and its gripper.

use crate::support::rig::*;
use dimos::arm::{GripperInfo, GripperUnit};
use dimos::control::config::{ArmConfig, TaskConfig};
use dimos::control::request::Request;
use dimos::telemetry::{Cause, Outcome, Phase, Reason, TaskState};

use super::follow::{APPROACH, FOLLOWER, LEADER, follow, in_step, led, task_of, until_in_step};

#[test]
fn the_speed_override_slows_it_and_a_pause_is_followed_by_an_approach() {
    let mut rig = in_step(task_of(follow(|_| {})));
    rig.ask(Request::Speed { fraction: 0.2 });
    rig.run_for(1.0);
    let (speed, _) = led(&mut rig, 1.5, |t| [(0.8 * t).min(0.8); 6]);
    assert!(speed <= 0.2 * V_MAX + 1e-9 && speed > 0.25, "{speed}");
    rig.ask(Request::Speed { fraction: 1.0 });
    rig.run_for(3.0);
    assert_eq!(rig.tasks[0].reason, Reason::InStep);
    rig.ask(Request::Pause { on: true });
    led(&mut rig, 1.0, |t| [0.8 + 0.5 * t; 6]);
    assert_eq!(rig.speed(FOLLOWER), 0.0);
    let paused = rig.commanded(FOLLOWER);
    led(&mut rig, 1.0, |t| [(1.3 + t).min(1.5); 6]);
    assert_eq!(rig.commanded(FOLLOWER), paused);
    rig.send(Request::Pause { on: false });
    let (speed, _) = led(&mut rig, 2.0, |_| [1.5; 6]);
    assert!(speed <= APPROACH + 1e-9 && speed > 0.28, "{speed}");
    until_in_step(&mut rig);
}

#[test]
fn it_is_started_and_cancelled_and_ends_when_its_arm_or_its_leader_is_stopped() {
    let mut rig = Rig::new(100.0, vec![arm("leader", 6), arm("follower", 6)], vec![task_of(follow(|_| {}))]);
    rig.make_ready();
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::AlreadyExecuting(0));
    until_in_step(&mut rig);
    assert_eq!(rig.ask(Request::Cancel { task: Some(0) }), Outcome::Cancelled);
    assert_eq!((rig.tasks[0].state, rig.tasks[0].distance), (TaskState::Idle, None));
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    until_in_step(&mut rig);
    rig.ask(Request::Stop { arm: Some(0) });
    rig.run(2);
    assert_eq!(rig.phase(LEADER), Phase::Held);
    assert!(matches!(rig.tasks[0].reason, Reason::ArmHeld(0, Cause::Operator)), "{:?}", rig.tasks[0]);
    // A hand that moves the leader all the same moves nothing else.
    let rests = rig.arms[FOLLOWER].q.clone();
    rig.arms[LEADER].q[1] += 0.3;
    rig.run_for(1.0);
    assert!((rig.arms[FOLLOWER].q[1] - rests[1]).abs() < 0.02, "{:?}", rig.arms[FOLLOWER].q);
    assert!(matches!(rig.ask(Request::Start { task: 0 }), Outcome::ArmLatched(0, _)));
    rig.ask(Request::Reset { arm: 0 });
    rig.run_for(0.2);
    rig.arms[LEADER].q[1] -= 0.3;
    rig.run_for(0.2);
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    rig.ask(Request::Stop { arm: Some(1) });
    assert!(matches!(rig.tasks[0].reason, Reason::ArmHeld(1, Cause::Operator)), "{:?}", rig.tasks[0]);
    assert!(matches!(rig.ask(Request::Start { task: 0 }), Outcome::ArmLatched(1, _)));
}

#[test]
fn what_follows_an_arm_whose_way_is_blocked_ends_with_it() {
    let tasks = vec![task_of(follow(|_| {})), task("t", trajectory(), 0..6, 10)];
    let mut rig = Rig::new(100.0, vec![arm("leader", 6), arm("follower", 6)], tasks);
    rig.make_ready();
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    until_in_step(&mut rig);
    assert_eq!(rig.execute(1, sweep(1, 0..6, 0.0, 0.6, 2.0)), Outcome::Accepted);
    rig.run_for(1.0);
    rig.ask(Request::WayBlocked { task: 1, motion: 1, in_time: false });
    rig.run(2);
    assert_eq!(rig.phase(LEADER), Phase::Held);
    assert!(matches!(rig.tasks[0].reason, Reason::ArmHeld(0, Cause::WayBlocked)), "{:?}", rig.tasks[0]);
}

#[test]
fn a_leader_that_is_held_for_another_reason_than_a_person_is_still_followed() {
    let mut rig = Rig::new(100.0, vec![arm("leader", 6), arm("follower", 6)], vec![task_of(follow(|_| {}))]);
    rig.make_ready();
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    until_in_step(&mut rig);
    // A hand moves it against its motors.
    rig.arms[LEADER].blocked = true;
    led(&mut rig, 1.0, |t| [0.4 * t, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(rig.phase(LEADER), Phase::Held);
    assert!(!rig.samples[LEADER].cause.stops_followers(), "{:?}", rig.samples[LEADER].cause);
    rig.run_for(2.0);
    assert_eq!(rig.tasks[0].state, TaskState::Executing, "{:?}", rig.tasks[0]);
    assert!((rig.arms[FOLLOWER].q[0] - 0.4).abs() < 0.02, "{:?}", rig.arms[FOLLOWER].q);
}

#[test]
fn with_auto_start_it_begins_when_its_arm_is_ready_whatever_the_leaders_motors_do() {
    let task = || TaskConfig { auto_start: true, ..task_of(follow(|_| {})) };
    let mut rig = Rig::new(100.0, vec![arm("leader", 6), arm("follower", 6)], vec![task()]);
    rig.arms[LEADER].enabled = false;
    rig.run(5);
    assert_eq!(rig.tasks[0].state, TaskState::Idle);
    rig.ask(Request::Enabled { arm: 1, outside: false });
    rig.run_for(0.5);
    assert_eq!(rig.tasks[0].state, TaskState::Executing, "{:?}", rig.events);

    // Without the leader's position it waits, and so it does for an arm that it has nothing to do with.
    for other in [LEADER, 2] {
        let arms = vec![arm("leader", 6), arm("follower", 6), arm("other", 6)];
        let mut rig = Rig::new(100.0, arms, vec![task()]);
        rig.arms[LEADER].enabled = false;
        rig.arms[2].enabled = other != 2;
        rig.arms[LEADER].silent = other == LEADER;
        rig.run(5);
        for arm in if other == 2 { vec![1] } else { vec![1, 2] } {
            rig.ask(Request::Enabled { arm, outside: false });
        }
        rig.run_for(0.5);
        assert_eq!(rig.tasks[0].state, TaskState::Idle, "{other}");
        (rig.arms[LEADER].silent, rig.arms[2].enabled) = (false, true);
        rig.run(5);
        if other == 2 {
            rig.ask(Request::Enabled { arm: 2, outside: false });
        }
        rig.run_for(0.5);
        assert_eq!(rig.tasks[0].state, TaskState::Executing, "{other}: {:?}", rig.events);
    }
}

#[test]
fn in_step_the_gripper_follows_by_its_own_range() {
    let jaw = GripperInfo { unit: GripperUnit::Radians, range: Some((0.0, 2.0)), ..GripperInfo::default() };
    let fingers = GripperInfo { range: Some((0.0, 0.1)), ..GripperInfo::default() };
    let arms = vec![
        ArmConfig { gripper_info: jaw, ..arm("leader", 6) },
        ArmConfig { gripper_info: fingers, ..arm("follower", 6) },
    ];
    let mut rig = Rig::new(100.0, arms, vec![task_of(follow(|params| params.gripper = true))]);
    rig.make_ready();
    rig.arms[LEADER].state.gripper = Some(1.0);
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    assert_eq!(rig.commands[FOLLOWER].gripper_seq, 0, "not on the way to the leader");
    until_in_step(&mut rig);
    rig.run_for(0.1);
    assert_eq!((rig.commands[FOLLOWER].gripper_seq, rig.commands[FOLLOWER].gripper), (1, 0.05));
    for k in 1..=100 {
        rig.arms[LEADER].state.gripper = Some(1.0 + 0.01 * f64::from(k));
        rig.tick();
    }
    let commands = rig.commands[FOLLOWER].gripper_seq;
    assert!((15..=21).contains(&commands) && (rig.arms[FOLLOWER].gripper - 0.1).abs() < 3e-3, "{commands}");
    rig.ask(Request::Cancel { task: Some(0) });
    rig.arms[LEADER].state.gripper = Some(0.0);
    rig.run_for(0.5);
    assert_eq!(rig.commands[FOLLOWER].gripper_seq, commands);
    assert_eq!(rig.commands[LEADER].gripper_seq, 0);
}

#[test]
fn a_gap_in_what_is_written_is_followed_by_an_approach_from_what_was_written() {
    let mut rig = in_step(task_of(follow(|_| {})));
    led(&mut rig, 1.0, |t| [0.5 * t * t; 6]);
    rig.arms[FOLLOWER].deaf = true;
    led(&mut rig, 0.3, |t| [0.5 + t; 6]);
    rig.arms[FOLLOWER].deaf = false;
    let (speed, _) = led(&mut rig, 3.0, |_| [0.8; 6]);
    assert!(speed <= V_MAX, "{speed}");
    rig.run_for(3.0);
    assert_eq!((rig.phase(FOLLOWER), rig.tasks[0].reason), (Phase::Ready, Reason::InStep), "{:?}", rig.events);
}

//! Commands: what is written, what is not, and what a refusal means.

use std::sync::atomic::Ordering::Relaxed;
use std::sync::mpsc::sync_channel;

use super::*;
use crate::adapter::{AdapterError, ManipulatorAdapter};
use dimos_core::arm::{Interference, Link};

#[test]
fn each_command_is_written_once() {
    let mut bench = Bench::enabled();
    let state = bench.hold_at(0.0);
    assert_eq!((bench.written(), state.written), (vec![0.0], bench.command.seq));
    bench.cycle();
    assert_eq!(bench.written(), [0.0], "the same command");
    bench.hold_at(0.001);
    assert_eq!(bench.written(), [0.0, 0.001]);
    assert_eq!(bench.worker.health.writes.load(Relaxed), 2);
}

#[test]
fn a_command_that_found_no_room_is_written_with_the_next_cycle_unless_it_is_replaced() {
    let mut bench = Bench::enabled();
    bench.arm.fail("write_joint_positions", AdapterError::Busy);
    let before = bench.states.read().written;
    let state = bench.hold_at(0.0);
    assert_eq!(state.written, bench.command.seq, "the reading after it has made room");
    assert!(before < state.written && bench.worker.health.write_errors.load(Relaxed) == 0);
    assert_eq!(bench.count("write_joint_positions"), 2);
    bench.cycle();
    assert_eq!(bench.count("write_joint_positions"), 2);
}

#[test]
fn a_command_without_a_mode_moves_nothing() {
    let mut bench = Bench::enabled();
    bench.tick(|c| (c.mode, c.values[0]) = (None, 0.5));
    assert!(bench.written().is_empty());
    assert!(!bench.worker.moving());
    bench.hold_at(0.0);
    assert!(bench.worker.moving());
    bench.worker.state.self_held = true;
    assert!(!bench.worker.moving());
}

#[test]
fn a_first_setpoint_away_from_the_arm_is_withheld() {
    let mut bench = Bench::enabled();
    bench.hold_at(0.3);
    assert!(bench.written().is_empty());
    assert_eq!(bench.worker.health.withheld.load(Relaxed), 1);
}

#[test]
fn a_mode_that_another_client_has_changed_is_not_set_back() {
    let mut bench = Bench::enabled();
    bench.hold_at(0.0);
    bench.arm.clone().set_control_mode(ControlMode::Velocity).unwrap();
    bench.arm.clear_calls();
    bench.hold_at(0.0);
    assert_eq!((bench.count("set_control_mode"), bench.count("write_joint_positions")), (0, 0));

    let mut bench = Bench::enabled();
    bench.worker.state.interference = Interference::Stop;
    bench.hold_at(0.0);
    assert!(bench.written().is_empty());
}

#[test]
fn the_mode_is_set_before_the_first_setpoint_and_not_again() {
    let mut bench = Bench::enabled();
    for _ in 0..3 {
        bench.tick(|c| (c.mode, c.values[0]) = (Some(ControlMode::Velocity), 0.0));
    }
    let calls: Vec<&str> =
        bench.arm.calls().iter().map(Call::name).filter(|n| n.starts_with("set_") || n.starts_with("write")).collect();
    assert_eq!(
        calls,
        ["set_control_mode", "write_joint_velocities", "write_joint_velocities", "write_joint_velocities"]
    );
}

#[test]
fn a_change_of_mode_may_be_refused_for_a_second() {
    let mut bench = Bench::enabled();
    let refused = || AdapterError::Rejected("still moving".into());
    let velocity = |c: &mut ArmCommand| (c.mode, c.values[0]) = (Some(ControlMode::Velocity), 0.0);
    for _ in 0..101 {
        bench.arm.fail("set_control_mode", refused());
        bench.tick(velocity);
    }
    assert_eq!(bench.worker.health.write_errors.load(Relaxed), 0, "1.00 s");
    bench.arm.fail("set_control_mode", refused());
    bench.tick(velocity);
    assert_eq!(bench.worker.health.write_errors.load(Relaxed), 1);
    // The second starts again once the mode was taken, or no mode is wanted.
    bench.tick(velocity);
    bench.tick(|c| c.mode = Some(ControlMode::Position));
    bench.arm.fail("set_control_mode", refused());
    bench.tick(velocity);
    assert_eq!(bench.worker.health.write_errors.load(Relaxed), 1);
    bench.advance(Duration::from_secs(2));
    bench.tick(|c| c.mode = None);
    bench.arm.fail("set_control_mode", refused());
    bench.tick(velocity);
    assert_eq!(bench.worker.health.write_errors.load(Relaxed), 1);
}

#[test]
fn a_refused_setpoint_is_no_fault_of_the_connection_and_the_tick_is_told_of_it() {
    let mut bench = Bench::enabled();
    for _ in 0..5 {
        bench.arm.fail("write_joint_positions", AdapterError::Rejected("too far".into()));
        let state = bench.hold_at(0.0);
        assert!(state.link == Link::Up && state.refused > state.written, "{state:?}");
    }
    let state = bench.hold_at(0.0);
    assert!(state.written > state.refused, "{state:?}");
}

#[test]
fn the_tick_is_told_of_a_step_that_the_last_check_withholds() {
    let mut bench = Bench::enabled();
    bench.hold_at(0.0);
    let state = bench.hold_at(0.5);
    assert!(state.refused > state.written, "{state:?}");
    assert!(bench.hold_at(0.0).written > state.refused);
}

#[test]
fn three_failed_writes_are_a_faulted_link_and_one_good_one_ends_that() {
    let mut bench = Bench::enabled();
    let refused = AdapterError::Protocol("no".into());
    for wanted in [Link::Up, Link::Up, Link::Faulted] {
        bench.arm.fail("write_joint_positions", refused.clone());
        assert_eq!(bench.hold_at(0.0).link, wanted);
    }
    assert_eq!(bench.notes(), ["a command was not taken: no"]);
    bench.hold_at(0.0);
    bench.advance(PERIOD);
    assert_eq!(bench.cycle().link, Link::Up);
    assert_eq!(bench.notes(), ["over: a command was not taken: no"]);
}

#[test]
fn two_setpoints_without_an_answer_are_discarded_with_the_connection() {
    let mut bench = Bench::enabled();
    let silent = || AdapterError::Timeout("no answer".into());
    bench.arm.fail("write_joint_positions", silent());
    let state = bench.hold_at(0.0);
    assert_eq!(state.written, bench.command.seq, "it may have reached the arm");
    assert!(!state.self_held && bench.worker.connected);
    bench.arm.fail("write_joint_positions", silent());
    let state = bench.hold_at(0.001);
    assert!(state.self_held && !bench.worker.connected && bench.count("disconnect") > 0, "{state:?}");
    assert_eq!(bench.worker.in_flight, 0);

    // One that was answered in between counts as none.
    let mut bench = Bench::enabled();
    for position in [0.0, 0.001] {
        bench.arm.fail("write_joint_positions", silent());
        bench.hold_at(position);
        bench.hold_at(position);
    }
    assert!(bench.worker.connected);
}

#[test]
fn a_pending_setpoint_is_discarded_when_the_state_is_stale() {
    let mut bench = Bench::enabled();
    bench.arm.fail("write_joint_positions", AdapterError::Timeout("no answer".into()));
    bench.hold_at(0.0);
    assert_eq!(bench.worker.in_flight, 1);
    let limit = bench.worker.config.state_timeout();
    bench.advance(limit);
    bench.worker.late = Duration::ZERO;
    bench.worker.discard_if_stale(&mut bench.adapter);
    assert!(bench.worker.connected, "at the limit");
    bench.advance(Duration::from_millis(5));
    bench.worker.late = Duration::from_millis(6);
    bench.worker.discard_if_stale(&mut bench.adapter);
    assert!(bench.worker.connected, "this thread was late by more");
    bench.worker.late = Duration::from_millis(1);
    bench.worker.discard_if_stale(&mut bench.adapter);
    assert!(!bench.worker.connected && bench.worker.state.self_held);
    assert!(bench.notes().iter().any(|note| note.contains("pending setpoints discarded")));
}

#[test]
fn nothing_is_discarded_without_a_pending_setpoint() {
    let mut bench = Bench::enabled();
    bench.hold_at(0.0);
    bench.advance(Duration::from_secs(1));
    bench.worker.discard_if_stale(&mut bench.adapter);
    assert!(bench.worker.connected);
}

#[test]
fn a_delay_of_this_thread_that_is_too_long_excuses_nothing() {
    let discarded = |late: Duration| {
        let mut bench = Bench::enabled();
        bench.hold_at(0.0);
        bench.worker.resend = true;
        bench.worker.late = late;
        bench.advance(bench.worker.config.state_timeout() + PERIOD);
        bench.worker.discard_if_stale(&mut bench.adapter);
        !bench.worker.connected
    };
    assert!(!discarded(Duration::from_millis(99)));
    assert!(discarded(Duration::from_millis(100)));
}

#[test]
fn an_arm_that_takes_setpoints_but_no_stop_is_faulted() {
    let mut bench = Bench::enabled();
    for _ in 0..3 {
        bench.arm.fail("write_stop", AdapterError::Rejected("busy".into()));
        bench.tick(|c| (c.mode, c.stop_seq) = (Some(ControlMode::Position), 1));
    }
    assert_eq!(bench.count("write_joint_positions"), 3);
    assert_eq!(bench.states.read().link, Link::Faulted);
}

#[test]
fn a_stop_is_sent_until_it_is_taken_and_confirmed_only_if_the_arm_says_so() {
    let mut bench = Bench::enabled();
    bench.hold_at(0.0);
    for _ in 0..2 {
        bench.arm.fail("write_stop", AdapterError::Rejected("busy".into()));
    }
    bench.tick(|c| (c.mode, c.stop_seq) = (None, 7));
    let health = bench.worker.health.clone();
    assert_eq!((health.stop_sent.load(Relaxed), health.stop_confirmed.load(Relaxed)), (0, 0));
    bench.cycle();
    bench.cycle();
    assert_eq!((health.stop_sent.load(Relaxed), health.stop_confirmed.load(Relaxed)), (7, 7));
    bench.cycle();
    assert_eq!(bench.count("write_stop"), 3);
    assert_eq!(bench.worker.ordered_power, Some(true), "a stop leaves the motors on");
}

#[test]
fn a_stop_while_disconnected_is_sent_after_the_reconnect_and_a_gripper_command_refused() {
    let mut bench = Bench::enabled();
    bench.worker.mark_lost();
    bench.tick(|c| (c.mode, c.stop_seq, c.gripper_seq) = (None, 3, 9));
    assert_eq!(bench.worker.health.gripper_answer(9), Some(Err(AdapterError::NotConnected)));
    assert_eq!(bench.count("write_stop"), 0);
    bench.advance(Duration::from_secs(1));
    bench.cycle();
    bench.cycle();
    assert_eq!(bench.worker.health.stop_sent.load(Relaxed), 3);
    assert_eq!(bench.count("write_stop"), 1);
}

#[test]
fn gripper_commands_are_answered() {
    let arm = MockAdapter::new(DOF).gripper(0.02);
    let mut bench = Bench::new(arm);
    bench.worker.connect(&mut bench.adapter).unwrap();
    bench.tick(|c| (c.gripper, c.gripper_seq) = (0.03, 1));
    let health = bench.worker.health.clone();
    assert_eq!(health.gripper_answer(1), Some(Ok(())));
    assert!(bench.arm.calls().contains(&Call::WriteGripperPosition(0.03)));
    bench.tick(|_| {});
    assert_eq!(bench.count("write_gripper_position"), 1, "once");

    let refused = AdapterError::Rejected("too wide".into());
    bench.arm.fail("write_gripper_position", refused.clone());
    bench.tick(|c| c.gripper_seq = 2);
    assert_eq!(health.gripper_answer(2), Some(Err(refused)));
    assert_eq!(bench.worker.write_errors, 0, "a refusal does not affect the joints");
    assert_eq!(health.write_errors.load(Relaxed), 1);

    bench.arm.fail("write_gripper_position", AdapterError::Timeout("no answer".into()));
    bench.tick(|c| c.gripper_seq = 3);
    assert_eq!((health.write_errors.load(Relaxed), bench.worker.in_flight), (2, 1));

    bench.worker.state.self_held = true;
    bench.arm.clear_calls();
    bench.tick(|c| c.gripper_seq = 4);
    assert!(matches!(health.gripper_answer(4), Some(Err(AdapterError::Rejected(_)))));
    assert_eq!(bench.count("write_gripper_position"), 0);
}

#[test]
fn a_gripper_that_moves_after_a_stop_is_held_within_its_range() {
    let arm = MockAdapter::new(DOF).gripper(0.02);
    let mut bench = Bench::new(arm);
    bench.worker.connect(&mut bench.adapter).unwrap();
    bench.tick(|c| c.stop_seq = 1);
    for opening in [0.021, 0.022, 0.023, 0.024] {
        bench.arm.clone().gripper(opening);
        bench.advance(PERIOD);
        bench.cycle();
    }
    let held: Vec<Call> = bench.arm.calls().into_iter().filter(|c| c.name() == "write_gripper_position").collect();
    assert_eq!(held.len(), 1, "{held:?}");
    assert!(matches!(held[0], Call::WriteGripperPosition(at) if (0.021..0.025).contains(&at)));
}

#[test]
fn a_reset_that_takes_time_is_asked_again_while_states_are_read_and_stops_are_sent() {
    let mut bench = Bench::enabled();
    let begin = |bench: &mut Bench| {
        let (reply, answer) = sync_channel(1);
        bench._orders.send(Order::ClearErrors(reply)).unwrap();
        answer
    };
    (0..3).for_each(|_| bench.arm.fail("write_clear_errors", AdapterError::Busy));
    let (first, mut seq) = (begin(&mut bench), bench.states.read().seq);
    for cycle in 0..3 {
        let state = bench.tick(|c| (c.mode, c.stop_seq) = (None, 1));
        assert!(state.seq > seq && first.try_recv().is_err(), "cycle {cycle}");
        seq = state.seq;
    }
    assert_eq!(bench.count("write_stop"), 1);
    let second = begin(&mut bench);
    bench.tick(|_| {});
    assert_eq!(first.try_recv(), Ok(Ok(())));
    assert!(
        matches!(second.try_recv(), Ok(Err(AdapterError::Rejected(why))) if why.starts_with("a reset is under way\nhint: "))
    );
    assert_eq!(bench.count("write_clear_errors"), 4);
    // It does not take for ever.
    (0..1000).for_each(|_| bench.arm.fail("write_clear_errors", AdapterError::Busy));
    let last = begin(&mut bench);
    for _ in 0..749 {
        bench.tick(|_| {});
    }
    assert!(last.try_recv().is_err());
    for _ in 0..3 {
        bench.tick(|_| {});
    }
    assert_eq!(last.try_recv(), Ok(Err(AdapterError::Busy)));
}

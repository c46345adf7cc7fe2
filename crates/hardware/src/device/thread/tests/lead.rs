//! Leading: the controller's change of mode over several cycles, what ends it, and a tick that dies meanwhile.

use std::sync::mpsc::{Receiver, sync_channel};

use super::*;
use crate::adapter::AdapterError;
use crate::device::Way;
use dimos_core::arm::{Interference, Pose};

const POSE: Pose = Pose { xyz: [0.3, 0.1, 0.2], rpy: [0.0; 3] };

fn native(bench: &Bench) -> Receiver<AdapterResult<()>> {
    let (reply, answer) = sync_channel(1);
    bench._orders.send(Order::Lead(Way::To(POSE, 0.25), 1, reply)).unwrap();
    answer
}

/// An enabled arm with its own kinematics that has held a setpoint.
fn holding() -> Bench {
    let mut bench = Bench::enabled_with(MockAdapter::new(DOF).pose(POSE));
    bench.hold_at(0.0);
    bench.arm.clear_calls();
    bench
}

/// A tick of the first lead.
fn idle(bench: &mut Bench) -> ArmState {
    bench.tick(|c| (c.mode, c.led, c.lead_seq) = (None, true, 1))
}

/// A tick that ends it by a stop.
fn stop(bench: &mut Bench) -> ArmState {
    bench.tick(|c| (c.mode, c.led, c.stop_seq) = (None, false, c.stop_seq + 1))
}

#[test]
fn a_change_of_mode_that_takes_time_is_asked_again_while_states_arrive() {
    let mut bench = holding();
    for _ in 0..3 {
        bench.arm.fail("set_control_mode", AdapterError::Rejected("under way".into()));
    }
    let answer = native(&bench);
    let before = bench.states.read().seq;
    let states: Vec<u64> = (0..3).map(|_| idle(&mut bench).seq).collect();
    assert!(states.is_sorted_by(|a, b| a < b) && states[0] > before, "read as usual: {states:?}");
    assert!(answer.try_recv().is_err() && bench.count("write_cartesian_position") == 0);
    idle(&mut bench);
    assert_eq!(answer.try_recv(), Ok(Ok(())));
    assert!(bench.arm.calls().contains(&Call::WriteCartesianPosition(POSE, 0.25)));
    for _ in 0..20 {
        assert_eq!(idle(&mut bench).interference, Interference::None, "the mode was ordered");
    }
    assert_eq!(bench.count("write_cartesian_position"), 1, "once");
    assert!(bench.written().is_empty(), "and no setpoint");
}

#[test]
fn a_pose_that_is_refused_is_refused_at_once_and_a_mode_that_never_comes_in_the_end() {
    let mut bench = holding();
    bench.arm.fail("write_cartesian_position", AdapterError::Rejected("no solution".into()));
    let answer = native(&bench);
    idle(&mut bench);
    assert_eq!(answer.try_recv(), Ok(Err(AdapterError::Rejected("no solution".into()))));
    assert!(!bench.worker.moving());

    let answer = native(&bench);
    for _ in 0..700 {
        bench.arm.fail("set_control_mode", AdapterError::Rejected("it moves".into()));
        idle(&mut bench);
    }
    assert_eq!(answer.try_recv(), Ok(Err(AdapterError::Rejected("it moves".into()))));

    let (reply, answer) = sync_channel(1);
    bench._orders.send(Order::Lead(Way::Hand, 1, reply)).unwrap();
    idle(&mut bench);
    assert_eq!(answer.try_recv(), Ok(Err(AdapterError::Unsupported)), "this arm has no hand guiding");
}

#[test]
fn a_stop_ends_a_motion_that_has_not_begun() {
    let mut bench = holding();
    bench.arm.fail("set_control_mode", AdapterError::Rejected("under way".into()));
    let answer = native(&bench);
    idle(&mut bench);
    stop(&mut bench);
    stop(&mut bench);
    assert!(matches!(answer.try_recv(), Ok(Err(AdapterError::Rejected(_)))));
    assert_eq!((bench.count("write_stop"), bench.count("write_cartesian_position")), (2, 0));
}

/// The order may come late: the client's thread had no processor.
#[test]
fn an_order_that_comes_after_the_stop_of_its_lead_is_refused() {
    let mut bench = holding();
    idle(&mut bench);
    stop(&mut bench);
    let late = native(&bench);
    bench.tick(|_| ());
    assert!(matches!(late.try_recv(), Ok(Err(AdapterError::Rejected(_)))));
    // Nor does it belong to the next lead.
    let late = native(&bench);
    bench.tick(|c| (c.led, c.lead_seq) = (true, 2));
    assert!(matches!(late.try_recv(), Ok(Err(AdapterError::Rejected(_)))));
    assert_eq!((bench.count("set_control_mode"), bench.count("write_cartesian_position")), (0, 0));
}

#[test]
fn an_order_whose_lead_never_comes_is_refused_in_the_end_and_an_arm_without_poses_at_once() {
    let mut bench = holding();
    let early = native(&bench);
    for _ in 0..700 {
        bench.tick(|c| c.mode = None);
    }
    assert_eq!(early.try_recv(), Ok(Err(AdapterError::Timeout("the tick did not pass the arm on".into()))));
    let mut plain = Bench::enabled();
    plain.hold_at(0.0);
    plain.arm.clear_calls();
    let answer = native(&plain);
    idle(&mut plain);
    assert_eq!(answer.try_recv(), Ok(Err(AdapterError::Unsupported)));
    for bench in [&bench, &plain] {
        assert_eq!((bench.count("set_control_mode"), bench.count("write_cartesian_position")), (0, 0));
    }
}

#[test]
fn an_order_that_is_not_carried_out_yet_ends_with_the_motors_and_with_the_connection() {
    let mut bench = holding();
    bench.arm.fail("set_control_mode", AdapterError::Rejected("under way".into()));
    let answer = native(&bench);
    idle(&mut bench);
    let (reply, disabled) = sync_channel(1);
    bench._orders.send(Order::Disable(reply)).unwrap();
    idle(&mut bench);
    assert_eq!(disabled.try_recv(), Ok(Ok(())));
    assert_eq!(answer.try_recv(), Ok(Err(AdapterError::Rejected("the motors were switched off".into()))));
    assert_eq!(bench.count("write_cartesian_position"), 0);

    let mut bench = holding();
    bench.arm.fail("write_cartesian_position", AdapterError::NotConnected);
    let answer = native(&bench);
    idle(&mut bench);
    assert_eq!(answer.try_recv(), Ok(Err(AdapterError::NotConnected)));
    assert_eq!(bench.states.read().link, dimos_core::arm::Link::Faulted, "at once");
}

#[test]
fn an_order_that_comes_before_its_lead_waits_for_it() {
    // The newest command that came is of the lead before it, or of an earlier one.
    for lead_seq in [0, u32::MAX] {
        let mut bench = holding();
        let early = native(&bench);
        bench.tick(|c| (c.mode, c.lead_seq) = (None, lead_seq));
        assert!(early.try_recv().is_err() && bench.count("write_cartesian_position") == 0);
        idle(&mut bench);
        assert_eq!(early.try_recv(), Ok(Ok(())));
    }
}

#[test]
fn a_stop_that_the_arm_does_not_take_at_once_begins_no_motion() {
    let mut bench = holding();
    let answer = native(&bench);
    bench.arm.fail("write_stop", AdapterError::Timeout("late".into()));
    bench.tick(|c| (c.mode, c.led, c.lead_seq, c.stop_seq) = (None, true, 1, c.stop_seq + 1));
    assert!(matches!(answer.try_recv(), Ok(Err(AdapterError::Rejected(_)))));
    assert_eq!(bench.count("write_cartesian_position"), 0);
}

#[test]
fn an_arm_whose_motors_were_switched_off_is_not_taken_over() {
    let led = || {
        let mut bench = holding();
        let answer = native(&bench);
        idle(&mut bench);
        assert_eq!(answer.try_recv(), Ok(Ok(())));
        bench
    };
    let ask = |order: fn(std::sync::mpsc::SyncSender<AdapterResult<()>>) -> Order, bench: &mut Bench| {
        let (reply, answer) = sync_channel(1);
        bench._orders.send(order(reply)).unwrap();
        bench.stepping(Duration::from_millis(1), stop);
        answer.recv().unwrap()
    };
    let mut by_the_run = led();
    ask(Order::Disable, &mut by_the_run).unwrap();
    assert!(matches!(ask(Order::TakeOver, &mut by_the_run), Err(AdapterError::Rejected(_))));
    assert!(!by_the_run.states.read().enabled);
    let mut by_others = led();
    drop(by_others.arm.clone().enabled(false));
    for _ in 0..5 {
        idle(&mut by_others);
    }
    assert!(matches!(ask(Order::TakeOver, &mut by_others), Err(AdapterError::Rejected(_))));
    let mut with_motors = led();
    assert_eq!(ask(Order::TakeOver, &mut with_motors), Ok(()));
}

#[test]
fn a_tick_that_dies_stops_an_arm_that_its_controller_moves() {
    let mut bench = holding();
    let answer = native(&bench);
    idle(&mut bench);
    assert_eq!(answer.try_recv(), Ok(Ok(())));
    assert!(bench.worker.moving());
    for _ in 0..30 {
        bench.advance(PERIOD);
        bench.cycle();
    }
    assert_eq!(bench.count("write_stop"), 1);
    assert!(bench.states.read().self_held && !bench.worker.moving());
}

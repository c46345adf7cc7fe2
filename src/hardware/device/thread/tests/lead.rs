//! Leading: the controller's change of mode over several cycles, what ends it, and a tick that dies meanwhile.

use std::sync::mpsc::{Receiver, sync_channel};

use super::*;
use crate::arm::{Interference, Pose};
use crate::hardware::adapter::AdapterError;

const POSE: Pose = Pose { xyz: [0.3, 0.1, 0.2], rpy: [0.0; 3] };

fn native(bench: &Bench) -> Receiver<AdapterResult<()>> {
    let (reply, answer) = sync_channel(1);
    bench._orders.send(Order::MoveNative(POSE, 0.25, reply)).unwrap();
    answer
}

/// An enabled arm with its own kinematics that has held a setpoint.
fn holding() -> Bench {
    let mut bench = Bench::enabled_with(MockAdapter::new(DOF).pose(POSE));
    bench.hold_at(0.0);
    bench.arm.clear_calls();
    bench
}

fn idle(bench: &mut Bench) -> ArmState {
    bench.tick(|c| c.mode = None)
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
    bench._orders.send(Order::Guide(reply)).unwrap();
    idle(&mut bench);
    assert_eq!(answer.try_recv(), Ok(Err(AdapterError::Unsupported)), "this arm has no hand guiding");
}

#[test]
fn a_stop_ends_a_motion_that_has_not_begun() {
    let mut bench = holding();
    bench.arm.fail("set_control_mode", AdapterError::Rejected("under way".into()));
    let answer = native(&bench);
    idle(&mut bench);
    bench.tick(|c| (c.mode, c.stop_seq) = (None, c.stop_seq + 1));
    idle(&mut bench);
    assert!(matches!(answer.try_recv(), Ok(Err(AdapterError::Rejected(_)))));
    assert_eq!((bench.count("write_stop"), bench.count("write_cartesian_position")), (1, 0));
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

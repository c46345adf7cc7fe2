//! A motion under way whose rest is no longer known to be free, on a virtual clock.

use dimos::control::request::Request;
use dimos::telemetry::{Cause, Outcome, Phase, Reason, TaskState};

use crate::support::rig::*;

#[test]
fn a_motion_whose_way_is_blocked_rests_on_its_path_and_says_why() {
    let mut rig = Rig::one_arm(one(trajectory()));
    rig.execute(0, sweep(1, 0..6, 0.0, 1.0, 2.0));
    rig.run_for(0.8);
    let blocked = |motion| Request::WayBlocked { task: 0, motion, in_time: true };
    assert_eq!(rig.ask(blocked(2)), Outcome::AlreadyStopped, "it was meant for another motion");
    assert_eq!(rig.tasks[0].state, TaskState::Executing);
    assert_eq!(rig.ask(blocked(1)), Outcome::Cancelled);
    assert_eq!((rig.tasks[0].state, rig.tasks[0].reason), (TaskState::Cancelling, Reason::WayBlocked));
    assert_eq!(rig.ask(Request::Cancel { task: None }), Outcome::Cancelled, "again, on the way");
    rig.run_for(1.0);
    assert_eq!((rig.tasks[0].state, rig.tasks[0].reason), (TaskState::Aborted, Reason::WayBlocked));
    assert_eq!((rig.phase(0), rig.speed(0), rig.retired.clone()), (Phase::Ready, 0.0, vec![1]));
    assert_eq!(rig.ask(blocked(1)), Outcome::AlreadyStopped);
    assert_eq!(rig.ask(Request::WayBlocked { task: 1, motion: 1, in_time: true }), Outcome::WrongTask(1));
}

#[test]
fn a_motion_that_cannot_rest_in_time_holds_the_arms_that_it_moves() {
    let mut rig = Rig::two_arms(vec![task("both", trajectory(), 0..13, 10), task("v", velocity(), 0..7, 5)]);
    // Joints of both arms, then of the second one only.
    for (motion, joints, held) in [(1, 5..9, [true, true]), (2, 7..9, [false, true])] {
        let start = rig.commanded(usize::from(joints.start >= 7))[0];
        rig.execute(0, sweep(motion, joints, start, start + 0.5, 1.0));
        rig.run_for(0.5);
        let late = Request::WayBlocked { task: 0, motion, in_time: false };
        assert_eq!(rig.ask(late), Outcome::Accepted, "{motion}");
        for (arm, held) in held.into_iter().enumerate() {
            let expected = if held { Phase::Held } else { Phase::Ready };
            assert_eq!(rig.phase(arm), expected, "motion {motion}, arm {arm}");
        }
        let reason = Reason::ArmHeld(u16::from(!held[0]), Cause::WayBlocked);
        assert_eq!((rig.tasks[0].state, rig.tasks[0].reason), (TaskState::Aborted, reason));
        rig.run_for(1.0);
        for arm in 0..2 {
            rig.ask(Request::Reset { arm });
            rig.ask(Request::Enabled { arm, outside: false });
        }
        rig.run_for(1.0);
    }
}

//! What was stopped stays stopped, on a virtual clock: a request made before an arm was stopped, held, disabled or
//! lost, or before another client took its lease, starts nothing, however the arm was made ready since.

use std::time::Duration;

use dimos::arm::Link;
use dimos::control::config::{ChunkParams, FollowParams, LeaderJoint, TaskConfig, TaskKind};
use dimos::control::request::{Motion, Request};
use dimos::control::tasks::chunk::curve;
use dimos::joint::joints_of;
use dimos::telemetry::{Cause, Event, Interruption, LedBy, Origin, Outcome, Phase, Reason, TaskState};
use dimos::trajectory::Spline;

use crate::support::rig::*;

const A: u64 = 3;
const B: u64 = 4;

/// A way to interrupt a ready arm, and what it is named.
type Way = (fn(&mut Rig), Interruption);

const WAYS: [Way; 6] = [
    (stop, Interruption::Stopped),
    (disable, Interruption::Disabled),
    (lose_the_link, Interruption::LinkLost),
    (lose_power, Interruption::PowerLost),
    (fault, Interruption::Held(Cause::Fault(31))),
    (commanded_by_b, Interruption::LeaseTaken(B)),
];

fn stop(rig: &mut Rig) {
    assert_eq!(rig.ask(Request::Stop { arm: None }), Outcome::Accepted);
}

fn disable(rig: &mut Rig) {
    assert_eq!(rig.ask(Request::PrepareDisable { arm: 0 }), Outcome::Accepted);
    rig.run_for(0.2);
    rig.arms[0].enabled = false;
    rig.run(3);
    rig.arms[0].enabled = true;
}

fn lose_the_link(rig: &mut Rig) {
    rig.arms[0].link = Link::Down;
    rig.run(3);
    rig.arms[0].link = Link::Up;
}

fn lose_power(rig: &mut Rig) {
    rig.arms[0].enabled = false;
    rig.run(3);
    rig.arms[0].enabled = true;
}

fn fault(rig: &mut Rig) {
    rig.arms[0].error = 31;
    rig.run(3);
    rig.arms[0].error = 0;
}

fn commanded_by_b(rig: &mut Rig) {
    rig.ask(Request::LeaseTaken { arm: 0, client: B });
    rig.ask(Request::LeaseEnded { arm: 0, client: B });
}

/// Resets the arm as far as needed, and enables it.
fn revive(rig: &mut Rig) {
    rig.run_for(1.0);
    assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
    rig.run(3);
    assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
    rig.run_for(0.3);
    assert_eq!(rig.phase(0), Phase::Ready);
}

fn tasks() -> Vec<TaskConfig> {
    vec![
        task("traj", trajectory(), 0..6, 10),
        task("servo", servo(), 0..6, 11),
        task("velocity", velocity(), 0..6, 12),
        task("chunk", TaskKind::new("chunk", &ChunkParams::default()), 0..6, 13),
    ]
}

/// A chunk that moves all joints to 0.1 rad, from this time from now on.
fn chunk(rig: &Rig, ahead: f64) -> Request {
    let names: Vec<String> = (0..6).map(|j| format!("j{j}")).collect();
    let actions: Vec<Vec<f64>> = (0..=20).map(|k| vec![0.005 * f64::from(k); 6]).collect();
    let spline = Spline::new(&curve(&names, &actions, 0.05, &rig.config.arms[0].limits)).unwrap();
    let start = rig.now.after(Duration::from_secs_f64(ahead));
    Request::Chunk { task: 3, start, motion: Box::new(Motion { id: 7, joints: (0..6).collect(), spline, until: None }) }
}

fn motions(rig: &Rig) -> Vec<Request> {
    vec![
        Request::Execute { task: 0, motion: sweep(1, 0..6, 0.0, 0.3, 1.0) },
        Request::Servo { task: 1, target: joints_of(&[0.05; 6]) },
        Request::Velocity { task: 2, target: joints_of(&[0.2; 6]) },
        chunk(rig, 0.0),
        Request::Gripper { arm: 0, opening: 0.02, force: None, speed: None },
        Request::Lead { arm: 0, by: LedBy::Controller },
    ]
}

#[test]
fn nothing_requested_before_an_interruption_moves_the_arm_after_it() {
    for (interrupt, named) in WAYS {
        let mut rig = Rig::one_arm(tasks());
        let origin = rig.origin(A);
        interrupt(&mut rig);
        revive(&mut rig);
        let before = rig.commanded(0);
        for request in motions(&rig) {
            let text = format!("{request:?}");
            assert_eq!(rig.ask_from(origin, request), Outcome::Superseded(0, named), "{text}");
            rig.run_for(0.2);
        }
        assert_eq!((rig.commanded(0), rig.phase(0)), (before, Phase::Ready), "{named:?}");
        // Requested now, it moves.
        let origin = rig.origin(A);
        let motion = sweep(2, 0..6, rig.commanded(0)[0], 0.3, 1.0);
        assert_eq!(rig.ask_from(origin, Request::Execute { task: 0, motion }), Outcome::Accepted, "{named:?}");
        rig.run_until(2.0, |rig| rig.tasks[0].state == TaskState::Completed);
    }
}

#[test]
fn a_stop_of_a_held_arm_counts_and_a_reset_and_an_enable_do_not() {
    let mut rig = Rig::one_arm(tasks());
    stop(&mut rig);
    let (held, execute) = (rig.origin(A), |id| Request::Execute { task: 0, motion: sweep(id, 0..6, 0.0, 0.1, 1.0) });
    revive(&mut rig);
    assert_eq!(rig.ask_from(held, execute(1)), Outcome::Accepted, "requested while it was held");
    rig.ask(Request::Cancel { task: None });
    stop(&mut rig);
    let held = rig.origin(A);
    stop(&mut rig);
    revive(&mut rig);
    assert_eq!(rig.ask_from(held, execute(2)), Outcome::Superseded(0, Interruption::Stopped));
}

#[test]
fn a_stop_in_the_tick_of_a_request_and_one_of_another_arm_are_told_apart() {
    let mut rig = Rig::two_arms(vec![task("left", trajectory(), 0..7, 10), task("right", trajectory(), 7..13, 10)]);
    let origin = rig.origin(A);
    assert_eq!(rig.ask(Request::Stop { arm: Some(0) }), Outcome::Accepted);
    let right = Request::Execute { task: 1, motion: sweep(1, 7..13, 0.0, 0.1, 1.0) };
    assert_eq!(rig.ask_from(origin, right), Outcome::Accepted, "the other arm was not stopped");
    rig.run_for(1.0);
    rig.ask(Request::Reset { arm: 0 });
    rig.ask(Request::Enabled { arm: 0, outside: false });
    rig.run_for(0.3);
    let left = Request::Execute { task: 0, motion: sweep(2, 0..7, 0.0, 0.1, 1.0) };
    assert_eq!(rig.ask_from(origin, left), Outcome::Superseded(0, Interruption::Stopped));
}

#[test]
fn a_client_may_take_the_lease_with_what_it_requests_and_moves_nothing_after_it_released_it() {
    let mut rig = Rig::one_arm(tasks());
    let origin = rig.origin(A);
    rig.ask(Request::LeaseTaken { arm: 0, client: A });
    let execute = |id, from| Request::Execute { task: 0, motion: sweep(id, 0..6, from, 0.05, 1.0) };
    assert_eq!(rig.ask_from(origin, execute(1, 0.0)), Outcome::Accepted);
    rig.ask(Request::LeaseEnded { arm: 0, client: A });
    rig.run(20);
    assert_eq!(rig.tasks[0].state, TaskState::Executing, "a trajectory that has begun continues");
    rig.run_until(2.0, |rig| rig.tasks[0].state == TaskState::Completed);
    assert_eq!(rig.ask_from(origin, execute(2, 0.05)), Outcome::Superseded(0, Interruption::LeaseEnded(A)));
}

#[test]
fn the_accepted_motion_of_a_client_supersedes_what_others_have_requested_and_a_refused_one_does_not() {
    let mut rig = Rig::one_arm(tasks());
    let (a, b) = (rig.origin(A), rig.origin(B));
    let refused = Request::Execute { task: 0, motion: sweep(1, 0..6, 0.5, 0.6, 1.0) };
    assert!(matches!(rig.ask_from(b, refused), Outcome::StartStateMismatch(..)));
    let gripper = |opening| Request::Gripper { arm: 0, opening, force: None, speed: None };
    assert_eq!(rig.ask_from(a, gripper(0.02)), Outcome::Accepted);
    assert_eq!(rig.ask_from(b, gripper(0.03)), Outcome::Superseded(0, Interruption::LeaseTaken(A)));
    let b = rig.origin(B);
    assert_eq!(rig.ask_from(b, gripper(0.03)), Outcome::Accepted);
    let execute = |id, from| Request::Execute { task: 0, motion: sweep(id, 0..6, from, 0.1, 1.0) };
    assert_eq!(rig.ask_from(a, execute(2, 0.0)), Outcome::Superseded(0, Interruption::LeaseTaken(B)));
    let elsewhere = rig.ask_from(a, execute(3, 0.3));
    assert!(matches!(elsewhere, Outcome::StartStateMismatch(..)), "that says more: {elsewhere:?}");
}

#[test]
fn a_waiting_chunk_is_dropped_and_a_running_one_decelerates_when_its_client_is_gone() {
    for ahead in [5.0, 0.0] {
        let mut rig = Rig::one_arm(tasks());
        let (a, waits) = (rig.origin(A), ahead > 0.0);
        let request = chunk(&rig, ahead);
        assert_eq!(rig.ask_from(a, request), Outcome::Accepted);
        rig.run_for(0.5);
        assert_eq!((rig.tasks[3].state, rig.speed(0) > 0.01), (TaskState::Executing, !waits));
        rig.ask(Request::LeaseEnded { arm: 0, client: B });
        assert_eq!(rig.tasks[3].state, TaskState::Executing, "the lease of another client");
        rig.ask(Request::LeaseEnded { arm: 0, client: A });
        assert_eq!((rig.tasks[3].state, rig.tasks[3].reason), (TaskState::Aborted, Reason::LeaseEnded(0)));
        // The rig checks that it decelerates within the limits.
        rig.run_for(0.5);
        let rests = rig.commanded(0);
        rig.run_for(7.0);
        assert_eq!((rig.commanded(0), rig.phase(0)), (rests, Phase::Ready), "start {ahead} s ahead");
    }
}

#[test]
fn a_task_that_the_blueprint_starts_does_not_start_after_a_stop() {
    for stopped in [false, true] {
        let mut rig = follower();
        rig.run(2);
        if stopped {
            rig.ask(Request::Stop { arm: Some(1) });
            rig.ask(Request::Reset { arm: 1 });
        }
        for arm in 0..2 {
            assert_eq!(rig.ask(Request::Enabled { arm, outside: false }), Outcome::Accepted);
        }
        rig.run_for(1.0);
        let state = if stopped { TaskState::Idle } else { TaskState::Executing };
        assert_eq!(rig.tasks[0].state, state, "{:?}", rig.events);
        let refused = Event::Request(0, Outcome::Superseded(1, Interruption::Stopped));
        assert_eq!(rig.reported(refused), stopped);
        if stopped {
            // A client starts it.
            let origin = rig.origin(A);
            assert_eq!(rig.ask_from(origin, Request::Start { task: 0 }), Outcome::Accepted);
        }
    }
}

/// A right arm that follows a left one from the start.
fn follower() -> Rig {
    let params = FollowParams { leader: Some("left".to_owned()), ..FollowParams::default() };
    let led = |joint| LeaderJoint { joint, scale: 1.0, offset: 0.0, endless: false };
    let mut follow = task("follow", TaskKind::new("follow", &params).led_by((0..6).map(led).collect()), 6..12, 10);
    follow.auto_start = true;
    Rig::new(100.0, vec![arm("left", 6), arm("right", 6)], vec![follow])
}

#[test]
fn a_request_without_an_origin_is_not_compared() {
    let mut rig = Rig::one_arm(tasks());
    stop(&mut rig);
    revive(&mut rig);
    assert_eq!(rig.execute(0, sweep(1, 0..6, 0.0, 0.1, 1.0)), Outcome::Accepted, "as in earlier logs");
    assert_eq!(Origin::default(), Origin { epoch: 0, client: 0 });
}

//! A controller that slows its arm, on a virtual clock: setpoints keep its time, on the same path.

use dimos::control::request::Request;
use dimos::joint::joints_of;
use dimos::telemetry::{Event, Phase, TaskState};

use crate::support::rig::*;

/// A rig whose commands keep the limits in the arm's own time only.
fn slowed(mut rig: Rig) -> Rig {
    rig.checked = false;
    rig
}

fn at(rig: &mut Rig, arm: usize, fraction: f64) {
    rig.arms[arm].state.speed_fraction = Some(fraction);
}

/// Largest distance of the joints from each other [rad]: all of them make the same motion.
fn spread(rig: &Rig) -> f64 {
    let q = rig.commanded(0);
    q.iter().fold(0.0, |most: f64, v| most.max((v - q[0]).abs()))
}

#[test]
fn a_motion_takes_as_much_longer_as_its_arm_is_slowed_and_waits_at_zero() {
    let mut rig = slowed(Rig::one_arm(one(trajectory())));
    rig.execute(0, sweep(7, 0..6, 0.0, 1.2, 2.0));
    let step = |rig: &mut Rig, fraction: f64, ticks: u32| {
        at(rig, 0, fraction);
        let (from, elapsed) = (rig.commanded(0)[0], rig.tasks[0].elapsed);
        for _ in 0..ticks {
            rig.tick();
            assert!(spread(rig) < 1e-9);
            assert_eq!(rig.phase(0), Phase::Ready, "{:?}", rig.events);
        }
        (rig.commanded(0)[0] - from, rig.tasks[0].elapsed - elapsed)
    };
    step(&mut rig, 1.0, 50);
    let (_, passed) = step(&mut rig, 0.3, 100);
    assert!((passed - 0.3).abs() < 1e-9, "{passed} s of the path in 1 s");
    let (moved, passed) = step(&mut rig, 0.0, 300);
    assert_eq!((moved, passed), (0.0, 0.0), "it waits on its path");
    assert_eq!(rig.tasks[0].state, TaskState::Executing);
    let (_, passed) = step(&mut rig, 0.05, 100);
    assert!((passed - 0.05).abs() < 1e-9, "{passed} s");
    at(&mut rig, 0, 1.0);
    rig.run_until(3.0, |rig| rig.tasks[0].state == TaskState::Completed);
    assert!((rig.commanded(0)[0] - 1.2).abs() < 1e-9);
    assert_eq!(rig.count(|event| matches!(event, Event::Limited(..) | Event::Arm(..))), 0, "{:?}", rig.events);
}

#[test]
fn an_arm_that_lags_by_its_own_time_is_not_held() {
    for fraction in [0.5, 0.1, 0.02] {
        let mut rig = slowed(Rig::one_arm(one(trajectory())));
        rig.execute(0, sweep(7, 0..6, 0.0, 1.2, 1.6));
        rig.run_for(0.6);
        at(&mut rig, 0, fraction);
        // 40 ms of the arm's own time.
        rig.arms[0].lag = 0.04 / fraction;
        rig.run_for(4.0);
        at(&mut rig, 0, 1.0);
        rig.arms[0].lag = 0.04;
        rig.run_until(4.0, |rig| rig.tasks[0].state == TaskState::Completed);
        assert_eq!(rig.phase(0), Phase::Ready, "at {fraction}: {:?}", rig.events);
    }
}

#[test]
fn what_ends_at_zero_ends_where_the_arm_rests() {
    let mut rig = slowed(Rig::one_arm(one(trajectory())));
    rig.execute(0, sweep(7, 0..6, 0.0, 1.2, 2.0));
    rig.run_for(1.0);
    at(&mut rig, 0, 0.0);
    rig.run(2);
    let here = rig.commanded(0);
    rig.ask(Request::Cancel { task: Some(0) });
    rig.run(2);
    assert_eq!(rig.tasks[0].state, TaskState::Aborted);
    at(&mut rig, 0, 1.0);
    rig.run_for(1.0);
    assert_eq!((rig.commanded(0), rig.phase(0)), (here, Phase::Ready), "nothing moves when the controller continues");

    // A stop reaches the arm's controller soon, however slow it is.
    rig.execute(0, sweep(8, 0..6, here_of(&rig), 0.0, 2.0));
    rig.run_for(1.0);
    at(&mut rig, 0, 0.02);
    rig.run(10);
    let stops = rig.arms[0].stops;
    rig.send(Request::Stop { arm: None });
    let took = rig.run_until(3.0, |rig| rig.arms[0].stops > stops);
    assert!(took < 1.5, "{took} s until the controller is stopped");
}

fn here_of(rig: &Rig) -> f64 {
    rig.commanded(0)[0]
}

#[test]
fn a_path_of_two_arms_keeps_one_time() {
    let mut rig = slowed(Rig::two_arms(vec![task("both", trajectory(), 0..13, 10)]));
    rig.execute(0, sweep(7, 0..13, 0.0, 1.0, 2.0));
    rig.run_for(0.8);
    at(&mut rig, 0, 0.4);
    let (mut before, mut first) = ((rig.commanded(1)[0], None::<f64>), true);
    rig.run_until(8.0, |rig| {
        let (left, right) = (rig.commanded(0)[0], rig.commanded(1)[0]);
        assert!((left - right).abs() < 1e-6, "{left} and {right}");
        let velocity = (right - before.0) / 0.01;
        if let Some(last) = before.1 {
            assert!(
                (velocity - last).abs() <= A_MAX * 0.01 * 1.01,
                "{last} to {velocity}: the other arm is not slowed"
            );
        }
        before = (right, Some(velocity).filter(|_| !std::mem::take(&mut first)));
        rig.tasks[0].state == TaskState::Completed
    });
}

#[test]
fn streams_are_slowed_too_and_begin_again_from_rest() {
    let mut rig = slowed(Rig::one_arm(one(velocity())));
    rig.velocity(0, &[0.4; 6]);
    rig.run_for(0.1);
    at(&mut rig, 0, 0.0);
    let stream = |rig: &mut Rig, ticks: u32| {
        for _ in 0..ticks {
            rig.velocity(0, &[0.4; 6]);
            rig.tick();
        }
        rig.commands[0].values[0]
    };
    assert_eq!(stream(&mut rig, 60), 0.0);
    at(&mut rig, 0, 0.5);
    let (first, later) = (stream(&mut rig, 1), stream(&mut rig, 60));
    assert!(first < 0.1 && (later - 0.4).abs() < 1e-9, "{first} {later}");

    let mut rig = slowed(Rig::one_arm(one(servo())));
    at(&mut rig, 0, 0.1);
    let mut target = 0.0;
    for _ in 0..100 {
        target += 0.005;
        rig.servo(0, &[target; 6]);
        let before = rig.commanded(0)[0];
        rig.tick();
        assert!(rig.commanded(0)[0] - before <= 0.1 * V_MAX * 0.01 + 1e-9);
    }
    assert_eq!(rig.phase(0), Phase::Ready, "{:?}", rig.events);
    assert!(rig.arms[0].q == rig.commanded(0) && joints_of(&rig.arms[0].q)[0] > 0.0);
}

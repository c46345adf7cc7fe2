//! F02 and F07: states that stop, and values that are not finite.

use std::time::Duration;

use dimos::arm::{ArmState, Link};
use dimos::control::request::Request;
use dimos::joint::joints_of;
use dimos::telemetry::{Cause, Event, Outcome, Phase, Reason, TaskState};
use dimos::trajectory::{JointTrajectory, Spline, TrajectoryPoint};

use crate::support::rig::*;

#[test]
fn f02_joints_never_vanish_and_their_age_grows() {
    let mut rig = Rig::two_arms(vec![task("l", trajectory(), 0..7, 10), task("r", trajectory(), 7..13, 10)]);
    rig.execute(0, sweep(1, 0..7, 0.0, 1.0, 2.0));
    rig.execute(1, sweep(2, 7..13, 0.0, 1.0, 2.0));
    rig.run_for(1.0);
    rig.arms[1].silent = true;
    let (last, mut age) = (rig.samples[1].state, Duration::ZERO);
    for k in 1..=100u32 {
        rig.tick();
        let sample = rig.samples[1];
        assert_eq!(sample.state.position, last.position, "the last state stays");
        assert_eq!(rig.samples.len(), 2);
        let now = rig.now.since(sample.state.stamp);
        assert!(now > age, "its age grows");
        age = now;
        // States are stale after 30 ms: two missed states are tolerated, three are not.
        assert_eq!(rig.phase(1), if k < 3 { Phase::Ready } else { Phase::Held }, "after {k} missed states");
    }
    assert_eq!(rig.samples[1].cause.name(), "stale");
    assert_eq!(rig.count(|e| matches!(e, Event::Arm(1, ..))), 1, "reported once");
    assert!(matches!(rig.tasks[1].reason, Reason::ArmHeld(1, Cause::Stale(_))));
    rig.run_until(2.0, |r| r.tasks[0].state == TaskState::Completed);
    rig.arms[1].silent = false;
    rig.run_for(1.0);
    assert_eq!(rig.phase(1), Phase::Held, "a hold is latched");
    assert_eq!(rig.arms[1].stops, 1);
}

#[test]
fn f02_a_link_that_fails_in_velocity_mode_stops_the_arm() {
    for link in [Link::Stale, Link::Faulted, Link::Down] {
        let mut rig = Rig::one_arm(vec![task("v", velocity(), 0..6, 10)]);
        for _ in 0..60 {
            rig.velocity(0, &[1.0; 6]);
            rig.tick();
        }
        let before = rig.commands[0].stop_seq;
        rig.arms[0].link = link;
        let took = rig.run_until(1.0, |r| r.commands[0].stop_seq != before);
        assert!(took <= 1.0 / A_MAX + 2.0 * rig.dt() + 1e-9, "{link:?}: {took}");
        rig.run_for(0.5);
        assert_eq!((rig.commands[0].mode, rig.commands[0].stop_seq), (None, before + 1), "{link:?}");
        rig.arms[0].link = Link::Up;
        rig.run_for(0.5);
        assert_eq!((rig.phase(0), rig.arms[0].v[0]), (Phase::Held, 0.0));
    }
}

#[test]
fn f07_requests_that_are_not_finite_are_refused() {
    let tasks = vec![task("s", servo(), 0..6, 10), task("v", velocity(), 0..6, 10), task("t", trajectory(), 0..6, 10)];
    let mut rig = Rig::one_arm(tasks);
    for unfit in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
        for k in 0..6 {
            let mut target = [0.0; 6];
            target[k] = unfit;
            let (s, v) = (rig.servo(0, &target), rig.velocity(1, &target));
            rig.tick();
            assert_eq!((rig.outcome(s), rig.outcome(v)), (Outcome::NonFinite(k as u16), Outcome::NonFinite(k as u16)));
        }
    }
    assert!(rig.tasks.iter().all(|t| t.state == TaskState::Idle));
    assert_eq!(rig.phase(0), Phase::Ready, "a refused request latches nothing");
}

#[test]
fn f07_a_spline_that_is_not_finite_is_refused() {
    let spline = |times: [f64; 2], a: f64, b: f64, v: &[f64], acc: &[f64]| {
        let point = |t: f64, p: f64| TrajectoryPoint {
            time_from_start: t,
            positions: [p][..].into(),
            velocities: v.into(),
            accelerations: acc.into(),
        };
        Spline::new(&JointTrajectory {
            joint_names: vec!["j".into()],
            points: times.map(|t| point(t, if t == 0.0 { a } else { b })).into(),
        })
    };
    assert!(spline([0.0, f64::NAN], 0.0, 1.0, &[], &[]).is_err());
    for (h, a, b, v, acc) in [
        (5e-324, 0.0, 1.0, vec![], vec![]),
        (1e-200, 0.0, 1.0, vec![], vec![]),
        (1e-80, 0.0, 1.0, vec![0.0], vec![0.0]),
        (1.0, -1e308, 1e308, vec![], vec![]),
        (1e-3, 0.0, 0.0, vec![1e308], vec![]),
    ] {
        let made = spline([0.0, h], a, b, &v, &acc);
        assert!(made.is_err(), "{h} {a} {b} {v:?} {acc:?} is accepted: {made:?}");
    }
}

#[test]
fn f07_measurements_that_are_not_finite_reach_no_command() {
    for unfit in [f64::NAN, f64::INFINITY] {
        let tasks = vec![task("t", trajectory(), 0..6, 10), task("v", velocity(), 0..6, 10)];
        let mut rig = Rig::one_arm(tasks);
        rig.execute(0, sweep(1, 0..6, 0.0, 1.0, 2.0));
        rig.run_for(0.7);
        // The last valid state is used instead; the rig checks that every command is finite.
        let q = std::mem::replace(&mut rig.arms[0].q, vec![unfit; 6]);
        let (mut states, period) = ([rig.arms[0].state], rig.config.period());
        states[0].position = joints_of(&[unfit; 6]);
        states[0].velocity = joints_of(&[unfit; 6]);
        for k in 0..5 {
            rig.now = rig.now.after(period);
            states[0].seq += 1;
            states[0].stamp = rig.now;
            rig.tick_with(&states, 0);
            assert!(rig.samples[0].state.position.iter().all(|p| p.is_finite()));
            assert_eq!(
                rig.phase(0),
                if k < 2 { Phase::Ready } else { Phase::Held },
                "the last valid state becomes stale"
            );
        }
        rig.arms[0].q = q;
        assert_eq!(rig.samples[0].cause.name(), "stale");
        assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }).name(), "ARM_LATCHED");
    }
}

#[test]
fn f07_velocities_that_are_not_finite_are_estimated() {
    let mut rig = Rig::one_arm(vec![task("t", trajectory(), 0..6, 10), task("v", velocity(), 0..6, 5)]);
    rig.velocity(1, &[0.0; 6]);
    rig.run(5);
    rig.execute(0, sweep(1, 0..6, 0.0, 0.5, 1.0));
    for _ in 0..300 {
        rig.now = rig.now.after(rig.config.period());
        let mut state = rig.arms[0].state;
        state.seq += 1;
        state.stamp = rig.now;
        state.written = rig.commands[0].seq;
        state.mode = rig.commands[0].mode.unwrap_or(state.mode);
        if rig.commands[0].mode.is_some_and(|m| m.is_position()) {
            state.position = rig.commands[0].values;
        }
        rig.arms[0].state = state;
        (rig.arms[0].written_at, rig.arms[0].written_start) = (rig.commands[0].at, rig.commands[0].start_seq);
        state.velocity = joints_of(&[f64::NAN; 6]);
        rig.tick_with(&[state], 0);
    }
    assert_eq!(rig.tasks[0].state, TaskState::Completed, "{:?}", rig.tasks[0]);
}

#[test]
fn f07_a_power_loss_is_seen_even_when_positions_are_not_finite() {
    let mut rig = Rig::one_arm(vec![task("t", trajectory(), 0..6, 10)]);
    let mut state = ArmState { enabled: false, ..rig.arms[0].state };
    state.position = joints_of(&[f64::NAN; 6]);
    rig.now = rig.now.after(rig.config.period());
    rig.tick_with(&[state], 0);
    assert_eq!((rig.phase(0), rig.samples[0].cause, rig.commands[0].mode), (Phase::Held, Cause::PowerLost, None));
}

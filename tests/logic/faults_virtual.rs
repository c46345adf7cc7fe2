//! Faults that the coordinator must withstand, on a virtual clock, each with the number that it must keep. Named
//! after the numbers of the project's table of faults. The rig checks every command of every test as well: finite,
//! within position, velocity and acceleration limits, no motion without power, modes changed at standstill. One table
//! of faults, hence the length.

use std::time::Duration;

use dimos::arm::{ArmState, Link};
use dimos::clock::Mono;
use dimos::control::config::*;
use dimos::control::coordinator::Coordinator;
use dimos::control::request::Request;
use dimos::control::tick_loop::{missed_periods, next_deadline};
use dimos::joint::{ControlMode, joints_of};
use dimos::telemetry::{Cause, Event, LimitKind, Outcome, Phase, Reason, TaskState};
use dimos::trajectory::{JointTrajectory, Spline, TrajectoryPoint};
use proptest::prelude::*;

use crate::support::rig::*;

/// A generator whose seed is its whole state, so that a failure can be repeated.
struct Random(u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: u64) -> u64 {
        self.next() % n
    }

    fn within(&mut self, lower: f64, upper: f64) -> f64 {
        lower + (upper - lower) * (self.next() >> 11) as f64 / (1u64 << 53) as f64
    }
}

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
        // 30 ms is the timeout: two missed states are ridden through, three are not.
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
fn f07_what_is_not_finite_is_refused_where_it_enters() {
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
fn f07_no_curve_is_made_that_is_not_finite() {
    let spline = |times: [f64; 2], a: f64, b: f64, v: &[f64], acc: &[f64]| {
        let point = |t: f64, p: f64| TrajectoryPoint {
            time_from_start: t,
            positions: vec![p],
            velocities: v.to_vec(),
            accelerations: acc.to_vec(),
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
        assert!(made.is_err(), "{h} {a} {b} {v:?} {acc:?} is smooth: {made:?}");
    }
}

#[test]
fn f07_measurements_that_are_not_finite_reach_no_command() {
    for unfit in [f64::NAN, f64::INFINITY] {
        let tasks = vec![task("t", trajectory(), 0..6, 10), task("v", velocity(), 0..6, 10)];
        let mut rig = Rig::one_arm(tasks);
        rig.execute(0, sweep(1, 0..6, 0.0, 1.0, 2.0));
        rig.run_for(0.7);
        // One such position is ridden through on the last state; the rig sees that no command is harmed.
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
            assert_eq!(rig.phase(0), if k < 2 { Phase::Ready } else { Phase::Held }, "they age");
        }
        rig.arms[0].q = q;
        assert_eq!(rig.samples[0].cause.name(), "stale");
        assert_eq!(rig.ask(Request::Enabled { arm: 0 }).name(), "ARM_LATCHED");
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

#[test]
fn f08_a_jump_is_refused_and_holds() {
    let mut rig = Rig::one_arm(vec![task("s", servo(), 0..6, 10)]);
    for (first, jump) in [(0.0, 0.201), (0.0, -0.3), (0.1, 3.0)] {
        rig.servo(0, &[first; 6]);
        rig.run(45);
        let mut target = [first; 6];
        target[2] += jump;
        rig.servo(0, &target);
        let before = rig.commanded(0)[2];
        rig.tick();
        assert_eq!(rig.phase(0), Phase::Held, "{jump}: {:?}", rig.tasks);
        assert_eq!(rig.samples[0].cause, Cause::Jump);
        assert!(matches!(rig.tasks[0].reason, Reason::Jump(2, by) if (by - jump).abs() < 1e-9), "{:?}", rig.tasks[0]);
        assert_eq!(rig.tasks[0].state, TaskState::Fault);
        rig.run_for(0.5);
        assert!((rig.commanded(0)[2] - before).abs() < 0.02, "it is not followed");
        let id = rig.servo(0, &[first; 6]);
        rig.tick();
        assert_eq!(rig.outcome(id), Outcome::ArmLatched(0, Cause::Jump));
        assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
        rig.make_ready();
    }
    // A stream that begins too far away is refused before it begins, and latches nothing.
    let far = rig.servo(0, &[0.5; 6]);
    rig.tick();
    assert_eq!(rig.outcome(far).name(), "START_STATE_MISMATCH");
    assert_eq!(rig.phase(0), Phase::Ready);
}

/// A jump in a slow stream must not pass because it is cut into small steps on the way to the tick.
#[test]
fn f08_a_jump_in_a_slow_stream_is_refused_too() {
    for (every, jump) in [(2, 0.25), (5, 0.5), (10, 1.0), (10, 1.8)] {
        let mut rig = Rig::one_arm(vec![task("s", servo(), 0..6, 10)]);
        for k in 0..12 {
            rig.servo(0, &[1e-3 * k as f64; 6]);
            rig.run(every);
        }
        rig.servo(0, &[jump; 6]);
        rig.tick();
        assert_eq!(rig.phase(0), Phase::Held, "a jump of {jump} rad in a stream of {} Hz", 100 / every);
        assert!(rig.arms[0].q[0] < 0.03);
    }
}

/// Ten targets a second at 1.4 rad/s are 0.14 rad apart: no jump, the joint can do that.
#[test]
fn f08_a_fast_slow_stream_is_no_jump() {
    let mut rig = Rig::one_arm(vec![task("s", servo(), 0..6, 10)]);
    let mut at = 0.0;
    for k in 0..20i32 {
        at += (0.02 * f64::from(k.min(19 - k))).min(0.14);
        rig.servo(0, &[at; 6]);
        rig.run(10);
    }
    assert_eq!(rig.phase(0), Phase::Ready, "{:?}", rig.events.last());
    rig.run(10);
    assert!((rig.arms[0].q[0] - at).abs() < 0.05);
}

#[test]
fn f08_clamped_commands_are_told_once_an_episode() {
    let mut rig = Rig::one_arm(vec![task("s", servo(), 0..1, 10)]);
    let mut target = 0.0;
    for _ in 0..40 {
        target += 0.03;
        rig.servo(0, &[target]);
        rig.tick();
    }
    assert_eq!(rig.count(|e| matches!(e, Event::Limited(0, LimitKind::Velocity, _))), 1);
    assert_eq!(rig.count(|e| matches!(e, Event::Limited(..))), 1, "{:?}", rig.events);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, failure_persistence: None, ..ProptestConfig::default() })]

    /// F08, F09: whatever a stream says, the wire keeps position, velocity and acceleration limits (the rig checks
    /// each command), and so does the arm.
    #[test]
    fn f08_f09_random_streams_keep_every_limit(
        rate in prop::sample::select(vec![50.0, 100.0, 1000.0]),
        steps in prop::collection::vec((-0.21f64..0.21, 1u64..8), 10..80),
        lag in 0.0f64..0.05,
    ) {
        let mut rig = Rig::new(rate, vec![arm("arm", 2)], vec![task("s", servo(), 0..2, 10)]);
        rig.arms[0].lag = lag;
        rig.make_ready();
        let mut target = [0.0, 0.0];
        for (k, (step, ticks)) in steps.into_iter().enumerate() {
            target[k % 2] += step;
            rig.servo(0, &target);
            rig.run(ticks);
            if rig.phase(0) == Phase::Held {
                rig.run_for(1.2);
                rig.ask(Request::Reset { arm: 0 });
                rig.make_ready();
                target = [rig.commanded(0)[0], rig.commanded(0)[1]];
            }
            prop_assert!(rig.arms[0].q.iter().all(|q| q.abs() <= SOFT + 1e-9));
        }
    }

    /// F09 in velocity mode, where the arm lags and its state is old: it still stops inside its limits.
    #[test]
    fn f09_velocities_stop_an_arm_that_lags_inside_its_limits(
        targets in prop::collection::vec((-3.0f64..3.0, 1u64..60), 1..40),
        lag in 0.0f64..0.03,
        age in 0u64..10,
    ) {
        let mut rig = Rig::new(100.0, vec![arm("arm", 1)], vec![task("v", velocity(), 0..1, 10)]);
        (rig.arms[0].lag, rig.arms[0].age) = (lag, Duration::from_millis(age));
        rig.make_ready();
        for (target, ticks) in targets {
            for _ in 0..ticks {
                rig.velocity(0, &[target]);
                rig.tick();
                prop_assert!(rig.arms[0].q[0].abs() <= RANGE, "at {}", rig.arms[0].q[0]);
            }
        }
    }
}

#[test]
fn f09_a_joint_outside_its_limits_may_always_come_in() {
    for kind in [servo(), velocity()] {
        let mut rig = Rig::new(100.0, vec![arm("arm", 1)], vec![task("t", kind.clone(), 0..1, 10)]);
        rig.arms[0].q[0] = 2.15;
        rig.make_ready();
        assert!((rig.arms[0].q[0] - 2.15).abs() < 1e-9, "held where it is");
        let out = |rig: &mut Rig, k: usize, sign: f64| {
            match kind.name.as_str() {
                "servo" => rig.servo(0, &[2.15 + sign * 0.004 * k as f64]),
                _ => rig.velocity(0, &[sign * 0.4]),
            };
            rig.tick();
        };
        (1..30).for_each(|k| out(&mut rig, k, 1.0));
        assert!(rig.arms[0].q[0] <= 2.15 + 1e-9, "not further out");
        rig.run_for(1.0);
        (1..200).for_each(|k| out(&mut rig, k, -1.0));
        assert!(rig.arms[0].q[0] < 1.9, "{}", rig.arms[0].q[0]);
    }
}

#[test]
fn f10_a_servo_stream_that_stops_is_brought_to_rest_and_let_go() {
    for (speed, timeout) in [(0.4, 0.5), (1.2, 0.1)] {
        let kind = TaskKind::new("servo", &ServoParams { timeout, default_positions: None });
        // A prediction beyond the last target is not made: the joints rest at the target long before the timeout.
        let mut rig = Rig::one_arm(vec![task("s", kind, 0..6, 10)]);
        for k in 1..60 {
            rig.servo(0, &[(speed * 0.01 * k as f64).min(1.0); 6]);
            rig.tick();
        }
        let took = rig.run_until(3.0, |r| r.tasks[0].state == TaskState::Idle);
        assert_eq!(rig.tasks[0].reason, Reason::Timeout);
        assert!((timeout..=timeout + 2.0 * rig.dt() + 1e-9).contains(&took), "{took} for {timeout}");
        let still = took + rig.run_until(3.0, |r| r.speed(0) == 0.0);
        assert!(still <= timeout + speed / A_MAX + 2.0 * rig.dt() + 1e-9, "{still}");
        assert_eq!(rig.phase(0), Phase::Ready, "a stopped stream is no fault");
        let here = rig.commanded(0);
        rig.run_for(2.0);
        assert_eq!(rig.commanded(0), here, "and holds");
        assert_eq!(rig.count(|e| *e == Event::Task(0, TaskState::Idle, Reason::Timeout)), 1);
    }
}

#[test]
fn f10_a_stream_that_was_behind_its_target_stops_too() {
    // The target ran away faster than the joint may: at the timeout the joint is still on its way, at full speed.
    let kind = TaskKind::new("servo", &ServoParams { timeout: 0.1, default_positions: None });
    let mut rig = Rig::one_arm(vec![task("s", kind, 0..1, 10)]);
    for k in 1..60 {
        rig.servo(0, &[0.03 * k as f64]);
        rig.tick();
    }
    assert!(rig.speed(0) > 0.9 * V_MAX);
    let still = rig.run_until(3.0, |r| r.speed(0) == 0.0);
    assert!(still <= 0.1 + V_MAX / A_MAX + 2.0 * rig.dt() + 1e-9, "{still}");
}

#[test]
fn f10_a_velocity_stream_that_stops_is_kept_at_zero() {
    for (timeout, zero_on_timeout) in [(0.2, true), (0.2, false), (0.05, true)] {
        let kind = TaskKind::new("velocity", &VelocityParams { timeout, zero_on_timeout });
        let mut rig = Rig::one_arm(vec![task("v", kind, 0..6, 10)]);
        for _ in 0..60 {
            rig.velocity(0, &[1.2; 6]);
            rig.tick();
        }
        assert!((rig.speed(0) - 1.2).abs() < 1e-9);
        let still = rig.run_until(3.0, |r| r.speed(0) == 0.0);
        assert!(still >= timeout && still <= timeout + 1.2 / A_MAX + 2.0 * rig.dt() + 1e-9, "{still}");
        let state = if zero_on_timeout { TaskState::Executing } else { TaskState::Idle };
        assert_eq!((rig.tasks[0].state, rig.tasks[0].reason), (state, Reason::Timeout));
        rig.run_for(1.0);
        assert_eq!(rig.tasks[0].state, state);
        assert_eq!((rig.speed(0), rig.phase(0)), (0.0, Phase::Ready));
        assert_eq!(rig.count(|e| *e == Event::Task(0, state, Reason::Timeout)), 1, "reported once");
    }
}

#[test]
fn f11_a_partial_command_leaves_the_other_joints_alone() {
    let tasks = vec![task("v", velocity(), [1], 10), task("s", servo(), [1], 10)];
    let mut rig = Rig::new(100.0, vec![arm("arm", 6)], tasks);
    rig.arms[0].q = vec![0.1, -1.2, 1.5, 0.4, -0.5, 0.6];
    rig.make_ready();
    let before = rig.arms[0].q.clone();
    for _ in 0..50 {
        rig.velocity(0, &[0.3]);
        rig.tick();
        let values = rig.commanded(0);
        if rig.commands[0].mode == Some(ControlMode::Velocity) {
            assert_eq!([values[0], values[2], values[3], values[4], values[5]], [0.0; 5]);
        }
    }
    assert!((rig.arms[0].q[1] - before[1] - 0.3 * 0.5).abs() < 0.03, "{:?}", rig.arms[0].q);
    rig.run_for(0.5);
    rig.ask(Request::Cancel { task: Some(0) });
    let at = rig.arms[0].q[1];
    for k in 1..50 {
        rig.servo(1, &[at + 1e-3 * k as f64]);
        rig.tick();
    }
    assert_eq!(rig.commands[0].mode, Some(ControlMode::ServoPosition));
    for j in [0, 2, 3, 4, 5] {
        assert!((rig.arms[0].q[j] - before[j]).abs() < 1e-9, "joint {j}: {:?} from {before:?}", rig.arms[0].q);
    }
}

#[test]
fn f11_the_mode_switch_waits_for_a_standstill() {
    let mut rig = Rig::one_arm(vec![task("s", servo(), 0..6, 5), task("v", velocity(), 0..6, 10)]);
    rig.arms[0].lag = 0.1;
    for k in 1..40 {
        rig.servo(0, &[0.01 * k as f64; 6]);
        rig.tick();
    }
    rig.velocity(1, &[0.5; 6]);
    let took = rig.run_until(1.0, |r| r.samples[0].command.mode == Some(ControlMode::Velocity));
    assert!(took > 0.2, "the arm was still moving: {took}");
    assert!(rig.arms[0].state.velocity[0].abs() <= 0.05);
}

#[test]
fn f11_an_arm_that_lacks_a_mode_comes_to_rest_instead() {
    let mut only_velocity = arm("arm", 6);
    only_velocity.modes = vec![ControlMode::Velocity];
    let tasks = vec![task("v", velocity(), 0..6, 5), task("t", trajectory(), 0..6, 10)];
    let mut rig = Rig::new(100.0, vec![only_velocity], tasks);
    rig.make_ready();
    for _ in 0..60 {
        rig.velocity(0, &[0.8; 6]);
        rig.tick();
    }
    let start = rig.arms[0].q[0];
    rig.execute(1, sweep(1, 0..6, start, 0.0, 1.0));
    rig.run_for(0.5);
    assert_eq!(rig.arms[0].v[0], 0.0);
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    /// F11: whatever sequence of tasks, modes and delays, no joint ever gets a value of the other mode. Joints
    /// are far from zero, so a position sent as a velocity breaks a limit, and the rig sees it.
    #[test]
    fn f11_random_sequences_never_mix_modes(
        steps in prop::collection::vec((0u8..7, -0.5f64..0.5, 1u64..40), 1..60),
        mode_delay in 0u32..6,
        lag in 0.0f64..0.04,
        reports_velocity: bool,
    ) {
        let tasks = vec![
            task("servo", servo(), 0..2, 10),
            task("velocity", velocity(), 0..3, 20),
            task("traj", trajectory(), 0..3, 15),
            task("velocity2", velocity(), 2..3, 15),
        ];
        let mut rig = Rig::new(100.0, vec![arm("arm", 3)], tasks);
        rig.arms[0].q = vec![1.7, -1.8, 1.6];
        (rig.arms[0].mode_delay, rig.arms[0].lag) = (mode_delay, lag);
        rig.arms[0].reports_velocity = reports_velocity;
        rig.make_ready();
        for (k, (what, value, ticks)) in steps.into_iter().enumerate() {
            let at = rig.arms[0].q.clone();
            match what {
                0 => { rig.servo(0, &[at[0] + 0.1 * value, at[1]]); }
                1 => { rig.velocity(1, &[value, -value, 0.5 * value]); }
                2 => {
                    let goal: Vec<f64> = at.iter().map(|q| (q + 0.3 * value).clamp(-1.9, 1.9)).collect();
                    let motion = motion(k as u64, &[0, 1, 2], &[(0.0, &at), (0.8, &goal)]);
                    rig.send(Request::Execute { task: 2, motion });
                }
                3 => { rig.velocity(3, &[value]); }
                4 => { rig.send(Request::Cancel { task: None }); }
                5 => { rig.send(Request::Stop { arm: None }); }
                _ => {
                    rig.send(Request::Reset { arm: 0 });
                    rig.send(Request::Enabled { arm: 0 });
                }
            }
            for _ in 0..ticks {
                rig.tick();
                if rig.commands[0].mode == Some(ControlMode::Velocity) {
                    prop_assert!(rig.commanded(0).iter().all(|v| v.abs() <= 0.5 + 1e-9));
                }
            }
        }
    }
}

#[test]
fn f13_the_higher_priority_wins_in_the_same_tick_and_the_loser_is_told_once() {
    let mut rig = Rig::one_arm(vec![task("low", trajectory(), 0..6, 10), task("high", servo(), 2..4, 20)]);
    rig.execute(0, sweep(1, 0..6, 0.0, 1.0, 2.0));
    rig.run_for(0.5);
    let at = rig.commanded(0)[2];
    rig.servo(1, &[at + 0.01, at]);
    rig.tick();
    assert_eq!(rig.tasks[0].state, TaskState::Aborted);
    assert_eq!(rig.tasks[0].reason, Reason::Preempted(1, 2));
    for k in 1..200 {
        rig.servo(1, &[at - 5e-4 * k as f64, at]);
        rig.tick();
    }
    assert_eq!(rig.count(|e| matches!(e, Event::Preempted(0, 1, 2, false))), 1);
    assert_eq!(rig.count(|e| matches!(e, Event::Preempted(..) | Event::ModeConflict(..))), 1);
    rig.run_for(2.0);
    assert_eq!(rig.tasks[0].state, TaskState::Aborted, "no silent resume");
    assert_eq!(rig.speed(0), 0.0);
}

#[test]
fn f13_a_stream_that_lost_its_joints_does_not_come_back_by_itself() {
    let mut rig = Rig::one_arm(vec![task("low", servo(), 0..6, 10), task("high", trajectory(), 0..3, 20)]);
    for _ in 0..3 {
        rig.servo(0, &[0.05; 6]);
        rig.tick();
    }
    rig.execute(1, sweep(1, 0..3, 0.0, 0.3, 0.8));
    // The stream continues with its remaining joints; the loss is reported once, not per target.
    for _ in 0..20 {
        rig.servo(0, &[0.05; 6]);
        rig.tick();
    }
    assert_eq!(rig.count(|e| matches!(e, Event::Preempted(0, 1, ..))), 1, "{:?}", rig.events);
    assert!((rig.commanded(0)[5] - 0.05).abs() < 1e-9, "joints that no other task wants remain its own");
    // It stops; the winner ends while the last target is still valid.
    rig.ask(Request::Cancel { task: Some(1) });
    rig.run(20);
    assert_eq!(rig.tasks[0].state, TaskState::Executing);
    let here = rig.commanded(0)[0];
    rig.run(5);
    assert_eq!(rig.commanded(0)[0], here, "no silent resume");
    // A new winner is reported again.
    rig.execute(1, sweep(2, 0..3, here, here + 0.1, 0.8));
    rig.servo(0, &[0.05; 6]);
    rig.tick();
    assert_eq!(rig.count(|e| matches!(e, Event::Preempted(0, 1, ..))), 2);
}

#[test]
fn f14_at_equal_priority_the_blueprints_order_wins_and_the_loser_is_told() {
    let mut rig = Rig::one_arm(vec![task("first", servo(), 0..3, 10), task("second", servo(), 2..6, 10)]);
    rig.servo(1, &[-0.05; 4]);
    rig.run(30);
    rig.servo(0, &[0.05; 3]);
    rig.servo(1, &[-0.05; 4]);
    rig.tick();
    assert!(rig.reported(Event::Preempted(1, 0, 2, true)));
    rig.run(45);
    assert!((rig.arms[0].q[2] - 0.05).abs() < 1e-9 && (rig.arms[0].q[3] + 0.05).abs() < 1e-9);
    let mut rig = Rig::one_arm(vec![task("first", velocity(), 0..3, 10), task("second", trajectory(), 3..6, 10)]);
    rig.velocity(0, &[0.2; 3]);
    rig.execute(1, sweep(1, 3..6, 0.0, 0.5, 1.0));
    assert!(rig.reported(Event::ModeConflict(1, 0, 0)), "one mode per arm: {:?}", rig.events);
    assert_eq!(rig.tasks[1].state, TaskState::Aborted);
}

/// What goes out of a random scenario, as bits.
fn scenario(seed: u64, ticks: u64) -> Vec<u64> {
    let mut random = Random(seed);
    let tasks = vec![
        task("a", servo(), 0..7, 10),
        task("b", servo(), 4..7, 10),
        task("c", velocity(), 7..13, 10),
        task("d", trajectory(), 0..13, 15),
        task("e", trajectory(), 7..13, 10),
    ];
    let mut rig = Rig::new(100.0, vec![arm("left", 7), arm("right", 6)], tasks);
    rig.arms[0].lag = 0.02;
    rig.arms[1].reports_velocity = false;
    rig.make_ready();
    let mut bits = Vec::new();
    for k in 0..ticks {
        let v = random.within(-0.3, 0.3);
        match random.below(60) {
            0..=9 => _ = rig.servo(0, &[0.5 * v; 7]),
            10..=15 => _ = rig.servo(1, &[-0.5 * v; 3]),
            16..=25 => _ = rig.velocity(2, &[v; 6]),
            26 => _ = rig.send(Request::Execute { task: 3, motion: sweep(k, 0..13, rig.arms[0].q[0], v, 1.0) }),
            27 => _ = rig.send(Request::Execute { task: 4, motion: sweep(k, 7..13, rig.arms[1].q[0], v, 0.9) }),
            28 => _ = rig.send(Request::Cancel { task: None }),
            29 => _ = rig.send(Request::Stop { arm: Some(random.below(2) as u16) }),
            30..=33 => {
                for arm in 0..2 {
                    rig.send(Request::Reset { arm });
                    rig.send(Request::Enabled { arm });
                }
            }
            34 => rig.arms[0].silent = random.below(2) == 0,
            35 => rig.arms[1].error = random.below(2) as i32,
            _ => {}
        }
        rig.tick_after(if random.below(200) == 0 { random.below(4) as u32 } else { 0 });
        for command in &rig.commands {
            bits.extend(command.values.iter().map(|v| v.to_bits()));
            bits.push(command.mode.map_or(99, |m| m as u64) << 32 | command.stop_seq as u64);
        }
    }
    bits.extend(
        rig.events
            .iter()
            .map(|(tick, e)| tick ^ format!("{e:?}").bytes().fold(7u64, |h, b| h.wrapping_mul(31) ^ b as u64)),
    );
    bits
}

#[test]
fn f14_the_same_inputs_give_the_same_commands_for_any_seed() {
    for seed in 0..250 {
        assert!(scenario(seed, 40) == scenario(seed, 40), "seed {seed}");
    }
}

#[test]
fn a_long_random_scenario_is_repeated_bit_for_bit() {
    let seed = std::env::var("DIMOS_TEST_SEED").ok().and_then(|s| s.parse().ok());
    let seed = seed.unwrap_or_else(|| u64::from(std::process::id()));
    println!("DIMOS_TEST_SEED={seed}");
    assert!(scenario(seed, 10_000) == scenario(seed, 10_000), "DIMOS_TEST_SEED={seed}");
}

#[test]
fn f20_skipped_periods_are_reported_and_not_made_up_for() {
    let mut rig = Rig::one_arm(vec![task("t", trajectory(), 0..6, 10)]);
    rig.execute(0, sweep(1, 0..6, 0.0, 1.0, 2.0));
    rig.run_for(0.5);
    let before = rig.commanded(0)[0];
    rig.arms[0].age = Duration::ZERO;
    rig.tick_after(5);
    assert!(rig.reported(Event::Overrun(5, 50_000_000)));
    assert!(rig.commanded(0)[0] - before <= V_MAX * rig.dt(), "one step, not six");
    assert_eq!(rig.tasks[0].state, TaskState::Executing, "50 ms are ridden through");
    rig.tick_after(8);
    assert_eq!(rig.phase(0), Phase::Ready, "90 ms between two ticks as well");
    rig.tick_after(9);
    assert_eq!((rig.phase(0), rig.samples[0].cause), (Phase::Held, Cause::Overrun), "100 ms are not");
    assert_eq!(rig.tasks[0].reason, Reason::ArmHeld(0, Cause::Overrun));
    rig.run_for(0.5);
    assert_eq!(rig.speed(0), 0.0);
}

#[test]
fn f20_all_arms_hold_after_100_ms_at_every_rate() {
    for rate in [20.0, 100.0, 250.0, 500.0, 1000.0, 2000.0] {
        let mut rig = Rig::new(rate, vec![arm("a", 6), arm("b", 6)], vec![]);
        rig.make_ready();
        rig.tick_after(((0.1 * rate) as u32).saturating_sub(2));
        assert!(rig.samples.iter().all(|s| s.phase == Phase::Ready), "{rate}");
        rig.tick_after((0.1 * rate) as u32);
        assert!(rig.samples.iter().all(|s| s.cause == Cause::Overrun), "{rate}");
    }
}

#[test]
fn f20_ten_overruns_in_a_row_are_degraded() {
    let mut rig = Rig::one_arm(vec![]);
    (0..9).for_each(|_| rig.tick_after(1));
    rig.tick();
    (0..9).for_each(|_| rig.tick_after(1));
    assert!(!rig.reported(Event::Degraded), "nine in a row are not ten");
    (0..5).for_each(|_| rig.tick_after(1));
    assert_eq!(rig.count(|e| *e == Event::Degraded), 1);
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    /// F20: however late the wake-ups, no two ticks come less than half a period apart, every period is accounted
    /// for, and the time that ticks work with never stalls or runs ahead.
    #[test]
    fn f20_no_two_ticks_within_half_a_period(lateness in prop::collection::vec(0u64..40_000_000, 1..300)) {
        let period = Duration::from_millis(10);
        let start = Mono(1_000_000_000);
        let (mut deadline, mut now, mut skips_before) = (start, start, 0);
        let (mut ticks, mut skipped, mut last): (u64, u64, Option<(Mono, Mono)>) = (0, 0, None);
        for late in lateness {
            // Most wake-ups are punctual; a sleep never ends early, and a deadline in the past ends it at once.
            let late = if late % 3 == 0 { late } else { late % 100_000 };
            now = now.max(deadline).after(Duration::from_nanos(late));
            let missed = missed_periods(deadline, now, period);
            let used = deadline.after(period * missed);
            let (next, skips_after) = next_deadline(used, now, period);
            prop_assert!(used <= now && next > now);
            prop_assert!(next.since(now) >= period / 2, "two ticks {:?} apart", next.since(now));
            if let Some((last_used, _)) = last {
                prop_assert!(used > last_used);
            }
            skipped += u64::from(skips_before + missed);
            ticks += 1;
            prop_assert_eq!(used.since(start), period * (ticks - 1 + skipped) as u32);
            last = Some((used, now));
            (deadline, skips_before) = (next, skips_after);
        }
    }
}

#[test]
fn f36_a_start_elsewhere_names_joint_and_amount_and_moves_nothing() {
    let mut rig = Rig::one_arm(vec![task("t", trajectory(), 0..6, 10)]);
    for (joint, off, fits) in [(4, 0.051, false), (2, -0.3, false), (0, 0.049, true)] {
        let mut start = [0.0; 6];
        start[joint] = off;
        let before = rig.commanded(0);
        let outcome = rig.execute(0, motion(1, &[0, 1, 2, 3, 4, 5], &[(0.0, &start), (1.0, &[0.1; 6])]));
        if fits {
            assert_eq!(outcome, Outcome::Accepted);
            continue;
        }
        let Outcome::StartStateMismatch(j, by) = outcome else { panic!("{outcome:?}") };
        assert!(j == joint as u16 && (by - off.abs()).abs() < 1e-9, "{outcome:?}");
        assert_eq!(rig.retired, [1]);
        rig.retired.clear();
        rig.run(10);
        assert_eq!(rig.commanded(0), before);
    }
}

#[test]
fn a_coordinator_without_arms_or_tasks_ticks() {
    let config = CoordinatorConfig { version: CONFIG_VERSION, rate: 100.0, arms: vec![], tasks: vec![] };
    let rig = Rig::new(100.0, vec![], vec![]);
    let time =
        dimos::control::coordinator::TickTime { now: rig.now, next: rig.now, skipped: 0, late_ns: 0, woke_late_ns: 0 };
    assert!(Coordinator::new(&config, Vec::new()).tick(time, &[], || None).commands.is_empty());
}

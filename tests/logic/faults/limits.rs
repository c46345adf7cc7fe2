//! F08, F09, F10 and F36: targets beyond the limits, streams that end, trajectories that start elsewhere.

use std::time::Duration;

use dimos::control::config::{ServoParams, TaskKind, VelocityParams};
use dimos::control::request::Request;
use dimos::telemetry::{Cause, Event, LimitKind, Outcome, Phase, Reason, TaskState};
use proptest::prelude::*;

use crate::support::rig::*;

/// Sends the same target at this many ticks' distance until the arm is held, for at most 1 s. Returns the outcomes.
fn insist(rig: &mut Rig, target: &[f64], every: u64) -> Vec<Outcome> {
    let mut outcomes = Vec::new();
    while rig.phase(0) == Phase::Ready && (outcomes.len() as u64) < 100 / every {
        let id = rig.servo(0, target);
        rig.run(every);
        outcomes.push(rig.outcome(id));
    }
    outcomes
}

#[test]
fn f08_targets_out_of_reach_are_refused_and_hold_after_a_while() {
    let mut rig = Rig::one_arm(vec![task("s", servo(), 0..6, 10)]);
    for (first, jump) in [(0.0, 0.9), (0.0, -1.2), (0.1, 3.0)] {
        (0..45).for_each(|_| {
            rig.servo(0, &[first; 6]);
            rig.tick();
        });
        let mut target = [first; 6];
        target[2] += jump;
        let before = rig.commanded(0)[2];
        let outcomes = insist(&mut rig, &target, 1);
        assert_eq!(rig.phase(0), Phase::Held, "{jump}: {:?}", rig.tasks);
        assert_eq!(rig.samples[0].cause, Cause::Jump);
        assert!((10..=22).contains(&outcomes.len()), "held after {} targets in as many 10 ms", outcomes.len());
        let refused = |o: &Outcome| matches!(o, Outcome::OutOfReach(2, by) if (by - jump).abs() < 1e-9);
        assert!(outcomes[..outcomes.len() - 1].iter().all(refused), "{outcomes:?}");
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

/// A joystick, a network or a policy makes one wrong target now and then: the stream continues without it.
#[test]
fn f08_single_targets_out_of_reach_are_left_out() {
    for (every, jump) in [(1, 0.25), (3, -0.6), (5, 0.9), (10, 1.8)] {
        let mut rig = Rig::one_arm(vec![task("s", servo(), 0..6, 10)]);
        let mut refused = 0;
        for k in 0..60u32 {
            let smooth = 0.3 * (0.1 * f64::from(k)).sin();
            let target = if k % 7 == 5 { smooth + jump } else { smooth };
            let id = rig.servo(0, &[target, smooth, smooth, smooth, smooth, smooth]);
            rig.run(every);
            refused += u32::from(matches!(rig.outcome(id), Outcome::OutOfReach(0, _)));
            assert_eq!(rig.phase(0), Phase::Ready, "{:?}", rig.tasks);
            assert!((rig.commanded(0)[0] - rig.commanded(0)[1]).abs() < 0.08, "{jump}: {:?}", rig.commanded(0));
        }
        assert_eq!(refused, 8, "a jump of {jump} rad in a stream of {} Hz", 100 / every);
    }
}

/// Interpolation between the targets of a slow stream must not hide a jump.
#[test]
fn f08_a_jump_in_a_slow_stream_is_refused_too() {
    for (every, jump) in [(2, 0.25), (5, 0.5), (10, 1.0), (10, 1.8)] {
        let mut rig = Rig::one_arm(vec![task("s", servo(), 0..6, 10)]);
        for k in 0..12 {
            rig.servo(0, &[1e-3 * k as f64; 6]);
            rig.run(every);
        }
        // As long as the joint cannot be there since the last target that counts.
        let outcomes = insist(&mut rig, &[jump; 6], every);
        assert!(matches!(outcomes[0], Outcome::OutOfReach(..)), "{outcomes:?}");
        assert!(rig.arms[0].q[0] < 0.25 || rig.phase(0) == Phase::Ready, "{jump}: {:?}", rig.arms[0].q);
    }
}

/// A network loses some targets of a stream at speed: the arm continues to the next one within its limits.
#[test]
fn f08_after_lost_targets_the_stream_goes_on_within_limits() {
    for lost in [1, 2, 3, 4, 6] {
        let mut rig = Rig::one_arm(vec![task("s", servo(), 0..1, 10)]);
        let at = |k: u32| 0.6 * (1.0 - (2.0 * f64::from(k) / 30.0).cos());
        for k in (0..95).filter(|k| !(18..18 + lost).contains(&(k % 30))) {
            // 30 Hz on a tick of 100 Hz.
            let id = rig.servo(0, &[at(k)]);
            let next = (k + 1..).find(|k| !(18..18 + lost).contains(&(k % 30))).unwrap();
            rig.run(u64::from(next * 10 / 3 - k * 10 / 3));
            assert_eq!(rig.outcome(id), Outcome::Accepted, "{lost} lost, target {k}");
            assert_eq!(rig.phase(0), Phase::Ready, "{lost} lost: {:?}", rig.tasks);
        }
        rig.run(30);
        assert!((rig.commanded(0)[0] - at(94)).abs() < 0.01, "{lost} lost: {:?}", rig.commanded(0));
    }
}

/// Targets at 10 Hz and 1.4 rad/s are 0.14 rad apart, within what the joint can do: not a jump.
#[test]
fn f08_fast_motion_in_a_slow_stream_is_no_jump() {
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
fn f08_limited_commands_are_reported_once_an_episode() {
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

    /// F08, F09: for any stream, commands keep the limits of position, velocity and acceleration (the rig checks each
    /// command), and so does the arm.
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

    /// F09 in velocity mode: an arm that lags, with a delayed state, still stops inside its limits.
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
        let mut outside = arm("arm", 1);
        outside.supervision.outside = 0.16;
        let mut rig = Rig::new(100.0, vec![outside], vec![task("t", kind.clone(), 0..1, 10)]);
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
        let mut fastest = 0.0f64;
        for k in 1..300 {
            out(&mut rig, k, -1.0);
            fastest = fastest.max(if rig.arms[0].q[0] > RANGE { rig.speed(0) } else { 0.0 });
        }
        assert!(rig.arms[0].q[0] < 1.9, "{}", rig.arms[0].q[0]);
        assert!(fastest <= 0.1 + 1e-9, "back slowly: {fastest} rad/s");
    }
}

#[test]
fn f10_after_a_servo_stream_ends_its_joints_decelerate_and_are_released() {
    for (speed, timeout) in [(0.4, 0.5), (1.2, 0.1)] {
        let kind = TaskKind::new("servo", &ServoParams { timeout, default_positions: None });
        // Targets are not extrapolated: the joints are at rest at the last target long before the timeout.
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
fn f10_joints_still_behind_their_target_decelerate_too() {
    // The targets were faster than the joint: at the timeout it still moves at full speed.
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
fn f36_a_start_elsewhere_is_refused_with_joint_and_amount() {
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

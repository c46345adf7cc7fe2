//! What the tick does when commands do not reach an arm, when measurements cannot be true, and when an arm does not
//! follow: on a virtual clock. Every command is also checked by the rig.

use std::time::Duration;

use dimos::control::config::{ArmConfig, TaskConfig};
use dimos::control::request::Request;
use dimos::joint::ControlMode;
use dimos::telemetry::{Cause, Event, Outcome, Phase, Reason, TaskState};

use crate::support::rig::*;

const P: f64 = 0.01;

/// One arm with these figures: lag [s], accuracy [rad].
fn figured(lag: f64, accuracy: f64) -> ArmConfig {
    let mut config = arm("arm", 6);
    (config.supervision.lag, config.supervision.accuracy) = (lag, accuracy);
    config
}

fn ready(config: ArmConfig, tasks: Vec<TaskConfig>) -> Rig {
    let mut rig = Rig::new(100.0, vec![config], tasks);
    rig.make_ready();
    rig
}

/// The largest commanded acceleration and jerk of joint 1 over some ticks from rest, by differences [rad/s², rad/s³].
fn steepest(rig: &mut Rig, ticks: u32) -> (f64, f64) {
    let (mut q, mut v, mut a) = (rig.commanded(0)[0], 0.0, 0.0);
    let (mut most_a, mut most_j) = (0.0f64, 0.0f64);
    for _ in 0..ticks {
        rig.tick();
        let now = rig.commanded(0)[0];
        let (v2, a2) = ((now - q) / P, ((now - q) / P - v) / P);
        (most_a, most_j) = (most_a.max(a2.abs()), most_j.max((a2 - a).abs() / P));
        (q, v, a) = (now, v2, a2);
    }
    (most_a, most_j)
}

#[test]
fn after_a_gap_a_motion_goes_on_from_what_was_written_within_acceleration_and_jerk() {
    for lost in 2..=4 {
        let mut config = figured(0.05, 0.005);
        config.limits.jerk_max = vec![40.0; 6];
        config.supervision.stale_after = Duration::from_millis(80);
        let mut rig = ready(config, one(trajectory()));
        rig.execute(0, sweep(1, 0..6, 0.0, 1.5, 2.0));
        rig.run_for(1.0);
        assert!(rig.speed(0) > 1.0, "{}", rig.speed(0));
        rig.arms[0].deaf = true;
        rig.run(lost);
        let written = rig.arms[0].written.clone().unwrap();
        assert_eq!(rig.commanded(0) == written, lost > 2, "{lost}: it waits at what was written");
        rig.arms[0].deaf = false;
        rig.tick();
        let (a, j) = steepest(&mut rig, 25);
        rig.run_until(4.0, |rig| rig.tasks[0].state != TaskState::Executing);
        assert_eq!((rig.tasks[0].state, rig.phase(0)), (TaskState::Completed, Phase::Ready), "{:?}", rig.tasks[0]);
        assert!((rig.commanded(0)[0] - 1.5).abs() < 1e-12);
        if lost > 2 {
            assert!(a <= A_MAX * 1.001 && j <= 40.0 * 1.6, "lost {lost}: {a} rad/s², {j} rad/s³");
        }
    }
}

#[test]
fn a_stream_goes_on_after_a_gap_and_is_no_jump() {
    let mut config = figured(0.05, 0.005);
    config.supervision.stale_after = Duration::from_millis(150);
    let mut rig = ready(config, one(servo()));
    for k in 0..250 {
        let target = 1.4 * (P * f64::from(k)).min(1.2);
        rig.servo(0, &[target; 6]);
        rig.arms[0].deaf = (60..72).contains(&k);
        rig.tick();
    }
    assert_eq!((rig.phase(0), rig.tasks[0].state), (Phase::Ready, TaskState::Executing));
    assert!((rig.arms[0].q[0] - 1.4 * 1.2).abs() < 1e-6);
}

#[test]
fn a_setpoint_that_is_written_after_its_gap_was_noticed_is_where_the_arm_waits() {
    let mut config = figured(0.05, 0.005);
    config.supervision.stale_after = Duration::from_millis(80);
    let mut rig = ready(config, one(trajectory()));
    rig.execute(0, sweep(1, 0..6, 0.0, 1.5, 2.0));
    rig.run_for(1.0);
    rig.arms[0].deaf = true;
    rig.run(2);
    let late = rig.commands[0];
    rig.tick();
    assert_eq!(rig.commanded(0), rig.arms[0].written.clone().unwrap(), "a gap");
    rig.arms[0].state.written = late.seq;
    // For the rig this is no gap.
    rig.checked = false;
    rig.tick();
    assert_eq!(rig.commands[0].values, late.values);
}

#[test]
fn a_gap_ends_once_the_arm_has_rested_where_it_was_sent_last() {
    let mut rig = ready(figured(0.05, 0.005), one(servo()));
    rig.arms[0].deaf = true;
    rig.run(2);
    rig.arms[0].deaf = false;
    // In this tick the last setpoint that was written is three periods old.
    rig.tick();
    for k in 0..12 {
        rig.servo(0, &[0.01; 6]);
        rig.tick();
        assert_eq!(rig.commanded(0)[0] > 0.0, k >= 5, "{k}: 50 ms at rest");
    }
}

#[test]
fn an_arm_that_cannot_be_reached_is_held_where_it_was_sent_last() {
    let mut rig = ready(figured(0.05, 0.005), one(trajectory()));
    rig.execute(0, sweep(1, 0..6, 0.0, 1.5, 2.0));
    rig.run_for(1.0);
    (rig.arms[0].deaf, rig.arms[0].silent) = (true, true);
    rig.run(30);
    assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "stale"));
    let (written, rest) = (rig.arms[0].written.clone().unwrap(), rig.arms[0].q[0]);
    assert!((written[0] - rest).abs() < 1e-9);
    (rig.arms[0].deaf, rig.arms[0].silent) = (false, false);
    rig.run_for(1.0);
    assert_eq!(rig.arms[0].q[0], rest, "nothing moves it when it can be reached again");
    assert!(rig.arms[0].stops >= 1 && rig.commands[0].mode.is_none());
}

#[test]
fn the_last_point_of_a_trajectory_is_commanded() {
    for seconds in [1.2, 1.503, 1.397] {
        let mut rig = ready(figured(0.05, 0.005), one(trajectory()));
        rig.execute(0, sweep(1, 0..6, 0.0, 0.7, seconds));
        rig.run_until(4.0, |rig| rig.tasks[0].state == TaskState::Completed);
        assert!(rig.arms[0].q.iter().all(|q| (q - 0.7).abs() < 1e-12), "{:?}", rig.arms[0].q);
    }
}

#[test]
fn an_arm_that_lags_is_not_taken_for_one_that_does_not_follow() {
    for lag in [0.03, 0.06, 0.15] {
        let mut config = figured(lag * 1.5, 0.005);
        config.supervision.tracking_tolerance = 0.15;
        let mut rig = ready(config, vec![task("t", trajectory(), 0..6, 10), task("v", velocity(), 0..6, 5)]);
        // A first-order lag, which is late by its time constant.
        rig.arms[0].lag = lag;
        for to in [1.8, -1.8] {
            let from = rig.commanded(0)[0];
            assert_eq!(
                rig.execute(0, sweep(1, 0..6, from, to, (to - from).abs() * 1.5 / V_MAX + 0.2)),
                Outcome::Accepted
            );
            rig.run_until(9.0, |rig| rig.tasks[0].state != TaskState::Executing);
            assert_eq!(
                (rig.tasks[0].state, rig.phase(0)),
                (TaskState::Completed, Phase::Ready),
                "{lag}: {:?}",
                rig.tasks[0]
            );
        }
        for k in 0..150 {
            rig.velocity(1, &[if k < 75 { V_MAX } else { -V_MAX }; 6]);
            rig.tick();
        }
        assert_eq!(rig.phase(0), Phase::Ready, "{lag}: {:?}", rig.samples[0].cause);
    }
}

/// Blocks joint 1 of an arm under a stream until it is held. Returns the rig and where the joint was blocked.
fn blocked(config: ArmConfig, speed: f64, stop_takes_hold: bool) -> (Rig, f64) {
    let mut rig = ready(config, one(servo()));
    rig.arms[0].stop_takes_hold = stop_takes_hold;
    let (mut target, mut blocked_at) = (0.0, 0.0);
    for k in 0..200 {
        target += speed * P;
        rig.servo(0, &[target, 0.0, 0.0, 0.0, 0.0, 0.0]);
        if k == 60 {
            rig.arms[0].blocked = true;
            blocked_at = rig.arms[0].q[0];
        }
        rig.tick();
        if rig.phase(0) == Phase::Held {
            break;
        }
    }
    assert!(matches!(rig.samples[0].cause, Cause::Tracking(0, by) if by < -0.15), "{:?}", rig.samples[0].cause);
    (rig, blocked_at)
}

#[test]
fn a_blocked_joint_holds_the_arm_and_does_not_lunge_when_its_own_stop_has_taken_hold() {
    for speed in [0.3, 0.8, 1.4] {
        let (mut rig, blocked_at) = blocked(figured(0.05, 0.005), speed, true);
        rig.run_for(1.2);
        assert!(rig.arms[0].stops >= 1 && rig.commands[0].mode.is_none());
        rig.arms[0].blocked = false;
        rig.run_for(1.0);
        assert!((rig.arms[0].q[0] - blocked_at).abs() <= 0.01, "{speed}");
    }
}

#[test]
fn the_setpoint_of_a_blocked_joint_is_taken_back_once_by_the_relief_after_the_stop() {
    for speed in [0.3, 0.8, 1.4] {
        let mut config = figured(0.05, 0.005);
        config.supervision.relief = 0.04;
        let (mut rig, blocked_at) = blocked(config, speed, false);
        rig.run_until(2.0, |rig| rig.arms[0].stops == 1);
        let stopped_at = rig.arms[0].setpoint.clone().unwrap()[0];
        rig.run_for(2.0);
        let setpoint = rig.arms[0].setpoint.clone().unwrap()[0];
        assert!(stopped_at > blocked_at + 0.15, "{speed}: the stop comes first, where the setpoint is");
        assert!((stopped_at - setpoint - 0.04).abs() < 1e-9, "{speed}: {stopped_at} then {setpoint}");
        assert_eq!((rig.arms[0].stops, rig.commands[0].mode), (2, None), "{speed}: and a stop again");
        rig.run_for(2.0);
        assert_eq!(rig.arms[0].setpoint.clone().unwrap()[0], setpoint, "{speed}: once");
    }
}

#[test]
fn no_setpoint_is_taken_back_after_an_operators_stop() {
    let mut config = figured(0.05, 0.005);
    config.supervision.relief = 0.04;
    let mut rig = ready(config, one(servo()));
    for k in 1..=80 {
        rig.arms[0].sag = 0.001 * f64::from(k);
        rig.tick();
    }
    rig.run_for(0.5);
    assert_eq!(rig.phase(0), Phase::Ready);
    rig.ask(Request::Stop { arm: None });
    rig.run_for(2.0);
    assert_eq!((rig.arms[0].setpoint.clone().unwrap()[0], rig.arms[0].stops), (0.0, 1));
}

#[test]
fn a_reading_that_slips_without_end_does_not_move_a_held_arm() {
    for relief in [0.0, 0.04] {
        for velocity in [true, false] {
            let mut config = figured(0.05, 0.005);
            config.supervision.relief = relief;
            let mut rig = ready(config, one(servo()));
            rig.arms[0].reports_velocity = velocity;
            let mut slip = 0.0;
            for k in 0..1500 {
                // A reading that moves on its own while its velocity says nothing, and then with the arm.
                slip += if k > 100 && slip < 0.6 { 0.004 } else { 0.0 };
                let mut states = [rig.arms[0].observe(rig.now.after(rig.config.period()))];
                states[0].position[0] += slip;
                rig.now = rig.now.after(rig.config.period());
                if k == 900 {
                    rig.send(Request::Stop { arm: None });
                }
                rig.tick_with(&states, 0);
                let (command, dt) = (rig.commands[0], rig.dt());
                rig.arms[0].execute_command(&command, dt);
            }
            let stops = rig.arms[0].stops;
            assert_eq!(rig.phase(0), Phase::Held, "{relief} {velocity}");
            assert!(stops >= 2, "the arm's own stop, and the operator's: {stops}");
            assert!(rig.arms[0].q[0].abs() <= relief + 1e-9, "{relief} {velocity}: {}", rig.arms[0].q[0]);
        }
    }
}

#[test]
fn an_arm_that_does_not_come_to_rest_is_stopped_all_the_same() {
    // A period of 2^-7 s adds up without rounding.
    let mut config = figured(0.05, 0.005);
    config.read_period = Duration::from_nanos(7_812_500);
    let mut rig = Rig::new(128.0, vec![config], one(servo()));
    rig.make_ready();
    let stops = rig.arms[0].stops;
    for k in 1..=64 {
        rig.servo(0, &[0.5 * f64::from(k) / 128.0; 6]);
        rig.tick();
    }
    rig.send(Request::Stop { arm: Some(0) });
    rig.run_until(1.0, |rig| rig.phase(0) == Phase::Held && rig.speed(0) == 0.0);
    // Each tick finds its joints in motion, by less than anything that is supervised.
    let ticks = (0..200).find(|k| {
        rig.arms[0].sag = 0.0005 * (k % 2) as f64;
        rig.tick();
        rig.arms[0].stops > stops
    });
    assert!(ticks.is_some_and(|ticks| (34..=42).contains(&ticks)), "38 ticks are 0.3 s: {ticks:?}");
}

#[test]
fn a_reading_that_is_not_believed_restarts_the_time_of_a_tracking_error() {
    let held_after = |wrong_reading: Option<u64>| {
        let mut rig = ready(figured(0.05, 0.005), one(servo()));
        rig.arms[0].blocked = true;
        (1..100)
            .find(|k| {
                rig.servo(0, &[0.01 * *k as f64; 6]);
                if wrong_reading == Some(*k) {
                    rig.arms[0].q[0] += 1.0;
                }
                rig.tick();
                if wrong_reading == Some(*k) {
                    rig.arms[0].q[0] -= 1.0;
                }
                rig.phase(0) == Phase::Held
            })
            .expect("held at last")
    };
    let usual = held_after(None);
    assert_eq!(held_after(Some(usual - 2)), usual - 2 + 11, "0.1 s from the next good reading");
}

#[test]
fn an_idle_arm_that_is_pushed_is_held() {
    let mut rig = ready(figured(0.05, 0.005), one(servo()));
    rig.arms[0].sag = 0.0;
    for _ in 0..60 {
        rig.arms[0].sag += 0.01; // its joints give way, slowly enough to be believed
        rig.tick();
    }
    assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "tracking"));
}

#[test]
fn in_velocity_mode_a_joint_that_does_not_follow_holds_the_arm() {
    let mut rig = ready(figured(0.05, 0.005), one(velocity()));
    for k in 0..200 {
        rig.velocity(0, &[0.9, 0.0, 0.0, 0.0, 0.0, 0.0]);
        rig.arms[0].blocked = k > 60;
        rig.tick();
    }
    assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "tracking"));
}

#[test]
fn an_arm_braked_by_velocities_goes_on_braking_after_a_short_gap() {
    let mut config = figured(0.05, 0.005);
    config.limits.acceleration_max = vec![1.0; 6];
    config.supervision.stale_after = Duration::from_millis(85);
    let mut rig = ready(config, one(velocity()));
    for _ in 0..150 {
        rig.velocity(0, &[0.8; 6]);
        rig.tick();
    }
    rig.ask(Request::Stop { arm: Some(0) });
    rig.run_for(0.3);
    let stops = rig.arms[0].stops;
    rig.arms[0].deaf = true;
    rig.run(4);
    rig.arms[0].deaf = false;
    rig.run_until(2.0, |rig| rig.arms[0].stops > stops);
    let last = rig.arms[0].written.clone().unwrap();
    assert!(last[0].abs() < 1e-9, "the stop came at {} rad/s", last[0]);
    // A gap as long as an age limit: the stop is all that is left.
    assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
    rig.make_ready();
    for _ in 0..150 {
        rig.velocity(0, &[-0.8; 6]);
        rig.tick();
    }
    assert!(rig.arms[0].v[0] < -0.7, "{:?}", rig.arms[0].v);
    rig.ask(Request::Stop { arm: Some(0) });
    let stops = rig.commands[0].stop_seq;
    rig.arms[0].deaf = true;
    rig.run(9);
    assert!(rig.commands[0].stop_seq > stops);
}

#[test]
fn a_wrong_reading_is_not_believed_and_three_that_agree_are_a_jump() {
    let mut rig = ready(figured(0.05, 0.005), one(servo()));
    rig.arms[0].q = vec![0.4; 6];
    rig.arms[0].setpoint = None;
    // Believed only while nothing is commanded: here it holds, so a jump of 0.4 rad is refused at first.
    rig.tick();
    assert_eq!(rig.phase(0), Phase::Ready);
    assert_eq!(rig.samples[0].state.position[0], 0.4, "the log has what was read");
    rig.arms[0].q = vec![0.0; 6];
    rig.run(5);
    assert_eq!(rig.phase(0), Phase::Ready, "once is no jump");
    rig.arms[0].blocked = true; // it stays there, whatever is commanded
    rig.arms[0].q = vec![0.4; 6];
    rig.run(4);
    let Cause::PositionJump(_, by) = rig.samples[0].cause else { panic!("{:?}", rig.samples[0].cause) };
    assert!((by - 0.4).abs() < 1e-9);
    assert_eq!(rig.phase(0), Phase::Held);
    rig.run_for(0.5);
    let setpoint = rig.arms[0].setpoint.clone().unwrap()[0];
    assert!(setpoint.abs() < 0.02, "no setpoint is made from a position that jumped: {setpoint}");
    assert_eq!(
        rig.ask(Request::Enabled { arm: 0, outside: false }),
        Outcome::ArmLatched(0, Cause::PositionJump(0, by))
    );
    assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
}

#[test]
fn an_arm_that_moves_while_it_is_enabled_is_held() {
    let mut rig = Rig::new(100.0, vec![figured(0.05, 0.005)], one(servo()));
    rig.run(2);
    assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
    for _ in 0..10 {
        rig.arms[0].q.iter_mut().for_each(|q| *q += 0.0043);
        rig.arms[0].setpoint = None;
        rig.arms[0].deaf = true;
        rig.tick();
    }
    assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "moved_while_activating"));
}

#[test]
fn a_mode_or_power_that_nobody_here_ordered_holds_the_arm_and_is_left_alone() {
    use dimos::arm::Interference;
    for (interference, cause) in [(Interference::Mode, "mode_changed"), (Interference::Power, "power_changed")] {
        let mut rig = ready(figured(0.05, 0.005), one(servo()));
        let stops = rig.arms[0].stops;
        rig.arms[0].state.interference = interference;
        rig.run(20);
        assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, cause));
        assert_eq!((rig.commands[0].mode, rig.arms[0].stops), (None, stops), "neither setpoints nor a stop");
    }
    let mut rig = Rig::new(100.0, vec![figured(0.05, 0.005)], one(servo()));
    rig.arms[0].enabled = false;
    rig.run(3);
    assert_eq!(rig.phase(0), Phase::Disabled);
    (rig.arms[0].enabled, rig.arms[0].state.interference) = (true, Interference::Power);
    rig.run(2);
    assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "power_changed"));
}

#[test]
fn velocities_stop_inside_the_range_however_seldom_states_come() {
    for every in [1, 2, 5, 10] {
        let mut config = figured(0.03, 0.005);
        config.read_period = Duration::from_millis(10 * every);
        config.supervision.stale_after = Duration::from_millis(35 * every);
        let mut rig = ready(config, one(velocity()));
        rig.arms[0].lag = 0.02;
        let mut furthest = 0.0f64;
        for k in 0..1200u64 {
            let to = if k / 400 % 2 == 0 { V_MAX } else { -V_MAX };
            rig.velocity(0, &[to; 6]);
            rig.arms[0].silent = k % every != 0;
            rig.tick();
            furthest = furthest.max(rig.arms[0].q[0].abs());
        }
        assert_eq!(rig.phase(0), Phase::Ready, "{every}: {:?}", rig.samples[0].cause);
        assert!(furthest <= RANGE && furthest > 1.2, "states every {} ms: {furthest}", 10 * every);
    }
}

#[test]
fn a_stall_of_this_computer_is_not_the_arms_silence() {
    for skipped in [1, 3, 5, 8] {
        let mut rig = ready(figured(0.05, 0.005), one(trajectory()));
        rig.execute(0, sweep(1, 0..6, 0.0, 1.5, 2.0));
        rig.run_for(1.0);
        // The newest state is from before the stall.
        rig.arms[0].silent = true;
        rig.tick_after(skipped);
        assert_eq!(rig.phase(0), Phase::Ready, "{skipped}: {:?}", rig.samples[0].cause);
        rig.arms[0].silent = false;
        rig.run_until(4.0, |rig| rig.tasks[0].state != TaskState::Executing);
        assert_eq!(rig.tasks[0].state, TaskState::Completed, "{:?}", rig.tasks[0].reason);
    }
    let mut rig = ready(figured(0.05, 0.005), one(trajectory()));
    rig.arms[0].silent = true;
    rig.run(8);
    let Cause::Stale(age) = rig.samples[0].cause else { panic!("{:?}", rig.samples[0].cause) };
    assert!(age.age_us > age.limit_us && age.own_us == 0, "{age:?}");
}

#[test]
fn a_delay_of_the_device_thread_is_not_the_arms_silence() {
    for (delay, phase) in [(60_000_000, Phase::Ready), (100_000_000, Phase::Held)] {
        let mut rig = ready(figured(0.05, 0.005), one(servo()));
        rig.arms[0].silent = true;
        for k in 1..=6u64 {
            rig.arms[0].state.own_delay_ns = match k {
                3..=5 => 10_000_000 * (k - 2),
                6 => delay,
                _ => 0,
            };
            rig.tick();
        }
        assert_eq!(rig.phase(0), phase, "{delay}: {:?}", rig.samples[0].cause);
    }
}

#[test]
fn the_path_tolerance_aborts_before_the_guard_latches() {
    let mut config = figured(0.05, 0.005);
    config.supervision.tracking_tolerance = 0.15;
    let mut rig = ready(config, one(trajectory()));
    rig.execute(0, sweep(1, 0..6, 0.0, 0.6, 3.0));
    rig.run_for(1.0);
    rig.arms[0].blocked = true;
    rig.run_until(3.0, |rig| rig.tasks[0].state != TaskState::Executing);
    assert!(matches!(rig.tasks[0].reason, Reason::PathTolerance(_, by) if by.abs() > 0.1), "{:?}", rig.tasks[0]);
    assert!(!rig.reported(Event::Arm(0, Phase::Held, Cause::Operator)));
    assert_eq!(rig.commands[0].mode, Some(ControlMode::ServoPosition));
}

//! Follow tasks on a virtual clock: the approach, the lag, and leaders that are lost, jump or leave the range. The rig
//! checks that no command breaks a limit of the arm.

use std::time::Duration;

use dimos::arm::{Link, Supervision};
use dimos::control::config::{ArmConfig, FollowParams, LeaderJoint, TaskConfig, TaskKind};
use dimos::control::request::Request;
use dimos::robot::random::Random;
use dimos::telemetry::{Bound, Cause, Event, LimitKind, Outcome, Phase, Reason, TaskState};

use crate::support::rig::*;

pub(super) const LEADER: usize = 0;
pub(super) const FOLLOWER: usize = 1;
/// Highest speed on the way to the leader [rad/s].
pub(super) const APPROACH: f64 = 0.3;
/// Resolution of a hobby servo [rad].
const RESOLUTION: f64 = std::f64::consts::TAU / 4096.0;

pub(super) fn follow(change: impl FnOnce(&mut FollowParams)) -> TaskKind {
    let mut params = FollowParams { leader: Some("leader".to_owned()), ..FollowParams::default() };
    change(&mut params);
    let led = |joint| LeaderJoint { joint, scale: 1.0, offset: 0.0, endless: false };
    TaskKind::new("follow", &params).led_by((0..6).map(led).collect())
}

pub(super) fn task_of(kind: TaskKind) -> TaskConfig {
    task("follow", kind, 6..12, 10)
}

/// A leader whose motors are off, an arm that follows it, both ready to begin.
pub(super) fn rig(task: TaskConfig) -> Rig {
    rig_of(arm("leader", 6), task)
}

pub(super) fn rig_of(leader: ArmConfig, task: TaskConfig) -> Rig {
    let mut rig = Rig::new(100.0, vec![leader, arm("follower", 6)], vec![task]);
    rig.arms[LEADER].enabled = false;
    rig.run(2);
    assert_eq!(rig.ask(Request::Enabled { arm: 1, outside: false }), Outcome::Accepted);
    rig.run_for(0.3);
    assert_eq!((rig.phase(LEADER), rig.phase(FOLLOWER)), (Phase::Disabled, Phase::Ready));
    rig.events.clear();
    rig
}

/// The same, in step with a leader at rest.
pub(super) fn in_step(task: TaskConfig) -> Rig {
    let mut rig = rig(task);
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    until_in_step(&mut rig);
    rig.events.clear();
    rig
}

pub(super) fn until_in_step(rig: &mut Rig) -> f64 {
    rig.run_until(20.0, |rig| rig.tasks[0].reason == Reason::InStep)
}

/// Ticks for this time [s] while a hand moves the leader. Returns the largest commanded speed and acceleration.
pub(super) fn led(rig: &mut Rig, seconds: f64, mut hand: impl FnMut(f64) -> [f64; 6]) -> (f64, f64) {
    let (mut speed, mut acceleration) = (0.0f64, 0.0f64);
    let mut last: Option<(Vec<f64>, Vec<f64>)> = None;
    for k in 1..=(seconds / rig.dt()).round() as u64 {
        rig.arms[LEADER].q = hand(k as f64 * rig.dt()).to_vec();
        rig.tick();
        let at = rig.commanded(FOLLOWER);
        let velocity = match &last {
            Some((before, _)) => at.iter().zip(before).map(|(q, before)| (q - before) / rig.dt()).collect(),
            None => vec![0.0; 6],
        };
        if let Some((_, before)) = last.filter(|_| k > 2) {
            let changes = velocity.iter().zip(&before).map(|(v, before)| ((v - before) / rig.dt()).abs());
            acceleration = changes.fold(acceleration, f64::max);
        }
        speed = velocity.iter().fold(speed, |most, v: &f64| most.max(v.abs()));
        last = Some((at, velocity));
    }
    (speed, acceleration)
}

#[test]
fn it_approaches_a_leader_without_power_slowly_all_joints_at_a_time_and_is_in_step_then() {
    let goal = [1.2, -0.9, 0.6, 0.3, -0.15, 1.0];
    let mut rig = rig(task_of(follow(|_| {})));
    rig.carry(LEADER, &goal);
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    assert_eq!((rig.tasks[0].state, rig.tasks[0].reason), (TaskState::Executing, Reason::Approaching));
    assert!((rig.tasks[0].distance.unwrap() - 1.2).abs() < 1e-9, "{:?}", rig.tasks[0]);
    let (mut fastest, mut last, mut ticks) = ([0.0f64; 6], rig.commanded(FOLLOWER), 0);
    let (mut velocity, mut acceleration, mut jerk) = ([0.0; 6], [0.0; 6], 0.0f64);
    while rig.tasks[0].reason != Reason::InStep {
        rig.tick();
        ticks += 1;
        let at = rig.commanded(FOLLOWER);
        let part = at[0] / goal[0];
        for j in 0..6 {
            let v = (at[j] - last[j]) / rig.dt();
            let a = (v - velocity[j]) / rig.dt();
            fastest[j] = fastest[j].max(v.abs());
            if ticks > 3 && part < 0.98 {
                jerk = jerk.max(((a - acceleration[j]) / rig.dt()).abs());
                assert!((at[j] - part * goal[j]).abs() < 2e-3, "joint {j} is not on the line at {at:?}");
            }
            (velocity[j], acceleration[j]) = (v, a);
        }
        last = at;
        assert!(ticks < 1000, "{:?}", rig.tasks[0]);
    }
    assert!(fastest.iter().all(|v| *v <= APPROACH + 1e-9) && fastest[0] > 0.299, "{fastest:?}");
    assert!(jerk <= 5.0 + 1e-6, "{jerk} rad/s³");
    let seconds = f64::from(ticks) * rig.dt();
    assert!((4.0..6.5).contains(&seconds), "1.2 rad in {seconds} s");
    assert!(rig.tasks[0].distance.unwrap() <= 0.02);
    rig.run_for(1.0);
    assert!(rig.tasks[0].distance.unwrap() < 1e-3, "{:?}", rig.tasks[0]);
    assert_eq!(rig.count(|e| matches!(e, Event::Limited(..))), 0);
    assert_eq!(
        (rig.phase(LEADER), rig.arms[LEADER].written.clone()),
        (Phase::Disabled, None),
        "the leader gets nothing"
    );
}

/// Fits the follower's commands to the leader's motion: the time by which they are behind [s], and the root mean square
/// of the rest [rad].
pub(super) fn lag(samples: &[(f64, f64)], motion: impl Fn(f64) -> f64) -> (f64, f64) {
    let error = |lag: f64| samples.iter().map(|(t, q)| (q - motion(t - lag)).powi(2)).sum::<f64>();
    let best = (-40..80).map(|ms| f64::from(ms) * 1e-3).min_by(|a, b| error(*a).total_cmp(&error(*b))).unwrap();
    (best, (error(best) / samples.len() as f64).sqrt())
}

#[test]
fn in_step_it_lags_by_no_more_than_a_tick_and_the_age_of_the_state() {
    // Resolution and noise of a hobby servo, states that are 2 ms old, and one state per tick or each two or four.
    for every in [1, 2, 4] {
        let slow = Supervision { stale_after: Duration::from_millis(100), ..Supervision::default() };
        let leader = ArmConfig { supervision: slow, ..arm("leader", 6) };
        let mut rig = rig_of(leader, task_of(follow(|_| {})));
        assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
        until_in_step(&mut rig);
        rig.events.clear();
        rig.arms[LEADER].age = Duration::from_millis(2);
        let (motion, mut random) = (|t: f64| 0.4 * (1.0 - (3.0 * t).cos()), Random::new(3));
        let (mut samples, mut acceleration, mut velocity) = (Vec::new(), 0.0f64, 0.0);
        for k in 1..=600u32 {
            let t = f64::from(k) * rig.dt();
            // The state of this tick was measured 2 ms before it.
            let q = motion(t - 2e-3) + 6e-4 * (random.unit() - 0.5);
            rig.arms[LEADER].q = vec![(q / RESOLUTION).round() * RESOLUTION; 6];
            rig.arms[LEADER].silent = k % every != 0;
            let before = rig.commanded(FOLLOWER)[0];
            rig.tick();
            let v = (rig.commanded(FOLLOWER)[0] - before) / rig.dt();
            acceleration = acceleration.max(((v - velocity) / rig.dt()).abs());
            velocity = v;
            if k > 100 {
                samples.push((t, rig.commanded(FOLLOWER)[0]));
            }
        }
        let (lag, rest) = lag(&samples, motion);
        eprintln!("a state each {every} ticks: lag {lag:.3} s, rest {rest:.4} rad, {acceleration:.2} rad/s²");
        assert!(lag <= 0.012, "a state each {every} ticks: {lag} s");
        assert!(rest < 0.03, "a state each {every} ticks: {rest} rad");
        assert!(acceleration <= A_MAX, "{acceleration} rad/s²");
        assert_eq!(rig.tasks[0].reason, Reason::InStep);
        assert_eq!(rig.count(|e| matches!(e, Event::Limited(..))), 0, "{:?}", rig.events);
    }
}

#[test]
fn a_leader_that_stands_still_leaves_the_arm_at_rest_in_spite_of_its_noise() {
    let mut rig = in_step(task_of(follow(|_| {})));
    let mut random = Random::new(5);
    let mut flicker = |_| [0.0; 6].map(|_: f64| RESOLUTION * (random.unit() * 2.0).floor());
    let (speed, acceleration) = led(&mut rig, 5.0, &mut flicker);
    assert!(speed < 0.03 && acceleration < 2.0, "{speed} rad/s, {acceleration} rad/s²");
}

#[test]
fn a_leader_that_is_lost_is_waited_for_at_rest_and_approached_again() {
    type Set = fn(&mut SimArm, bool);
    let faults: [(&str, Set); 3] = [
        ("stale", |arm, on| arm.silent = on),
        ("link_lost", |arm, on| arm.link = if on { Link::Down } else { Link::Up }),
        ("arm_fault", |arm, on| arm.error = if on { 31 } else { 0 }),
    ];
    for (name, set) in faults {
        let mut rig = in_step(task_of(follow(|_| {})));
        led(&mut rig, 1.0, |t| [0.8 * t * t / 2.0; 6]);
        let speed = rig.speed(FOLLOWER);
        assert!(speed > 0.6, "{name}: {speed}");
        set(&mut rig.arms[LEADER], true);
        rig.run_for(0.5);
        assert_eq!((rig.speed(FOLLOWER), rig.tasks[0].state), (0.0, TaskState::Executing), "{name}");
        let lost = matches!(rig.tasks[0].reason, Reason::LeaderLost(0, cause) if cause.name() == name);
        assert!(lost, "{name}: {:?}", rig.tasks[0]);
        assert_eq!(rig.count(|e| matches!(e, Event::Task(0, _, Reason::LeaderLost(..)))), 1, "{name}: reported once");
        assert_eq!(rig.tasks[0].distance, None, "{name}: it is not known");
        let held = rig.commanded(FOLLOWER);
        // It comes back elsewhere.
        rig.carry(LEADER, &[1.2; 6]);
        rig.run_for(0.5);
        assert_eq!(rig.commanded(FOLLOWER), held, "{name}");
        set(&mut rig.arms[LEADER], false);
        let (speed, _) = led(&mut rig, 1.0, |_| [1.2; 6]);
        assert!(speed <= APPROACH + 1e-9 && speed > 0.25, "{name}: {speed} rad/s");
        assert_eq!(rig.tasks[0].reason, Reason::Approaching, "{name}");
        until_in_step(&mut rig);
        rig.run_for(1.0);
        assert!(rig.tasks[0].distance.unwrap() < 1e-3, "{name}");
    }
}

#[test]
fn without_its_leader_for_long_it_ends_and_says_why() {
    let mut rig = in_step(task_of(follow(|params| params.leader_timeout = 1.0)));
    rig.arms[LEADER].silent = true;
    let took = rig.run_until(3.0, |rig| rig.tasks[0].state == TaskState::Aborted);
    assert!((1.0..1.1).contains(&took), "{took}");
    assert!(matches!(rig.tasks[0].reason, Reason::LeaderLost(0, Cause::Stale(_))), "{:?}", rig.tasks[0]);
    rig.arms[LEADER].silent = false;
    let held = rig.commanded(FOLLOWER);
    led(&mut rig, 1.0, |_| [0.7; 6]);
    assert_eq!((rig.commanded(FOLLOWER), rig.phase(FOLLOWER)), (held, Phase::Ready), "only a request begins it again");
    rig.arms[LEADER].error = 7;
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::StartStateUnavailable(0));
    rig.arms[LEADER].error = 0;
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
}

#[test]
fn a_leader_that_jumps_is_not_followed() {
    let mut rig = in_step(task_of(follow(|_| {})));
    // One wrong sample, then more than any hand can do.
    rig.arms[LEADER].q = vec![-1.0; 6];
    rig.tick();
    let (speed, _) = led(&mut rig, 1.0, |_| [0.0; 6]);
    assert!(speed <= 1e-9, "after one wrong sample: {speed} rad/s");
    assert_eq!(rig.tasks[0].reason, Reason::InStep);
    let (speed, _) = led(&mut rig, 0.5, |_| [0.8; 6]);
    assert!(speed <= 1e-9, "{speed} rad/s");
    assert_eq!((rig.phase(LEADER), rig.phase(FOLLOWER)), (Phase::Held, Phase::Ready));
    // An operator has seen it: the leader is where it is read, and the follower approaches it.
    assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
    let (speed, _) = led(&mut rig, 3.0, |_| [0.8; 6]);
    assert!(speed <= APPROACH + 1e-9 && speed > 0.29, "{speed} rad/s");
}

#[test]
fn a_leader_that_a_hand_moves_far_while_it_is_not_read_is_approached_again() {
    let mut rig = in_step(task_of(follow(|_| {})));
    rig.arms[LEADER].silent = true;
    led(&mut rig, 0.02, |t| [12.0 * t; 6]);
    rig.arms[LEADER].silent = false;
    let (speed, _) = led(&mut rig, 2.0, |_| [0.3; 6]);
    assert_eq!(rig.phase(LEADER), Phase::Disabled, "as fast as a hand may be");
    assert!(speed <= APPROACH + 1e-9 && speed > 0.2, "{speed} rad/s");
}

#[test]
fn a_leader_outside_the_range_is_refused_or_followed_to_the_limit() {
    let mut rig = rig(task_of(follow(|_| {})));
    rig.carry(LEADER, &[0.0, 0.0, 0.0, RANGE + 0.3, 0.0, 0.0]);
    match rig.ask(Request::Start { task: 0 }) {
        Outcome::OutOfLimits(9, by) => assert!((by - 0.31).abs() < 1e-9, "{by}"),
        outcome => panic!("{outcome:?}"),
    }
    assert_eq!(rig.tasks[0].state, TaskState::Idle);
    rig.carry(LEADER, &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0]);
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    until_in_step(&mut rig);
    let out = |t: f64| [0.0, 0.0, 0.0, 1.0 + 0.7 * (1.0 - (1.5 * t).cos()), 0.0, 0.0];
    led(&mut rig, 2.0, out);
    assert!((rig.commanded(FOLLOWER)[3] - SOFT).abs() < 1e-9, "{:?}", rig.commanded(FOLLOWER));
    assert_eq!(rig.tasks[0].bound, Bound::Position(9));
    assert!(rig.tasks[0].distance.unwrap() > 0.2, "{:?}", rig.tasks[0]);
    assert_eq!(rig.count(|e| matches!(e, Event::Limited(9, LimitKind::Position, _))), 1, "{:?}", rig.events);
    led(&mut rig, std::f64::consts::TAU / 1.5 - 2.0, |t| out(t + 2.0));
    rig.run_for(1.0);
    assert!(rig.tasks[0].distance.unwrap() < 5e-3 && rig.tasks[0].bound == Bound::None, "{:?}", rig.tasks[0]);
    assert_eq!(rig.phase(FOLLOWER), Phase::Ready);
}

#[test]
fn a_leader_further_than_max_approach_is_not_approached() {
    let mut rig = rig(task_of(follow(|params| params.max_approach = 0.5)));
    rig.carry(LEADER, &[0.0, 0.0, 0.6, 0.0, 0.0, 0.0]);
    match rig.ask(Request::Start { task: 0 }) {
        Outcome::StartStateMismatch(8, by) => assert!((by - 0.6).abs() < 1e-9, "{by}"),
        outcome => panic!("{outcome:?}"),
    }
    rig.carry(LEADER, &[0.0, 0.0, 0.4, 0.0, 0.0, 0.0]);
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    until_in_step(&mut rig);
    // It was silent while it was carried away.
    rig.arms[LEADER].silent = true;
    rig.run_for(0.2);
    rig.arms[LEADER].q[2] = 1.2;
    rig.arms[LEADER].silent = false;
    rig.tick();
    assert!(matches!(rig.tasks[0].reason, Reason::LeaderAway(8, by) if by > 0.7), "{:?}", rig.tasks[0]);
    assert_eq!(rig.tasks[0].state, TaskState::Aborted);
}

#[test]
fn a_leader_further_than_half_a_turn_is_approached_only_if_the_blueprint_says_so() {
    let wide = |params: fn(&mut FollowParams)| {
        let mut rig = rig(task_of(follow(params)));
        rig.carry(LEADER, &[0.0, 1.7, 0.0, 0.0, 0.0, 0.0]);
        assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
        until_in_step(&mut rig);
        // It was silent while it was carried away.
        rig.arms[LEADER].silent = true;
        rig.run_for(0.2);
        rig.arms[LEADER].q[1] = -1.7;
        rig.arms[LEADER].silent = false;
        rig.tick();
        rig.tasks[0].reason
    };
    assert!(matches!(wide(|_| {}), Reason::LeaderAway(7, by) if (by - 3.4).abs() < 0.01));
    assert_eq!(wide(|params| params.max_approach = 4.0), Reason::Approaching);
}

#[test]
fn a_joint_without_end_follows_round_the_circle() {
    let params = FollowParams { leader: Some("leader".to_owned()), ..FollowParams::default() };
    let led = LeaderJoint { joint: 0, scale: 1.0, offset: 0.0, endless: true };
    let mut rig = rig(task("follow", TaskKind::new("follow", &params).led_by(vec![led]), 6..7, 10));
    let turn = std::f64::consts::TAU;
    rig.carry(LEADER, &[turn + 0.4, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    until_in_step(&mut rig);
    rig.run_for(1.0);
    assert!((rig.commanded(FOLLOWER)[0] - 0.4).abs() < 1e-3, "{:?}", rig.commanded(FOLLOWER));
    // Its reading loses a turn: the follower stays.
    rig.arms[LEADER].q[0] = 0.4;
    rig.run_for(1.0);
    assert!((rig.commanded(FOLLOWER)[0] - 0.4).abs() < 1e-3);
    assert!(matches!(rig.samples[LEADER].cause, Cause::TurnLost(0, _)), "{:?}", rig.samples[LEADER].cause);
}

#[test]
fn a_leader_that_is_too_fast_is_caught_up_with_within_the_limits() {
    let mut rig = in_step(task_of(follow(|_| {})));
    // 3 rad/s, twice what the arm can do.
    led(&mut rig, 0.5, |t| [-(3.0 * t); 6]);
    assert_eq!(rig.tasks[0].bound, Bound::Velocity(6), "{:?}", rig.tasks[0]);
    let (speed, acceleration) = led(&mut rig, 1.5, |_| [-1.5; 6]);
    assert!(speed <= V_MAX && speed > 0.9 * V_MAX && acceleration <= A_MAX * (1.0 + 1e-6), "{speed} {acceleration}");
    assert!(rig.tasks[0].distance.unwrap() < 5e-3, "{:?}", rig.tasks[0]);
}

#[test]
fn scale_and_offset_make_the_target() {
    let params = FollowParams { leader: Some("leader".to_owned()), ..FollowParams::default() };
    let led_by = [(5, -0.5, 0.2), (0, 2.0, -0.1)].map(|(joint, scale, offset)| LeaderJoint {
        joint,
        scale,
        offset,
        endless: false,
    });
    let kind = TaskKind::new("follow", &params).led_by(led_by.to_vec());
    let mut rig = rig(task("follow", kind, 6..8, 10));
    rig.carry(LEADER, &[0.3, 1.0, 1.0, 1.0, 1.0, -0.8]);
    assert_eq!(rig.ask(Request::Start { task: 0 }), Outcome::Accepted);
    until_in_step(&mut rig);
    rig.run_for(1.0);
    let at = rig.commanded(FOLLOWER);
    assert!((at[0] - 0.6).abs() < 1e-3 && (at[1] - 0.5).abs() < 1e-3 && at[2] == 0.0, "{at:?}");
}

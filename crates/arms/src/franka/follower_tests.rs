//! Setpoints of any rate and phase, against a controller that uses every command.

use super::*;
use crate::franka::model::Model;
use crate::franka::protocol::command::Target;
use crate::franka::shaping::{Pace, Shaping};

/// Where the first joint is to be at a time [s]: at rest for 0.3 s, then 0.5 rad in 1.2 s.
fn goal(t: f64) -> f64 {
    let t = ((t - 0.3) / 1.2).clamp(0.0, 1.0);
    0.5 * t * t * t * (10.0 + t * (6.0 * t - 15.0))
}

/// What a run shows.
#[derive(Debug)]
struct Seen {
    /// Largest lag of the commands behind the setpoints [s], about.
    lag: f64,
    /// Error at the end [rad].
    error: f64,
    /// Largest acceleration [rad/s²].
    acceleration: f64,
    /// States without an answer.
    unanswered: u32,
    direct: bool,
}

/// Writes setpoints at `times` [s], in order. States come every millisecond, and 0.1 ms later to the follower; those
/// for which `lost` is true never do.
fn run(times: &[f64], lost: impl Fn(u64) -> bool) -> Seen {
    let (model, first) = (Model::Fr3, State { id: 1000, ..State::default() });
    let shaping = Shaping::new(100.0, Some(model.ranges()));
    let mut controller = State { q_d: [0.0, 0.0, 0.0, -1.5, 0.0, 1.5, 0.0], ..first };
    let base = controller.q_d;
    let mut follower = Follower::new(&controller, false, shaping.gain);
    let (mut pace, mut answered) = (Pace::default(), controller.id);
    let (mut known, mut known_at) = (controller, 0.0);
    let mut seen = Seen { lag: 0.0, error: 0.0, acceleration: 0.0, unanswered: 0, direct: false };
    let mut times = times.iter().copied().peekable();
    for cycle in 0..2390_u64 {
        let came = cycle as f64 * 1e-3 + 1e-4;
        let mut answer = None;
        if !lost(cycle) {
            (known, known_at) = (controller, came);
            answer = follower.state(&known);
        }
        while let Some(t) = times.next_if(|t| *t < came + 1e-3) {
            let mut values = base;
            values[0] = goal(t);
            let age = Duration::from_secs_f64((t - known_at).max(0.0));
            let direct = follower.setpoint(&values, &known, age);
            assert!(answer.is_none() || direct.is_none(), "two answers to one state");
            answer = answer.or(direct);
        }
        // A command uses the state that it answers; without one the controller keeps its acceleration.
        let before = controller;
        let speeds: [f64; DOF] = match answer.filter(|_| known.id == before.id) {
            Some(values) => {
                pace.take(&values, before.id - answered);
                answered = before.id;
                match shaping.shape(&Target::Positions(values), &before, cycle == 0, Some(&pace)) {
                    Target::Positions(q) => std::array::from_fn(|i| (q[i] - before.q_d[i]) / PERIOD),
                    Target::Velocities(_) => unreachable!(),
                }
            }
            None => {
                seen.unanswered += 1;
                std::array::from_fn(|i| before.dq_d[i] + before.ddq_d[i] * PERIOD)
            }
        };
        controller.id += 1;
        controller.dq_d = speeds;
        controller.q_d = std::array::from_fn(|i| before.q_d[i] + speeds[i] * PERIOD);
        controller.ddq_d = std::array::from_fn(|i| (speeds[i] - before.dq_d[i]) / PERIOD);
        let (acceleration, jerk) = (controller.ddq_d[0], (controller.ddq_d[0] - before.ddq_d[0]) / PERIOD);
        assert!(acceleration.abs() <= 10.0 && jerk.abs() <= 5000.0, "cycle {cycle}: {acceleration}, {jerk}");
        seen.acceleration = seen.acceleration.max(acceleration.abs());
        // At full speed, a distance is a time.
        if (0.7..1.1).contains(&came) {
            seen.lag = seen.lag.max((goal(came) - controller.q_d[0]) / 0.78);
        }
        seen.direct = follower.is_direct();
    }
    seen.error = (controller.q_d[0] - 0.5).abs();
    seen
}

/// Times of setpoints, with a period and a phase [s].
fn every(period: f64, phase: f64) -> Vec<f64> {
    (0..).map(|i| f64::from(i) * period + phase).take_while(|t| *t < 2.4).collect()
}

/// Numbers from −1 to 1, always the same.
fn noise() -> impl Iterator<Item = f64> {
    let mut seed = 1_u32;
    std::iter::repeat_with(move || {
        seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        f64::from(seed >> 8) / f64::from(1 << 23) - 1.0
    })
}

#[test]
fn setpoints_right_after_their_states_are_answers_at_once() {
    let seen = run(&every(1e-3, 3e-4), |_| false);
    assert!(seen.direct && seen.unanswered <= 1, "{seen:?}");
    assert!(seen.lag < 0.004 && seen.error < 1e-6 && seen.acceleration < 2.5, "{seen:?}");
}

#[test]
fn setpoints_of_any_other_rate_are_smoothed() {
    for (period, lag) in [(1.9e-3, 0.04), (2e-3, 0.04), (4e-3, 0.04), (10e-3, 0.045), (33e-3, 0.09)] {
        let seen = run(&every(period, 7e-4), |_| false);
        assert!(!seen.direct && seen.unanswered == 0, "{period}: {seen:?}");
        assert!(seen.lag < lag && seen.error < 1e-6 && seen.acceleration < 4.0, "{period}: {seen:?}");
    }
}

#[test]
fn a_pause_changes_nothing() {
    let times: Vec<f64> = every(3e-3, 7e-4).into_iter().filter(|t| !(0.05..0.28).contains(t)).collect();
    let seen = run(&times, |_| false);
    assert!(seen.lag < 0.04 && seen.error < 1e-6, "{seen:?}");
}

#[test]
fn a_phase_that_jitters_or_drifts_is_no_jump() {
    // About as each state comes: before or after it.
    let jitter: Vec<f64> = every(1e-3, 1e-4).iter().zip(noise()).map(|(t, noise)| t + 6e-5 * noise).collect();
    let late: Vec<f64> = every(1e-3, 7e-4).iter().zip(noise()).map(|(t, noise)| t + 2e-4 * noise).collect();
    for times in [jitter, late, every(1.0005e-3, 3e-4), every(0.9995e-3, 3e-4), every(1.003e-3, 3e-4)] {
        let seen = run(&times, |_| false);
        assert!(seen.lag < 0.04 && seen.error < 1e-5 && seen.acceleration < 9.0, "{seen:?}");
        assert!(seen.unanswered < 12, "{seen:?}");
    }
}

#[test]
fn lost_states_are_made_up_for() {
    // Some at once, and one in twenty.
    for lost in [|cycle: u64| (800..812).contains(&cycle), |cycle: u64| cycle % 20 == 7] {
        let seen = run(&every(1e-3, 3e-4), lost);
        assert!(seen.error < 1e-5 && seen.acceleration < 9.0, "{seen:?}");
    }
}

#[test]
fn a_tick_that_misses_periods_is_caught_up_gently() {
    // The computer was stalled for 5 ms at full speed: the goal is late from then on.
    let times: Vec<f64> = every(1e-3, 3e-4).into_iter().filter(|t| !(0.9..0.905).contains(t)).collect();
    let seen = run(&times, |_| false);
    assert!(seen.direct && seen.error < 1e-5 && seen.acceleration < 5.0, "{seen:?}");
    // For 50 ms: a run would have held the arm; here it is slowed down, and continues.
    let times: Vec<f64> = every(1e-3, 3e-4).into_iter().filter(|t| !(0.9..0.95).contains(t)).collect();
    let seen = run(&times, |_| false);
    assert!(seen.error < 1e-5 && seen.acceleration < 9.0, "{seen:?}");
}

#[test]
fn setpoints_that_come_irregularly_for_a_while_lag_little_afterwards() {
    // For 60 ms every third tick is late by 0.8 ms: its state has no setpoint, the next one has two.
    let late = |i: usize| (850..910).contains(&i) && i.is_multiple_of(3);
    let times = every(1e-3, 3e-4);
    let times: Vec<f64> = times.iter().enumerate().map(|(i, t)| if late(i) { t + 8e-4 } else { *t }).collect();
    let seen = run(&times, |_| false);
    assert!(!seen.direct || seen.error < 1e-6, "{seen:?}");
    assert!(seen.lag < 0.04 && seen.acceleration < 9.0 && seen.error < 1e-5, "{seen:?}");
}

#[test]
fn what_slips_at_rest_does_not_delay_the_next_motion() {
    // Desired speeds of an arm at rest are rounded.
    let mut state = State { id: 1000, dq_d: [1e-6; DOF], ..State::default() };
    let mut follower = Follower::new(&state, false, 1.0);
    let mut goal = state.q_d;
    let (in_time, late) = (Duration::from_micros(200), Duration::from_micros(800));
    for _ in 0..120 {
        state.id += 1;
        follower.state(&state);
        follower.setpoint(&goal, &state, in_time);
    }
    assert!(follower.is_direct());
    for _ in 0..12 {
        state.id += 3;
        follower.state(&state);
        follower.setpoint(&goal, &state, in_time);
    }
    assert!(!follower.is_direct());
    let mut answer = goal;
    for _ in 0..200 {
        state.id += 1;
        answer = follower.state(&state).unwrap();
        goal[0] += 0.001;
        follower.setpoint(&goal, &state, late);
    }
    // 1 rad/s, so a distance is a time.
    let lag = goal[0] - answer[0];
    assert!(lag < 0.03, "{lag} s");
}

//! What is believed of an arm's readings, and how old it is.

use super::*;
use dimos_core::joint::{ControlMode, joints_of};

fn config() -> ArmConfig {
    let mut config = ArmConfig { modes: vec![ControlMode::ServoPosition], ..ArmConfig::of_two_joints(1.0) };
    config.supervision.stale_after = Duration::from_millis(50);
    config
}

fn at(ms: u64) -> Mono {
    Mono(1_000_000_000 + ms * 1_000_000)
}

/// Reading number `seq`, measured 10 ms after the one before it.
fn reading(seq: u64, q: f64) -> ArmState {
    ArmState {
        seq,
        stamp: at(10 * seq),
        dof: 2,
        position: joints_of(&[q, 0.5]),
        velocity: joints_of(&[0.25, 0.0]),
        velocity_source: VelocitySource::Measured,
        effort: Some(joints_of(&[q, q])),
        enabled: true,
        link: Link::Up,
        ..ArmState::default()
    }
}

fn read(feedback: &mut Feedback, state: &ArmState) -> Verdict {
    feedback.read(state, None, false, state.stamp.after(Duration::from_millis(1)), &Stalls::default())
}

#[test]
fn an_implausible_reading_is_logged_and_not_used() {
    let mut feedback = Feedback::new(&config());
    assert!(!feedback.is_usable(), "nothing was read");
    assert_eq!(read(&mut feedback, &reading(1, 0.1)), Verdict::Accepted);
    assert!(feedback.is_usable() && !feedback.is_rejected());

    let wrong = ArmState { error: 3, velocity: joints_of(&[9.0, 9.0]), ..reading(2, 1.1) };
    assert_eq!(read(&mut feedback, &wrong), Verdict::Rejected);
    assert!(feedback.is_rejected() && !feedback.is_usable() && feedback.freshness().fresh);
    let (kept, logged) = (*feedback.state(), feedback.measured());
    assert_eq!((kept.position, kept.velocity), (reading(1, 0.1).position, reading(1, 0.1).velocity));
    assert_eq!((kept.effort, kept.seq, kept.stamp, kept.error), (reading(1, 0.1).effort, 1, at(10), 3));
    assert_eq!((logged.position, logged.seq, logged.stamp), (wrong.position, 2, at(20)));
    assert_eq!((logged.velocity, logged.velocity_source), (kept.velocity, VelocitySource::Measured));
    assert_eq!(read(&mut feedback, &wrong), Verdict::Same, "the same reading again is rejected as before");
    assert!(feedback.is_rejected());
    assert_eq!(feedback.state().position, kept.position);

    assert_eq!(read(&mut feedback, &reading(3, 0.1)), Verdict::Accepted);
    assert!(feedback.is_usable());
    assert_eq!(feedback.measured(), *feedback.state());
    assert_eq!(read(&mut feedback, &reading(3, 0.1)), Verdict::Same);
    assert!(feedback.is_usable());
}

#[test]
fn what_is_not_a_number_is_no_measurement() {
    let mut feedback = Feedback::new(&config());
    read(&mut feedback, &reading(1, 0.1));
    assert_eq!(read(&mut feedback, &reading(2, f64::NAN)), Verdict::Rejected);
    assert_eq!(feedback.state().position, reading(1, 0.1).position);
    assert_eq!(feedback.measured(), *feedback.state(), "the log has no NaN either");
    let mut unused = reading(3, 0.1);
    unused.position[5] = f64::NAN;
    assert_eq!(read(&mut feedback, &unused), Verdict::Accepted, "a joint that the arm does not have");
    let without = ArmState { velocity: joints_of(&[f64::INFINITY, 0.0]), ..reading(4, 0.1) };
    assert_eq!(read(&mut feedback, &without), Verdict::Accepted);
    assert_eq!(feedback.state().velocity_source, VelocitySource::Estimated);
    assert!(feedback.state().velocity.iter().all(|v| v.is_finite()));
}

#[test]
fn a_state_is_fresh_up_to_its_age_limit_with_a_connection() {
    let of = |change: fn(&mut ArmState), age_us: u64| {
        let (mut feedback, mut state) = (Feedback::new(&config()), reading(1, 0.1));
        change(&mut state);
        feedback.read(&state, None, false, state.stamp.after(Duration::from_micros(age_us)), &Stalls::default());
        feedback.freshness()
    };
    let limit = Age { age_us: 50_000, limit_us: 50_000, own_us: 0 };
    assert_eq!(of(|_| {}, 50_000), Freshness { fresh: true, age: limit });
    assert!(!of(|_| {}, 50_001).fresh);
    assert!(!of(|state| state.link = Link::Stale, 1_000).fresh);
    assert!(!of(|state| state.seq = 0, 1_000).fresh, "there is none yet");
    // The device thread could not run.
    let delayed = of(|state| state.own_delay_ns = 60_000_000, 100_000);
    assert_eq!((delayed.fresh, delayed.age.age_us, delayed.age.own_us), (true, 40_000, 60_000));
    assert!(!of(|state| state.own_delay_ns = 100_000_000, 100_000).fresh, "a longer one is not excused");
    let more = of(|state| state.own_delay_ns = 60_000_000, 40_000);
    assert_eq!((more.age.age_us, more.age.own_us), (0, 40_000), "no more than the whole age");
}

#[test]
fn the_age_limit_is_three_reads_at_least() {
    let slow = ArmConfig { read_period: Duration::from_millis(40), ..config() };
    let mut feedback = Feedback::new(&slow);
    let state = reading(1, 0.1);
    feedback.read(&state, None, false, state.stamp.after(Duration::from_millis(120)), &Stalls::default());
    assert!(feedback.freshness().fresh);
    feedback.read(&state, None, false, state.stamp.after(Duration::from_millis(121)), &Stalls::default());
    assert!(!feedback.freshness().fresh);
}

#[test]
fn time_in_which_the_tick_could_not_run_is_not_the_states_age() {
    let mut stalls = Stalls::default();
    stalls.note(at(90), Duration::from_millis(70));
    let mut feedback = Feedback::new(&config());
    feedback.read(&reading(1, 0.1), None, false, at(100), &stalls);
    let age = feedback.freshness().age;
    assert_eq!((feedback.freshness().fresh, age.age_us, age.own_us), (true, 20_000, 70_000));
}

#[test]
fn rejected_readings_keep_a_state_fresh_until_a_jump_could_be_confirmed() {
    let mut feedback = Feedback::new(&config());
    read(&mut feedback, &reading(1, 0.1));
    // Each differs from the one before, so that none confirms a jump. The limit is 50 ms, and 3 readings to confirm.
    for seq in 2..=12 {
        let far = if seq % 2 == 0 { 2.0 } else { -2.0 };
        let state = reading(seq, far);
        assert_eq!(feedback.read(&state, None, false, state.stamp, &Stalls::default()), Verdict::Rejected);
        assert_eq!(feedback.freshness().fresh, 10 * seq <= 10 + 50 + 30, "reading {seq}");
    }
}

#[test]
fn a_velocity_without_motion_is_a_contradiction_where_setpoints_are_all_that_moves_the_arm() {
    for driven in [true, false] {
        let mut feedback = Feedback::new(&config());
        let found = (1..60).any(|k| {
            let state = ArmState { velocity: joints_of(&[0.8, 0.0]), ..reading(k, 0.1) };
            let verdict = feedback.read(&state, None, driven, state.stamp, &Stalls::default());
            matches!(verdict, Verdict::Inconsistent(0, _))
        });
        assert_eq!((found, feedback.is_usable()), (driven, !driven));
    }
}

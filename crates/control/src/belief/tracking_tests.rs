//! When an arm that is away from its setpoints is held.

use super::*;
use dimos_core::joint::{JointBounds, joints_of};

const PERIOD: Duration = Duration::from_millis(10);
const DT: f64 = 0.01;

fn tracking() -> Tracking {
    let supervision = dimos_core::arm::Supervision { lag: 0.05, accuracy: 0.005, ..Default::default() };
    Tracking::new(&ArmConfig { supervision, ..ArmConfig::of_two_joints(1.0) }, PERIOD)
}

fn at(ms: u64) -> Mono {
    Mono(1_000_000_000 + ms * 1_000_000)
}

fn limiters(q: f64) -> Vec<Limiter> {
    let mut limiter = Limiter::new(JointBounds::inside(-3.0, 3.0, 1.0, 4.0));
    limiter.seed(q);
    vec![limiter; 2]
}

fn state(ms: u64, q: f64, v: f64) -> ArmState {
    ArmState { seq: 1, stamp: at(ms), position: joints_of(&[q, q]), velocity: joints_of(&[v, v]), ..Default::default() }
}

/// How long this error lasts until the arm is held [ticks]. Half of the time that is allowed is one tick, exactly.
fn ticks_until_held(velocity: bool, state: &ArmState, tracking: &mut Tracking) -> Option<usize> {
    let dt = if velocity { MAX_TIME.1 / 2.0 } else { MAX_TIME.0 / 2.0 };
    (1..=9).find(|_| tracking.supervise(state, dt).is_some())
}

#[test]
fn an_error_is_the_distance_from_the_setpoints_of_the_last_lag() {
    let mut t = tracking();
    assert!(t.range(&state(0, 0.0, 0.0)).is_none());
    for k in 0..=20 {
        t.push(at(10 * k), &joints_of(&[0.01 * k as f64; 2]), None);
    }
    // The setpoints of the last 50 ms go from 0.15 to 0.20 rad; the start of the range is exact to a 16th of it.
    t.compare(&state(200, 0.16, 0.0), &limiters(0.2));
    assert_eq!([t.error(0), t.error(1)], [0.0; 2], "in the range");
    t.compare(&state(200, 0.25, 0.0), &limiters(0.2));
    assert!((t.error(0) - 0.05).abs() < 1e-12 && t.error(0) == t.error(1), "{}", t.error(0));
    t.compare(&state(200, 0.05, 0.0), &limiters(0.2));
    assert!((-0.1..=-0.08).contains(&t.error(0)), "{}", t.error(0));
    t.compare(&state(200, 0.209, 0.0), &limiters(0.2));
    assert_eq!(t.error(0), 0.0, "near the newest setpoint");
    t.compare(&state(200, 0.05, 0.0), &limiters(0.2));
    t.clear_errors();
    assert_eq!(t.error(0), 0.0);
    t.restart();
    assert!(t.range(&state(200, 0.0, 0.0)).is_none());
}

#[test]
fn the_setpoint_is_near_on_the_same_side_of_zero_only() {
    let mut t = tracking();
    t.push(at(0), &joints_of(&[-0.2, -0.2]), None);
    t.compare(&state(10, 0.2, 0.0), &limiters(-0.2));
    assert!((t.error(0) - 0.4).abs() < 1e-12, "{}", t.error(0));
}

#[test]
fn an_error_above_its_tolerance_holds_after_a_tenth_of_a_second() {
    let mut t = tracking();
    t.push(at(0), &joints_of(&[0.0; 2]), None);
    let away = state(10, 0.16, 0.0);
    t.compare(&away, &limiters(0.0));
    assert_eq!(ticks_until_held(false, &away, &mut t), Some(3), "two ticks are allowed");
    let Some(Cause::Tracking(_, by)) = t.supervise(&away, DT) else { panic!("no longer held") };
    assert!((by - 0.16).abs() < 1e-12);

    let mut t = tracking();
    t.push(at(0), &joints_of(&[0.0; 2]), None);
    t.compare(&state(10, 0.14, 0.0), &limiters(0.0));
    assert_eq!(ticks_until_held(false, &away, &mut t), None, "within the tolerance of 0.15 rad");

    // After a moment without supervision the time begins again.
    t.compare(&away, &limiters(0.0));
    for _ in 0..3 {
        assert!((0..9).all(|_| t.supervise(&away, DT).is_none()));
        t.pause();
    }
    assert_eq!(ticks_until_held(false, &away, &mut t), Some(3));
}

#[test]
fn velocities_may_differ_for_longer_and_by_more_at_speed() {
    let held_at = |setpoint: f64, measured: f64| {
        let mut t = tracking();
        t.push(at(0), &joints_of(&[0.0; 2]), Some(&joints_of(&[setpoint; 2])));
        ticks_until_held(true, &state(10, 0.0, measured), &mut t)
    };
    assert_eq!(held_at(0.0, 0.19), None);
    assert_eq!(held_at(0.0, 0.21), Some(3), "two ticks are allowed");
    assert_eq!(held_at(1.0, 1.24), None, "a fifth of the velocity");
    assert_eq!(held_at(1.0, 1.26), Some(3));
    assert_eq!(ticks_until_held(true, &state(10, 0.0, 9.0), &mut tracking()), None, "nothing to compare with");
}

//! What a limiter lets through, exactly at its limits and with anything that may be asked.

use super::*;
use proptest::prelude::*;

const DT: f64 = 0.01;

fn limiter() -> Limiter {
    Limiter::new(JointBounds::inside(-2.0, 2.0, 1.5, 4.0))
}

/// What was commanded is reported in the unit of the limit that applied, also of a velocity.
#[test]
fn a_limited_velocity_is_reported_in_the_unit_of_its_limit() {
    let by = |target: f64, at: f64| limiter().follow_velocity(target, (at, at), DT, 1.0).unwrap().by;
    assert_eq!(by(0.2, 0.0), Some((LimitKind::Acceleration, 0.2 / DT)), "rad/s²: 0.2 rad/s within one tick");
    assert_eq!(by(1.6, 0.0), Some((LimitKind::Velocity, 1.6)), "rad/s");
    assert_eq!(by(0.5, 1.9999), Some((LimitKind::Position, 1.9999 + 0.5 * DT)), "rad");
    assert_eq!(by(0.03, 0.0), None);
}

proptest! {
    #[test]
    fn far_from_a_limit_needs_no_exact_answer(v in 0.0..8.0f64, a in 0.1..60.0f64, more in 0.0..0.5f64, dt in 0.0005..0.05f64) {
        let room = v * v / (2.0 * a) + v * dt + a * dt * dt + more;
        prop_assert!(v <= braking_speed(room, a, dt) + ROUNDING);
    }
}

proptest! {
    /// The quick answer far from a limit and the exact one near it agree.
    #[test]
    fn whether_a_joint_stops_inside_is_whether_its_braking_speed_allows_it(
        v in -8.0..8.0f64, a in 0.1..60.0f64, room in 0.0..20.0f64, share in 0.0..2.0f64, dt in 0.0005..0.05f64,
    ) {
        let l = Limiter::new(JointBounds::inside(-2.0, 2.0, 8.0, a));
        let at_the_limit = v * v / (2.0 * a) * share;
        for room in [room, at_the_limit] {
            prop_assert_eq!(l.stops_inside(v, room, dt), v.abs() <= braking_speed(room, a, dt) + ROUNDING);
        }
    }
}

#[test]
fn a_range_loses_its_margin_or_a_tenth_at_each_end() {
    let wide = JointBounds::inside(-2.0, 1.0, 1.5, 4.0);
    assert_eq!((wide.lower, wide.upper), (-2.0 + POSITION_MARGIN, 1.0 - POSITION_MARGIN));
    let narrow = JointBounds::inside(-0.01, 0.03, 1.5, 4.0);
    assert!((narrow.lower - -0.006).abs() < 1e-12 && (narrow.upper - 0.026).abs() < 1e-12, "{narrow:?}");
    for (q, excess) in [(-2.5, 0.51), (-1.99, 0.0), (0.3, 0.0), (0.99, 0.0), (1.25, 0.26)] {
        assert!((wide.excess(q) - excess).abs() < 1e-12, "{q}: {}", wide.excess(q));
    }
}

/// A third of the deceleration that it needs, and it is still inside at rest, without more than it may brake.
#[test]
fn a_joint_that_brakes_together_with_others_keeps_its_range() {
    let mut l = limiter();
    let (upper, acceleration) = (l.bounds.upper, l.bounds.acceleration);
    let speed = 1.2;
    l.rewind(upper - way(speed, acceleration), speed);
    let mut kept = l;
    for _ in 0..400 {
        let before = kept;
        kept.decelerate_from(&before, acceleration * DT / 3.0, DT);
        kept.keep_inside(&before);
        assert!(kept.position() <= upper, "{}", kept.position());
        assert!((kept.velocity() - before.velocity()).abs() <= acceleration * DT * (1.0 + 1e-9));
        // The step is what the velocity says: none is cut off at the end of the range.
        assert!((kept.position() - before.position() - kept.velocity() * DT).abs() < 1e-6);
    }
    assert!(kept.at_rest() && upper - kept.position() < 0.01, "{}", kept.position());
}

/// The way of a joint from this speed to rest, with room for a step [rad].
fn way(speed: f64, acceleration: f64) -> f64 {
    speed * speed / (2.0 * acceleration) + speed * DT
}

#[test]
fn a_step_of_exactly_the_largest_one_is_no_jump() {
    let l = limiter();
    assert_eq!(l.refuses(JUMP, false), None);
    assert_eq!(l.refuses(-JUMP, true), None);
    let beyond = JUMP * (1.0 + f64::EPSILON);
    assert_eq!(l.refuses(beyond, false), Some(Refusal::Jump(beyond)));
}

/// The first request of another task is compared with the command, the next one of the same task with its last.
#[test]
fn a_task_that_takes_over_is_compared_with_the_command() {
    let mut l = limiter();
    for k in 1..=3 {
        l.follow_position(0.15 * k as f64, DT, 1.0).unwrap();
    }
    assert!(l.position() < 0.01, "the command is far behind the requests: {}", l.position());
    assert_eq!(l.refuses(0.0, true), None);
    assert_eq!(l.refuses(0.0, false), Some(Refusal::Jump(-(0.15 * 3.0))));
    assert_eq!(l.refuses(0.6, false), None);
    assert_eq!(l.refuses(0.6, true), Some(Refusal::Jump(0.6 - l.position())));
}

#[test]
fn requests_exactly_at_a_limit_are_not_limited() {
    let mut l = limiter();
    let (mut q, mut v) = (-1.0, 0.0);
    l.seed(q);
    for _ in 0..100 {
        v = f64::min(v + 4.0 * DT, 1.5);
        q += v * DT;
        let out = l.follow_position(q, DT, 1.0).unwrap();
        assert_eq!((out.value, out.by), (q, None), "at {v} rad/s");
    }
    assert_eq!(v, 1.5);
}

#[test]
fn the_limit_that_changed_a_command_is_named() {
    let by = |velocity: f64, target: f64| {
        let mut l = limiter();
        l.rewind(0.0, velocity);
        l.follow_position(target, DT, 1.0).unwrap().by
    };
    assert_eq!(by(0.0, 1.5 * DT), Some((LimitKind::Acceleration, 1.5 / DT)), "the top speed at once");
    assert_eq!(by(1.5, 1.6 * DT).map(|(kind, _)| kind), Some(LimitKind::Velocity));
    assert_eq!(by(1.5, 1.5 * DT), None);
    let mut l = limiter();
    l.seed(1.98);
    assert_eq!(l.follow_position(2.0, DT, 1.0).unwrap().by, Some((LimitKind::Position, 2.0)));
}

/// At both ends: a joint that runs towards its limit brakes with its acceleration and then is at rest there.
#[test]
fn a_joint_brakes_before_each_of_its_limits() {
    for side in [-1.0, 1.0] {
        let mut l = limiter();
        let (mut target, mut fastest) = (0.0, 0.0f64);
        for _ in 0..600 {
            target = f64::min(target + 1.5 * DT, 2.5);
            let before = l.velocity();
            l.follow_position(side * target, DT, 1.0).unwrap();
            assert!(side * l.position() <= 1.99 + 1e-12 && (l.velocity() - before).abs() <= 4.0 * DT + 1e-9);
            fastest = fastest.max(side * l.velocity());
        }
        assert!((side * l.position() - 1.99).abs() < 1e-9 && fastest > 1.49, "{side}: {} {fastest}", l.position());
    }
}

#[test]
fn what_is_possible_passes_bit_for_bit() {
    let mut l = limiter();
    for k in 0..500 {
        let t = k as f64 * DT;
        let q = 0.5 * (1.0 - (1.2 * t).cos());
        assert_eq!(l.follow_position(q, DT, 1.0), Ok(Limited { value: q, by: None }));
    }
}

#[test]
fn a_step_is_followed_within_limits_without_overshoot_and_met() {
    let mut l = limiter();
    let (mut last, mut last_v) = (0.0, 0.0);
    for _ in 0..200 {
        let out = l.follow_position(0.15, DT, 1.0).unwrap();
        let v = (out.value - last) / DT;
        assert!(v.abs() <= 1.5 * (1.0 + 1e-9) && (v - last_v).abs() <= 4.0 * DT * (1.0 + 1e-6) + 1e-9);
        assert!(out.value <= 0.15 + 1e-12);
        (last, last_v) = (out.value, v);
    }
    assert_eq!(last, 0.15);
}

#[test]
fn a_stream_that_starts_at_speed_is_caught_up_with_and_not_refused() {
    let mut l = limiter();
    let mut gap = 0.0f64;
    for k in 1..300 {
        let target = 0.4 * DT * k as f64;
        gap = (target - l.follow_position(target, DT, 1.0).unwrap().value).abs();
    }
    assert!(gap < 1e-9, "{gap}");
}

#[test]
fn a_jump_is_refused_and_changes_nothing() {
    let mut l = limiter();
    l.follow_position(0.01, DT, 1.0).unwrap();
    let before = l;
    assert_eq!(l.follow_position(0.3, DT, 1.0), Err(Refusal::Jump(0.3 - 0.01)));
    assert_eq!(l.follow_position(f64::NAN, DT, 1.0), Err(Refusal::NonFinite));
    assert_eq!((l.position, l.velocity), (before.position, before.velocity));
}

#[test]
fn a_joint_outside_its_range_may_stay_or_come_in() {
    let mut l = limiter();
    l.seed(2.3);
    assert_eq!(l.follow_position(2.3, DT, 1.0).unwrap().value, 2.3);
    assert!(l.follow_position(2.35, DT, 1.0).unwrap().value <= 2.3);
    for k in 0..400 {
        let q = l.follow_position(2.3 - 0.002 * k as f64, DT, 1.0).unwrap().value;
        assert!(q <= 2.3);
    }
    assert!(l.position() < 1.99);
}

#[test]
fn a_moving_joint_without_requests_decelerates_within_its_limit() {
    let mut l = limiter();
    for k in 1..100 {
        l.follow_position(0.5 * (DT * k as f64).powi(2) * 2.0, DT, 1.0).unwrap();
    }
    let mut v = l.velocity();
    while !l.at_rest() {
        l.hold_position(DT);
        assert!((l.velocity() - v).abs() <= 4.0 * DT + 1e-12);
        v = l.velocity();
    }
    let rest = l.position();
    assert_eq!(l.hold_position(DT), rest);
}

proptest! {
    /// F08 and F09: whatever is asked, what goes out keeps every limit.
    #[test]
    fn f08_f09_no_command_breaks_a_limit(
        start in -1.9f64..1.9,
        steps in prop::collection::vec(-0.25f64..0.25, 1..300),
    ) {
        let mut l = limiter();
        l.seed(start);
        let (mut target, mut last, mut last_v) = (start, start, 0.0);
        for s in steps {
            target += s;
            let q = match l.follow_position(target, DT, 1.0) {
                Ok(out) => out.value,
                Err(_) => { target = l.position(); l.hold_position(DT) }
            };
            let v = (q - last) / DT;
            prop_assert!(v.abs() <= 1.5 * (1.0 + 1e-9) + 1e-9, "velocity {v}");
            prop_assert!((v - last_v).abs() <= 4.0 * DT * (1.0 + 1e-6) + 1e-7, "acceleration {}", (v - last_v) / DT);
            prop_assert!((-1.99 - 1e-12..=1.99 + 1e-12).contains(&q) || (q - start).abs() < 1e-12);
            (last, last_v) = (q, v);
        }
    }

    /// The same in velocity mode, with a joint that follows exactly.
    #[test]
    fn f09_velocities_stop_inside_the_range(targets in prop::collection::vec(-5.0f64..5.0, 1..400)) {
        let mut l = limiter();
        l.seed(0.0);
        let (mut q, mut last) = (0.0, 0.0);
        for t in targets {
            let v = l.follow_velocity(t, (q, q), DT, 1.0).unwrap().value;
            prop_assert!(v.abs() <= 1.5 && (v - last).abs() <= 4.0 * DT + 1e-12);
            q += v * DT;
            last = v;
            prop_assert!((-2.0..=2.0).contains(&q), "{q}");
        }
    }

    /// F07: nothing that is not finite comes out, whatever comes in.
    #[test]
    fn f07_nothing_but_finite_numbers_comes_out(targets in prop::collection::vec(any::<f64>(), 1..50)) {
        let mut l = limiter();
        l.seed(0.1);
        for t in targets {
            if let Ok(out) = l.follow_position(t, DT, 1.0) { prop_assert!(out.value.is_finite()); }
            if let Ok(out) = l.follow_velocity(t, (0.1, 0.1), DT, 1.0) { prop_assert!(out.value.is_finite()); }
            prop_assert!(l.hold_position(DT).is_finite());
        }
    }
}

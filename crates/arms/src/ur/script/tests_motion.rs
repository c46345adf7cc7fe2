//! What the text of `control.script` does with streams, gaps, holds and stops, one at a time.

use super::machine::Controller;
use super::tests_patterns::{HOLD, Judge, Panel, SERVO, SPEED, STOP};
use crate::ur::model::Model;

/// One that follows a steady stream.
fn following(velocity: [f64; 6]) -> Judge {
    let mut judge = Judge::new(Model::Ur5e, 8.0, [0.0; 6]);
    judge.stream(velocity, 1.0, 2);
    let near = judge.velocity.iter().zip(velocity).all(|(v, wanted)| (v - wanted).abs() < 0.01);
    assert!(near, "a steady stream is as fast as it is commanded: {:?}", judge.velocity);
    judge
}

#[test]
fn a_gap_is_bridged_then_all_joints_decelerate_together() {
    let mut judge = following([1.5, -0.75, 0.3, 0.0, 0.0, 0.0]);
    // The last order was one step ago.
    for _ in 0..9 {
        judge.step();
        assert!((judge.velocity[0] - 1.5).abs() < 0.01 && judge.state() == 2, "{:?}", judge.velocity);
    }
    for k in 1..=150 {
        judge.step();
        let expected = (1.5 - 8.0 * 0.002 * f64::from(k)).max(0.0);
        assert!((judge.velocity[0] - expected).abs() < 0.02, "step {k}: {} rad/s", judge.velocity[0]);
        assert!((judge.velocity[1] + 0.5 * judge.velocity[0]).abs() < 0.01, "along the motion: {:?}", judge.velocity);
        assert_eq!(judge.state(), 4, "decelerates because no setpoint came in time");
    }
    assert!(judge.fastest() < 1e-9 && !judge.ended, "at rest, and waiting");
    judge.steps(0.8);
    assert_eq!((judge.state(), judge.ended), (11, true));
}

#[test]
fn a_gap_within_the_tolerance_changes_nothing() {
    let mut judge = following([1.5, 0.0, 0.0, 0.0, 0.0, 0.0]);
    judge.steps(0.016);
    // The stream continues where it would be.
    for k in 508..600 {
        if k % 2 == 0 {
            judge.order(SERVO, [1.5 * 0.002 * f64::from(k), 0.0, 0.0, 0.0, 0.0, 0.0]);
        }
        judge.step();
        assert!((judge.velocity[0] - 1.5).abs() < 0.05 && judge.state() == 2, "{} rad/s", judge.velocity[0]);
    }
}

#[test]
fn setpoints_are_met_again_after_a_gap() {
    for gap in [0.03, 0.1, 0.25] {
        let mut judge = following([1.5, 0.0, 0.0, 0.0, 0.0, 0.0]);
        let start = judge.at();
        judge.steps(gap);
        for k in 0..600 {
            let way = 1.5 * (gap + 0.002 * f64::from(k));
            judge.order(SERVO, [start[0] + way, 0.0, 0.0, 0.0, 0.0, 0.0]);
            judge.step();
        }
        let error = start[0] + 1.5 * (gap + 1.2) - judge.at()[0];
        assert!((0.0..0.012).contains(&error) && judge.state() == 2, "{gap} s: {error} rad behind");
    }
}

#[test]
fn holds_stops_and_far_setpoints_decelerate() {
    for (order, values, state, ends) in
        [(HOLD, [0.0; 6], 1, false), (STOP, [0.0; 6], 10, true), (SERVO, [6.0; 6], 12, true), (9, [0.0; 6], 1, false)]
    {
        for speed in [false, true] {
            let mut judge = Judge::new(Model::Ur5e, 8.0, [0.0; 6]);
            let velocity = [1.5, 1.0, 0.0, 0.0, 0.0, 0.0];
            if speed {
                (0..300).for_each(|_| {
                    judge.order(SPEED, velocity);
                    judge.step();
                });
                assert_eq!((judge.state(), (judge.velocity[0] - 1.5).abs() < 1e-6), (3, true));
            } else {
                judge.stream(velocity, 1.0, 2);
            }
            let from = judge.at()[0];
            judge.order(order, values);
            judge.steps(0.25);
            assert_eq!((judge.state(), judge.ended), (state, ends), "order {order}");
            assert!(judge.fastest() < 1e-6, "order {order}: {:?}", judge.velocity);
            let way = judge.at()[0] - from;
            assert!((way - 1.5 * 1.5 / 16.0).abs() < 0.01, "order {order}: {way} rad");
        }
    }
}

#[test]
fn what_is_extrapolated_ends_before_a_limit() {
    for (room, period) in [(0.02, 1), (0.1, 2), (0.141, 5), (0.16, 2)] {
        // Joint 2 is slower, and nearer to its limit.
        let top = std::f64::consts::TAU;
        let mut judge = Judge::new(Model::Ur5e, 8.0, [top - 1.5 - room, 0.75 - top + room, 0.0, 0.0, 0.0, 0.0]);
        judge.stream([1.5, -0.75, 0.0, 0.0, 0.0, 0.0], 1.0, period);
        judge.steps(0.9);
        assert!(judge.fastest() < 1e-6 && judge.state() == 4, "{room} rad: {:?}", judge.velocity);
    }
    // An arm outside its limits comes back, and goes no further.
    let mut judge = Judge::new(Model::Ur5e, 8.0, [6.3, 0.0, 0.0, 0.0, 0.0, 0.0]);
    judge.stream([0.5, 0.0, 0.0, 0.0, 0.0, 0.0], 0.1, 2);
    judge.stream([-0.5, 0.0, 0.0, 0.0, 0.0, 0.0], 1.0, 2);
    assert!(judge.at()[0] < 6.0, "{} rad", judge.at()[0]);
}

#[test]
fn a_registers_change_while_they_are_read_is_no_order() {
    struct Torn(Panel, std::cell::Cell<i32>);
    impl Controller for Torn {
        fn step_time(&self) -> f64 {
            self.0.step_time()
        }
        fn target(&self) -> [f64; 6] {
            self.0.target()
        }
        fn read_integer(&self, register: usize) -> i32 {
            // The count differs at each read.
            self.1.set(self.1.get() + 1);
            if register == 24 { self.1.get() } else { SERVO }
        }
        fn read_float(&self, _register: usize) -> f64 {
            1.0
        }
        fn write_integer(&mut self, register: usize, value: i32) {
            self.0.write_integer(register, value);
        }
        fn servoj(&mut self, point: &[f64; 6], lookahead: f64) {
            self.0.servoj(point, lookahead);
        }
        fn stopj(&mut self, deceleration: f64) {
            self.0.stopj(deceleration);
        }
    }
    let Judge { mut machine, panel, .. } = Judge::new(Model::Ur5e, 8.0, [0.0; 6]);
    let mut torn = Torn(panel, 0.into());
    assert!((0..100).all(|_| machine.step(&mut torn)));
    assert_eq!((torn.0.point, torn.0.out[1]), (None, 1));
}

#[test]
fn a_motion_at_full_acceleration_is_followed_without_overshoot() {
    // 1 rad at up to 1.5 rad/s and 8 rad/s², then rest.
    let way = |t: f64| {
        let (ramp, end) = (1.5 / 8.0, 1.0 / 1.5 + 1.5 / 8.0);
        match t {
            t if t < ramp => 4.0 * t.max(0.0) * t.max(0.0),
            t if t < end - ramp => 1.5 * (t - 0.5 * ramp),
            t if t < end => 1.0 - 4.0 * (end - t) * (end - t),
            _ => 1.0,
        }
    };
    for period in [1, 2, 5, 8] {
        let mut judge = Judge::new(Model::Ur5e, 8.0, [0.0; 6]);
        for k in 0..800 {
            let t = 0.002 * k as f64;
            if k % period == 0 {
                judge.order(SERVO, [way(t), 0.0, 0.0, 0.0, 0.0, 0.0]);
            }
            judge.step();
            let (at, late) = (judge.at()[0], 0.002 * (period + 8) as f64);
            assert!(at < way(t) + 0.002 && at > way(t - late) - 0.004, "every {period} steps: {at} rad at {t} s");
        }
        assert!((judge.at()[0] - 1.0).abs() < 1e-4, "{} rad", judge.at()[0]);
    }
}

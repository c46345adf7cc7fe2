//! From where an arm starts again: what nothing explains needs an operator's reset, each time, and a lost turn count
//! more than that.

use std::f64::consts::TAU;

use dimos::arm::Interference;
use dimos::control::request::Request;
use dimos::telemetry::{Outcome, Phase};

use super::support::rig::*;

fn enable(rig: &mut Rig) -> (Phase, &'static str) {
    assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
    rig.run_for(0.5);
    (rig.phase(0), rig.samples[0].cause.name())
}

/// Something moves the arm by 0.4 rad while its motors are on.
fn push(rig: &mut Rig) {
    rig.arms[0].setpoint = None;
    for _ in 0..40 {
        rig.arms[0].q.iter_mut().for_each(|q| *q += 0.01);
        rig.tick();
    }
    rig.run_for(0.2);
}

#[test]
fn the_reset_of_another_hold_explains_no_difference() {
    let mut rig = Rig::one_arm(one(trajectory()));
    assert_eq!(rig.ask(Request::Stop { arm: None }), Outcome::Accepted);
    push(&mut rig);
    assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
    assert_eq!(enable(&mut rig), (Phase::Held, "start_mismatch"));
}

#[test]
fn a_reset_explains_one_difference_and_not_the_next() {
    let mut rig = Rig::one_arm(one(trajectory()));
    for _ in 0..2 {
        assert_eq!(rig.ask(Request::PrepareDisable { arm: 0 }), Outcome::Accepted);
        rig.run_for(0.5);
        push(&mut rig);
        assert_eq!(enable(&mut rig), (Phase::Held, "start_mismatch"));
        assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
        assert_eq!(enable(&mut rig), (Phase::Ready, "none"));
    }
}

#[test]
fn where_another_client_has_moved_the_arm_to_is_no_difference() {
    let mut rig = Rig::one_arm(one(trajectory()));
    rig.arms[0].state.interference = Interference::Stop;
    rig.run(3);
    assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "stopped_elsewhere"));
    push(&mut rig);
    rig.arms[0].state.interference = Interference::None;
    rig.run(3);
    assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
    assert_eq!(enable(&mut rig), (Phase::Ready, "none"));
    assert!((rig.commanded(0)[0] - 0.4).abs() < 0.005, "{:?}", rig.commanded(0));
}

/// The last check before the wire has refused it: what it was taken from is no longer so.
#[test]
fn a_first_setpoint_that_is_not_written_is_taken_again() {
    let mut rig = Rig::one_arm(one(trajectory()));
    assert_eq!(rig.ask(Request::PrepareDisable { arm: 0 }), Outcome::Accepted);
    rig.run_for(0.5);
    rig.arms[0].deaf = true;
    let before = rig.commands[0].start_seq;
    assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
    rig.run_for(1.0);
    assert!(rig.commands[0].start_seq >= before + 3, "{} after {before}", rig.commands[0].start_seq);
    assert_eq!(rig.phase(0), Phase::Activating);
    rig.arms[0].deaf = false;
    rig.run_until(1.0, |rig| rig.phase(0) == Phase::Ready);
}

#[test]
fn far_outside_its_limits_an_arm_is_enabled_only_if_its_operator_says_so() {
    let mut rig = Rig::one_arm(one(trajectory()));
    rig.arms[0].enabled = false;
    rig.run(3);
    rig.carry(0, &[RANGE + 0.1, 0.0, 0.0, 0.0, 0.0, 0.0]);
    rig.arms[0].setpoint = None;
    rig.arms[0].enabled = true;
    rig.run(3);
    rig.ask(Request::Reset { arm: 0 });
    assert_eq!(enable(&mut rig), (Phase::Held, "outside_range"));
    assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
    assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: true }), Outcome::Accepted);
    rig.run_for(0.5);
    assert_eq!((rig.phase(0), rig.commanded(0)[0]), (Phase::Ready, RANGE + 0.1));
}

#[test]
fn a_reset_does_not_make_a_lost_turn_a_position() {
    let mut rig = Rig::one_arm(one(trajectory()));
    rig.arms[0].blocked = true;
    rig.arms[0].q[2] += TAU;
    rig.run(10);
    assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "turn_lost"));
    // Without its motors nothing of what was written still holds.
    rig.arms[0].enabled = false;
    rig.run(10);
    assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
    rig.run(10);
    rig.arms[0].enabled = true;
    rig.run(10);
    rig.ask(Request::Reset { arm: 0 });
    rig.ask(Request::Enabled { arm: 0, outside: false });
    rig.run_for(1.0);
    assert_ne!(rig.phase(0), Phase::Ready, "{:?}", rig.samples[0].cause);
}

#[test]
fn a_stop_is_latched_whatever_the_arm_says_and_however_long_it_is_silent() {
    let mut rig = Rig::one_arm(one(trajectory()));
    assert_eq!(rig.ask(Request::PrepareDisable { arm: 0 }), Outcome::Accepted);
    rig.arms[0].silent = true;
    rig.run_for(0.5);
    assert_ne!(rig.phase(0), Phase::Held);
    assert_eq!(rig.ask(Request::Stop { arm: None }), Outcome::Accepted);
    assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "operator_stop"));
}

#[test]
fn a_stop_at_rest_is_not_kept_waiting_by_readings_that_do_not_rest() {
    let mut rig = Rig::one_arm(one(trajectory()));
    assert_eq!(rig.execute(0, sweep(1, 0..6, 0.0, 0.8, 2.0)), Outcome::Accepted);
    rig.run_for(1.0);
    rig.arms[0].error = 7;
    let stops = rig.arms[0].stops;
    // The arm decelerates by its setpoints; then it is given time to settle.
    let mut last = f64::NAN;
    rig.run_until(2.0, |rig| {
        let now = rig.commands[0].values[0];
        rig.phase(0) == Phase::Held && std::mem::replace(&mut last, now) == now
    });
    assert!(rig.commands[0].mode.is_some() && rig.arms[0].stops == stops, "it settles");
    assert_eq!(rig.ask(Request::Stop { arm: None }), Outcome::Accepted);
    assert_eq!(rig.arms[0].stops, stops + 1, "at once");
}

//! A blocked joint after its hold: the arm's own stop first, then the setpoint goes back towards the joint, once and by
//! no more than the row allows, and only on readings that are believed.

use dimos::control::config::*;
use dimos::joint::ControlMode;
use dimos::telemetry::{Outcome, Phase};

use super::support::rig::*;

/// An arm without a stop of its own that takes the pressure off a joint, whose setpoints may go back by `relief` [rad].
fn rig(relief: f64) -> Rig {
    let mut arm = arm("arm", 6);
    arm.supervision.relief = relief;
    let along = TrajectoryParams { path_tolerance: 2.0, ..TrajectoryParams::default() };
    let mut rig = Rig::new(100.0, vec![arm], one(TaskKind::new("trajectory", &along)));
    rig.make_ready();
    rig
}

/// The same, held because something is in the way of all joints; its stop was sent, its relief is to come.
fn held(relief: f64) -> Rig {
    let mut rig = rig(relief);
    rig.arms[0].blocked = true;
    rig.arms[0].v.fill(0.0);
    assert_eq!(rig.execute(0, sweep(1, 0..6, 0.0, 0.6, 1.0)), Outcome::Accepted);
    rig.run_until(2.0, |rig| rig.phase(0) == Phase::Held);
    assert_eq!(rig.samples[0].cause.name(), "tracking");
    let stops = rig.arms[0].stops;
    rig.run_until(2.0, |rig| rig.arms[0].stops > stops);
    assert!(rig.commands[0].mode.is_none(), "{:?}", rig.commands[0]);
    rig
}

/// The same, while the setpoints go back. They are slow, and may end between two of them.
fn on_the_way(relief: f64) -> Rig {
    let mut rig = held(relief);
    rig.run_until(0.5, is_relieved);
    rig.run(10);
    assert!(is_relieved(&rig));
    rig.checked = false;
    rig
}

fn setpoint(rig: &Rig) -> f64 {
    rig.commands[0].values[0]
}

fn is_relieved(rig: &Rig) -> bool {
    rig.commands[0].mode.is_some()
}

#[test]
fn after_its_stop_a_setpoint_goes_back_once_by_the_relief_and_the_arm_is_stopped_again() {
    // By no more than the tracking tolerance, whatever the row says.
    for (relief, most) in [(0.04, 0.04), (0.5, 0.15)] {
        let mut rig = held(relief);
        let (from, stops) = (setpoint(&rig), rig.arms[0].stops);
        assert!(from > most + 0.02, "{from}");
        rig.run_until(0.5, is_relieved);
        rig.run_until(10.0, |rig| rig.arms[0].stops == stops + 1);
        assert!((setpoint(&rig) - (from - most)).abs() < 1e-9, "{} from {from}", setpoint(&rig));
        for _ in 0..500 {
            rig.tick();
            assert!(!is_relieved(&rig), "again, to {}", setpoint(&rig));
        }
        assert_eq!(rig.arms[0].stops, stops + 1);
    }
}

#[test]
fn before_the_stop_no_setpoint_goes_back() {
    let mut rig = rig(0.04);
    rig.arms[0].blocked = true;
    rig.arms[0].v.fill(0.0);
    assert_eq!(rig.execute(0, sweep(1, 0..6, 0.0, 0.6, 1.0)), Outcome::Accepted);
    let (stops, mut furthest) = (rig.arms[0].stops, 0.0);
    while rig.arms[0].stops == stops {
        rig.tick();
        assert!(setpoint(&rig) >= furthest, "back to {} from {furthest}", setpoint(&rig));
        furthest = setpoint(&rig);
    }
    assert_eq!(rig.phase(0), Phase::Held);
}

#[test]
fn a_joint_that_is_pushed_out_of_its_range_draws_no_setpoint_there() {
    let mut rig = rig(0.04);
    assert_eq!(rig.execute(0, sweep(1, 0..6, 0.0, SOFT - 0.005, 3.0)), Outcome::Accepted);
    rig.run_until(6.0, |rig| rig.count(|event| format!("{event:?}").contains("Completed")) > 0);
    rig.arms[0].blocked = true;
    for _ in 0..40 {
        rig.arms[0].q[0] += 0.01;
        rig.arms[0].v[0] = 1.0;
        rig.tick();
    }
    rig.arms[0].v.fill(0.0);
    assert_eq!(rig.phase(0), Phase::Held);
    let mut relieved = false;
    for _ in 0..300 {
        rig.tick();
        relieved |= is_relieved(&rig);
        assert!(setpoint(&rig) <= SOFT + 1e-9, "{}", setpoint(&rig));
    }
    assert!(relieved);
}

#[test]
fn an_arm_that_moves_is_not_relieved_until_it_rests() {
    let mut rig = held(0.04);
    for _ in 0..60 {
        rig.arms[0].q[0] += 0.001;
        rig.arms[0].v[0] = 0.1;
        rig.tick();
        assert!(!is_relieved(&rig), "at {} rad", rig.arms[0].q[0]);
    }
    rig.arms[0].v.fill(0.0);
    rig.run_until(0.5, is_relieved);
}

#[test]
fn readings_that_are_not_believed_relieve_nothing_and_end_a_relief() {
    let mut rig = held(0.2);
    rig.arms[0].q[0] += 1.0;
    for _ in 0..200 {
        rig.tick();
        assert!(!is_relieved(&rig));
    }
    let mut rig = on_the_way(0.2);
    let (there, stops) = (setpoint(&rig), rig.arms[0].stops);
    rig.arms[0].q[1] += 1.0;
    rig.run(200);
    assert!(!is_relieved(&rig) && rig.arms[0].stops > stops);
    assert!((setpoint(&rig) - there).abs() < 0.01, "{there}, then {}", setpoint(&rig));
}

#[test]
fn after_an_operators_stop_nothing_is_relieved() {
    // While a relief is under way.
    let mut rig = on_the_way(0.2);
    let stops = rig.arms[0].stops;
    assert_eq!(rig.ask(dimos::control::request::Request::Stop { arm: None }), Outcome::Accepted);
    assert!(!is_relieved(&rig) && rig.arms[0].stops == stops + 1, "at once");
    for _ in 0..200 {
        rig.tick();
        assert!(!is_relieved(&rig));
    }
    // Instead of a tracking error.
    let mut rig = self::rig(0.2);
    assert_eq!(rig.execute(0, sweep(1, 0..6, 0.0, 0.6, 1.0)), Outcome::Accepted);
    rig.run_for(0.5);
    rig.arms[0].blocked = true;
    rig.arms[0].v.fill(0.0);
    assert_eq!(rig.ask(dimos::control::request::Request::Stop { arm: None }), Outcome::Accepted);
    let mut furthest = 0.0;
    for _ in 0..400 {
        rig.tick();
        if rig.commands[0].mode == Some(ControlMode::ServoPosition) {
            assert!(setpoint(&rig) >= furthest, "back to {}", setpoint(&rig));
            furthest = setpoint(&rig);
        }
    }
    assert!(furthest > 0.0);
}

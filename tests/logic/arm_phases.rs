//! How an arm goes through its phases: enabled, ready, held, reset, disabled; on a virtual clock.

use dimos::arm::Link;
use dimos::control::coordinator::TickTime;
use dimos::control::request::Request;
use dimos::telemetry::{Cause, Event, Outcome, Phase, Reason, TaskState};

use crate::support::rig::*;

#[test]
fn stop_reset_and_enable_are_three_acts_and_none_moves_the_arm() {
    for (stop_takes_hold, lag, sag) in [(false, 0.0, 0.0), (true, 0.0, 0.0), (true, 0.06, 0.0), (false, 0.06, 0.03)] {
        let mut sagging = arm("arm", 6);
        sagging.supervision.accuracy = 0.02;
        let mut rig = Rig::new(100.0, vec![sagging], one(trajectory()));
        rig.make_ready();
        (rig.arms[0].stop_takes_hold, rig.arms[0].lag, rig.arms[0].sag) = (stop_takes_hold, lag, sag);
        rig.run_for(1.0);
        let commanded = rig.commanded(0)[0];
        rig.execute(0, sweep(1, 0..6, commanded, 1.0, 2.0));
        rig.run_for(1.0);
        assert_eq!(rig.ask(Request::Stop { arm: None }), Outcome::Accepted);
        assert_eq!(rig.phase(0), Phase::Held);
        assert!(rig.reported(Event::Task(0, TaskState::Aborted, Reason::ArmHeld(0, Cause::Operator))));
        rig.run_for(2.0);
        assert_eq!(
            (rig.commands[0].mode, rig.arms[0].stops),
            (None, 1),
            "at rest it gets no more commands, stopped once"
        );
        let rest = rig.arms[0].q[0];
        let here = |rig: &Rig, what: &str| {
            let moved = (rig.arms[0].q[0] - rest).abs();
            assert!(moved < 0.005, "{what} moved it by {moved} ({stop_takes_hold} {lag} {sag})");
        };
        let id = rig.send(Request::Execute { task: 0, motion: sweep(2, 0..6, rest, 1.2, 1.0) });
        rig.tick();
        assert_eq!(rig.outcome(id), Outcome::ArmLatched(0, Cause::Operator));
        assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::ArmLatched(0, Cause::Operator));
        assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
        assert_eq!(rig.phase(0), Phase::Standby);
        rig.run_for(0.5);
        here(&rig, "reset");
        let id = rig.send(Request::Execute { task: 0, motion: sweep(3, 0..6, rest, 1.2, 1.0) });
        rig.tick();
        assert_eq!(rig.outcome(id).name(), "ARM_NOT_READY");
        assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
        let before = rig.events.len();
        for _ in 0..100 {
            rig.tick();
            here(&rig, "enable");
        }
        assert_eq!(rig.phase(0), Phase::Ready);
        assert_eq!(rig.events.len(), before + 1, "one event, Ready");
    }
}

#[test]
fn an_arm_that_is_being_disabled_or_enabled_may_be_silent_meanwhile() {
    let mut rig = Rig::one_arm(one(trajectory()));
    assert_eq!(rig.ask(Request::PrepareDisable { arm: 0 }), Outcome::Accepted);
    rig.run_for(0.6);
    rig.arms[0].silent = true; // its device thread waits for the motors
    rig.run_for(0.5);
    assert_eq!((rig.phase(0), rig.commands[0].mode), (Phase::Standby, None), "no fault, and nothing is sent");
    assert_eq!(
        rig.ask(Request::Enabled { arm: 0, outside: false }),
        Outcome::StartStateUnavailable(0),
        "not on an old state"
    );
    (rig.arms[0].silent, rig.arms[0].enabled) = (false, false);
    rig.run(3);
    assert_eq!(rig.phase(0), Phase::Disabled);

    let mut rig = Rig::one_arm(one(trajectory()));
    rig.ask(Request::PrepareDisable { arm: 0 });
    rig.run_for(0.6);
    rig.arms[0].link = Link::Faulted;
    rig.run(3);
    assert_eq!((rig.phase(0), rig.samples[0].cause), (Phase::Held, Cause::LinkLost), "a broken connection is a fault");
}

#[test]
fn a_stop_while_an_arm_is_being_enabled_is_not_lost() {
    let mut rig = Rig::new(100.0, vec![arm("arm", 6)], one(trajectory()));
    rig.arms[0].enabled = false;
    rig.run(3);
    assert_eq!(rig.phase(0), Phase::Disabled);
    assert_eq!(rig.ask(Request::Stop { arm: None }), Outcome::Accepted);
    rig.arms[0].enabled = true; // the motors were on their way
    rig.run(3);
    assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::ArmLatched(0, Cause::Operator));
    rig.run_for(0.5);
    assert_eq!((rig.phase(0), rig.commands[0].mode, rig.arms[0].stops), (Phase::Held, None, 1));
    assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
    assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
}

#[test]
fn an_open_stop_input_latches_a_hold_in_every_phase_and_is_reset_only_when_closed() {
    for (enabled, moving) in [(true, true), (true, false), (false, false)] {
        let mut rig = Rig::new(100.0, vec![arm("arm", 6)], one(trajectory()));
        rig.arms[0].enabled = enabled;
        if enabled {
            rig.make_ready();
        }
        rig.run_for(0.5);
        if moving {
            let q = rig.commanded(0)[0];
            rig.execute(0, sweep(1, 0..6, q, 1.0, 2.0));
            rig.run_for(0.8);
        }
        let speed = rig.speed(0);
        rig.arms[0].state.stop_input_open = true;
        // In the tick after the reading.
        rig.run(1);
        assert_eq!((rig.phase(0), rig.samples[0].cause), (Phase::Held, Cause::StopInput), "{enabled} {moving}");
        assert!(!moving || rig.speed(0) < speed, "{} {speed}", rig.speed(0));
        assert!(rig.reported(Event::Arm(0, Phase::Held, Cause::StopInput)));
        rig.run_for(2.0);
        assert_eq!((rig.commands[0].mode, rig.arms[0].stops), (None, u32::from(enabled)));
        let rest = rig.arms[0].q[0];
        assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::StillFaulted(0, Cause::StopInput));
        assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::ArmLatched(0, Cause::StopInput));
        rig.arms[0].state.stop_input_open = false;
        rig.run_for(0.5);
        assert_eq!((rig.phase(0), rig.commands[0].mode), (Phase::Held, None), "closing it moves nothing");
        assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
        rig.run_for(0.5);
        assert_eq!(rig.phase(0), if enabled { Phase::Standby } else { Phase::Disabled });
        assert_eq!(rig.arms[0].q[0], rest);
    }
}

#[test]
fn activating_again_and_again_does_not_sink() {
    let mut sagging = arm("arm", 6);
    sagging.supervision.accuracy = 0.02;
    let mut rig = Rig::new(100.0, vec![sagging], one(trajectory()));
    rig.make_ready();
    rig.arms[0].sag = 0.02;
    rig.arms[0].lag = 0.03;
    rig.run_for(1.0);
    let before = rig.arms[0].q[0];
    for _ in 0..20 {
        rig.ask(Request::Stop { arm: Some(0) });
        rig.run_for(1.0);
        rig.ask(Request::Reset { arm: 0 });
        rig.ask(Request::Enabled { arm: 0, outside: false });
        rig.run_for(0.5);
    }
    assert_eq!(rig.phase(0), Phase::Ready);
    assert!((rig.arms[0].q[0] - before).abs() < 1e-6, "sank by {}", before - rig.arms[0].q[0]);
}

#[test]
fn an_arm_that_was_carried_away_while_off_is_held_where_it_is() {
    for (off, carried, accuracy) in [(true, 0.03, 0.005), (true, 0.03, 0.02), (true, 0.4, 0.005), (false, 0.4, 0.005)] {
        let mut inexact = arm("arm", 6);
        inexact.supervision.accuracy = accuracy;
        let mut rig = Rig::new(100.0, vec![inexact], one(trajectory()));
        rig.make_ready();
        assert_eq!(rig.ask(Request::PrepareDisable { arm: 0 }), Outcome::Accepted);
        rig.run_for(0.6);
        rig.arms[0].enabled = !off;
        rig.run(3);
        assert_eq!(rig.phase(0), if off { Phase::Disabled } else { Phase::Standby });
        rig.arms[0].setpoint = None;
        for _ in 0..40 {
            rig.arms[0].q.iter_mut().for_each(|q| *q += carried / 40.0);
            rig.run(1);
        }
        let there = rig.arms[0].q[0];
        rig.run(3);
        rig.arms[0].enabled = true;
        rig.run(3);
        assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
        rig.run_for(0.5);
        assert!((rig.arms[0].q[0] - there).abs() < 0.005, "{} from {there}", rig.arms[0].q[0]);
        if !off {
            // Under power nothing explains that: an operator looks first.
            assert_eq!((rig.phase(0), rig.samples[0].cause.name()), (Phase::Held, "start_mismatch"));
            assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
            assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
            rig.run_for(0.5);
            assert!((rig.arms[0].q[0] - there).abs() < 0.005, "{} from {there}", rig.arms[0].q[0]);
        }
        assert_eq!(rig.phase(0), Phase::Ready);
    }
}

#[test]
fn an_arm_that_lost_its_connection_is_held_where_it_came_to_rest() {
    let mut inexact = arm("arm", 6);
    inexact.supervision.accuracy = 0.02;
    let mut rig = Rig::new(100.0, vec![inexact], one(trajectory()));
    rig.make_ready();
    rig.arms[0].link = Link::Faulted;
    rig.arms[0].setpoint = None;
    for _ in 0..40 {
        rig.arms[0].q.iter_mut().for_each(|q| *q += 0.03 / 40.0);
        rig.run(1);
    }
    let there = rig.arms[0].q[0];
    rig.arms[0].link = Link::Up;
    rig.run(3);
    assert_eq!(rig.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
    assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
    rig.run_for(0.5);
    assert_eq!((rig.phase(0), rig.arms[0].q[0]), (Phase::Ready, there), "not where it was sent last");
}

#[test]
fn the_first_command_after_activation_holds() {
    let mut outside = arm("arm", 6);
    outside.supervision.outside = 0.11;
    let mut rig = Rig::new(100.0, vec![outside], one(trajectory()));
    rig.arms[0].q = vec![0.7, -0.4, 2.1, 0.0, 1.99, -1.995];
    rig.arms[0].mode_delay = 5;
    let before = rig.arms[0].q.clone();
    rig.run(2);
    assert_eq!((rig.phase(0), rig.commands[0].mode), (Phase::Standby, None), "nothing is sent before `enable`");
    assert_eq!(rig.execute(0, sweep(1, 0..6, 0.0, 0.1, 1.0)), Outcome::ArmNotReady(0, Phase::Standby, Cause::None));
    rig.ask(Request::Enabled { arm: 0, outside: false });
    assert_eq!(rig.phase(0), Phase::Activating);
    let ready_after = rig.run_until(1.0, |r| r.phase(0) == Phase::Ready);
    assert!(ready_after >= 0.2, "{ready_after}");
    for (q, b) in rig.arms[0].q.iter().zip(&before) {
        assert!((q - b).abs() <= 0.005, "{q} from {b}");
    }
}

#[test]
fn an_arm_is_not_taken_up_without_a_fresh_state() {
    let mut rig = Rig::new(100.0, vec![arm("arm", 6)], one(trajectory()));
    assert_eq!(rig.coordinator.tick(time(&rig), &[Default::default()], || None).arms[0].phase, Phase::Unknown);
    rig.run(2);
    rig.arms[0].silent = true;
    rig.run(10);
    assert_ne!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
    assert_eq!(rig.commands[0].mode, None);
}

fn time(rig: &Rig) -> TickTime {
    let next = rig.now.after(rig.config.period());
    TickTime { now: rig.now, next, skipped: 0, late_ns: 0, woke_late_ns: 0 }
}

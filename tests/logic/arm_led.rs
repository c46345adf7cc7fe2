//! An arm that is led, by hand or by its own controller: what it gets meanwhile, what holds it, and how the run takes
//! it over, on a virtual clock.

use dimos::control::request::Request;
use dimos::telemetry::{Cause, Event, LedBy, Outcome, Phase};

use crate::support::rig::*;

fn led(by: LedBy) -> Rig {
    let mut rig = Rig::one_arm(one(trajectory()));
    rig.run_for(0.5);
    assert_eq!(rig.ask(Request::Lead { arm: 0, by }), Outcome::Accepted);
    assert_eq!(rig.phase(0), Phase::Led);
    rig
}

/// Moves the first joint evenly, as a hand or a controller does.
fn lead(rig: &mut Rig, velocity: f64, seconds: f64) {
    let ticks = (seconds * rig.config.rate) as usize;
    for _ in 0..ticks {
        let dt = rig.dt();
        rig.arms[0].setpoint = None;
        rig.arms[0].q[0] += velocity * dt;
        rig.arms[0].v[0] = velocity;
        rig.tick();
    }
    rig.arms[0].v[0] = 0.0;
}

#[test]
fn a_led_arm_gets_no_setpoint_and_is_taken_over_where_it_is() {
    for by in [LedBy::Hand, LedBy::Controller] {
        let mut rig = led(by);
        rig.arms[0].stop_takes_hold = true;
        lead(&mut rig, 0.8, 1.0);
        assert_eq!((rig.phase(0), rig.commands[0].mode, rig.arms[0].stops), (Phase::Led, None, 0), "{by:?}");
        let here = rig.arms[0].q[0];
        let id = rig.send(Request::Execute { task: 0, motion: sweep(1, 0..6, here, 1.0, 1.0) });
        rig.tick();
        assert_eq!(rig.outcome(id), Outcome::ArmNotReady(0, Phase::Led, Cause::None));
        assert_eq!(
            rig.ask(Request::Enabled { arm: 0, outside: false }),
            Outcome::ArmNotReady(0, Phase::Led, Cause::None)
        );
        // Taken over: its own stop first, then it is enabled. The rig checks each setpoint.
        assert_eq!(rig.ask(Request::PrepareDisable { arm: 0 }), Outcome::Accepted);
        rig.run(3);
        assert_eq!((rig.phase(0), rig.arms[0].stops), (Phase::Standby, 1), "{by:?}");
        assert_eq!(rig.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);
        rig.run_for(0.5);
        assert_eq!(rig.phase(0), Phase::Ready);
        assert!((rig.arms[0].q[0] - here).abs() < 1e-9 && (rig.commanded(0)[0] - here).abs() < 1e-9, "{by:?}");
        assert_eq!(rig.execute(0, sweep(2, 0..1, here, here - 0.3, 1.0)), Outcome::Accepted, "{by:?}");
    }
}

#[test]
fn an_arm_is_led_only_from_rest_without_a_task_and_its_motors_as_the_way_needs_them() {
    let mut rig = Rig::one_arm(one(trajectory()));
    rig.run_for(0.5);
    let lead = |by| Request::Lead { arm: 0, by };
    rig.execute(0, sweep(1, 0..6, 0.0, 0.5, 1.0));
    rig.run_for(0.3);
    assert_eq!(rig.ask(lead(LedBy::Hand)), Outcome::AlreadyExecuting(0));
    rig.run_for(2.0);
    rig.arms[0].v[2] = 0.1;
    rig.arms[0].setpoint = None;
    assert_eq!(rig.ask(lead(LedBy::Hand)), Outcome::ArmMoving(0), "something else moves it");
    rig.arms[0].v[2] = 0.0;
    rig.ask(Request::Pause { on: true });
    assert_eq!(rig.ask(lead(LedBy::Controller)), Outcome::Paused);
    rig.ask(Request::Pause { on: false });
    rig.ask(Request::Stop { arm: None });
    for by in [LedBy::Hand, LedBy::HandMotorsOff, LedBy::Controller] {
        assert_eq!(rig.ask(lead(by)), Outcome::ArmLatched(0, Cause::Operator));
    }

    let mut off = Rig::new(100.0, vec![arm("arm", 6)], one(trajectory()));
    off.arms[0].enabled = false;
    off.run(3);
    assert_eq!(off.ask(lead(LedBy::Hand)), Outcome::ArmNotReady(0, Phase::Disabled, Cause::None));
    assert_eq!(off.ask(lead(LedBy::HandMotorsOff)), Outcome::Accepted);
    off.carry(0, &[0.0, 0.2, 0.0, 0.0, 0.0, 0.0]);
    off.run_for(0.3);
    assert_eq!((off.phase(0), off.commands[0].mode), (Phase::Led, None));
    assert_eq!(off.ask(Request::PrepareDisable { arm: 0 }), Outcome::Accepted);
    off.run(3);
    assert_eq!((off.phase(0), off.arms[0].stops), (Phase::Disabled, 0), "a stop means nothing to it");
}

#[test]
fn a_controller_that_is_too_fast_or_out_of_range_is_stopped_and_latched_and_a_hand_is_not() {
    for (velocity, held) in [(1.09 * V_MAX, false), (1.11 * V_MAX, true), (-1.2 * V_MAX, true)] {
        let mut rig = led(LedBy::Controller);
        lead(&mut rig, velocity, 0.1);
        let cause = rig.samples[0].cause;
        assert_eq!(rig.phase(0) == Phase::Held, held, "{velocity}: {cause:?}");
        assert!(!held || matches!(cause, Cause::LedTooFast(0, v) if (v - velocity).abs() < 1e-9), "{cause:?}");
        assert_eq!(rig.arms[0].stops, u32::from(held));
        let mut hand = led(LedBy::Hand);
        lead(&mut hand, velocity, 0.1);
        assert_eq!(hand.phase(0), Phase::Led, "{velocity}: a hand may");
    }
    for (readings, phase) in [(1, Phase::Led), (2, Phase::Held)] {
        let mut fast = led(LedBy::Controller);
        for _ in 0..readings {
            fast.arms[0].v[0] = 1.3 * V_MAX;
            fast.tick();
        }
        fast.arms[0].v[0] = 0.0;
        fast.run(3);
        assert_eq!(fast.phase(0), phase, "one velocity may be noise, two are not");
    }

    let mut below = led(LedBy::Controller);
    lead(&mut below, -0.5, (RANGE - 0.01) / 0.5);
    assert_eq!(below.phase(0), Phase::Led, "inside its range");
    lead(&mut below, -0.5, 0.06);
    assert!(matches!(below.samples[0].cause, Cause::LedOutOfRange(0, q) if q < -RANGE), "{:?}", below.samples[0]);

    let mut rig = led(LedBy::Controller);
    rig.arms[0].q[0] = RANGE - 0.05;
    let mut slow = led(LedBy::Controller);
    lead(&mut slow, 0.5, (RANGE - 0.01) / 0.5);
    assert_eq!(slow.phase(0), Phase::Led, "inside its range");
    lead(&mut slow, 0.5, 0.06);
    assert!(matches!(slow.samples[0].cause, Cause::LedOutOfRange(0, q) if q > RANGE), "{:?}", slow.samples[0]);
    assert_eq!((slow.phase(0), slow.arms[0].stops), (Phase::Held, 1));
    // Back inside, it is reset and enabled as after any hold.
    slow.arms[0].q[0] = 1.0;
    slow.run(10);
    assert_eq!(slow.ask(Request::Reset { arm: 0 }), Outcome::Accepted);
    assert_eq!(slow.ask(Request::Enabled { arm: 0, outside: false }), Outcome::Accepted);

    let mut hand = led(LedBy::Hand);
    lead(&mut hand, 0.5, (RANGE + 0.05) / 0.5);
    assert_eq!(hand.phase(0), Phase::Led);
    hand.ask(Request::PrepareDisable { arm: 0 });
    hand.run(3);
    hand.ask(Request::Enabled { arm: 0, outside: false });
    hand.run_for(0.5);
    let outside = hand.ask(Request::Lead { arm: 0, by: LedBy::Controller });
    assert!(matches!(outside, Outcome::OutOfLimits(0, by) if by > 0.04), "{outside:?}");
}

#[test]
fn the_joint_that_keeps_a_controller_from_starting_is_named_over_all_arms() {
    let mut rig = Rig::new(100.0, vec![arm("left", 6), arm("right", 6)], Vec::new());
    rig.make_ready();
    assert_eq!(rig.ask(Request::Lead { arm: 1, by: LedBy::Hand }), Outcome::Accepted);
    for _ in 0..400 {
        rig.arms[1].setpoint = None;
        rig.arms[1].q[2] += (RANGE + 0.05) / 400.0;
        rig.tick();
    }
    rig.ask(Request::PrepareDisable { arm: 1 });
    rig.run(3);
    rig.ask(Request::Enabled { arm: 1, outside: false });
    rig.run_for(0.5);
    let outside = rig.ask(Request::Lead { arm: 1, by: LedBy::Controller });
    assert!(matches!(outside, Outcome::OutOfLimits(8, by) if by > 0.04), "{outside:?}");
}

#[test]
fn each_lead_has_a_number_of_its_own_and_a_refused_one_has_none() {
    let mut rig = led(LedBy::Hand);
    let first = rig.commands[0].lead_seq;
    rig.ask(Request::Stop { arm: None });
    let lead = || Request::Lead { arm: 0, by: LedBy::Controller };
    assert_eq!(rig.ask(lead()), Outcome::ArmLatched(0, Cause::Operator));
    rig.ask(Request::Reset { arm: 0 });
    rig.ask(Request::Enabled { arm: 0, outside: false });
    rig.run_for(0.5);
    assert_eq!(rig.commands[0].lead_seq, first);
    assert_eq!(rig.ask(lead()), Outcome::Accepted);
    assert_eq!(rig.commands[0].lead_seq, first + 1);
}

#[test]
fn stops_faults_and_the_end_of_the_run_reach_a_led_arm() {
    let mut stopped = led(LedBy::Controller);
    lead(&mut stopped, 0.5, 0.3);
    assert_eq!(stopped.ask(Request::Stop { arm: None }), Outcome::Accepted);
    assert_eq!((stopped.phase(0), stopped.arms[0].stops), (Phase::Held, 1), "in the same tick");

    // It moves on: another stop is another stop.
    lead(&mut stopped, 0.5, 0.3);
    assert_eq!(stopped.ask(Request::Stop { arm: Some(0) }), Outcome::Accepted);
    assert_eq!((stopped.phase(0), stopped.arms[0].stops), (Phase::Held, 2));

    for end in [Request::EndNative { arm: 0 }, Request::Pause { on: true }] {
        let mut native = led(LedBy::Controller);
        lead(&mut native, 0.5, 0.3);
        native.ask(end);
        native.run(2);
        assert_eq!((native.phase(0), native.arms[0].stops), (Phase::Standby, 1));
        assert!(!native.commands[0].led);
    }
    let mut hand = led(LedBy::Hand);
    assert_eq!(hand.ask(Request::EndNative { arm: 0 }), Outcome::AlreadyStopped);
    assert_eq!((hand.phase(0), hand.commands[0].led), (Phase::Led, true));

    let mut elsewhere = led(LedBy::Controller);
    elsewhere.arms[0].state.interference = dimos::arm::Interference::Stop;
    elsewhere.tick();
    assert_eq!((elsewhere.phase(0), elsewhere.samples[0].cause), (Phase::Held, Cause::StoppedElsewhere));
    assert_eq!(elsewhere.arms[0].stops, 1, "or its controller continues when it is released");
    elsewhere.run(5);
    assert_eq!(elsewhere.arms[0].stops, 1, "once");

    // Another client controls it now: a stop of this run would be a command to that client's arm.
    let mut of_another = Rig::one_arm(one(trajectory()));
    of_another.arms[0].state.interference = dimos::arm::Interference::Mode;
    of_another.run(2);
    assert_eq!((of_another.phase(0), of_another.samples[0].cause), (Phase::Held, Cause::ModeChanged));
    of_another.ask(Request::Stop { arm: None });
    of_another.run(2);
    assert_eq!(of_another.arms[0].stops, 0);

    let mut silent = led(LedBy::Controller);
    silent.arms[0].silent = true;
    silent.run_for(0.2);
    assert!(matches!(silent.samples[0].cause, Cause::Stale(_)), "{:?}", silent.samples[0].cause);
    assert_eq!((silent.phase(0), silent.arms[0].stops), (Phase::Held, 1));

    let mut unpowered = led(LedBy::Hand);
    unpowered.arms[0].enabled = false;
    unpowered.run(2);
    assert_eq!((unpowered.phase(0), unpowered.samples[0].cause), (Phase::Held, Cause::PowerLost));

    let mut lost = led(LedBy::Controller);
    lost.arms[0].link = dimos::arm::Link::Down;
    lost.run_for(0.1);
    assert_eq!((lost.phase(0), lost.samples[0].cause), (Phase::Held, Cause::LinkLost));
    let owed = lost.arms[0].stops;
    assert_eq!(lost.ask(Request::Enabled { arm: 0, outside: false }), Outcome::ArmLatched(0, Cause::LinkLost));
    lost.arms[0].link = dimos::arm::Link::Up;
    lost.run(2);
    assert_eq!(lost.arms[0].stops, owed + 1, "as soon as it can be reached");

    let mut ended = led(LedBy::Controller);
    lead(&mut ended, 0.5, 0.3);
    ended.ask(Request::Shutdown);
    ended.run(2);
    assert_eq!((ended.phase(0), ended.arms[0].stops), (Phase::Standby, 1));
    assert!(ended.reported(Event::Arm(0, Phase::Led, Cause::None)));
}

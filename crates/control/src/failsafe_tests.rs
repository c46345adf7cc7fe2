//! Every phase against every trouble, without an arm.

use super::*;

const FRESH: Freshness = Freshness { fresh: true, age: Age { age_us: 1_000, limit_us: 50_000, own_us: 0 } };
const OLD: Freshness = Freshness { fresh: false, age: Age { age_us: 60_000, limit_us: 50_000, own_us: 0 } };

fn at(ms: u64) -> Mono {
    Mono(1_000_000_000 + ms * 1_000_000)
}

fn healthy() -> ArmState {
    ArmState { seq: 1, dof: 6, link: Link::Up, enabled: true, ..ArmState::default() }
}

/// What may be wrong with an arm, and the cause of the hold that follows.
fn troubles() -> Vec<(ArmState, Freshness, Cause)> {
    vec![
        (ArmState { error: 21, ..healthy() }, FRESH, Cause::Fault(21)),
        (ArmState { error: 21, link: Link::Down, ..healthy() }, FRESH, Cause::Fault(21)),
        (ArmState { link: Link::Down, ..healthy() }, FRESH, Cause::LinkLost),
        (ArmState { link: Link::Faulted, ..healthy() }, FRESH, Cause::LinkLost),
        (ArmState { link: Link::Stale, ..healthy() }, FRESH, Cause::Stale(FRESH.age)),
        (healthy(), OLD, Cause::Stale(OLD.age)),
        (ArmState { interference: Interference::Mode, ..healthy() }, FRESH, Cause::ModeChanged),
        (ArmState { interference: Interference::Power, ..healthy() }, FRESH, Cause::PowerChanged),
        (ArmState { interference: Interference::Identity, ..healthy() }, FRESH, Cause::IdentityChanged),
        (ArmState { interference: Interference::Stop, ..healthy() }, FRESH, Cause::StoppedElsewhere),
        (ArmState { self_held: true, ..healthy() }, FRESH, Cause::HeartbeatLost),
    ]
}

/// An arm in this phase since `at(0)`, with nothing wrong.
fn in_phase(phase: Phase) -> Failsafe {
    Failsafe { phase, cause: Cause::None, since: at(0), ..Failsafe::default() }
}

#[test]
fn each_trouble_holds_an_arm_that_may_move_and_has_its_own_cause() {
    assert_eq!(trouble(&healthy(), FRESH), None);
    for (state, fresh, cause) in troubles() {
        assert_eq!(trouble(&state, fresh), Some(cause));
        for phase in [Phase::Ready, Phase::Activating] {
            let mut arm = in_phase(phase);
            assert!(arm.update(&state, fresh, at(10)), "{phase:?} {cause:?}");
            assert_eq!((arm.phase(), arm.cause()), (Phase::Held, cause), "{phase:?}");
            assert!(!arm.update(&healthy(), FRESH, at(20)), "a hold is latched: {cause:?}");
        }
    }
}

#[test]
fn while_the_motors_are_switched_an_old_state_and_a_self_hold_pass() {
    for (state, fresh, cause) in troubles() {
        let mut arm = in_phase(Phase::Standby);
        arm.update(&state, fresh, at(10));
        let passes = matches!(cause, Cause::HeartbeatLost | Cause::Stale(_));
        let expected = if passes { (Phase::Standby, Cause::None) } else { (Phase::Held, cause) };
        assert_eq!((arm.phase(), arm.cause()), expected);
    }
    let off = ArmState { enabled: false, ..healthy() };
    let mut arm = in_phase(Phase::Standby);
    assert!(!arm.update(&off, OLD, at(10)), "an old state says nothing of the motors");
    assert!(arm.update(&off, FRESH, at(20)));
    assert_eq!(arm.phase(), Phase::Disabled);
}

#[test]
fn the_first_state_decides_between_standby_and_disabled() {
    let mut arm = Failsafe::default();
    assert!(!arm.update(&ArmState { seq: 0, ..healthy() }, FRESH, at(0)));
    assert_eq!(arm.phase(), Phase::Unknown);
    assert!(arm.update(&healthy(), FRESH, at(0)));
    assert_eq!((arm.phase(), arm.cause()), (Phase::Standby, Cause::None));
    let mut arm = Failsafe::default();
    assert!(arm.update(&ArmState { enabled: false, ..healthy() }, FRESH, at(0)));
    assert_eq!(arm.phase(), Phase::Disabled);
}

#[test]
fn only_another_arm_and_motors_that_someone_else_enabled_hold_a_disabled_arm() {
    for (state, fresh, cause) in troubles() {
        let mut arm = in_phase(Phase::Disabled);
        let changed = arm.update(&ArmState { enabled: false, ..state }, fresh, at(10));
        assert_eq!(changed, matches!(cause, Cause::PowerChanged | Cause::IdentityChanged), "{cause:?}");
        assert_eq!(arm.phase(), if changed { Phase::Held } else { Phase::Disabled });
    }
}

#[test]
fn an_arm_is_ready_at_the_end_of_the_ramp_and_held_when_its_motors_go_off() {
    let mut arm = in_phase(Phase::Activating);
    let ramp = ACTIVATION_RAMP.as_millis() as u64;
    assert!(!arm.update(&healthy(), FRESH, at(ramp - 1)));
    assert!(arm.update(&healthy(), FRESH, at(ramp)));
    assert_eq!((arm.phase(), arm.cause()), (Phase::Ready, Cause::None));
    assert!(!arm.update(&healthy(), FRESH, at(2 * ramp)));
    for phase in [Phase::Ready, Phase::Activating] {
        let mut arm = in_phase(phase);
        assert!(arm.update(&ArmState { enabled: false, ..healthy() }, FRESH, at(2 * ramp)));
        assert_eq!((arm.phase(), arm.cause()), (Phase::Held, Cause::PowerLost));
    }
}

#[test]
fn the_first_cause_of_a_hold_stays_and_only_an_operator_holds_a_disabled_arm() {
    for (phase, by_operator, by_overrun) in [
        (Phase::Unknown, false, false),
        (Phase::Disabled, true, false),
        (Phase::Standby, true, true),
        (Phase::Activating, true, true),
        (Phase::Ready, true, true),
    ] {
        for (cause, holds) in [(Cause::Operator, by_operator), (Cause::Overrun, by_overrun)] {
            let mut arm = in_phase(phase);
            arm.hold(cause, at(5));
            assert_eq!(arm.phase() == Phase::Held, holds, "{phase:?} {cause:?}");
            arm.hold(Cause::Jump, at(6));
            assert!(!holds || arm.cause() == cause, "{phase:?} {cause:?}");
        }
    }
}

#[test]
fn a_reset_is_refused_while_the_cause_persists() {
    for (state, fresh, cause) in troubles() {
        let mut arm = Failsafe { phase: Phase::Held, cause: Cause::Operator, since: at(0), ..Failsafe::default() };
        let outcome = arm.reset(3, &state, fresh, at(10));
        // The hold of a device thread, and readings that are not believed, end when the motors are enabled.
        if matches!(cause, Cause::HeartbeatLost | Cause::Stale(_)) {
            assert_eq!((outcome, arm.phase()), (Outcome::Accepted, Phase::Standby));
        } else {
            assert_eq!((outcome, arm.phase()), (Outcome::StillFaulted(3, cause), Phase::Held));
        }
    }
    for (enabled, phase) in [(true, Phase::Standby), (false, Phase::Disabled)] {
        let mut arm = Failsafe { phase: Phase::Held, cause: Cause::Jump, since: at(0), ..Failsafe::default() };
        assert_eq!(arm.reset(0, &ArmState { enabled, ..healthy() }, FRESH, at(10)), Outcome::Accepted);
        assert_eq!((arm.phase(), arm.cause()), (phase, Cause::None));
    }
    let mut arm = in_phase(Phase::Ready);
    assert_eq!(arm.reset(0, &healthy(), FRESH, at(10)), Outcome::Accepted);
    assert_eq!(arm.phase(), Phase::Ready, "there is nothing to reset");
}

#[test]
fn an_arm_is_enabled_only_with_a_fresh_state_without_trouble_and_with_power() {
    for phase in [Phase::Unknown, Phase::Disabled, Phase::Standby] {
        for (state, fresh, cause) in troubles() {
            let mut arm = in_phase(phase);
            let expected = match cause {
                Cause::Stale(_) | Cause::LinkLost => Outcome::StartStateUnavailable(1),
                cause => Outcome::StillFaulted(1, cause),
            };
            assert_eq!((arm.on_enabled(1, &state, fresh, at(10)), arm.phase()), (expected, phase));
        }
        let mut arm = in_phase(phase);
        let off = ArmState { enabled: false, ..healthy() };
        assert_eq!(arm.on_enabled(1, &off, FRESH, at(10)), Outcome::ArmNotReady(1, phase, Cause::PowerLost));
        assert_eq!(arm.on_enabled(1, &healthy(), FRESH, at(10)), Outcome::Accepted);
        assert_eq!((arm.phase(), arm.since), (Phase::Activating, at(10)));
    }
    let mut held = Failsafe { phase: Phase::Held, cause: Cause::Jump, since: at(0), ..Failsafe::default() };
    assert_eq!(held.on_enabled(1, &healthy(), FRESH, at(10)), Outcome::ArmLatched(1, Cause::Jump));
    for phase in [Phase::Activating, Phase::Ready] {
        let mut arm = in_phase(phase);
        assert_eq!(arm.on_enabled(1, &healthy(), FRESH, at(10)), Outcome::Accepted);
        assert_eq!((arm.phase(), arm.since), (phase, at(0)), "the ramp does not begin again");
    }
}

#[test]
fn a_task_may_move_an_arm_only_when_it_is_ready() {
    for phase in [Phase::Unknown, Phase::Disabled, Phase::Standby, Phase::Activating] {
        assert_eq!(in_phase(phase).admits(2), Err(Outcome::ArmNotReady(2, phase, Cause::None)));
    }
    assert_eq!(in_phase(Phase::Ready).admits(2), Ok(()));
    let held = Failsafe { phase: Phase::Held, cause: Cause::Overrun, since: at(0), ..Failsafe::default() };
    assert_eq!(held.admits(2), Err(Outcome::ArmLatched(2, Cause::Overrun)));
    for (phase, after) in [
        (Phase::Ready, Phase::Standby),
        (Phase::Activating, Phase::Standby),
        (Phase::Held, Phase::Held),
        (Phase::Disabled, Phase::Disabled),
        (Phase::Unknown, Phase::Unknown),
    ] {
        let mut arm = in_phase(phase);
        arm.prepare_disable(at(10));
        assert_eq!(arm.phase(), after);
    }
}

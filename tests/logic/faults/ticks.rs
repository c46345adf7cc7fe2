//! F20: ticks that come late, and skipped periods.

use std::time::Duration;

use dimos::clock::Mono;
use dimos::control::config::{CONFIG_VERSION, CoordinatorConfig};
use dimos::control::coordinator::{Coordinator, TickTime};
use dimos::control::pace::{missed_periods, next_deadline};
use dimos::telemetry::{Cause, Event, Phase, Reason, TaskState};
use proptest::prelude::*;

use crate::support::rig::*;

#[test]
fn f20_skipped_periods_are_reported_and_not_caught_up() {
    let mut rig = Rig::one_arm(vec![task("t", trajectory(), 0..6, 10)]);
    rig.execute(0, sweep(1, 0..6, 0.0, 1.0, 2.0));
    rig.run_for(0.5);
    let before = rig.commanded(0)[0];
    rig.arms[0].age = Duration::ZERO;
    rig.tick_after(5);
    assert!(rig.reported(Event::Overrun(5, 50_000_000)));
    assert!(rig.commanded(0)[0] - before <= V_MAX * rig.dt(), "one step, not six");
    assert_eq!(rig.tasks[0].state, TaskState::Executing, "50 ms are tolerated");
    rig.tick_after(8);
    assert_eq!(rig.phase(0), Phase::Ready, "90 ms between two ticks as well");
    rig.tick_after(9);
    assert_eq!((rig.phase(0), rig.samples[0].cause), (Phase::Held, Cause::Overrun), "100 ms are not");
    assert_eq!(rig.tasks[0].reason, Reason::ArmHeld(0, Cause::Overrun));
    rig.run_for(0.5);
    assert_eq!(rig.speed(0), 0.0);
}

#[test]
fn f20_all_arms_hold_after_100_ms_at_every_rate() {
    for rate in [20.0, 100.0, 250.0, 500.0, 1000.0, 2000.0] {
        let mut rig = Rig::new(rate, vec![arm("a", 6), arm("b", 6)], vec![]);
        rig.make_ready();
        rig.tick_after(((0.1 * rate) as u32).saturating_sub(2));
        assert!(rig.samples.iter().all(|s| s.phase == Phase::Ready), "{rate}");
        rig.tick_after((0.1 * rate) as u32);
        assert!(rig.samples.iter().all(|s| s.cause == Cause::Overrun), "{rate}");
    }
}

#[test]
fn f20_ten_overruns_in_a_row_are_degraded() {
    let mut rig = Rig::one_arm(vec![]);
    (0..9).for_each(|_| rig.tick_after(1));
    rig.tick();
    (0..9).for_each(|_| rig.tick_after(1));
    assert!(!rig.reported(Event::Degraded), "nine in a row are not ten");
    (0..5).for_each(|_| rig.tick_after(1));
    assert_eq!(rig.count(|e| *e == Event::Degraded), 1);
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::default() })]

    /// F20: however late the wake-ups, ticks are at least half a period apart, every period is accounted for, and the
    /// time that ticks use neither stalls nor runs ahead.
    #[test]
    fn f20_no_two_ticks_within_half_a_period(lateness in prop::collection::vec(0u64..40_000_000, 1..300)) {
        let period = Duration::from_millis(10);
        let start = Mono(1_000_000_000);
        let (mut deadline, mut now, mut skips_before) = (start, start, 0);
        let (mut ticks, mut skipped, mut last): (u64, u64, Option<(Mono, Mono)>) = (0, 0, None);
        for late in lateness {
            // Most wake-ups are punctual; a sleep never ends early, and a deadline in the past ends it at once.
            let late = if late % 3 == 0 { late } else { late % 100_000 };
            now = now.max(deadline).after(Duration::from_nanos(late));
            let missed = missed_periods(deadline, now, period);
            let used = deadline.after(period * missed);
            let (next, skips_after) = next_deadline(used, now, period);
            prop_assert!(used <= now && next > now);
            prop_assert!(next.since(now) >= period / 2, "two ticks {:?} apart", next.since(now));
            if let Some((last_used, _)) = last {
                prop_assert!(used > last_used);
            }
            skipped += u64::from(skips_before + missed);
            ticks += 1;
            prop_assert_eq!(used.since(start), period * (ticks - 1 + skipped) as u32);
            last = Some((used, now));
            (deadline, skips_before) = (next, skips_after);
        }
    }
}

#[test]
fn a_coordinator_without_arms_or_tasks_ticks() {
    let config = CoordinatorConfig { version: CONFIG_VERSION, rate: 100.0, arms: vec![], tasks: vec![] };
    let rig = Rig::new(100.0, vec![], vec![]);
    let time = TickTime { now: rig.now, next: rig.now, skipped: 0, late_ns: 0, woke_late_ns: 0 };
    assert!(Coordinator::new(&config, Vec::new()).tick(time, &[], || None).commands.is_empty());
}

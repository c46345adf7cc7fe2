//! The tick's heartbeat: when a silent tick holds the arm.

use super::*;
use crate::device::thread::tests::{Bench, PERIOD};

const MS: Duration = Duration::from_millis(1);
/// Timeout of the heartbeat with ticks of 10 ms.
const TIMEOUT: Duration = Duration::from_millis(40);

/// An arm that setpoints move; the tick is this thread.
fn moving() -> Bench {
    let mut bench = Bench::enabled();
    bench.beat.adopt_thread();
    bench.hold_at(0.0);
    bench
}

/// A check some time after the latest heartbeat.
fn held_after(bench: &mut Bench, silence: Duration) -> bool {
    bench.set(bench.beat.last().unwrap().after(silence));
    bench.worker.check_tick();
    bench.worker.state.self_held
}

#[test]
fn a_tick_that_waits_may_be_silent_for_a_period_and_a_delay() {
    let mut bench = moving();
    let longest = PERIOD + MAX_DELAY;
    assert!(!held_after(&mut bench, longest - MS));
    assert!(held_after(&mut bench, longest));
    assert!(bench.worker.stop_pending && bench.states.read().self_held);
    assert_eq!(bench.notes(), ["no tick for 110 ms (limit 40 ms): held by the device thread"]);
}

#[test]
fn a_tick_that_hangs_is_silent_for_its_timeout_at_most() {
    let mut bench = moving();
    bench.worker.tick.hangs = true;
    assert!(!held_after(&mut bench, TIMEOUT - MS));
    assert!(held_after(&mut bench, TIMEOUT));
}

#[test]
fn a_tick_that_should_have_woken_has_the_longest_delay() {
    let mut bench = moving();
    bench.worker.tick.hangs = true;
    let due = bench.beat.last().unwrap().after(PERIOD);
    bench.beat.sleep_until(due);
    assert!(!held_after(&mut bench, PERIOD + MAX_DELAY - MS));
    assert!(held_after(&mut bench, PERIOD + MAX_DELAY));
}

#[test]
fn a_silent_tick_holds_no_arm_that_nothing_moves() {
    let mut bench = Bench::enabled();
    bench.tick(|c| c.mode = None);
    assert!(!held_after(&mut bench, Duration::from_secs(2)));
    let now = bench.now();
    assert_eq!(bench.worker.until_tick_check(now), Duration::MAX);
}

#[test]
fn late_wake_ups_of_this_thread_add_to_the_tolerated_silence() {
    let mut bench = moving();
    let last = bench.beat.last().unwrap();
    for (late, sum) in
        [(MS / 2, Duration::ZERO), (MS, MS), (30 * MS, 31 * MS), (MAX_DELAY, 31 * MS), (99 * MS, MAX_DELAY)]
    {
        bench.worker.see_tick(last, late);
        assert_eq!(bench.worker.tick.late, sum, "after {late:?}");
    }
    bench.worker.tick.hangs = true;
    assert!(!held_after(&mut bench, TIMEOUT + MAX_DELAY - MS));
    assert!(held_after(&mut bench, TIMEOUT + MAX_DELAY));

    // A heartbeat ends that.
    let mut bench = moving();
    bench.worker.see_tick(bench.now(), 30 * MS);
    bench.advance(PERIOD);
    bench.beat.beat(bench.now());
    bench.worker.see_tick(bench.now(), Duration::ZERO);
    assert_eq!(bench.worker.tick.late, Duration::ZERO);
}

#[test]
fn this_thread_wakes_twice_before_the_timeout_to_observe_the_tick() {
    let mut bench = moving();
    let last = bench.beat.last().unwrap();
    let wait = |silence: Duration| bench.worker.until_tick_check(last.after(silence));
    assert_eq!(wait(Duration::ZERO), TIMEOUT - 10 * MS);
    assert_eq!(wait(29 * MS), MS);
    assert_eq!(wait(30 * MS), 5 * MS);
    assert_eq!(wait(200 * MS), 5 * MS);
    bench.worker.tick.late = 20 * MS;
    assert_eq!(bench.worker.until_tick_check(last), TIMEOUT + 10 * MS);
}

#[test]
fn a_tick_that_has_ended_hangs() {
    let mut bench = moving();
    std::thread::scope(|scope| scope.spawn(|| bench.beat.adopt_thread()).join().unwrap());
    // The kernel may have the thread for a moment longer than its end is waited for.
    let began = std::time::Instant::now();
    while bench.beat.cpu_time().is_some() {
        assert!(began.elapsed() < Duration::from_secs(10));
        std::thread::yield_now();
    }
    let last = bench.beat.last().unwrap();
    bench.worker.see_tick(last.after(PERIOD), Duration::ZERO);
    assert!(!bench.worker.tick.hangs, "not late yet");
    bench.worker.see_tick(last.after(PERIOD + MS), Duration::ZERO);
    assert!(bench.worker.tick.hangs);
}

#[test]
fn a_silent_tick_that_uses_the_processor_all_along_hangs() {
    let mut bench = moving();
    // What it used before its latest heartbeat does not count.
    let idle = bench.beat.cpu_time().unwrap();
    while bench.beat.cpu_time().unwrap() - idle < 40 * MS {
        std::hint::black_box(0);
    }
    bench.beat.beat(bench.beat.last().unwrap().after(PERIOD));
    let last = bench.beat.last().unwrap();
    bench.worker.see_tick(last, Duration::ZERO);
    // This thread is the tick, and computes. The virtual time of the observations is its processor time.
    let began = bench.beat.cpu_time().unwrap();
    let mut at = |busy: Duration| {
        while bench.beat.cpu_time().unwrap() - began < busy {
            std::hint::black_box(0);
        }
        bench.worker.see_tick(last.after(busy + PERIOD), Duration::ZERO);
        bench.worker.tick.hangs
    };
    assert!(!at(6 * MS), "the first look");
    assert!(!at(13 * MS), "it used the processor, but not since it had to wake");
    assert!(at(34 * MS));
}

#[test]
fn a_silent_tick_that_waits_does_not_hang_and_stalls_are_not_judged() {
    let mut bench = moving();
    let last = bench.beat.last().unwrap();
    for silence in [11, 17, 23, 35, 60] {
        bench.worker.see_tick(last.after(silence * MS), Duration::ZERO);
        assert!(!bench.worker.tick.hangs, "{silence} ms");
    }
    // As if it had computed all along.
    while bench.beat.cpu_time().unwrap() < 40 * MS {
        std::hint::black_box(0);
    }
    bench.worker.tick.observed = Some((last.after(60 * MS), Duration::ZERO));
    bench.worker.tick.cpu_time = Some(Duration::ZERO);
    bench.worker.see_tick(last.after(70 * MS), 2 * MS);
    assert!(!bench.worker.tick.hangs, "this thread was stalled itself");
    assert_eq!(bench.worker.tick.observed.map(|(at, _)| at), Some(last.after(70 * MS)));
}

#[test]
fn observations_are_five_milliseconds_apart() {
    let mut bench = moving();
    let last = bench.beat.last().unwrap();
    let mut observed = |silence: Duration| {
        bench.worker.see_tick(last.after(silence), Duration::ZERO);
        bench.worker.tick.observed.map(|(at, _)| at.since(last))
    };
    assert_eq!(observed(PERIOD), None);
    assert_eq!(observed(11 * MS), Some(11 * MS));
    assert_eq!(observed(15 * MS), Some(11 * MS));
    assert_eq!(observed(16 * MS), Some(16 * MS));
}

#[test]
fn a_tick_that_used_the_processor_but_now_waits_does_not_hang() {
    let mut bench = moving();
    let last = bench.beat.last().unwrap();
    let used = bench.beat.cpu_time().unwrap();
    // Since its heartbeat it has used 100 ms, of the latest 10 ms three.
    bench.worker.see_tick(last, Duration::ZERO);
    bench.worker.tick.cpu_time = Some(used.saturating_sub(100 * MS));
    while bench.beat.cpu_time().unwrap() - used < 3 * MS || bench.beat.cpu_time().unwrap() < 40 * MS {
        std::hint::black_box(0);
    }
    let before = bench.beat.cpu_time().unwrap().saturating_sub(3 * MS);
    bench.worker.tick.cpu_time = Some(Duration::ZERO);
    bench.worker.tick.observed = Some((last.after(50 * MS), before));
    bench.worker.see_tick(last.after(60 * MS), Duration::ZERO);
    assert!(!bench.worker.tick.hangs);
}

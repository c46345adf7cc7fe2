//! Readings: when an arm is stale, what is read in turn, and what counts as interference.

use std::sync::atomic::Ordering::Relaxed;

use super::*;
use crate::adapter::AdapterError;
use dimos_core::arm::{Interference, Link, VelocitySource};

fn lost() -> AdapterError {
    AdapterError::Timeout("no answer".into())
}

/// Cycles with failed reads, a period apart.
fn fail_reads(bench: &mut Bench, times: u32) -> ArmState {
    let mut state = ArmState::default();
    for _ in 0..times {
        bench.arm.fail("read_joint_positions", lost());
        bench.advance(PERIOD);
        state = bench.cycle();
    }
    state
}

#[test]
fn an_arm_is_stale_after_its_time_and_three_failures_and_up_with_one_state() {
    let mut bench = Bench::connected();
    let seq = bench.cycle().seq;
    assert_eq!(fail_reads(&mut bench, 5).link, Link::Up, "50 ms");
    let state = fail_reads(&mut bench, 1);
    assert_eq!((state.link, state.seq), (Link::Stale, seq), "60 ms, limit 50 ms");
    assert_eq!(bench.worker.health.read_errors.load(Relaxed), 6);
    assert_eq!(bench.notes(), ["no state: no answer"], "once");
    bench.advance(PERIOD);
    let state = bench.cycle();
    assert_eq!((state.link, state.seq), (Link::Up, seq + 1));
    assert_eq!(bench.notes(), ["over: no state: no answer"]);
}

#[test]
fn one_failure_after_a_long_time_is_no_stale_arm() {
    let mut bench = Bench::connected();
    bench.cycle();
    bench.advance(10 * PERIOD);
    assert_eq!(fail_reads(&mut bench, 2).link, Link::Up);
    assert_eq!(fail_reads(&mut bench, 1).link, Link::Stale);
}

#[test]
fn a_failed_reading_makes_positions_implausible() {
    let mut bench = Bench::connected();
    bench.settle();
    assert!(bench.worker.plausible.stable(bench.worker.state.stamp));
    fail_reads(&mut bench, 1);
    assert!(!bench.worker.plausible.stable(bench.worker.state.stamp));
}

#[test]
fn reads_are_a_period_apart_and_just_before_the_tick() {
    let mut bench = Bench::connected();
    bench.cycle();
    bench.arm.clear_calls();
    bench.advance(PERIOD / 2);
    bench.cycle();
    assert_eq!(bench.count("read_joint_positions"), 0);
    bench.advance(PERIOD / 2);
    bench.cycle();
    assert_eq!(bench.count("read_joint_positions"), 1);

    // A tick 4 ms after the reading: the next reading ends a millisecond before the next tick.
    let read = bench.now();
    bench.advance(Duration::from_millis(4));
    let next_tick = bench.now().after(PERIOD);
    bench.worker.read_before(next_tick);
    assert_eq!(bench.worker.next_read, read.after(PERIOD), "not later than planned");
    bench.worker.next_read = next_tick;
    bench.worker.read_before(next_tick);
    assert_eq!(bench.worker.next_read, next_tick.before(Duration::from_millis(1)));
    bench.worker.read_time = 2e-3;
    bench.worker.read_before(next_tick);
    assert_eq!(bench.worker.next_read, next_tick.before(PERIOD / 2), "three times the reading, half a period at most");
    bench.worker.read_before(read);
    assert_eq!(bench.worker.next_read, read.after(PERIOD.mul_f64(0.8)), "not sooner than the arm can");
}

#[test]
fn the_time_of_a_reading_is_averaged() {
    let mut bench = Bench::connected();
    bench.worker.read_time = 0.0;
    // The clock is asked at the start and at the end of a reading, and for slow readings in between.
    bench.stepping(Duration::from_millis(1), |bench| bench.worker.read(&mut bench.adapter));
    let first = bench.worker.read_time;
    assert!((1e-4..1e-3).contains(&first), "{first}");
    for _ in 0..100 {
        bench.stepping(Duration::from_millis(1), |bench| bench.worker.read(&mut bench.adapter));
    }
    let mean = bench.worker.read_time;
    assert!((0.9e-3..6e-3).contains(&mean), "{mean}");
}

#[test]
fn where_each_read_costs_a_round_trip_one_more_value_is_read_per_cycle() {
    let arm = MockAdapter::new(DOF).gripper(0.02).force_torque([1.0; 6]).pose(dimos_core::arm::Pose::default());
    let mut bench = Bench::new(arm);
    bench.worker.connect(&mut bench.adapter).unwrap();
    bench.worker.whole_state_at_once = false;
    bench.worker.turn = 0;
    let others = [
        "read_error",
        "read_enabled",
        "read_gripper_position",
        "read_force_torque",
        "read_cartesian_position",
        "read_state",
    ];
    let mut read = Vec::new();
    for _ in 0..6 {
        bench.arm.clear_calls();
        bench.advance(PERIOD);
        bench.cycle();
        assert_eq!(bench.count("read_joint_positions"), 1);
        read.push(others.iter().filter(|name| bench.count(name) == 1).copied().collect::<Vec<_>>());
    }
    let turns = [
        vec!["read_error"],
        vec!["read_enabled"],
        vec!["read_gripper_position"],
        vec!["read_force_torque"],
        vec!["read_cartesian_position"],
        vec!["read_state"],
    ];
    assert_eq!(read, turns);
    let state = bench.cycle();
    assert_eq!((state.gripper, state.wrench), (Some(0.02), Some([1.0; 6])));
    assert!(bench.worker.health.codes().is_some());
}

#[test]
fn an_arm_that_has_its_whole_state_at_once_is_asked_for_all_of_it() {
    let mut bench = Bench::connected();
    bench.advance(PERIOD);
    bench.cycle();
    for name in ["read_error", "read_enabled", "read_state", "read_joint_velocities"] {
        assert_eq!(bench.count(name), 1, "{name}");
    }
}

#[test]
fn an_error_is_trouble_until_it_is_cleared() {
    let arm = MockAdapter::new(DOF).error(7, "overload");
    let mut bench = Bench::new(arm);
    bench.worker.connect(&mut bench.adapter).unwrap();
    bench.advance(PERIOD);
    let state = bench.cycle();
    assert_eq!((state.error, bench.worker.health.error_text().as_str()), (7, "overload"));
    bench.advance(PERIOD);
    bench.cycle();
    assert_eq!(bench.notes(), ["the arm reports error 7: overload"], "once, and not over");
    bench.arm.clone().error(0, "");
    bench.advance(PERIOD);
    assert_eq!(bench.cycle().error, 0);
    assert_eq!(bench.notes(), ["over: the arm reports error 7: overload"]);
    assert_eq!(bench.worker.health.error_text(), "");
}

#[test]
fn the_same_measurement_counts_once_and_its_age_grows() {
    let mut bench = Bench::connected();
    let before = bench.cycle();
    let stamp = Mono(before.stamp.0 + 5);
    bench.worker.reading.stamp = Some(stamp);
    bench.worker.reading.position[0] = 0.01;
    bench.worker.take_reading(bench.now());
    bench.worker.reading.position[0] = 0.02;
    bench.advance(PERIOD);
    bench.worker.take_reading(bench.now());
    let state = bench.worker.state;
    assert_eq!((state.seq, state.stamp, state.position[0]), (before.seq + 1, stamp, 0.01));
    assert!(bench.worker.last_read < bench.now(), "nothing new was read");
}

#[test]
fn velocities_are_measured_or_absent() {
    let mut bench = Bench::new(MockAdapter::new(DOF).velocities(Some(&[0.5, 0.0, 0.0])));
    bench.worker.connect(&mut bench.adapter).unwrap();
    bench.advance(PERIOD);
    let state = bench.cycle();
    assert_eq!((state.velocity[0], state.velocity_source), (0.5, VelocitySource::Measured));
    bench.arm.clone().velocities(None);
    bench.advance(PERIOD);
    let state = bench.cycle();
    assert_eq!((state.velocity[0], state.velocity_source), (0.0, VelocitySource::Absent));
}

#[test]
fn two_readings_that_contradict_the_orders_are_interference() {
    let mut bench = Bench::enabled();
    bench.worker.ordered_mode = Some(ControlMode::Velocity);
    bench.advance(PERIOD);
    assert_eq!(bench.cycle().interference, Interference::None, "one may have been measured before the order");
    bench.advance(PERIOD);
    assert_eq!(bench.cycle().interference, Interference::Mode);

    let mut bench = Bench::enabled();
    bench.worker.ordered_power = Some(false);
    bench.advance(PERIOD);
    bench.cycle();
    bench.arm.clone().enabled(false);
    bench.advance(PERIOD);
    assert_eq!(bench.cycle().interference, Interference::None, "they are off");
    bench.arm.clone().enabled(true);
    for _ in 0..2 {
        bench.advance(PERIOD);
        bench.cycle();
    }
    assert_eq!(bench.cycle().interference, Interference::Power);
    // Motors that go off are no interference: the tick reports them.
    let mut bench = Bench::enabled();
    bench.arm.clone().enabled(false);
    for _ in 0..3 {
        bench.advance(PERIOD);
        assert_eq!(bench.cycle().interference, Interference::None);
    }
}

#[test]
fn what_the_adapter_reports_of_others_is_taken_once() {
    let mut bench = Bench::enabled();
    bench.worker.take_foreign_change(None);
    assert_eq!(bench.worker.state.interference, Interference::None);
    bench.worker.take_foreign_change(Some("paused at the pendant"));
    assert_eq!(bench.worker.state.interference, Interference::Stop);
    bench.worker.take_foreign_change(Some("stopped at the pendant"));
    assert_eq!(bench.notes(), ["paused at the pendant"]);

    let mut bench = Bench::enabled();
    bench.worker.ordered_mode = Some(ControlMode::Velocity);
    bench.worker.take_foreign_change(Some("another mode"));
    assert_eq!(bench.worker.state.interference, Interference::Mode);
}

#[test]
fn the_rate_of_states_is_that_of_their_intervals() {
    let mut bench = Bench::connected();
    for _ in 0..200 {
        bench.advance(PERIOD);
        bench.cycle();
    }
    let rate = bench.worker.health.rate();
    assert!((rate - 100.0).abs() < 1.0, "{rate} Hz");
}

#[test]
fn only_new_states_of_the_arm_that_clocks_the_ticks_start_one() {
    let wake = Wake::new().unwrap();
    let mut bench = Bench::with(MockAdapter::new(DOF), |config| config.pace = Some(wake.clone()));
    bench.worker.connect(&mut bench.adapter).unwrap();
    assert!(wake.wait(Duration::ZERO), "the first one");
    bench.advance(PERIOD);
    bench.cycle();
    assert!(wake.wait(Duration::ZERO));
    bench.cycle();
    assert!(!wake.wait(Duration::ZERO), "nothing was read");
    fail_reads(&mut bench, 1);
    assert!(!wake.wait(Duration::ZERO));
}

#[test]
fn setpoints_start_at_the_arm_once_its_motors_were_off() {
    let mut bench = Bench::enabled();
    bench.hold_at(0.0);
    drop(bench.arm.clone().enabled(false).positions(&[0.3, 0.0, 0.0]));
    bench.advance(PERIOD);
    bench.cycle();
    drop(bench.arm.clone().enabled(true));
    bench.advance(PERIOD);
    bench.cycle();
    bench.hold_at(0.3);
    assert_eq!(bench.written(), [0.0, 0.3]);
}

#[test]
fn while_its_motors_are_on_setpoints_continue_from_the_last_one_however_far_the_arm_lags() {
    let mut bench = Bench::enabled();
    let setpoints: Vec<f64> = (0..60).map(|k| f64::from(k) * 0.02).collect();
    for setpoint in &setpoints {
        bench.hold_at(*setpoint);
    }
    assert_eq!(bench.written(), setpoints, "the mock arm stays at 0");
}

use std::f64::consts::PI;
use std::time::Duration;

use super::*;
use crate::sim::plant::Plant;
use dimos_core::joint::JointLimits;

fn at(seconds: f64) -> Mono {
    Mono::ZERO.after(Duration::from_secs_f64(10.0 + seconds))
}

/// Offset at a time [rad]: half-cosine waves of 0.8 s to 2° and back, to −2° and back.
fn wave(t: f64) -> f64 {
    let reach = 2.0_f64.to_radians();
    let part = |t: f64| 0.5 - 0.5 * (t.clamp(0.0, 0.8) / 0.8 * PI).cos();
    reach * (part(t) - part(t - 1.0) - part(t - 2.0) + part(t - 3.0))
}

/// Setpoints with this `period` [s].
fn written(period: f64) -> Vec<Point> {
    (0..(4.2 / period) as usize).map(|i| i as f64 * period).map(|t| Point { at: at(t), value: wave(t) }).collect()
}

/// Evenly distributed numbers from −1 to 1.
fn noise() -> impl FnMut() -> f64 {
    let mut state = 7_u64;
    move || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    }
}

fn holds(written: &[Point], t: f64) -> f64 {
    let next = written.partition_point(|point| point.at <= at(t));
    written[next.saturating_sub(1)].value
}

/// Positions every 2.7 ms of a joint that repeats its setpoints after `lag` [s], with offset and noise [rad].
fn repeated(written: &[Point], lag: f64, off: f64, noisy: f64) -> Vec<Point> {
    let mut noise = noise();
    let times = (0..1500).map(|i| 0.0027 * f64::from(i));
    times.map(|t| Point { at: at(t), value: holds(written, (t - lag).max(0.0)) + off + noisy * noise() }).collect()
}

fn close(found: Option<f64>, lag: f64, within: f64) {
    let found = found.unwrap_or_else(|| panic!("no lag found instead of {lag}"));
    assert!((found - lag).abs() < within, "{found} instead of {lag}");
}

#[test]
fn a_repeated_stream_is_found_at_any_period_of_setpoints() {
    for lag in [0.0, 0.003, 0.03, 0.037, 0.06, 0.15, 0.4] {
        for period in [0.002, 0.01, 0.02] {
            let written = written(period);
            close(delay(&written, &repeated(&written, lag, 0.0, 0.0)), lag, 0.0005);
        }
    }
}

#[test]
fn noise_and_sagging_do_not_look_like_lag() {
    let written = written(0.01);
    for lag in [0.03, 0.037, 0.06, 0.15] {
        close(delay(&written, &repeated(&written, lag, 0.01, 0.001)), lag, 0.001);
    }
}

#[test]
fn a_joint_that_does_not_follow_has_no_lag() {
    let written = written(0.01);
    let still: Vec<_> = repeated(&written, 0.0, 0.0, 0.0).iter().map(|p| Point { value: 0.3, ..*p }).collect();
    assert_eq!(delay(&written, &still), None);
    let mirrored: Vec<_> = repeated(&written, 0.0, 0.0, 0.0).iter().map(|p| Point { value: -p.value, ..*p }).collect();
    assert_eq!(delay(&written, &mirrored), None);
    assert_eq!(delay(&written, &repeated(&written, 0.7, 0.0, 0.0)), None, "longer than is measured");
    assert_eq!(delay(&written, &repeated(&written, 0.03, 0.0, 0.0)[..20]), None, "too few");
    assert_eq!(delay(&[], &still), None);
    assert_eq!(delay(&written, &[]), None);
    assert_eq!(delay(&written[..1], &still), None);
}

/// Lag of an emulated joint whose setpoints have this `period` [s].
fn emulated(lag: f64, period: f64) -> Option<f64> {
    let limits = JointLimits { acceleration_max: vec![10.0], ..JointLimits::uniform(1, 2.0, 3.0) };
    let mut plant = Plant::lagging(&limits, &[0.5], lag);
    plant.enable(true);
    let (mut written, mut measured, mut next) = (Vec::new(), Vec::new(), 0.0);
    for i in 0..8400 {
        let t = 0.0005 * f64::from(i);
        if t >= next {
            written.push(Point { at: at(t), value: wave(t) });
            plant.servo(&[0.5 + wave(t)]);
            next += period;
        }
        plant.advance(0.0005);
        measured.push(Point { at: at(t + 0.0005), value: plant.positions()[0] - 0.5 });
    }
    delay(&written, &measured)
}

#[test]
fn emulated_joints_have_the_lag_that_they_are_given() {
    // A joint with less lag than half a period moves in steps, smoothed by its acceleration limit.
    for (lags, within) in [(vec![0.001, 0.005], 0.002), (vec![0.01, 0.02, 0.03, 0.037, 0.06, 0.15, 0.4], 0.001)] {
        for (lag, period) in lags.iter().flat_map(|lag| [(*lag, 0.005), (*lag, 0.01)]) {
            close(emulated(lag, period), lag, within);
        }
    }
}

/// A trace of four waves with a reading every 2.7 ms. The program stalls for 50 ms in the waves `stalled`, and the
/// setpoints of that time are 50 ms late.
fn trace(lag: f64, stalled: &[usize]) -> Trace {
    let mut trace = Trace::default();
    let written = written(0.01);
    written.iter().for_each(|point| trace.wrote(point.at, point.value));
    for (i, point) in repeated(&written, lag, 0.0, 0.0).iter().enumerate() {
        if i % 370 == 0 && i / 370 < 4 {
            trace.begin_wave();
        }
        let in_stall = (100..120).contains(&(i % 370)) && stalled.contains(&(i / 370));
        if !in_stall {
            let late = stalled.contains(&(i / 370)) && i % 370 > 100;
            let value = if late { holds(&written, (i as f64 * 0.0027 - lag - 0.05).max(0.0)) } else { point.value };
            trace.saw(point.at, point.at, value);
        }
    }
    trace
}

#[test]
fn waves_with_gaps_are_dropped() {
    close(trace(0.037, &[]).lag(), 0.037, 0.001);
    close(trace(0.037, &[0, 3]).lag(), 0.037, 0.001);
    assert_eq!(trace(0.037, &[0, 1, 2, 3]).lag(), None, "all of them are too uneven");
}

#[test]
fn a_state_that_is_read_twice_counts_once_and_slow_reads_are_no_gaps() {
    let (mut trace, written) = (Trace::default(), written(0.01));
    written.iter().for_each(|point| trace.wrote(point.at, point.value));
    trace.begin_wave();
    for (i, point) in repeated(&written, 0.06, 0.0, 0.0).iter().enumerate() {
        // A reading every 10.8 ms; every second one finds no new state.
        if i % 4 == 0 {
            let measured = Point { at: at((i / 8) as f64 * 8.0 * 0.0027), value: 0.0 };
            let value = holds(&written, (measured.at.seconds_since(at(0.0)) - 0.06).max(0.0));
            trace.saw(point.at, measured.at, value);
        }
    }
    assert!(trace.measured.len() < trace.readings.len() * 6 / 10);
    close(trace.lag(), 0.06, 0.002);
}

#[test]
fn an_arm_has_its_slowest_joints_lag() {
    let lag = Lag::of(vec![Some(0.03), None, Some(0.05), Some(0.04)], 0.02);
    assert_eq!((lag.largest, lag.median, lag.complete()), (Some(0.05), Some(0.04), false));
    assert_eq!(Lag::of(vec![None], 0.02).largest, None);
    assert!(!Lag::of(vec![], 0.02).complete() && Lag::of(vec![Some(0.0)], 0.02).complete());
}

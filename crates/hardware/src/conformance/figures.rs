//! Measures how a device delivers its state: rate, jitter, age, duration of a reading.

use std::time::Duration;

use serde::Serialize;

use crate::adapter::{AdapterError, AdapterResult, JointReading, ManipulatorAdapter};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_rt::histogram::Histogram;
use dimos_rt::host::sleep_until;
use dimos_rt::wake::Wake;

/// Measured figures.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Figures {
    /// Duration of the measurement [s].
    pub seconds: f64,
    /// Whether the device streams its state, or is polled.
    pub sends_by_itself: bool,
    /// Whether its measurements have a time stamp.
    pub has_stamps: bool,
    /// Readings.
    pub readings: u64,
    /// Readings that failed.
    pub failed: u64,
    /// New states per second [Hz].
    pub rate: f64,
    /// Time between new states, by their stamps if there are any [ms].
    pub interval: Spread,
    /// Duration of a reading [ms].
    pub reading: Spread,
    /// How old a state is when it has been read [ms]; `None` without stamps.
    pub age: Option<Spread>,
}

/// How a duration spreads.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Spread {
    /// Half are no longer.
    pub p50: f64,
    /// 99 % are no longer.
    pub p99: f64,
    /// The longest.
    pub max: f64,
}

impl Spread {
    fn of(histogram: &Histogram) -> Self {
        let figures = histogram.figures();
        Self { p50: figures.p50 / 1e3, p99: figures.p99 / 1e3, max: figures.max / 1e3 }
    }
}

/// Reads a connected device's state for some time, at its own rate.
pub fn measure(adapter: &mut dyn ManipulatorAdapter, time: Duration) -> AdapterResult<Figures> {
    let (intervals, readings, ages) = (Histogram::default(), Histogram::default(), Histogram::default());
    let wake = Wake::new().map_err(|e| AdapterError::Io(e.to_string()))?;
    let period = Duration::from_secs_f64(1.0 / adapter.get_info().native_rate.clamp(1.0, 2000.0));
    let began = MonotonicClock.now();
    let end = began.after(time);
    let mut next = began;
    let (mut news, mut failed, mut sends_by_itself) = (0_u64, 0, false);
    let mut last: Option<(Option<Mono>, Mono)> = None;
    let mut reading = JointReading::default();
    while MonotonicClock.now() < end {
        match adapter.state_fd() {
            Some(state) => {
                sends_by_itself = true;
                // As the device thread does, which also reads after a period without a new state.
                wake.wait_or_readable(state, period);
            }
            None => {
                next = next.after(period).max(MonotonicClock.now());
                sleep_until(next);
            }
        }
        let asked = MonotonicClock.now();
        let result = adapter.read_joints(&mut reading);
        let now = MonotonicClock.now();
        readings.record(now.since(asked).as_nanos() as u64);
        if let Err(error) = result {
            failed += 1;
            if !adapter.is_connected() {
                return Err(error);
            }
            continue;
        }
        let at = reading.stamp.unwrap_or(now);
        match last {
            Some((Some(before), _)) if reading.stamp == Some(before) => continue,
            Some((before, arrived)) => intervals.record(at.since(before.unwrap_or(arrived)).as_nanos() as u64),
            None => {}
        }
        if let Some(stamp) = reading.stamp {
            ages.record(now.since(stamp).as_nanos() as u64);
        }
        news += 1;
        last = Some((reading.stamp, now));
    }
    let seconds = MonotonicClock.now().seconds_since(began);
    let has_stamps = reading.stamp.is_some();
    Ok(Figures {
        seconds,
        sends_by_itself,
        has_stamps,
        readings: readings.figures().count,
        failed,
        rate: news as f64 / seconds,
        interval: Spread::of(&intervals),
        reading: Spread::of(&readings),
        age: has_stamps.then(|| Spread::of(&ages)),
    })
}

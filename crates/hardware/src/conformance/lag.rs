//! An arm's lag: the time from a setpoint written to the measured motion that follows it.

use std::ops::Range;

use serde::Serialize;

use dimos_core::clock::Mono;

/// Maximum lag that can be measured [s].
const MAX_LAG: f64 = 0.5;
/// Step of the search before its refinement [s].
const COARSE: f64 = 0.005;
/// Steps of the refinement: each leaves two thirds of the interval.
const REFINEMENTS: u32 = 25;
/// Minimum number of measurements, and minimum range of setpoints [rad], for an estimate.
const MIN_DATA: (usize, f64) = (50, 0.005);
/// Maximum part of the setpoints' variance that may remain unexplained by the measurements.
const UNEXPLAINED: f64 = 0.2;
/// A time between two readings above this is a gap in which this program did not run [s] …
const MIN_GAP: f64 = 0.008;
/// … or this many times the median, for an arm whose states take long to read.
const GAP_IN_MEDIANS: f64 = 3.0;
/// Maximum part of a wave's time in gaps, if every wave has gaps.
const MAX_GAPS: f64 = 0.05;

/// A value at a time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Time.
    pub at: Mono,
    /// Joint position [rad].
    pub value: f64,
}

/// Measured lag of an arm.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Lag {
    /// Largest lag of all joints [s]: what the arm's `lag` must allow for.
    pub largest: Option<f64>,
    /// Median of all joints [s].
    pub median: Option<f64>,
    /// Lag that the adapter's row states [s].
    pub row: f64,
    /// Lag of each joint [s]; `None` if not measured.
    pub joints: Vec<Option<f64>>,
}

impl Lag {
    /// Returns the lag of an arm with these joints, whose row states `row` [s].
    pub fn of(joints: Vec<Option<f64>>, row: f64) -> Self {
        let mut sorted: Vec<f64> = joints.iter().copied().flatten().collect();
        Self { median: median(&mut sorted), largest: sorted.last().copied(), row, joints }
    }

    /// Returns whether every joint was measured.
    pub fn complete(&self) -> bool {
        !self.joints.is_empty() && self.joints.iter().all(Option::is_some)
    }
}

/// Estimates the delay, 0 to 0.5 s, between the `written` setpoints and the `measured` positions of a joint [s]: the
/// one with the least squared difference. `None` if there is too little data, or the positions do not follow.
///
/// A setpoint holds until the next one. A joint without lag moves in steps; a real one moves smoothly through the
/// middle of the steps. Both are equal on average, and the line through the middle of each hold is that average. Unlike
/// the steps, it gives a sum of squares without plateaus. A line through the setpoints at the times of their writes
/// would be ahead by half a period, and the lag too long by as much.
///
/// A constant difference (droop under load) is not lag and is ignored. Motion in both directions separates the two.
pub fn delay(written: &[Point], measured: &[Point]) -> Option<f64> {
    let origin = written.first()?.at;
    let seconds = |points: &[Point]| points.iter().map(|p| (p.at.seconds_since(origin), p.value)).collect::<Vec<_>>();
    let (line, measured) = (middles(&seconds(written)), seconds(measured));
    let values = || line.iter().map(|(_, value)| *value);
    let range = values().fold(f64::NEG_INFINITY, f64::max) - values().fold(f64::INFINITY, f64::min);
    if measured.len() < MIN_DATA.0 || range.is_nan() || range < MIN_DATA.1 {
        return None;
    }
    let cost = |delay: f64| variance(measured.iter().map(|(at, value)| value - on(&line, at - delay)));
    let steps = (MAX_LAG / COARSE).round() as u32;
    let coarse = (0..=steps).map(|step| (f64::from(step) * COARSE, cost(f64::from(step) * COARSE)));
    let (best, _) = coarse.min_by(|a, b| a.1.total_cmp(&b.1))?;
    if best >= MAX_LAG - COARSE / 2.0 {
        return None; // possibly longer
    }
    let (mut low, mut high) = ((best - COARSE).max(0.0), best + COARSE);
    for _ in 0..REFINEMENTS {
        let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
        if cost(a) <= cost(b) { high = b } else { low = a }
    }
    let delay = (low + high) / 2.0;
    let moved = variance(measured.iter().map(|(at, _)| on(&line, at - delay)));
    (cost(delay) <= UNEXPLAINED * moved).then_some(delay)
}

/// Returns each setpoint at the middle of its hold [s]. The last one is assumed to hold as long as the one before.
fn middles(written: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let ends = written.iter().skip(1).map(|(at, _)| *at);
    let mut half = 0.0;
    let with_ends = written.iter().zip(ends.map(Some).chain([None]));
    with_ends
        .map(|((at, value), end)| {
            half = end.map_or(half, |end| (end - at) / 2.0);
            (at + half, *value)
        })
        .collect()
}

/// Returns the value at a time [s] of the line through some points.
fn on(line: &[(f64, f64)], at: f64) -> f64 {
    let next = line.partition_point(|(time, _)| *time <= at);
    match (next.checked_sub(1).and_then(|last| line.get(last)), line.get(next)) {
        (Some((t0, v0)), Some((t1, v1))) => v0 + (v1 - v0) * (at - t0) / (t1 - t0),
        (Some((_, value)), None) | (None, Some((_, value))) => *value,
        (None, None) => f64::NAN,
    }
}

fn variance(values: impl Iterator<Item = f64>) -> f64 {
    let (count, sum, squares) =
        values.fold((0.0, 0.0, 0.0), |(n, sum, squares), v| (n + 1.0, sum + v, squares + v * v));
    (squares - sum * sum / count) / count
}

/// Returns the median. Sorts the values.
fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    let upper = *values.get(values.len() / 2)?;
    let lower = *values.get(values.len().checked_sub(1)? / 2)?;
    Some((lower + upper) / 2.0)
}

/// Setpoints and measured positions of one joint, in waves.
#[derive(Debug, Default)]
pub struct Trace {
    written: Vec<Point>,
    measured: Vec<Point>,
    /// Time of each reading, and the number of measurements before it.
    readings: Vec<(Mono, usize)>,
    /// Index of the first reading of each wave.
    waves: Vec<usize>,
}

impl Trace {
    /// Begins a wave.
    pub fn begin_wave(&mut self) {
        self.waves.push(self.readings.len());
    }

    /// Records a setpoint.
    pub fn wrote(&mut self, at: Mono, value: f64) {
        self.written.push(Point { at, value });
    }

    /// Records a reading at `now` of a position measured at `at`. A repeated measurement is ignored.
    pub fn saw(&mut self, now: Mono, at: Mono, value: f64) {
        self.readings.push((now, self.measured.len()));
        if self.measured.last().is_none_or(|last| last.at < at) {
            self.measured.push(Point { at, value });
        }
    }

    /// Estimates the lag [s] from the waves without gaps. If there are none, from those with the shortest gaps; `None`
    /// if these are too long.
    pub fn lag(&self) -> Option<f64> {
        let ends = self.waves.iter().skip(1).copied().chain([self.readings.len()]);
        let waves: Vec<Range<usize>> = self.waves.iter().zip(ends).map(|(first, end)| *first..end).collect();
        let kept = |most: f64| {
            let even = waves.iter().filter(|wave| self.gaps((*wave).clone()) <= most);
            let measured = even.filter_map(|wave| {
                let first = self.readings.get(wave.start)?.1;
                let end = self.readings.get(wave.end).map_or(self.measured.len(), |look| look.1);
                self.measured.get(first..end)
            });
            measured.flatten().copied().collect::<Vec<_>>()
        };
        delay(&self.written, &kept(0.0)).or_else(|| delay(&self.written, &kept(MAX_GAPS)))
    }

    /// Returns the part of a wave's time in gaps; 1 for a wave without readings.
    fn gaps(&self, wave: Range<usize>) -> f64 {
        let readings = self.readings.get(wave).unwrap_or_default();
        let pairs = readings.iter().zip(readings.iter().skip(1));
        let intervals: Vec<f64> = pairs.map(|((from, _), (to, _))| to.seconds_since(*from)).collect();
        let Some(median) = median(&mut intervals.clone()) else { return 1.0 };
        let gap = MIN_GAP.max(GAP_IN_MEDIANS * median);
        intervals.iter().filter(|interval| **interval > gap).sum::<f64>() / intervals.iter().sum::<f64>()
    }
}

#[cfg(test)]
#[path = "lag_tests.rs"]
mod tests;

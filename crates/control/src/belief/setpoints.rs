//! The latest setpoints of an arm as ranges. A joint that follows with a delay is within the range of the setpoints of
//! the last `lag` seconds; a joint outside of it is blocked, or is moved by an external force.

use dimos_core::clock::Mono;
use dimos_core::joint::{Joints, MAX_DOF};

/// Number of parts of the window. The start of a range is exact to one part.
const PARTS: usize = 16;

/// Range of the setpoints in one part of the window.
#[derive(Debug, Clone, Copy)]
struct Part {
    /// Time of its first setpoint.
    from: Mono,
    /// Time of its last setpoint.
    to: Mono,
    low: Joints,
    high: Joints,
}

/// Setpoints of one arm over its `lag`.
#[derive(Debug, Clone)]
pub struct SetpointWindow {
    dof: usize,
    /// Length of a part [ns].
    part: u64,
    parts: [Part; PARTS + 1],
    newest: usize,
    count: usize,
}

impl SetpointWindow {
    /// Creates the window of an arm of `dof` joints, over `span` [s]: its lag and the age of its states.
    pub fn new(dof: usize, span: f64) -> Self {
        let none = Part { from: Mono::ZERO, to: Mono::ZERO, low: [0.0; MAX_DOF], high: [0.0; MAX_DOF] };
        let part = (span.clamp(0.0, 10.0) * 1e9 / (PARTS - 2) as f64) as u64;
        Self { dof: dof.min(MAX_DOF), part, parts: [none; PARTS + 1], newest: 0, count: 0 }
    }

    /// Removes all setpoints: another mode, or a new start.
    pub fn clear(&mut self) {
        self.count = 0;
    }

    /// Adds the setpoints of a tick [rad or rad/s].
    pub fn push(&mut self, now: Mono, values: &Joints) {
        let grown = self.count > 0
            && self.parts.get_mut(self.newest).is_some_and(|part| {
                let same = now.0.saturating_sub(part.from.0) < self.part;
                if same {
                    part.to = now;
                    let ranges = part.low.iter_mut().zip(&mut part.high);
                    for ((low, high), v) in ranges.zip(values).take(self.dof) {
                        (*low, *high) = (low.min(*v), high.max(*v));
                    }
                }
                same
            });
        if !grown {
            self.newest = (self.newest + 1) % self.parts.len();
            self.count = (self.count + 1).min(self.parts.len());
            if let Some(part) = self.parts.get_mut(self.newest) {
                *part = Part { from: now, to: now, low: *values, high: *values };
            }
        }
    }

    /// Returns the range of the setpoints since a time, with the one in effect at that time. `None`: there are none.
    pub fn range(&self, since: Mono) -> Option<Range> {
        let mut range =
            self.parts.get(self.newest).filter(|_| self.count > 0).map(|p| Range { low: p.low, high: p.high })?;
        let (first, last) = self.parts.split_at_checked(self.newest)?;
        let mut newest = self.parts.get(self.newest)?;
        // From the newest to the oldest part, around the ring.
        let older = first.iter().rev().chain(last.iter().skip(1).rev());
        for part in older.take(self.count - 1) {
            if newest.to < since {
                break;
            }
            let bounds = range.low.iter_mut().zip(&mut range.high).zip(part.low.iter().zip(&part.high));
            for ((low, high), (l, h)) in bounds.take(self.dof) {
                (*low, *high) = (low.min(*l), high.max(*h));
            }
            newest = part;
        }
        Some(range)
    }
}

/// Lowest and highest setpoint of each joint [rad or rad/s].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Range {
    /// Lowest.
    pub low: Joints,
    /// Highest.
    pub high: Joints,
}

impl Range {
    /// Returns the lowest setpoint of a joint.
    pub fn low(&self, joint: usize) -> f64 {
        self.low.get(joint).copied().unwrap_or_default()
    }

    /// Returns the highest setpoint of a joint.
    pub fn high(&self, joint: usize) -> f64 {
        self.high.get(joint).copied().unwrap_or_default()
    }

    /// Returns the signed distance of a joint's value from the range; 0 inside.
    pub fn distance(&self, joint: usize, value: f64) -> f64 {
        match (self.low.get(joint), self.high.get(joint)) {
            (Some(low), _) if value < *low => value - low,
            (_, Some(high)) if value > *high => value - high,
            _ => 0.0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ms(t: u64) -> Mono {
        Mono(t * 1_000_000)
    }

    fn ramp() -> SetpointWindow {
        let mut points = SetpointWindow::new(1, 0.06);
        for k in 0..100u64 {
            points.push(ms(10 * k), &dimos_core::joint::joints_of(&[0.03 * k as f64]));
        }
        points
    }

    #[test]
    fn a_joint_that_lags_is_inside_the_window() {
        let points = ramp();
        let since = ms(990 - 60);
        assert_eq!(points.range(since).unwrap().distance(0, 0.03 * 99.0), 0.0);
        assert_eq!(points.range(since).unwrap().distance(0, 0.03 * 93.0), 0.0);
        let behind = points.range(since).unwrap().distance(0, 0.03 * 80.0);
        assert!((-0.39..-0.33).contains(&behind), "{behind}");
        assert!((points.range(since).unwrap().distance(0, 3.5) - (3.5 - 2.97)).abs() < 1e-12);
    }

    #[test]
    fn a_joint_at_rest_is_compared_with_where_it_was_sent() {
        let mut points = ramp();
        for k in 100..120u64 {
            points.push(ms(10 * k), &dimos_core::joint::joints_of(&[2.97]));
        }
        let off = points.range(ms(1190 - 60)).unwrap().distance(0, 2.8);
        assert!((off + 0.17).abs() < 1e-12, "{off}");
        points.clear();
        assert!(points.range(ms(0)).is_none());
    }

    #[test]
    fn a_fast_tick_needs_no_more_room() {
        let mut points = SetpointWindow::new(1, 0.06);
        for k in 0..1000u64 {
            points.push(ms(k), &dimos_core::joint::joints_of(&[0.003 * k as f64]));
        }
        let range = points.range(ms(999 - 60)).unwrap();
        let (low, high) = (range.low[0], range.high[0]);
        assert!((2.997 - 1e-9..2.998).contains(&high) && (2.75..=0.003 * 939.0).contains(&low), "{low} {high}");
    }
}

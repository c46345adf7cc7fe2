//! When the states that a device streams were measured, and which of them count.

use super::device_time::DeviceTime;
use dimos_core::clock::Mono;

/// Positions that jump by more than the arm can move plus this [rad] count only when the next state agrees.
const MAX_JUMP: f64 = 0.1;
/// Joints may be faster than their top speed by this factor.
const FASTER: f64 = 1.5;

/// Time of the newest state, and the filter of states with impossible positions.
#[derive(Debug, Clone, Copy)]
pub struct Measured<const N: usize> {
    /// When the newest state was measured.
    pub stamp: Mono,
    /// When it arrived.
    pub arrived: Mono,
    device_time: DeviceTime,
    /// Positions of the last state that did not count [rad], and when it arrived.
    suspect: Option<([f64; N], Mono)>,
}

impl<const N: usize> Measured<N> {
    /// Starts with a first state that arrived at `arrived`, with the device's own time [ns] if it sends one.
    pub fn new(device_ns: Option<u64>, arrived: Mono) -> Self {
        let mut measured = Self { stamp: arrived, arrived, device_time: DeviceTime::default(), suspect: None };
        measured.set_time(device_ns, arrived);
        measured
    }

    /// Takes a state. Returns `false` for one that does not count: its positions [rad] are farther from `last` than
    /// joints with the top speed `top` [rad/s] can have moved, and no such state with about the same positions came
    /// before it.
    pub fn take(
        &mut self,
        positions: &[f64; N],
        last: &[f64; N],
        top: f64,
        device_ns: Option<u64>,
        arrived: Mono,
    ) -> bool {
        let possible = |from: &[f64; N], since: Mono| {
            let reach = MAX_JUMP + FASTER * top * arrived.since(since).as_secs_f64();
            positions.iter().zip(from).all(|(new, old)| (new - old).abs() <= reach)
        };
        let agrees = self.suspect.is_some_and(|(before, since)| possible(&before, since));
        if !agrees && !possible(last, self.arrived) {
            self.suspect = Some((*positions, arrived));
            return false;
        }
        self.suspect = None;
        self.set_time(device_ns, arrived);
        true
    }

    fn set_time(&mut self, device_ns: Option<u64>, arrived: Mono) {
        self.stamp = device_ns.map_or(arrived, |ns| self.device_time.translate(ns, arrived));
        self.arrived = arrived;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_jump_counts_when_the_next_state_agrees_with_it() {
        let at = |ms: u64| Mono(ms * 1_000_000);
        let mut measured = Measured::new(None, at(0));
        let mut take = |positions: [f64; 2], ms| measured.take(&positions, &[0.5, 1.0], 3.0, None, at(ms));
        assert!(take([0.52, 1.0], 4));
        assert!(!take([0.0, 0.0], 8), "one alone is noise");
        assert!(take([0.5, 1.0], 12));
        assert!(!take([0.0, 0.0], 16));
        assert!(!take([9.0, -9.0], 20), "two that differ are noise, too");
        assert!(take([9.01, -9.0], 24), "two that agree are where the arm is");
        assert!(!take([f64::NAN, 1.0], 28));
        assert_eq!((measured.arrived, measured.stamp), (at(24), at(24)));
    }
}

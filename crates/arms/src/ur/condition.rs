//! What the controller's state proves of its arm: that positions are measured, and how fast it runs motion.

use super::SPEC;
use super::protocol::state::State;
use super::session::Session;

/// Joints that the controller holds are this close to where it commands them, also in motion [rad].
const HELD_WITHIN: f64 = 0.3;
/// A controller that runs motions at a smaller fraction of their speed reads an order too late for a stop.
const SLOWEST: f64 = 0.02;

impl Session {
    /// Returns whether the joint positions are measured: the controller runs and holds the arm there, in its range.
    /// Before power-on they may be what was measured last, or nothing.
    pub fn positions_are_proven(&self) -> bool {
        let State { position, target, .. } = &self.state;
        let limits = &self.device.limits;
        let ranges = limits.position_lower.iter().zip(&limits.position_upper);
        let inside =
            position.iter().zip(ranges).all(|(q, (low, high))| (low - SPEC.outside..=high + SPEC.outside).contains(q));
        let held = position.iter().zip(target).all(|(q, target)| (q - target).abs() < HELD_WITHIN);
        self.enabled() && inside && held
    }

    /// Returns the fraction of its speed at which the controller runs motions: the slider, times how much it slows them
    /// beyond that. Without a program that runs, the second factor is 0, and means nothing.
    pub fn speed_fraction(&self) -> f64 {
        let scaling = if self.ready.is_some() && self.program_runs() { self.state.scaling } else { 1.0 };
        (self.state.slider * scaling).clamp(0.0, 1.0)
    }

    /// Returns whether the controller is too slow, or stopped on its way, to read an order in time.
    pub(super) fn crawls(&self) -> bool {
        self.speed_fraction() < SLOWEST
    }
}

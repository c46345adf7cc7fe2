//! Dead time of simulated joints: setpoints take effect later than they arrive.

use std::collections::VecDeque;

use dimos_core::joint::{Joints, MAX_DOF};

/// Maximum number of delayed setpoints: those of 1 s at 500 Hz.
const CAPACITY: usize = 512;

/// Setpoints in transit, in the order of their arrival. Allocates only in [`DelayLine::new`].
#[derive(Debug, Clone)]
pub struct DelayLine {
    /// Dead time [s].
    delay: f64,
    /// Elapsed time [s].
    now: f64,
    /// When each setpoint takes effect [s], and the setpoint [rad].
    pending: VecDeque<(f64, Joints)>,
}

impl DelayLine {
    /// Creates an empty line with a dead time of `delay` [s].
    pub fn new(delay: f64) -> Self {
        let delay = if delay.is_finite() { delay.max(0.0) } else { 0.0 };
        let capacity = if delay > 0.0 { CAPACITY } else { 0 };
        Self { delay, now: 0.0, pending: VecDeque::with_capacity(capacity) }
    }

    /// Delays a setpoint [rad]. Returns the one that takes effect at once: this one without dead time, or the oldest
    /// one if the line is full.
    pub fn push(&mut self, target: &[f64]) -> Option<Joints> {
        let mut joints = [f64::NAN; MAX_DOF];
        joints.iter_mut().zip(target).for_each(|(joint, value)| *joint = *value);
        if self.delay == 0.0 {
            return Some(joints);
        }
        let oldest = if self.pending.len() >= CAPACITY { self.pending.pop_front() } else { None };
        self.pending.push_back((self.now + self.delay, joints));
        oldest.map(|(_, joints)| joints)
    }

    /// Advances by up to `limit` [s] until the next setpoint takes effect. Returns the elapsed time and this setpoint
    /// [rad], or `None` after all of `limit`.
    pub fn pass(&mut self, limit: f64) -> Option<(f64, Joints)> {
        match self.pending.front().copied().filter(|(due, _)| *due <= self.now + limit) {
            Some((due, joints)) => {
                self.pending.pop_front();
                let wait = (due - self.now).clamp(0.0, limit);
                self.now += wait;
                Some((wait, joints))
            }
            None => {
                self.now += limit;
                None
            }
        }
    }

    /// Discards all delayed setpoints.
    pub fn clear(&mut self) {
        self.pending.clear();
    }
}

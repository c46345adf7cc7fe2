//! Delivery of commands: until the first setpoint of a start is written, it is recomputed from the newest measurement;
//! after a gap in delivery, motion continues from the last written setpoint.

use super::ArmControl;
use crate::arm::Link;
use crate::clock::Mono;
use crate::control::written::Issued;
use crate::joint::{ControlMode, MAX_DOF};

impl ArmControl {
    /// Returns the time of the last written command during a gap.
    pub fn gap(&self) -> Option<Mono> {
        self.gap_since.map(|_| self.written.last().at)
    }

    /// Takes what the device thread has written, and compares the latest positions with their setpoints.
    pub(super) fn take_written(&mut self, now: Mono) {
        let state = self.feedback.state();
        self.written.report(state.written);
        // An arm that lost its connection has stopped on its own, at some other position.
        if !state.enabled || matches!(state.link, Link::Down | Link::Faulted) {
            self.holds_written = false;
        }
        let follows = self.starting.is_none() && self.command.mode.is_some_and(ControlMode::is_position);
        if !follows {
            return self.tracking.clear_errors();
        }
        // Before the comparison: an arm without new setpoints moves beyond the last one.
        if self.gap_since.is_none() && !self.returning && self.written.gap(now) {
            self.tracking.begin_to_coast(now, &self.limiters);
        }
        self.tracking.compare(self.feedback.state(), &self.limiters);
    }

    /// Begins a new start: the next command does not continue the previous ones and must be where the arm is.
    pub(super) fn start(&mut self) {
        self.command.start_seq = self.command.start_seq.wrapping_add(1);
        self.starting = Some(self.command.seq + 1);
        self.tracking.restart();
        self.rest.start();
        self.seed_limiters();
    }

    /// Starts each joint where it is measured. A joint that still holds the position that was written last, within its
    /// accuracy, starts at that position: otherwise it would sink a little at every start.
    fn seed_limiters(&mut self) {
        for (j, limiter) in self.limiters.iter_mut().enumerate() {
            let q = self.feedback.state().position.get(j).copied().unwrap_or_default();
            let written = self.written.last().position.get(j).copied().filter(|_| self.holds_written);
            let near = |written: &f64| (written - q).abs() <= 2.0 * self.config.supervision.accuracy;
            limiter.seed(written.filter(near).unwrap_or(q));
        }
    }

    /// Finds out whether commands reach the arm, and after a gap, whether the arm is back at what was written last.
    /// During a gap, takes the limiters back to that.
    pub(super) fn check_gap(&mut self, now: Mono) {
        if let Some(first) = self.starting {
            // Each tick makes the first setpoint again from the newest measurement, until one is written.
            if self.feedback.state().written >= first
                && let Some(mode) = self.command.mode
            {
                self.starting = None;
                self.holds_written = mode.is_position();
            } else {
                self.seed_limiters();
            }
        }
        let started = self.starting.is_none() && self.command.mode.is_some();
        // A command from before the gap may be written after the gap was noticed.
        let late = self.gap_since.is_some_and(|first| self.written.last().seq < first);
        let position = self.command.mode.is_some_and(ControlMode::is_position);
        if !(started && (late || self.written.gap(now))) {
            self.gap_since = None;
            self.returning =
                started && position && self.tracking.is_coasting(now, self.feedback.state(), &self.limiters);
            return;
        }
        self.gap_since.get_or_insert(self.command.seq);
        let last = self.written.last();
        for (limiter, (q, v)) in self.limiters.iter_mut().zip(last.position.iter().zip(&last.velocity)) {
            // In position mode the joints are at rest at the last setpoint; in velocity mode they continue.
            limiter.rewind(*q, if position { 0.0 } else { *v });
        }
    }

    /// Keeps the command that leaves the tick, to know later what was written.
    pub fn issue(&mut self, now: Mono) {
        let Some(mode) = self.command.mode else { return };
        let mut issued = Issued { seq: self.command.seq, at: now, position: [0.0; MAX_DOF], velocity: [0.0; MAX_DOF] };
        let out = issued.position.iter_mut().zip(&mut issued.velocity);
        for ((q, v), limiter) in out.zip(&self.limiters) {
            (*q, *v) = (limiter.position(), limiter.velocity());
        }
        self.written.issue(issued);
        self.tracking.push(now, &self.command.values);
        self.holds_written &= mode.is_position();
    }
}

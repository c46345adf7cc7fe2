//! The last setpoint that was written to the arm: a commanded arm continues from it, never from a reading. The device
//! thread reports the number of the newest command that it wrote; the commands of the last ticks are kept to look it
//! up. Nothing written for longer than the arm's controller bridges is a gap.

use std::time::Duration;

use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, Joints, MAX_DOF};

/// Two setpoints at their regular distance are no gap, even if one between them was lost [periods].
const PERIODS: u32 = 2;

/// A command as it was issued.
#[derive(Debug, Clone, Copy)]
pub struct Issued {
    /// `ArmCommand::seq`.
    pub seq: u64,
    /// The tick's time.
    pub at: Mono,
    /// Commanded positions [rad].
    pub position: Joints,
    /// Commanded velocities [rad/s].
    pub velocity: Joints,
    /// The mode of all that.
    pub mode: ControlMode,
    /// Efforts beside the arm's own control [Nm or N].
    pub effort: Option<Joints>,
}

impl Default for Issued {
    fn default() -> Self {
        let (position, velocity, mode) = ([0.0; MAX_DOF], [0.0; MAX_DOF], ControlMode::default());
        Self { seq: 0, at: Mono::ZERO, position, velocity, mode, effort: None }
    }
}

/// The commands of the last ticks of one arm, and the newest of them that was written.
#[derive(Debug, Clone)]
pub struct Written {
    issued: Vec<Issued>,
    next: usize,
    last: Issued,
    limit: Duration,
}

impl Written {
    /// Creates it for this period of the tick, this longest regular time between two setpoints on the wire, and the
    /// time that the arm's controller bridges.
    pub fn new(tick: Duration, write: Duration, tolerance: Duration) -> Self {
        let limit = tolerance.max(PERIODS * tick.max(write));
        let kept = (limit.as_nanos() / tick.as_nanos().max(1)) as usize + 4;
        let none = Issued::default();
        // Time stamps lie on the tick's grid; a period is rounded to ns.
        Self { issued: vec![none; kept.min(4096)], next: 0, last: none, limit: limit + Duration::from_micros(1) }
    }

    /// Keeps a command that leaves the tick.
    pub fn issue(&mut self, issued: Issued) {
        if let Some(slot) = self.issued.get_mut(self.next) {
            *slot = issued;
        }
        self.next = (self.next + 1) % self.issued.len().max(1);
    }

    /// Takes the number of the newest command that the device thread wrote.
    pub fn report(&mut self, seq: u64) {
        if seq != self.last.seq
            && let Some(found) = self.issued.iter().find(|issued| issued.seq == seq && seq != 0)
        {
            self.last = *found;
        }
    }

    /// What was written did not all reach the arm: it was stopped here [rad].
    pub fn rests_at(&mut self, position: &Joints) {
        (self.last.position, self.last.velocity) = (*position, [0.0; MAX_DOF]);
    }

    /// Returns whether a time without a setpoint [s] is no gap.
    pub fn bridges(&self, time: f64) -> bool {
        time <= self.limit.as_secs_f64()
    }

    /// Returns the newest written command.
    pub fn last(&self) -> &Issued {
        &self.last
    }

    /// Returns whether more time than the controller bridges lies between the last written setpoint and one of `now`.
    pub fn gap(&self, now: Mono) -> bool {
        now.since(self.last.at) > self.limit
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_lost_write_is_no_gap_and_two_are() {
        let period = Duration::from_millis(10);
        let mut written = Written::new(period, Duration::from_millis(4), Duration::ZERO);
        let at = |k: u64| Mono(k * 10_000_000);
        let issue = |w: &mut Written, k: u64| {
            let position = dimos_core::joint::joints_of(&[k as f64]);
            w.issue(Issued { seq: k, at: at(k), position, ..Issued::default() });
        };
        for k in 1..50 {
            written.report(k - 1);
            issue(&mut written, k);
            assert!(k == 1 || !written.gap(at(k)), "{k}");
        }
        written.report(48);
        assert!(!written.gap(at(50)) && written.gap(at(51)));
        assert_eq!(written.last().position[0], 48.0);
        written.report(7);
        assert_eq!(written.last().seq, 48, "too old to be known: the last one stays");
        written.report(49);
        assert_eq!(written.last().position[0], 49.0);
    }
}

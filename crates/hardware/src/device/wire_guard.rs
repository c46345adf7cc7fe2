//! The last check of a setpoint before it is written. The tick keeps the limits between its commands; this check keeps
//! them between setpoints that reach the wire, even when commands are skipped.

use std::time::Duration;

use dimos_core::arm::{ArmCommand, ArmState, EffortLimits, Impedance, Supervision};
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, JointLimits, Joints, MAX_DOF};

/// Maximum time that one step may cover where the arm's controller bridges less, in periods.
const PERIODS: u32 = 2;
/// Tolerance for rounding, relative to a step and absolute [rad, rad/s].
const ROUNDING: (f64, f64) = (1e-6, 1e-6);

/// The last setpoint written.
#[derive(Debug, Clone, Copy)]
struct Last {
    mode: ControlMode,
    values: Joints,
    effort: Option<Joints>,
    at: Mono,
    start_seq: u32,
}

/// Decides whether a command may be written.
#[derive(Debug)]
pub struct WireGuard {
    last: Option<Last>,
    velocity: Joints,
    acceleration: Joints,
    dof: usize,
    /// The longer of the tick's and the arm's own period.
    period: Duration,
    supervision: Supervision,
    /// Without limits, no effort is written; without gains, no gain.
    efforts: Option<EffortLimits>,
    impedance: Option<Impedance>,
}

impl WireGuard {
    /// Creates the guard of an arm with `dof` joints; `period` is the longer of the tick's and the arm's own for
    /// setpoints.
    pub fn new(dof: usize, period: Duration, supervision: Supervision) -> Self {
        Self {
            last: None,
            velocity: [0.0; MAX_DOF],
            acceleration: [0.0; MAX_DOF],
            dof,
            period,
            supervision,
            efforts: None,
            impedance: None,
        }
    }

    /// Sets the limits of efforts, and those of gains.
    pub fn set_efforts(&mut self, efforts: Option<EffortLimits>, impedance: Option<Impedance>) {
        (self.efforts, self.impedance) = (efforts, impedance);
    }

    /// Returns the longest time without a setpoint.
    pub fn longest_gap(&self) -> Duration {
        (PERIODS * self.period).max(self.supervision.gap_tolerance)
    }

    /// Sets the period: the longer of the tick's and the arm's own for setpoints.
    pub fn set_period(&mut self, period: Duration) {
        self.period = period;
    }

    /// Sets the longest time without a setpoint that the arm bridges.
    pub fn set_gap_tolerance(&mut self, tolerance: Duration) {
        self.supervision.gap_tolerance = tolerance;
    }

    /// Sets the limits of commands.
    pub fn set_limits(&mut self, limits: &JointLimits) {
        let limits = limits.clone().with_defaults();
        self.velocity = dimos_core::joint::joints_of(&limits.velocity_max);
        self.acceleration = dimos_core::joint::joints_of(&limits.acceleration_max);
    }

    /// Forgets the last setpoint: the motors are off, or the connection is new.
    pub fn forget(&mut self) {
        self.last = None;
    }

    /// Records a setpoint that was written, or may have been.
    pub fn wrote(&mut self, command: &ArmCommand, mode: ControlMode) {
        let ArmCommand { values, effort, at, start_seq, .. } = *command;
        self.last = Some(Last { mode, values, effort, at, start_seq });
    }

    /// Returns whether a command continues the last setpoint, rather than to begin a start.
    pub fn continues(&self, command: &ArmCommand, mode: ControlMode) -> bool {
        self.last.is_some_and(|last| last.start_seq == command.start_seq && last.mode == mode)
    }

    /// Returns whether a command may be written. `state` is the newest reading, `age` its age, `read_period` the period
    /// of reads.
    pub fn admits(
        &self,
        command: &ArmCommand,
        mode: ControlMode,
        state: &ArmState,
        age: Duration,
        read_period: Duration,
    ) -> bool {
        let last = self.last.filter(|last| last.start_seq == command.start_seq && last.mode == mode);
        if !self.gains_are_within(command, mode) || !self.effort_is_within(command, last.as_ref()) {
            return false;
        }
        match last {
            Some(last) => {
                let time = command.at.since(last.at).clamp(Duration::ZERO, self.longest_gap()).as_secs_f64();
                let limits = if mode == ControlMode::Velocity { &self.acceleration } else { &self.velocity };
                self.within(&command.values, &last.values, |j| {
                    limits.get(j).copied().unwrap_or_default() * time * (1.0 + ROUNDING.0) + ROUNDING.1
                })
            }
            None if age > 2 * read_period => false,
            None if mode == ControlMode::Velocity => {
                let time = (PERIODS * self.period).as_secs_f64();
                self.within(&command.values, &[0.0; MAX_DOF], |j| {
                    self.acceleration.get(j).copied().unwrap_or_default() * time + ROUNDING.1
                })
            }
            None => self.starts_at(command, state),
        }
    }

    /// Returns whether the efforts are within their limits, and change no faster than these allow. A start may begin
    /// with any of them: an arm that is held against its weight needs them at once.
    fn effort_is_within(&self, command: &ArmCommand, last: Option<&Last>) -> bool {
        let Some(effort) = &command.effort else { return true };
        let Some(limits) = &self.efforts else { return false };
        let most = |list: &Joints, j: usize, time: f64| {
            list.get(j).copied().unwrap_or_default() * time * (1.0 + ROUNDING.0) + ROUNDING.1
        };
        let steady = last.is_none_or(|last| {
            let time = command.at.since(last.at).clamp(Duration::ZERO, self.longest_gap()).as_secs_f64();
            // What was not commanded before begins at zero.
            self.within(effort, &last.effort.unwrap_or([0.0; MAX_DOF]), |j| most(&limits.rate, j, time))
        });
        steady && self.within(effort, &[0.0; MAX_DOF], |j| most(&limits.max, j, 1.0))
    }

    /// Returns whether there are gains in impedance mode only, and within those that the arm takes.
    fn gains_are_within(&self, command: &ArmCommand, mode: ControlMode) -> bool {
        let Some([stiffness, damping]) = &command.gains else { return mode != ControlMode::Impedance };
        let Some(most) = self.impedance.as_ref().filter(|_| mode == ControlMode::Impedance) else { return false };
        let within = |list: &Joints, most: &Joints| {
            list.iter().zip(most).take(self.dof).all(|(gain, most)| (0.0..=*most).contains(gain))
        };
        within(stiffness, &most.stiffness_max) && within(damping, &most.damping_max)
    }

    /// Returns whether the first setpoint is at the measured position or at what the arm's controller commands itself,
    /// or repeats the last setpoint while the arm is still there.
    fn starts_at(&self, command: &ArmCommand, state: &ArmState) -> bool {
        // Slightly more than the tick allows, which used an earlier reading.
        let seed = self.supervision.seed_tolerance().max(2.0 * self.supervision.accuracy);
        let last = self.last.filter(|last| last.mode.is_position());
        (0..self.dof).all(|j| {
            let (Some(value), Some(q)) = (command.values.get(j), state.position.get(j)) else { return false };
            let repeats = last.is_some_and(|last| last.values.get(j) == Some(value));
            let own = state.commanded.as_ref().and_then(|own| own.position.get(j));
            let droop = 2.0 * self.supervision.accuracy + self.supervision.droop;
            let commanded = own.is_some_and(|own| (value - own).abs() <= seed)
                && (value - q).abs() <= self.supervision.tracking_tolerance;
            commanded || (value - q).abs() <= if repeats { droop + seed } else { seed }
        })
    }

    fn within(&self, values: &Joints, from: &Joints, reach: impl Fn(usize) -> f64) -> bool {
        let steps = values.iter().zip(from).take(self.dof).enumerate();
        steps.into_iter().all(|(j, (to, from))| (to - from).abs() <= reach(j))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::joint::joints_of;

    const P: Duration = Duration::from_millis(10);

    fn guard() -> WireGuard {
        let mut guard = WireGuard::new(1, P, Supervision::default());
        let mut limits = JointLimits::uniform(1, 3.0, 2.0);
        limits.acceleration_max = vec![10.0];
        guard.set_limits(&limits);
        guard
    }

    fn command(ms: u64, value: f64, start_seq: u32) -> ArmCommand {
        ArmCommand { at: Mono(ms * 1_000_000), values: joints_of(&[value]), start_seq, ..ArmCommand::default() }
    }

    fn state(q: f64) -> ArmState {
        ArmState { position: joints_of(&[q]), ..ArmState::default() }
    }

    #[test]
    fn a_step_covers_two_periods_at_most() {
        let (mut g, servo) = (guard(), ControlMode::ServoPosition);
        g.wrote(&command(100, 0.0, 1), servo);
        let admits = |g: &WireGuard, ms, q| g.admits(&command(ms, q, 1), servo, &state(9.0), Duration::ZERO, P);
        assert!(admits(&g, 110, 0.02) && !admits(&g, 110, 0.021));
        assert!(admits(&g, 120, 0.04) && !admits(&g, 120, 0.041));
        assert!(admits(&g, 900, 0.04) && !admits(&g, 900, 0.041), "regardless of the length of the gap");
    }

    #[test]
    fn the_first_setpoint_must_be_at_the_measured_position() {
        let (mut g, servo) = (guard(), ControlMode::ServoPosition);
        let admits = |g: &WireGuard, value, q, age| g.admits(&command(100, value, 2), servo, &state(q), age, P);
        assert!(admits(&g, 0.504, 0.5, P) && !admits(&g, 0.511, 0.5, P));
        assert!(!admits(&g, 0.5, 0.5, 3 * P), "a stale reading");
        g.wrote(&command(90, 0.515, 1), servo);
        assert!(admits(&g, 0.515, 0.5, P), "the arm is there");
        g.forget();
        assert!(!admits(&g, 0.515, 0.5, P));
    }

    #[test]
    fn velocities_change_by_the_acceleration() {
        let (mut g, velocity) = (guard(), ControlMode::Velocity);
        let admits = |g: &WireGuard, ms, v| g.admits(&command(ms, v, 1), velocity, &state(0.0), Duration::ZERO, P);
        assert!(admits(&g, 100, 0.1) && !admits(&g, 100, 0.3));
        g.wrote(&command(100, 1.0, 1), velocity);
        assert!(admits(&g, 110, 1.1) && !admits(&g, 110, 1.11));
    }

    #[test]
    fn efforts_keep_their_limits_and_their_rate_and_none_is_written_without_limits() {
        let (mut g, servo) = (guard(), ControlMode::ServoPosition);
        let with = |ms, effort: Option<f64>, start| ArmCommand {
            effort: effort.map(|effort| joints_of(&[effort])),
            ..command(ms, 0.0, start)
        };
        let admits = |g: &WireGuard, ms, effort| g.admits(&with(ms, effort, 1), servo, &state(0.0), Duration::ZERO, P);
        assert!(admits(&g, 100, None) && !admits(&g, 100, Some(0.0)), "no limits are known");
        g.set_efforts(Some(EffortLimits { max: [20.0; MAX_DOF], rate: [200.0; MAX_DOF] }), None);
        assert!(admits(&g, 100, Some(-20.0)) && !admits(&g, 100, Some(20.1)) && !admits(&g, 100, Some(f64::NAN)));
        g.wrote(&with(100, Some(5.0), 1), servo);
        assert!(admits(&g, 110, Some(7.0)) && !admits(&g, 110, Some(7.1)) && !admits(&g, 110, Some(2.9)));
        assert!(admits(&g, 900, Some(9.0)) && !admits(&g, 900, Some(9.1)), "regardless of the length of the gap");
        let starts = g.admits(&with(110, Some(-15.0), 2), servo, &state(0.0), Duration::ZERO, P);
        assert!(starts, "a start carries its weight at once");
        g.wrote(&with(100, None, 1), servo);
        assert!(admits(&g, 110, Some(2.0)) && !admits(&g, 110, Some(2.1)), "what was not commanded begins at zero");
    }

    #[test]
    fn gains_belong_to_impedance_mode_and_are_within_those_of_the_arm() {
        let mut g = guard();
        let admits = |g: &WireGuard, gains: Option<(f64, f64)>, mode| {
            let gains = gains.map(|(stiffness, damping)| [joints_of(&[stiffness]), joints_of(&[damping])]);
            g.admits(&ArmCommand { gains, ..command(100, 0.0, 1) }, mode, &state(0.0), Duration::ZERO, P)
        };
        let (servo, impedance) = (ControlMode::ServoPosition, ControlMode::Impedance);
        assert!(!admits(&g, Some((1.0, 1.0)), impedance), "the arm's are not known");
        g.set_efforts(None, Some(Impedance::uniform((100.0, 2.0), (500.0, 5.0))));
        assert!(admits(&g, Some((500.0, 0.0)), impedance) && !admits(&g, None, impedance));
        for wrong in [(501.0, 1.0), (-1.0, 1.0), (1.0, 5.1), (f64::NAN, 1.0)] {
            assert!(!admits(&g, Some(wrong), impedance), "{wrong:?}");
        }
        assert!(!admits(&g, Some((1.0, 1.0)), servo) && admits(&g, None, servo));
    }

    /// Of rad or rad/s: more than the rounding of a sum, less than any resolution of an arm.
    #[test]
    fn rounding_is_no_reason_to_skip_a_setpoint() {
        let (mut g, servo) = (guard(), ControlMode::ServoPosition);
        g.wrote(&command(100, 0.0, 1), servo);
        let admits = |g: &WireGuard, q| g.admits(&command(110, q, 1), servo, &state(0.0), Duration::ZERO, P);
        assert!(admits(&g, 0.02 * (1.0 + 1e-6) + 0.9e-6) && !admits(&g, 0.02 * (1.0 + 1e-6) + 1.1e-6));
        let velocity = ControlMode::Velocity;
        let starts = |v| guard().admits(&command(110, v, 1), velocity, &state(0.0), Duration::ZERO, P);
        assert!(starts(0.2 + 0.9e-6) && !starts(0.2 + 1.1e-6));
    }

    #[test]
    fn a_reading_of_two_periods_ago_is_still_one_to_start_from() {
        let admits = |age| guard().admits(&command(1, 0.0, 1), ControlMode::ServoPosition, &state(0.0), age, P);
        assert!(admits(2 * P) && !admits(2 * P + Duration::from_nanos(1)));
    }

    #[test]
    fn a_new_start_or_another_mode_is_not_compared_with_the_last_setpoint() {
        let (mut g, servo, velocity) = (guard(), ControlMode::ServoPosition, ControlMode::Velocity);
        g.wrote(&command(100, 0.0, 1), servo);
        let admits = |value, start, mode| g.admits(&command(110, value, start), mode, &state(0.5), Duration::ZERO, P);
        assert!(admits(0.0, 1, servo) && !admits(0.5, 1, servo), "it continues");
        assert!(admits(0.5, 2, servo), "it starts again, where the arm is now");
        assert!(admits(0.15, 1, velocity) && !admits(0.25, 1, velocity), "velocities start at 0");
    }

    #[test]
    fn an_arm_that_sags_starts_at_its_last_setpoint_and_no_other() {
        let supervision = Supervision { accuracy: 0.02, ..Supervision::default() };
        let mut g = WireGuard::new(1, P, supervision);
        g.wrote(&command(90, 0.5, 1), ControlMode::ServoPosition);
        let admits = |value, q| g.admits(&command(100, value, 2), ControlMode::ServoPosition, &state(q), P, P);
        // Twice its accuracy, and the step that the tick allows.
        assert!(admits(0.5, 0.421) && !admits(0.5, 0.419));
        assert!(admits(0.51, 0.4701) && !admits(0.51, 0.4699), "not the last setpoint");
    }

    #[test]
    fn a_longer_period_allows_longer_steps() {
        let (mut g, servo) = (guard(), ControlMode::ServoPosition);
        g.set_period(3 * P);
        g.wrote(&command(100, 0.0, 1), servo);
        let admits = |q| g.admits(&command(900, q, 1), servo, &state(0.0), Duration::ZERO, P);
        assert!(admits(0.12) && !admits(0.121));
    }
}

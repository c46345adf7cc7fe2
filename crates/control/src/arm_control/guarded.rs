//! What the collision guard needs of an arm: its next step, and its deceleration instead of that.

use super::{ArmControl, Limiter};
use crate::guard::JointStep;
use crate::rest::braking;
use dimos_core::joint::ControlMode;

impl ArmControl {
    /// Returns whether its position is known: some state was read.
    pub fn is_placed(&self) -> bool {
        self.feedback.state().seq > 0
    }

    /// Returns whether its commands were at rest before this tick.
    pub fn was_at_rest(&self) -> bool {
        self.before.iter().all(Limiter::at_rest)
    }

    /// Returns the step of a joint of the arm in this tick, or with `braking` the first step of its deceleration
    /// instead.
    pub fn step(&self, joint: usize, braking: bool, dt: f64) -> JointStep {
        let measured = self.feedback.state().position.get(joint).copied().unwrap_or_default();
        let (Some(mode), Some(before), Some(limiter)) =
            (self.command.mode, self.before.get(joint), self.limiters.get(joint))
        else {
            return JointStep::at(measured);
        };
        // All joints brake together: after a first step of braking, each by the same as in that step.
        let of = |limiters: &[Limiter]| braking::decreases(limiters, dt).get(joint).copied().unwrap_or_default();
        let decrease = if braking { of(&self.before) } else { of(&self.limiters) };
        let velocity = if braking { before.braked(decrease) } else { limiter.velocity() };
        if mode == ControlMode::Velocity {
            let (low, high) =
                self.ahead(dt).and_then(|ahead| ahead.get(joint).copied()).unwrap_or((measured, measured));
            let from = 0.5 * (low + high);
            return JointStep { from, to: from + velocity * dt, velocity, decrease, spread: 0.5 * (high - low) };
        }
        let from = before.position();
        let to = if braking { from + velocity * dt } else { limiter.position() };
        if mode == ControlMode::Impedance {
            // It may be anywhere between where it is pushed and where it is commanded.
            let (middle, spread) = (0.5 * (from + measured), 0.5 * (from - measured).abs());
            return JointStep { from: middle, to: middle + (to - from), velocity, decrease, spread };
        }
        JointStep { from, to, velocity, decrease, spread: 0.0 }
    }

    /// Decelerates instead of following the requests of this tick.
    pub fn brake(&mut self, dt: f64) {
        let velocity = self.command.mode == Some(ControlMode::Velocity);
        let dt = self.own_time(dt);
        if dt == 0.0 {
            self.limiters.copy_from_slice(&self.before);
            let out = self.limiters.iter().zip(self.command.values.iter_mut());
            out.for_each(|(limiter, out)| *out = if velocity { limiter.velocity() } else { limiter.position() });
            return;
        }
        let decreases = braking::decreases(&self.before, dt);
        let joints = self.limiters.iter_mut().zip(&self.before).zip(decreases);
        for (((limiter, before), decrease), out) in joints.zip(self.command.values.iter_mut()) {
            limiter.decelerate_from(before, decrease, dt);
            *out = if velocity { limiter.velocity() } else { limiter.position() };
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::belief::stalls::Stalls;
    use crate::config::ArmConfig;
    use dimos_core::arm::ArmState;
    use dimos_core::clock::Mono;
    use dimos_core::joint::joints_of;

    const PERIOD: Duration = Duration::from_millis(10);
    const DT: f64 = 0.01;

    /// Two joints whose limiters were at `before` [rad, rad/s] and are at `now`.
    fn arm(mode: ControlMode, before: (f64, f64), now: (f64, f64)) -> ArmControl {
        let mut config = ArmConfig::of_two_joints(2.0);
        config.limits.acceleration_max = vec![5.0; 2];
        let mut arm = ArmControl::new(config, 0, PERIOD);
        arm.command.mode = Some(mode);
        arm.before.iter_mut().for_each(|limiter| limiter.rewind(before.0, before.1));
        arm.limiters.iter_mut().for_each(|limiter| limiter.rewind(now.0, now.1));
        arm
    }

    fn see(arm: &mut ArmControl, seq: u64, positions: [f64; 2]) {
        let stamp = Mono(1_000_000_000 + seq * 10_000_000);
        let state = ArmState { seq, stamp, dof: 2, position: joints_of(&positions), ..ArmState::default() };
        arm.feedback.read(&state, None, false, stamp, &Stalls::default());
    }

    fn close(a: JointStep, b: JointStep) -> bool {
        let pairs =
            [(a.from, b.from), (a.to, b.to), (a.velocity, b.velocity), (a.decrease, b.decrease), (a.spread, b.spread)];
        pairs.iter().all(|(a, b)| (a - b).abs() < 1e-12)
    }

    #[test]
    fn an_arm_is_placed_with_its_first_state_and_at_rest_as_its_setpoints_were() {
        let mut moving = arm(ControlMode::ServoPosition, (0.5, 0.3), (0.503, 0.3));
        assert!(!moving.is_placed() && !moving.was_at_rest());
        see(&mut moving, 1, [0.5, 0.5]);
        assert!(moving.is_placed());
        assert!(arm(ControlMode::ServoPosition, (0.5, 0.0), (0.503, 0.3)).was_at_rest());
    }

    #[test]
    fn the_step_is_that_of_the_limiters_and_braking_the_first_of_the_deceleration() {
        let arm = arm(ControlMode::ServoPosition, (0.5, 0.4), (0.506, 0.42));
        let step = JointStep { from: 0.5, to: 0.506, velocity: 0.42, decrease: 5.0 * DT, spread: 0.0 };
        assert_eq!(arm.step(1, false, DT), step);
        let braking = JointStep { to: 0.5 + 0.35 * DT, velocity: 0.35, ..step };
        assert!(close(arm.step(1, true, DT), braking), "{:?}", arm.step(1, true, DT));
        assert_eq!(arm.step(2, false, DT), JointStep::at(0.0), "no such joint");
    }

    /// A joint that moves slowly would rest sooner on its own, beside the line on which the way was proven free.
    #[test]
    fn the_braking_that_is_executed_is_the_one_that_was_proven() {
        let mut arm = arm(ControlMode::ServoPosition, (0.5, 0.4), (0.506, 0.42));
        arm.before[1].rewind(0.5, -0.1);
        for tick in 0..12 {
            let proven = [0, 1].map(|joint| arm.step(joint, true, DT));
            arm.brake(DT);
            for (joint, proven) in proven.iter().enumerate() {
                let executed = &arm.limiters[joint];
                assert!((executed.position() - proven.to).abs() < 1e-12, "{joint} in tick {tick}: {proven:?}");
                assert!((executed.velocity() - proven.velocity).abs() < 1e-12, "{joint} in tick {tick}: {proven:?}");
                assert_eq!(arm.command.values[joint], executed.position());
            }
            arm.before.copy_from_slice(&arm.limiters);
        }
        assert!(arm.was_at_rest());
    }

    #[test]
    fn a_joint_that_yields_may_be_anywhere_between_its_reading_and_its_setpoint() {
        let mut arm = arm(ControlMode::Impedance, (0.5, 0.4), (0.504, 0.4));
        see(&mut arm, 1, [0.1, 0.5]);
        let step = arm.step(0, false, DT);
        let expected = JointStep { from: 0.3, to: 0.304, velocity: 0.4, decrease: 5.0 * DT, spread: 0.2 };
        assert!(close(step, expected), "{step:?}");
    }

    #[test]
    fn with_velocities_the_step_begins_where_the_joint_may_be() {
        let mut arm = arm(ControlMode::Velocity, (0.0, 0.4), (0.0, 0.42));
        see(&mut arm, 1, [0.2, 0.7]);
        let step = JointStep { from: 0.7, to: 0.7 + 0.42 * DT, velocity: 0.42, decrease: 5.0 * DT, spread: 0.0 };
        assert!(close(arm.step(1, false, DT), step), "{:?}", arm.step(1, false, DT));
        let braking = JointStep { to: 0.7 + 0.35 * DT, velocity: 0.35, ..step };
        assert!(close(arm.step(1, true, DT), braking), "{:?}", arm.step(1, true, DT));
    }

    #[test]
    fn with_velocities_a_joint_may_be_anywhere_on_the_way_that_its_setpoints_take_it_since_it_was_measured() {
        let mut arm = arm(ControlMode::Velocity, (0.0, 0.0), (0.0, 0.0));
        let stamp = Mono(2_000_000_000);
        arm.tracking.push(stamp, &joints_of(&[]), Some(&joints_of(&[0.4, -0.2])));
        // 8 ms old, of which this computer could not read for 3 ms.
        let state = ArmState { seq: 1, stamp, dof: 2, own_delay_ns: 3_000_000, ..ArmState::default() };
        arm.feedback.read(&state, None, false, stamp.after(Duration::from_millis(8)), &Stalls::default());
        let time = arm.config.supervision.lag + 0.008 + DT;
        for (joint, velocity) in [(0, 0.4), (1, -0.2)] {
            let step = arm.step(joint, false, DT);
            assert!((step.from - 0.5 * velocity * time).abs() < 1e-12, "{step:?}");
            assert!((step.spread - 0.5 * f64::abs(velocity) * time).abs() < 1e-12, "{step:?}");
        }
    }

    /// A reading alone does not say where it is: it may be false, and velocities have led the joint elsewhere.
    #[test]
    fn with_velocities_a_joint_may_be_anywhere_between_its_reading_and_where_they_have_led_it() {
        let mut arm = arm(ControlMode::Velocity, (0.6, 0.0), (0.6, 0.0));
        see(&mut arm, 1, [0.2, 0.9]);
        arm.tracking.push(Mono(1_010_000_000), &joints_of(&[]), Some(&joints_of(&[0.0, 0.0])));
        let between = JointStep { from: 0.4, to: 0.4, spread: 0.2, ..arm.step(0, false, DT) };
        assert!(close(arm.step(0, false, DT), between), "{:?}", arm.step(0, false, DT));
        let between = JointStep { from: 0.75, to: 0.75, spread: 0.15, ..arm.step(1, false, DT) };
        assert!(close(arm.step(1, false, DT), between), "{:?}", arm.step(1, false, DT));
    }
}

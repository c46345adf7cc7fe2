//! Limits that a control box watches in servo mode, where it executes what it is given: the joints' speed, the tool's
//! speed, and a joint that does not get ahead. Codes are the vendor's; where it gives no figure, a comment says that
//! ours is a choice.

use nalgebra::Isometry3;

use super::super::model::Model;
use super::kinematics::Links;
use dimos_core::clock::Mono;
use dimos_hardware::sim::reach::Chain;

/// Error: speed over the limit.
pub const SPEED: u8 = 24;
/// Error: abnormal current, as of a collision.
pub const COLLISION: u8 = 31;
/// Error: the tool's speed over the limit in servo mode.
pub const TOOL_SPEED: u8 = 60;
/// Firmware with [`TOOL_SPEED`] and a limit that is settable; before, the top speed is the limit and the error
/// [`SPEED`].
const SETTABLE: [u16; 3] = [2, 3, 0];
/// Default limit of the tool's speed in servo mode, as a multiple of its top speed in planned moves.
pub const LIMIT_FACTOR: f32 = 1.2;
/// Setpoints may be late by this much without a jump [s] (our choice).
const LATE: f64 = 0.1;
/// A setpoint may be this much faster: times of arrival jitter (our choice).
const SLACK: f64 = 1.05;
/// A joint this far from its goal is to move [rad].
const FAR: f64 = 0.02;
/// Time after which a joint that does not move counts as a collision [s]: about 2 s in servo mode, where the box
/// does not know the planned torques (xArm-Python-SDK #128); shorter in others (our choice).
const BLOCKED_SERVO: f64 = 2.0;
const BLOCKED_PLANNED: f64 = 0.3;

/// What the box remembers of a stream.
#[derive(Debug, Clone, Copy, Default)]
pub struct Judge {
    last: Option<([f64; 7], Mono)>,
    /// How far each joint may still go at once [rad].
    credit: [f64; 7],
    /// Where the arm is to go [rad], and whether it is to turn.
    goal: Option<[f64; 7]>,
    turns: bool,
    blocked_since: Option<Mono>,
}

impl Judge {
    /// Forgets the stream: the arm was stopped.
    pub fn forget(&mut self) {
        *self = Self::default();
    }

    /// Returns the last setpoint [rad].
    pub fn last_setpoint(&self) -> Option<[f64; 7]> {
        self.last.map(|(setpoint, _)| setpoint)
    }

    /// Takes a setpoint [rad] for an arm that is at `at`; the error if a joint would have to be faster than `top`
    /// [rad/s].
    pub fn setpoint(&mut self, target: &[f64; 7], at: &[f64; 7], top: f64, now: Mono) -> Result<(), u8> {
        let (before, passed) = self.last.map_or((*at, LATE), |(last, since)| (last, now.seconds_since(since)));
        let mut jumps = false;
        for ((credit, target), before) in self.credit.iter_mut().zip(target).zip(before) {
            *credit = (*credit + top * SLACK * passed).min(top * LATE) - (target - before).abs();
            jumps |= *credit < 0.0;
        }
        (self.last, self.goal) = (Some((*target, now)), Some(*target));
        if jumps { Err(SPEED) } else { Ok(()) }
    }

    /// Takes the goal of a planned move [rad].
    pub fn goes_to(&mut self, goal: Option<[f64; 7]>) {
        self.goal = goal;
    }

    /// Takes velocities [rad/s].
    pub fn turns_at(&mut self, velocities: &[f64; 7]) {
        self.turns = velocities.iter().any(|velocity| *velocity != 0.0);
    }

    /// Returns the error of a joint that is blocked while an arm at `at` [rad] is commanded to move.
    pub fn blocked(&mut self, blocked: bool, at: &[f64; 7], mode: u8, now: Mono) -> Option<u8> {
        let far = |goal: [f64; 7]| goal.iter().zip(at).any(|(goal, at)| (goal - at).abs() > FAR);
        if !blocked || !(self.turns || self.goal.is_some_and(far)) {
            self.blocked_since = None;
            return None;
        }
        let since = *self.blocked_since.get_or_insert(now);
        let limit = if mode == 1 { BLOCKED_SERVO } else { BLOCKED_PLANNED };
        (now.seconds_since(since) > limit).then_some(COLLISION)
    }
}

/// Returns the speed of the tool [m/s] at joint positions [rad] and velocities [rad/s].
pub fn tool_speed(chain: Links, tool: &Isometry3<f64>, positions: &[f64; 7], velocities: &[f64; 7]) -> f64 {
    let end = chain.forward(positions) * tool;
    let velocity = chain.jacobian(positions, &end.translation.vector) * nalgebra::SVector::from(*velocities);
    velocity.fixed_rows::<3>(0).norm()
}

/// Returns the limit of the tool's speed in servo mode [m/s], and the error above it.
pub fn tool_limit(model: Option<Model>, firmware: [u16; 3], factor: f32) -> (f64, u8) {
    let top = model.map_or(1.0, |model| model.line_speed() / 1000.0);
    if firmware < SETTABLE { (top, SPEED) } else { (top * f64::from(factor), TOOL_SPEED) }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::super::super::model::VELOCITY;
    use super::*;

    /// Streams a ramp of joint 1, one setpoint per `period` [s]; the time until it is refused [s].
    fn ramp(speed: f64, period: f64) -> Option<f64> {
        let (mut judge, mut now) = (Judge::default(), Mono(1));
        (0..200).find_map(|i| {
            let mut target = [0.0; 7];
            target[0] = speed * period * f64::from(i);
            now = now.after(Duration::from_secs_f64(period));
            judge.setpoint(&target, &[0.0; 7], VELOCITY, now).is_err().then_some(f64::from(i) * period)
        })
    }

    #[test]
    fn joints_may_be_as_fast_as_the_arm_and_not_faster() {
        for period in [0.004, 0.01, 0.05] {
            assert_eq!(ramp(VELOCITY, period), None, "{period}");
            assert!(ramp(2.0 * VELOCITY, period).is_some_and(|after| after < 0.2), "{period}: {:?}", ramp(6.3, period));
        }
    }

    #[test]
    fn a_jump_is_refused_and_a_late_setpoint_is_not() {
        let mut judge = Judge::default();
        let at = |degrees: f64| [degrees.to_radians(), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let time = |ms: u64| Mono(1).after(Duration::from_millis(ms));
        assert_eq!(judge.setpoint(&at(0.5), &at(0.0), VELOCITY, time(0)), Ok(()));
        assert_eq!(judge.setpoint(&at(10.0), &at(0.0), VELOCITY, time(80)), Ok(()), "80 ms late at 120°/s");
        assert_eq!(judge.setpoint(&at(50.0), &at(0.0), VELOCITY, time(2000)), Err(SPEED), "40° at once");
        judge.forget();
        assert_eq!(judge.setpoint(&at(40.0), &at(0.0), VELOCITY, time(3000)), Err(SPEED), "the first setpoint too");
    }

    #[test]
    fn the_limit_of_the_tool_follows_model_and_firmware() {
        assert_eq!(tool_limit(Some(Model::Xarm6), [2, 2, 2], LIMIT_FACTOR), (1.0, SPEED));
        let (limit, code) = tool_limit(Some(Model::Xarm6), [2, 5, 1], LIMIT_FACTOR);
        assert!((limit - 1.2).abs() < 1e-6 && code == TOOL_SPEED);
        assert!((tool_limit(Some(Model::Lite6), [2, 5, 1], LIMIT_FACTOR).0 - 0.6).abs() < 1e-6);
        let swing = [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
        let speed = tool_speed(Links::of(Model::Xarm6), &Isometry3::identity(), &[0.0; 7], &swing);
        assert!((speed - 0.207).abs() < 1e-9, "{speed}");
    }
}

//! The motion of one joint: out and back in one mode, and a stop on the way.

use std::collections::VecDeque;
use std::ops::Range;
use std::time::Duration;

use super::{DEGREE, FirstMotion, FirstMotionEnd, JointMotion, MAX_STRAY, REACH, SPEED};
use crate::conformance::context::{farthest, rest_point, when_there_is_room};
use crate::conformance::lag::Trace;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::joint::ControlMode;

/// Speed of the move that a stop interrupts, as a fraction of the top speed.
const STOPPED_SPEED: f64 = 0.02;
/// Distance to the target at which a joint has arrived [rad].
const GOAL_TOLERANCE: f64 = 0.3 * DEGREE;
/// Motion beyond the target that counts as unexpected [rad].
const MAX_OVERSHOOT: f64 = 1.0 * DEGREE;
/// Tracking error that counts as unexpected [rad].
const MAX_TRACKING_ERROR: f64 = 1.5 * DEGREE;
/// A planned move may be this many times as fast as ordered; its speed is an average over this time [s].
const MAX_SPEED_RATIO: f64 = 2.5;
const SPEED_WINDOW: f64 = 0.05;
/// How long one move may take.
pub(super) const MOVE_TIMEOUT: Duration = Duration::from_secs(15);
/// Readings from one setpoint of a stream to the next. A reading right after each setpoint only would always see the
/// joint in the same part of its step.
const SAMPLES: u32 = 4;
/// Shortest time of a wave, and of one that measures the lag [s]: slow enough for the tracking error to stay small in
/// spite of a long lag.
const MIN_WAVE_TIME: (f64, f64) = (0.3, 0.8);
/// Longest time by which setpoints advance at once [s].
const MAX_TIME_STEP: f64 = 0.01;
/// Allowed integral of a joint's velocity, as a fraction of its travel. It is below 1 where this program got no
/// processor during the fast part, but never has the other sign, and never is as large as degrees for radians.
const VELOCITY_INTEGRAL_RATIO: Range<f64> = -0.3..5.0;

/// Observations during one move: the joint's offset from the start, the largest motion of the others, and the integral
/// of the measured velocity [rad].
#[derive(Clone, Copy, Default)]
pub(super) struct Observed {
    moved: f64,
    others: f64,
    integral: Option<f64>,
}

/// Adds a position [rad] to the recent path. Returns the speed [rad/s] and its ratio to the ordered one if it is too
/// fast.
fn check_speed(path: &mut VecDeque<(Mono, f64)>, at: Mono, moved: f64, ordered: f64) -> Result<(), (f64, f64)> {
    path.push_back((at, moved));
    while path.get(1).is_some_and(|(then, _)| at.seconds_since(*then) >= SPEED_WINDOW) {
        path.pop_front();
    }
    let Some((then, before)) = path.front().filter(|(then, _)| at.seconds_since(*then) >= SPEED_WINDOW) else {
        return Ok(());
    };
    let speed = (moved - before).abs() / at.seconds_since(*then);
    if speed > MAX_SPEED_RATIO * ordered { Err((speed, speed / ordered)) } else { Ok(()) }
}

impl FirstMotion<'_> {
    pub(super) fn move_out_and_back(&mut self, joint: usize, mode: ControlMode) -> Result<(), FirstMotionEnd> {
        let began = MonotonicClock.now();
        let up = self.move_joint(joint, mode, 0.0, REACH)?;
        let middle = self.move_joint(joint, mode, REACH, 0.0)?;
        let down = self.move_joint(joint, mode, 0.0, -REACH)?;
        let back = self.move_joint(joint, mode, -REACH, 0.0)?;
        let velocity = up.integral.map(|integral| integral / up.moved);
        if let Some(wrong) = velocity.filter(|part| !VELOCITY_INTEGRAL_RATIO.contains(part)) {
            let what = format!("joint {}: the integral of its velocity is {wrong:.2} of its travel", joint + 1);
            return Err(FirstMotionEnd::Unexpected(format!("{what}: are they in rad/s, and of this joint?")));
        }
        let others = [up, middle, down, back].iter().map(|seen| seen.others).fold(0.0, f64::max);
        self.motion.ways.push(JointMotion {
            joint: joint + 1,
            mode,
            sent: REACH,
            up: up.moved,
            down: down.moved,
            back: back.moved,
            others,
            velocity,
            seconds: MonotonicClock.now().seconds_since(began),
        });
        Ok(())
    }

    /// Moves a joint from one offset to another [rad], by one command or by a stream of setpoints.
    pub(super) fn move_joint(
        &mut self,
        joint: usize,
        mode: ControlMode,
        from: f64,
        to: f64,
    ) -> Result<Observed, FirstMotionEnd> {
        let limits = self.adapter.get_limits()?;
        let top = limits.velocity_max.get(joint).copied().unwrap_or(1.0);
        // The peak velocity of the half cosine wave is SPEED.
        let shortest = if self.trace.is_some() { MIN_WAVE_TIME.1 } else { MIN_WAVE_TIME.0 };
        let time = (std::f64::consts::FRAC_PI_2 * (to - from).abs() / (SPEED * top)).max(shortest);
        let stream = mode == ControlMode::ServoPosition;
        if !stream {
            self.adapter.write_joint_positions(&self.target(joint, to), SPEED)?;
        }
        let began = MonotonicClock.now();
        let (mut seen, mut last) = (Observed::default(), None);
        let (mut streamed, mut before_this) = (0.0, began);
        let mut path = VecDeque::new();
        let (mut still, mut point) = (0, if stream { from } else { to });
        self.trace.iter_mut().for_each(Trace::begin_wave);
        for sample in 0_u32.. {
            let now = MonotonicClock.now();
            let past = now.seconds_since(began);
            // A stall of this program must not become a jump of the setpoints.
            streamed += now.seconds_since(before_this).min(MAX_TIME_STEP);
            before_this = now;
            let part = (streamed / time).min(1.0);
            let due = stream && sample % SAMPLES == 0;
            // Setpoints are written alternately before and after a reading. If they were always written before it, the
            // first reading after each would see the same early part of the step, and the measured lag would be too
            // short by half a reading period.
            let afterwards = self.trace.is_some() && sample / SAMPLES % 2 == 1;
            if due {
                point = from + (to - from) * (0.5 - 0.5 * (part * std::f64::consts::PI).cos());
            }
            if due && !afterwards {
                self.stream(joint, point)?;
            }
            let (positions, reading, at) = self.read()?;
            if due && afterwards {
                self.stream(joint, point)?;
            }
            let before = seen.moved;
            seen = self.check_motion(joint, from, to, &positions, seen)?;
            if let Some(trace) = &mut self.trace {
                trace.saw(now, at, seen.moved);
            }
            if !stream {
                check_speed(&mut path, at, seen.moved, SPEED * top).map_err(|(speed, ratio)| {
                    let what =
                        format!("joint {} moves at {speed:.2} rad/s, {ratio:.1} times as fast as ordered", joint + 1);
                    FirstMotionEnd::Unexpected(what)
                })?;
            }
            if stream && (seen.moved - point).abs() > MAX_TRACKING_ERROR {
                let behind = (seen.moved - point).abs().to_degrees();
                return Err(FirstMotionEnd::Unexpected(format!(
                    "joint {} is {behind:.2}° from its setpoint",
                    joint + 1
                )));
            }
            if let Some(velocity) = reading.velocity.and_then(|v| v.get(joint).copied()) {
                let dt = last.map_or(0.0, |then| at.seconds_since(then));
                seen.integral = Some(seen.integral.unwrap_or(0.0) + velocity * dt);
            }
            last = Some(at);
            still = if (seen.moved - before).abs() < 0.01 * DEGREE { still + 1 } else { 0 };
            if (seen.moved - to).abs() < GOAL_TOLERANCE && still >= 20 && (!stream || part >= 1.0) {
                return Ok(seen);
            }
            if past > MOVE_TIMEOUT.as_secs_f64() {
                let (sent, moved) = ((to - from).to_degrees(), (seen.moved - from).to_degrees());
                return Err(FirstMotionEnd::Unexpected(format!(
                    "joint {} was sent by {sent:+.2}° and moved by {moved:+.2}°",
                    joint + 1
                )));
            }
            self.pause()?;
        }
        Ok(seen)
    }

    /// Writes a setpoint of one joint, as an offset from the start [rad].
    pub(super) fn stream(&mut self, joint: usize, point: f64) -> Result<(), FirstMotionEnd> {
        let target = self.target(joint, point);
        let mut at = Mono::ZERO;
        when_there_is_room(|| {
            at = MonotonicClock.now();
            self.adapter.write_joint_positions(&target, 1.0)
        })?;
        if let Some(trace) = &mut self.trace {
            trace.wrote(at, point);
        }
        Ok(())
    }

    /// Compares the joint positions with the command.
    pub(super) fn check_motion(
        &self,
        joint: usize,
        from: f64,
        to: f64,
        positions: &[f64],
        mut seen: Observed,
    ) -> Result<Observed, FirstMotionEnd> {
        for (other, (now, start)) in positions.iter().zip(&self.start).enumerate() {
            let moved = now - start;
            if other == joint {
                seen.moved = moved;
            } else if moved.abs() > MAX_STRAY {
                let (other, joint, moved) = (other + 1, joint + 1, moved.to_degrees());
                return Err(FirstMotionEnd::Unexpected(format!(
                    "joint {other} moved by {moved:+.2}° while joint {joint} was sent"
                )));
            } else {
                seen.others = seen.others.max(moved.abs());
            }
        }
        let (way, past) = (to - from, seen.moved - from);
        let sent = way.to_degrees();
        if past * way.signum() < -MAX_STRAY {
            return Err(FirstMotionEnd::Unexpected(format!(
                "joint {} was sent by {sent:+.2}° and moves the other way",
                joint + 1
            )));
        }
        if past * way.signum() > way.abs() + MAX_OVERSHOOT {
            let past = past.to_degrees();
            return Err(FirstMotionEnd::Unexpected(format!(
                "joint {} was sent by {sent:+.2}° and moved by {past:+.2}°",
                joint + 1
            )));
        }
        Ok(seen)
    }

    /// Stops joint 1 in motion, after a quarter of its travel.
    pub(super) fn stop_in_motion(&mut self) -> Result<(), FirstMotionEnd> {
        self.set_mode(ControlMode::Position)?;
        self.adapter.write_joint_positions(&self.target(0, REACH), STOPPED_SPEED)?;
        self.until(MOVE_TIMEOUT, "joint 1 does not start to move", |it| {
            let positions = it.read()?.0;
            Ok(it.check_motion(0, 0.0, REACH, &positions, Observed::default())?.moved > REACH / 4.0)
        })?;
        let rest = rest_point(self.adapter);
        self.adapter.write_stop(&rest)?;
        let at = self.read()?.0;
        let rest = self.wait_for_standstill()?;
        self.motion.stopped = Some(farthest(&rest, &at));
        if farthest(&rest, &self.target(0, REACH)) < GOAL_TOLERANCE {
            return Err(FirstMotionEnd::Unexpected("joint 1 moved to its target in spite of a stop".to_owned()));
        }
        self.adapter.activate()?;
        self.set_mode(ControlMode::Position)?;
        let here = rest.first().zip(self.start.first()).map_or(0.0, |(now, start)| now - start);
        self.move_joint(0, ControlMode::Position, here, 0.0).map(drop)
    }

    pub(super) fn target(&self, joint: usize, offset: f64) -> Vec<f64> {
        let add = |(i, start): (usize, &f64)| if i == joint { start + offset } else { *start };
        self.start.iter().enumerate().map(add).collect()
    }
}

//! How hard the arm brakes and accelerates.

use std::time::Duration;

use super::drive::RAMP;
use super::{End, Tour, skipped, ways};
use crate::conformance::context::{rest_point, when_there_is_room};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::ControlMode;

/// Parts of the top speed from which the arm is stopped.
const SPEEDS: [f64; 3] = [0.1, 0.25, 0.5];
/// How long the joint moves evenly before a stop [s].
const EVEN: f64 = 0.15;
/// Deceleration that a way is planned with until one was measured: a part of the acceleration limit.
const CAREFUL: f64 = 0.25;
/// Attempts to move evenly, and how far the average speed may be off, as a part.
const ATTEMPTS: u32 = 3;
const UNEVEN: f64 = 0.015;
/// How long a velocity is commanded [s].
const STEP: f64 = 0.35;

impl Tour<'_> {
    /// Stops from several speeds: the way of a stop is `v·t + v²/2a`.
    pub(super) fn stops(&mut self) -> Result<String, End> {
        self.prepare()?;
        self.go(0.0)?;
        let (mut found, mut left_out) = (Vec::new(), Vec::new());
        for part in SPEEDS {
            let speed = part * self.top();
            let brakes = ways(&found).map_or(CAREFUL / RAMP * self.ramp(), |(_, slope)| 0.5 / slope.max(1e-4));
            let needed = 0.5 * speed * speed / self.ramp() + speed * (EVEN + 0.1) + 0.6 * speed * speed / brakes;
            if needed > self.room {
                left_out.push(format!("{:.0} % (needs {:.0}°)", 100.0 * part, needed.to_degrees()));
                continue;
            }
            self.person.tell(&format!("a stop from {:.0} % of the top speed", 100.0 * part));
            let (speed, way, past) = self.stop_from(speed)?;
            self.figure(format!("way of a stop from {speed:.2} rad/s"), way.to_degrees(), "°", None);
            if let Some(past) = past {
                self.figure(format!("past the ordered rest, from {speed:.2} rad/s"), past.to_degrees(), "°", None);
            }
            found.push((speed, way));
        }
        let Some((reaction, slope)) = ways(&found) else {
            return skipped(format!("no room for stops from two speeds: {}", left_out.join(", ")));
        };
        if slope <= 1e-4 {
            return Err(End::Failed("the way of a stop does not grow with the speed".to_owned()));
        }
        let deceleration = 0.5 / slope;
        let now = self.ramp() / RAMP;
        let key = format!("hardware.arm.limits.acceleration: {:.2} (now {now:.2})", deceleration.min(now));
        self.figure("deceleration of a stop", deceleration, "rad/s²", Some(key));
        self.figure("reaction to a stop", 1e3 * reaction, "ms", None);
        let without = if left_out.is_empty() { String::new() } else { format!("; not from {}", left_out.join(", ")) };
        Ok(format!("joint {} stops at {deceleration:.2} rad/s²{without}", self.joint + 1))
    }

    /// Stops the joint from a speed [rad/s]. Returns the speed, the way, and how far the joint went past the point of
    /// rest that was given with the stop [rad].
    fn stop_from(&mut self, speed: f64) -> Result<(f64, f64, Option<f64>), End> {
        let mut pace = self.cruise(speed, EVEN)?.pace(0.6 * EVEN).abs();
        for _ in 1..ATTEMPTS {
            if (pace - speed).abs() < UNEVEN * speed {
                break;
            }
            // Other programs took the processor: the setpoints were not even.
            self.stop()?;
            self.recover()?;
            pace = self.cruise(speed, EVEN)?.pace(0.6 * EVEN).abs();
        }
        let rest = rest_point(self.adapter);
        let (seen, stamp) = self.at()?;
        let sent = MonotonicClock.now();
        self.ready = false;
        self.adapter.write_stop(&rest)?;
        let begin = seen * self.direction + pace * sent.seconds_since(stamp);
        let mut farthest = begin;
        let mut quiet = MonotonicClock.now();
        while MonotonicClock.now().since(quiet) < Duration::from_millis(120) {
            let now = self.at()?.0 * self.direction;
            if now > farthest + 2e-4 {
                quiet = MonotonicClock.now();
            }
            farthest = farthest.max(now);
            self.wait(Duration::from_millis(3))?;
            if MonotonicClock.now().since(sent) > Duration::from_secs(10) {
                return Err(End::Failed("the arm does not stop within 10 s".to_owned()));
            }
        }
        self.recover()?;
        let of = |values: &[f64]| values.get(self.joint).copied().unwrap_or_default();
        let ordered = rest.position.map(|position| (of(&position) - of(&self.start)) * self.direction);
        Ok((pace, farthest - begin, ordered.map(|ordered| farthest - ordered)))
    }

    /// Commands a velocity at once.
    pub(super) fn velocity_step(&mut self) -> Result<String, End> {
        if !self.has(ControlMode::Velocity) {
            return skipped("the arm has no velocity mode");
        }
        self.prepare()?;
        self.go(0.0)?;
        self.set_mode(ControlMode::Velocity)?;
        self.ready = false;
        let speed = 0.1 * self.top();
        let (joint, mut velocities) = (self.joint, vec![0.0; self.info.dof]);
        velocities.iter_mut().skip(joint).take(1).for_each(|v| *v = speed * self.direction);
        let (began, mut seen) = (MonotonicClock.now(), Vec::new());
        while MonotonicClock.now().seconds_since(began) < STEP {
            let adapter = &mut *self.adapter;
            when_there_is_room(|| adapter.write_joint_velocities(&velocities))?;
            let (offset, stamp) = self.at()?;
            if seen.last().is_none_or(|(before, _)| *before < stamp) {
                seen.push((stamp, offset * self.direction));
            }
            self.wait(Duration::from_millis(2))?;
        }
        let zero = vec![0.0; self.info.dof];
        let adapter = &mut *self.adapter;
        when_there_is_room(|| adapter.write_joint_velocities(&zero))?;
        self.still()?;
        self.stop()?;
        self.recover()?;
        // Velocities between readings about 8 ms apart.
        let mut rises = Vec::new();
        for (i, (at, value)) in seen.iter().enumerate() {
            if let Some((then, was)) = seen.iter().take(i).rev().find(|(then, _)| at.seconds_since(*then) >= 0.008) {
                let middle = 0.5 * (at.seconds_since(began) + then.seconds_since(began));
                rises.push((middle, (value - was) / at.seconds_since(*then)));
            }
        }
        let reaches = |part: f64| rises.iter().find(|(_, v)| *v >= part * speed).map(|(at, _)| *at);
        let (Some(begins), Some(tenth), Some(most)) = (reaches(0.03), reaches(0.1), reaches(0.9)) else {
            return Err(End::Failed(format!("the joint did not reach {speed:.2} rad/s within {STEP} s")));
        };
        let acceleration = 0.8 * speed / (most - tenth).max(1e-3);
        self.figure("acceleration at a velocity step", acceleration, "rad/s²", None);
        self.figure("reaction to a velocity", 1e3 * begins, "ms", None);
        self.figure("jerk at a velocity step, at least", acceleration / (most - begins).max(1e-3), "rad/s³", None);
        Ok(format!("a velocity of {speed:.2} rad/s is reached at {acceleration:.1} rad/s²"))
    }
}

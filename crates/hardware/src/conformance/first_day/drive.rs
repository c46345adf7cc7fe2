//! Motions of one joint by streamed setpoints, and what is seen of them.

use std::time::Duration;

use super::{End, Tour, skipped};
use crate::adapter::{AdapterError, JointReading};
use crate::conformance::context::{CLOCKED, farthest, pause, rest_point, when_there_is_room};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::joint::ControlMode;

/// Most that a joint moves from the start [rad].
const MAX_ROOM: f64 = 1.05;
/// Room that is left to a joint's limit [rad].
const MARGIN: f64 = 0.06;
/// Shortest time between two setpoints.
const PERIOD: Duration = Duration::from_millis(4);
/// Longest time by which a path advances at once [s]: a stall of this program must not become a jump.
const MAX_ADVANCE: f64 = 0.012;
/// Ramps use this part of the acceleration limit.
pub(super) const RAMP: f64 = 0.2;
/// Acceleration of an arm that states none [rad/s²].
const ACCELERATION: f64 = 2.0;
/// Part of the top speed at which a joint returns.
const RETURN: f64 = 0.1;
/// How long the last setpoint of a motion is repeated, at least [s].
const HOLD: f64 = 0.25;
/// How long a change of mode, the motors and a motion may take.
pub(super) const MODE: Duration = Duration::from_secs(3);
pub(super) const MOTORS: Duration = Duration::from_secs(10);
const MOTION: Duration = Duration::from_secs(20);
/// A joint that moves by less than this within a tenth of a second is at rest [rad].
const STILL: f64 = 0.0006;
/// Errors of the state that are borne in a row.
const MAX_LATE: u32 = 3;

/// What was written and seen.
#[derive(Debug, Default)]
pub(super) struct Log {
    /// Setpoints and their times.
    pub written: Vec<(Mono, f64)>,
    /// Measured offsets and their times.
    pub seen: Vec<(Mono, f64)>,
}

impl Log {
    /// Returns the average velocity of the setpoints of the last `time` [s] [rad/s].
    pub fn pace(&self, time: f64) -> f64 {
        slope(&self.written, time)
    }
}

/// Returns the slope of the points of the last `time` [s].
fn slope(points: &[(Mono, f64)], time: f64) -> f64 {
    let Some((end, value)) = points.last() else { return 0.0 };
    let first = points.iter().rev().take_while(|(at, _)| end.seconds_since(*at) <= time).last();
    first.map_or(0.0, |(at, from)| (value - from) / end.seconds_since(*at).max(1e-6))
}

impl Tour<'_> {
    pub(super) fn top(&self) -> f64 {
        self.limits.velocity_max.get(self.joint).copied().filter(|v| *v > 0.0).unwrap_or(1.0)
    }

    pub(super) fn ramp(&self) -> f64 {
        let limit = self.limits.acceleration_max.get(self.joint).copied().filter(|a| *a > 0.0);
        RAMP * limit.unwrap_or(ACCELERATION)
    }

    pub(super) fn clocked(&self) -> bool {
        self.info.native_rate >= CLOCKED
    }

    /// Returns the time between two setpoints.
    pub(super) fn period(&self) -> Duration {
        self.adapter.set_point_period().unwrap_or(PERIOD).clamp(PERIOD, Duration::from_millis(50))
    }

    pub(super) fn check_interrupted(&self) -> Result<(), End> {
        if (self.interrupted)() { Err(End::Interrupted) } else { Ok(()) }
    }

    pub(super) fn wait(&mut self, time: Duration) -> Result<(), End> {
        pause(self.adapter, time);
        self.check_interrupted()
    }

    /// Reads the arm: joint positions [rad] and the time of their measurement.
    pub(super) fn read(&mut self) -> Result<(JointReading, Mono), End> {
        let mut reading = JointReading::default();
        for _ in 0..MAX_LATE {
            match self.adapter.read_joints(&mut reading) {
                Ok(()) => {
                    let at = reading.stamp.unwrap_or_else(|| MonotonicClock.now());
                    let dof = self.info.dof;
                    if reading.position.iter().take(dof).all(|value| value.is_finite()) {
                        return Ok((reading, at));
                    }
                }
                Err(AdapterError::Timeout(_)) => {}
                Err(error) => return Err(error.into()),
            }
            pause(self.adapter, Duration::from_millis(2));
        }
        Err(End::Failed("no usable state of the joints".to_owned()))
    }

    pub(super) fn positions(&mut self) -> Result<Vec<f64>, End> {
        let dof = self.info.dof;
        Ok(self.read()?.0.position.iter().take(dof).copied().collect())
    }

    /// Returns the measured offset of the joint from the start [rad], and its time.
    pub(super) fn at(&mut self) -> Result<(f64, Mono), End> {
        let (reading, at) = self.read()?;
        let of = |values: &[f64]| values.get(self.joint).copied().unwrap_or_default();
        Ok((of(&reading.position) - of(&self.start), at))
    }

    /// Fails if the arm is in error, or its motors are off.
    pub(super) fn healthy(&mut self) -> Result<(), End> {
        match self.adapter.read_error()? {
            (0, _) if self.adapter.read_enabled()? => Ok(()),
            (0, _) => Err(End::Failed("the motors went off".to_owned())),
            (code, text) => Err(End::Failed(format!("error {code}: {text}"))),
        }
    }

    /// Prepares for streams: motors on, servo mode, the joint chosen. The first time it keeps the pose as the start.
    pub(super) fn prepare(&mut self) -> Result<(), End> {
        if self.ready {
            return self.healthy();
        }
        if !self.has(ControlMode::ServoPosition) {
            return skipped("the arm has no servo_position mode");
        }
        self.motors_on()?;
        self.set_mode(ControlMode::ServoPosition)?;
        let now = self.still()?;
        if self.start.is_empty() {
            self.start = now;
            self.choose()?;
            self.offset = 0.0;
        } else {
            self.offset = self.at()?.0;
        }
        self.ready = true;
        Ok(())
    }

    pub(super) fn motors_on(&mut self) -> Result<(), End> {
        self.adapter.activate()?;
        self.until(MOTORS, "the motors did not come on", |it| Ok(it.adapter.read_enabled()?))
    }

    /// Changes the mode; an arm may count as moving slightly longer than it does here.
    pub(super) fn set_mode(&mut self, mode: ControlMode) -> Result<(), End> {
        let end = MonotonicClock.now().after(MODE);
        loop {
            match self.adapter.set_control_mode(mode) {
                Err(AdapterError::Rejected(_) | AdapterError::Busy) if MonotonicClock.now() < end => {
                    self.wait(Duration::from_millis(10))?;
                }
                result => return Ok(result?),
            }
        }
    }

    /// Chooses the joint with the most room: the first one if it has enough, as it carries no weight.
    fn choose(&mut self) -> Result<(), End> {
        let room = |i: usize| {
            let of = |values: &[f64]| values.get(i).copied().unwrap_or_default();
            let (up, down) =
                (of(&self.limits.position_upper) - of(&self.start), of(&self.start) - of(&self.limits.position_lower));
            let room = up.max(down) - MARGIN;
            (room.min(MAX_ROOM), if up >= down { 1.0 } else { -1.0 })
        };
        let joints: Vec<(f64, f64)> = (0..self.start.len()).map(room).collect();
        let most = joints.iter().enumerate().max_by(|a, b| a.1.0.total_cmp(&b.1.0)).map(|(i, _)| i);
        let first = joints.first().is_some_and(|(room, ..)| *room >= 0.8 * MAX_ROOM);
        let joint = if first { Some(0) } else { most };
        match joint.and_then(|joint| Some((joint, joints.get(joint)?))) {
            Some((joint, (room, direction))) if *room > 0.15 => {
                (self.joint, self.direction, self.room) = (joint, *direction, *room);
                Ok(())
            }
            _ => skipped("no joint has room for a motion: move the arm to the middle of its range"),
        }
    }

    /// Writes a setpoint of the joint, as an offset from the start [rad].
    pub(super) fn write(&mut self, offset: f64) -> Result<Mono, End> {
        let (joint, mut target) = (self.joint, self.start.clone());
        if let Some(value) = target.get_mut(joint) {
            *value += offset;
        }
        let mut at = Mono::ZERO;
        when_there_is_room(|| {
            at = MonotonicClock.now();
            self.adapter.write_joint_positions(&target, 1.0)
        })?;
        self.offset = offset;
        Ok(at)
    }

    /// Streams `path`, a function of the time since the begin [s], until it is `None`. Adds to `log`.
    pub(super) fn stream(&mut self, log: &mut Log, mut path: impl FnMut(f64) -> Option<f64>) -> Result<(), End> {
        let period = self.period();
        let (mut passed, mut last) = (0.0, MonotonicClock.now());
        loop {
            let now = MonotonicClock.now();
            passed += now.seconds_since(last).min(MAX_ADVANCE.max(1.5 * period.as_secs_f64()));
            last = now;
            let Some(offset) = path(passed) else { return Ok(()) };
            let at = self.write(offset)?;
            log.written.push((at, offset));
            let (seen, stamp) = self.at()?;
            if log.seen.last().is_none_or(|(before, _)| *before < stamp) {
                log.seen.push((stamp, seen));
            }
            if (seen - offset).abs() > 0.35 {
                let apart = (seen - offset).abs().to_degrees();
                return Err(End::Failed(format!("joint {} is {apart:.1}° from its setpoint", self.joint + 1)));
            }
            self.wait(period.saturating_sub(MonotonicClock.now().since(now)))?;
        }
    }

    /// Accelerates the joint to `velocity` [rad/s] and keeps it for `time` [s].
    pub(super) fn cruise(&mut self, velocity: f64, time: f64) -> Result<Log, End> {
        let (from, ramp, direction) = (self.offset, self.ramp(), self.direction);
        let rise = velocity / ramp;
        let mut log = Log::default();
        self.stream(&mut log, |t| {
            let way = if t < rise { 0.5 * ramp * t * t } else { velocity * (t - 0.5 * rise) };
            (t <= rise + time).then_some(from + direction * way)
        })?;
        Ok(log)
    }

    /// Decelerates the joint from `velocity` [rad/s] to rest.
    pub(super) fn brake(&mut self, velocity: f64) -> Result<(), End> {
        let (from, ramp, direction) = (self.offset, self.ramp(), self.direction);
        let end = velocity / ramp;
        self.stream(&mut Log::default(), |t| {
            (t <= end + 0.05).then(|| {
                let t = t.min(end);
                from + direction * (velocity * t - 0.5 * ramp * t * t)
            })
        })
    }

    /// Brings the joint to an offset [rad], slowly, and waits until it is at rest.
    pub(super) fn go(&mut self, to: f64) -> Result<(), End> {
        let (from, speed) = (self.offset, RETURN * self.top());
        // Gentle at both ends: the peak of a half cosine wave.
        let time = (std::f64::consts::FRAC_PI_2 * (to - from).abs() / speed).max(0.2);
        // An arm that continues without setpoints must have seen that this motion ended.
        let hold = HOLD.max(25.0 * self.period().as_secs_f64());
        self.stream(&mut Log::default(), |t| {
            let part = (t / time).min(1.0);
            (t <= time + hold).then(|| from + (to - from) * (0.5 - 0.5 * (part * std::f64::consts::PI).cos()))
        })?;
        self.droop = self.at()?.0 - self.offset;
        self.still().map(drop)
    }

    /// Waits until no joint moves for a tenth of a second.
    pub(super) fn still(&mut self) -> Result<Vec<f64>, End> {
        let mut last = self.positions()?;
        self.until(MOTION, "the arm does not stop within 20 s", |it| {
            it.wait(Duration::from_millis(100))?;
            let now = it.positions()?;
            let still = farthest(&now, &last) < STILL;
            last = now;
            Ok(still)
        })?;
        Ok(last)
    }

    pub(super) fn until(
        &mut self,
        limit: Duration,
        what: &str,
        mut done: impl FnMut(&mut Self) -> Result<bool, End>,
    ) -> Result<(), End> {
        let end = MonotonicClock.now().after(limit);
        while !done(self)? {
            if MonotonicClock.now() > end {
                return Err(End::Failed(what.to_owned()));
            }
            self.read()?;
            self.wait(Duration::from_millis(3))?;
        }
        Ok(())
    }

    /// Sends the arm's own stop.
    pub(super) fn stop(&mut self) -> Result<(), End> {
        let rest = rest_point(self.adapter);
        self.ready = false;
        Ok(self.adapter.write_stop(&rest).map(drop)?)
    }

    /// After a stop or an error: clears it, enables the arm and returns to the start.
    pub(super) fn recover(&mut self) -> Result<(), End> {
        if self.start.is_empty() {
            return Ok(());
        }
        self.ready = false;
        self.clear()?;
        self.still()?;
        self.prepare()?;
        self.go(0.0)
    }

    /// Connects again if needed, and clears an error.
    pub(super) fn clear(&mut self) -> Result<(), End> {
        let end = MonotonicClock.now().after(MOTORS);
        loop {
            let result = match self.adapter.is_connected() {
                true => Ok(()),
                false => self.adapter.connect(),
            };
            let result = result.and_then(|()| match self.adapter.read_joints(&mut JointReading::default()) {
                Err(AdapterError::Timeout(_)) | Ok(()) => self.adapter.read_error(),
                Err(error) => Err(error),
            });
            let result =
                result.and_then(|(code, _)| if code == 0 { Ok(()) } else { self.adapter.write_clear_errors() });
            match result {
                Ok(()) if self.adapter.read_error().is_ok_and(|(code, _)| code == 0) => return Ok(()),
                Err(error) if MonotonicClock.now() > end => return Err(error.into()),
                Ok(()) if MonotonicClock.now() > end => {
                    return Err(End::Failed("the error cannot be cleared".to_owned()));
                }
                _ => self.wait(Duration::from_millis(50))?,
            }
        }
    }
}

//! The first motion of a real arm: each joint in turn moves slowly by 2° to both sides and back, monitored all the
//! time.
//!
//! It shows that the joints are in order, that signs and units are right, that the mode works, and that a stop stops.
//! Anything unexpected ends it with `write_stop`; nothing is commanded after that.

mod excursion;
mod monitor;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

use serde::Serialize;

use super::context::{CLOCKED, farthest, pause, rest_point};
use super::lag::{Lag, Trace};
use crate::adapter::{AdapterError, JointReading, ManipulatorAdapter};
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::ControlMode;
use dimos_rt::host;

/// How far each joint moves to either side [rad]: 2°.
pub const REACH: f64 = 2.0 * DEGREE;
/// Speed, as a fraction of the top speed.
pub const SPEED: f64 = 0.05;
/// Distance that every joint must have to its limits [rad]: 3°.
pub const ROOM: f64 = 3.0 * DEGREE;

const DEGREE: f64 = std::f64::consts::PI / 180.0;
/// Motion of any joint but the commanded one, or in the wrong direction, that counts as unexpected [rad].
const MAX_STRAY: f64 = 0.5 * DEGREE;
/// How long the motors may take to come on.
const MOTORS_TIMEOUT: Duration = Duration::from_secs(5);
/// How long the arm may refuse a change of mode after a motion.
const MODE_TIMEOUT: Duration = Duration::from_secs(2);
/// How long the arm is monitored after the motors came on.
pub(super) const HOLD_TIME: Duration = Duration::from_millis(500);
/// Attempts to measure the lag of a joint while this program runs unevenly.
const LAG_ATTEMPTS: u32 = 3;

/// One joint's motion to both sides and back in one mode. Positions in rad.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct JointMotion {
    /// Index of the joint, from 1.
    pub joint: usize,
    /// The mode.
    #[serde(serialize_with = "name_of")]
    pub mode: ControlMode,
    /// Commanded distance to either side.
    pub sent: f64,
    /// Distance in positive direction.
    pub up: f64,
    /// Distance in negative direction.
    pub down: f64,
    /// Distance from the start at the end.
    pub back: f64,
    /// Largest motion of any other joint meanwhile.
    pub others: f64,
    /// Integral of its measured velocity, as a fraction of `up`; `None` without measured velocities.
    pub velocity: Option<f64>,
    /// Duration [s].
    pub seconds: f64,
}

fn name_of<S: serde::Serializer>(mode: &ControlMode, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(mode.name())
}

/// Result of the first motion.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Motion {
    /// How far the arm moved when its motors came on [rad].
    pub held: Option<f64>,
    /// The joints' motions.
    pub ways: Vec<JointMotion>,
    /// How far the arm still moved after a stop in motion [rad].
    pub stopped: Option<f64>,
    /// What was unexpected and ended the motion.
    pub odd: Option<String>,
    /// Whether it was interrupted.
    pub interrupted: bool,
    /// State of the motors afterwards.
    pub left: String,
}

/// Why the motion ended early.
enum FirstMotionEnd {
    Unexpected(String),
    Interrupted,
}

impl From<AdapterError> for FirstMotionEnd {
    fn from(error: AdapterError) -> Self {
        Self::Unexpected(error.to_string())
    }
}

/// Checks that the arm may be moved from its current position; the error says why not.
pub fn refusal(adapter: &mut dyn ManipulatorAdapter) -> Result<(), String> {
    let said = |e: AdapterError| e.to_string();
    let mut reading = JointReading::default();
    adapter.read_joints(&mut reading).map_err(said)?;
    let (code, text) = adapter.read_error().map_err(said)?;
    if code != 0 {
        return Err(format!("it is in error {code}: {text}\nhint: clear it first with the vendor's own tools"));
    }
    let modes = adapter.get_info().modes;
    if !modes.iter().any(|mode| mode.is_position()) {
        return Err("it has neither a position mode nor a servo mode".to_owned());
    }
    let limits = adapter.get_limits().map_err(said)?;
    let range = limits.position_lower.iter().zip(&limits.position_upper);
    for (i, (at, (lower, upper))) in reading.position.iter().zip(range).enumerate() {
        let (room, which) = if at - lower < upper - at { (at - lower, "lower") } else { (upper - at, "upper") };
        if room < ROOM || !room.is_finite() {
            return Err(format!(
                "joint {} at {:.2}° has {:.2}° to its {which} limit, {:.0}° are needed\nhint: move the arm to the \
                 middle of its range with the vendor's own tools",
                i + 1,
                at.to_degrees(),
                room.to_degrees(),
                ROOM.to_degrees()
            ));
        }
    }
    Ok(())
}

/// Moves each joint of a connected arm slightly. Ends with a stop when something unexpected happens or `interrupted`
/// returns true. `progress` receives a line of text before each step.
pub fn run_first_motion(
    adapter: &mut dyn ManipulatorAdapter,
    interrupted: &dyn Fn() -> bool,
    progress: &mut dyn FnMut(&str),
) -> Motion {
    FirstMotion { adapter, interrupted, progress, start: Vec::new(), motion: Motion::default(), trace: None }
        .run(FirstMotion::move_joints)
}

/// Moves each joint of a connected arm slightly by streamed setpoints, slower than [`run_first_motion`], and measures
/// its lag. `row` is the lag that the adapter's row states [s].
pub fn measure_lag(
    adapter: &mut dyn ManipulatorAdapter,
    row: f64,
    interrupted: &dyn Fn() -> bool,
    progress: &mut dyn FnMut(&str),
) -> (Motion, Lag) {
    let mut joints = Vec::new();
    let trace = Some(Trace::default());
    let first_motion =
        FirstMotion { adapter, interrupted, progress, start: Vec::new(), motion: Motion::default(), trace };
    let motion = first_motion.run(|it| it.measure_lags(&mut joints));
    (motion, Lag::of(joints, row))
}

struct FirstMotion<'a> {
    adapter: &'a mut dyn ManipulatorAdapter,
    interrupted: &'a dyn Fn() -> bool,
    progress: &'a mut dyn FnMut(&str),
    /// Joint positions at the start [rad].
    start: Vec<f64>,
    motion: Motion,
    /// Setpoints and positions of a joint whose lag is measured.
    trace: Option<Trace>,
}

impl FirstMotion<'_> {
    /// Runs `motions` and restores the state of the motors.
    fn run(mut self, motions: impl FnOnce(&mut Self) -> Result<(), FirstMotionEnd>) -> Motion {
        if self.adapter.get_info().native_rate >= CLOCKED {
            // It wants an answer every millisecond: as in a device thread.
            host::enter_realtime(host::DEVICE_PRIORITY);
        }
        let was_on = self.adapter.read_enabled().unwrap_or(true);
        match catch_unwind(AssertUnwindSafe(|| motions(&mut self))) {
            Ok(Ok(())) => {}
            Ok(Err(FirstMotionEnd::Unexpected(what))) => self.motion.odd = Some(what),
            Ok(Err(FirstMotionEnd::Interrupted)) => self.motion.interrupted = true,
            Err(_) => self.motion.odd = Some("the adapter panicked".to_owned()),
        }
        self.leave_arm(was_on);
        self.motion
    }

    /// Returns the lag of the last motion. Its computation may take longer than an arm waits for an answer.
    fn lag(&mut self) -> Option<f64> {
        let (trace, adapter) = (self.trace.as_ref()?, &mut *self.adapter);
        std::thread::scope(|scope| {
            let computed = scope.spawn(|| trace.lag());
            while !computed.is_finished() {
                pause(adapter, Duration::from_millis(2));
            }
            computed.join().ok().flatten()
        })
    }

    /// Measures the lag of each joint [s].
    fn measure_lags(&mut self, joints: &mut Vec<Option<f64>>) -> Result<(), FirstMotionEnd> {
        self.motors_on()?;
        let mode = ControlMode::ServoPosition;
        self.set_mode(mode)?;
        for joint in 0..self.start.len() {
            (self.progress)(&format!("lag of joint {}: first +, then −", joint + 1));
            let mut lag = None;
            for attempt in 0..LAG_ATTEMPTS {
                if attempt > 0 {
                    self.motion.ways.pop();
                }
                self.trace = Some(Trace::default());
                self.move_out_and_back(joint, mode)?;
                lag = self.lag();
                if lag.is_some() {
                    break;
                }
            }
            joints.push(lag);
        }
        Ok(())
    }

    /// Enables the motors and checks that the arm holds its pose.
    fn motors_on(&mut self) -> Result<(), FirstMotionEnd> {
        self.start = self.read()?.0;
        (self.progress)("the motors come on");
        self.adapter.activate()?;
        self.until(MOTORS_TIMEOUT, "the motors did not come on within 5 s", |it| Ok(it.adapter.read_enabled()?))?;
        let (began, before) = (MonotonicClock.now(), self.start.clone());
        let mut held: f64 = 0.0;
        while MonotonicClock.now().since(began) < HOLD_TIME {
            held = held.max(farthest(&self.read()?.0, &before));
            self.motion.held = Some(held);
            if held > MAX_STRAY {
                return Err(FirstMotionEnd::Unexpected(format!(
                    "the arm moved by {:.2}° when its motors came on",
                    held.to_degrees()
                )));
            }
            self.pause()?;
        }
        self.start = self.read()?.0;
        Ok(())
    }

    fn move_joints(&mut self) -> Result<(), FirstMotionEnd> {
        self.motors_on()?;
        let modes = self.adapter.get_info().modes;
        for mode in [ControlMode::Position, ControlMode::ServoPosition] {
            if modes.contains(&mode) {
                self.set_mode(mode)?;
                for joint in 0..self.start.len() {
                    (self.progress)(&format!("joint {} in {} mode: first +, then −", joint + 1, mode.name()));
                    self.move_out_and_back(joint, mode)?;
                }
            }
        }
        if modes.contains(&ControlMode::Position) {
            (self.progress)("a stop in motion");
            self.stop_in_motion()?;
        }
        Ok(())
    }

    /// Changes the mode. Retries for [`MODE_TIMEOUT`]: an arm may count as moving slightly longer than it does here.
    fn set_mode(&mut self, mode: ControlMode) -> Result<(), FirstMotionEnd> {
        let end = MonotonicClock.now().after(MODE_TIMEOUT);
        loop {
            match self.adapter.set_control_mode(mode) {
                Err(AdapterError::Rejected(_)) if MonotonicClock.now() < end => self.pause()?,
                result => return Ok(result?),
            }
        }
    }

    /// Stops, and disables the motors if they were off before and the arm does not fall without them.
    fn leave_arm(&mut self, was_on: bool) {
        // Up to three attempts: this is the one command that must not be lost.
        let stopped = (0..3).any(|_| {
            let rest = rest_point(self.adapter);
            self.adapter.deactivate(&rest).is_ok()
        });
        let holds = self.adapter.get_info().holds_when_disabled;
        self.motion.left = if !stopped {
            "the arm did not take the last stop: stop it with the vendor's own tools".to_owned()
        } else if was_on {
            "motors on, as they were found".to_owned()
        } else if !holds {
            "motors on: this arm falls without them".to_owned()
        } else {
            std::thread::sleep(HOLD_TIME);
            match self.adapter.write_enable(false) {
                Ok(()) => "motors off, as they were found".to_owned(),
                Err(e) => format!("motors on: {e}"),
            }
        };
    }
}

//! The first motion of a real arm: each joint by itself, a little there and back again, slowly, watched all the time.
//!
//! What it shows: that the joints are in order, that plus is plus, that a degree is a degree, that the mode works, and
//! that a stop stops. Whatever is odd ends it with `write_stop`, and nothing is commanded after that.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

use serde::Serialize;

use super::context::when_there_is_room;
use super::lag::{Lag, Trace};
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::spec::{AdapterError, JointReading, ManipulatorAdapter};
use crate::joint::ControlMode;

/// How far each joint goes to either side [rad]: 2°.
pub const REACH: f64 = 2.0 * DEGREE;
/// Speed, as a fraction of the top speed.
pub const SPEED: f64 = 0.05;
/// Room that every joint must have to its limits [rad]: 3°.
pub const ROOM: f64 = 3.0 * DEGREE;

const DEGREE: f64 = std::f64::consts::PI / 180.0;
/// Speed of the move that is interrupted by a stop, as a fraction of the top speed.
const SLOWEST: f64 = 0.02;
/// This close to its target a joint has arrived [rad].
const CLOSE: f64 = 0.3 * DEGREE;
/// More than this of a joint that is not meant, or the wrong way, is odd [rad].
const STRAY: f64 = 0.5 * DEGREE;
/// More than this beyond the target is odd [rad].
const OVERSHOOT: f64 = 1.0 * DEGREE;
/// Behind its setpoints by more than this, a joint does not follow [rad].
const BEHIND: f64 = 1.5 * DEGREE;
/// How long one way may take.
const PATIENCE: Duration = Duration::from_secs(15);
/// How long the motors may take to come on.
const MOTORS: Duration = Duration::from_secs(5);
/// How long it may refuse to change its mode after a motion.
const MODE_LIMIT: Duration = Duration::from_secs(2);
/// How long the arm is watched after the motors came on.
const WATCH: Duration = Duration::from_millis(500);
/// A state older than this is no state to move by [s].
const OLD: f64 = 0.5;
/// Time between looks.
const PERIOD: Duration = Duration::from_micros(2500);
/// Looks from one setpoint of a stream to the next. Looking only when one has just been sent would always see the
/// joint in the same part of its step.
const LOOKS: u32 = 4;
/// Shortest time of a wave, and of one with which the lag is measured [s]: slow enough for the joint to stay near its
/// setpoints in spite of a long lag.
const SHORTEST: (f64, f64) = (0.3, 0.8);
/// Attempts to measure the lag of a joint while this program runs unevenly.
const ATTEMPTS: u32 = 3;
/// Setpoints go on by no more than this time at once [s].
const LONGEST_STEP: f64 = 0.01;
/// What the integral of a joint's velocity may be, as a fraction of its way: less where this program had to wait for a
/// processor and missed the fast part, but never of the other sign, and never as much as degrees for radians.
const HONEST: std::ops::Range<f64> = -0.3..5.0;

/// One joint's way there and back in one mode. All angles in rad.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Way {
    /// Which joint, from 1.
    pub joint: usize,
    /// In which mode.
    #[serde(serialize_with = "name_of")]
    pub mode: ControlMode,
    /// How far it was sent.
    pub sent: f64,
    /// How far it went up, and how far down.
    pub up: f64,
    /// How far it went down.
    pub down: f64,
    /// How far it is off its start in the end.
    pub back: f64,
    /// The most that any other joint moved meanwhile.
    pub others: f64,
    /// Its measured velocity, integrated, as a fraction of its way up; `None` where it measures none.
    pub velocity: Option<f64>,
    /// Time for all [s].
    pub seconds: f64,
}

fn name_of<S: serde::Serializer>(mode: &ControlMode, to: S) -> Result<S::Ok, S::Error> {
    to.serialize_str(mode.name())
}

/// What came of it.
#[derive(Debug, Clone, PartialEq, Default, Serialize)]
pub struct Motion {
    /// How far the arm moved when its motors came on [rad].
    pub held: Option<f64>,
    /// The joints' ways.
    pub ways: Vec<Way>,
    /// How far the arm went on after a stop in motion [rad].
    pub stopped: Option<f64>,
    /// What was odd, and ended it.
    pub odd: Option<String>,
    /// It was interrupted.
    pub interrupted: bool,
    /// How the motors were left.
    pub left: String,
}

/// Why it ended early.
enum End {
    Odd(String),
    Interrupted,
}

impl From<AdapterError> for End {
    fn from(error: AdapterError) -> Self {
        Self::Odd(error.to_string())
    }
}

/// Says why this arm should not be moved from where it stands, where something speaks against it.
pub fn refusal(adapter: &mut dyn ManipulatorAdapter) -> Result<(), String> {
    let said = |e: AdapterError| e.to_string();
    let mut reading = JointReading::default();
    adapter.read_joints(&mut reading).map_err(said)?;
    let (code, text) = adapter.read_error().map_err(said)?;
    if code != 0 {
        return Err(format!("it is in error {code}: {text}\nhint: clear that first, by the vendor's own means"));
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
                "joint {} at {:.2}° has {:.2}° to its {which} limit, {:.0}° are needed\nhint: bring the arm to a pose \
                 in the middle of its range, by the vendor's own means",
                i + 1,
                at.to_degrees(),
                room.to_degrees(),
                ROOM.to_degrees()
            ));
        }
    }
    Ok(())
}

/// Moves each joint of a connected arm a little. Ends it by a stop when something is odd or `interrupted` says so.
/// `tell` hears what happens next.
pub fn move_gently(
    adapter: &mut dyn ManipulatorAdapter,
    interrupted: &dyn Fn() -> bool,
    tell: &mut dyn FnMut(&str),
) -> Motion {
    Gently { adapter, interrupted, tell, start: Vec::new(), motion: Motion::default(), trace: None }.run(Gently::all)
}

/// Moves each joint of a connected arm a little by streamed setpoints, as [`move_gently`] does but slower, and measures
/// its lag. `row` is the row's [s].
pub fn measure_lag(
    adapter: &mut dyn ManipulatorAdapter,
    row: f64,
    interrupted: &dyn Fn() -> bool,
    tell: &mut dyn FnMut(&str),
) -> (Motion, Lag) {
    let mut joints = Vec::new();
    let trace = Some(Trace::default());
    let gently = Gently { adapter, interrupted, tell, start: Vec::new(), motion: Motion::default(), trace };
    let motion = gently.run(|it| it.lags(&mut joints));
    (motion, Lag::of(joints, row))
}

struct Gently<'a> {
    adapter: &'a mut dyn ManipulatorAdapter,
    interrupted: &'a dyn Fn() -> bool,
    tell: &'a mut dyn FnMut(&str),
    /// Where the arm stood [rad].
    start: Vec<f64>,
    motion: Motion,
    /// What a joint was sent and did, where its lag is measured.
    trace: Option<Trace>,
}

/// What is seen of one way: the joint's offset from the start, the most that others moved [rad], and the integral of
/// the measured velocity [rad].
#[derive(Clone, Copy, Default)]
struct Seen {
    moved: f64,
    others: f64,
    integral: Option<f64>,
}

impl Gently<'_> {
    /// Makes `motions`, and leaves the arm as it was found.
    fn run(mut self, motions: impl FnOnce(&mut Self) -> Result<(), End>) -> Motion {
        let was_on = self.adapter.read_enabled().unwrap_or(true);
        match catch_unwind(AssertUnwindSafe(|| motions(&mut self))) {
            Ok(Ok(())) => {}
            Ok(Err(End::Odd(what))) => self.motion.odd = Some(what),
            Ok(Err(End::Interrupted)) => self.motion.interrupted = true,
            Err(_) => self.motion.odd = Some("the adapter panicked".to_owned()),
        }
        self.leave(was_on);
        self.motion
    }

    /// Measures the lag of each joint [s].
    fn lags(&mut self, joints: &mut Vec<Option<f64>>) -> Result<(), End> {
        self.motors_on()?;
        let mode = ControlMode::ServoPosition;
        self.set_mode(mode)?;
        for joint in 0..self.start.len() {
            (self.tell)(&format!("lag of joint {}: first +, then −", joint + 1));
            let mut lag = None;
            for attempt in 0..ATTEMPTS {
                if attempt > 0 {
                    self.motion.ways.pop();
                }
                self.trace = Some(Trace::default());
                self.there_and_back(joint, mode)?;
                lag = self.trace.as_ref().and_then(Trace::lag);
                if lag.is_some() {
                    break;
                }
            }
            joints.push(lag);
        }
        Ok(())
    }

    /// Enables the motors, and watches that the arm holds its pose.
    fn motors_on(&mut self) -> Result<(), End> {
        self.start = self.look()?.0;
        (self.tell)("the motors come on");
        self.adapter.activate()?;
        self.until(MOTORS, "the motors do not come on", |it| Ok(it.adapter.read_enabled()?))?;
        let (began, before) = (MonotonicClock.now(), self.start.clone());
        let mut held: f64 = 0.0;
        while MonotonicClock.now().since(began) < WATCH {
            held = held.max(farthest(&self.look()?.0, &before));
            self.motion.held = Some(held);
            if held > STRAY {
                return Err(End::Odd(format!("the arm moved by {:.2}° when its motors came on", held.to_degrees())));
            }
            self.pause()?;
        }
        self.start = self.look()?.0;
        Ok(())
    }

    fn all(&mut self) -> Result<(), End> {
        self.motors_on()?;
        let modes = self.adapter.get_info().modes;
        for mode in [ControlMode::Position, ControlMode::ServoPosition] {
            if modes.contains(&mode) {
                self.set_mode(mode)?;
                for joint in 0..self.start.len() {
                    (self.tell)(&format!("joint {} in {} mode: first +, then −", joint + 1, mode.name()));
                    self.there_and_back(joint, mode)?;
                }
            }
        }
        if modes.contains(&ControlMode::Position) {
            (self.tell)("a stop in motion");
            self.stop_in_motion()?;
        }
        Ok(())
    }

    /// Changes the mode. An arm may hold itself to be moving for a moment longer than we do.
    fn set_mode(&mut self, mode: ControlMode) -> Result<(), End> {
        let end = MonotonicClock.now().after(MODE_LIMIT);
        loop {
            match self.adapter.set_control_mode(mode) {
                Err(AdapterError::Rejected(_)) if MonotonicClock.now() < end => self.pause()?,
                result => return Ok(result?),
            }
        }
    }

    fn there_and_back(&mut self, joint: usize, mode: ControlMode) -> Result<(), End> {
        let began = MonotonicClock.now();
        let up = self.go(joint, mode, 0.0, REACH)?;
        let middle = self.go(joint, mode, REACH, 0.0)?;
        let down = self.go(joint, mode, 0.0, -REACH)?;
        let back = self.go(joint, mode, -REACH, 0.0)?;
        let velocity = up.integral.map(|integral| integral / up.moved);
        if let Some(wrong) = velocity.filter(|part| !HONEST.contains(part)) {
            let what = format!("joint {}: its velocities, added up, make {wrong:.2} of its way", joint + 1);
            return Err(End::Odd(format!("{what}: are they in rad/s, and of this joint?")));
        }
        let others = [up, middle, down, back].iter().map(|seen| seen.others).fold(0.0, f64::max);
        self.motion.ways.push(Way {
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

    /// Brings a joint from one offset to another [rad], by one command or by a stream of setpoints.
    fn go(&mut self, joint: usize, mode: ControlMode, from: f64, to: f64) -> Result<Seen, End> {
        let limits = self.adapter.get_limits()?;
        let top = limits.velocity_max.get(joint).copied().unwrap_or(1.0);
        // The fastest moment of a half cosine wave is at SPEED.
        let shortest = if self.trace.is_some() { SHORTEST.1 } else { SHORTEST.0 };
        let time = (std::f64::consts::FRAC_PI_2 * (to - from).abs() / (SPEED * top)).max(shortest);
        let stream = mode == ControlMode::ServoPosition;
        if !stream {
            self.adapter.write_joint_positions(&self.target(joint, to), SPEED)?;
        }
        let began = MonotonicClock.now();
        let (mut seen, mut last) = (Seen::default(), None);
        let (mut streamed, mut before_this) = (0.0, began);
        let (mut still, mut point) = (0, if stream { from } else { to });
        self.trace.iter_mut().for_each(Trace::begin_wave);
        for look in 0_u32.. {
            let now = MonotonicClock.now();
            let past = now.seconds_since(began);
            // A pause of this program must not become a jump of the setpoints.
            streamed += now.seconds_since(before_this).min(LONGEST_STEP);
            before_this = now;
            let part = (streamed / time).min(1.0);
            let due = stream && look % LOOKS == 0;
            // In turn before and after a look: always before it, the first look after each would see the joint in the
            // same early part of its step, and the lag would come out short by half the time between looks.
            let afterwards = self.trace.is_some() && look / LOOKS % 2 == 1;
            if due {
                point = from + (to - from) * (0.5 - 0.5 * (part * std::f64::consts::PI).cos());
            }
            if due && !afterwards {
                self.stream(joint, point)?;
            }
            let (positions, reading, at) = self.look()?;
            if due && afterwards {
                self.stream(joint, point)?;
            }
            let before = seen.moved;
            seen = self.judge(joint, from, to, &positions, seen)?;
            if let Some(trace) = &mut self.trace {
                trace.saw(now, at, seen.moved);
            }
            if stream && (seen.moved - point).abs() > BEHIND {
                let behind = (seen.moved - point).abs().to_degrees();
                return Err(End::Odd(format!("joint {} is {behind:.2}° from its setpoint", joint + 1)));
            }
            if let Some(velocity) = reading.velocity.and_then(|v| v.get(joint).copied()) {
                let dt = last.map_or(0.0, |then| at.seconds_since(then));
                seen.integral = Some(seen.integral.unwrap_or(0.0) + velocity * dt);
            }
            last = Some(at);
            still = if (seen.moved - before).abs() < 0.01 * DEGREE { still + 1 } else { 0 };
            if (seen.moved - to).abs() < CLOSE && still >= 20 && (!stream || part >= 1.0) {
                return Ok(seen);
            }
            if past > PATIENCE.as_secs_f64() {
                let (sent, moved) = ((to - from).to_degrees(), (seen.moved - from).to_degrees());
                return Err(End::Odd(format!("joint {} was sent by {sent:+.2}° and moved by {moved:+.2}°", joint + 1)));
            }
            self.pause()?;
        }
        Ok(seen)
    }

    /// Writes a setpoint of one joint, as an offset from the start [rad].
    fn stream(&mut self, joint: usize, point: f64) -> Result<(), End> {
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

    /// Whether what is seen is what was asked for.
    fn judge(&self, joint: usize, from: f64, to: f64, positions: &[f64], mut seen: Seen) -> Result<Seen, End> {
        for (other, (now, start)) in positions.iter().zip(&self.start).enumerate() {
            let moved = now - start;
            if other == joint {
                seen.moved = moved;
            } else if moved.abs() > STRAY {
                let (other, joint, moved) = (other + 1, joint + 1, moved.to_degrees());
                return Err(End::Odd(format!("joint {other} moved by {moved:+.2}° while joint {joint} was sent")));
            } else {
                seen.others = seen.others.max(moved.abs());
            }
        }
        let (way, past) = (to - from, seen.moved - from);
        let sent = way.to_degrees();
        if past * way.signum() < -STRAY {
            return Err(End::Odd(format!("joint {} was sent by {sent:+.2}° and moves the other way", joint + 1)));
        }
        if past * way.signum() > way.abs() + OVERSHOOT {
            let past = past.to_degrees();
            return Err(End::Odd(format!("joint {} was sent by {sent:+.2}° and moved by {past:+.2}°", joint + 1)));
        }
        Ok(seen)
    }

    /// A stop on the way, at a quarter of it.
    fn stop_in_motion(&mut self) -> Result<(), End> {
        self.set_mode(ControlMode::Position)?;
        self.adapter.write_joint_positions(&self.target(0, REACH), SLOWEST)?;
        self.until(PATIENCE, "joint 1 does not start", |it| {
            let positions = it.look()?.0;
            Ok(it.judge(0, 0.0, REACH, &positions, Seen::default())?.moved > REACH / 4.0)
        })?;
        self.adapter.write_stop()?;
        let at = self.look()?.0;
        let stands = self.standstill()?;
        self.motion.stopped = Some(farthest(&stands, &at));
        if farthest(&stands, &self.target(0, REACH)) < CLOSE {
            return Err(End::Odd("joint 1 went to its target in spite of a stop".to_owned()));
        }
        self.adapter.activate()?;
        self.set_mode(ControlMode::Position)?;
        let here = stands.first().zip(self.start.first()).map_or(0.0, |(now, start)| now - start);
        self.go(0, ControlMode::Position, here, 0.0).map(drop)
    }

    fn target(&self, joint: usize, offset: f64) -> Vec<f64> {
        let add = |(i, start): (usize, &f64)| if i == joint { start + offset } else { *start };
        self.start.iter().enumerate().map(add).collect()
    }

    /// Reads the arm. A state that is old, an error, or motors that went off are odd.
    fn look(&mut self) -> Result<(Vec<f64>, JointReading, Mono), End> {
        let mut reading = JointReading::default();
        let mut result = self.adapter.read_joints(&mut reading);
        if matches!(result, Err(AdapterError::Timeout(_))) {
            result = self.adapter.read_joints(&mut reading);
        }
        result.map_err(|e| End::Odd(format!("no state: {e}")))?;
        let now = MonotonicClock.now();
        let at = reading.stamp.unwrap_or(now);
        let age = now.seconds_since(at);
        if age > OLD {
            return Err(End::Odd(format!("its newest state is {age:.1} s old")));
        }
        let (code, text) = self.adapter.read_error()?;
        if code != 0 {
            return Err(End::Odd(format!("error {code}: {text}")));
        }
        if !self.start.is_empty() && self.motion.held.is_some() && !self.adapter.read_enabled()? {
            return Err(End::Odd("the motors went off".to_owned()));
        }
        let positions = reading.position.get(..self.adapter.get_dof()).unwrap_or_default();
        if !positions.iter().all(|value| value.is_finite()) {
            return Err(End::Odd(format!("a joint position is no number: {positions:?}")));
        }
        Ok((positions.to_vec(), reading, at))
    }

    fn pause(&self) -> Result<(), End> {
        std::thread::sleep(PERIOD);
        if (self.interrupted)() { Err(End::Interrupted) } else { Ok(()) }
    }

    fn until(
        &mut self,
        limit: Duration,
        what: &str,
        mut done: impl FnMut(&mut Self) -> Result<bool, End>,
    ) -> Result<(), End> {
        let end = MonotonicClock.now().after(limit);
        while !done(self)? {
            if MonotonicClock.now() > end {
                return Err(End::Odd(what.to_owned()));
            }
            self.look()?;
            self.pause()?;
        }
        Ok(())
    }

    /// Waits until no joint moves for a tenth of a second.
    fn standstill(&mut self) -> Result<Vec<f64>, End> {
        let mut last = self.look()?.0;
        self.until(PATIENCE, "it does not come to rest", |it| {
            std::thread::sleep(Duration::from_millis(100));
            let now = it.look()?.0;
            let still = farthest(&now, &last) < 0.05 * DEGREE;
            last = now;
            Ok(still)
        })?;
        Ok(last)
    }

    /// Stops, and leaves the motors as they were found, where the arm does not fall by it.
    fn leave(&mut self, was_on: bool) {
        // Asked for more than once: this is the one command that must not be lost.
        let stopped = (0..3).any(|_| self.adapter.deactivate().is_ok());
        let holds = self.adapter.get_info().holds_when_disabled;
        self.motion.left = if !stopped {
            "it did not take the last stop: look after it by the vendor's own means".to_owned()
        } else if was_on {
            "motors on, as they were found".to_owned()
        } else if !holds {
            "motors on: this arm falls when they go off".to_owned()
        } else {
            std::thread::sleep(WATCH);
            match self.adapter.write_enable(false) {
                Ok(()) => "motors off, as they were found".to_owned(),
                Err(e) => format!("motors on: {e}"),
            }
        };
    }
}

fn farthest(a: &[f64], b: &[f64]) -> f64 {
    super::context::farthest(a, b)
}

//! The context of a check: an adapter, its emulator, and common steps.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};

use crate::adapter::{AdapterError, AdapterResult, JointReading, ManipulatorAdapter};
use crate::registry::{AdapterConfig, AdapterSpec, Emulator, EmulatorAddress, Truth};
use crate::sim::faults::Fault;
use dimos_core::arm::StopPoint;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_core::joint::{ControlMode, JointLimits, joints_of};

/// Maximum wait for an expected event.
const WAIT_TIMEOUT: Duration = Duration::from_secs(10);
/// Begin of the first fault of an arm without an emulator, and distance between further ones: time since the connection
/// [s].
const FAULT_AT: f64 = 1.0;

/// Time by which a stop and the reading after it may be late, beside the lag of the arm [s].
const LATE: f64 = 0.04;

/// Maximum wait for room for a setpoint.
const ROOM: Duration = Duration::from_secs(1);

/// Rate of the states of an arm whose controller is the clock: it ends a motion whose states are not answered [Hz].
pub(super) const CLOCKED: f64 = 1000.0;

/// Waits. The states of an arm whose controller is the clock are read meanwhile, as the device thread does.
pub fn pause(adapter: &mut dyn ManipulatorAdapter, time: Duration) {
    let until = Instant::now() + time;
    if adapter.state_fd().is_none() || adapter.get_info().native_rate < CLOCKED {
        return std::thread::sleep(time);
    }
    loop {
        let left = until.saturating_duration_since(Instant::now());
        let Some(states) = adapter.state_fd().filter(|_| !left.is_zero()) else { return std::thread::sleep(left) };
        let timeout = Timespec { tv_sec: left.as_secs() as i64, tv_nsec: left.subsec_nanos().into() };
        let came = poll(&mut [PollFd::from_borrowed_fd(states, PollFlags::IN)], Some(&timeout));
        if came.is_ok_and(|ready| ready > 0) && adapter.read_joints(&mut JointReading::default()).is_err() {
            // A broken connection stays readable.
            std::thread::sleep(Duration::from_millis(1));
        }
    }
}

/// Acceleration of arms whose limits have none [rad/s²].
const BRAKING: f64 = 5.0;

/// Returns where the arm is at rest after braking: of its own readings, since the checks are its caller and write no
/// stream of setpoints. None while it cannot be read.
pub fn rest_point(adapter: &mut dyn ManipulatorAdapter) -> StopPoint {
    let (mut reading, limits) = (JointReading::default(), adapter.get_limits().unwrap_or_default());
    if adapter.read_joints(&mut reading).is_err() {
        return StopPoint::default();
    }
    let mut position = reading.position;
    for (i, (at, v)) in position.iter_mut().zip(reading.velocity.unwrap_or_default()).enumerate() {
        let brakes = limits.acceleration_max.get(i).copied().filter(|a| *a > 0.0).unwrap_or(BRAKING);
        let ends = *at + v * v.abs() / (2.0 * brakes);
        let range = limits.position_lower.get(i).zip(limits.position_upper.get(i));
        // A joint outside its range stays there.
        *at = range.map_or(ends, |(lower, upper)| ends.max(lower.min(*at)).min(upper.max(*at)));
    }
    StopPoint { position: Some(position) }
}

/// Answers in a row that may be late on a busy machine.
const MAX_LATE: u32 = 2;

/// Retries a write of setpoints while two are unacknowledged, as the device thread does. On a busy machine the answer
/// may be late twice, like that of a read.
pub fn when_there_is_room(mut write: impl FnMut() -> AdapterResult<()>) -> AdapterResult<()> {
    let (until, mut late) = (Instant::now() + ROOM, 0);
    loop {
        match write() {
            Err(AdapterError::Busy) if Instant::now() < until => std::thread::sleep(Duration::from_millis(1)),
            Err(AdapterError::Timeout(_)) if late < MAX_LATE => late += 1,
            result => return result,
        }
    }
}

/// The subject of the checks.
#[derive(Debug, Clone)]
pub struct Subject {
    /// The row of the arm.
    pub row: AdapterSpec,
    /// Configuration of the adapter. The address is used only with a real device.
    pub config: AdapterConfig,
    /// Whether a real device is at the address. Checks for emulators are then skipped.
    pub real: bool,
    /// Returns the calling thread's allocations so far, if the program has a counting allocator.
    pub allocations: Option<fn() -> u64>,
}

impl Subject {
    /// Returns the emulator of a row, with the maximum number of joints and default options.
    pub fn emulated(row: &AdapterSpec) -> Self {
        let config = AdapterConfig {
            hardware_id: "conformance".into(),
            address: String::new(),
            dof: row.dof.1,
            options: serde_json::json!({}),
        };
        Self { row: *row, config, real: false, allocations: None }
    }
}

/// An adapter that is not connected yet, and its emulator.
pub struct Context {
    /// The row under test.
    pub row: AdapterSpec,
    /// Configuration of the adapter.
    pub config: AdapterConfig,
    /// The emulator; `None` if the adapter is its own plant, or the device is real.
    pub emulator: Option<Box<dyn Emulator>>,
    /// The adapter under test.
    pub adapter: Box<dyn ManipulatorAdapter>,
    /// Counts the thread's allocations so far.
    pub allocations: Option<fn() -> u64>,
    /// Whether the device is real: its measurements have noise.
    pub real: bool,
    /// Why the check does not apply.
    pub(super) skipped: Option<String>,
    /// Finding of the check, for the report.
    pub(super) found: Option<String>,
    faults: VecDeque<Fault>,
    /// The last setpoint of a stream [rad].
    streamed: Option<Vec<f64>>,
}

impl Context {
    /// Creates an adapter, and an emulator unless the device is real.
    pub(super) fn new(subject: &Subject) -> Result<Self, String> {
        let (row, mut config) = (subject.row, subject.config.clone());
        let emulator = match row.emulate.filter(|_| !subject.real) {
            Some(start) => Some(start(&config, &EmulatorAddress::InProcess).map_err(|e| e.to_string())?),
            None => None,
        };
        if let Some(emulator) = &emulator {
            config.address = emulator.address();
        }
        let adapter = (row.create)(&config).map_err(|e| format!("cannot be made: {e}"))?;
        let (allocations, real) = (subject.allocations, subject.real);
        let faults = VecDeque::new();
        let (skipped, found, streamed) = (None, None, None);
        Ok(Self { row, config, emulator, adapter, allocations, real, skipped, found, faults, streamed })
    }

    /// Takes the arm without the option `calibration`: a calibration is of a real arm, and the emulated one is as the
    /// data sheet says. For checks that compare positions with the emulated arm's; must come first.
    pub fn leave_out_calibration(&mut self) -> Result<(), String> {
        let mut config = self.config.clone();
        if config.options.as_object_mut().and_then(|options| options.remove("calibration")).is_none() || self.real {
            return Ok(());
        }
        let subject = Subject { row: self.row, config, real: self.real, allocations: self.allocations };
        *self = Self::new(&subject)?;
        self.found("without the calibration: the emulated arm has none")
    }

    /// Marks the check as not applicable.
    pub fn skip(&mut self, why: &str) -> Result<(), String> {
        self.skipped = Some(why.to_owned());
        Ok(())
    }

    /// Records a finding for the report.
    pub fn found(&mut self, what: impl Into<String>) -> Result<(), String> {
        self.found = Some(what.into());
        Ok(())
    }

    /// Returns how far a joint at rest may seem to move [rad]: rounding, or the noise of a real encoder.
    pub fn rest(&self) -> f64 {
        (1.5 * self.row.resolution).max(if self.real { 0.002 } else { 1e-6 })
    }

    /// Returns how far a joint may move that is held [rad].
    pub fn holding(&self) -> f64 {
        self.rest().max(1e-3)
    }

    /// Returns how far below their setpoints joints rest [rad]: of a real arm by its row, of an emulated one by its
    /// options.
    pub fn droop(&self) -> f64 {
        let emulated = self.config.options.pointer("/sim/droop").and_then(serde_json::Value::as_f64);
        if self.real { self.row.droop } else { emulated.unwrap_or(0.0) }
    }

    /// Returns how far a joint may move whose motor begins to hold it, or is stopped [rad].
    pub fn settling(&self) -> f64 {
        (self.row.accuracy + self.row.resolution + self.droop()).max(0.005)
    }

    /// Returns how far from its target a joint may be that has arrived [rad].
    pub fn arrival(&self) -> f64 {
        (self.row.accuracy + self.row.resolution + self.droop()).max(1e-3)
    }

    /// Returns how far a joint may coast after a stop at `speed` [rad/s], by the row's lag and the acceleration limits
    /// [rad].
    pub fn coasting(&mut self, speed: f64) -> Result<f64, String> {
        let limits = self.limits()?.with_defaults();
        let slowest = limits.acceleration_max.iter().copied().fold(f64::INFINITY, f64::min);
        Ok(speed * (self.row.lag + LATE) + 0.5 * speed * speed / slowest + self.holding())
    }

    /// Prepares a fault; `false` if the emulator cannot play it. Must come first in a check. Faults begin in the order
    /// in which they were prepared.
    pub fn prepare(&mut self, fault: Fault) -> bool {
        if self.real {
            return false;
        }
        self.faults.push_back(fault);
        if let Some(emulator) = &self.emulator {
            // A fault in the far future only tests whether it can be played.
            return emulator.inject(fault.at(1e6)).is_ok();
        }
        let script = self.faults.iter().enumerate().map(|(i, fault)| fault.at(FAULT_AT * (i + 1) as f64));
        let script = serde_json::to_value(script.collect::<Vec<_>>()).unwrap_or_default();
        let mut config = self.config.clone();
        match config.options.as_object_mut() {
            Some(options) => drop(options.insert("faults".to_owned(), script)),
            None => config.options = serde_json::json!({ "faults": script }),
        }
        (self.row.create)(&config).is_ok_and(|adapter| {
            self.adapter = adapter;
            true
        })
    }

    /// Begins the next prepared fault, now or soon.
    pub fn trigger_faults(&mut self) -> Result<(), String> {
        match (&self.emulator, self.faults.pop_front()) {
            (Some(emulator), Some(fault)) => emulator.inject(fault),
            _ => Ok(()),
        }
    }

    /// Connects.
    pub fn connect(&mut self) -> Result<(), String> {
        self.adapter.connect().map_err(|e| format!("connect: {e}"))
    }

    /// Connects, activates and sets a mode.
    pub fn ready(&mut self, mode: ControlMode) -> Result<(), String> {
        self.connect()?;
        self.activate()?;
        self.set_mode(mode).map_err(|e| format!("set_control_mode {}: {e}", mode.name()))
    }

    /// Sets the mode. Retries on `Rejected`, as the device thread does.
    pub fn set_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        let end = Instant::now() + WAIT_TIMEOUT;
        loop {
            let result = self.adapter.set_control_mode(mode);
            if !matches!(result, Err(AdapterError::Rejected(_))) || Instant::now() > end {
                return result;
            }
            pause(&mut *self.adapter, Duration::from_millis(5));
        }
    }

    /// Activates, and waits for the motors as the device thread does.
    pub fn activate(&mut self) -> Result<(), String> {
        self.adapter.activate().map_err(|e| format!("activate: {e}"))?;
        self.until("the motors to come on", Self::enabled)
    }

    /// Returns whether the arm has a mode, by its row and by what its adapter knows now.
    pub fn has_mode(&self, mode: ControlMode) -> bool {
        self.row.modes.contains(&mode) && self.adapter.get_info().modes.contains(&mode)
    }

    /// Returns the first mode of the arm.
    pub fn first_mode(&self) -> ControlMode {
        self.row.modes.iter().copied().find(|mode| self.has_mode(*mode)).unwrap_or_default()
    }

    /// Returns a mode for joint positions; `None` if it has none.
    pub fn position_mode(&self) -> Option<ControlMode> {
        [ControlMode::ServoPosition, ControlMode::Position].into_iter().find(|mode| self.has_mode(*mode))
    }

    /// Moves from `start` to `goal` [rad] in a position mode: by setpoints during half a second, or by one target.
    pub fn stream(&mut self, start: &[f64], goal: &[f64]) -> Result<(), String> {
        if self.adapter.get_control_mode() == ControlMode::ServoPosition {
            for i in 1..=50 {
                self.command(&between(start, goal, f64::from(i) / 50.0), 1.0)?;
                pause(&mut *self.adapter, Duration::from_millis(10));
            }
        } else {
            self.command(goal, 0.5)?;
        }
        self.until("the last setpoint", |context| Ok(farthest(&context.positions()?, goal) < context.arrival()))
    }

    /// Returns what is true of the emulated arm; nothing is known of a real one.
    pub fn truth(&self) -> Truth {
        self.emulator.as_ref().map_or(Truth::default(), |emulator| emulator.truth())
    }

    /// Returns the true joint positions of the emulated arm [rad]; `None` if they are unknown.
    pub fn true_positions(&self) -> Option<Vec<f64>> {
        Some(self.truth().positions?.get(..self.config.dof).unwrap_or_default().to_vec())
    }

    /// Returns joint positions [rad] that were measured after this call.
    pub fn positions(&mut self) -> Result<Vec<f64>, String> {
        let reading = self.joints()?;
        Ok(reading.position.get(..self.config.dof).unwrap_or_default().to_vec())
    }

    /// Returns all joint values, measured after this call.
    pub fn joints(&mut self) -> Result<JointReading, String> {
        let asked = MonotonicClock.now();
        loop {
            let reading = self.read()?;
            let pushed = self.adapter.state_fd().is_some();
            match reading.stamp {
                Some(stamp) if pushed && stamp < asked => {}
                _ => return Ok(reading),
            }
            if MonotonicClock.now().since(asked) > WAIT_TIMEOUT {
                return Err(format!("read_joints: no newer state within {WAIT_TIMEOUT:?}"));
            }
            pause(&mut *self.adapter, Duration::from_millis(1));
        }
    }

    /// Calls `read_joints`; on a busy machine it may be late twice.
    fn read(&mut self) -> Result<JointReading, String> {
        let mut reading = JointReading::default();
        let mut result = self.adapter.read_joints(&mut reading);
        for _ in 0..MAX_LATE {
            if !matches!(result, Err(AdapterError::Timeout(_))) {
                break;
            }
            result = self.adapter.read_joints(&mut reading);
        }
        result.map(|()| reading).map_err(|e| format!("read_joints: {e}"))
    }

    /// Returns the joint limits.
    pub fn limits(&mut self) -> Result<JointLimits, String> {
        self.adapter.get_limits().map_err(|e| format!("get_limits: {e}"))
    }

    /// Returns whether the motors are on, as the device reports after this call.
    pub fn enabled(&mut self) -> Result<bool, String> {
        self.joints()?;
        self.adapter.read_enabled().map_err(|e| format!("read_enabled: {e}"))
    }

    /// Returns the error, as the device reports it after this call.
    pub fn error(&mut self) -> Result<(i32, String), String> {
        self.joints()?;
        self.adapter.read_error().map_err(|e| format!("read_error: {e}"))
    }

    /// Returns the gripper's position [m or rad], as the device reports it after this call; `None` without a gripper.
    pub fn gripper(&mut self) -> Result<Option<f64>, String> {
        self.joints()?;
        let opening = self.adapter.gripper().map_or(Ok(None), |gripper| gripper.read_gripper_position());
        opening.map_err(|e| format!("read_gripper_position: {e}"))
    }

    /// Commands the gripper's position [m or rad].
    pub fn command_gripper(&mut self, opening: f64) -> Result<(), String> {
        let gripper = self.adapter.gripper().ok_or(AdapterError::Unsupported);
        let result = gripper.and_then(|gripper| gripper.write_gripper_position(opening));
        result.map_err(|e| format!("write_gripper_position: {e}"))
    }

    /// Returns joint positions at nine tenths of the range between the limits [rad]: far from any pose at power-up.
    pub fn far(&mut self) -> Result<Vec<f64>, String> {
        let limits = self.limits()?;
        let range = limits.position_lower.iter().zip(&limits.position_upper);
        Ok(range.map(|(lower, upper)| lower + 0.9 * (upper - lower)).collect())
    }

    /// Commands joint positions.
    pub fn command(&mut self, positions: &[f64], speed: f64) -> Result<(), String> {
        let adapter = &mut self.adapter;
        self.streamed = (adapter.get_control_mode() == ControlMode::ServoPosition).then(|| positions.to_vec());
        when_there_is_room(|| adapter.write_joint_positions(positions, speed))
            .map_err(|e| format!("write_joint_positions: {e}"))
    }

    /// Commands velocities.
    pub fn command_velocities(&mut self, velocities: &[f64]) -> Result<(), String> {
        let adapter = &mut self.adapter;
        self.streamed = None;
        when_there_is_room(|| adapter.write_joint_velocities(velocities))
            .map_err(|e| format!("write_joint_velocities: {e}"))
    }

    /// Stops: a stream where its last setpoint is, all else where its braking ends by what is read.
    pub fn stop(&mut self) -> Result<(), String> {
        let rest = match self.streamed.take() {
            Some(last) => StopPoint { position: Some(joints_of(&last)) },
            None => rest_point(&mut *self.adapter),
        };
        self.adapter.write_stop(&rest).map(drop).map_err(|e| format!("write_stop: {e}"))
    }

    /// Returns joint positions slightly off `from` [rad]: a different amount for each joint, alternately up and down,
    /// inside the limits.
    pub fn nearby(&mut self, from: &[f64]) -> Result<Vec<f64>, String> {
        let limits = self.limits()?;
        let range = limits.position_lower.iter().zip(&limits.position_upper);
        // So large that an arm which has arrived has moved.
        let least = (1.5 * self.arrival()).clamp(0.02, 0.1);
        let step = |i: usize| least * (i + 1) as f64 / from.len().max(6) as f64 * 6.0;
        Ok(from
            .iter()
            .zip(range)
            .enumerate()
            .map(|(i, (position, (lower, upper)))| {
                let wanted = position + if i % 2 == 0 { step(i) } else { -step(i) };
                if (*lower..=*upper).contains(&wanted) { wanted } else { 2.0 * position - wanted }
            })
            .collect())
    }

    /// Clears the arm's errors; waits for an arm that needs time for it.
    pub fn clear_errors(&mut self) -> AdapterResult<()> {
        let end = Instant::now() + WAIT_TIMEOUT;
        loop {
            match self.adapter.write_clear_errors() {
                Err(AdapterError::Busy) if Instant::now() < end => {
                    pause(&mut *self.adapter, Duration::from_millis(5));
                }
                result => return result,
            }
        }
    }

    /// Waits until `done` returns true.
    pub fn until(&mut self, what: &str, mut done: impl FnMut(&mut Self) -> Result<bool, String>) -> Result<(), String> {
        let end = Instant::now() + WAIT_TIMEOUT;
        while !done(self)? {
            if Instant::now() > end {
                return Err(format!("{what}: not within {WAIT_TIMEOUT:?}"));
            }
            pause(&mut *self.adapter, Duration::from_millis(5));
        }
        Ok(())
    }

    /// Waits until all joints are at rest: positions that do not change for a while.
    pub fn standstill(&mut self) -> Result<Vec<f64>, String> {
        // A joint that droops sinks slowly, by less than its encoder sees at once.
        let look = Duration::from_millis(if self.droop() > 0.0 { 500 } else { 50 });
        let mut last = self.positions()?;
        self.until("standstill", |context| {
            pause(&mut *context.adapter, look);
            let now = context.positions()?;
            let still = farthest(&now, &last) <= context.rest();
            last = now;
            Ok(still)
        })?;
        Ok(last)
    }

    /// Waits until a planned move has brought all joints to rest at `goal` [rad].
    pub fn arrive(&mut self, what: &str, goal: &[f64]) -> Result<(), String> {
        self.until(what, |context| Ok(farthest(&context.positions()?, goal) < context.arrival()))?;
        let (rest, most) = (self.standstill()?, self.arrival());
        require(farthest(&rest, goal) < most, || format!("{what}: it rests at {rest:?}, and was sent to {goal:?}"))
    }

    /// Checks for a third of a second that no joint moves by more than `most` [rad].
    pub fn stays(&mut self, from: &[f64], most: f64) -> Result<(), String> {
        for _ in 0..33 {
            pause(&mut *self.adapter, Duration::from_millis(10));
            let moved = farthest(&self.positions()?, from);
            if moved > most {
                return Err(format!("the arm moved by {moved:.6} rad"));
            }
        }
        Ok(())
    }
}

/// Returns the point at a fraction of the way between two.
pub fn between(from: &[f64], to: &[f64], part: f64) -> Vec<f64> {
    from.iter().zip(to).map(|(a, b)| a + (b - a) * part).collect()
}

/// Returns the largest difference of two vectors.
pub fn farthest(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Fails with `why` unless `holds`.
pub fn require(holds: bool, why: impl FnOnce() -> String) -> Result<(), String> {
    if holds { Ok(()) } else { Err(why()) }
}

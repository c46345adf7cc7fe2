//! The SO-101 adapter: the adapter protocol on one side, the servos' line on the other.
//!
//! Wire: counts and counts/s. Here: rad, rad/s, m. One request reads the whole state of all servos;
//! [`ManipulatorAdapter::read_joints`] makes it, and what is read right after is answered from it.

use std::f64::consts::TAU;
use std::time::Duration;

use super::bus::{Bus, servo};
use super::calibration::{Calibration, NAMES, Range};
use super::protocol::{
    self, Instruction, MAX_DATA, MAX_INSTRUCTION, MODEL, SERVOS, STATE, Servo, TURN, register, signed,
};
use super::settings;
use super::{DOF, GRIPPER_MAX, HOLDS_WHEN_DISABLED, MODES, NATIVE_RATE, Options, TOP_SPEED, check, limits};
use crate::arm::JointStatus;
use crate::clock::{Clock, Mono, MonotonicClock};
use crate::hardware::adapter::{
    AdapterError, AdapterResult, Gripper, JointMonitor, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState,
    Stop,
};
use crate::hardware::adapter_util::{fill, finite};
use crate::hardware::registry::AdapterConfig;
use crate::hardware::transport::request_reply::Retry;
use crate::joint::{ControlMode, JointLimits, Joints, joints_of};

/// Longest wait for the state of all servos. All attempts together stay below `stale_after`.
const CYCLE: Retry = Retry { each: Duration::from_millis(30), times: 3 };
/// A state answers further questions for this time.
const STATE_AGE: Duration = Duration::from_millis(5);
/// A setpoint is written if the motors were on and without error this long ago at most: the state is read once a cycle.
const WRITABLE: Duration = Duration::from_millis(50);
/// How often torque and goals are written until the servos show them: nothing acknowledges a write to all.
const WRITES: u32 = 4;
/// A goal this far from the joint is that joint's position [counts]: encoders flicker.
const SAME: i32 = 3;
/// A joint at rest further than this from its goal has not started yet, or is blocked [counts]; nearer, it droops.
const DROOP: i32 = 40;
/// Acceleration of the servos, the highest [100 counts/s²].
const ACCELERATION: u8 = 254;
/// Below this the servos answer, but have no force [0.1 V].
const LOWEST_VOLTAGE: u8 = 55;
/// Unit of the servos' currents [A].
const AMPERE: f64 = 6.5e-3;
/// Slowest planned motion [counts/s]: zero would be the fastest.
const SLOWEST: f64 = 10.0;

/// An SO-101.
pub struct So101Adapter {
    bus: Bus,
    calibration: Calibration,
    /// Whether settings with other values than wanted are written when connecting.
    write_settings: bool,
    firmware: (u8, u8),
    mode: ControlMode,
    /// The last state of all servos, and when it was asked for.
    state: Option<([Servo; SERVOS], Mono)>,
    /// The last goal of the gripper [counts]; `None`: where it is.
    gripper_goal: Option<i32>,
    /// The servos' homing offsets, read when connecting [counts].
    offsets: [i32; SERVOS],
}

impl So101Adapter {
    /// Creates an adapter for the servos at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        config.check(check)?;
        let options = config.options::<Options>()?;
        Ok(Self {
            bus: Bus::new(config)?,
            calibration: options.calibration().map_err(|e| AdapterError::Rejected(e.what))?,
            write_settings: options.write_settings,
            firmware: (0, 0),
            mode: MODES.first().copied().unwrap_or_default(),
            state: None,
            gripper_goal: None,
            offsets: [0; SERVOS],
        })
    }

    fn range(&self, servo: usize) -> Range {
        self.calibration.0.get(servo).copied().unwrap_or(Calibration::default().0[0])
    }

    /// Writes the same registers of all servos.
    fn write<const N: usize>(&mut self, address: u8, values: [[u8; N]; SERVOS]) -> AdapterResult<()> {
        let mut frame = [0; MAX_INSTRUCTION];
        let values = values.as_flattened();
        self.state = None;
        self.bus.line.tell(protocol::encode(Instruction::WriteAll(address, N as u8, values), &mut frame))
    }

    /// Asks for the state of all servos.
    fn fetch(&mut self) -> AdapterResult<[Servo; SERVOS]> {
        self.state = None;
        let asked = MonotonicClock.now();
        let mut frame = [0; MAX_INSTRUCTION];
        let frame = protocol::encode(Instruction::ReadAll(STATE.0, STATE.1), &mut frame);
        let mut servos: [Option<Servo>; SERVOS] = [None; SERVOS];
        let scan = |bytes: &[u8]| {
            protocol::scan(bytes, 1..=SERVOS as u8, usize::from(STATE.1)).map(|status| {
                let mut data = [0; MAX_DATA];
                data.iter_mut().zip(status.data).for_each(|(to, byte)| *to = *byte);
                (status.id, data)
            })
        };
        let result = self.bus.line.gather(frame, CYCLE, SERVOS, scan, |(id, data)| {
            let slot = usize::from(id).checked_sub(1).and_then(|servo| servos.get_mut(servo));
            slot.is_some_and(|slot| slot.replace(Servo::decode(&data).unwrap_or_default()).is_none())
        });
        if let (Err(AdapterError::Timeout(text)), Some(missing)) = (&result, servos.iter().position(Option::is_none)) {
            let name = NAMES.get(missing).copied().unwrap_or_default();
            return Err(AdapterError::Timeout(format!("{text}; servo {} ({name}) did not", missing + 1)));
        }
        result?;
        let servos = servos.map(Option::unwrap_or_default);
        self.state = Some((servos, asked));
        Ok(servos)
    }

    /// Returns the last state, or a new one when that is too old.
    fn recent(&mut self) -> AdapterResult<[Servo; SERVOS]> {
        self.not_older(STATE_AGE)
    }

    fn not_older(&mut self, age: Duration) -> AdapterResult<[Servo; SERVOS]> {
        match self.state {
            Some((servos, at)) if self.bus.line.is_open() && MonotonicClock.now().since(at) <= age => Ok(servos),
            _ => self.fetch(),
        }
    }

    /// Writes goals until the servos show them.
    fn write_goals(&mut self, goals: [i32; SERVOS]) -> AdapterResult<()> {
        for _ in 0..WRITES {
            self.write(register::GOAL, goals.map(|goal| (goal.max(0) as u16).to_le_bytes()))?;
            if self.fetch()?.iter().zip(&goals).all(|(servo, goal)| servo.goal == *goal) {
                return Ok(());
            }
        }
        Err(AdapterError::Protocol("so101: the servos do not take their goals".into()))
    }

    /// Switches all motors on or off until the servos show it.
    fn write_torque(&mut self, on: bool) -> AdapterResult<()> {
        for _ in 0..WRITES {
            self.write(register::TORQUE, [[u8::from(on)]; SERVOS])?;
            if self.fetch()?.iter().all(|servo| servo.on == on) {
                return Ok(());
            }
        }
        let what = if on { "on" } else { "off" };
        Err(AdapterError::Protocol(format!("so101: not all motors can be switched {what}")))
    }

    /// Returns where each servo is, inside its range. A servo goes to its goal when its motor comes on, and some when a
    /// goal is written.
    fn hold_goals(&self, servos: &[Servo; SERVOS]) -> AdapterResult<[i32; SERVOS]> {
        let mut goals = servos.map(|servo| servo.position);
        for (j, goal) in goals.iter_mut().enumerate() {
            let (range, position) = (self.range(j), *goal);
            *goal = position.max(range.low).min(range.high);
            if (*goal - position).abs() > SAME && j < DOF {
                let degrees = |counts: i32| f64::from(counts) * 360.0 / TURN;
                return Err(AdapterError::Rejected(format!(
                    "joint {} ({}) is {:.1}° outside its range\nhint: move it inside by hand, or calibrate the arm",
                    j + 1,
                    NAMES.get(j).copied().unwrap_or_default(),
                    degrees((*goal - position).abs())
                )));
            }
        }
        Ok(goals)
    }

    /// Writes goals of the joints with a top speed [counts/s, 0 = none]; the gripper keeps its own.
    fn drive(&mut self, joints: [f64; DOF], speed: u16) -> AdapterResult<()> {
        let servos = self.not_older(WRITABLE)?;
        if let Some(joint) = servos.iter().take(DOF).position(|servo| !servo.on) {
            return Err(AdapterError::Rejected(format!("the motor of joint {} is off", joint + 1)));
        }
        if let Some((code, text)) = error_of(&servos) {
            return Err(AdapterError::Fault { code, text });
        }
        let mut values = [[0; 7]; SERVOS];
        for (j, value) in values.iter_mut().enumerate() {
            let held = servos.get(j).map_or(0, |servo| servo.goal);
            let goal = match joints.get(j) {
                Some(angle) => self.range(j).counts(*angle),
                None => self.gripper_goal.unwrap_or(held),
            };
            let ([g0, g1], [s0, s1]) = ((goal.max(0) as u16).to_le_bytes(), speed.to_le_bytes());
            *value = [ACCELERATION, g0, g1, 0, 0, s0, s1];
        }
        let seen = self.state;
        self.write(register::ACCELERATION, values)?;
        // Goals change nothing of what was measured.
        self.state = seen;
        Ok(())
    }

    fn angles(&self, of: impl Fn(usize, Range) -> f64) -> Joints {
        let mut values = [0.0; DOF];
        values.iter_mut().enumerate().for_each(|(j, value)| *value = of(j, self.range(j)));
        joints_of(&values)
    }
}

/// Returns code and text of the first servo in error; the text names it.
fn error_of(servos: &[Servo; SERVOS]) -> Option<(i32, String)> {
    let (i, servo) = servos.iter().enumerate().find(|(_, servo)| servo.error != 0)?;
    let (name, text) = (NAMES.get(i).copied().unwrap_or_default(), protocol::error_text(servo.error));
    Some((servo.error.into(), format!("servo {} ({name}): {text}", i + 1)))
}

impl ManipulatorAdapter for So101Adapter {
    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.bus.open()?;
        let introduced = self.introduce();
        if introduced.is_err() {
            self.disconnect();
        }
        introduced
    }

    fn disconnect(&mut self) {
        self.bus.line.close();
        (self.state, self.gripper_goal) = (None, None);
    }

    fn is_connected(&self) -> bool {
        self.bus.line.is_open()
    }

    fn get_info(&self) -> ManipulatorInfo {
        ManipulatorInfo {
            vendor: "The Robot Studio".into(),
            model: "SO-101".into(),
            dof: DOF,
            firmware_version: self.is_connected().then(|| format!("{}.{}", self.firmware.0, self.firmware.1)),
            serial_number: None,
            native_rate: NATIVE_RATE,
            modes: MODES,
            holds_when_disabled: HOLDS_WHEN_DISABLED,
            whole_state_at_once: true,
        }
    }

    fn get_dof(&self) -> usize {
        DOF
    }

    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        Ok(limits(&self.calibration))
    }

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        if !self.is_connected() {
            return Err(AdapterError::NotConnected);
        }
        if !MODES.contains(&mode) {
            return Err(AdapterError::Unsupported);
        }
        self.mode = mode;
        Ok(())
    }

    fn get_control_mode(&self) -> ControlMode {
        self.mode
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        let servos = self.fetch()?;
        fill(positions, &self.angles(|j, range| range.angle(servos.get(j).map_or(0, |servo| servo.position))));
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        let servos = self.recent()?;
        fill(velocities, &self.angles(|j, _| velocity(servos.get(j))));
        Ok(true)
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let servos = self.fetch()?;
        *reading = JointReading {
            stamp: None,
            device_ns: None,
            position: self.angles(|j, range| range.angle(servos.get(j).map_or(0, |servo| servo.position))),
            velocity: Some(self.angles(|j, _| velocity(servos.get(j)))),
            effort: None,
            valid: Some(true),
        };
        Ok(())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let servos = self.recent()?;
        let bits = |of: fn(&Servo) -> bool| servos.iter().zip(0..).map(|(s, i)| i32::from(of(s)) << i).sum::<i32>();
        Ok(RobotState { state: bits(|servo| servo.on) + (bits(|servo| servo.moving) << 8), mode: 0 })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        Ok(error_of(&self.recent()?).unwrap_or_default())
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        Ok(self.recent()?.iter().take(DOF).all(|servo| servo.on))
    }

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        let joints = finite::<DOF>(positions)?;
        let speed = match self.mode {
            ControlMode::Position => (velocity * TOP_SPEED * TURN / TAU).max(SLOWEST) as u16,
            _ => 0,
        };
        self.drive(joints, speed)
    }

    fn write_stop(&mut self) -> AdapterResult<Stop> {
        let servos = self.fetch()?;
        self.gripper_goal = None;
        if !servos.iter().any(|servo| servo.on && (servo.moving || (servo.goal - servo.position).abs() > DROOP)) {
            return Ok(Stop::Confirmed);
        }
        // A joint at rest keeps its goal: its position is lower by its droop.
        let mut goals = servos.map(|servo| servo.goal);
        for (j, (goal, servo)) in goals.iter_mut().zip(&servos).enumerate() {
            let range = self.range(j);
            if servo.moving || !servo.on || (servo.goal - servo.position).abs() > DROOP {
                *goal = servo.position.max(range.low).min(range.high);
            }
        }
        self.write_goals(goals)?;
        Ok(Stop::Confirmed)
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        if enable {
            let servos = self.fetch()?;
            if servos.iter().all(|servo| servo.on) {
                return Ok(());
            }
            if let Some(servo) = servos.iter().find(|servo| servo.voltage < LOWEST_VOLTAGE) {
                let volts = f64::from(servo.voltage) * 0.1;
                return Err(AdapterError::Rejected(format!(
                    "so101: the servos have {volts:.1} V\nhint: switch the arm's power supply on; USB gives them no force"
                )));
            }
            let held = self.hold_goals(&servos)?;
            // A motor that is on keeps its goal.
            let mut goals = servos.map(|servo| servo.goal);
            for ((goal, servo), held) in goals.iter_mut().zip(&servos).zip(held) {
                if !servo.on {
                    *goal = held;
                }
            }
            self.gripper_goal = None;
            self.write_goals(goals)?;
        }
        self.write_torque(enable)
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        let servos = self.fetch()?;
        if error_of(&servos).is_none() {
            return Ok(());
        }
        // An overload ends when the goal no longer asks for force. The other servos keep theirs.
        let held = self.hold_goals(&servos)?;
        let mut goals = servos.map(|servo| servo.goal);
        for ((goal, servo), held) in goals.iter_mut().zip(&servos).zip(held) {
            if servo.error != 0 {
                *goal = held;
            }
        }
        self.write_goals(goals)?;
        match error_of(&self.fetch()?) {
            None => Ok(()),
            Some((_, text)) => Err(AdapterError::Rejected(format!(
                "{text}, still\nhint: support the arm, switch its motors off (dimos arm disable) and on again"
            ))),
        }
    }

    fn discard_pending(&mut self) {
        self.bus.line.abort();
        self.disconnect();
    }

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        Some(self)
    }

    fn joint_monitor(&mut self) -> Option<&mut dyn JointMonitor> {
        Some(self)
    }
}

/// Returns a servo's velocity [rad/s].
fn velocity(servo: Option<&Servo>) -> f64 {
    servo.map_or(0.0, |servo| f64::from(servo.velocity) * TAU / TURN)
}

impl So101Adapter {
    /// Checks that the servos are those of this arm, calibrated as the blueprint says.
    fn introduce(&mut self) -> AdapterResult<()> {
        let at = self.bus.address().to_string();
        for (i, id) in (1..=SERVOS as u8).enumerate() {
            let [firmware @ .., _, m0, m1] = self.bus.read::<5>(id, 0)?;
            let model = u16::from_le_bytes([m0, m1]);
            if model != MODEL {
                let what = format!("so101 at {at}: {} is model {model}, expected {MODEL} (STS3215)", servo(id));
                return Err(AdapterError::Rejected(what));
            }
            self.firmware = (firmware[0], firmware[1]);
            let [low0, low1, high0, high1] = self.bus.read::<4>(id, register::RANGE)?;
            let found = (u16::from_le_bytes([low0, low1]), u16::from_le_bytes([high0, high1]));
            let offset = signed(u16::from_le_bytes(self.bus.read::<2>(id, register::OFFSET)?), 11);
            self.offsets.get_mut(i).into_iter().for_each(|to| *to = offset);
            let range = self.range(i);
            let same = found == (range.low as u16, range.high as u16);
            if range.offset.is_some_and(|expected| !same || offset != expected) {
                return Err(AdapterError::Rejected(format!(
                    "so101 at {at}: {} has the range {} to {} and the offset {offset}, not those of the calibration \
                     file\nhint: write the file to the servos (dimos arm calibrate so101 --restore FILE), or name another",
                    servo(id),
                    found.0,
                    found.1
                )));
            }
        }
        self.settle()?;
        self.fetch().map(drop)
    }

    /// Checks the settings that the servos keep, and writes them if the blueprint says so.
    fn settle(&mut self) -> AdapterResult<()> {
        let at = self.bus.address().to_string();
        let found = settings::check(&mut self.bus)?;
        if found.is_empty() {
            return Ok(());
        }
        if self.write_settings {
            if self.fetch()?.iter().any(|servo| servo.on) {
                let what = format!("so101 at {at}: settings cannot be written while motors are on");
                return Err(AdapterError::Rejected(format!(
                    "{what}\nhint: support the arm and switch its power off and on"
                )));
            }
            tracing::warn!("so101 at {at}: {} settings are written to the servos", found.len());
            return settings::write(&mut self.bus);
        }
        let hint = "dimos arm configure so101";
        if let Some(mode) = found.iter().find(|setting| setting.name == settings::MODE) {
            let what = format!("so101 at {at}: {} is in control mode {}, not 0 (position)", mode.motor, mode.found);
            return Err(AdapterError::Rejected(format!("{what}\nhint: {hint}")));
        }
        let list = found.iter().map(|s| format!("{}: {} is {}, not {}", s.motor, s.name, s.found, s.wanted));
        let list = list.collect::<Vec<_>>().join("; ");
        tracing::warn!("so101 at {at}: the servos have other settings ({hint} writes them): {list}");
        Ok(())
    }
}

impl JointMonitor for So101Adapter {
    /// The load is the duty cycle of the motor: the servos measure no torque.
    fn read_joint_status(&mut self, joints: &mut [JointStatus]) -> AdapterResult<()> {
        for (joint, servo) in joints.iter_mut().zip(&self.recent()?) {
            *joint = JointStatus {
                temperature: Some(servo.temperature.into()),
                current: Some(f64::from(servo.current) * AMPERE),
                voltage: Some(f64::from(servo.voltage) * 0.1),
                load: Some(f64::from(servo.load) * 1e-3),
                error: Some(servo.error.into()),
            };
        }
        Ok(())
    }

    fn read_calibration_offsets(&mut self, offsets: &mut [f64]) -> AdapterResult<bool> {
        fill(offsets, &self.offsets.map(|offset| f64::from(offset) * TAU / TURN));
        Ok(true)
    }
}

impl Gripper for So101Adapter {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        let position = self.recent()?.get(DOF).map_or(0, |servo| servo.position);
        let range = self.range(DOF);
        Ok(Some(f64::from(position - range.low) / f64::from(range.high - range.low) * GRIPPER_MAX))
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        if !(0.0..=GRIPPER_MAX).contains(&position) {
            return Err(AdapterError::Rejected(format!("the gripper opens 0 to {GRIPPER_MAX} m, not {position} m")));
        }
        let servos = self.recent()?;
        if !servos.get(DOF).is_some_and(|servo| servo.on) {
            return Err(AdapterError::Rejected("the motor of the gripper is off".into()));
        }
        let range = self.range(DOF);
        let goal = f64::from(range.low) + position / GRIPPER_MAX * f64::from(range.high - range.low);
        self.gripper_goal = Some(goal.round() as i32);
        let mut goals = servos.map(|servo| servo.goal);
        if let (Some(to), Some(goal)) = (goals.get_mut(DOF), self.gripper_goal) {
            *to = goal;
        }
        self.write_goals(goals)
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        Some((0.0, GRIPPER_MAX))
    }
}

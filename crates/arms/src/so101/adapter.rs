//! The SO-101 adapter: the adapter protocol on one side, the servos' line on the other.
//!
//! Wire: counts and counts/s. Here: rad, rad/s. One request reads the whole state of all servos;
//! [`ManipulatorAdapter::read_joints`] makes it, and what is read right after is answered from it.

use std::f64::consts::TAU;
use std::time::Duration;

use super::bus::Bus;
use super::calibration::{Calibration, Range};
use super::protocol::{SERVOS, Servo, TURN, register};
use super::seam::Seams;
use super::{DOF, HOLDS_WHEN_DISABLED, MODES, NATIVE_RATE, Options, TOP_SPEED, check, limits};
use dimos_core::arm::{Commanded, JointSet, StopPoint};
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, JointLimits, Joints, joints_of};
use dimos_hardware::adapter::{
    AdapterError, AdapterResult, Gripper, JointMonitor, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState,
    Stop,
};
use dimos_hardware::adapter_util::{fill, finite};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::service::Setting;

/// A setpoint is written if the motors were on and without error this long ago at most: the state is read once a cycle.
const WRITABLE: Duration = Duration::from_millis(50);
/// Acceleration of the servos, the highest [100 counts/s²].
const ACCELERATION: u8 = 254;
/// Slowest planned motion [counts/s]: zero would be the fastest.
const SLOWEST: f64 = 10.0;

/// An SO-101.
pub struct So101Adapter {
    pub(super) bus: Bus,
    calibration: Calibration,
    /// Whether settings with other values than wanted are written when connecting.
    pub(super) write_settings: bool,
    pub(super) firmware: (u8, u8),
    mode: ControlMode,
    /// The last state of all servos, and when it was asked for.
    pub(super) state: Option<([Servo; SERVOS], Mono)>,
    /// What was last heard of each servo.
    pub(super) heard: [Option<Servo>; SERVOS],
    /// The servos, counted from the base, that did not answer when the others did.
    pub(super) missing: JointSet,
    /// The seams of the encoders.
    pub(super) seams: Seams,
    /// The goals that servos had before they were taken back because of an overload [counts], until another setpoint.
    pub(super) relieved: [Option<i32>; SERVOS],
    /// The last goal of the gripper [counts]; `None`: the goal that its servo has.
    pub(super) gripper_goal: Option<i32>,
    /// Top speed of the gripper [counts/s]; 0 = none.
    pub(super) gripper_speed: u16,
    /// The servos' homing offsets, read when connecting [counts].
    pub(super) offsets: [i32; SERVOS],
    /// The settings with other values than wanted that the last warning listed.
    pub(super) warned: Vec<Setting>,
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
            heard: [None; SERVOS],
            missing: JointSet::NONE,
            seams: Seams::default(),
            relieved: [None; SERVOS],
            gripper_goal: None,
            gripper_speed: 0,
            offsets: [0; SERVOS],
            warned: Vec::new(),
        })
    }

    pub(super) fn range(&self, servo: usize) -> Range {
        self.calibration.0.get(servo).copied().unwrap_or(Calibration::default().0[0])
    }

    /// Writes goals of the joints with a top speed [counts/s, 0 = none]; the gripper keeps its own. A planned move has
    /// a top speed, and is written until the servos show it; after a setpoint the next one follows at once.
    fn drive(&mut self, joints: [f64; DOF], speed: u16) -> AdapterResult<()> {
        let servos = self.not_older(WRITABLE)?;
        if let Some(joint) = servos.iter().take(DOF).position(|servo| !servo.on) {
            return Err(AdapterError::Rejected(format!("the motor of joint {} is off", joint + 1)));
        }
        if let Some((code, text)) = self.error(&servos) {
            return Err(AdapterError::Fault { code, text });
        }
        self.relieved = [None; SERVOS];
        let (mut values, mut goals) = ([[0; 7]; SERVOS], servos.map(|servo| servo.goal));
        for (j, (value, goal)) in values.iter_mut().zip(&mut goals).enumerate() {
            let speed = match joints.get(j) {
                Some(angle) => {
                    *goal = self.range(j).counts(*angle).max(0);
                    speed
                }
                None => {
                    *goal = self.gripper_goal.unwrap_or(*goal).max(0);
                    self.gripper_speed
                }
            };
            let ([g0, g1], [s0, s1]) = ((*goal as u16).to_le_bytes(), speed.to_le_bytes());
            *value = [ACCELERATION, g0, g1, 0, 0, s0, s1];
        }
        if speed > 0 {
            return self.write_motion(register::ACCELERATION, values, &goals);
        }
        let seen = self.state;
        self.write(register::ACCELERATION, values)?;
        // Goals change nothing of what was measured.
        self.state = seen;
        Ok(())
    }

    /// Returns code and text of the first error.
    fn error(&self, servos: &[Servo; SERVOS]) -> Option<(i32, String)> {
        self.seams.error(|j| self.range(j)).or_else(|| self.error_of(servos))
    }

    /// Returns the positions [rad], counted over the seam.
    fn positions(&self) -> Joints {
        self.angles(|j, range| range.angle(self.seams.positions.get(j).copied().unwrap_or_default()))
    }

    fn angles(&self, of: impl Fn(usize, Range) -> f64) -> Joints {
        let mut values = [0.0; DOF];
        values.iter_mut().enumerate().for_each(|(j, value)| *value = of(j, self.range(j)));
        joints_of(&values)
    }
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
        (self.state, self.gripper_goal, self.gripper_speed) = (None, None, 0);
        (self.seams, self.relieved) = (Seams::default(), [None; SERVOS]);
        (self.heard, self.missing) = ([None; SERVOS], JointSet::NONE);
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
        self.guard_seams(&servos)?;
        fill(positions, &self.positions());
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        let servos = self.recent()?;
        fill(velocities, &self.angles(|j, _| velocity(servos.get(j))));
        Ok(true)
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let servos = self.fetch()?;
        self.guard_seams(&servos)?;
        let goal = |j, range: Range| servos.get(j).map_or(0.0, |servo| range.angle(self.seams.goal(j, servo)));
        let on = servos.iter().take(DOF).all(|servo| servo.on);
        *reading = JointReading {
            position: self.positions(),
            velocity: Some(self.angles(|j, _| velocity(servos.get(j)))),
            // Counts of absolute encoders: 0 rad is the middle of a range, not what a servo sends unmeasured.
            valid: Some(true),
            missing: JointSet::of(self.missing.iter().filter(|servo| *servo < DOF)),
            commanded: on.then(|| Commanded { position: self.angles(goal), ..Commanded::default() }),
            ..JointReading::default()
        };
        Ok(())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let servos = self.recent()?;
        let bits = |of: fn(&Servo) -> bool| servos.iter().zip(0..).map(|(s, i)| i32::from(of(s)) << i).sum::<i32>();
        Ok(RobotState { state: bits(|servo| servo.on) + (bits(|servo| servo.moving) << 8), mode: 0 })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        let servos = self.recent()?;
        Ok(self.error(&servos).unwrap_or_default())
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        Ok(self.recent()?.iter().take(DOF).all(|servo| servo.on))
    }

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        let joints = finite::<DOF>(positions)?;
        let speed = match self.mode {
            ControlMode::Position => counts_of_speed(velocity),
            _ => 0,
        };
        self.drive(joints, speed)
    }

    /// Makes the point of rest the goal of the joints; the gripper keeps its own. A motor that is off gets no goal: it
    /// might come on.
    fn write_stop(&mut self, rest: &StopPoint) -> AdapterResult<Stop> {
        let servos = self.fetch()?;
        self.gripper_goal = None;
        if let Some(position) = rest.position {
            let mut goals = servos.map(|servo| servo.goal);
            for (j, (goal, angle)) in goals.iter_mut().zip(position).enumerate().take(DOF) {
                if angle.is_finite() && !self.seams.is_crossed(j) {
                    *goal = self.range(j).counts(angle);
                }
            }
            if servos.iter().zip(goals).any(|(servo, goal)| servo.on && servo.goal != goal) {
                self.write_goals_of_enabled(&servos, goals)?;
            }
        }
        Ok(Stop::Confirmed)
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        if enable { self.enable() } else { self.write_torque(false) }
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        let servos = self.fetch()?;
        if let Some((_, text)) = self.seams.error(|j| self.range(j)) {
            return Err(AdapterError::Rejected(text));
        }
        if self.error_of(&servos).is_none() {
            return Ok(());
        }
        // An overload ends when the goal no longer asks for force, or when the motor is switched off. The other servos
        // keep their goals.
        let goals = self.relieved_goals(&servos);
        self.write_goals_of_enabled(&servos, goals)?;
        for (id, _) in self.bus.ids().zip(&servos).filter(|(_, servo)| !servo.on && servo.error != 0) {
            self.bus.write(id, register::TORQUE, &[0])?;
        }
        let servos = self.fetch()?;
        match self.error_of(&servos) {
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

/// Returns a fraction of the top speed as a servo takes it [counts/s].
pub(super) fn counts_of_speed(fraction: f64) -> u16 {
    (fraction * TOP_SPEED * TURN / TAU).max(SLOWEST) as u16
}

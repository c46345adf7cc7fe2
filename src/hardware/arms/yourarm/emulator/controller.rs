//! The emulated controller: what it does with a request. Time is passed in and nothing here knows of sockets.

use std::time::Duration;

use super::super::{GRIPPER_MAX, limits, protocol::DOF};
use super::kinematics;
use super::wire::{self, Frame, Report, Request, put_hello, put_report, reply, status};
use crate::clock::Mono;
use crate::hardware::sim::arm::Delivery;
use crate::hardware::sim::faults::{DEFAULT_STALL, Fault, FaultKind, FaultScript};
use crate::hardware::sim::gripper::Gripper;
use crate::hardware::sim::plant::{Drive, Plant, Tracking};
use crate::hardware::sim::stream;
use crate::hardware::transport::tcp::Scan;
use crate::joint::{JointLimits, Joints};

/// Pose at power-up [rad] where the options give none: not zero, so that nothing works by accident.
const INITIAL: [f64; DOF] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];
/// How far joints are behind their set points [s].
const LAG: f64 = 0.01;
/// In velocity mode the arm stops when no velocity arrives for this long [s].
const VELOCITY_TIMEOUT: f64 = 0.2;
/// Speed of the gripper [m/s].
const GRIPPER_SPEED: f64 = 0.1;
/// Positions this close to a limit count as inside: numbers on the wire are rounded [deg].
const ROUNDING: f32 = 0.001;
/// Error code of the open E-stop line.
const ESTOP: u16 = 1;
/// Most requests that are kept when recording.
const TRACE: usize = 200_000;

/// A request as it came over the wire.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Received {
    /// When.
    pub at: Mono,
    /// What, in wire units (deg, deg/s, mm, %).
    pub request: Request,
    /// The status of the reply; 0 = done.
    pub status: u8,
}

/// The controller's memory.
pub struct Controller {
    plant: Plant,
    gripper: Gripper,
    limits: JointLimits,
    mode: u8,
    error: u16,
    estop_open: bool,
    /// When the line closes by itself.
    estop_until: Option<Mono>,
    last_velocity: Mono,
    script: FaultScript,
    /// When the first client said hello: time zero of the script.
    first_hello: Option<Mono>,
    powered_up: Mono,
    advanced_to: Mono,
    trace: Option<Vec<Received>>,
    /// The last report, for the fault that shows nothing newer.
    reported: Option<Report>,
}

impl Controller {
    /// A controller that was just switched on: disabled, in position mode.
    pub fn new(initial: &[f64], faults: &[Fault], now: Mono) -> Self {
        let limits = limits();
        let initial = if initial.is_empty() { &INITIAL } else { initial };
        Self {
            plant: Plant::new(&limits, initial, Tracking::Lag(LAG), 0.0),
            gripper: Gripper::new(GRIPPER_MAX, GRIPPER_SPEED),
            limits,
            mode: 0,
            error: 0,
            estop_open: false,
            estop_until: None,
            last_velocity: now,
            script: FaultScript::new(faults),
            first_hello: None,
            powered_up: now,
            advanced_to: now,
            trace: None,
            reported: None,
        }
    }

    /// Brings the joints up to `now`.
    pub fn advance(&mut self, now: Mono) {
        if self.plant.drive() == Drive::Velocity {
            let timeout = self.last_velocity.seconds_since(self.advanced_to) + VELOCITY_TIMEOUT;
            if now.seconds_since(self.advanced_to) > timeout {
                self.plant.advance(timeout);
                self.plant.stop();
                self.advanced_to = self.advanced_to.after(Duration::from_secs_f64(timeout.max(0.0)));
            }
        }
        let dt = now.seconds_since(self.advanced_to).max(0.0);
        self.plant.advance(dt);
        self.gripper.advance(dt);
        self.advanced_to = now.max(self.advanced_to);
        if self.estop_until.is_some_and(|until| now >= until) {
            self.release_estop();
        }
    }

    /// Joint positions [rad] and velocities [rad/s].
    pub fn joints(&self) -> (Joints, Joints) {
        (self.plant.positions(), self.plant.velocities())
    }

    /// Whether the motors are on.
    pub fn enabled(&self) -> bool {
        self.plant.enabled()
    }

    /// Lets a fault happen `fault.at` seconds from now.
    pub fn inject(&mut self, fault: Fault, now: Mono) {
        self.script.inject(fault, self.script_time(now));
    }

    /// Opens the E-stop line: error, motors off.
    pub fn press_estop(&mut self) {
        self.estop_open = true;
        self.estop_until = None;
        self.error = ESTOP;
        self.plant.enable(false);
        self.gripper.stop();
    }

    /// Closes the E-stop line. Error and motors stay as they are.
    pub fn release_estop(&mut self) {
        self.estop_open = false;
        self.estop_until = None;
    }

    /// Starts recording requests, forgetting those recorded before.
    pub fn record(&mut self) {
        self.trace = Some(Vec::new());
    }

    /// What was recorded.
    pub fn trace(&self) -> Vec<Received> {
        self.trace.clone().unwrap_or_default()
    }

    /// Does what a frame asks and writes the reply into `out`.
    fn handle(&mut self, frame: &Frame, now: Mono, out: &mut Vec<u8>) -> Delivery {
        self.advance(now);
        if frame.request == Ok(Request::Hello) {
            self.first_hello.get_or_insert(now);
        }
        let t = self.script_time(now);
        self.suffer(t, now);
        let outcome = frame.request.and_then(|request| self.execute(&request, now, t));
        let status = outcome.err().unwrap_or(status::OK);
        if let (Some(trace), Ok(request)) = (&mut self.trace, frame.request)
            && trace.len() < TRACE
        {
            trace.push(Received { at: now, request, status });
        }
        match (outcome, frame.request) {
            (Ok(()), Ok(Request::Hello)) => {
                let dof = DOF as u8 + u8::from(self.script.take(FaultKind::WrongDof, t).is_some());
                let other = self.script.take(FaultKind::WrongModel, t).is_some();
                let model = if other { "YOURARM-6L" } else { "YOURARM-6" };
                reply(out, frame, status, |out| put_hello(out, model, dof, [2, 1, 3], "YA6-00042"));
            }
            (Ok(()), Ok(Request::GetState)) => {
                let report = self.report(now, t);
                reply(out, frame, status, |out| put_report(out, &report));
            }
            (Ok(()), _) => reply(out, frame, status, |_| ()),
            (Err(_), _) => reply(out, frame, status, |out| out.extend(self.error.to_le_bytes())),
        }
        self.delivery(t, now)
    }

    fn script_time(&self, now: Mono) -> f64 {
        self.first_hello.map_or(0.0, |first| now.seconds_since(first))
    }

    /// Faults of the arm itself.
    fn suffer(&mut self, t: f64, now: Mono) {
        if let Some(fault) = self.script.take(FaultKind::Estop, t) {
            self.press_estop();
            self.estop_until = fault.left(t).map(|left| now.after(left));
        }
        if let Some(fault) = self.script.take(FaultKind::ErrorCode, t) {
            self.error = fault.code;
            self.plant.stop();
        }
        let blocked = self.script.take(FaultKind::Blocked, t).map(|fault| fault.joint.saturating_sub(1));
        (0..DOF).for_each(|joint| self.plant.block(joint, blocked == Some(joint)));
    }

    /// Faults of the wire.
    fn delivery(&mut self, t: f64, now: Mono) -> Delivery {
        if let Some(fault) = self.script.take(FaultKind::PowerLoss, t) {
            let dark = fault.left(t).unwrap_or_default();
            (self.mode, self.error, self.powered_up) = (0, 0, now.after(dark));
            self.plant.enable(false);
            return Delivery::PowerLoss(dark);
        }
        if let Some(fault) = self.script.take(FaultKind::Stall, t) {
            return Delivery::Stall(fault.left(t).unwrap_or(DEFAULT_STALL));
        }
        let faults = [
            (FaultKind::Disconnect, Delivery::Disconnect),
            (FaultKind::Silent, Delivery::Silent),
            (FaultKind::Truncated, Delivery::Truncated),
            (FaultKind::Corrupt, Delivery::Corrupt),
            (FaultKind::Garbage, Delivery::Garbage),
        ];
        let struck = faults.iter().find(|(kind, _)| self.script.take(*kind, t).is_some());
        struck.map_or(Delivery::Send, |(_, delivery)| *delivery)
    }

    fn execute(&mut self, request: &Request, now: Mono, t: f64) -> Result<(), u8> {
        if request.moves() {
            self.may_move()?;
        }
        match *request {
            Request::Hello | Request::GetState => {}
            Request::SetMode(mode) if mode == self.mode => {}
            Request::SetMode(_) if self.plant.moving() => return Err(status::MOVING),
            Request::SetMode(mode) => {
                self.plant.stop();
                self.mode = mode;
            }
            Request::Enable(true) if self.error != 0 => return Err(status::IN_ERROR),
            Request::Enable(on) => {
                let wakes = on && !self.plant.enabled();
                if wakes && let Some(fault) = self.script.take(FaultKind::Sag, t) {
                    self.plant.sag(fault.amount);
                }
                self.plant.enable(on);
            }
            Request::ClearError if self.estop_open => return Err(status::IN_ERROR),
            Request::ClearError => self.error = 0,
            Request::Stop => {
                self.plant.stop();
                self.gripper.stop();
            }
            Request::MoveJoints(speed, degrees) => {
                let target = self.target(0, degrees)?;
                self.plant.move_to(&target, f64::from(speed) / 100.0);
            }
            Request::ServoJoints(degrees) => {
                let target = self.target(1, degrees)?;
                self.plant.servo(&target);
            }
            Request::VelocityJoints(degrees) => {
                self.in_mode(2)?;
                self.last_velocity = now;
                self.plant.velocity(&degrees.map(|v| f64::from(v).to_radians()));
            }
            Request::MoveCartesian(speed, [x, y, z, roll, pitch, yaw]) => {
                self.in_mode(0)?;
                let [x, y, z] = [x, y, z].map(|mm| f64::from(mm) / 1000.0);
                let [roll, pitch, yaw] = [roll, pitch, yaw].map(|deg| f64::from(deg).to_radians());
                let goal = kinematics::from_values([x, y, z, roll, pitch, yaw]);
                let joints = kinematics::inverse(&goal, &self.six()).ok_or(status::OUT_OF_RANGE)?;
                let target = self.target(0, joints.map(|v| v.to_degrees() as f32))?;
                self.plant.move_to(&target, f64::from(speed) / 100.0);
            }
            Request::Gripper(mm) => {
                let opening = f64::from(mm) / 1000.0;
                if !(0.0..=GRIPPER_MAX + 1e-6).contains(&opening) {
                    return Err(status::OUT_OF_RANGE);
                }
                self.gripper.move_to(opening);
            }
        }
        Ok(())
    }

    fn may_move(&self) -> Result<(), u8> {
        match (self.error, self.plant.enabled()) {
            (0, true) => Ok(()),
            (0, false) => Err(status::DISABLED),
            _ => Err(status::IN_ERROR),
        }
    }

    fn in_mode(&self, mode: u8) -> Result<(), u8> {
        if self.mode == mode { Ok(()) } else { Err(status::WRONG_MODE) }
    }

    /// Joint targets of a command that needs a mode [rad], inside the limits.
    fn target(&self, mode: u8, degrees: [f32; DOF]) -> Result<[f64; DOF], u8> {
        self.in_mode(mode)?;
        let range = self.limits.position_lower.iter().zip(&self.limits.position_upper);
        let inside = degrees.iter().zip(range).all(|(value, (lower, upper))| {
            (lower.to_degrees() as f32 - ROUNDING..=upper.to_degrees() as f32 + ROUNDING).contains(value)
        });
        if inside { Ok(degrees.map(|v| f64::from(v).to_radians())) } else { Err(status::OUT_OF_RANGE) }
    }

    fn six(&self) -> [f64; DOF] {
        first(&self.plant.positions())
    }

    fn report(&mut self, now: Mono, t: f64) -> Report {
        if let Some(old) = self.reported
            && self.script.take(FaultKind::Frozen, t).is_some()
        {
            return old;
        }
        let degrees = |values: &Joints| first(values).map(|v| v.to_degrees() as f32);
        let state = match (self.error, self.plant.enabled()) {
            (0, false) => 0,
            (0, true) if !self.plant.moving() => 1,
            (0, true) => 2,
            _ => 3,
        };
        let [x, y, z, roll, pitch, yaw] = kinematics::to_values(&kinematics::forward(&self.six()));
        let mut report = Report {
            time_us: now.since(self.powered_up).as_micros() as u64,
            state,
            mode: self.mode,
            enabled: self.plant.enabled(),
            estop: self.estop_open,
            error: self.error,
            joints: [
                degrees(&self.plant.positions()),
                degrees(&self.plant.velocities()),
                first(&self.plant.efforts()).map(|v| v as f32),
            ],
            gripper: (self.gripper.position * 1000.0) as f32,
            pose: [
                (x * 1000.0) as f32,
                (y * 1000.0) as f32,
                (z * 1000.0) as f32,
                roll.to_degrees() as f32,
                pitch.to_degrees() as f32,
                yaw.to_degrees() as f32,
            ],
        };
        if self.script.take(FaultKind::Nan, t).is_some() {
            report.joints = [[f32::NAN; 6]; 3];
        } else if self.script.take(FaultKind::ZeroState, t).is_some() {
            report.joints = [[0.0; 6]; 3];
        }
        self.reported = Some(report);
        report
    }
}

impl stream::Controller for Controller {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        match wire::scan(bytes) {
            Scan::More => Scan::More,
            Scan::Skip(n) => Scan::Skip(n),
            Scan::Take(n, frame) => Scan::Take(n, self.handle(&frame, now, answer)),
        }
    }

    /// The arm stops.
    fn client_gone(&mut self, now: Mono) {
        self.advance(now);
        self.plant.stop();
    }

    fn turn_away(&self, bytes: &[u8], answer: &mut Vec<u8>) {
        if let Scan::Take(_, frame) = wire::scan(bytes) {
            reply(answer, &frame, status::BUSY, |out| out.extend([0, 0]));
        }
    }
}

/// The first six of all joints.
fn first(joints: &Joints) -> [f64; DOF] {
    joints.first_chunk().copied().unwrap_or_default()
}

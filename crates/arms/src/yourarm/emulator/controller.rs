//! The emulated controller: executes requests. It consists of a [`SimArm`], a gripper and the arm's kinematics. Time is
//! passed in, and there is no I/O.

use super::super::{GRIPPER_MAX, PLAYABLE, limits, protocol::DOF};
use super::Sim;
use super::kinematics::Links;
use super::masses;
use super::wire::{
    self, Frame, Report, Request, SetpointRequest, put_drives, put_floats, put_hello, put_io, put_report, reply, status,
};
use dimos_core::arm::{Load, Setpoint};
use std::time::Duration;

use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, Joints, joints_of};
use dimos_core::pose;
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::registry::Truth;
use dimos_hardware::sim::arm::{Delivery, HasArm, Refusal, SimArm};
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::gripper::Gripper;
use dimos_hardware::sim::io::SimIo;
use dimos_hardware::sim::reach::Chain;
use dimos_hardware::sim::stream;
use dimos_hardware::sim::trace::Trace;
use dimos_hardware::transport::Scan;

/// Pose at power-up [rad] if the options give none: not zero, so that mistakes show.
const INITIAL: [f64; DOF] = [0.0, -0.3, 0.6, 0.0, 0.8, 0.0];
/// In velocity mode the arm stops when no velocity arrives for this long [s].
const VELOCITY_TIMEOUT: f64 = 0.2;
/// Speed of the gripper [m/s], its smallest and largest force, and the one at power-up [N].
const GRIPPER_SPEED: f64 = 0.1;
const GRIPPER_FORCE: std::ops::RangeInclusive<f64> = 1.0..=60.0;
const POWER_UP_FORCE: f64 = 30.0;
/// Largest load at the flange [kg].
const MAX_LOAD: f32 = 5.0;
/// Rated torque of each joint [Nm], and torque per motor current [Nm/A].
const RATED_TORQUE: [f64; DOF] = [60.0, 60.0, 40.0, 15.0, 15.0, 10.0];
const TORQUE_PER_AMPERE: f64 = 10.0;
/// Supply voltage [V].
const SUPPLY: f64 = 48.0;
/// Encoder offsets of this arm's factory calibration [deg].
const OFFSETS: [f32; DOF] = [1.5, -2.0, 0.0, 0.25, 10.0, -0.5];
/// Error of a joint that something stops.
const COLLISION: u16 = 2;
/// Error of a drive whose motor has lost its power.
const DRIVE_OFF: u16 = 7;
/// The modes, by their numbers on the wire.
const MODES: [ControlMode; 4] =
    [ControlMode::Position, ControlMode::ServoPosition, ControlMode::Velocity, ControlMode::Impedance];
/// Highest stiffness [Nm/rad] and damping [Nm·s/rad] of a setpoint.
const GAINS: [f32; 2] = [500.0, 50.0];

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
    pub(super) serial: String,
    pub(super) arm: SimArm,
    pub(super) gripper: Gripper,
    pub(super) io: SimIo,
    /// Load at the flange [kg, mm, kg·m²], and direction of gravity in the base frame.
    pub(super) load: [f32; 10],
    pub(super) gravity: [f32; 3],
    /// Requests that came over the wire.
    pub trace: Trace<Received>,
    /// The last report, for the fault `frozen`.
    reported: Option<Report>,
}

impl Controller {
    /// A controller that was just switched on: disabled, in position mode.
    pub fn new(options: &Sim, now: Mono) -> AdapterResult<Self> {
        let arm = SimArm::new("yourarm", &limits(), &options.kit().starting_at(&INITIAL), PLAYABLE, now)?;
        let arm = arm.colliding_as(COLLISION);
        let stiffness = if options.servo_stiffness > 0.0 { options.servo_stiffness } else { f64::INFINITY };
        let arm = arm.with_masses(masses::of(stiffness));
        Ok(Self {
            serial: "YA6-00042".to_owned(),
            arm: arm.with_velocity_timeout(VELOCITY_TIMEOUT),
            gripper: Gripper::new(GRIPPER_MAX, GRIPPER_SPEED).with_force(POWER_UP_FORCE),
            io: SimIo::default(),
            load: [0.0; 10],
            gravity: [0.0, 0.0, -1.0],
            trace: Trace::default(),
            reported: None,
        })
    }

    /// Executes the request of a frame and writes the reply into `out`.
    fn handle(&mut self, frame: &Frame, now: Mono, out: &mut Vec<u8>) -> Delivery {
        self.advance(now);
        if frame.request == Ok(Request::Hello) {
            self.arm.client_came();
        }
        let outcome = frame.request.and_then(|request| self.execute(&request));
        let status = outcome.err().unwrap_or(status::OK);
        if let Ok(request) = frame.request {
            self.trace.push(|| Received { at: now, request, status });
        }
        match (outcome, frame.request) {
            (Ok(()), Ok(Request::Hello)) => {
                let dof = self.arm.claimed_dof() as u8;
                let other = self.arm.take_fault(FaultKind::WrongModel).is_some();
                let model = if other { "YOURARM-6L" } else { "YOURARM-6" };
                reply(out, frame, status, |out| put_hello(out, model, dof, [2, 1, 3], &self.serial));
            }
            (Ok(()), Ok(Request::GetState(with_force))) => {
                let report = self.report();
                reply(out, frame, status, |out| put_report(out, &report, with_force));
            }
            (Ok(()), Ok(Request::GetPayload)) => reply(out, frame, status, |out| put_floats(out, &self.load)),
            (Ok(()), Ok(Request::GetMounting)) => reply(out, frame, status, |out| put_floats(out, &self.gravity)),
            (Ok(()), Ok(Request::GetOffsets)) => reply(out, frame, status, |out| put_floats(out, &OFFSETS)),
            (Ok(()), Ok(Request::GetJointStatus)) => {
                let drives = self.drives();
                reply(out, frame, status, |out| put_drives(out, drives));
            }
            (Ok(()), Ok(Request::GetIo)) => {
                let io = self.io.state();
                let volts = [io.analog_inputs, io.analog_outputs].map(|[a, b, ..]| [a as f32, b as f32]);
                let [inputs, outputs] = [io.digital_inputs, io.digital_outputs].map(|bits| bits as u16);
                reply(out, frame, status, |out| put_io(out, inputs, outputs, volts));
            }
            (Ok(()), _) => reply(out, frame, status, |_| ()),
            (Err(_), _) => reply(out, frame, status, |out| out.extend(self.arm.error().to_le_bytes())),
        }
        self.arm.delivery()
    }

    /// Executes a request; the error is the status of the reply.
    fn execute(&mut self, request: &Request) -> Result<(), u8> {
        let channel = |there: bool| if there { Ok(()) } else { Err(status::NO_CHANNEL) };
        match *request {
            Request::SetDigital(output, high) => channel(self.io.set_output(output, high)),
            Request::SetAnalog(_, volts) if !(0.0..=10.0).contains(&volts) => Err(status::OUT_OF_RANGE),
            Request::SetAnalog(output, volts) => channel(self.io.set_voltage(output, volts.into())),
            Request::SetPayload(_) | Request::SetMounting(_) if self.arm.moving() => Err(status::MOVING),
            Request::SetPayload([mass, ..]) if !(0.0..=MAX_LOAD).contains(&mass) => Err(status::OUT_OF_RANGE),
            Request::SetPayload(load) => {
                self.load = load;
                Ok(())
            }
            Request::SetMounting(gravity) if (gravity.iter().map(|v| v * v).sum::<f32>() - 1.0).abs() > 0.01 => {
                Err(status::MALFORMED)
            }
            Request::SetMounting(gravity) => {
                self.gravity = gravity;
                Ok(())
            }
            _ => self.execute_motion(request).map_err(status_of),
        }
    }

    fn execute_motion(&mut self, request: &Request) -> Result<(), Refusal> {
        let arm = &mut self.arm;
        match *request {
            Request::SetMode(mode) => arm.set_mode(MODES.get(usize::from(mode)).copied().ok_or(Refusal::WrongMode)?),
            Request::Enable(on) => arm.enable(on),
            Request::ClearError => arm.clear_error(),
            Request::Stop => {
                arm.stop();
                self.gripper.stop();
                Ok(())
            }
            Request::MoveJoints(speed, degrees) => arm.move_to(&radians(degrees), f64::from(speed) / 100.0),
            Request::ServoJoints(degrees) => arm.servo(&radians(degrees)),
            Request::VelocityJoints(degrees) => arm.velocity(&radians(degrees)),
            Request::Setpoint(setpoint) => follow(arm, &setpoint),
            Request::MoveCartesian(speed, [x, y, z, roll, pitch, yaw]) => {
                arm.may_move(ControlMode::Position)?;
                let [x, y, z] = [x, y, z].map(|mm| f64::from(mm) / 1000.0);
                let [roll, pitch, yaw] = [roll, pitch, yaw].map(|deg| f64::from(deg).to_radians());
                let goal = pose::from_xyz_rpy([x, y, z], [roll, pitch, yaw]);
                let joints = Links.inverse(&goal, &first(&arm.joints().0)).ok_or(Refusal::OutOfRange)?;
                arm.move_to(&joints, f64::from(speed) / 100.0)
            }
            Request::Gripper(mm) => self.grip(mm, POWER_UP_FORCE),
            Request::Grip(mm, newtons) => self.grip(mm, newtons.into()),
            // Read only, or handled by `execute`.
            _ => Ok(()),
        }
    }

    fn grip(&mut self, mm: f32, force: f64) -> Result<(), Refusal> {
        self.arm.ready()?;
        let opening = f64::from(mm) / 1000.0;
        if !(0.0..=GRIPPER_MAX + 1e-6).contains(&opening) || !GRIPPER_FORCE.contains(&force) {
            return Err(Refusal::OutOfRange);
        }
        self.gripper.max_force = force;
        self.gripper.move_to(opening);
        Ok(())
    }

    /// Condition of the drives: temperature [°C], current [A], voltage [V], load [%], and error.
    fn drives(&self) -> [([f32; 4], u16); DOF] {
        let any_on = (0..DOF).any(|joint| self.arm.motor(joint));
        let (mut drives, torques) = ([Default::default(); DOF], first(&self.arm.efforts()));
        for (i, (drive, (torque, rated))) in drives.iter_mut().zip(torques.into_iter().zip(RATED_TORQUE)).enumerate() {
            let load = torque / rated;
            let values = [SimArm::temperature(i) + 20.0 * load.abs(), torque / TORQUE_PER_AMPERE, SUPPLY, 100.0 * load];
            // With all motors off none has lost its power.
            let error = if any_on && !self.arm.motor(i) { DRIVE_OFF } else { 0 };
            *drive = (values.map(|v| v as f32), error);
        }
        drives
    }

    fn report(&mut self) -> Report {
        if let Some(old) = self.reported
            && self.arm.take_fault(FaultKind::Frozen).is_some()
        {
            return old;
        }
        let arm = &mut self.arm;
        let measured = arm.measured();
        let floats = |values: &Joints| first(values).map(|v| v as f32);
        let degrees = |values: &Joints| floats(&values.map(f64::to_degrees));
        let ([x, y, z], [roll, pitch, yaw]) = pose::to_xyz_rpy(&Links.forward(&first(&arm.joints().0)));
        let report = Report {
            time_us: arm.uptime().as_micros() as u64,
            state: arm.state_code(),
            mode: MODES.iter().position(|mode| *mode == arm.mode()).unwrap_or_default() as u8,
            enabled: arm.enabled(),
            estop: arm.estop_open(),
            error: arm.error(),
            joints: [degrees(&measured.positions), degrees(&measured.velocities), floats(&measured.efforts)],
            gripper: (self.gripper.position * 1000.0) as f32,
            pose: [
                (x * 1000.0) as f32,
                (y * 1000.0) as f32,
                (z * 1000.0) as f32,
                roll.to_degrees() as f32,
                pitch.to_degrees() as f32,
                yaw.to_degrees() as f32,
            ],
            force: self.gripper.force() as f32,
        };
        self.reported = Some(report);
        report
    }
}

/// Follows a setpoint in servo or impedance mode.
fn follow(arm: &mut SimArm, wire: &SetpointRequest) -> Result<(), Refusal> {
    let beyond =
        |torques: [f32; DOF]| torques.iter().zip(RATED_TORQUE).any(|(torque, most)| f64::from(torque.abs()) > most);
    let beyond_gains = wire.gains.is_some_and(|gains| {
        gains.iter().zip(GAINS).any(|(list, most)| list.iter().any(|gain| !(0.0..=most).contains(gain)))
    });
    if wire.torques.is_some_and(beyond) || beyond_gains {
        return Err(Refusal::OutOfRange);
    }
    let mode = arm.mode();
    if mode != ControlMode::ServoPosition && mode != ControlMode::Impedance {
        return Err(Refusal::WrongMode);
    }
    let joints = |list: [f32; DOF]| joints_of(&list.map(f64::from));
    let at = Mono(wire.time_us.saturating_mul(1000));
    let [stiffness, damping] = wire.gains.map_or([None, None], |gains| gains.map(|list| Some(joints(list))));
    arm.follow(&Setpoint {
        position: joints_of(&radians(wire.joints)),
        velocity: joints_of(&radians(wire.velocities)),
        acceleration: wire.accelerations.map(|list| joints_of(&radians(list))),
        effort: wire.torques.map(joints),
        stiffness,
        damping,
        mode,
        at,
        expires: (wire.valid_ms > 0).then(|| at.after(Duration::from_millis(wire.valid_ms.into()))),
    })
}

fn status_of(refusal: Refusal) -> u8 {
    match refusal {
        Refusal::Disabled => status::DISABLED,
        Refusal::WrongMode => status::WRONG_MODE,
        Refusal::Moving => status::MOVING,
        Refusal::OutOfRange => status::OUT_OF_RANGE,
        Refusal::InError => status::IN_ERROR,
    }
}

fn radians(degrees: [f32; DOF]) -> [f64; DOF] {
    degrees.map(|v| f64::from(v).to_radians())
}

impl HasArm for Controller {
    fn arm(&mut self) -> &mut SimArm {
        &mut self.arm
    }

    fn complete(&self, truth: &mut Truth) {
        truth.temperatures = Some(joints_of(&self.drives().map(|([celsius, ..], _)| celsius.into())));
        truth.gripper_position = Some(self.gripper.position);
        truth.gripper_force = Some(self.gripper.max_force);
        let [mass, x, y, z, inertia @ ..] = self.load.map(f64::from);
        truth.load = Some(Load { mass, center: [x, y, z].map(|mm| mm / 1000.0), inertia });
    }

    fn advance(&mut self, now: Mono) {
        let before = self.arm.now();
        self.arm.advance(now);
        self.io.play(&mut self.arm);
        self.gripper.play(|kind| self.arm.take_fault(kind));
        self.gripper.advance(self.arm.now().seconds_since(before));
        if self.arm.estop_open() {
            self.gripper.stop();
        }
    }
}

impl stream::Controller for Controller {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        wire::scan(bytes).map(|frame| self.handle(&frame, now, answer))
    }

    /// The arm stops.
    fn client_gone(&mut self, now: Mono) {
        self.advance(now);
        self.arm.stop();
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

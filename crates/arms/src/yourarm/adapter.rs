//! The YourArm adapter: the adapter protocol on one side, the controller's wire format on the other.
//!
//! Wire: degrees, deg/s, millimetres, Nm, one TCP connection, one reply to each command.
//! Here: rad, rad/s, m, Nm. Every conversion between the two is in this file.
//!
//! One packet of the controller holds all that is measured. [`ManipulatorAdapter::read_joints`] fetches it; what is
//! read right after (error, gripper, pose …) is answered from the same packet, so that a cycle costs one round trip.

use std::time::Duration;

use super::frame::{self, MAX_FRAME, Reply, Status};
use super::protocol::{self, Command, DOF, Hello, Mode, WireJoints};
use super::{GRIPPER_FORCE, HOLDS_WHEN_DISABLED, MODES, NATIVE_RATE, Options, check, limits};
use dimos_core::arm::{
    AnalogUnit, ControllerPose, EffortKind, IoInfo, IoState, JointSet, JointStatus, Load, Pose, Setpoint, StopPoint,
};
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_core::joint::{ControlMode, JointLimits, Joints, joints_of};
use dimos_hardware::adapter::{
    AdapterError, AdapterResult, Cartesian, Gripper, Io, JointMonitor, JointReading, ManipulatorAdapter,
    ManipulatorInfo, Payload, RobotState, Stop,
};
use dimos_hardware::adapter_util::{fault, fill, finite, within};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::transport::device_time::DeviceTime;
use dimos_hardware::transport::request_reply::{RequestReply, Retry};
use dimos_hardware::transport::tcp::{Endpoint, TcpLink};

/// Longest wait for the connection and for the controller's introduction: together below 3 s.
const CONNECT_TIMEOUT: Duration = Duration::from_millis(1500);
const HELLO: Retry = Retry::once(Duration::from_millis(1000));
/// Longest wait for the reply to an order. The controller answers within 1 ms; the rest is for a busy host.
const REPLY: Retry = Retry::once(Duration::from_millis(100));
/// Longest wait for measurements, and for the reply to a setpoint. One lost reply is asked for again, and both tries
/// together stay below `stale_after`: a single lost packet must not hold the arm.
const CYCLE: Retry = Retry { each: Duration::from_millis(22), times: 2 };
/// A packet answers further questions for one period of the controller.
const PACKET_AGE: Duration = Duration::from_millis(2);

const MM_PER_M: f64 = 1000.0;

/// A YourArm behind its controller.
pub struct YourArmAdapter {
    endpoint: Endpoint,
    options: Options,
    /// The connection, and who is at its other end.
    line: RequestReply<TcpLink>,
    hello: Option<Hello>,
    /// Number of the last command; its reply carries the same.
    sequence: u16,
    /// The last packet, and when it arrived; `Mono::ZERO`: it is outdated.
    state: protocol::State,
    state_at: Mono,
    device_time: DeviceTime,
}

impl YourArmAdapter {
    /// An adapter for the controller at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        config.check(check)?;
        Ok(Self {
            endpoint: config.parse_address(|address| Endpoint::parse(address, protocol::PORT))?,
            options: config.options()?,
            line: RequestReply::default(),
            hello: None,
            sequence: 0,
            state: protocol::State::default(),
            state_at: Mono::ZERO,
            device_time: DeviceTime::default(),
        })
    }

    /// Sends a command and waits for its reply; `decode` makes something of the reply's data.
    fn request<T>(
        &mut self,
        command: &Command,
        timeout: Retry,
        decode: impl Fn(&[u8]) -> Option<T>,
    ) -> AdapterResult<T> {
        self.sequence = self.sequence.wrapping_add(1);
        let (sequence, opcode) = (self.sequence, command.opcode());
        let mut frame = [0; MAX_FRAME];
        let frame = protocol::encode(command, sequence, &mut frame);
        self.line.request(frame, timeout, |bytes| {
            frame::scan(bytes, opcode, sequence).map(|reply| read_reply(command, &reply, &decode))
        })?
    }

    /// A command whose reply has no data. What was measured before it answers nothing after it.
    fn command(&mut self, command: &Command) -> AdapterResult<()> {
        self.state_at = Mono::ZERO;
        self.request(command, REPLY, |_| Some(()))
    }

    /// A setpoint: executing it twice is harmless, so it is sent again when its reply is lost.
    fn set_point(&mut self, command: &Command) -> AdapterResult<()> {
        self.state_at = Mono::ZERO;
        self.request(command, CYCLE, |_| Some(()))
    }

    /// Asks for a packet of measurements.
    fn fetch(&mut self) -> AdapterResult<()> {
        self.state_at = Mono::ZERO;
        self.state = self.request(&Command::GetState, CYCLE, protocol::State::decode)?;
        self.state_at = MonotonicClock.now();
        Ok(())
    }

    /// The last packet, or a new one when that is too old.
    fn recent(&mut self) -> AdapterResult<&protocol::State> {
        if !self.line.is_open() {
            return Err(AdapterError::NotConnected);
        }
        if MonotonicClock.now().since(self.state_at) > PACKET_AGE {
            self.fetch()?;
        }
        Ok(&self.state)
    }

    /// Says whether the other end is the arm that this adapter is for.
    fn verify(&self, hello: &Hello) -> AdapterResult<()> {
        let wrong = |what: String| Err(AdapterError::Rejected(format!("yourarm at {}: {what}", self.endpoint)));
        if hello.dof != DOF {
            wrong(format!("expected {DOF} joints, the controller says {}", hello.dof))
        } else if hello.model != protocol::MODEL {
            wrong(format!("expected model {}, the controller says {:?}", protocol::MODEL, hello.model))
        } else {
            Ok(())
        }
    }

    /// Speed of a planned move [%] from a fraction of the top speed.
    fn percent(&self, velocity: f64) -> f64 {
        (velocity * self.options.speed_scale * 100.0).clamp(1.0, 100.0)
    }
}

/// Turns refusals into errors and data into what they mean.
fn read_reply<T>(command: &Command, reply: &Reply<'_>, decode: impl Fn(&[u8]) -> Option<T>) -> AdapterResult<T> {
    let name = command.name();
    match reply.status {
        Status::Ok => decode(reply.data)
            .ok_or_else(|| AdapterError::Protocol(format!("yourarm: the reply to {name} is malformed"))),
        Status::Refused(protocol::IN_ERROR) => {
            let code = protocol::decode_refusal(reply.data).unwrap_or_default();
            Err(fault(code, protocol::error_text(code)))
        }
        Status::Refused(status) => {
            Err(AdapterError::Rejected(format!("yourarm refuses {name}: {}", protocol::status_text(status))))
        }
    }
}

// --- Units ---

/// Joint values of the wire [deg or deg/s] as ours [rad or rad/s].
fn from_degrees(values: &WireJoints) -> Joints {
    joints_of(&values.map(f64::to_radians))
}

/// Our joint values [rad or rad/s] as those of the wire [deg or deg/s].
fn to_degrees(values: &[f64]) -> AdapterResult<WireJoints> {
    Ok(finite(values)?.map(f64::to_degrees))
}

impl ManipulatorAdapter for YourArmAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.line.open(TcpLink::connect("yourarm", &self.endpoint, CONNECT_TIMEOUT)?);
        let introduced = self.request(&Command::Hello, HELLO, Hello::decode).and_then(|hello| {
            self.verify(&hello)?;
            self.hello = Some(hello);
            self.fetch() // so that the mode is known, and that measurements do come
        });
        if introduced.is_err() {
            self.disconnect();
        }
        introduced
    }

    fn disconnect(&mut self) {
        self.line.close();
        self.state_at = Mono::ZERO;
        self.device_time = DeviceTime::default();
    }

    fn is_connected(&self) -> bool {
        self.line.is_open()
    }

    // `activate` and `deactivate`: the default bodies do what is right here. ENABLE holds the arm where it is; STOP
    // leaves the motors on.

    // --- Identity ---

    fn get_info(&self) -> ManipulatorInfo {
        let hello = self.hello.as_ref();
        ManipulatorInfo {
            vendor: "YourVendor".into(),
            model: hello.map_or(protocol::MODEL.into(), |hello| hello.model.clone()),
            dof: DOF,
            firmware_version: hello.map(|hello| hello.firmware.map(|n| n.to_string()).join(".")),
            serial_number: hello.map(|hello| hello.serial.clone()),
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
        Ok(limits()) // the controller cannot be asked for them
    }

    // --- Mode ---

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        let wire = match mode {
            ControlMode::Position => Mode::Position,
            ControlMode::ServoPosition => Mode::Servo,
            ControlMode::Velocity => Mode::Velocity,
            ControlMode::Impedance => Mode::Impedance,
            _ => return Err(AdapterError::Unsupported),
        };
        self.command(&Command::SetMode(wire))?; // refused while the arm moves
        self.fetch()?;
        if self.state.mode == wire {
            Ok(())
        } else {
            Err(AdapterError::Protocol(format!("yourarm confirmed the mode {wire:?} but is in {:?}", self.state.mode)))
        }
    }

    fn get_control_mode(&self) -> ControlMode {
        match self.state.mode {
            Mode::Position => ControlMode::Position,
            Mode::Servo => ControlMode::ServoPosition,
            Mode::Velocity => ControlMode::Velocity,
            Mode::Impedance => ControlMode::Impedance,
        }
    }

    // --- State ---

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        self.fetch()?;
        fill(positions, &from_degrees(&self.state.positions));
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        fill(velocities, &from_degrees(&self.recent()?.velocities));
        Ok(true) // `false` if your arm does not measure them: never fill in zeros
    }

    fn read_joint_efforts(&mut self, efforts: &mut [f64]) -> AdapterResult<bool> {
        fill(efforts, &self.recent()?.torques);
        Ok(true)
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        self.fetch()?;
        *reading = JointReading {
            stamp: Some(self.device_time.translate(self.state.time_us.saturating_mul(1000), self.state_at)),
            device_ns: Some(self.state.time_us.saturating_mul(1000)),
            position: from_degrees(&self.state.positions),
            velocity: Some(from_degrees(&self.state.velocities)),
            effort: Some(joints_of(&self.state.torques)),
            effort_kind: EffortKind::Measured,
            missing: JointSet::NONE, // name the joints whose motors do not answer, if yours can be lost one by one
            valid: None,
            commanded: None,
            speed_fraction: None,
        };
        Ok(())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let state = self.recent()?;
        Ok(RobotState { state: state.state.into(), mode: state.mode as i32 })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        let code = self.recent()?.error;
        Ok((code.into(), protocol::error_text(code).into())) // an empty text allocates nothing
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        Ok(self.recent()?.enabled)
    }

    // --- Motion ---

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        let joints = to_degrees(positions)?;
        match self.get_control_mode() {
            ControlMode::Position => self.command(&Command::MoveJoints { speed: self.percent(velocity), joints }),
            ControlMode::ServoPosition => self.set_point(&Command::ServoJoints(joints)),
            mode => Err(AdapterError::Rejected(format!("joint positions in {} mode", mode.name()))),
        }
    }

    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        let joints = to_degrees(velocities)?;
        self.set_point(&Command::VelocityJoints(joints)) // the controller checks the mode
    }

    /// Passes on all that a setpoint has. What it does not have is not sent: zero would be a command.
    fn write_setpoint(&mut self, setpoint: &Setpoint) -> AdapterResult<()> {
        if setpoint.mode == ControlMode::Position {
            return self.write_joint_positions(setpoint.position.get(..DOF).unwrap_or_default(), 1.0);
        }
        let plain = |values: &Joints| finite(values.get(..DOF).unwrap_or_default());
        let degrees = |values: &Joints| to_degrees(values.get(..DOF).unwrap_or_default());
        let gains = match (&setpoint.stiffness, &setpoint.damping) {
            (Some(stiffness), Some(damping)) => Some([plain(stiffness)?, plain(damping)?]),
            _ => None,
        };
        self.set_point(&Command::Setpoint(protocol::Setpoint {
            time_us: setpoint.at.0 / 1000,
            valid_ms: setpoint.valid_for().map_or(0, |seconds| (seconds * 1000.0).ceil().clamp(1.0, 65_000.0) as u16),
            joints: [degrees(&setpoint.position)?, degrees(&setpoint.velocity)?],
            acceleration: setpoint.acceleration.as_ref().map(degrees).transpose()?,
            torque: setpoint.effort.as_ref().map(plain).transpose()?,
            gains,
        }))
    }

    fn write_stop(&mut self, _rest: &StopPoint) -> AdapterResult<Stop> {
        self.command(&Command::Stop)?;
        Ok(Stop::Confirmed) // the controller replied; where an arm cannot, answer `Sent`
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.command(&Command::Enable(enable))
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.command(&Command::ClearError)
    }

    fn discard_pending(&mut self) {
        self.line.abort(); // what the controller did not acknowledge must not reach it later
        self.disconnect();
    }

    // --- Optional parts: leave out what your arm does not have ---

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        if self.options.gripper { Some(self) } else { None }
    }

    fn cartesian(&mut self) -> Option<&mut dyn Cartesian> {
        Some(self)
    }

    fn io(&mut self) -> Option<&mut dyn Io> {
        Some(self)
    }

    fn payload(&mut self) -> Option<&mut dyn Payload> {
        Some(self)
    }

    fn joint_monitor(&mut self) -> Option<&mut dyn JointMonitor> {
        Some(self)
    }
}

impl Gripper for YourArmAdapter {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        let state = self.recent()?;
        Ok(state.gripper_fitted.then_some(state.gripper / MM_PER_M))
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        Some((0.0, super::GRIPPER_MAX))
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        self.command(&Command::Gripper(millimetres(position)?))
    }

    // The rest is for a gripper with force control.

    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        Some(GRIPPER_FORCE)
    }

    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        let opening = millimetres(position)?;
        self.command(&Command::Grip(opening, within("gripper force", force, GRIPPER_FORCE, "N")?))
    }

    fn read_gripper_force(&mut self) -> AdapterResult<Option<f64>> {
        let state = self.recent()?;
        Ok(state.gripper_fitted.then_some(state.gripper_force))
    }
}

/// Opening of the gripper [mm] from ours [m].
fn millimetres(opening: f64) -> AdapterResult<f64> {
    Ok(within("gripper opening", opening, (0.0, super::GRIPPER_MAX), "m")? * MM_PER_M)
}

impl JointMonitor for YourArmAdapter {
    fn read_joint_status(&mut self, joints: &mut [JointStatus]) -> AdapterResult<()> {
        let drives = self.request(&Command::GetJointStatus, CYCLE, protocol::decode_drives)?;
        for (joint, drive) in joints.iter_mut().zip(&drives) {
            *joint = JointStatus {
                temperature: Some(drive.temperature),
                current: Some(drive.current),
                voltage: Some(drive.voltage),
                load: Some(drive.load / 100.0),
                error: Some(drive.error.into()),
            };
        }
        Ok(())
    }

    fn read_calibration_offsets(&mut self, offsets: &mut [f64]) -> AdapterResult<bool> {
        fill(offsets, &self.request(&Command::GetOffsets, REPLY, protocol::decode_floats::<DOF>)?.map(f64::to_radians));
        Ok(true)
    }
}

impl Payload for YourArmAdapter {
    fn read_payload(&mut self) -> AdapterResult<Option<Load>> {
        let [mass, x, y, z, inertia @ ..] = self.request(&Command::GetPayload, CYCLE, protocol::decode_floats::<10>)?;
        Ok(Some(Load { mass, center: [x, y, z].map(|v| v / MM_PER_M), inertia }))
    }

    fn write_payload(&mut self, load: &Load) -> AdapterResult<()> {
        let ([x, y, z], [xx, xy, xz, yy, yz, zz]) = (load.center.map(|v| v * MM_PER_M), load.inertia);
        self.command(&Command::SetPayload([load.mass, x, y, z, xx, xy, xz, yy, yz, zz]))
    }

    fn read_mounting(&mut self) -> AdapterResult<Option<[f64; 3]>> {
        self.request(&Command::GetMounting, REPLY, protocol::decode_floats).map(Some)
    }

    fn write_mounting(&mut self, gravity: [f64; 3]) -> AdapterResult<()> {
        self.command(&Command::SetMounting(gravity))
    }
}

impl Io for YourArmAdapter {
    fn get_io(&self) -> IoInfo {
        const VOLTS: &[AnalogUnit] = &[AnalogUnit::Volt; protocol::ANALOG];
        let digital = protocol::DIGITAL;
        IoInfo { digital_inputs: digital, digital_outputs: digital, analog_inputs: VOLTS, analog_outputs: VOLTS }
    }

    fn read_io(&mut self, state: &mut IoState) -> AdapterResult<()> {
        let io = self.request(&Command::GetIo, CYCLE, protocol::Io::decode)?;
        *state = IoState::default();
        (state.digital_inputs, state.digital_outputs) = (io.digital_inputs.into(), io.digital_outputs.into());
        fill(&mut state.analog_inputs, &io.analog_inputs);
        fill(&mut state.analog_outputs, &io.analog_outputs);
        Ok(())
    }

    fn write_digital_output(&mut self, output: u8, high: bool) -> AdapterResult<()> {
        self.request(&Command::SetDigital(output, high), REPLY, |_| Some(()))
    }

    fn write_analog_output(&mut self, output: u8, value: f64) -> AdapterResult<()> {
        self.request(&Command::SetAnalog(output, value), REPLY, |_| Some(()))
    }
}

impl Cartesian for YourArmAdapter {
    fn read_cartesian_position(&mut self) -> AdapterResult<Option<ControllerPose>> {
        let [x, y, z, roll, pitch, yaw] = self.recent()?.pose;
        let flange = Pose { xyz: [x, y, z].map(|v| v / MM_PER_M), rpy: [roll, pitch, yaw].map(f64::to_radians) };
        Ok(Some(ControllerPose::of_flange(flange)))
    }

    fn write_cartesian_position(&mut self, pose: &Pose, velocity: f64) -> AdapterResult<()> {
        let ([x, y, z], [roll, pitch, yaw]) = (pose.xyz.map(|v| v * MM_PER_M), pose.rpy.map(f64::to_degrees));
        let pose = [x, y, z, roll, pitch, yaw];
        if !pose.iter().all(|value| value.is_finite()) {
            return Err(AdapterError::Rejected("the pose is not finite".into()));
        }
        self.command(&Command::MoveCartesian { speed: self.percent(velocity), pose })
    }
}

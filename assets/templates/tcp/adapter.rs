//! The Acme adapter: the adapter protocol on one side, the controller's wire format on the other.
//!
//! Wire: degrees, deg/s, Nm. Here: rad, rad/s, Nm. Every conversion between the two is in this file.
//!
//! One reply holds all that is measured. [`ManipulatorAdapter::read_joints`] fetches it; what is read right after
//! (error, enabled …) is answered from the same reply, so that a cycle costs one round trip.

use std::time::Duration;

use dimos_hardware::adapter::{
    AdapterError, AdapterResult, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};
use dimos_hardware::adapter_util::{fault, fill, finite};
use dimos_hardware::arm::StopPoint;
use dimos_hardware::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::joint::{ControlMode, JointLimits, Joints, joints_of};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::transport::device_time::DeviceTime;
use dimos_hardware::transport::request_reply::{RequestReply, Retry};

use super::protocol::{self, Command, Hello, MAX_COMMAND, Mode, State, WireJoints};
use super::wire::{self, Address, Link};
use super::{DOF, HOLDS_WHEN_DISABLED, MODES, NATIVE_RATE, Options, check, limits};

/// HELLO is retried, as the controller may just be starting. With the connection: below 3 s.
const HELLO: Retry = Retry { each: Duration::from_millis(250), times: 5 };
/// Longest wait for any other reply. YOUR ARM: several times what the controller needs.
const REPLY: Retry = Retry::once(Duration::from_millis(100));
/// Longest wait for measurements, and for the reply to a setpoint. YOUR ARM: all tries together stay below
/// `stale_after`, so that a single lost reply does not hold the arm.
const CYCLE: Retry = Retry { each: Duration::from_millis(30), times: 3 };
/// A reply answers further questions for one period of the controller.
const STATE_AGE: Duration = Duration::from_micros((1e6 / NATIVE_RATE) as u64);

/// An arm behind its controller.
pub struct AcmeAdapter {
    address: Address,
    /// The connection, and who is at its other end.
    line: RequestReply<Link>,
    hello: Option<Hello>,
    /// Number of the last command; its reply carries the same.
    number: u8,
    /// The last state, and when it arrived.
    state: Option<(State, Mono)>,
    mode: Mode,
    device_time: DeviceTime,
}

impl AcmeAdapter {
    /// An adapter for the controller at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        config.check(check)?;
        let _: Options = config.options()?; // YOUR ARM: keep those that the adapter needs
        Ok(Self {
            address: config.parse_address(wire::address)?,
            line: RequestReply::default(),
            hello: None,
            number: 0,
            state: None,
            mode: Mode::default(),
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
        self.number = self.number.wrapping_add(1);
        let (number, (opcode, name)) = (self.number, command.sheet());
        let mut frame = [0; MAX_COMMAND];
        let frame = protocol::encode(command, number, &mut frame);
        let reply = self.line.request(frame, timeout, |bytes| {
            protocol::scan(bytes, opcode, number).map(|reply| match reply.status {
                0 => Ok(decode(reply.data)),
                status => Err(status),
            })
        })?;
        let malformed = || AdapterError::Protocol(format!("acme: the reply to {name} is malformed"));
        reply.map_err(|status| self.refused(command, status))?.ok_or_else(malformed)
    }

    /// What a refusal means. The controller does not say which error it is in: the state does.
    fn refused(&mut self, command: &Command, status: u8) -> AdapterError {
        let (opcode, name) = command.sheet();
        if status == protocol::IN_ERROR
            && opcode != Command::State.sheet().0
            && let Ok(code) = self.fetch().map(|state| state.error)
        {
            return fault(code, protocol::error_text(code));
        }
        AdapterError::Rejected(format!("acme refuses {name}: {}", protocol::status_text(status)))
    }

    /// A command whose reply has no data. What was measured before it answers nothing after it.
    fn command(&mut self, command: &Command) -> AdapterResult<()> {
        self.state = None;
        self.request(command, REPLY, |_| Some(()))
    }

    /// A setpoint: executing it twice is harmless, so it is sent again when its reply is lost.
    fn set_point(&mut self, command: &Command) -> AdapterResult<()> {
        self.state = None;
        self.request(command, CYCLE, |_| Some(()))
    }

    /// Asks for what is measured.
    fn fetch(&mut self) -> AdapterResult<State> {
        self.state = None;
        let state = self.request(&Command::State, CYCLE, State::decode)?;
        self.state = Some((state, MonotonicClock.now()));
        self.mode = state.mode;
        Ok(state)
    }

    /// The last state, or a new one when that is too old.
    fn recent(&mut self) -> AdapterResult<State> {
        match self.state {
            Some((state, at)) if self.line.is_open() && MonotonicClock.now().since(at) <= STATE_AGE => Ok(state),
            _ => self.fetch(),
        }
    }

    /// Says whether the other end is the arm that this adapter is for.
    fn verify(&self, hello: &Hello) -> AdapterResult<()> {
        let wrong = |what: String| Err(AdapterError::Rejected(format!("acme at {}: {what}", self.address)));
        if hello.dof != DOF {
            wrong(format!("expected {DOF} joints, the controller says {}", hello.dof))
        } else if hello.model != protocol::MODEL {
            wrong(format!("expected model {}, the controller says {}", protocol::MODEL, hello.model))
        } else {
            Ok(())
        }
    }
}

// --- Units. YOUR ARM: other units, other signs, another order of the joints are changed here and nowhere else ---

/// Joint values of the wire [deg or deg/s] as ours [rad or rad/s].
fn from_wire(values: &WireJoints) -> Joints {
    joints_of(&values.map(f64::to_radians))
}

/// Our joint values [rad or rad/s] as those of the wire [deg or deg/s].
fn to_wire(values: &[f64]) -> AdapterResult<WireJoints> {
    Ok(finite(values)?.map(f64::to_degrees))
}

impl ManipulatorAdapter for AcmeAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.line.open(wire::connect(&self.address)?);
        let introduced = self.request(&Command::Hello, HELLO, Hello::decode).and_then(|hello| {
            self.verify(&hello)?;
            self.hello = Some(hello);
            self.fetch() // so that the mode is known, and that measurements do come
        });
        if introduced.is_err() {
            self.disconnect();
        }
        introduced.map(drop)
    }

    fn disconnect(&mut self) {
        self.line.close();
        self.state = None;
        self.device_time = DeviceTime::default();
    }

    fn is_connected(&self) -> bool {
        self.line.is_open()
    }

    // `activate` enables and `deactivate` stops: their default bodies do what is right for an arm whose ENABLE holds it
    // where it is. YOUR ARM: if it needs more (release brakes, home), write `activate`. It must not move the arm.

    // --- Identity ---

    fn get_info(&self) -> ManipulatorInfo {
        ManipulatorInfo {
            vendor: "Acme".into(), // YOUR ARM
            model: "Acme".into(),  // YOUR ARM
            dof: DOF,
            firmware_version: self.hello.map(|hello| format!("{}.{}", hello.firmware.0, hello.firmware.1)),
            serial_number: self.hello.map(|hello| hello.serial.to_string()),
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
        Ok(limits()) // YOUR ARM: ask the controller, if it knows them
    }

    // --- Mode ---

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        let wire = match mode {
            ControlMode::Position => Mode::Planned,
            ControlMode::ServoPosition => Mode::SetPoints,
            ControlMode::Velocity => Mode::Velocities,
            _ => return Err(AdapterError::Unsupported),
        };
        self.command(&Command::Mode(wire))?;
        match self.fetch()?.mode {
            now if now == wire => Ok(()),
            now => Err(AdapterError::Protocol(format!("acme confirmed the mode {wire:?} but is in {now:?}"))),
        }
    }

    fn get_control_mode(&self) -> ControlMode {
        match self.mode {
            Mode::Planned => ControlMode::Position,
            Mode::SetPoints => ControlMode::ServoPosition,
            Mode::Velocities => ControlMode::Velocity,
        }
    }

    // --- State ---

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        fill(positions, &from_wire(&self.fetch()?.positions));
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        fill(velocities, &from_wire(&self.recent()?.velocities));
        Ok(true) // YOUR ARM: leave the method out if it does not measure them; never fill in zeros
    }

    fn read_joint_efforts(&mut self, efforts: &mut [f64]) -> AdapterResult<bool> {
        fill(efforts, &self.recent()?.torques);
        Ok(true) // YOUR ARM: the same
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let state = self.fetch()?;
        let device_ns = state.time_us.saturating_mul(1000);
        *reading = JointReading {
            // YOUR ARM: `None` if the controller does not tell when it measured.
            stamp: Some(self.device_time.translate(device_ns, MonotonicClock.now())),
            device_ns: Some(device_ns),
            position: from_wire(&state.positions),
            velocity: Some(from_wire(&state.velocities)),
            effort: Some(joints_of(&state.torques)),
            valid: None,
            commanded: None,      // YOUR ARM: what the controller itself commands, if it reports that
            speed_fraction: None, // YOUR ARM: at which part of its speed the controller runs motions, if it reports that
            ..JointReading::default()  // YOUR ARM: what efforts are (`effort_kind`), motors that are lost (`missing`)
        };
        Ok(())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let state = self.recent()?;
        Ok(RobotState { state: i32::from(state.enabled) + 2 * i32::from(state.moving), mode: state.mode as i32 })
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
        let joints = to_wire(positions)?;
        match self.mode {
            Mode::Planned => self.command(&Command::Move((velocity * 100.0).clamp(1.0, 100.0), joints)),
            Mode::SetPoints => self.set_point(&Command::Servo(joints)),
            Mode::Velocities => Err(AdapterError::Rejected("joint positions in velocity mode".into())),
        }
    }

    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        self.set_point(&Command::Velocity(to_wire(velocities)?)) // the controller checks the mode
    }

    fn write_stop(&mut self, _rest: &StopPoint) -> AdapterResult<Stop> {
        self.command(&Command::Stop)?;
        Ok(Stop::Confirmed) // YOUR ARM: `Sent` if the controller does not answer
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.command(&Command::Enable(enable))
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.command(&Command::Clear)
    }

    fn discard_pending(&mut self) {
        self.line.abort(); // what the controller did not acknowledge must not reach it later
        self.disconnect();
    }

    // --- Optional parts. YOUR ARM: for a gripper, a force/torque sensor or poses add `gripper`, `force_torque` or
    // `cartesian`, which return `Some(self)`, and implement `Gripper`, `ForceTorque` or `Cartesian` ---
}

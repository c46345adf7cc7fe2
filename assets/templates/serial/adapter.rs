//! The Acme adapter: the adapter protocol on one side, the controller's wire format on the other.
//!
//! Wire: 0.001 deg, 0.001 deg/s. Here: rad, rad/s. Every conversion between the two is in this file.
//!
//! One reply holds all that is measured. [`ManipulatorAdapter::read_joints`] fetches it; what is read right after
//! (error, enabled …) is answered from the same reply, so that a cycle costs one round trip.

use std::time::Duration;

use dimos::clock::{Clock, Mono, MonotonicClock};
use dimos::hardware::registry::AdapterConfig;
use dimos::hardware::spec::{
    AdapterError, AdapterResult, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};
use dimos::hardware::transport::device_time::DeviceTime;
use dimos::hardware::transport::serial::{Scan, SerialLink};
use dimos::joint::{ControlMode, JointLimits, Joints, joints_of};

use super::protocol::{self, Command, Hello, Line, MAX_COMMAND, Mode, State, WireJoints};
use super::{DOF, HOLDS_WHEN_DISABLED, MODES, NATIVE_RATE, Options, fit, limits};

/// Longest wait for the controller's introduction, and how often it is asked for: it may just be starting. Below 3 s.
const HELLO_TIMEOUT: Duration = Duration::from_millis(250);
const HELLOS: u32 = 6;
/// Longest wait until the line takes a command.
const SEND_TIMEOUT: Duration = Duration::from_millis(100);
/// Longest wait for any other reply. YOUR ARM: several times what the controller needs.
const REPLY_TIMEOUT: Duration = Duration::from_millis(100);
/// So many replies in a row that do not come end the connection. One lost reply is not a lost arm.
const LOST_AFTER: u32 = 3;
/// After a reply that did not come, so long is listened and nothing said: it may come late, or its rest.
const QUIET: Duration = Duration::from_millis(20);
/// A reply answers further questions for one period of the controller.
const STATE_AGE: Duration = Duration::from_millis(5); // YOUR ARM: 1 / NATIVE_RATE

/// An arm behind its controller.
pub struct AcmeAdapter {
    line: Line,
    /// The open line, and who is at its other end.
    link: Option<SerialLink>,
    hello: Option<Hello>,
    /// Replies in a row that did not come.
    lost: u32,
    /// The last state, and when it arrived.
    state: Option<(State, Mono)>,
    mode: Mode,
    device_time: DeviceTime,
}

impl AcmeAdapter {
    /// An adapter for the controller at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        let rejected = |text: String| AdapterError::Rejected(format!("{}: {text}", config.hardware_id));
        config.fit(fit)?;
        let _: Options = config.options()?; // YOUR ARM: keep those that the adapter needs
        Ok(Self {
            line: Line::parse(&config.address).map_err(|e| rejected(format!("address: {e}")))?,
            link: None,
            hello: None,
            lost: 0,
            state: None,
            mode: Mode::default(),
            device_time: DeviceTime::default(),
        })
    }

    /// Sends a command and waits for its reply; `decode` makes something of the reply's data.
    fn request<T>(
        &mut self,
        command: &Command,
        timeout: Duration,
        decode: impl Fn(&[u8]) -> Option<T>,
    ) -> AdapterResult<T> {
        let link = self.link.as_mut().ok_or(AdapterError::NotConnected)?;
        let (opcode, name) = command.sheet();
        let mut frame = [0; MAX_COMMAND];
        let result = link.send(protocol::encode(command, &mut frame)).and_then(|()| {
            link.receive(timeout, |bytes| match protocol::scan(bytes, opcode) {
                Scan::More => Scan::More,
                Scan::Skip(n) => Scan::Skip(n),
                Scan::Take(n, reply) if reply.status == 0 => Scan::Take(n, Ok(decode(reply.data))),
                Scan::Take(n, reply) => Scan::Take(n, Err(reply.status)),
            })
        });
        match result {
            Ok(reply) => {
                self.lost = 0;
                let malformed = || AdapterError::Protocol(format!("acme: the reply to {name} is malformed"));
                reply.map_err(|status| self.refused(command, status))?.ok_or_else(malformed)
            }
            Err(error) => {
                self.lost += 1;
                // Replies have no number: one that came late would be taken for the answer to the next command.
                let _ = link.receive::<()>(QUIET, |bytes| Scan::Skip(bytes.len()));
                if !matches!(error, AdapterError::Timeout(_)) || self.lost >= LOST_AFTER {
                    self.disconnect();
                }
                Err(error)
            }
        }
    }

    /// What a refusal means. The controller does not say which error it is in: the state does.
    fn refused(&mut self, command: &Command, status: u8) -> AdapterError {
        let (opcode, name) = command.sheet();
        if status == protocol::IN_ERROR
            && opcode != Command::State.sheet().0
            && let Ok(code) = self.fetch().map(|state| state.error)
        {
            return AdapterError::Fault { code: code.into(), text: protocol::error_text(code).into() };
        }
        AdapterError::Rejected(format!("acme refuses {name}: {}", protocol::status_text(status)))
    }

    /// A command whose reply has no data. What was measured before it answers nothing after it.
    fn command(&mut self, command: &Command) -> AdapterResult<()> {
        self.state = None;
        self.request(command, REPLY_TIMEOUT, |_| Some(()))
    }

    /// Asks for what is measured.
    fn fetch(&mut self) -> AdapterResult<State> {
        self.state = None;
        let state = self.request(&Command::State, REPLY_TIMEOUT, State::decode)?;
        self.state = Some((state, MonotonicClock.now()));
        self.mode = state.mode;
        Ok(state)
    }

    /// The last state, or a new one when that is too old.
    fn recent(&mut self) -> AdapterResult<State> {
        match self.state {
            Some((state, at)) if self.link.is_some() && MonotonicClock.now().since(at) <= STATE_AGE => Ok(state),
            _ => self.fetch(),
        }
    }

    /// Asks the controller who it is, until it says so.
    fn introduce(&mut self) -> AdapterResult<Hello> {
        let mut answer = Err(AdapterError::NotConnected);
        for _ in 0..HELLOS {
            self.lost = 0;
            answer = self.request(&Command::Hello, HELLO_TIMEOUT, Hello::decode);
            if !matches!(answer, Err(AdapterError::Timeout(_))) {
                break;
            }
        }
        answer
    }

    /// Says whether the other end is the arm that this adapter is for.
    fn verify(&self, hello: &Hello) -> AdapterResult<()> {
        let wrong = |what: String| Err(AdapterError::Rejected(format!("acme at {}: {what}", self.line.path)));
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

/// Joint values of the wire [0.001 deg or 0.001 deg/s] as ours [rad or rad/s].
fn from_wire(values: &WireJoints) -> Joints {
    joints_of(&values.map(|value| (f64::from(value) / 1000.0).to_radians()))
}

/// Our joint values [rad or rad/s] as those of the wire [0.001 deg or 0.001 deg/s].
fn to_wire(values: &[f64]) -> AdapterResult<WireJoints> {
    match <[f64; DOF]>::try_from(values) {
        Ok(values) if values.iter().all(|value| value.is_finite()) => {
            Ok(values.map(|value| (value.to_degrees() * 1000.0).round() as i32))
        }
        _ => Err(AdapterError::Rejected(format!("{DOF} finite values are needed, one per joint"))),
    }
}

/// Copies the first values; `out` has length dof.
fn fill(out: &mut [f64], values: &[f64]) {
    out.iter_mut().zip(values).for_each(|(to, value)| *to = *value);
}

impl ManipulatorAdapter for AcmeAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.link = Some(SerialLink::connect("acme", &self.line.path, self.line.baud, SEND_TIMEOUT)?);
        let introduced = self.introduce().and_then(|hello| {
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
        self.link = None;
        self.lost = 0;
        self.state = None;
        self.device_time = DeviceTime::default();
    }

    fn is_connected(&self) -> bool {
        self.link.is_some()
    }

    // `activate` enables and `deactivate` stops: their default bodies do what is right for an arm whose ENABLE holds it
    // where it is. YOUR ARM: if it needs more (release brakes, home), write `activate`. It must not move the arm.

    // --- What it is ---

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

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let state = self.fetch()?;
        let device_ns = u64::from(state.time_ms) * 1_000_000;
        *reading = JointReading {
            // YOUR ARM: `None` if the controller does not tell when it measured.
            stamp: Some(self.device_time.translate(device_ns, MonotonicClock.now())),
            position: from_wire(&state.positions),
            velocity: Some(from_wire(&state.velocities)),
            effort: None, // YOUR ARM: its torques [Nm], if it measures them; then write `read_joint_efforts` too
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
            Mode::Planned => self.command(&Command::Move((velocity * 100.0).clamp(1.0, 100.0) as u8, joints)),
            Mode::SetPoints => self.command(&Command::Servo(joints)),
            Mode::Velocities => Err(AdapterError::Rejected("joint positions in velocity mode".into())),
        }
    }

    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        self.command(&Command::Velocity(to_wire(velocities)?)) // the controller checks the mode
    }

    fn write_stop(&mut self) -> AdapterResult<Stop> {
        self.command(&Command::Stop)?;
        Ok(Stop::Confirmed) // YOUR ARM: `Sent` if the controller does not answer
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.command(&Command::Enable(enable))
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.command(&Command::Clear)
    }

    // --- Optional parts. YOUR ARM: `read_cartesian_position`, `write_gripper_position`, `read_force_torque` … are in
    // the trait `ManipulatorAdapter`; what is not written here says "not supported" ---
}

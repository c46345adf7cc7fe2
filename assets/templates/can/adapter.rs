//! The Acme adapter: the adapter protocol on one side, the frames of the bus on the other.
//!
//! Wire: 0.001 deg, 0.001 deg/s. Here: rad, rad/s. Every conversion between the two is in this file.
//!
//! The arm streams its state, and acknowledges nothing. So [`ManipulatorAdapter::state_fd`] shows when to read,
//! every read first takes up what has arrived, and a command that must be sure waits until the state shows it.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use dimos_hardware::adapter::{
    AdapterError, AdapterResult, JointReading, ManipulatorAdapter, ManipulatorInfo, RobotState, Stop,
};
use dimos_hardware::adapter_util::{fault, fill, finite};
use dimos_hardware::arm::StopPoint;
use dimos_hardware::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::joint::{ControlMode, JointLimits, Joints, joints_of};
use dimos_hardware::registry::AdapterConfig;
use dimos_hardware::transport::can::{self, CanAddress, CanEvent, CanFrame, CanPort};

use super::protocol::{self, Control, FILTERS, Feedback, Identity, Mode, PAIRS, Status, WireJoints};
use super::{DOF, HOLDS_WHEN_DISABLED, MODES, NATIVE_RATE, Options, check, limits};

/// Longest wait for the arm's introduction, and for its first state: together below 3 s.
const CONNECT_TIMEOUT: Duration = Duration::from_millis(1200);
/// How often it is asked for its introduction.
const ASK_AGAIN: Duration = Duration::from_millis(100);
/// Longest wait until the state shows what was commanded. YOUR ARM: how long its motors take to switch on, or its brakes.
const CONFIRM_TIMEOUT: Duration = Duration::from_millis(500);
/// A powered arm is never silent for this long: reading fails. YOUR ARM: some 20 of its periods.
const STALE: Duration = Duration::from_millis(100);
/// After this silence the arm counts as lost, and is connected to again.
const LOST: Duration = Duration::from_millis(500);
/// How often is looked for what is waited for.
const LOOK: Duration = Duration::from_millis(1);

/// An arm on a bus.
pub struct AcmeAdapter {
    address: CanAddress,
    port: Option<Box<dyn CanPort>>,
    /// What waits on the bus must be out before anything new is sent.
    discarding: bool,
    identity: Option<Identity>,
    /// What has arrived of the current round of frames; a bit per pair says which of them.
    round: State,
    arrived: (u16, u16),
    /// The last whole round, and when it was complete.
    state: State,
    state_at: Mono,
}

/// A round of frames.
#[derive(Debug, Clone, Copy, Default)]
struct State {
    positions: WireJoints,
    velocities: WireJoints,
    status: Status,
}

impl AcmeAdapter {
    /// An adapter for the arm on the bus at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        config.check(check)?;
        let _: Options = config.options()?; // YOUR ARM: keep those that the adapter needs
        Ok(Self {
            address: config.parse_address(CanAddress::parse)?,
            port: None,
            discarding: false,
            identity: None,
            round: State::default(),
            arrived: (0, 0),
            state: State::default(),
            state_at: Mono::ZERO,
        })
    }

    fn port(&mut self) -> AdapterResult<&mut (dyn CanPort + 'static)> {
        self.port.as_deref_mut().ok_or(AdapterError::NotConnected)
    }

    /// Takes up all that has arrived, without waiting.
    fn take_up(&mut self) -> AdapterResult<()> {
        loop {
            match self.port()?.receive() {
                Ok(Some(CanEvent::Frame(frame))) => self.take(&frame),
                Ok(Some(CanEvent::Trouble(_))) => {} // it shows as silence
                Ok(None) => return Ok(()),
                Err(error) => {
                    self.disconnect();
                    return Err(error);
                }
            }
        }
    }

    fn take(&mut self, frame: &CanFrame) {
        let put = |joints: &mut WireJoints, number: usize, pair: [i32; 2]| {
            joints.iter_mut().skip(2 * number).zip(pair).for_each(|(joint, value)| *joint = value);
        };
        match protocol::decode(frame) {
            Some(Feedback::Positions(number, pair)) => {
                put(&mut self.round.positions, number, pair);
                self.arrived.0 |= 1 << number;
            }
            Some(Feedback::Velocities(number, pair)) => {
                put(&mut self.round.velocities, number, pair);
                self.arrived.1 |= 1 << number;
            }
            // The status ends a round. One in which frames are missing is not used.
            Some(Feedback::Status(status)) => {
                self.round.status = status;
                let all = ((1_u32 << PAIRS) - 1) as u16;
                if std::mem::take(&mut self.arrived) == (all, all) {
                    (self.state, self.state_at) = (self.round, MonotonicClock.now());
                }
            }
            Some(Feedback::Identity(identity)) => self.identity = Some(identity),
            None => {}
        }
    }

    /// The newest state. An error when the arm has been silent for too long.
    fn recent(&mut self) -> AdapterResult<State> {
        self.take_up()?;
        let silence = MonotonicClock.now().since(self.state_at);
        if silence > LOST {
            self.disconnect();
            return Err(AdapterError::Io(format!("acme at {} is silent: the connection is lost", self.address)));
        }
        if silence > STALE {
            let what = format!("acme at {} has sent no state for {} ms", self.address, silence.as_millis());
            return Err(AdapterError::Timeout(what));
        }
        Ok(self.state)
    }

    /// Hands frames to the bus.
    fn send(&mut self, frames: &[CanFrame]) -> AdapterResult<()> {
        let waiting = self.port()?.waiting();
        self.discarding &= waiting > 0;
        let sent = match self.discarding {
            true => 0,
            false => self.port()?.send(frames).inspect_err(|_| self.disconnect())?,
        };
        if sent < frames.len() {
            let what = format!("the bus of acme at {} takes no more frames: no node acknowledges them", self.address);
            return Err(AdapterError::Io(what));
        }
        Ok(())
    }

    /// Waits until `done`, taking up what arrives.
    fn wait(&mut self, timeout: Duration, what: &str, done: impl Fn(&Self) -> bool) -> AdapterResult<()> {
        let end = MonotonicClock.now().after(timeout);
        loop {
            self.take_up()?;
            if done(self) {
                return Ok(());
            }
            if MonotonicClock.now() >= end {
                return Err(AdapterError::Timeout(format!("acme at {}: {what} within {timeout:?}", self.address)));
            }
            std::thread::sleep(LOOK);
        }
    }

    /// Sends a command, and waits until a state that came after it shows that it is obeyed.
    fn command(&mut self, control: Control, done: impl Fn(&Status) -> bool) -> AdapterResult<()> {
        self.take_up()?;
        let before = self.state_at;
        self.send(&[control.encode()])?;
        let confirmed = |arm: &Self| arm.state_at > before && done(&arm.state.status);
        self.wait(CONFIRM_TIMEOUT, &format!("it does not obey {control:?}"), confirmed)
    }

    /// The arm does not say that it refuses a motion: its state does.
    fn may_move(&mut self) -> AdapterResult<()> {
        match self.recent()?.status {
            Status { error: 0, enabled: true, .. } => Ok(()),
            Status { error: 0, .. } => Err(AdapterError::Rejected("acme: the motors are off".into())),
            Status { error, .. } => Err(fault(error, protocol::error_text(error))),
        }
    }

    /// Asks the arm who it is, until it says so: it may just be starting.
    fn identify(&mut self) -> AdapterResult<()> {
        let end = MonotonicClock.now().after(CONNECT_TIMEOUT);
        loop {
            self.send(&[Control::Identify.encode()])?;
            match self.wait(ASK_AGAIN, "it does not say who it is", |arm| arm.identity.is_some()) {
                Err(AdapterError::Timeout(_)) if MonotonicClock.now() < end => {}
                result => return result,
            }
        }
    }

    /// Says whether the other end is the arm that this adapter is for.
    fn verify(&self) -> AdapterResult<()> {
        let wrong = |what: String| Err(AdapterError::Rejected(format!("acme at {}: {what}", self.address)));
        match self.identity {
            Some(Identity { dof, .. }) if dof != DOF => wrong(format!("expected {DOF} joints, the arm says {dof}")),
            Some(Identity { model, .. }) if model != protocol::MODEL => {
                wrong(format!("expected model {}, the arm says {model}", protocol::MODEL))
            }
            _ => Ok(()),
        }
    }
}

// --- Units. YOUR ARM: other units, other signs, another order of the joints are changed here and nowhere else ---

/// Joint values of the wire [0.001 deg or 0.001 deg/s] as ours [rad or rad/s].
fn from_wire(values: &WireJoints) -> Joints {
    joints_of(&values.map(|value| (f64::from(value) / 1000.0).to_radians()))
}

/// Our joint values [rad] as those of the wire [0.001 deg].
fn to_wire(values: &[f64]) -> AdapterResult<WireJoints> {
    Ok(finite(values)?.map(|value: f64| (value.to_degrees() * 1000.0).round() as i32))
}

impl ManipulatorAdapter for AcmeAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.port = Some(can::open("acme", &self.address, FILTERS)?);
        let introduced = self.identify().and_then(|()| {
            self.verify()?;
            self.wait(CONNECT_TIMEOUT, "it sends no state", |arm| arm.state_at > Mono::ZERO)
        });
        if introduced.is_err() {
            self.disconnect();
        }
        introduced
    }

    fn disconnect(&mut self) {
        (self.port, self.discarding) = (None, false);
        self.identity = None;
        self.arrived = (0, 0);
        self.state_at = Mono::ZERO;
    }

    fn is_connected(&self) -> bool {
        self.port.is_some()
    }

    // `activate` enables and `deactivate` stops: their default bodies do what is right for an arm whose motors hold it
    // where it is. YOUR ARM: if it needs more (release brakes, home), write `activate`. It must not move the arm.

    // --- Identity ---

    fn get_info(&self) -> ManipulatorInfo {
        ManipulatorInfo {
            vendor: "Acme".into(), // YOUR ARM
            model: "Acme".into(),  // YOUR ARM
            dof: DOF,
            firmware_version: self.identity.map(|who| format!("{}.{}", who.firmware.0, who.firmware.1)),
            serial_number: self.identity.map(|who| who.serial.to_string()),
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
        Ok(limits()) // YOUR ARM: ask it, if it knows them
    }

    // --- Mode ---

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        let wire = match mode {
            ControlMode::Position => Mode::Planned,
            ControlMode::ServoPosition => Mode::SetPoints,
            _ => return Err(AdapterError::Unsupported),
        };
        let status = self.recent()?.status;
        if status.moving && status.mode != wire {
            return Err(AdapterError::Rejected("acme: the arm is moving".into()));
        }
        self.command(Control::Mode(wire, 100), |status| status.mode == wire)
    }

    fn get_control_mode(&self) -> ControlMode {
        match self.state.status.mode {
            Mode::Planned => ControlMode::Position,
            Mode::SetPoints => ControlMode::ServoPosition,
        }
    }

    // --- State ---

    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        self.port.as_ref().map(|port| port.fd())
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        fill(positions, &from_wire(&self.recent()?.positions));
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        fill(velocities, &from_wire(&self.recent()?.velocities));
        Ok(true) // YOUR ARM: leave the method out if it does not measure them; never fill in zeros
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let state = self.recent()?;
        *reading = JointReading {
            stamp: Some(self.state_at), // the arm has no clock: when the round was complete
            device_ns: None,
            position: from_wire(&state.positions),
            velocity: Some(from_wire(&state.velocities)),
            effort: None, // YOUR ARM: its torques [Nm], if it measures them; then write `read_joint_efforts` too
            valid: None,
            commanded: None,      // YOUR ARM: what the controller itself commands, if it reports that
            speed_fraction: None, // YOUR ARM: at which part of its speed the controller runs motions, if it reports that
            ..JointReading::default()  // YOUR ARM: what efforts are (`effort_kind`), motors that are lost (`missing`)
        };
        Ok(())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let status = self.recent()?.status;
        Ok(RobotState { state: i32::from(status.enabled) + 2 * i32::from(status.moving), mode: status.mode as i32 })
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        let code = self.recent()?.status.error;
        Ok((code.into(), protocol::error_text(code).into())) // an empty text allocates nothing
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        Ok(self.recent()?.status.enabled)
    }

    // --- Motion ---

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        let targets = protocol::encode_targets(&to_wire(positions)?);
        self.may_move()?;
        // At most two setpoints wait for the bus.
        if self.port()?.waiting() > PAIRS {
            return Err(AdapterError::Busy);
        }
        if self.state.status.mode == Mode::Planned {
            let speed = (velocity * 100.0).clamp(1.0, 100.0) as u8;
            self.send(&[Control::Mode(Mode::Planned, speed).encode()])?;
        }
        self.send(&targets)
    }

    // This arm has no velocity mode, so `write_joint_velocities` is left out. `dimos check` reports tasks that need one.

    fn write_stop(&mut self, _rest: &StopPoint) -> AdapterResult<Stop> {
        self.send(&[Control::Stop.encode()])?;
        Ok(Stop::Sent) // nothing is acknowledged
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        match self.recent()?.status.error {
            error if enable && error != 0 => Err(fault(error, protocol::error_text(error))),
            _ => self.command(Control::Enable(enable), |status| status.enabled == enable),
        }
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        let cleared = self.command(Control::Clear, |status| status.error == 0);
        match (cleared, self.state.status.error) {
            (Err(AdapterError::Timeout(_)), error) if error != 0 => Err(fault(error, protocol::error_text(error))),
            (cleared, _) => cleared,
        }
    }

    /// Called when the states are stale. What an interface of the system does not give back goes out before anything new.
    fn discard_pending(&mut self) {
        match self.port.as_mut().map(|port| port.discard()) {
            Some(Ok(waiting)) => self.discarding = waiting > 0,
            _ => self.disconnect(),
        }
    }

    // --- Optional parts. YOUR ARM: for a gripper, a force/torque sensor or poses add `gripper`, `force_torque` or
    // `cartesian`, which return `Some(self)`, and implement `Gripper`, `ForceTorque` or `Cartesian` ---
}

//! The adapter of an arm that another process serves. SI units on both sides, so nothing is converted.
//!
//! A command goes out in a cycle request, whose reply brings the state: one round trip a tick. The reply wakes the
//! device thread ([`ManipulatorAdapter::state_fd`]), so a slow peer costs nothing but the age of its states.

use std::os::fd::BorrowedFd;
use std::time::Duration;

use super::address::Address;
use super::protocol::{Act, Command, Description, Measured, More, WirePose};
use super::session::Session;
use super::{NATIVE_RATE, USUAL_MODES, check, limits, same_modes};
use dimos_core::arm::{
    Bridging, ControllerPose, EffortKind, Field, GripperUnit, Impedance, Pose, Setpoint, SetpointFields, StopPoint,
};
use dimos_core::joint::{ControlMode, JointLimits, Joints, MAX_DOF};
use dimos_hardware::adapter::{
    AdapterError, AdapterResult, Cartesian, ForceTorque, Gripper, JointReading, ManipulatorAdapter, ManipulatorInfo,
    RobotState, Stop,
};
use dimos_hardware::adapter_util::fill;
use dimos_hardware::registry::AdapterConfig;

/// Longest wait for the motors: a vendor's SDK may take its time.
const ENABLE_TIMEOUT: Duration = Duration::from_millis(2500);
/// Longest wait for the end of commanded motion, and for errors to be cleared.
const END_TIMEOUT: Duration = Duration::from_millis(1000);

/// An arm behind a peer.
pub struct RemoteAdapter {
    address: Address,
    dof: usize,
    session: Option<Session>,
    mode: ControlMode,
    assumed_enabled: bool,
    /// Description from the peer of the last connection.
    last: Option<Description>,
}

impl RemoteAdapter {
    /// An adapter for the peer at `config.address`. Does not connect.
    pub fn new(config: &AdapterConfig) -> AdapterResult<Self> {
        config.check(check)?;
        let address = config.parse_address(Address::parse)?;
        let (mode, assumed_enabled) = (ControlMode::Position, false);
        Ok(Self { address, dof: config.dof, session: None, mode, assumed_enabled, last: None })
    }

    fn session(&mut self) -> AdapterResult<&mut Session> {
        self.session.as_mut().ok_or(AdapterError::NotConnected)
    }

    /// Calls `what` with the session; an error ends it.
    fn with<T>(&mut self, what: impl FnOnce(&mut Session) -> AdapterResult<T>) -> AdapterResult<T> {
        what(self.session()?).inspect_err(|_| self.session = None)
    }

    /// Requests an act and waits for its answer.
    fn act(&mut self, act: &Act, timeout: Duration) -> AdapterResult<()> {
        let answer = self.with(|session| session.act(act, timeout))?;
        answer.unwrap_or_else(|| {
            let peer = self.session.as_ref().map(Session::peer).unwrap_or_default();
            let text = format!("{peer} has not answered {} within {timeout:?}", act.method());
            Err(AdapterError::Timeout(text))
        })
    }

    fn late(&mut self) -> AdapterResult<Duration> {
        self.session().map(|session| session.late())
    }

    /// Returns a part of the newest state, measured after the last act.
    fn recent<T>(&mut self, of: impl FnOnce(&Measured) -> T) -> AdapterResult<T> {
        self.with(|session| session.recent().map(|state| state.map(of)))?
    }

    /// Where the efforts of the arm come from, if its peer says so.
    fn effort_kind(&self) -> Option<EffortKind> {
        self.last.as_ref()?.effort_kind
    }

    /// Whether the peer of this connection, or of the previous one, has the part.
    fn has_part(&self, name: &str) -> bool {
        self.last.as_ref().is_some_and(|description| description.parts.iter().any(|part| part == name))
    }

    /// Sends a command unless the newest state shows that the arm would refuse it.
    fn command(&mut self, mode: ControlMode, values: &[f64], velocity: f64, more: More<'_>) -> AdapterResult<()> {
        // Text cannot say what is no number.
        let whole = |list: &[f64]| list.len() == self.dof && list.iter().all(|value| value.is_finite());
        if !whole(values) || !more.lists().all(whole) {
            return Err(AdapterError::Rejected(format!("expected {} finite values, one per joint", self.dof)));
        }
        self.with(Session::take_up)?;
        let (enabled, held, error) = self.recent(|state| (state.enabled, state.held, state.error))?;
        if let Some((code @ (1.. | ..=-1), text)) = error {
            return Err(AdapterError::Fault { code, text: text.to_string() });
        }
        if held {
            return Err(AdapterError::Rejected("the arm's server process stopped the arm; enable it again".into()));
        }
        if enabled == Some(false) {
            return Err(AdapterError::Rejected("the motors are disabled".into()));
        }
        let sent = self.session()?.command(Command { mode, velocity, values, more });
        // A refusal leaves the connection as it is.
        sent.inspect_err(|error| {
            if !matches!(error, AdapterError::Rejected(_) | AdapterError::Busy) {
                self.session = None;
            }
        })
    }
}

impl ManipulatorAdapter for RemoteAdapter {
    // --- Lifecycle ---

    fn connect(&mut self) -> AdapterResult<()> {
        self.disconnect();
        self.assumed_enabled = false;
        let mut session = Session::open(&self.address, self.dof)?;
        self.mode = session.recent()??.mode.unwrap_or_default();
        session.newest()??; // requests the next state, so that its reply wakes the device thread
        self.last = Some(session.description.clone());
        self.session = Some(session);
        Ok(())
    }

    fn disconnect(&mut self) {
        self.session = None;
    }

    fn is_connected(&self) -> bool {
        self.session.is_some()
    }

    fn activate(&mut self) -> AdapterResult<()> {
        self.act(&Act::Activate, ENABLE_TIMEOUT).map(|()| self.assumed_enabled = true)
    }

    fn deactivate(&mut self, _rest: &StopPoint) -> AdapterResult<()> {
        self.act(&Act::Deactivate, END_TIMEOUT)
    }

    // --- Identity ---

    fn get_info(&self) -> ManipulatorInfo {
        let said = self.last.as_ref();
        ManipulatorInfo {
            vendor: said.map_or("unknown".into(), |d| d.info.vendor.clone()),
            model: said.map_or("remote".into(), |d| d.info.model.clone()),
            dof: self.dof,
            firmware_version: said.and_then(|d| d.info.firmware_version.clone()),
            serial_number: said.and_then(|d| d.info.serial_number.clone()),
            native_rate: said.map_or(NATIVE_RATE, |d| d.native_rate),
            modes: said.and_then(|d| d.modes.as_deref()).map_or(USUAL_MODES, same_modes),
            holds_when_disabled: said.and_then(|d| d.holds_when_disabled).unwrap_or(false),
            whole_state_at_once: true,
        }
    }

    fn get_dof(&self) -> usize {
        self.dof
    }

    fn get_limits(&mut self) -> AdapterResult<JointLimits> {
        Ok(self.last.as_ref().map_or_else(|| limits(self.dof), |d| d.limits.clone()))
    }

    fn bridging(&self) -> Option<Bridging> {
        self.last.as_ref()?.bridging()
    }

    fn setpoint_fields(&self) -> Option<SetpointFields> {
        self.last.as_ref().map(Description::setpoint_fields)
    }

    fn impedance(&self) -> Option<Impedance> {
        self.last.as_ref()?.impedance()
    }

    fn connection_warning(&self) -> Option<&'static str> {
        let said = self.last.as_ref()?;
        said.asked_rate.filter(|asked| *asked > said.native_rate)?;
        Some("its server process delivers fewer states than its --hz asks for, as it says in its own output")
    }

    // --- Mode ---

    fn set_control_mode(&mut self, mode: ControlMode) -> AdapterResult<()> {
        self.session()?;
        if !self.get_info().modes.contains(&mode) {
            return Err(AdapterError::Unsupported);
        }
        let timeout = self.late()?;
        match self.act(&Act::Mode(mode), timeout) {
            // The next command retries it; the server has continued meanwhile.
            Err(AdapterError::Timeout(text)) => Err(AdapterError::Rejected(text)),
            result => result.map(|()| self.mode = mode),
        }
    }

    fn get_control_mode(&self) -> ControlMode {
        self.mode
    }

    // --- State ---

    fn state_fd(&self) -> Option<BorrowedFd<'_>> {
        self.session.as_ref().map(Session::fd)
    }

    fn read_joint_positions(&mut self, positions: &mut [f64]) -> AdapterResult<()> {
        let values = self.with(|session| session.fresh().map(|state| state.map(|(state, _)| state.position)))??;
        fill(positions, &values.joints);
        Ok(())
    }

    fn read_joint_velocities(&mut self, velocities: &mut [f64]) -> AdapterResult<bool> {
        let values = self.recent(|state| state.velocity)?;
        fill(velocities, &values.map_or([0.0; MAX_DOF], |values| values.joints));
        Ok(values.is_some())
    }

    fn read_joint_efforts(&mut self, efforts: &mut [f64]) -> AdapterResult<bool> {
        let values = self.recent(|state| state.effort)?;
        fill(efforts, &values.map_or([0.0; MAX_DOF], |values| values.joints));
        Ok(values.is_some())
    }

    fn read_joints(&mut self, reading: &mut JointReading) -> AdapterResult<()> {
        let (state, stamp) =
            self.with(|session| session.newest().map(|s| s.map(|(state, stamp)| (*state, stamp))))??;
        if self.session()?.after_last_act() {
            self.mode = state.mode.unwrap_or(self.mode);
        }
        *reading = JointReading {
            stamp: Some(stamp),
            device_ns: state.device_time,
            position: state.position.joints,
            velocity: state.velocity.map(|values| values.joints),
            effort: state.effort.map(|values| values.joints),
            effort_kind: self.effort_kind().filter(|_| state.effort.is_some()).unwrap_or_default(),
            missing: state.lost(),
            ..JointReading::default()
        };
        Ok(())
    }

    fn read_state(&mut self) -> AdapterResult<RobotState> {
        let codes = self.recent(|state| state.codes)?;
        Ok(codes.map_or(RobotState::default(), |codes| RobotState { state: codes.state, mode: codes.mode }))
    }

    fn read_error(&mut self) -> AdapterResult<(i32, String)> {
        self.recent(|state| match state.error {
            None | Some((0, _)) => (0, String::new()),
            Some((code, text)) => (code, text.to_string()),
        })
    }

    fn read_enabled(&mut self) -> AdapterResult<bool> {
        // An arm that does not report it counts as last commanded. One that its peer holds accepts no command, as if
        // its motors were off.
        let assumed = self.assumed_enabled;
        self.recent(|state| state.enabled.unwrap_or(assumed) && !state.held)
    }

    // --- Motion ---

    fn write_joint_positions(&mut self, positions: &[f64], velocity: f64) -> AdapterResult<()> {
        let mode = self.mode;
        if matches!(mode, ControlMode::Velocity | ControlMode::Impedance) && self.session.is_some() {
            return Err(AdapterError::Rejected(format!("joint positions in {} mode", mode.name())));
        }
        self.command(mode, positions, velocity, More::default())
    }

    /// Passes on what the peer takes of the setpoint.
    fn write_setpoint(&mut self, setpoint: &Setpoint) -> AdapterResult<()> {
        let (fields, dof, mode) = (self.setpoint_fields().unwrap_or_default(), self.dof, self.mode);
        if mode != setpoint.mode && self.session.is_some() {
            let what = format!("a setpoint for {} in {} mode", setpoint.mode.name(), mode.name());
            return Err(AdapterError::Rejected(what));
        }
        fn list(field: Field, of: Option<&Joints>, dof: usize) -> Option<&[f64]> {
            of.filter(|_| field.is_taken())?.get(..dof)
        }
        let more = More {
            velocities: list(fields.velocity, Some(&setpoint.velocity), dof),
            accelerations: list(fields.acceleration, setpoint.acceleration.as_ref(), dof),
            efforts: list(fields.effort, setpoint.effort.as_ref(), dof),
            stiffness: list(fields.stiffness, setpoint.stiffness.as_ref(), dof),
            damping: list(fields.damping, setpoint.damping.as_ref(), dof),
            at: fields.at.is_taken().then_some(setpoint.at.0),
            valid: setpoint.valid_for().filter(|_| fields.expires.is_taken()),
        };
        self.command(mode, setpoint.position.get(..dof).unwrap_or_default(), 1.0, more)
    }

    fn write_joint_velocities(&mut self, velocities: &[f64]) -> AdapterResult<()> {
        let mode = self.mode;
        self.session()?;
        if !self.get_info().modes.contains(&ControlMode::Velocity) {
            return Err(AdapterError::Unsupported);
        }
        if mode != ControlMode::Velocity {
            return Err(AdapterError::Rejected(format!("joint velocities in {} mode", mode.name())));
        }
        self.command(mode, velocities, 1.0, More::default())
    }

    fn write_stop(&mut self, rest: &StopPoint) -> AdapterResult<Stop> {
        let timeout = self.late()?;
        // An older peer would refuse a stop with an argument; text cannot say what is no number.
        let takes = self.last.as_ref().is_some_and(|described| described.stop_point);
        let finite = |position: &Joints| position.iter().take(self.dof).all(|angle| angle.is_finite());
        let known = rest.position.filter(|position| takes && finite(position));
        let positions = known.map_or(Vec::new(), |position| position.iter().take(self.dof).copied().collect());
        self.act(&Act::Stop(positions), timeout).map(|()| Stop::Confirmed)
    }

    fn write_enable(&mut self, enable: bool) -> AdapterResult<()> {
        self.act(&Act::Enable(enable), ENABLE_TIMEOUT).map(|()| self.assumed_enabled = enable)
    }

    fn write_clear_errors(&mut self) -> AdapterResult<()> {
        self.act(&Act::ClearErrors, END_TIMEOUT)
    }

    fn set_point_period(&self) -> Option<Duration> {
        // A setpoint waits for the answer to the one before, and the peer answers once a cycle.
        self.last.as_ref().map(|said| Duration::from_secs_f64(1.0 / said.native_rate.max(0.1)))
    }

    fn discard_pending(&mut self) {
        if let Some(session) = self.session.take() {
            session.abort();
        }
    }

    // --- Optional parts ---

    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        if self.has_part("read_gripper_position") { Some(self) } else { None }
    }

    // A sensor may be switched on while the arm runs; `parts` lists what answered when the connection began.
    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        Some(self)
    }

    fn cartesian(&mut self) -> Option<&mut dyn Cartesian> {
        if self.has_part("read_cartesian_position") { Some(self) } else { None }
    }
}

impl Gripper for RemoteAdapter {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        self.recent(|state| state.gripper)
    }

    fn get_gripper_unit(&self) -> GripperUnit {
        self.last.as_ref().and_then(|described| described.gripper_unit).unwrap_or_default()
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        self.last.as_ref()?.gripper_range
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        let timeout = self.late()?;
        if !position.is_finite() {
            return Err(AdapterError::Rejected(format!("a gripper position of {position}")));
        }
        self.act(&Act::Gripper(position), timeout)
    }
}

impl ForceTorque for RemoteAdapter {
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        self.recent(|state| state.wrench)
    }
}

impl Cartesian for RemoteAdapter {
    fn read_cartesian_position(&mut self) -> AdapterResult<Option<ControllerPose>> {
        self.recent(|state| state.pose.map(|pose| ControllerPose::of_flange(pose.pose())))
    }

    fn write_cartesian_position(&mut self, pose: &Pose, velocity: f64) -> AdapterResult<()> {
        let timeout = self.late()?;
        if !pose.xyz.iter().chain(&pose.rpy).all(|value| value.is_finite()) {
            return Err(AdapterError::Rejected("the pose is not finite".into()));
        }
        self.act(&Act::Cartesian(WirePose::of(pose), velocity), timeout)
    }
}

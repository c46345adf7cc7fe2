//! What a peer does with a request: one method of the adapter it serves, or one cycle of them.

use std::time::{Duration, Instant};

use serde_json::{Map, Value, json};

use super::wire::{Command, Request};
use crate::arm::Pose;
use crate::clock::{Clock, MonotonicClock};
use crate::hardware::sim::faults::{Fault, FaultKind, FaultScript};
use crate::hardware::spec::{AdapterError, AdapterResult, JointReading, ManipulatorAdapter};
use crate::joint::{ControlMode, JointLimits, Joints};

/// The error code of the open E-stop line, as it is played.
const ESTOP: i32 = 1;
/// The modes that the protocol knows.
const MODES: [ControlMode; 3] = [ControlMode::Position, ControlMode::ServoPosition, ControlMode::Velocity];

/// The adapter that is served, and what stands between it and the client.
pub struct Service {
    adapter: Box<dyn ManipulatorAdapter>,
    holds_when_disabled: Option<bool>,
    /// Why no command is taken before the arm is enabled anew.
    held: Option<&'static str>,
    /// Commands have come since the last stop.
    commanded: bool,
    /// The error that is played, and until when it cannot be cleared.
    error: i32,
    error_until: Instant,
    /// The reading that is repeated, while that is played.
    frozen: Option<JointReading>,
    script: FaultScript,
    first_hello: Option<Instant>,
}

impl Service {
    /// Serves `adapter`. `holds_when_disabled` replaces what it says of itself; `faults` go wrong on the way.
    pub fn new(adapter: Box<dyn ManipulatorAdapter>, holds_when_disabled: Option<bool>, faults: &[Fault]) -> Self {
        Self {
            adapter,
            holds_when_disabled,
            held: None,
            commanded: false,
            error: 0,
            error_until: Instant::now(),
            frozen: None,
            script: FaultScript::new(faults),
            first_hello: None,
        }
    }

    fn script_time(&self) -> f64 {
        self.first_hello.map_or(0.0, |first| first.elapsed().as_secs_f64())
    }

    /// Lets a fault happen `fault.at` seconds from now.
    pub fn inject(&mut self, fault: Fault) {
        let now = self.script_time();
        self.script.inject(fault, now);
    }

    /// The fault of this kind that strikes now, and how long it still lasts.
    pub fn strikes(&mut self, kind: FaultKind) -> Option<Duration> {
        let now = self.script_time();
        self.script.take(kind, now).map(|fault| fault.left(now).unwrap_or_default())
    }

    /// Whether commands have come since the last stop.
    pub fn commanded(&self) -> bool {
        self.commanded
    }

    /// Stops the arm because nobody commands it any more. From then on it has to be enabled anew.
    pub fn stop_by_itself(&mut self, why: &'static str) {
        // One that fails is tried again: `commanded` stays.
        self.commanded &= self.adapter.write_stop().is_err();
        self.held = Some(why);
    }

    /// Ends the service: stops what is commanded.
    pub fn end(&mut self) {
        if self.commanded {
            self.stop_by_itself("the peer has ended");
        }
        self.adapter.disconnect();
    }

    /// Does what is asked; answers the content of the reply.
    pub fn answer(&mut self, request: &Request) -> AdapterResult<Map<String, Value>> {
        self.play();
        let content = match request.what.as_str() {
            "hello" => self.hello()?,
            "cycle" => self.cycle(request.command.as_ref())?,
            method => self.act(method, &request.arguments).map(|()| json!({}))?,
        };
        Ok(content.as_object().cloned().unwrap_or_default())
    }

    fn hello(&mut self) -> AdapterResult<Value> {
        self.first_hello.get_or_insert_with(Instant::now);
        if !self.adapter.is_connected() {
            self.adapter.connect()?;
        }
        self.held = Some("it has to be enabled first");
        let (info, limits) = (self.adapter.get_info(), self.adapter.get_limits()?);
        let gripper = self.adapter.read_gripper_position()?.map(|_| "read_gripper_position");
        let pose = self.adapter.read_cartesian_position()?.map(|_| "read_cartesian_position");
        let dof = info.dof + usize::from(self.strikes(FaultKind::WrongDof).is_some());
        Ok(json!({
            "version": 1,
            "dof": dof,
            "info": {
                "vendor": info.vendor,
                "model": info.model,
                "firmware_version": info.firmware_version,
                "serial_number": info.serial_number,
            },
            "native_rate": info.native_rate,
            "modes": info.modes.iter().filter(|mode| MODES.contains(mode)).collect::<Vec<_>>(),
            "holds_when_disabled": self.holds_when_disabled.unwrap_or(info.holds_when_disabled),
            "limits": lists(&limits, dof),
            "gripper_range": self.adapter.get_gripper_range(),
            "parts": gripper.into_iter().chain(pose).collect::<Vec<_>>(),
        }))
    }

    fn act(&mut self, method: &str, arguments: &[Value]) -> AdapterResult<()> {
        let first = arguments.first().cloned().unwrap_or_default();
        let malformed = || AdapterError::Protocol(format!("{method} cannot be called with {arguments:?}"));
        match method {
            "activate" => self.enabling(true, |adapter| adapter.activate()),
            "write_enable" => {
                let on = first.as_bool().ok_or_else(malformed)?;
                self.enabling(on, |adapter| adapter.write_enable(on))
            }
            "deactivate" => {
                self.commanded = false;
                self.adapter.deactivate()
            }
            "write_stop" => self.adapter.write_stop().map(|_| self.commanded = false),
            "set_control_mode" => {
                self.adapter.set_control_mode(serde_json::from_value(first).map_err(|_| malformed())?)
            }
            "write_clear_errors" if self.error != 0 && Instant::now() < self.error_until => Err(self.fault()),
            "write_clear_errors" => {
                self.error = 0;
                self.adapter.write_clear_errors()
            }
            "write_gripper_position" => {
                self.may_move()?;
                self.adapter.write_gripper_position(first.as_f64().ok_or_else(malformed)?)
            }
            "write_cartesian_position" => {
                let axis = |name| first.get(name).and_then(Value::as_f64).ok_or_else(malformed);
                let velocity = arguments.get(1).and_then(Value::as_f64).ok_or_else(malformed)?;
                let (xyz, rpy) = ([axis("x")?, axis("y")?, axis("z")?], [axis("roll")?, axis("pitch")?, axis("yaw")?]);
                self.may_move()?;
                self.commanded = true;
                self.adapter.write_cartesian_position(&Pose { xyz, rpy }, velocity)
            }
            _ => Err(AdapterError::Protocol(format!("nothing is known here of {method:?}"))),
        }
    }

    fn enabling(
        &mut self,
        on: bool,
        enable: impl FnOnce(&mut dyn ManipulatorAdapter) -> AdapterResult<()>,
    ) -> AdapterResult<()> {
        if on && self.error != 0 {
            return Err(self.fault());
        }
        enable(&mut *self.adapter)?;
        if on {
            self.held = None;
        } else {
            self.commanded = false;
        }
        Ok(())
    }

    fn fault(&self) -> AdapterError {
        AdapterError::Fault { code: self.error, text: self.error_text() }
    }

    fn error_text(&self) -> String {
        match self.error {
            0 => String::new(),
            ESTOP => "E-stop line open".to_owned(),
            code => format!("scripted error {code}"),
        }
    }

    fn may_move(&self) -> AdapterResult<()> {
        match self.held {
            _ if self.error != 0 => Err(self.fault()),
            Some(why) => Err(AdapterError::Rejected(why.to_owned())),
            None => Ok(()),
        }
    }

    /// A cycle: the command, then the reading.
    fn cycle(&mut self, command: Option<&Command>) -> AdapterResult<Value> {
        let refused = command.and_then(|command| self.command(command).err());
        let mut reading = JointReading::default();
        self.adapter.read_joints(&mut reading)?;
        if self.strikes(FaultKind::Nan).is_some() || !reading.position.iter().all(|v| v.is_finite()) {
            return Err(AdapterError::Protocol("the position of a joint is not a number".to_owned()));
        }
        if self.strikes(FaultKind::Frozen).is_some() {
            reading = *self.frozen.get_or_insert(reading);
        } else {
            self.frozen = None;
        }
        let own = self.adapter.read_error()?;
        let (code, text) = if self.error == 0 { own } else { (self.error, self.error_text()) };
        let codes = self.adapter.read_state()?;
        let dof = self.adapter.get_dof();
        let joints = |values: &Joints| values.iter().take(dof).copied().collect::<Vec<f64>>();
        let pose = self.adapter.read_cartesian_position()?;
        Ok(json!({
            "state": {
                "time": reading.stamp.unwrap_or_else(|| MonotonicClock.now()).0,
                "read_joint_positions": joints(&reading.position),
                "read_joint_velocities": reading.velocity.as_ref().map(joints),
                "read_joint_efforts": reading.effort.as_ref().map(joints),
                "read_enabled": self.adapter.read_enabled()?,
                "held": self.held.is_some(),
                "read_error": [json!(code), json!(text)],
                "read_state": { "state": codes.state, "mode": codes.mode },
                "get_control_mode": self.adapter.get_control_mode(),
                "read_gripper_position": self.adapter.read_gripper_position()?,
                "read_cartesian_position": pose.map(|Pose { xyz: [x, y, z], rpy: [roll, pitch, yaw] }| {
                    json!({ "x": x, "y": y, "z": z, "roll": roll, "pitch": pitch, "yaw": yaw })
                }),
                "read_force_torque": self.adapter.read_force_torque()?,
            },
            "refused": refused.map(|error| error.to_string()),
        }))
    }

    fn command(&mut self, command: &Command) -> AdapterResult<()> {
        self.may_move()?;
        let mode = self.adapter.get_control_mode();
        if mode.name() != command.mode {
            return Err(AdapterError::Rejected(format!("a command for {} in {} mode", command.mode, mode.name())));
        }
        self.commanded = true;
        match mode {
            ControlMode::Velocity => self.adapter.write_joint_velocities(&command.values),
            _ => self.adapter.write_joint_positions(&command.values, command.velocity),
        }
    }

    /// Lets the arm's own faults happen.
    fn play(&mut self) {
        let now = self.script_time();
        if let Some(fault) = self.script.take(FaultKind::ErrorCode, now) {
            self.error = i32::from(fault.code);
            let _ = self.adapter.write_stop();
        }
        if let Some(fault) = self.script.take(FaultKind::Estop, now) {
            self.error = ESTOP;
            self.error_until = Instant::now() + fault.left(now).unwrap_or(Duration::from_secs(1_000_000));
            let _ = self.adapter.write_stop();
            let _ = self.adapter.write_enable(false);
        }
    }
}

/// Limits as JSON, for an arm that says it has `dof` joints.
fn lists(limits: &JointLimits, dof: usize) -> Value {
    let mut limits = limits.clone();
    for list in [
        &mut limits.position_lower,
        &mut limits.position_upper,
        &mut limits.velocity_max,
        &mut limits.acceleration_max,
        &mut limits.jerk_max,
    ] {
        if let Some(last) = list.last().copied() {
            list.resize(dof, last);
        }
    }
    json!(limits)
}

//! Executes requests: a method of an adapter, or a cycle. The arm is a [`SimArm`].

use serde_json::{Map, Value, json};

use super::super::{MODES, NATIVE_RATE, SPEC, USUAL_MODES};
use super::wire::{self, Command, Request};
use super::{PLAYABLE, SILENCE_TIMEOUT};
use dimos_core::arm::{AfterGap, EffortKind, Setpoint, SetpointFields};
use dimos_core::clock::Mono;
use dimos_core::joint::{ControlMode, JointLimits, Joints, joints_of};
use dimos_hardware::adapter::{AdapterError, AdapterResult};
use dimos_hardware::registry::Truth;
use dimos_hardware::sim::arm::{Delivery, HasArm, Measured, SimArm, SimOptions};
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::gripper::Gripper;
use dimos_hardware::sim::stream;
use dimos_hardware::transport::Scan;

/// Highest acceleration [rad/s²] and jerk [rad/s³] of every joint.
const ACCELERATION: f64 = 10.0;
const JERK: f64 = 100.0;
/// Stiffness [Nm/rad] and damping [Nm·s/rad] with which it is held in impedance mode, and the highest of both.
const STIFFNESS: (f64, f64) = (100.0, 1000.0);
const DAMPING: (f64, f64) = (5.0, 100.0);
/// Widest opening of the gripper [m], and its speed [m/s].
const GRIPPER: (f64, f64) = (0.08, 0.1);

/// The server and its arm.
pub struct Controller {
    arm: SimArm,
    limits: JointLimits,
    /// How long it bridges a gap in its commands before it decelerates; 0: it goes to its last setpoint [s].
    gap_tolerance: f64,
    gripper: Gripper,
    /// Why commands are refused until the arm is enabled again.
    held: Option<&'static str>,
    /// Commands have come since the last stop.
    commanded: bool,
    /// When the last request was answered.
    heard: Mono,
    /// The last measurement, for the fault `frozen`.
    measured: Option<(Mono, Measured)>,
}

impl Controller {
    /// An arm with these position and velocity limits that was just switched on; at zero where the options give no
    /// pose.
    pub fn new(limits: &JointLimits, options: &SimOptions, now: Mono) -> AdapterResult<Self> {
        let dof = limits.position_lower.len();
        let limits =
            JointLimits { acceleration_max: vec![ACCELERATION; dof], jerk_max: vec![JERK; dof], ..limits.clone() };
        let options = options.clone().starting_at(&vec![0.0; dof]);
        Ok(Self {
            arm: SimArm::new("remote", &limits, &options, PLAYABLE, now)?,
            limits,
            gap_tolerance: options.controller.gap_tolerance,
            gripper: Gripper::new(GRIPPER.0, GRIPPER.1),
            held: None,
            commanded: false,
            heard: now,
            measured: None,
        })
    }

    fn integrate(&mut self, now: Mono) {
        let before = self.arm.now();
        self.arm.integrate(now);
        self.gripper.play(|kind| self.arm.take_fault(kind));
        self.gripper.advance(self.arm.now().seconds_since(before));
    }

    /// Stops an arm that is no longer commanded. It must then be enabled again.
    fn stop_unasked(&mut self, why: &'static str) {
        self.stop();
        self.held = Some(why);
    }

    fn stop(&mut self) {
        self.commanded = false;
        self.arm.stop();
        self.gripper.stop();
    }

    /// Executes a request; returns the content of the reply.
    fn answer(&mut self, request: &Request) -> AdapterResult<Map<String, Value>> {
        let content = match request.what.as_str() {
            "hello" => self.hello(request.version.unwrap_or(1)),
            "cycle" => self.cycle(request.command.as_ref())?,
            method => self.act(method, &request.arguments).map(|()| json!({}))?,
        };
        Ok(content.as_object().cloned().unwrap_or_default())
    }

    /// The description, in the client's version if that is older.
    fn hello(&mut self, version: u64) -> Value {
        self.arm.client_came();
        self.held = Some("it has to be enabled first");
        let (dof, gap_tolerance) = (self.arm.claimed_dof(), self.gap_tolerance);
        let each = |value: f64| vec![value; dof];
        let fields: Vec<&str> = SetpointFields::ALL.named().iter().map(|(name, _)| *name).collect();
        json!({
            "version": version.min(2),
            "dof": dof,
            "fields": fields,
            "impedance": { "stiffness": each(STIFFNESS.0), "damping": each(DAMPING.0),
                "stiffness_max": each(STIFFNESS.1), "damping_max": each(DAMPING.1) },
            "effort_kind": EffortKind::Measured,
            "info": { "vendor": "dimos", "model": "simulated", "firmware_version": null, "serial_number": null },
            "native_rate": NATIVE_RATE,
            "modes": if version < 2 { USUAL_MODES } else { MODES },
            "holds_when_disabled": SPEC.holds_when_disabled,
            "limits": lists(&self.limits, dof),
            "gripper_range": [0.0, GRIPPER.0],
            "stop_point": true,
            "gap_tolerance": gap_tolerance,
            "after_gap": if gap_tolerance > 0.0 { AfterGap::Decelerates } else { AfterGap::RestsAtSetpoint },
            "parts": ["read_gripper_position"],
        })
    }

    fn act(&mut self, method: &str, arguments: &[Value]) -> AdapterResult<()> {
        let first = arguments.first().cloned().unwrap_or_default();
        let malformed = || AdapterError::Protocol(format!("{method} cannot be called with {arguments:?}"));
        match method {
            "activate" => self.enable(true),
            "write_enable" => self.enable(first.as_bool().ok_or_else(malformed)?),
            "deactivate" | "write_stop" => {
                self.stop();
                Ok(())
            }
            "set_control_mode" => {
                let mode = serde_json::from_value(first).map_err(|_| malformed())?;
                let known = MODES.contains(&mode).then_some(mode).ok_or(AdapterError::Unsupported)?;
                self.arm.set_mode(known).map_err(|refusal| self.arm.rejected(refusal))
            }
            "write_clear_errors" => self.arm.clear_error().map_err(|refusal| self.arm.rejected(refusal)),
            "write_gripper_position" => {
                self.may_move()?;
                self.arm.ready().map_err(|refusal| self.arm.rejected(refusal))?;
                let opening = first.as_f64().ok_or_else(malformed)?;
                if !(0.0..=GRIPPER.0).contains(&opening) {
                    let what = format!("gripper opening {opening} m is not within 0 to {} m", GRIPPER.0);
                    return Err(AdapterError::Rejected(what));
                }
                self.gripper.move_to(opening);
                Ok(())
            }
            "write_cartesian_position" => Err(AdapterError::Unsupported),
            _ => Err(AdapterError::Protocol(format!("unknown request {method:?}"))),
        }
    }

    fn enable(&mut self, on: bool) -> AdapterResult<()> {
        self.arm.enable(on).map_err(|refusal| self.arm.rejected(refusal))?;
        if on {
            self.held = None;
        } else {
            self.commanded = false;
        }
        Ok(())
    }

    fn may_move(&self) -> AdapterResult<()> {
        match self.held {
            _ if self.arm.error() != 0 => Err(self.arm.fault()),
            Some(why) => Err(AdapterError::Rejected(why.to_owned())),
            None => Ok(()),
        }
    }

    /// A cycle: the command, then the reading.
    fn cycle(&mut self, command: Option<&Command>) -> AdapterResult<Value> {
        let refused = command.and_then(|command| self.command(command).err());
        let (time, measured) = self.measure();
        if !measured.positions.iter().all(|value| value.is_finite()) {
            return Err(AdapterError::Protocol("the position of a joint is not a number".to_owned()));
        }
        let arm = &self.arm;
        let joints = |values: &Joints| values.iter().take(arm.dof()).copied().collect::<Vec<f64>>();
        Ok(json!({
            "state": {
                "time": time.0,
                "read_joint_positions": joints(&measured.positions),
                "read_joint_velocities": joints(&measured.velocities),
                "read_joint_efforts": joints(&measured.efforts),
                "read_enabled": arm.enabled(),
                "held": self.held.is_some(),
                "read_error": [json!(arm.error()), json!(arm.error_text())],
                "read_state": { "state": arm.state_code(), "mode": MODES.iter().position(|mode| *mode == arm.mode()) },
                "get_control_mode": arm.mode(),
                "read_gripper_position": self.gripper.position,
                "read_cartesian_position": null,
                "read_force_torque": null,
            },
            "refused": refused.map(|error| error.to_string()),
        }))
    }

    /// A measurement and its time.
    fn measure(&mut self) -> (Mono, Measured) {
        if let Some(old) = self.measured
            && self.arm.take_fault(FaultKind::Frozen).is_some()
        {
            return old;
        }
        *self.measured.insert((self.arm.now(), self.arm.measured()))
    }

    fn command(&mut self, command: &Command) -> AdapterResult<()> {
        self.may_move()?;
        let (mode, values, dof) = (self.arm.mode(), &command.values, self.arm.dof());
        if mode.name() != command.mode {
            return Err(AdapterError::Rejected(format!("a command for {} in {} mode", command.mode, mode.name())));
        }
        if values.len() != dof || !values.iter().all(|value| value.is_finite()) {
            return Err(AdapterError::Rejected(format!("expected {dof} finite values, one per joint")));
        }
        let whole = self.setpoint(command, mode).map_err(AdapterError::Rejected)?;
        self.commanded = true;
        match mode {
            ControlMode::Velocity => self.arm.velocity(values),
            ControlMode::ServoPosition | ControlMode::Impedance => self.arm.follow(&whole),
            _ => self.arm.move_to(values, command.velocity),
        }
        .map_err(|refusal| self.arm.rejected(refusal))
    }
}

impl Controller {
    /// A command as a setpoint, with all that it has.
    fn setpoint(&self, command: &Command, mode: ControlMode) -> Result<Setpoint, String> {
        let dof = self.arm.dof();
        let list = |name: &str| -> Result<Option<Joints>, String> {
            match command.list(name)? {
                Some(list) if list.len() != dof => Err(format!("{name} has {} values for {dof} joints", list.len())),
                list => Ok(list.map(|list| joints_of(&list))),
            }
        };
        let at = command.at.map_or(self.arm.now(), Mono);
        let (stiffness, damping) = (list("stiffness")?, list("damping")?);
        if mode == ControlMode::Impedance && (stiffness.is_none() || damping.is_none()) {
            return Err("impedance mode needs stiffness and damping".to_owned());
        }
        Ok(Setpoint {
            velocity: list("velocities")?.unwrap_or_default(),
            acceleration: list("accelerations")?,
            effort: list("efforts")?,
            stiffness,
            damping,
            expires: command.valid.map(|valid| at.after(std::time::Duration::from_secs_f64(valid.clamp(0.0, 60.0)))),
            ..Setpoint::new(mode, joints_of(&command.values), at)
        })
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

impl HasArm for Controller {
    fn arm(&mut self) -> &mut SimArm {
        &mut self.arm
    }

    fn complete(&self, truth: &mut Truth) {
        truth.gripper_position = Some(self.gripper.position);
    }

    /// Stops a commanded arm when no request arrives within the timeout: the client may hang.
    fn advance(&mut self, now: Mono) {
        let deadline = self.heard.after(SILENCE_TIMEOUT);
        if self.commanded && now >= deadline {
            self.integrate(deadline);
            self.stop_unasked("no request came for 0.5 s: enable it again");
        }
        self.integrate(now);
        self.arm.apply_faults();
    }
}

impl stream::Controller for Controller {
    fn serve(&mut self, bytes: &[u8], now: Mono, answer: &mut Vec<u8>) -> Scan<Delivery> {
        wire::scan(bytes).map(|request| {
            self.advance(now);
            let request = match request {
                Ok(request) => request,
                Err(what) => {
                    wire::refused(answer, 0, &AdapterError::Protocol(what.to_owned()));
                    return Delivery::HangUp;
                }
            };
            match self.answer(&request) {
                Ok(content) => wire::done(answer, request.id, content),
                Err(error) => wire::refused(answer, request.id, &error),
            }
            let delivery = self.arm.delivery();
            // During a stall the client waits for the answer and does not count as silent.
            self.heard = if let Delivery::Stall(time) = delivery { now.after(time) } else { now };
            delivery
        })
    }

    fn client_gone(&mut self, now: Mono) {
        self.advance(now);
        if self.commanded {
            self.stop_unasked("its client disconnected");
        }
    }

    fn turn_away(&self, bytes: &[u8], answer: &mut Vec<u8>) {
        let id = if let Scan::Take(_, Ok(request)) = wire::scan(bytes) { request.id } else { 1 };
        wire::refused(answer, id, &AdapterError::Rejected("it serves another client already".to_owned()));
    }
}

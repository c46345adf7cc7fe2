//! The emulated controller: modes, states, errors, and what moves the joints. Time is passed in and nothing here knows
//! of sockets; what a request means is in `registers`.

use std::collections::VecDeque;
use std::time::Duration;

use nalgebra::Isometry3;

use super::super::model::{Identity, Model, VELOCITY};
use super::super::protocol::gripper::GripperKind;
use super::kinematics::{Chain, to_wire};
use super::report::Snapshot;
use super::tool::Tool;
use super::wire::Request;
use super::{SimOptions, SlowReply, Withhold};
use crate::clock::Mono;
use crate::hardware::sim::faults::{DEFAULT_STALL, Fault, FaultKind, FaultScript};
use crate::hardware::sim::plant::{Drive, Plant};
use crate::joint::{JointLimits, Joints};

/// Acceleration of the emulated joints [rad/s²]: a real arm does less than its limit.
const ACCELERATION: f64 = 12.0;
/// Longest stretch that is advanced at once [s], so that queued moves follow one another.
const SLICE: f64 = 0.02;
/// Most requests that are kept when recording, and most moves in the queue.
const TRACE: usize = 200_000;
pub(super) const QUEUE: usize = 256;
/// What the force/torque sensor feels of the tool [N, Nm].
const TOOL_WEIGHT: [f32; 6] = [0.3, -0.2, -4.9, 0.01, 0.02, 0.0];
/// Error code of the E-stop button.
const ESTOP: u8 = 1;

/// States, as reported. While it is ready, 1 or 2 is reported by whether it moves.
pub(super) mod state {
    pub const MOVING: u8 = 1;
    pub const STANDING: u8 = 2;
    pub const PAUSED: u8 = 3;
    pub const STOPPED: u8 = 4;
    pub const CHANGED: u8 = 5;
    pub const STOPPING: u8 = 6;
}

/// A request as it came over the wire.
#[derive(Debug, Clone, PartialEq)]
pub struct Received {
    /// When.
    pub at: Mono,
    /// The protocol number.
    pub protocol: u8,
    /// The register.
    pub register: u8,
    /// The payload.
    pub payload: Vec<u8>,
    /// The state byte of the response.
    pub status: u8,
    /// Whether it came over the second control port.
    pub second: bool,
}

impl Received {
    /// Whether it asks the arm or its gripper to move.
    pub fn moves(&self) -> bool {
        matches!(self.register, 21..=30 | 81..=83) || (self.register == 124 && self.payload.get(2) == Some(&16))
    }
}

/// What happens to a response or report on its way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Delivery {
    /// It is sent.
    Send,
    /// It is sent so much later; nothing else is sent until then.
    Stall(Duration),
    /// It is lost.
    Silent,
    /// Noise goes before it.
    Garbage,
    /// One of its bytes is wrong.
    Corrupt,
    /// Only its first half is sent.
    Truncated,
    /// The one before it is sent again.
    Frozen,
    /// All connections end.
    Disconnect,
    /// All connections end, and there is no power for so long.
    PowerLoss(Duration),
}

/// A planned move.
#[derive(Debug, Clone, Copy)]
pub(super) struct Move {
    pub target: [f64; 7],
    /// Fraction of the top speed.
    pub speed: f64,
}

/// The controller's memory.
pub struct Controller {
    pub(super) identity: Identity,
    pub(super) firmware: [u16; 3],
    pub(super) chain: Chain,
    pub(super) plant: Plant,
    pub(super) limits: JointLimits,
    pub(super) tool: Tool,
    pub(super) mode: u8,
    pub(super) state: u8,
    pub(super) error: u8,
    pub(super) warning: u8,
    /// Motors on, one bit per joint.
    pub(super) enabled: u8,
    pub(super) queue: VecDeque<Move>,
    pub(super) current: Option<Move>,
    pub(super) velocity_until: Option<Mono>,
    pub(super) settings: Settings,
    /// It answers to a change of mode, and stays in the mode that it is in.
    pub keeps_mode: bool,
    /// It sends no reports of how it is; all others go on.
    pub condition_muted: bool,
    /// What becomes of the full reports.
    pub withhold: Withhold,
    slow: Vec<SlowReply>,
    estop_open: bool,
    estop_until: Option<Mono>,
    pub(super) script: FaultScript,
    first_contact: Option<Mono>,
    powered_up: Mono,
    advanced_to: Mono,
    counter: u32,
    trace: Option<Vec<Received>>,
}

/// What clients can set.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Settings {
    pub offset: [f32; 6],
    pub load: [f32; 4],
    pub sensitivity: [u8; 2],
    /// Reports hold currents in the place of torques.
    pub currents: bool,
    pub wrench_on: bool,
    pub wrench_zero: [f32; 6],
}

impl Controller {
    /// A controller that was just switched on: disabled, stopped, in mode 0.
    pub fn new(model: Model, firmware: [u16; 3], gripper: GripperKind, options: &SimOptions, now: Mono) -> Self {
        let identity = introduce(model);
        let mut limits = identity.limits().unwrap_or_else(|| model.limits());
        limits.acceleration_max.iter_mut().for_each(|a| *a = ACCELERATION);
        let given = &options.initial_positions;
        let initial = if given.is_empty() { at_home(model) } else { given };
        Self {
            identity,
            firmware,
            chain: Chain::of(model),
            plant: Plant::lagging(&limits, initial, options.lag),
            limits,
            tool: Tool::new(gripper),
            mode: 0,
            state: state::STOPPED,
            error: 0,
            warning: 0,
            enabled: 0,
            queue: VecDeque::new(),
            current: None,
            velocity_until: None,
            settings: Settings { sensitivity: [3, 3], ..Settings::default() },
            keeps_mode: false,
            condition_muted: false,
            withhold: Withhold::No,
            slow: options.slow_replies.clone(),
            estop_open: false,
            estop_until: None,
            script: FaultScript::new(&options.faults),
            first_contact: None,
            powered_up: now,
            advanced_to: now,
            counter: 0,
            trace: None,
        }
    }

    /// Brings the joints up to `now`.
    pub fn advance(&mut self, now: Mono) {
        while self.advanced_to < now {
            let mut dt = now.seconds_since(self.advanced_to).min(SLICE);
            let ends = self.velocity_until.map(|until| until.seconds_since(self.advanced_to));
            if ends.is_some_and(|left| left <= 0.0) {
                self.velocity_until = None;
                self.plant.stop();
            } else if let Some(left) = ends {
                dt = dt.min(left.max(1e-9));
            }
            self.plant.advance(dt);
            self.tool.advance(dt);
            self.advanced_to = self.advanced_to.after(Duration::from_secs_f64(dt)).max(Mono(self.advanced_to.0 + 1));
            self.next_move();
        }
        if self.estop_until.is_some_and(|until| now >= until) {
            self.release_estop();
        }
    }

    /// Begins the next planned move when the one before it is done.
    fn next_move(&mut self) {
        if self.plant.moving() {
            return;
        }
        if self.state == state::STOPPING {
            self.state = state::STOPPED;
        }
        if self.state == state::STANDING {
            self.current = self.queue.pop_front();
            if let Some(Move { target, speed }) = self.current {
                self.plant.move_to(&target, speed);
            }
        }
    }

    /// Joint positions [rad] and velocities [rad/s].
    pub fn joints(&self) -> (Joints, Joints) {
        (self.plant.positions(), self.plant.velocities())
    }

    /// Whether all motors are on.
    pub fn all_enabled(&self) -> bool {
        u32::from(self.enabled).count_ones() as usize == self.identity.axes
    }

    /// Lets a fault happen `fault.at` seconds from now.
    pub fn inject(&mut self, fault: Fault, now: Mono) {
        self.script.inject(fault, self.script_time(now));
    }

    /// Somebody pushes the E-stop button: error, motors off.
    pub fn press_estop(&mut self) {
        self.estop_open = true;
        self.estop_until = None;
        self.fail(ESTOP);
        self.enabled = 0;
        self.plant.enable(false);
    }

    /// Somebody releases it. Nothing else changes.
    pub fn release_estop(&mut self) {
        self.estop_open = false;
        self.estop_until = None;
    }

    /// Goes into error: everything stops.
    pub(super) fn fail(&mut self, code: u8) {
        self.error = code;
        self.halt(state::STOPPED);
    }

    /// Stops the joints, forgets what is queued.
    pub(super) fn halt(&mut self, state: u8) {
        self.state = state;
        self.queue.clear();
        (self.current, self.velocity_until) = (None, None);
        self.plant.stop();
    }

    pub(super) fn clear_error(&mut self) {
        if !self.estop_open {
            self.error = 0;
            self.halt(if self.all_enabled() { state::CHANGED } else { state::STOPPED });
        }
    }

    /// The state byte of responses.
    pub(super) fn status(&self) -> u8 {
        let ready = self.state <= state::STANDING && self.error == 0 && self.all_enabled();
        u8::from(!ready) << 4 | u8::from(self.warning != 0) << 5 | u8::from(self.error != 0) << 6
    }

    /// The state as it is reported.
    pub(super) fn reported_state(&self) -> u8 {
        let moving = self.plant.moving() || !self.queue.is_empty();
        if self.state == state::STANDING && moving { state::MOVING } else { self.state }
    }

    /// The tool's pose.
    pub(super) fn pose(&self) -> Isometry3<f64> {
        self.chain.forward(&self.seven())
    }

    /// The joints as the wire has them.
    pub(super) fn seven(&self) -> [f64; 7] {
        first(&self.plant.positions())
    }

    /// What the force/torque sensor shows: without the tool's weight, and with it.
    pub(super) fn wrench(&self) -> ([f32; 6], [f32; 6]) {
        if !self.settings.wrench_on {
            return ([0.0; 6], [0.0; 6]);
        }
        let mut net = TOOL_WEIGHT;
        net.iter_mut().zip(self.settings.wrench_zero).for_each(|(value, zero)| *value -= zero);
        (net, TOOL_WEIGHT)
    }

    /// What the arm's torques are [Nm]: friction, since the emulated links have no mass.
    pub(super) fn torques(&self) -> [f32; 7] {
        first(&self.plant.efforts()).map(|v| v as f32)
    }

    /// What reports show now.
    pub fn snapshot(&mut self, now: Mono) -> Snapshot {
        self.advance(now);
        let t = self.script_time(now);
        self.suffer(t, now);
        let (wrench, wrench_raw) = self.wrench();
        self.counter = self.counter.wrapping_add(1);
        let scale = if self.settings.currents { 0.1 } else { 1.0 };
        let mut snapshot = Snapshot {
            time_us: now.since(self.powered_up).as_micros() as u64,
            state: self.reported_state(),
            mode: self.mode,
            queued: (self.queue.len() + usize::from(self.current.is_some() && self.plant.moving())) as u16,
            position: self.seven().map(|v| v as f32),
            velocity: first(&self.plant.velocities()).map(|v| v as f32),
            torque: self.torques().map(|v| v * scale),
            pose: to_wire(&self.pose()),
            enabled: self.enabled,
            error: self.error,
            warning: self.warning,
            axes: self.identity.axes as u8,
            kind: self.identity.kind as u8,
            firmware: self.firmware,
            offset: self.settings.offset,
            load: self.settings.load,
            sensitivity: self.settings.sensitivity,
            wrench,
            wrench_raw,
            counter: self.counter,
        };
        if self.script.take(FaultKind::Nan, t).is_some() {
            snapshot.position = [f32::NAN; 7];
        } else if self.script.take(FaultKind::ZeroState, t).is_some() {
            // A controller that has not measured yet has no pose either.
            (snapshot.position, snapshot.velocity, snapshot.pose) = ([0.0; 7], [0.0; 7], [0.0; 6]);
        }
        snapshot
    }

    /// Does what a request asks and writes the response into `out`; what becomes of it on its way.
    pub fn handle(&mut self, request: &Request<'_>, second: bool, now: Mono, out: &mut Vec<u8>) -> Delivery {
        self.first_contact.get_or_insert(now);
        self.advance(now);
        let t = self.script_time(now);
        self.suffer(t, now);
        let status = self.respond(request, now, t, out);
        if let Some(trace) = self.trace.as_mut().filter(|trace| trace.len() < TRACE) {
            let (protocol, register, payload) = (request.protocol, request.register, request.payload.to_vec());
            trace.push(Received { at: now, protocol, register, payload, status, second });
        }
        self.delivery(now)
    }

    /// How long the reply to a register takes.
    pub fn reply_time(&self, register: u8) -> Duration {
        let slow = self.slow.iter().find(|slow| slow.register == register);
        slow.map_or(Duration::ZERO, |slow| Duration::from_secs_f64(slow.delay))
    }

    /// Lets the replies to a register take time from now on.
    pub fn slow_down(&mut self, slow: SlowReply) {
        self.slow.retain(|other| other.register != slow.register);
        self.slow.push(slow);
    }

    pub(super) fn script_time(&self, now: Mono) -> f64 {
        self.first_contact.map_or(0.0, |first| now.seconds_since(first))
    }

    /// Faults of the arm itself.
    fn suffer(&mut self, t: f64, now: Mono) {
        if let Some(fault) = self.script.take(FaultKind::Estop, t) {
            self.press_estop();
            self.estop_until = fault.left(t).map(|left| now.after(left));
        }
        if let Some(fault) = self.script.take(FaultKind::ErrorCode, t) {
            self.fail(fault.code.min(255) as u8);
        }
        let blocked = self.script.take(FaultKind::Blocked, t).map(|fault| fault.joint.saturating_sub(1));
        (0..self.identity.axes).for_each(|joint| self.plant.block(joint, blocked == Some(joint)));
    }

    /// Faults of the wire that also strike at the slow reports.
    pub fn mute(&mut self, now: Mono) -> Delivery {
        let t = self.script_time(now);
        let lasting = |kind| self.script.lasts(kind, t);
        match (lasting(FaultKind::Silent), lasting(FaultKind::Frozen)) {
            (true, _) => Delivery::Silent,
            (_, true) => Delivery::Frozen,
            _ => Delivery::Send,
        }
    }

    /// Faults of the wire, for the next response or report.
    pub fn delivery(&mut self, now: Mono) -> Delivery {
        let t = self.script_time(now);
        if let Some(fault) = self.script.take(FaultKind::PowerLoss, t) {
            let dark = fault.left(t).unwrap_or_default();
            self.halt(state::STOPPED);
            (self.mode, self.error, self.warning, self.enabled) = (0, 0, 0, 0);
            self.powered_up = now.after(dark);
            self.plant.enable(false);
            return Delivery::PowerLoss(dark);
        }
        if let Some(fault) = self.script.take(FaultKind::Stall, t) {
            return Delivery::Stall(fault.left(t).unwrap_or(DEFAULT_STALL));
        }
        let faults = [
            (FaultKind::Disconnect, Delivery::Disconnect),
            (FaultKind::Silent, Delivery::Silent),
            (FaultKind::Frozen, Delivery::Frozen),
            (FaultKind::Truncated, Delivery::Truncated),
            (FaultKind::Corrupt, Delivery::Corrupt),
            (FaultKind::Garbage, Delivery::Garbage),
        ];
        let struck = faults.iter().find(|(kind, _)| self.script.take(*kind, t).is_some());
        struck.map_or(Delivery::Send, |(_, delivery)| *delivery)
    }

    /// Switches all motors on or off; a sagging arm sinks when they come on.
    pub(super) fn power(&mut self, t: f64) {
        let on = self.all_enabled();
        if on
            && self.plant.drive() == Drive::Disabled
            && let Some(fault) = self.script.take(FaultKind::Sag, t)
        {
            self.plant.sag(fault.amount);
        }
        self.plant.enable(on);
    }

    /// Starts recording requests, forgetting those recorded before.
    pub fn record(&mut self) {
        self.trace = Some(Vec::new());
    }

    /// What was recorded.
    pub fn trace(&self) -> Vec<Received> {
        self.trace.clone().unwrap_or_default()
    }
}

/// How an arm of a model introduces itself.
fn introduce(model: Model) -> Identity {
    let (kind, serial) = match model {
        Model::Xarm5 => (5, "XF1305"),
        Model::Xarm6 => (6, "XI1305"),
        Model::Xarm7 => (7, "XS1305"),
        Model::Lite6 => (9, "LI1006"),
        Model::Xarm850 => (12, "FX8510"),
    };
    Identity { axes: model.axes(), kind, serial: serial.into() }
}

/// Pose at power-up [rad]: not zero, so that nothing works by accident, and far from limits and singularities.
fn at_home(model: Model) -> &'static [f64] {
    match model {
        Model::Xarm5 => &[0.1, -0.5, -0.7, 1.2, 0.2],
        Model::Xarm6 => &[0.1, -0.6, -0.8, 0.05, 1.4, 0.1],
        Model::Xarm7 => &[0.1, -0.5, 0.05, 0.9, 0.1, 1.3, 0.2],
        Model::Lite6 => &[0.1, 0.2, 1.3, 0.05, 1.0, 0.1],
        Model::Xarm850 => &[0.1, -0.3, -1.2, 0.05, 0.9, 0.1],
    }
}

fn first(joints: &Joints) -> [f64; 7] {
    joints.first_chunk().copied().unwrap_or_default()
}

/// A speed [rad/s] as a fraction of the top speed.
pub(super) fn fraction(speed: f32) -> f64 {
    (f64::from(speed) / VELOCITY).clamp(0.0, 1.0)
}

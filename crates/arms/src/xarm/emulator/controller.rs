//! The emulated controller: modes, states, errors, and when the arm behind it moves. Time is passed in and nothing here
//! knows of sockets; what a request means is in `registers`, what comes and goes at the ports in `ports`.

use std::collections::VecDeque;
use std::time::Duration;

use nalgebra::Isometry3;

use super::super::model::{Identity, Model};
use super::super::protocol::gripper::GripperKind;
use super::controlled_arm::{ControlledArm, Refusal};
use super::judge::Judge;
use super::kinematics::{Links, to_wire};
use super::motion::is_motion;
use super::queue::{Goal, Move};
use super::settings::Settings;
use super::tool::Tool;
use super::{PLAYABLE, SimOptions, SlowReply, Withhold};
use dimos_core::clock::Mono;
use dimos_core::joint::Joints;
use dimos_core::pose::from_xyz_rpy;
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::sim::arm::SimArm;
use dimos_hardware::sim::reach::Chain;
use dimos_hardware::sim::trace::Trace;

/// Acceleration of the emulated joints [rad/s²]: a real arm does less than its limit.
const ACCELERATION: f64 = 12.0;
/// Longest stretch that is advanced at once, so that queued moves follow one another.
const SLICE: Duration = Duration::from_millis(20);
/// The mode that executes setpoints.
pub(super) const SERVO: u8 = 1;
/// Positions this close to a limit count as inside [rad]: the vendor's client allows as much.
pub(super) const TOLERANCE: f64 = 0.00175;
/// The error of a joint that takes more current than its motion needs.
const COLLISION: u16 = 31;
/// What the force/torque sensor feels of the tool [N, Nm].
const TOOL_WEIGHT: [f32; 6] = [0.3, -0.2, -4.9, 0.01, 0.02, 0.0];
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
        is_motion(self.register) || (self.register == 124 && self.payload.get(2) == Some(&16))
    }
}

/// The controller's memory, and the arm behind it.
pub struct Controller<A> {
    pub(super) identity: Identity,
    /// End of its serial number.
    pub(super) unit: String,
    pub(super) firmware: [u16; 3],
    /// The kinematics; without them, poses are those that the arm itself knows.
    pub(super) chain: Option<Links>,
    pub(super) arm: A,
    pub(super) tool: Tool,
    pub(super) mode: u8,
    pub(super) state: u8,
    pub(super) warning: u8,
    pub(super) queue: VecDeque<Move>,
    pub(super) current: Option<Move>,
    /// End of the pause that is under way.
    pub(super) pauses_until: Option<Mono>,
    pub(super) settings: Settings,
    /// The settings that survive a loss of power.
    pub(super) saved: Settings,
    /// Watches over servo mode.
    pub(super) judge: Judge,
    /// Goal of a request whose outcome is not known yet, with its payload and when it was last made.
    pub(super) unanswered: Option<(Vec<u8>, Goal, Mono)>,
    /// It answers to a change of mode, and stays in the mode that it is in.
    pub keeps_mode: bool,
    /// Suppresses the reports of the condition; all others continue.
    pub condition_muted: bool,
    /// What becomes of the full reports.
    pub withhold: Withhold,
    pub(super) slow: Vec<SlowReply>,
    pub(super) counter: u32,
    /// Requests that came over the wire.
    pub trace: Trace<Received>,
}

impl Controller<SimArm> {
    /// A controller with a simulated arm that was just switched on: disabled, stopped, in mode 0.
    pub fn new(
        model: Model,
        firmware: [u16; 3],
        gripper: GripperKind,
        options: &SimOptions,
        now: Mono,
    ) -> AdapterResult<Self> {
        let identity = introduce(model);
        let mut limits = identity.limits().unwrap_or_else(|| model.limits());
        limits.acceleration_max.iter_mut().for_each(|a| *a = ACCELERATION);
        let common = options.common().starting_at(at_home(model));
        let arm = SimArm::new("xarm", &limits, &common, PLAYABLE, now)?.colliding_as(COLLISION);
        // Its modes are its own.
        let arm = arm.without_modes().with_tolerance(TOLERANCE);
        let slow = options.slow_replies.clone();
        let wire = |[x, y, z, roll, pitch, yaw]: [f64; 6]| to_wire(&from_xyz_rpy([x, y, z], [roll, pitch, yaw]));
        let (offset, base) = (wire(options.tcp_offset), wire(options.world_offset));
        let settings = Settings { limit_factor: options.tool_speed_factor, offset, base, ..Settings::default() };
        let controller = Self::around(identity, firmware, gripper, arm);
        Ok(Self { chain: Some(Links::of(model)), slow, settings, saved: settings, ..controller })
    }

    /// Pushes the E-stop button: error, motors off.
    pub fn press_estop(&mut self) {
        self.arm.press_estop();
        self.halt(state::STOPPED);
    }
}

impl<A: ControlledArm> Controller<A> {
    /// A controller of an arm without kinematics, stopped, in mode 0.
    pub fn around(identity: Identity, firmware: [u16; 3], gripper: GripperKind, arm: A) -> Self {
        Self {
            identity,
            unit: "C07L01".to_owned(),
            firmware,
            chain: None,
            arm,
            tool: Tool::new(gripper),
            mode: 0,
            state: state::STOPPED,
            warning: 0,
            queue: VecDeque::new(),
            current: None,
            pauses_until: None,
            settings: Settings::default(),
            saved: Settings::default(),
            judge: Judge::default(),
            unanswered: None,
            keeps_mode: false,
            condition_muted: false,
            withhold: Withhold::No,
            slow: Vec::new(),
            counter: 0,
            trace: Trace::default(),
        }
    }

    /// Advances everything to `now`.
    pub fn advance(&mut self, now: Mono) {
        while self.arm.now() < now {
            let before = self.arm.now();
            self.arm.integrate(now.min(before.after(SLICE)));
            match self.arm.gripper() {
                Some((opening, moving)) => self.tool.show(opening, moving),
                None => {
                    self.tool.play(|kind| self.arm.due_fault(kind));
                    self.tool.advance(self.arm.now().seconds_since(before));
                }
            }
            self.watch();
            self.next_move();
        }
        if self.arm.has_stopped() {
            self.halt(state::STOPPED);
        }
    }

    /// Motors on, one bit per joint.
    pub(super) fn motors(&self) -> u8 {
        (0..self.identity.axes).fold(0, |bits, joint| bits | u8::from(self.arm.motor(joint)) << joint)
    }

    /// The error; 0 = none.
    pub(super) fn error(&self) -> u8 {
        self.arm.error().min(255) as u8
    }

    /// Goes into error: everything stops.
    pub(super) fn fail(&mut self, code: u8) {
        self.arm.fail(code.into());
        self.halt(state::STOPPED);
    }

    /// Stops the joints, forgets what is queued.
    pub(super) fn halt(&mut self, state: u8) {
        self.state = state;
        self.queue.clear();
        (self.current, self.pauses_until, self.unanswered) = (None, None, None);
        self.judge.forget();
        self.arm.stop();
        self.arm.end();
    }

    pub(super) fn clear_error(&mut self) -> Result<(), Refusal> {
        self.arm.clear()?;
        self.halt(if self.arm.enabled() { state::CHANGED } else { state::STOPPED });
        Ok(())
    }

    /// The state byte of responses.
    pub(super) fn status(&self) -> u8 {
        let ready = self.state <= state::STANDING && self.arm.is_ready();
        u8::from(!ready) << 4 | u8::from(self.warning != 0) << 5 | u8::from(self.error() != 0) << 6
    }

    /// The state as it is reported.
    pub(super) fn reported_state(&self) -> u8 {
        let moving = self.is_busy() || !self.queue.is_empty();
        if self.state == state::STANDING && moving { state::MOVING } else { self.state }
    }

    /// The tool's pose, if it is known.
    pub(super) fn pose(&self) -> Option<Isometry3<f64>> {
        self.chain.map_or_else(|| self.arm.pose(), |chain| Some(self.tcp_of(chain, &self.seven())))
    }

    /// The pose of the tool's centre point in the reference frame, at joints [rad].
    pub(super) fn tcp_of(&self, chain: Links, joints: &[f64; 7]) -> Isometry3<f64> {
        self.base() * chain.forward(joints) * self.tool_offset()
    }

    /// The joints and their velocities as they are reported.
    pub(super) fn reported(&mut self) -> ([f64; 7], [f64; 7]) {
        let (positions, velocities) = self.arm.joints();
        let (mut positions, mut velocities) = (first(&positions), first(&velocities));
        self.arm.misread(&mut positions, &mut velocities);
        (positions, velocities)
    }

    /// The joints as the wire has them.
    pub(super) fn seven(&self) -> [f64; 7] {
        first(&self.arm.joints().0)
    }

    /// What the force/torque sensor shows: without the tool's weight, and with it.
    pub(super) fn wrench(&self) -> ([f32; 6], [f32; 6]) {
        if let Some(measured) = self.arm.wrench() {
            return (measured, measured);
        }
        if !self.settings.wrench_on || !self.arm.takes_settings() {
            return ([0.0; 6], [0.0; 6]);
        }
        let mut net = TOOL_WEIGHT;
        net.iter_mut().zip(self.settings.wrench_zero).for_each(|(value, zero)| *value -= zero);
        (net, TOOL_WEIGHT)
    }

    /// What the arm's torques are [Nm]: friction, since the emulated links have no mass.
    pub(super) fn torques(&self) -> [f32; 7] {
        first(&self.arm.efforts()).map(|v| v as f32)
    }

    /// Lets the replies to a register take time from now on.
    pub fn slow_down(&mut self, slow: SlowReply) {
        self.slow.retain(|other| other.register != slow.register);
        self.slow.push(slow);
    }
}

/// How an arm of a model introduces itself.
pub(super) fn introduce(model: Model) -> Identity {
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

pub(super) fn first(joints: &Joints) -> [f64; 7] {
    joints.first_chunk().copied().unwrap_or_default()
}

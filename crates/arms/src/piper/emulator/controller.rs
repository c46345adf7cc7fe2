//! The emulated controller: what it does with a frame. Its motors are in `power`, what it sends in `feedback`.
//!
//! Where the sheet leaves open what an arm does, this one does the worst: a joint target that it was given while its
//! motors were off is where it goes when they come on; every reset takes the power away.

use std::f64::consts::TAU;
use std::ops::RangeInclusive;
use std::time::Duration;

use super::super::model::{Model, SPEED};
use super::super::{GripperKind, NATIVE_RATE, protocol::DOF};
use super::feedback::Staircase;
use super::kinematics::Links;
use super::wire::{self, Request};
use super::{SimOptions, stops};
use dimos_core::clock::Mono;
use dimos_core::joint::Joints;
use dimos_core::pose;
use dimos_hardware::adapter::AdapterResult;
use dimos_hardware::sim::arm::{Delivery, HasArm, SimArm};
use dimos_hardware::sim::can_server::CanController;
use dimos_hardware::sim::faults::FaultKind;
use dimos_hardware::sim::gripper::Gripper;
use dimos_hardware::sim::reach::Chain;
use dimos_hardware::sim::trace::Trace;
use dimos_hardware::transport::can::{CanFilter, CanFrame};

/// Commands, beside which a Piper hears nothing: 0x150–0x15F and 0x470–0x47F, and the question for its firmware.
const FILTERS: &[CanFilter] =
    &[CanFilter { id: 0x150, mask: 0x7F0 }, CanFilter { id: 0x470, mask: 0x7F0 }, CanFilter { id: 0x4AF, mask: 0x7FF }];
/// Frames that no client knows: strange identifiers, too few bytes.
const NOISE: &[(u16, &[u8])] =
    &[(0x000, &[]), (0x7FF, &[0xFF; 8]), (0x2A5, &[1]), (0x2A0, &[9; 8]), (0x267, &[0xFF; 8]), (0x4AF, &[])];

/// Pose at power-up [rad] where the options give none: not zero, so that nothing works by accident.
const INITIAL: [f64; DOF] = [0.1, 0.6, -0.7, 0.05, 0.4, -0.1];
/// So far beyond a limit a target may be [0.001°].
const ROUNDING: i32 = 100;
/// Speed of the gripper [m/s].
const GRIPPER_SPEED: f64 = 0.1;

/// States of the arm.
pub(super) mod state {
    pub use dimos_hardware::sim::arm::ESTOP;
    pub const NO_SOLUTION: u16 = 2;
    pub const LIMIT: u16 = 4;
    pub const COLLISION: u16 = 7;
    pub const OTHER: u16 = 10;
}

/// The controller's memory.
pub struct Controller {
    pub(super) arm: SimArm,
    pub(super) gripper: Gripper,
    pub(super) has_gripper: bool,
    /// Its motor is on; its error bits.
    pub(super) gripper_on: bool,
    pub(super) gripper_errors: u8,
    pub(super) firmware: [u8; 8],
    /// Highest and lowest angle [0.1°] and speed [0.001 rad/s] of each joint.
    pub(super) limits: [(i16, i16, u16); DOF],
    pub(super) control: u8,
    pub(super) mode: u8,
    pub(super) speed: u8,
    pub(super) follow: u8,
    pub(super) teaching: bool,
    pub(super) leading: bool,
    pub(super) beyond: u8,
    /// Since when the motors are coming on.
    pub(super) starting: Option<Mono>,
    /// The parts of a pose and of joint targets that have come [0.001 mm, 0.001°].
    pub(super) pose: [[i32; 2]; 3],
    pub(super) joints: [[i32; 2]; 3],
    pub(super) ticks: u64,
    /// It sends less often than an arm.
    pub(super) slow: bool,
    /// What its moving joints show.
    pub(super) staircases: [Staircase; DOF],
    /// What came over the bus, and when.
    pub trace: Trace<(Mono, CanFrame)>,
    /// How often the motors lost their power under a reset.
    pub power_drops: u64,
    /// Its dimensions.
    pub(super) links: Links,
    /// It takes targets outside its limits.
    pub lenient: bool,
    /// Frames that it does not send.
    pub muted: Option<RangeInclusive<u16>>,
}

impl Controller {
    /// A controller that was just switched on, motors off.
    pub fn new(
        options: &SimOptions,
        (model, gripper): (Model, GripperKind),
        playable: &'static [FaultKind],
        now: Mono,
    ) -> AdapterResult<Self> {
        let decidegrees = |value: f64| (value.to_degrees() * 10.0).round() as i16;
        let mut firmware = [0; 8];
        firmware.iter_mut().zip(options.firmware.bytes()).for_each(|(to, byte)| *to = byte);
        let arm = SimArm::new("piper", &stops(model), &options.common().starting_at(&INITIAL), playable, now)?;
        Ok(Self {
            // Its limits are its own, in units of the wire.
            arm: arm.without_modes().with_tolerance(f64::INFINITY).colliding_as(state::COLLISION),
            gripper: Gripper::new(gripper.stroke().unwrap_or_default(), GRIPPER_SPEED),
            has_gripper: gripper != GripperKind::None,
            gripper_on: false,
            gripper_errors: 0,
            firmware,
            links: Links(model),
            limits: model.ranges().map(|(lower, upper)| (decidegrees(upper), decidegrees(lower), (SPEED * 1e3) as u16)),
            control: 0,
            mode: 0,
            speed: 0,
            follow: 0,
            teaching: false,
            leading: false,
            beyond: 0,
            starting: None,
            pose: [[0; 2]; 3],
            joints: [[0; 2]; 3],
            ticks: 0,
            slow: options.feedback_hz < NATIVE_RATE,
            staircases: [Staircase::default(); DOF],
            trace: Trace::default(),
            power_drops: 0,
            lenient: false,
            muted: None,
        })
    }

    // --- Commands ---

    /// Does what a frame says; answers go into `out`.
    fn execute(&mut self, frame: &CanFrame, out: &mut Vec<CanFrame>) {
        let Some(request) = wire::understand(frame) else { return };
        if matches!(frame.id, 0x470..=0x475) && frame.id != 0x472 {
            out.push(wire::acknowledge(frame.id));
        }
        match request {
            Request::Halt { stop: 1, .. } => self.estop(),
            Request::Halt { stop: 2, .. } => {
                self.power_drops += 1;
                self.lose_power();
            }
            Request::Halt { teach, .. } => self.teach(teach),
            // Standby; a mode that is not emulated; an arm in teaching ignores commands.
            Request::Control { control: 0, .. } => self.control = 0,
            Request::Control { mode: 2.., .. } | Request::Mit(_) => self.cannot(),
            Request::Control { .. } if self.teaching => {}
            Request::Control { control, mode, speed, follow } => {
                (self.control, self.mode, self.speed, self.follow) = (control, mode, speed, follow);
            }
            Request::Pose(part, pair) => {
                self.pose.get_mut(part).into_iter().for_each(|to| *to = pair);
                if part == 2 && self.listens(0) {
                    self.move_to_pose();
                }
            }
            Request::Joints(part, pair) => {
                self.joints.get_mut(part).into_iter().for_each(|to| *to = pair);
                if part == 2 && self.listens(1) {
                    self.move_joints(six(self.joints));
                }
            }
            Request::Gripper(stroke, torque, action) => self.grip(stroke, torque, action),
            Request::Role(0xFA) => self.leading = true,
            Request::Role(0xFC) => self.leading = false,
            Request::Role(_) => {}
            Request::Motors(motor, action) => self.switch(motor, action),
            Request::Query(motor, what) => out.extend(self.answer(motor, what)),
            Request::SetLimits(motor, upper, lower, speed) => self.set_limits(motor, upper, lower, speed),
            Request::Configure(_, _, clear) => {
                if clear && self.arm.clear_error().is_ok() {
                    self.beyond = 0;
                }
            }
            Request::Firmware => out.push(wire::firmware(&self.firmware)),
        }
    }

    /// Bit 0 of `action`: on, and to this stroke [0.001 mm] with at most this torque [mNm]; bit 1: errors are cleared
    /// before that.
    fn grip(&mut self, stroke: i32, torque: u16, action: u8) {
        self.gripper.max_force = f64::from(torque.min(5000)) * 1e-3;
        if action & 2 != 0 {
            self.gripper_errors = 0;
        }
        self.gripper_on = action & 1 != 0;
        match self.gripper_on && self.gripper_errors == 0 {
            true => self.gripper.move_to(f64::from(stroke) * 1e-6),
            false => self.gripper.stop(),
        }
    }

    fn teach(&mut self, what: u8) {
        match what {
            1 => (self.teaching, self.control) = (true, 2),
            2 => (self.teaching, self.control) = (false, 0),
            _ => {}
        }
    }

    /// Reports a mode that is not emulated as an error.
    fn cannot(&mut self) {
        let other = if self.arm.error() == 0 { state::OTHER } else { self.arm.error() };
        self.arm.fail(other);
    }

    fn listens(&self, mode: u8) -> bool {
        self.control == 1 && self.mode == mode && self.arm.error() == 0
    }

    fn answer(&self, motor: u8, what: u8) -> Option<CanFrame> {
        let (upper, lower, speed) = *self.limits.get(usize::from(motor.checked_sub(1)?))?;
        match what {
            1 => Some(wire::limits(motor, upper, lower, speed)),
            2 => Some(wire::acceleration(motor, 5000)),
            _ => None,
        }
    }

    fn set_limits(&mut self, motor: u8, upper: i16, lower: i16, speed: u16) {
        const KEEP: i16 = 0x7FFF;
        let all = self.limits.iter_mut().zip(1..).filter(|(_, number)| *number == motor || motor == 7);
        for (limits, _) in all {
            let keep = |new: i16, old: i16| if new == KEEP { old } else { new };
            *limits = (keep(upper, limits.0), keep(lower, limits.1), keep(speed as i16, limits.2 as i16) as u16);
        }
    }

    fn move_to_pose(&mut self) {
        let [x, y, z, roll, pitch, yaw] = six(self.pose);
        let [x, y, z] = [x, y, z].map(|v| f64::from(v) * 1e-6);
        let [roll, pitch, yaw] = [roll, pitch, yaw].map(radians);
        let goal = pose::from_xyz_rpy([x, y, z], [roll, pitch, yaw]);
        let found = self.links.inverse(&goal, &self.six()).map(|joints| joints.map(millidegrees));
        match found.filter(|joints| self.outside(joints) == 0) {
            None => self.arm.fail(state::NO_SOLUTION),
            Some(joints) => {
                let _disabled = self.arm.move_to(&joints.map(radians), self.fraction());
            }
        }
    }

    fn move_joints(&mut self, target: [i32; 6]) {
        self.beyond = self.outside(&target);
        if self.beyond != 0 {
            return self.arm.fail(state::LIMIT);
        }
        self.arm.take_goal(&target.map(radians), self.fraction(), self.follow == 0xAD);
    }

    fn fraction(&self) -> f64 {
        f64::from(self.speed.min(100)) / 100.0
    }

    /// Joints that a target would bring beyond their limits, as bits.
    fn outside(&self, target: &[i32; 6]) -> u8 {
        let joints = target.iter().zip(&self.limits).enumerate();
        if self.lenient {
            return 0;
        }
        joints.fold(0, |bits, (joint, (value, (upper, lower, _)))| {
            let inside = i32::from(*lower) * 100 - ROUNDING..=i32::from(*upper) * 100 + ROUNDING;
            bits | u8::from(!inside.contains(value)) << joint
        })
    }

    pub(super) fn six(&self) -> [f64; DOF] {
        first(&self.arm.joints().0)
    }
}

impl CanController for Controller {
    fn on_frame(&mut self, frame: &CanFrame, now: Mono, answers: &mut Vec<CanFrame>) {
        self.advance(now);
        self.arm.client_came();
        if self.arm.loses_command() {
            return;
        }
        self.trace.push(|| (now, *frame));
        self.execute(frame, answers);
    }

    fn tick(&mut self, now: Mono, frames: &mut Vec<CanFrame>) -> Delivery {
        self.advance(now);
        self.report(frames);
        let delivery = self.arm.delivery();
        if matches!(delivery, Delivery::PowerLoss(_)) {
            self.lose_power();
        }
        delivery
    }

    fn filters(&self) -> &'static [CanFilter] {
        FILTERS
    }

    fn noise(&self) -> &'static [(u16, &'static [u8])] {
        NOISE
    }

    fn start_time(&self) -> Duration {
        Duration::ZERO
    }
}

fn six([[a, b], [c, d], [e, f]]: [[i32; 2]; 3]) -> [i32; 6] {
    [a, b, c, d, e, f]
}

/// The first six of all joints.
pub(super) fn first(joints: &Joints) -> [f64; DOF] {
    joints.first_chunk().copied().unwrap_or_default()
}

/// [rad] from [0.001°].
pub(super) fn radians(wire: i32) -> f64 {
    f64::from(wire) / 360_000.0 * TAU
}

/// [0.001°] from [rad].
pub(super) fn millidegrees(value: f64) -> i32 {
    (value / TAU * 360_000.0).round() as i32
}

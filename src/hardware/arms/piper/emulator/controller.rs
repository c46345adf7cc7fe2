//! The emulated controller: what it does with a frame, and what it sends. Time is passed in, and nothing here knows of
//! buses.
//!
//! Where the sheet leaves open what an arm does, this one does the worst: a joint target that it was given while its
//! motors were off is where it goes when they come on; every reset takes the power away. One machine, hence its length.

use std::f64::consts::TAU;
use std::ops::RangeInclusive;
use std::time::Duration;

use super::super::{GripperKind, RANGES, SPEED, protocol::DOF};
use super::kinematics;
use super::wire::{self, Request, Status};
use super::{SimOptions, stops};
use crate::clock::Mono;
use crate::hardware::sim::diary::{self, Happening};
use crate::hardware::sim::faults::{Fault, FaultKind, FaultScript};
use crate::hardware::sim::gripper::Gripper;
use crate::hardware::sim::plant::Plant;
use crate::hardware::transport::can::CanFrame;
use crate::joint::Joints;

/// Pose at power-up [rad] where the options give none: not zero, so that nothing works by accident.
const INITIAL: [f64; DOF] = [0.1, 0.6, -0.7, 0.05, 0.4, -0.1];
/// How the arm sinks when its motors are off, once they have been on: how fast [rad/s], and where its joints then lie.
/// Until then somebody holds it.
const FALL: f64 = 0.3;
const FOLDED: [Option<f64>; DOF] = [None, Some(0.0), Some(0.0), None, Some(0.0), None];
/// How long the motors take to come on, one after the other.
const MOTOR_START: Duration = Duration::from_millis(40);
const NEXT_MOTOR: Duration = Duration::from_millis(5);
/// Targets that come closer together than this in time and angle are a stream [s, rad].
const STREAM: (f64, f64) = (0.1, 0.1);
/// So far beyond a limit a target may be [0.001°].
const ROUNDING: i32 = 100;
/// Speed of the gripper [m/s].
const GRIPPER_SPEED: f64 = 0.1;
/// Torque per current [Nm/A] of joints 1–3 and 4–6, and what firmware up to 1.8-2 leaves of the former's currents.
const TORQUE: [f64; 2] = [1.18125, 0.95844];
const QUARTER: f64 = 0.25;
/// States of the arm.
mod state {
    pub const ESTOP: u8 = 1;
    pub const NO_SOLUTION: u8 = 2;
    pub const LIMIT: u8 = 4;
    pub const OTHER: u8 = 10;
}
/// Most frames that are kept when recording.
const TRACE: usize = 200_000;

/// The controller's memory.
pub struct Controller {
    plant: Plant,
    gripper: Gripper,
    has_gripper: bool,
    /// Its motor is on; its error bits.
    gripper_on: bool,
    gripper_errors: u8,
    firmware: [u8; 8],
    /// Highest and lowest angle [0.1°] and speed [0.001 rad/s] of each joint.
    limits: [(i16, i16, u16); DOF],
    control: u8,
    mode: u8,
    speed: u8,
    follow: u8,
    teaching: bool,
    leading: bool,
    arm: u8,
    beyond: u8,
    /// When the E-stop is reset by itself.
    estop_until: Option<Mono>,
    motors: [bool; DOF],
    /// Since when the motors are coming on.
    starting: Option<Mono>,
    /// The parts of a pose and of joint targets that have come [0.001 mm, 0.001°], and the joint target in force.
    pose: [[i32; 2]; 3],
    joints: [[i32; 2]; 3],
    target: Option<[i32; 6]>,
    target_at: Mono,
    ticks: u64,
    script: FaultScript,
    /// When the first frame came: time zero of the script.
    first_frame: Option<Mono>,
    advanced_to: Mono,
    trace: Option<Vec<(Mono, CanFrame)>>,
    /// How often the motors lost their power under a reset.
    pub power_drops: u64,
    /// It takes targets outside its limits.
    pub lenient: bool,
    /// Frames that it does not send.
    pub muted: Option<RangeInclusive<u16>>,
}

impl Controller {
    /// A controller that was just switched on, motors off.
    pub fn new(options: &SimOptions, gripper: GripperKind, now: Mono) -> Self {
        let initial = if options.initial_positions.is_empty() { &INITIAL[..] } else { &options.initial_positions };
        let decidegrees = |value: f64| (value.to_degrees() * 10.0).round() as i16;
        let mut firmware = [0; 8];
        firmware.iter_mut().zip(options.firmware.bytes()).for_each(|(to, byte)| *to = byte);
        Self {
            plant: Plant::lagging(&stops(), initial, options.lag),
            gripper: Gripper::new(gripper.stroke().unwrap_or_default(), GRIPPER_SPEED),
            has_gripper: gripper != GripperKind::None,
            gripper_on: false,
            gripper_errors: 0,
            firmware,
            limits: RANGES.map(|(lower, upper)| (decidegrees(upper), decidegrees(lower), (SPEED * 1e3) as u16)),
            control: 0,
            mode: 0,
            speed: 0,
            follow: 0,
            teaching: false,
            leading: false,
            arm: 0,
            beyond: 0,
            estop_until: None,
            motors: [false; DOF],
            starting: None,
            pose: [[0; 2]; 3],
            joints: [[0; 2]; 3],
            target: None,
            target_at: Mono::ZERO,
            ticks: 0,
            script: FaultScript::new(&options.faults),
            first_frame: None,
            advanced_to: now,
            trace: None,
            power_drops: 0,
            lenient: false,
            muted: None,
        }
    }

    // --- For tests ---

    /// Joint positions [rad] and velocities [rad/s].
    pub fn true_joints(&self) -> (Joints, Joints) {
        (self.plant.positions(), self.plant.velocities())
    }

    /// Whether all motors are on.
    pub fn enabled(&self) -> bool {
        self.plant.enabled()
    }

    /// Starts recording frames, forgetting those recorded before.
    pub fn record(&mut self) {
        self.trace = Some(Vec::new());
    }

    /// What was recorded.
    pub fn trace(&self) -> Vec<(Mono, CanFrame)> {
        self.trace.clone().unwrap_or_default()
    }

    /// Lets a fault happen `fault.at` seconds from now.
    pub fn inject(&mut self, fault: Fault, now: Mono) {
        self.script.inject(fault, self.script_time(now));
    }

    /// The fault of this kind that strikes now, counted as one strike, and how long it still lasts.
    pub fn strikes(&mut self, kind: FaultKind, now: Mono) -> Option<Option<Duration>> {
        let t = self.script_time(now);
        self.script.take(kind, t).map(|fault| fault.left(t))
    }

    fn script_time(&self, now: Mono) -> f64 {
        self.first_frame.map_or(0.0, |first| now.seconds_since(first))
    }

    // --- Time ---

    /// Brings the joints up to `now`.
    pub fn advance(&mut self, now: Mono) {
        if self.starting.is_some() {
            self.start_motors(now);
        }
        let dt = now.seconds_since(self.advanced_to).max(0.0);
        self.plant.advance(dt);
        self.gripper.advance(dt);
        self.advanced_to = now.max(self.advanced_to);
        if self.estop_until.is_some_and(|until| now >= until) {
            (self.estop_until, self.arm) = (None, 0);
        }
    }

    /// Faults of the arm itself.
    pub fn suffer(&mut self, now: Mono) {
        let t = self.script_time(now);
        if let Some(fault) = self.script.take(FaultKind::Estop, t) {
            self.estop();
            self.estop_until = fault.left(t).map(|left| now.after(left));
        }
        match self.script.take(FaultKind::ErrorCode, t).map(|fault| fault.code) {
            None => {}
            // Of the gripper; what else the arm does not call by a number of its own.
            Some(code @ 400..=405) => {
                self.gripper_errors |= 1 << (code - 400);
                self.gripper.stop();
            }
            Some(code) => {
                self.arm = code.min(255) as u8;
                self.plant.stop();
            }
        }
        if self.script.take(FaultKind::Leader, t).is_some() {
            self.leading = true;
        }
        let blocked = self.script.take(FaultKind::Blocked, t).map(|fault| fault.joint.saturating_sub(1));
        (0..DOF).for_each(|joint| self.plant.block(joint, blocked == Some(joint)));
    }

    /// Everything is off, and starts anew when the power is back.
    pub fn lose_power(&mut self) {
        (self.control, self.mode, self.speed, self.follow, self.arm, self.beyond) = (0, 0, 0, 0, 0, 0);
        (self.teaching, self.target, self.estop_until) = (false, None, None);
        self.motors_off();
    }

    fn estop(&mut self) {
        self.arm = state::ESTOP;
        self.estop_until = None;
        self.motors_off();
    }

    fn motors_off(&mut self) {
        self.motors = [false; DOF];
        self.starting = None;
        self.gripper_on = false;
        self.gripper.stop();
        self.plant.enable(false);
    }

    fn start_motors(&mut self, now: Mono) {
        let Some(since) = self.starting else { return };
        for (motor, joint) in self.motors.iter_mut().zip(0..) {
            *motor |= now >= since.after(MOTOR_START + NEXT_MOTOR * joint);
        }
        if self.motors != [true; DOF] {
            return;
        }
        self.starting = None;
        let t = self.script_time(now);
        if let Some(fault) = self.script.take(FaultKind::Sag, t) {
            self.plant.sag(fault.amount);
        }
        self.plant.enable(true);
        self.plant.falls(FALL, &FOLDED);
        if let (Some(target), 1) = (self.target, self.control) {
            self.plant.move_to(&target.map(radians), 1.0);
        }
    }

    // --- Commands ---

    /// Does what a frame says; answers go into `out`.
    pub fn handle(&mut self, frame: &CanFrame, now: Mono, out: &mut Vec<CanFrame>) {
        self.advance(now);
        if self.first_frame.is_none() {
            self.first_frame = Some(now);
            diary::note(Happening::Came);
        }
        if let Some(trace) = &mut self.trace
            && trace.len() < TRACE
        {
            trace.push((now, *frame));
        }
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
            // Standby; a mode that this emulator has not; whoever is being taught does not listen.
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
                    self.move_joints(six(self.joints), now);
                }
            }
            Request::Gripper(stroke, _, action) => self.grip(stroke, action),
            Request::Role(0xFA) => self.leading = true,
            Request::Role(0xFC) => self.leading = false,
            Request::Role(_) => {}
            Request::Motors(motor, action) => self.switch(motor, action, now),
            Request::Query(motor, what) => out.extend(self.answer(motor, what)),
            Request::SetLimits(motor, upper, lower, speed) => self.set_limits(motor, upper, lower, speed),
            Request::Configure(_, _, clear) if clear && self.arm != state::ESTOP => (self.arm, self.beyond) = (0, 0),
            Request::Configure(..) => {}
            Request::Firmware => out.push(wire::firmware(&self.firmware)),
        }
    }

    /// Bit 0 of `action`: on, and to this stroke [0.001 mm]; bit 1: errors are cleared before that.
    fn grip(&mut self, stroke: i32, action: u8) {
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

    /// A mode that is not emulated: said, not passed over.
    fn cannot(&mut self) {
        self.arm = if self.arm == 0 { state::OTHER } else { self.arm };
        self.plant.stop();
    }

    fn listens(&self, mode: u8) -> bool {
        self.control == 1 && self.mode == mode && self.arm == 0
    }

    fn switch(&mut self, motor: u8, action: u8, now: Mono) {
        let which = usize::from(motor.wrapping_sub(1));
        match (motor, action) {
            (7 | 255, 2) if self.arm == state::ESTOP => {}
            (7 | 255, 2) if self.motors != [true; DOF] => {
                self.starting.get_or_insert(now);
                self.gripper_on = true;
            }
            (7 | 255, 1) => self.motors_off(),
            (1..=6, 1 | 2) if self.arm != state::ESTOP => {
                self.motors.get_mut(which).into_iter().for_each(|on| *on = action == 2);
                match self.motors == [true; DOF] {
                    true => self.starting = Some(now.before(Duration::from_secs(1))),
                    false => self.plant.enable(false),
                }
            }
            _ => {}
        }
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
        let goal = kinematics::from_values([x, y, z, roll, pitch, yaw]);
        let found = kinematics::inverse(&goal, &self.six()).map(|joints| joints.map(millidegrees));
        match found.filter(|joints| self.outside(joints) == 0) {
            None => {
                self.arm = state::NO_SOLUTION;
                self.plant.stop();
            }
            Some(joints) => self.plant.move_to(&joints.map(radians), self.fraction()),
        }
    }

    fn move_joints(&mut self, target: [i32; 6], now: Mono) {
        self.beyond = self.outside(&target);
        if self.beyond != 0 {
            self.arm = state::LIMIT;
            return self.plant.stop();
        }
        let values = target.map(radians);
        let before = self.target.replace(target);
        let pause = now.seconds_since(self.target_at);
        self.target_at = now;
        let step = before.map_or(f64::MAX, |before| {
            let steps = before.iter().zip(&target).map(|(a, b)| radians((a - b).saturating_abs()));
            steps.fold(0.0, f64::max)
        });
        let streamed = pause < STREAM.0 && step < STREAM.1;
        if self.follow == 0xAD || (streamed && step > 0.0) {
            self.plant.servo(&values);
        } else if !streamed {
            self.plant.move_to(&values, self.fraction());
        }
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

    // --- Feedback ---

    /// What is sent in the period that begins now; the slow frames come with every fifth.
    pub fn report(&mut self, now: Mono, out: &mut Vec<CanFrame>) {
        self.advance(now);
        self.ticks += 1;
        let stroke = (self.gripper.position * 1e6).round() as i32;
        let zero = self.strikes(FaultKind::ZeroState, now).is_some();
        let (mut positions, mut velocities) = (self.six(), first(&self.plant.velocities()));
        if self.leading {
            return out.extend(wire::leading(positions.map(millidegrees), stroke));
        }
        if zero {
            (positions, velocities) = ([0.0; DOF], [0.0; DOF]);
        }
        let status = Status {
            control: self.control,
            arm: self.arm,
            mode: self.mode,
            teach: u8::from(self.teaching),
            moving: self.plant.moving(),
            limits: self.beyond,
        };
        out.push(status.frame());
        let [x, y, z, roll, pitch, yaw] = kinematics::to_values(&kinematics::forward(&positions));
        let ([x, y, z], [roll, pitch, yaw]) =
            ([x, y, z].map(|v| (v * 1e6).round() as i32), [roll, pitch, yaw].map(millidegrees));
        out.extend(wire::triple(0x2A2, [x, y, z, roll, pitch, yaw]));
        out.extend(wire::triple(0x2A5, positions.map(millidegrees)));
        if self.has_gripper {
            let on = if self.gripper_on { 0x40 } else { 0 };
            out.push(wire::gripper(stroke, 0, 0x80 | on | self.gripper_errors)); // it knows its zero
        }
        let efforts = first(&self.plant.efforts());
        let milli = |value: f64| (value * 1e3).round() as i32;
        for (((joint, velocity), effort), position) in (1..).zip(velocities).zip(efforts).zip(positions) {
            let (torque, part) = if joint <= 3 { (TORQUE[0], self.part()) } else { (TORQUE[1], 1.0) };
            out.push(wire::motor(joint, milli(velocity), milli(effort / torque * part), milli(position)));
        }
        if self.ticks.is_multiple_of(5) {
            for (joint, on) in (1..).zip(self.motors) {
                out.push(wire::driver(joint, 240, [35, 30], if on { 0x40 } else { 0 }, if on { 400 } else { 20 }));
            }
        }
        if let Some(muted) = &self.muted {
            out.retain(|frame| !muted.contains(&frame.id));
        }
    }

    /// What this firmware reports of the currents of joints 1 to 3.
    fn part(&self) -> f64 {
        if self.firmware.as_slice() <= b"S-V1.8-2".as_slice() { QUARTER } else { 1.0 }
    }

    fn six(&self) -> [f64; DOF] {
        first(&self.plant.positions())
    }
}

fn six([[a, b], [c, d], [e, f]]: [[i32; 2]; 3]) -> [i32; 6] {
    [a, b, c, d, e, f]
}

/// The first six of all joints.
fn first(joints: &Joints) -> [f64; DOF] {
    joints.first_chunk().copied().unwrap_or_default()
}

/// [rad] from [0.001°].
fn radians(wire: i32) -> f64 {
    f64::from(wire) / 360_000.0 * TAU
}

/// [0.001°] from [rad].
fn millidegrees(value: f64) -> i32 {
    (value / TAU * 360_000.0).round() as i32
}

//! What is known of the arm: its feedback frames put together.
//!
//! Positions and poses come in three frames each. A set counts when its three frames came in order and belong to one
//! burst: never half of one measurement and half of the next.

use std::time::Duration;

use super::guard::Guard;
use super::jump_filter::JumpFilter;
use super::protocol::{
    DOF, Driver, FeedbackFrame, Gripper, Motor, MotorLimits, Status, WireJoints, arm_text, driver_text, gripper_text,
};
use crate::clock::{Clock, Mono, MonotonicClock};

/// Frames of one burst arrive within less than a period of the arm.
const BURST: Duration = Duration::from_millis(4);
/// No joint is farther round than this [0.001°].
const FAR: u32 = 360_000;
/// Positions come every 5 ms. After a longer pause than this those that waited on their way arrive first, all at once.
const PAUSE: Duration = Duration::from_millis(20);
/// For how long after a pause positions may be such.
const WAITED: Duration = Duration::from_millis(10);
/// A set of zeros is not believed of an arm that was farther away than this at the last one [0.001°].
const NOT_ZERO: u32 = 5_000;
/// After this time an arm at exactly zero is taken to be there.
const ZEROS: Duration = Duration::from_secs(1);
/// A motor that says no more than this stands [0.001 rad/s].
pub const STANDSTILL: i32 = 20;
/// Room for the text of the firmware.
const TEXT: usize = 128;

/// Three frames that make six numbers.
#[derive(Debug, Clone, Copy, Default)]
struct Triple {
    parts: [[i32; 2]; 3],
    next: usize,
    began: Mono,
}

impl Triple {
    /// Takes a part; the answer is the set that it completes.
    fn take(&mut self, part: usize, pair: [i32; 2], now: Mono) -> Option<[i32; 6]> {
        if part == 0 {
            self.began = now;
        } else if part != self.next || now.since(self.began) > BURST {
            self.next = 0;
            return None;
        }
        *self.parts.get_mut(part)? = pair;
        self.next = (part + 1) % 3;
        let [[a, b], [c, d], [e, f]] = self.parts;
        (self.next == 0).then_some([a, b, c, d, e, f])
    }
}

/// What was counted since the connection was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Frames that meant something.
    pub decoded: u64,
    /// Complete sets of joint positions.
    pub sets: u64,
    /// Frames too short, and sets of positions that are not believed.
    pub damaged: u64,
    /// Frames of no interest.
    pub other: u64,
    /// Frames such as an arm sends that leads others.
    pub leader: u64,
}

/// The arm's newest feedback. `Mono::ZERO` stands for never.
#[derive(Debug, Clone)]
pub struct Feedback {
    /// The newest believed joint positions [0.001°].
    pub joints: WireJoints,
    /// When `joints` was completed.
    pub joints_at: Mono,
    /// When the first of them arrived after the latest pause of [`PAUSE`].
    pub resumed_at: Mono,
    /// x, y, z [0.001 mm], roll, pitch, yaw [0.001°].
    pub pose: Option<[i32; 6]>,
    /// The controller's state.
    pub status: Status,
    /// When `status` arrived.
    pub status_at: Mono,
    /// Speeds and currents.
    pub motors: [Motor; DOF],
    /// When each of `motors` arrived.
    motors_at: [Mono; DOF],
    /// Voltages, temperatures, errors.
    pub drivers: [Driver; DOF],
    /// When each of `drivers` arrived.
    drivers_at: [Mono; DOF],
    /// The gripper, once it was heard of.
    pub gripper: Option<Gripper>,
    /// Whether the gripper is used: only then its errors are errors.
    pub gripper_used: bool,
    /// The limits that the controller was asked for.
    pub limits: [Option<MotorLimits>; DOF],
    /// When somebody else last sent a command to an arm on this bus.
    pub commanded_at: Mono,
    /// Changes that this run did not order.
    pub guard: Guard,
    /// What was counted.
    pub counts: Counts,
    jump_filter: JumpFilter,
    /// Since when every joint has read exactly zero.
    zeros_since: Option<Mono>,
    joint_parts: Triple,
    pose_parts: Triple,
    text: [u8; TEXT],
    text_length: usize,
}

impl Default for Feedback {
    fn default() -> Self {
        Self {
            joints: [0; DOF],
            joints_at: Mono::ZERO,
            resumed_at: Mono::ZERO,
            pose: None,
            status: Status::default(),
            status_at: Mono::ZERO,
            motors: Default::default(),
            motors_at: [Mono::ZERO; DOF],
            drivers: Default::default(),
            drivers_at: [Mono::ZERO; DOF],
            gripper: None,
            gripper_used: false,
            limits: [None; DOF],
            commanded_at: Mono::ZERO,
            guard: Guard::default(),
            counts: Counts::default(),
            jump_filter: JumpFilter::default(),
            zeros_since: None,
            joint_parts: Triple::default(),
            pose_parts: Triple::default(),
            text: [0; TEXT],
            text_length: 0,
        }
    }
}

impl Feedback {
    /// Nothing known yet, of an arm whose gripper is used or not.
    pub fn of_arm(gripper_used: bool) -> Self {
        Self { gripper_used, ..Self::default() }
    }

    /// Adds what a frame says that arrived at `now`.
    pub fn take(&mut self, feedback: FeedbackFrame, now: Mono) {
        match feedback {
            FeedbackFrame::Other => return self.counts.other += 1,
            FeedbackFrame::Damaged => return self.counts.damaged += 1,
            FeedbackFrame::Leader | FeedbackFrame::Command => {
                self.commanded_at = now;
                self.guard.commanded();
                return self.counts.leader += u64::from(feedback == FeedbackFrame::Leader);
            }
            _ => self.counts.decoded += 1,
        }
        match feedback {
            FeedbackFrame::Joints(part, pair) => {
                if let Some(joints) = self.joint_parts.take(part, pair, now) {
                    self.take_joints(joints, now);
                }
            }
            FeedbackFrame::Pose(part, pair) => self.pose = self.pose_parts.take(part, pair, now).or(self.pose),
            FeedbackFrame::Status(status) => {
                (self.status, self.status_at) = (status, now);
                self.guard.status(&status, now);
            }
            FeedbackFrame::Gripper(gripper) => self.gripper = Some(gripper),
            FeedbackFrame::Motor(joint, motor) => {
                if let (Some(to), Some(at)) = (self.motors.get_mut(joint), self.motors_at.get_mut(joint)) {
                    (*to, *at) = (motor, now);
                }
            }
            FeedbackFrame::Driver(joint, driver) => {
                if let (Some(to), Some(at)) = (self.drivers.get_mut(joint), self.drivers_at.get_mut(joint)) {
                    (*to, *at) = (driver, now);
                    if !driver.enabled() {
                        self.guard.motor_off(now);
                    }
                }
            }
            FeedbackFrame::Limits(joint, limits) => {
                self.limits.get_mut(joint).into_iter().for_each(|to| *to = Some(limits));
            }
            FeedbackFrame::Firmware(piece, length) => {
                let room = self.text.get_mut(self.text_length..).unwrap_or_default();
                let count = length.min(room.len());
                room.iter_mut().zip(piece.iter().take(count)).for_each(|(to, from)| *to = *from);
                self.text_length += count;
            }
            FeedbackFrame::Other | FeedbackFrame::Damaged | FeedbackFrame::Leader | FeedbackFrame::Command => {}
        }
    }

    fn take_joints(&mut self, joints: WireJoints, now: Mono) {
        let far = joints.iter().any(|value| value.unsigned_abs() > FAR);
        // A controller that has just started says zero before it has asked its joints.
        let elsewhere = self.joints_at != Mono::ZERO && self.joints.iter().any(|value| value.unsigned_abs() > NOT_ZERO);
        if far || (elsewhere && joints == [0; DOF]) || !self.jump_filter.take(joints, now) {
            return self.counts.damaged += 1;
        }
        self.zeros_since = (joints == [0; DOF]).then(|| self.zeros_since.unwrap_or(now));
        if now.since(self.joints_at) > PAUSE {
            self.resumed_at = now;
        }
        (self.joints, self.joints_at) = (joints, now);
        self.counts.sets += 1;
    }

    /// Whether every joint reads exactly zero, and has not done so for long yet.
    pub fn only_zeros(&self, now: Mono) -> bool {
        self.joints == [0; DOF] && self.zeros_since.is_none_or(|since| now.since(since) < ZEROS)
    }

    /// Whether the positions are measured now, as far as their arrival shows.
    pub fn is_live(&self) -> bool {
        let now = MonotonicClock.now();
        now.since(self.joints_at) <= PAUSE && self.joints_at.since(self.resumed_at) >= WAITED
    }

    /// Whether joint positions were refused lately, so that the believed ones may be the wrong ones.
    pub fn disputed(&self, now: Mono) -> bool {
        self.jump_filter.disputed(now)
    }

    /// Whether all motors say that they stand.
    pub fn stands(&self) -> bool {
        self.motors.iter().all(|motor| i32::from(motor.speed).abs() <= STANDSTILL)
    }

    /// Whether everything was heard of that the reads need.
    pub fn complete(&self) -> bool {
        let others = self.motors_at.iter().chain(&self.drivers_at);
        [self.joints_at, self.status_at].iter().chain(others).all(|at| *at != Mono::ZERO)
    }

    /// Whether every motor was heard of after this time.
    pub fn motors_heard(&self, after: Mono) -> bool {
        self.motors_at.iter().all(|at| *at > after)
    }

    /// Whether every driver was heard of after this time.
    pub fn drivers_heard(&self, after: Mono) -> bool {
        self.drivers_at.iter().all(|at| *at > after)
    }

    /// The joints, counted from 1, whose drivers were not heard of after this time: `2, 5`.
    pub fn silent_drivers(&self, after: Mono) -> String {
        let silent = (1..).zip(&self.drivers_at).filter(|(_, at)| **at <= after);
        silent.map(|(joint, _): (u32, _)| joint.to_string()).collect::<Vec<_>>().join(", ")
    }

    /// Whether every motor is on.
    pub fn enabled(&self) -> bool {
        self.drivers.iter().all(Driver::enabled)
    }

    /// Whether every motor is off.
    pub fn disabled(&self) -> bool {
        !self.drivers.iter().any(Driver::enabled)
    }

    /// The firmware as (1, 6, 3) for `S-V1.6-3`, once the controller has said it.
    pub fn firmware(&self) -> Option<(u8, u8, u8)> {
        let text = self.text.get(..self.text_length)?;
        let start = text.windows(3).position(|window| window == b"S-V")? + 3;
        let rest = text.get(start..start + 5)?;
        let digit = |at: usize| rest.get(at).filter(|c| c.is_ascii_digit()).map(|c| c - b'0');
        Some((digit(0)?, digit(2)?, digit(4)?))
    }

    // --- Errors ---

    /// The first error, by weight: 1–15 and above a state of the arm, 201–206 a joint that does not answer, 101–106 a
    /// joint beyond its limits, 3jb bit b of the driver of joint j, 40b bit b of the gripper; 0 = none.
    pub fn error_code(&self) -> i32 {
        let bit = |bits: u8| bits.trailing_zeros() as i32 + 1;
        let Status { arm, limits, silent, .. } = self.status;
        if !matches!(arm, 0 | 11..=13) {
            return arm.into();
        }
        if silent != 0 {
            return 200 + bit(silent);
        }
        if limits != 0 {
            return 100 + bit(limits);
        }
        let driver = self.driver_errors().map(|(joint, bit, _)| 300 + 10 * joint as i32 + i32::from(bit)).next();
        driver.or_else(|| self.gripper_errors().next().map(|(bit, _)| 400 + i32::from(bit))).unwrap_or(0)
    }

    /// All that is wrong, in words; empty when nothing is.
    pub fn error_text(&self) -> String {
        if self.error_code() == 0 {
            return String::new();
        }
        let mut parts = Vec::new();
        if !matches!(self.status.arm, 0 | 11..=13) {
            parts.push(arm_text(self.status.arm).to_owned());
        }
        for joint in 1..=DOF {
            let has = |bits: u8| bits & (1 << (joint - 1)) != 0;
            if has(self.status.silent) {
                parts.push(format!("joint {joint} does not answer"));
            }
            if has(self.status.limits) {
                parts.push(format!("joint {joint} beyond its limits"));
            }
        }
        parts.extend(self.driver_errors().map(|(joint, bit, driver)| {
            let what = driver_text(bit).unwrap_or_default();
            match bit {
                0 => format!("joint {joint}: {what} ({:.1} V)", f64::from(driver.voltage) / 10.0),
                1 => format!("joint {joint}: {what} ({} °C)", driver.motor_temperature),
                3 => format!("joint {joint}: {what} ({} °C)", driver.driver_temperature),
                _ => format!("joint {joint}: {what}"),
            }
        }));
        parts.extend(self.gripper_errors().map(|(_, what)| format!("gripper: {what}")));
        parts.join("; ")
    }

    /// Joint (from 1), bit and driver of every error that a driver reports.
    fn driver_errors(&self) -> impl Iterator<Item = (usize, u8, &Driver)> {
        self.drivers.iter().enumerate().flat_map(|(i, driver)| {
            let errors = (0..8).filter(|bit| driver.status & (1 << bit) != 0 && driver_text(*bit).is_some());
            errors.map(move |bit| (i + 1, bit, driver))
        })
    }

    /// Bit and words of every error that the gripper reports, where it is used.
    pub fn gripper_errors(&self) -> impl Iterator<Item = (u8, &'static str)> {
        let status = self.gripper.filter(|_| self.gripper_used).map_or(0, |gripper| gripper.status);
        (0..8).filter(move |bit| status & (1 << bit) != 0).filter_map(|bit| Some((bit, gripper_text(bit)?)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(n: u64) -> Mono {
        Mono(1_000_000_000 + n * 1_000_000)
    }

    fn joints(feedback: &mut Feedback, part: usize, value: i32, at: Mono) {
        feedback.take(FeedbackFrame::Joints(part, [value, value]), at);
    }

    #[test]
    fn a_set_is_three_frames_of_one_burst_in_order() {
        let mut feedback = Feedback::default();
        (0..3).for_each(|part| joints(&mut feedback, part, 1, ms(part as u64)));
        assert_eq!((feedback.joints, feedback.joints_at), ([1; 6], ms(2)));
        // Each of the three lost in turn: no set.
        for lost in 0..3 {
            (0..3).filter(|part| *part != lost).for_each(|part| joints(&mut feedback, part, 7, ms(10)));
        }
        assert_eq!(feedback.joints, [1; 6]);
        // The end of one burst and that of the next.
        joints(&mut feedback, 0, 8, ms(20));
        joints(&mut feedback, 1, 8, ms(20));
        joints(&mut feedback, 2, 9, ms(25));
        assert_eq!((feedback.joints, feedback.counts.sets), ([1; 6], 1));
        (0..3).for_each(|part| joints(&mut feedback, part, -5, ms(30)));
        assert_eq!((feedback.joints, feedback.joints_at), ([-5; 6], ms(30)));
        // What no arm can have reached in that time.
        (0..3).for_each(|part| joints(&mut feedback, part, 60_000, ms(35)));
        assert_eq!((feedback.joints, feedback.counts.damaged), ([-5; 6], 1));
        assert!(feedback.disputed(ms(35)));
    }

    #[test]
    fn sudden_zeros_and_impossible_angles_are_not_believed() {
        let mut feedback = Feedback::default();
        let mut at = 1;
        let mut set = |value: i32| {
            at += 200;
            (0..3).for_each(|part| joints(&mut feedback, part, value, ms(at)));
            feedback.joints[0]
        };
        assert_eq!(set(0), 0, "the first may be zero: activation looks again");
        assert_eq!(set(40_000), 40_000);
        assert_eq!(set(0), 40_000);
        assert_eq!(set(400_000), 40_000);
        assert_eq!(set(4_000), 4_000);
        assert_eq!(set(0), 0, "close to zero, zero is plausible");
        assert_eq!(feedback.counts.damaged, 2);
    }

    #[test]
    fn errors_have_a_code_and_all_their_words() {
        let mut feedback = Feedback::default();
        assert_eq!((feedback.error_code(), feedback.error_text()), (0, String::new()));
        let hot = Driver { motor_temperature: 84, status: 0x40 | 0b10, ..Driver::default() };
        feedback.take(FeedbackFrame::Driver(2, hot), ms(0));
        assert_eq!((feedback.error_code(), feedback.error_text()), (331, "joint 3: motor too hot (84 °C)".into()));
        feedback.take(FeedbackFrame::Status(Status { limits: 0b10, silent: 0b100000, ..Status::default() }), ms(0));
        assert_eq!(feedback.error_code(), 206);
        feedback.take(FeedbackFrame::Status(Status { arm: 9, limits: 0b10, ..Status::default() }), ms(0));
        let text = "a joint is in error; joint 2 beyond its limits; joint 3: motor too hot (84 °C)";
        assert_eq!((feedback.error_code(), feedback.error_text()), (9, text.into()));
        feedback.take(FeedbackFrame::Status(Status { arm: 12, ..Status::default() }), ms(0));
        assert_eq!(feedback.error_code(), 331, "being taught is no error");
        let closed_too_hard = Gripper { status: 0xC0 | 0b100100, ..Gripper::default() };
        let mut feedback = Feedback::default();
        feedback.take(FeedbackFrame::Gripper(closed_too_hard), ms(0));
        assert_eq!((feedback.error_code(), feedback.error_text()), (0, String::new()), "of no interest");
        feedback.gripper_used = true;
        let text = "gripper: overcurrent; gripper: driver error";
        assert_eq!((feedback.error_code(), feedback.error_text()), (402, text.into()));
        feedback.take(FeedbackFrame::Driver(2, hot), ms(0));
        let text = "joint 3: motor too hot (84 °C); gripper: overcurrent; gripper: driver error";
        assert_eq!((feedback.error_code(), feedback.error_text()), (331, text.into()));
    }

    #[test]
    fn the_firmware_is_found_in_its_pieces() {
        let mut feedback = Feedback::default();
        for (piece, length) in [(b"\0H-V1.2-", 8), (b"1 S-V1.6", 8), (b"-3\0\0\0\0\0\0", 2)] {
            assert_eq!(feedback.firmware(), None);
            feedback.take(FeedbackFrame::Firmware(*piece, length), ms(0));
        }
        assert_eq!(feedback.firmware(), Some((1, 6, 3)));
        (0..1000).for_each(|_| feedback.take(FeedbackFrame::Firmware([b'x'; 8], 8), ms(0)));
        assert_eq!(feedback.firmware(), Some((1, 6, 3)));
    }

    #[test]
    fn it_is_complete_when_every_part_was_heard() {
        let mut feedback = Feedback::default();
        (0..3).for_each(|part| joints(&mut feedback, part, 1, ms(0)));
        feedback.take(FeedbackFrame::Status(Status::default()), ms(0));
        for joint in 0..DOF {
            assert!(!feedback.complete());
            feedback.take(FeedbackFrame::Motor(joint, Motor::default()), ms(0));
            feedback.take(FeedbackFrame::Driver(joint, Driver { status: 0x40, ..Driver::default() }), ms(0));
        }
        assert!(feedback.complete() && feedback.enabled() && !feedback.disabled());
    }
}

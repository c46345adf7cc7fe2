//! Assembles the arm's feedback frames into complete measurements.
//!
//! Positions and poses come in three frames each. A set is complete when its three frames arrived in order and in one
//! burst, so it never mixes two measurements.

mod errors;
mod frame_set;
#[cfg(test)]
mod tests;

use std::time::Duration;

use frame_set::FrameSet;

use super::guard::Guard;
use super::jump_filter::JumpFilter;
use super::protocol::{DOF, Driver, FeedbackFrame, Gripper, Motor, MotorLimits, Status, WireJoints};
use dimos_core::clock::Mono;

/// Largest plausible joint position [0.001°].
const MAX_ANGLE: u32 = 360_000;
/// A set of zeros is implausible when a joint was farther from zero than this in the previous set [0.001°].
const ZERO_SET_MAX_JUMP: u32 = 5_000;
/// After this time, zeros count as the arm's real position.
const ZEROS_TIME: Duration = Duration::from_secs(1);
/// Standstill threshold of a motor's reported speed [0.001 rad/s].
pub const STANDSTILL: i32 = 20;
/// Capacity for the firmware's version text.
const TEXT_CAPACITY: usize = 128;

/// Counts since the connection was made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counts {
    /// Frames that were decoded.
    pub decoded: u64,
    /// Complete sets of joint positions.
    pub sets: u64,
    /// Frames that are too short, and implausible sets of positions.
    pub damaged: u64,
    /// Frames that are not used.
    pub other: u64,
    /// Frames that only a leader arm sends.
    pub leader: u64,
}

/// The arm's newest feedback. A time of `Mono::ZERO` means never.
#[derive(Debug, Clone)]
pub struct Feedback {
    /// The newest plausible joint positions [0.001°].
    pub joints: WireJoints,
    /// When `joints` was completed.
    pub joints_at: Mono,
    /// When positions were last accepted to which no motion led.
    pub jumped_at: Mono,
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
    /// The gripper, once it has reported.
    pub gripper: Option<Gripper>,
    /// Whether the gripper is used. If not, its errors are ignored.
    pub gripper_used: bool,
    /// Motor limits that the controller reported.
    pub limits: [Option<MotorLimits>; DOF],
    /// When another client last commanded an arm on this bus.
    pub commanded_at: Mono,
    /// Changes that this run did not order.
    pub guard: Guard,
    /// Counts.
    pub counts: Counts,
    jump_filter: JumpFilter,
    /// Since when every joint has read exactly zero.
    zeros_since: Option<Mono>,
    joint_parts: FrameSet,
    pose_parts: FrameSet,
    text: [u8; TEXT_CAPACITY],
    text_length: usize,
}

impl Default for Feedback {
    fn default() -> Self {
        Self {
            joints: [0; DOF],
            joints_at: Mono::ZERO,
            jumped_at: Mono::ZERO,
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
            joint_parts: FrameSet::default(),
            pose_parts: FrameSet::default(),
            text: [0; TEXT_CAPACITY],
            text_length: 0,
        }
    }
}

impl Feedback {
    /// Returns empty feedback, for an arm whose gripper is used or not.
    pub fn of_arm(gripper_used: bool) -> Self {
        Self { gripper_used, ..Self::default() }
    }

    /// Adds a frame that arrived at `now`.
    pub fn take(&mut self, frame: FeedbackFrame, now: Mono) {
        match frame {
            FeedbackFrame::Other => return self.counts.other += 1,
            FeedbackFrame::Damaged => return self.counts.damaged += 1,
            FeedbackFrame::Leader | FeedbackFrame::Command => {
                self.commanded_at = now;
                self.guard.commanded();
                return self.counts.leader += u64::from(frame == FeedbackFrame::Leader);
            }
            _ => self.counts.decoded += 1,
        }
        match frame {
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
        let far = joints.iter().any(|value| value.unsigned_abs() > MAX_ANGLE);
        // A controller that has just started reports zeros until it has read its joints.
        let elsewhere =
            self.joints_at != Mono::ZERO && self.joints.iter().any(|value| value.unsigned_abs() > ZERO_SET_MAX_JUMP);
        if far || (elsewhere && joints == [0; DOF]) || !self.jump_filter.take(joints, now) {
            return self.counts.damaged += 1;
        }
        self.zeros_since = (joints == [0; DOF]).then(|| self.zeros_since.unwrap_or(now));
        self.jumped_at = self.jump_filter.jumped_at;
        (self.joints, self.joints_at) = (joints, now);
        self.counts.sets += 1;
    }

    /// Returns whether every joint reads exactly zero, and has for less than a second.
    pub fn only_zeros(&self, now: Mono) -> bool {
        self.joints == [0; DOF] && self.zeros_since.is_none_or(|since| now.since(since) < ZEROS_TIME)
    }

    /// Returns whether positions were rejected recently, so that the accepted ones may be wrong.
    pub fn disputed(&self, now: Mono) -> bool {
        self.jump_filter.disputed(now)
    }

    /// Returns whether all motors report to be stationary.
    pub fn is_stationary(&self) -> bool {
        self.motors.iter().all(|motor| i32::from(motor.speed).abs() <= STANDSTILL)
    }

    /// Returns whether every frame that the reads need has arrived.
    pub fn complete(&self) -> bool {
        let others = self.motors_at.iter().chain(&self.drivers_at);
        [self.joints_at, self.status_at].iter().chain(others).all(|at| *at != Mono::ZERO)
    }

    /// Returns whether every motor has reported after `after`.
    pub fn motors_heard(&self, after: Mono) -> bool {
        self.motors_at.iter().all(|at| *at > after)
    }

    /// Returns whether every driver has reported after `after`.
    pub fn drivers_heard(&self, after: Mono) -> bool {
        self.drivers_at.iter().all(|at| *at > after)
    }

    /// Returns the joints, from 1, whose drivers have not reported after `after`: `2, 5`.
    pub fn silent_drivers(&self, after: Mono) -> String {
        let silent = (1..).zip(&self.drivers_at).filter(|(_, at)| **at <= after);
        silent.map(|(joint, _): (u32, _)| joint.to_string()).collect::<Vec<_>>().join(", ")
    }

    /// Returns whether every motor is on.
    pub fn enabled(&self) -> bool {
        self.drivers.iter().all(Driver::enabled)
    }

    /// Returns whether every motor is off.
    pub fn disabled(&self) -> bool {
        !self.drivers.iter().any(Driver::enabled)
    }

    /// Returns the firmware version, (1, 6, 3) for `S-V1.6-3`, once the controller has reported it.
    pub fn firmware(&self) -> Option<(u8, u8, u8)> {
        let text = self.text.get(..self.text_length)?;
        let start = text.windows(3).position(|window| window == b"S-V")? + 3;
        let rest = text.get(start..start + 5)?;
        let digit = |at: usize| rest.get(at).filter(|c| c.is_ascii_digit()).map(|c| c - b'0');
        Some((digit(0)?, digit(2)?, digit(4)?))
    }
}

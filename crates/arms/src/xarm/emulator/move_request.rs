//! What a request asks of a planned move, read from its payload: the registers differ in their lengths, not in what
//! their fields mean.

use nalgebra::{Isometry3, Translation3};

use super::kinematics::{from_wire, from_wire_axis_angle, to_wire};
use super::wire::{number, numbers};

/// A request for a move.
#[derive(Debug, Clone, Copy)]
pub struct MoveRequest {
    /// Where it ends.
    pub target: Target,
    /// Highest speed [rad/s or mm/s].
    pub speed: f32,
    /// Highest acceleration [rad/s² or mm/s²].
    pub acceleration: f32,
    /// The move is only checked, not made.
    pub checks_only: bool,
    /// The response has a third byte: the result of the check.
    pub has_result: bool,
}

/// Where a move ends.
#[derive(Debug, Clone, Copy)]
pub enum Target {
    /// At joint positions [rad]; infinite ones stay as they are.
    Joints([f32; 7]),
    /// At joint positions that differ by this from those at the start [rad].
    JointChange([f32; 7]),
    /// At a pose of the tool [mm, rad].
    Pose([f32; 6], Frame, Orientation),
}

/// What a pose refers to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Frame {
    /// The base. Infinite values stay as they are.
    Base,
    /// The tool at the start.
    Tool,
    /// The pose at the start, in the directions of the base.
    Start,
}

/// How the last three values of a pose are meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Orientation {
    /// Roll, pitch, yaw about fixed axes.
    RollPitchYaw,
    /// A rotation vector.
    AxisAngle,
}

impl Orientation {
    fn of(flag: u8) -> Option<Self> {
        match flag {
            0 => Some(Self::RollPitchYaw),
            1 => Some(Self::AxisAngle),
            _ => None,
        }
    }

    fn pose(self, values: [f32; 6]) -> Isometry3<f64> {
        match self {
            Self::RollPitchYaw => from_wire(values),
            Self::AxisAngle => from_wire_axis_angle(values),
        }
    }
}

impl Frame {
    /// Returns the pose that values mean for a tool that is at `start`; `None` if they are not finite.
    pub fn goal(self, start: &Isometry3<f64>, mut values: [f32; 6], how: Orientation) -> Option<Isometry3<f64>> {
        if self == Self::Base && how == Orientation::RollPitchYaw {
            let kept = to_wire(start);
            values.iter_mut().zip(kept).filter(|(value, _)| **value == f32::INFINITY).for_each(|(v, k)| *v = k);
        }
        if !values.iter().all(|value| value.is_finite()) {
            return None;
        }
        Some(match (self, how) {
            (Self::Base, _) => how.pose(values),
            (Self::Tool, _) => start * how.pose(values),
            (Self::Start, Orientation::RollPitchYaw) => {
                let mut sum = to_wire(start);
                sum.iter_mut().zip(values).for_each(|(value, change)| *value += change);
                from_wire(sum)
            }
            (Self::Start, Orientation::AxisAngle) => {
                let change = how.pose(values);
                let place = Translation3::from(start.translation.vector + change.translation.vector);
                Isometry3::from_parts(place, change.rotation * start.rotation)
            }
        })
    }
}

impl MoveRequest {
    /// A move to a target, without speed.
    pub fn to(target: Target) -> Self {
        Self { target, speed: 0.0, acceleration: 0.0, checks_only: false, has_result: false }
    }

    /// Reads the request of a planned move; `None` for a payload that the register does not have.
    pub fn planned(register: u8, data: &[u8]) -> Option<Self> {
        // Numbers of the register, then bytes: those that say what the numbers mean, the check, the kind of motion.
        let (count, meanings) = match (register, data.len()) {
            (21, 43..) => (10, 2),
            (21 | 28, _) => (9, 0),
            (22..=24, _) => (10, 0),
            (25, _) => (3, 0),
            (83, _) => (11, 2),
            (92, _) => (9, 2),
            _ => return None,
        };
        let bytes = data.get(4 * count..)?;
        let (meaning, rest) = bytes.split_at_checked(meanings)?;
        let check = match *rest {
            [] => None,
            [check] | [check, _] => Some(check),
            _ => return None,
        };
        let flags = meaning.first_chunk::<2>().copied().unwrap_or_default();
        let pose = |frame, how| Some(Target::Pose(numbers(data)?, frame, how));
        let rpy = Orientation::RollPitchYaw;
        let target = match (register, flags) {
            (21, [coordinates, how]) => pose(tool_or(Frame::Base, coordinates)?, Orientation::of(how)?)?,
            (22, _) => pose(Frame::Base, rpy)?,
            (28, _) => pose(Frame::Tool, rpy)?,
            (23 | 24, _) => Target::Joints(numbers(data)?),
            (25, _) => Target::Joints([0.0; 7]),
            (83, [1, 0]) => Target::JointChange(numbers(data)?),
            (83, [0, how]) => pose(Frame::Start, Orientation::of(how)?)?,
            (92, [coordinates, relative @ 0..=1]) => {
                let base = if relative == 1 { Frame::Start } else { Frame::Base };
                pose(tool_or(base, coordinates)?, Orientation::AxisAngle)?
            }
            _ => return None,
        };
        let at = match (register, target) {
            (25, _) => 0,
            (83, _) => 7,
            (_, Target::Pose(..)) => 6,
            _ => 7,
        };
        Some(Self {
            target,
            speed: number(data, 0, at)?,
            acceleration: number(data, 0, at + 1)?,
            checks_only: check.is_some_and(|check| check > 0),
            has_result: check.is_some(),
        })
    }

    /// Reads a setpoint for the tool.
    pub fn servo(register: u8, data: &[u8]) -> Option<Self> {
        let pose = numbers(data)?;
        let target = match register {
            30 => {
                let frame = if number(data, 0, 8)? == 1.0 { Frame::Tool } else { Frame::Base };
                Target::Pose(pose, frame, Orientation::RollPitchYaw)
            }
            _ => {
                let [coordinates @ 0..=1, 0, 0, 0, relative @ 0..=1] = *data.get(32..)? else { return None };
                let base = if relative == 1 { Frame::Start } else { Frame::Base };
                Target::Pose(pose, tool_or(base, coordinates)?, Orientation::AxisAngle)
            }
        };
        Some(Self::to(target))
    }
}

/// Returns the frame that a flag selects: 0 the given one, 1 that of the tool.
fn tool_or(base: Frame, flag: u8) -> Option<Frame> {
    match flag {
        0 => Some(base),
        1 => Some(Frame::Tool),
        _ => None,
    }
}

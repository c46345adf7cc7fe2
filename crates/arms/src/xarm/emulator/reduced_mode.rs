//! Reduced mode and the safety boundary. Limits that are set take effect when reduced mode is switched on, as the
//! vendor says; what is reported before is what was set (our choice).

use super::controlled_arm::{ControlledArm, JOINT_LIMIT, Refusal};
use super::controller::{Controller, TOLERANCE};
use super::judge::SPEED;
use super::kinematics::to_wire;
use super::registers::BAD_PARAMETER;
use super::settings::Settings;
use super::wire::{number, numbers, put_numbers};
use Refusal::Warning;

/// Error: the tool has left the safety boundary.
const BOUNDARY: u8 = 35;
/// Firmware with joint ranges, and a longer answer to register 53.
const WITH_RANGES: [u16; 3] = [1, 2, 11];
/// Length of the shorter one.
const SHORT: usize = 21;
/// Velocities may be this much above the limit: a ramp rounds (our choice).
const SLACK: f64 = 1.05;
/// Slower joints are at rest [rad/s].
const AT_REST: f64 = 0.01;

/// Limits of reduced mode.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limits {
    /// Highest and lowest x, y and z of the tool [mm].
    pub boundary: [i32; 6],
    /// Highest speed of the tool [mm/s].
    pub line_speed: f32,
    /// Highest speed of a joint [rad/s].
    pub joint_speed: f32,
    /// Lowest and highest position of each joint [rad].
    pub ranges: [f32; 14],
}

impl Default for Limits {
    /// The vendor does not publish what a new box has; these are ours.
    fn default() -> Self {
        let turn = 2.0 * std::f32::consts::PI;
        let ranges = std::array::from_fn(|i| if i % 2 == 0 { -turn } else { turn });
        Self { boundary: [9999, -9999, 9999, -9999, 9999, -9999], line_speed: 250.0, joint_speed: 0.5, ranges }
    }
}

/// Reduced mode.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ReducedMode {
    /// What is set.
    pub set: Limits,
    /// What holds, while it is on.
    pub active: Option<Limits>,
    /// Whether the tool must stay inside the boundary.
    pub fence: bool,
    /// Whether the arm moves back after a collision, which it does not here.
    rebounds: bool,
}

impl ReducedMode {
    /// Writes the settings as reports and register 53 have them.
    pub fn write(&self, out: &mut Vec<u8>) {
        let Limits { boundary, line_speed, joint_speed, ranges } = self.set;
        out.push(self.active.is_some().into());
        boundary.iter().for_each(|edge| out.extend((*edge as i16).to_be_bytes()));
        put_numbers(out, [line_speed, joint_speed].into_iter().chain(ranges));
        out.extend([u8::from(self.fence), u8::from(self.rebounds)]);
    }
}

/// Returns whether a register belongs to this module.
pub(super) fn is_of_reduced_mode(register: u8) -> bool {
    matches!(register, 47..=50 | 52 | 53 | 58..=60)
}

impl Settings {
    /// Does what a request to one of these registers asks.
    pub(super) fn reduced_mode(
        &mut self,
        register: u8,
        data: &[u8],
        firmware: [u16; 3],
        out: &mut Vec<u8>,
    ) -> Result<(), Refusal> {
        let bad = Warning(BAD_PARAMETER);
        let reduced = &mut self.reduced;
        let speed = || number(data, 0, 0).filter(|speed| speed.is_finite() && *speed > 0.0).ok_or(bad);
        match (register, data) {
            (47, _) => reduced.set.line_speed = speed()?,
            (48, _) => reduced.set.joint_speed = speed()?,
            (49, _) => out.push(reduced.active.is_some().into()),
            (50, [on @ 0..=1]) => reduced.active = (*on == 1).then_some(reduced.set),
            (52, _) => {
                let edges = data.chunks_exact(4).map(|bytes| bytes.try_into().map(i32::from_le_bytes));
                let edges: Vec<i32> = edges.collect::<Result<_, _>>().map_err(|_| bad)?;
                let edges: [i32; 6] = edges.try_into().map_err(|_| bad)?;
                let fits = |edge: &i32| i16::try_from(*edge).is_ok();
                if !edges.iter().all(fits) || edges.as_chunks::<2>().0.iter().any(|[most, least]| most < least) {
                    return Err(bad);
                }
                reduced.set.boundary = edges;
            }
            (53, _) => {
                let begin = out.len();
                reduced.write(out);
                if firmware < WITH_RANGES {
                    out.truncate(begin + SHORT);
                }
            }
            (58, _) => {
                let ranges: [f32; 14] = numbers(data).ok_or(bad)?;
                if !ranges.as_chunks::<2>().0.iter().all(|[low, high]| low <= high) {
                    return Err(bad);
                }
                reduced.set.ranges = ranges;
            }
            (59, [on @ 0..=1]) => reduced.fence = *on == 1,
            (60, [on @ 0..=1]) => reduced.rebounds = *on == 1,
            _ => return Err(bad),
        }
        Ok(())
    }
}

impl<A: ControlledArm> Controller<A> {
    /// Returns whether positions [rad] are outside the joint ranges of reduced mode.
    pub(super) fn leaves_reduced_range(&self, positions: &[f64; 7]) -> bool {
        let Some(Limits { ranges, .. }) = self.settings.reduced.active else { return false };
        let ranges = ranges.as_chunks::<2>().0.iter().take(self.identity.axes);
        let outside = |(q, [low, high]): (&f64, &[f32; 2])| {
            !(f64::from(*low) - TOLERANCE..=f64::from(*high) + TOLERANCE).contains(q)
        };
        positions.iter().zip(ranges).any(outside)
    }

    /// Returns the error of velocities [rad/s] above those of reduced mode.
    pub(super) fn too_fast(&self, velocities: &[f64; 7]) -> Option<u8> {
        let limit = f64::from(self.settings.reduced.active?.joint_speed) * SLACK;
        velocities.iter().any(|velocity| velocity.abs() > limit).then_some(SPEED)
    }

    /// Returns the error of a moving arm that leaves a joint range of reduced mode, or the safety boundary.
    pub(super) fn outside(&self, positions: &[f64; 7], velocities: &[f64; 7]) -> Option<u8> {
        if velocities.iter().all(|velocity| velocity.abs() < AT_REST) {
            return None;
        }
        if self.leaves_reduced_range(positions) {
            return Some(JOINT_LIMIT);
        }
        let tool = to_wire(&self.pose().filter(|_| self.settings.reduced.fence)?);
        let boundary = self.settings.reduced.set.boundary;
        let mut edges = tool.iter().zip(boundary.as_chunks::<2>().0);
        let leaves = edges.any(|(at, [most, least])| !(*least as f32..=*most as f32).contains(at));
        leaves.then_some(BOUNDARY)
    }
}

//! What clients can set: the registers of settings, and what reports show of them.

use nalgebra::Isometry3;

use super::controlled_arm::{ControlledArm, Refusal};
use super::controller::{Controller, state};
use super::judge::LIMIT_FACTOR;
use super::kinematics::from_wire;
use super::reduced_mode::{ReducedMode, is_of_reduced_mode};
use super::registers::BAD_PARAMETER;
use super::wire::{number, numbers, put_numbers};
use Refusal::{NotNow, Warning};

/// Number of the linear speed limit among the common parameters.
const LIMIT_FACTOR_NUMBER: u8 = 1;

/// What clients can set.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// Pose of the base in the reference frame of poses [mm, rad].
    pub base: [f32; 6],
    /// Offset of the tool [mm, rad], its mass and centre [kg, mm].
    pub offset: [f32; 6],
    /// See `offset`.
    pub load: [f32; 4],
    /// Sensitivities for collisions and for guiding by hand.
    pub sensitivity: [u8; 2],
    /// Jerk and largest acceleration of the tool [mm/s³, mm/s²], then of the joints [rad/s³, rad/s²].
    pub motion: [f32; 4],
    /// Limit of the tool's speed in servo mode, as a multiple of its top speed.
    pub limit_factor: f32,
    /// Reduced mode.
    pub reduced: ReducedMode,
    /// Reports hold currents in the place of torques.
    pub currents: bool,
    /// The force/torque sensor is on.
    pub wrench_on: bool,
    /// What it shows as zero [N, Nm].
    pub wrench_zero: [f32; 6],
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            base: [0.0; 6],
            offset: [0.0; 6],
            load: [0.0; 4],
            sensitivity: [3, 3],
            motion: [10_000.0, 50_000.0, 20.0, 20.0],
            limit_factor: LIMIT_FACTOR,
            reduced: ReducedMode::default(),
            currents: false,
            wrench_on: false,
            wrench_zero: [0.0; 6],
        }
    }
}

/// Returns whether a register belongs to this module.
pub(super) fn is_setting(register: u8) -> bool {
    matches!(register, 31..=40 | 70 | 73 | 201..=203 | 206 | 232 | 233) || is_of_reduced_mode(register)
}

impl<A: ControlledArm> Controller<A> {
    pub(super) fn setting(&mut self, register: u8, data: &[u8], out: &mut Vec<u8>) -> Result<(), Refusal> {
        let bad = Warning(BAD_PARAMETER);
        let own = self.arm.takes_settings();
        match (register, data) {
            (203, _) => out.push(0),
            (36, _) => {
                let load = numbers(data).ok_or(bad)?;
                self.arm.set_load(load)?;
                self.reset_with(|s| s.load = load, out);
            }
            // Settings that the arm does not have are refused, except those that change nothing.
            (35 | 73, _) if !own && data.iter().all(|byte| *byte == 0) => self.put_queue(out),
            (70, [0]) | (202, [0]) => {
                self.settings.currents &= register != 70;
            }
            (201, [1]) if self.arm.wrench().is_some() => {}
            _ if !own => return Err(NotNow),
            _ if is_of_reduced_mode(register) => {
                let firmware = self.firmware;
                self.settings.reduced_mode(register, data, firmware, out)?;
            }
            (31..=34, _) => {
                let value = number(data, 0, 0).filter(|value| value.is_finite() && *value > 0.0).ok_or(bad)?;
                if let Some(to) = self.settings.motion.get_mut(usize::from(register - 31)) {
                    *to = value;
                }
                self.put_queue(out);
            }
            (35 | 73, _) => {
                let offset =
                    numbers(data).filter(|values: &[f32; 6]| values.iter().all(|v| v.is_finite())).ok_or(bad)?;
                self.reset_with(|s| *(if register == 35 { &mut s.offset } else { &mut s.base }) = offset, out);
            }
            (37, [level @ 0..=5]) => self.reset_with(|s| s.sensitivity = [*level, s.sensitivity[1]], out),
            (38, [level @ 1..=5]) => self.reset_with(|s| s.sensitivity = [s.sensitivity[0], *level], out),
            (39, _) => self.settings = Settings::default(),
            (40, _) => self.saved = self.settings,
            (70, [1]) => self.settings.currents = true,
            (201, [on @ 0..=1]) => self.settings.wrench_on = *on == 1,
            (206, _) if self.settings.wrench_on => self.settings.wrench_zero = self.wrench().1,
            (232, [LIMIT_FACTOR_NUMBER, ..]) => {
                let factor = number(data, 1, 0).filter(|factor| *factor > 0.0 && factor.is_finite()).ok_or(bad)?;
                self.settings.limit_factor = factor;
            }
            (233, [LIMIT_FACTOR_NUMBER]) => put_numbers(out, [self.settings.limit_factor]),
            (37 | 38, _) => return Err(bad),
            // The sensor's control of forces, and all other parameters: not emulated.
            _ => return Err(NotNow),
        }
        Ok(())
    }

    /// A setting that resets the system and drops to mode 0.
    fn reset_with(&mut self, set: impl FnOnce(&mut Settings), out: &mut Vec<u8>) {
        set(&mut self.settings);
        self.mode = 0;
        self.halt(state::CHANGED);
        self.put_queue(out);
    }

    /// The tool's centre point in the flange.
    pub(super) fn tool_offset(&self) -> Isometry3<f64> {
        from_wire(self.settings.offset)
    }
    /// The base in the reference frame of poses.
    pub(super) fn base(&self) -> Isometry3<f64> {
        from_wire(self.settings.base)
    }
}

//! Programs, one step of the controller at a time: the adapter's own one, and that of `ur_rtde`.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::Surface;
use super::controller::Registers;
use super::ours::{self, Ours};
use super::points::Points;
use crate::ur::DOF;
use crate::ur::model::Model;
use dimos_core::arm::Dh;
use dimos_hardware::sim::arm::{Refusal, SimArm};
use dimos_hardware::sim::reach::Chain;

/// Payload: mass, centre of gravity, inertia.
type Payload = (f64, [f64; 3], [f64; 6]);
/// Error of a protective stop that a client asks for.
const ASKED_ERROR: u16 = 50;

/// What the controller knows of its arm: model, chain, and the tool's centre point in the flange's frame.
#[derive(Debug, Clone, Copy)]
pub(super) struct Build {
    pub model: Model,
    pub reach: Reach,
    pub tool: Isometry3<f64>,
    pub surface: Option<Surface>,
}

/// A running program.
#[derive(Debug, Clone)]
pub(super) enum Program {
    /// The adapter's own.
    Ours(Box<Ours>),
    /// That of `ur_rtde`.
    Rtde(RtdeControl),
    /// One that does nothing, and ends.
    Other(String),
}

impl Program {
    pub fn name(&self) -> &str {
        match self {
            Self::Ours(_) => ours::NAME,
            Self::Rtde(_) => "rtde_control",
            Self::Other(name) => name,
        }
    }

    /// Makes one step; whether the program has ended. `step`: its time [s], and the fraction of the speed at which the
    /// controller runs motion.
    pub fn step(
        &mut self,
        arm: &mut SimArm,
        registers: &mut Registers,
        payload: &mut Payload,
        step: (f64, f64),
        build: &Build,
    ) -> bool {
        match self {
            Self::Ours(program) => program.step(arm, registers, step.0),
            Self::Rtde(program) => program.step(arm, registers, payload, step, build),
            Self::Other(_) => true,
        }
    }

    /// Returns the position that the last step gave to servoj, if it did.
    pub fn servoed(&self) -> Option<[f64; DOF]> {
        match self {
            Self::Ours(program) => program.servoed(),
            Self::Rtde(program) => program.points.last().filter(|_| program.streaming),
            Self::Other(_) => None,
        }
    }

    /// Returns the argument of the error of the last point of servoj that was refused.
    pub fn argument(&self) -> i32 {
        match self {
            Self::Ours(program) => program.argument(),
            Self::Rtde(program) => program.points.argument,
            Self::Other(_) => 0,
        }
    }

    /// Returns why the program failed in its last step.
    pub fn failure(&self) -> Option<String> {
        match self {
            Self::Rtde(program) => program.failure.clone(),
            _ => None,
        }
    }
}

pub(super) fn joints(arm: &SimArm) -> [f64; DOF] {
    arm.joints().0.first_chunk::<DOF>().copied().unwrap_or_default()
}

pub(super) fn six(registers: &[f64], first: usize) -> [f64; DOF] {
    std::array::from_fn(|i| registers.get(first + i).copied().unwrap_or_default())
}

/// `ur_rtde`'s program: commands in the lower registers.
#[derive(Debug, Clone, Default)]
pub(super) struct RtdeControl {
    /// The blocking command that is under way.
    busy: bool,
    points: Points,
    streaming: bool,
    /// Why it cannot carry out a command: it ends.
    failure: Option<String>,
}

/// Commands that are repeated, without an acknowledgement.
const REPEATED: [i32; 15] = [6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70];

/// Commands of motions that the controller plans: they wait for it to run at a speed.
const PLANNED: [i32; 4] = [1, 2, 3, 4];

impl RtdeControl {
    fn step(
        &mut self,
        arm: &mut SimArm,
        registers: &mut Registers,
        payload: &mut Payload,
        step: (f64, f64),
        build: &Build,
    ) -> bool {
        let (command, state) = (registers.int_in[0], registers.int_out[0]);
        if state == 0 {
            registers.int_out[0] = 1;
        } else if self.busy {
            if !arm.moving() {
                self.busy = false;
                registers.int_out[0] = 2;
            }
        } else if command == 0 {
            registers.int_out[0] = 1;
        } else if command == 255 {
            return true;
        } else if state == 1 && (step.1 > 0.0 || !PLANNED.contains(&command)) {
            let streaming = std::mem::replace(&mut self.streaming, command == 11);
            if !streaming {
                self.points = Points::default();
            }
            self.failure = self.begin(command, arm, registers, payload, step, build).err();
            if self.failure.is_some() {
                return true;
            }
            if !REPEATED.contains(&command) {
                self.busy = true;
            }
        }
        false
    }

    fn begin(
        &mut self,
        command: i32,
        arm: &mut SimArm,
        registers: &mut Registers,
        payload: &mut Payload,
        step: (f64, f64),
        build: &Build,
    ) -> Result<(), String> {
        let values = six(&registers.double_in, 0);
        let (step, pace) = step;
        let top = build.model.limits().velocity_max.first().copied().unwrap_or(1.0);
        let speed = pace * registers.double_in[6] / top;
        let inverse = |arm: &SimArm| {
            let goal = build.reach.inverse(&(pose(&values) * build.tool.inverse()), &joints(arm));
            goal.ok_or_else(|| format!("command {command}: no solution for the pose {values:?}"))
        };
        let refused = |refusal: Refusal| format!("command {command} to {values:?}: {refusal:?}");
        match command {
            1 => arm.move_to(&values, speed.clamp(0.01, 1.0)).map_err(refused)?,
            2 => arm.move_to(&inverse(arm)?, speed.clamp(0.01, 1.0)).map_err(refused)?,
            3 => arm.move_to(&inverse(arm)?, (0.3 * pace).clamp(0.01, 1.0)).map_err(refused)?,
            4 => arm.move_to(&values, (0.3 * pace).clamp(0.01, 1.0)).map_err(refused)?,
            9 => arm.velocity_for(&values.map(|v| pace * v), None).map_err(refused)?,
            // Its values: velocity, acceleration, time, lookahead time, gain.
            11 => self.points.take(arm, &values, step, registers.double_in[9]),
            15 | 16 | 33 | 34 => arm.stop(),
            17 => (payload.0, payload.1) = (values[0], [values[1], values[2], values[3]]),
            26 => registers.double_out[0] = step,
            31 => arm.fail(ASKED_ERROR),
            _ => return Err(format!("command {command} is not emulated")),
        }
        Ok(())
    }
}

/// The arm's chain: its own parameters, joint by joint.
#[derive(Debug, Clone, Copy)]
pub(super) struct Reach(pub [Dh; DOF]);

impl Chain for Reach {
    /// A joint turns about z of the frame before it, so that frame's z is the axis: the twist of the joint before is
    /// part of it.
    fn link(&self, joint: usize, position: f64) -> Option<Isometry3<f64>> {
        let before = joint.checked_sub(1).and_then(|before| self.0.get(before).copied()).unwrap_or_default();
        let Dh { a, alpha, .. } = before;
        let Dh { theta, d, .. } = *self.0.get(joint)?;
        let before = Isometry3::from_parts(
            Translation3::new(a, 0.0, 0.0),
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), alpha),
        );
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), theta + position);
        Some(before * Isometry3::from_parts(Translation3::new(0.0, 0.0, d), turn))
    }

    fn end(&self) -> Isometry3<f64> {
        let [.., Dh { a, alpha, .. }] = self.0;
        Isometry3::new(Vector3::new(a, 0.0, 0.0), Vector3::new(alpha, 0.0, 0.0))
    }
}

/// The pose of position [m] and rotation vector [rad].
pub(super) fn pose(values: &[f64; 6]) -> Isometry3<f64> {
    let [x, y, z, a, b, c] = *values;
    Isometry3::new(Vector3::new(x, y, z), Vector3::new(a, b, c))
}

//! Programs, one step of the controller at a time: the adapter's own one, and that of `ur_rtde`.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::controller::Registers;
use super::ours::{self, Ours};
use crate::hardware::arms::ur::DOF;
use crate::hardware::arms::ur::model::Model;
use crate::hardware::sim::arm::{Refusal, SimArm};
use crate::hardware::sim::reach::Chain;

/// Payload: mass, centre of gravity, inertia.
type Payload = (f64, [f64; 3], [f64; 6]);
/// A setpoint this far from the one before is a jump [rad/s].
const JUMP: f64 = 20.0;
/// Error of a jump.
const JUMP_ERROR: u16 = 204;
/// Error of a protective stop that a client asks for.
const ASKED_ERROR: u16 = 50;

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

    /// Makes one step; whether the program has ended.
    pub fn step(
        &mut self,
        arm: &mut SimArm,
        registers: &mut Registers,
        payload: &mut Payload,
        step: f64,
        model: Model,
    ) -> bool {
        match self {
            Self::Ours(program) => program.step(arm, registers, step),
            Self::Rtde(program) => program.step(arm, registers, payload, step, model),
            Self::Other(_) => true,
        }
    }

    /// Returns the position that the last step gave to servoj, if it did.
    pub fn servoed(&self) -> Option<[f64; DOF]> {
        match self {
            Self::Ours(program) => program.servoed(),
            Self::Rtde(program) => program.last,
            Self::Other(_) => None,
        }
    }
}

pub(super) fn joints(arm: &SimArm) -> [f64; DOF] {
    arm.joints().0.first_chunk::<DOF>().copied().unwrap_or_default()
}

pub(super) fn six(registers: &[f64], first: usize) -> [f64; DOF] {
    std::array::from_fn(|i| registers.get(first + i).copied().unwrap_or_default())
}

/// Follows a setpoint; a jump is a protective stop.
pub(super) fn servo(arm: &mut SimArm, last: &mut Option<[f64; DOF]>, goal: &[f64; DOF], step: f64) {
    let from = last.unwrap_or_else(|| joints(arm));
    if from.iter().zip(goal).any(|(a, b)| (a - b).abs() > JUMP * step) {
        arm.fail(JUMP_ERROR);
        return;
    }
    if arm.servo(goal) != Err(Refusal::OutOfRange) {
        *last = Some(*goal);
    }
}

/// `ur_rtde`'s program: commands in the lower registers.
#[derive(Debug, Clone, Default)]
pub(super) struct RtdeControl {
    /// The blocking command that is under way.
    busy: bool,
    last: Option<[f64; DOF]>,
    streaming: bool,
}

/// Commands that are repeated, without an acknowledgement.
const REPEATED: [i32; 15] = [6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70];

impl RtdeControl {
    fn step(
        &mut self,
        arm: &mut SimArm,
        registers: &mut Registers,
        payload: &mut Payload,
        step: f64,
        model: Model,
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
        } else if state == 1 {
            let streaming = std::mem::replace(&mut self.streaming, command == 11);
            if !streaming {
                self.last = None;
            }
            self.begin(command, arm, registers, payload, step, model);
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
        step: f64,
        model: Model,
    ) {
        let values = six(&registers.double_in, 0);
        let speed = registers.double_in[6] / model.limits().velocity_max.first().copied().unwrap_or(1.0);
        match command {
            1 => {
                let _ = arm.move_to(&values, speed.clamp(0.01, 1.0));
            }
            3 => {
                if let Some(goal) = Reach(model).inverse(&pose(&values), &joints(arm)) {
                    let _ = arm.move_to(&goal, 0.3);
                }
            }
            9 => {
                let _ = arm.velocity_for(&values, None);
            }
            11 => servo(arm, &mut self.last, &values, step),
            15 | 16 | 33 | 34 => arm.stop(),
            17 => {
                (payload.0, payload.1) = (values[0], [values[1], values[2], values[3]]);
            }
            26 => registers.double_out[0] = step,
            31 => arm.fail(ASKED_ERROR),
            _ => {}
        }
    }
}

/// The arm's chain.
pub(super) struct Reach(pub Model);

impl Chain for Reach {
    /// A joint turns about z of the frame before it, so that frame's z is the axis: the twist of the joint before is
    /// part of it.
    fn link(&self, joint: usize, position: f64) -> Option<Isometry3<f64>> {
        let (a, alpha) = match joint.checked_sub(1).and_then(|before| self.0.dh().get(before).copied()) {
            Some((a, _, alpha)) => (a, alpha),
            None => (0.0, 0.0),
        };
        let (_, d, _) = *self.0.dh().get(joint)?;
        let before = Isometry3::from_parts(
            Translation3::new(a, 0.0, 0.0),
            UnitQuaternion::from_axis_angle(&Vector3::x_axis(), alpha),
        );
        let turn = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), position);
        Some(before * Isometry3::from_parts(Translation3::new(0.0, 0.0, d), turn))
    }
}

/// The pose of position [m] and rotation vector [rad].
pub(super) fn pose(values: &[f64; 6]) -> Isometry3<f64> {
    let [x, y, z, a, b, c] = *values;
    Isometry3::new(Vector3::new(x, y, z), Vector3::new(a, b, c))
}

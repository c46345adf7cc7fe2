//! What programs do, one step of the controller at a time: the adapter's own one, and that of `ur_rtde`.

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};

use super::controller::Registers;
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
    Ours(Ours),
    /// That of `ur_rtde`.
    Rtde(RtdeControl),
    /// One that does nothing, and ends.
    Other(String),
}

impl Program {
    pub fn name(&self) -> &str {
        match self {
            Self::Ours(_) => "dimos_control",
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
}

fn joints(arm: &SimArm) -> [f64; DOF] {
    arm.joints().0.first_chunk::<DOF>().copied().unwrap_or_default()
}

fn six(registers: &[f64], first: usize) -> [f64; DOF] {
    std::array::from_fn(|i| registers.get(first + i).copied().unwrap_or_default())
}

/// Follows a setpoint; a jump is a protective stop.
fn servo(arm: &mut SimArm, last: &mut Option<[f64; DOF]>, goal: &[f64; DOF], step: f64) {
    let from = last.unwrap_or_else(|| joints(arm));
    if from.iter().zip(goal).any(|(a, b)| (a - b).abs() > JUMP * step) {
        arm.fail(JUMP_ERROR);
        return;
    }
    if arm.servo(goal) != Err(Refusal::OutOfRange) {
        *last = Some(*goal);
    }
}

/// The adapter's program.
#[derive(Debug, Clone)]
pub(super) struct Ours {
    number: i32,
    count: Option<i32>,
    state: i32,
    silent: u32,
    left: u32,
    goal: [f64; DOF],
    setpoint: [f64; DOF],
    last: Option<[f64; DOF]>,
}

impl Ours {
    pub fn new(number: i32) -> Self {
        Self { number, count: None, state: 1, silent: 0, left: 0, goal: [0.0; DOF], setpoint: [0.0; DOF], last: None }
    }

    fn step(&mut self, arm: &mut SimArm, registers: &mut Registers, step: f64) -> bool {
        if self.state >= 10 {
            return !arm.moving();
        }
        let now = registers.int_in[24];
        let before = self.state;
        let count = *self.count.get_or_insert(now);
        if now == count {
            self.silent += 1;
            let time = f64::from(self.silent) * step;
            if time > 1.0 {
                self.state = 11;
            } else if self.state == 3 && time > 0.2 {
                self.state = 1;
            }
        } else {
            self.goal = six(&registers.double_in, 24);
            self.state = match registers.int_in[25] {
                1 => 2,
                2 => 3,
                3 => 10,
                _ => 1,
            };
            if self.state == 2 {
                self.left = (self.silent + 1).min((0.03 / step).floor() as u32);
                if before != 2 {
                    (self.setpoint, self.last) = (joints(arm), None);
                }
            }
            (self.silent, self.count) = (0, Some(now));
        }
        registers.int_out[24] = self.count.unwrap_or(now);
        registers.int_out[25] = self.state;
        registers.int_out[26] = self.number;
        match self.state {
            2 => {
                if self.left > 0 {
                    let left = f64::from(self.left);
                    self.setpoint.iter_mut().zip(&self.goal).for_each(|(q, goal)| *q += (goal - *q) / left);
                    self.left -= 1;
                }
                servo(arm, &mut self.last, &self.setpoint, step);
            }
            3 => {
                let _ = arm.velocity_for(&self.goal, None);
            }
            _ if before > 1 => arm.stop(),
            _ => {}
        }
        false
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

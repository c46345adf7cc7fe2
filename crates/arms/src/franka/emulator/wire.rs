//! The controller's side of the bytes: states, commands, answers. Shares nothing with the adapter's side.

use super::control::{Command, Control, DOF, columns};
use dimos_hardware::sim::arm::Measured;

/// Commands by their numbers in interface 10 and in interface 5.
pub(super) const MOVE: (u32, u32) = (1, 1);
pub(super) const STOP: (u32, u32) = (2, 2);
pub(super) const RECOVERY: (u32, u32) = (10, 12);

/// How a motion ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Ended {
    Success,
    Preempted,
    Reflex,
    UserStop,
    Aborted,
}

impl Ended {
    /// The status in the last answer to Move; `five` in interface 5.
    pub fn status(self, five: bool) -> u8 {
        match (self, five) {
            (Self::Success, _) => 0,
            (Self::Preempted, _) => 2,
            (Self::Reflex, true) => 6,
            (Self::UserStop, true) => 7,
            (Self::Aborted, true) => 9,
            (Self::Reflex, false) => 8,
            (Self::UserStop, false) => 9,
            (Self::Aborted, false) => 11,
        }
    }
}

/// Writes numbers in the width of the interface.
struct State {
    bytes: Vec<u8>,
    wide: bool,
}

impl State {
    fn put(&mut self, values: &[f64]) {
        for value in values {
            if self.wide {
                self.bytes.extend(value.to_le_bytes());
            } else {
                self.bytes.extend((*value as f32).to_le_bytes());
            }
        }
    }

    fn zeros(&mut self, count: usize) {
        (0..count).for_each(|_| self.put(&[0.0]));
    }

    fn flags(&mut self, bits: u64) {
        self.bytes.extend((0..41).map(|bit| (bits >> bit & 1) as u8));
    }
}

/// The state of a cycle.
pub(super) fn state(control: &Control, measured: &Measured) -> Vec<u8> {
    let wide = control.wide();
    let mut to = State { bytes: Vec::with_capacity(2400), wide };
    let seven = |values: &[f64]| values.get(..DOF).unwrap_or_default().to_vec();
    let pose = control.pose(measured);
    let (q, dq, tau) = (seven(&measured.positions), seven(&measured.velocities), seven(&measured.efforts));
    let contact = |limits: &[f64; DOF]| -> Vec<f64> {
        control.external.iter().zip(limits).map(|(torque, most)| f64::from(torque.abs() > *most)).collect()
    };
    let elbow = [q.get(2).copied().unwrap_or_default(), -1.0];
    let [mass, rest @ ..] = control.load;
    to.bytes.extend(control.id.to_le_bytes());
    to.put(&pose); // O_T_EE
    to.put(&pose); // O_T_EE_d
    to.put(&columns(&control.end_effector())); // F_T_EE
    to.put(&columns(&control.stiffness)); // EE_T_K
    control.frames.iter().for_each(|frame| to.put(&columns(frame))); // F_T_NE, NE_T_EE
    to.put(&control.tool); // m_ee, I_ee, F_x_Cee
    to.put(&[mass]);
    to.put(rest.get(3..).unwrap_or_default()); // I_load
    to.put(rest.get(..3).unwrap_or_default()); // F_x_Cload
    to.put(&elbow);
    to.put(&elbow);
    to.put(&tau); // tau_J
    to.zeros(14); // tau_J_d, dtau_J
    to.put(&q);
    to.put(&control.q_d);
    to.put(&dq);
    to.put(&control.dq_d);
    to.put(&control.ddq_d);
    to.put(&contact(&control.thresholds.0)); // joint_contact
    to.zeros(6);
    to.put(&contact(&control.thresholds.1)); // joint_collision
    to.zeros(6);
    to.put(&control.external); // tau_ext_hat
    to.zeros(12 + 6); // forces, O_dP_EE_d
    to.put(&[0.0, 0.0, -9.81]); // O_ddP_O
    to.put(&elbow);
    to.zeros(4);
    to.put(&pose); // O_T_EE_c
    to.zeros(12); // O_dP_EE_c, O_ddP_EE_c
    to.put(&q); // theta
    to.put(&dq); // dtheta
    if !wide {
        to.zeros(36); // accelerometers
    }
    to.bytes.extend([control.generator, control.controller]);
    to.flags(control.errors);
    to.flags(control.reason);
    to.bytes.push(control.mode);
    to.put(&[control.success_rate()]);
    to.bytes
}

/// A command, and the number of the state that it answers.
pub(super) fn command(bytes: &[u8], wide: bool) -> Option<(u64, Command)> {
    if bytes.len() != if wide { 370 } else { 371 } {
        return None;
    }
    let number = |at: usize| bytes.get(at..at + 8).and_then(|b| b.try_into().ok()).map_or(f64::NAN, f64::from_le_bytes);
    let id = bytes.get(..8).and_then(|b| b.try_into().ok()).map(u64::from_le_bytes)?;
    let seven = |from: usize| std::array::from_fn(|i| number(from + 8 * i));
    let finished = bytes.get(313).is_some_and(|byte| *byte != 0);
    Some((id, Command { positions: seven(8), velocities: seven(64), finished }))
}

/// Numbers in a request.
pub(super) fn floats(bytes: &[u8]) -> Vec<f64> {
    bytes.as_chunks().0.iter().map(|chunk| f64::from_le_bytes(*chunk)).collect()
}

/// An answer with a status and more.
pub(super) fn answer(code: u32, id: u32, status: u8, rest: &[u8]) -> Vec<u8> {
    let length = 13 + rest.len() as u32;
    [&[code, id, length].map(u32::to_le_bytes).concat()[..], &[status], rest].concat()
}

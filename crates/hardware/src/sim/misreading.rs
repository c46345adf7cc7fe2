//! Readings that are wrong and do not look it: an encoder that slips, two joints in each other's place, a report that
//! is late. They change what a simulated arm says of itself, never where it is.

use std::collections::VecDeque;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::faults::Fault;
use dimos_core::joint::{Joints, MAX_DOF};

/// What is wrong with the readings of a joint during the fault `misread`.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Misreading {
    /// The position is off by `amount` [rad].
    #[default]
    Offset,
    /// The position drifts away at `amount` [rad/s]; the velocity agrees with that.
    Drift,
    /// The position drifts away at `amount` [rad/s]; the velocity does not show it.
    Slip,
    /// Position and velocity are multiplied by `amount`.
    Scaled,
    /// Position and velocity have the wrong sign.
    Mirrored,
    /// The joint and the next one are reported in each other's place.
    Swapped,
    /// The position is off by up to `amount` [rad], differently in each reading.
    Noise,
    /// Position and velocity were true `amount` [s] ago.
    Late,
    /// The position stays; the velocity is true.
    Frozen,
}

/// What misreadings remember.
#[derive(Debug, Clone, Default)]
pub(super) struct Memory {
    /// Times [s since the first connection], true positions and velocities since a late reading began.
    past: VecDeque<(f64, Joints, Joints)>,
    /// Where a frozen joint was.
    frozen: [Option<f64>; MAX_DOF],
    noise: u32,
}

impl Memory {
    /// Returns a number between -1 and 1, the same sequence every time (xorshift32).
    fn noise(&mut self) -> f64 {
        let mut x = self.noise.max(1);
        x ^= x << 13;
        x ^= x >> 17;
        x ^= x << 5;
        self.noise = x;
        f64::from(x) / f64::from(u32::MAX) * 2.0 - 1.0
    }
}

impl Memory {
    /// Changes true positions [rad] and velocities [rad/s] to what is reported of them now [s since the first
    /// connection], by all `faults` that are due.
    pub(super) fn apply(&mut self, faults: &[Fault], now: f64, positions: &mut [f64], velocities: &mut [f64]) {
        faults.iter().for_each(|fault| self.change(fault, now, positions, velocities));
        if !faults.iter().any(|fault| fault.misread == Misreading::Late) {
            self.past.clear();
        }
    }

    fn change(&mut self, fault: &Fault, now: f64, positions: &mut [f64], velocities: &mut [f64]) {
        let joint = fault.joint.saturating_sub(1);
        if fault.misread == Misreading::Swapped {
            let next = if joint + 1 < positions.len() { joint + 1 } else { 0 };
            if joint < positions.len().min(velocities.len()) {
                positions.swap(joint, next);
                velocities.swap(joint, next);
            }
            return;
        }
        if fault.misread == Misreading::Late {
            self.delay(now, fault.amount, joint, positions, velocities);
            return;
        }
        let noise = self.noise();
        let (Some(q), Some(v)) = (positions.get_mut(joint), velocities.get_mut(joint)) else { return };
        let drifted = fault.amount * (now - fault.at).max(0.0);
        match fault.misread {
            Misreading::Offset => *q += fault.amount,
            Misreading::Drift => (*q, *v) = (*q + drifted, *v + fault.amount),
            Misreading::Slip => *q += drifted,
            Misreading::Scaled => (*q, *v) = (*q * fault.amount, *v * fault.amount),
            Misreading::Mirrored => (*q, *v) = (-*q, -*v),
            Misreading::Noise => *q += fault.amount * noise,
            Misreading::Frozen => {
                if let Some(frozen) = self.frozen.get_mut(joint) {
                    *q = *frozen.get_or_insert(*q);
                }
            }
            Misreading::Swapped | Misreading::Late => {}
        }
    }

    /// The first reading of the fault is reported until it is old enough.
    fn delay(&mut self, now: f64, age: f64, joint: usize, positions: &mut [f64], velocities: &mut [f64]) {
        let of = |values: &[f64]| std::array::from_fn(|i| values.get(i).copied().unwrap_or_default());
        if self.past.back().is_none_or(|(at, ..)| *at < now) {
            self.past.push_back((now, of(positions), of(velocities)));
        }
        while self.past.get(1).is_some_and(|(at, ..)| *at <= now - age) {
            self.past.pop_front();
        }
        let Some((_, old, speed)) = self.past.front() else { return };
        for (said, was) in [(positions, old), (velocities, speed)] {
            said.iter_mut().zip(was).skip(joint).take(1).for_each(|(said, was)| *said = *was);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sim::faults::FaultKind;

    fn told(memory: &mut Memory, misread: Misreading, amount: f64, now: f64, truth: (f64, f64)) -> [f64; 4] {
        let fault = Fault { misread, amount, at: 1.0, ..Fault::new(FaultKind::Misread) };
        let (mut q, mut v) = ([truth.0, 5.0], [truth.1, 6.0]);
        memory.change(&fault, now, &mut q, &mut v);
        [q[0], q[1], v[0], v[1]]
    }

    #[test]
    fn each_misreading_changes_what_it_says() {
        let once = |misread, amount| told(&mut Memory::default(), misread, amount, 3.0, (1.0, 2.0));
        assert_eq!(once(Misreading::Offset, 0.5), [1.5, 5.0, 2.0, 6.0]);
        assert_eq!(once(Misreading::Drift, 0.5), [2.0, 5.0, 2.5, 6.0]);
        assert_eq!(once(Misreading::Slip, 0.5), [2.0, 5.0, 2.0, 6.0]);
        assert_eq!(once(Misreading::Scaled, 0.5), [0.5, 5.0, 1.0, 6.0]);
        assert_eq!(once(Misreading::Mirrored, 0.0), [-1.0, 5.0, -2.0, 6.0]);
        assert_eq!(once(Misreading::Swapped, 0.0), [5.0, 1.0, 6.0, 2.0]);
        let noisy = once(Misreading::Noise, 0.5)[0];
        assert!(noisy != 1.0 && (noisy - 1.0).abs() <= 0.5, "{noisy}");
    }

    #[test]
    fn what_is_late_was_true_before_and_what_is_frozen_stays() {
        let mut memory = Memory::default();
        let mut late = |now: f64| told(&mut memory, Misreading::Late, 0.125, now, (now, 1.0))[0];
        assert_eq!([1.0, 1.0625, 1.125, 1.1875, 1.25].map(&mut late), [1.0, 1.0, 1.0, 1.0625, 1.125]);
        let mut memory = Memory::default();
        let mut frozen = |q: f64| told(&mut memory, Misreading::Frozen, 0.0, 1.0 + q, (q, q));
        assert_eq!([frozen(0.1)[0], frozen(0.2)[0], frozen(0.3)[2]], [0.1, 0.1, 0.3]);
    }
}

//! Relief of a blocked joint: after the arm's own stop, the setpoint is taken back towards the joint once, by at most
//! the row's `relief`, so that a joint that comes free does not lunge. Only where the arm itself has no stop that does.

use crate::limit::{Limiter, WAY_BACK};
use dimos_core::arm::Supervision;
use dimos_core::joint::{Joints, MAX_DOF, braking_speed};

/// Part of the acceleration limit that a relief uses.
const GENTLY: f64 = 0.5;
/// A reading that followed at least this part of the relief, and came nearer by less than the rest, is false.
const FOLLOWED: f64 = 0.5;

/// Progress of a relief.
#[derive(Debug, Clone, Copy, PartialEq)]
#[expect(clippy::large_enum_variant, reason = "one per arm, and the tick does not allocate")]
pub enum Relief {
    /// None is due, or it is over.
    None,
    /// The arm is to be relieved once its readings are trusted.
    Due,
    /// The setpoints move.
    Moving(Move),
}

/// A relief under way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Move {
    /// Setpoints before and after it [rad].
    from: Joints,
    to: Joints,
    /// Where the joints were read before it [rad].
    read: Joints,
}

impl Move {
    /// Returns the relief of joints that are read away from their setpoints; `None`: none is.
    pub fn towards(read: &Joints, limiters: &[Limiter], supervision: &Supervision) -> Option<Self> {
        let (mut from, mut to) = ([0.0; MAX_DOF], [0.0; MAX_DOF]);
        let mut any = false;
        for ((q, limiter), (from, to)) in read.iter().zip(limiters).zip(from.iter_mut().zip(&mut to)) {
            let off = q - limiter.position();
            let (lower, upper) = limiter.range();
            let away = off.abs() > supervision.accuracy + supervision.droop;
            let most = supervision.relief.min(supervision.tracking_tolerance);
            let step = if away { off.max(-most).min(most) } else { 0.0 };
            *from = limiter.position();
            *to = (limiter.position() + step).max(lower).min(upper);
            any |= *to != *from;
        }
        any.then_some(Self { from, to, read: *read })
    }

    /// Moves the setpoints by one step of `dt` [s]. Returns whether they have arrived.
    pub fn advance(&self, limiters: &mut [Limiter], dt: f64) -> bool {
        let mut arrived = true;
        for (limiter, to) in limiters.iter_mut().zip(&self.to) {
            let left = to - limiter.position();
            if left == 0.0 {
                limiter.relieve(*to, 0.0, dt);
                continue;
            }
            let acceleration = GENTLY * limiter.bounds().acceleration;
            let most = braking_speed(left.abs(), acceleration, dt).min(WAY_BACK).min(limiter.bounds().velocity);
            let speed = most.min(limiter.velocity().abs() + acceleration * dt);
            let reached = speed * dt >= left.abs() - 1e-12;
            let next = if reached { *to } else { limiter.position() + (speed * dt).copysign(left) };
            limiter.relieve(next, if reached { 0.0 } else { speed.copysign(left) }, dt);
            arrived &= reached;
        }
        arrived
    }

    /// Returns the joint whose reading has moved with its setpoint without coming nearer, and by how much [rad]: it is
    /// false.
    pub fn followed_by(&self, read: &Joints, dof: usize) -> Option<(usize, f64)> {
        let joints = read.iter().zip(&self.read).zip(self.from.iter().zip(&self.to)).take(dof).enumerate();
        { joints }.find_map(|(j, ((now, before), (from, to)))| {
            let (moved, relief) = (now - before, to - from);
            let nearer = (before - from).abs() - (now - to).abs();
            let followed = relief != 0.0 && moved / relief >= FOLLOWED && nearer < FOLLOWED * relief.abs();
            followed.then_some((j, moved))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_core::joint::{JointBounds, joints_of};

    const DT: f64 = 0.01;

    fn limiters() -> Vec<Limiter> {
        let mut limiters = vec![Limiter::new(JointBounds::inside(-2.0, 2.0, 2.0, 4.0)); 2];
        limiters.iter_mut().for_each(|limiter| limiter.seed(0.5));
        limiters
    }

    fn supervision() -> Supervision {
        Supervision { accuracy: 0.01, relief: 0.04, ..Supervision::default() }
    }

    #[test]
    fn a_setpoint_goes_back_by_the_relief_at_most_and_within_the_acceleration() {
        let mut limiters = limiters();
        let relief = Move::towards(&joints_of(&[0.8, 0.505]), &limiters, &supervision()).unwrap();
        let (mut v, mut steps) = (0.0, 0);
        loop {
            let before = limiters[0].position();
            let arrived = relief.advance(&mut limiters, DT);
            let now = (limiters[0].position() - before) / DT;
            assert!((now - v).abs() <= 4.0 * DT * 1.01, "{v} {now}");
            (v, steps) = (now, steps + 1);
            assert!(steps < 200);
            if arrived {
                break;
            }
        }
        assert!((limiters[0].position() - 0.54).abs() < 1e-9 && limiters[1].position() == 0.5);
        assert!(limiters.iter().all(Limiter::at_rest));
    }

    #[test]
    fn a_reading_that_moves_with_the_setpoint_is_false_and_one_that_stays_is_blocked() {
        let relief = Move::towards(&joints_of(&[0.8, 0.5]), &limiters(), &supervision()).unwrap();
        assert_eq!(relief.followed_by(&joints_of(&[0.8, 0.5]), 2), None, "blocked");
        let (joint, by) = relief.followed_by(&joints_of(&[0.84, 0.5]), 2).unwrap();
        assert!(joint == 0 && (by - 0.04).abs() < 1e-12);
        assert_eq!(relief.followed_by(&joints_of(&[0.55, 0.5]), 2), None, "it came free, and is at its setpoint");
        assert_eq!(Move::towards(&joints_of(&[0.505, 0.5]), &limiters(), &supervision()), None);
    }
}

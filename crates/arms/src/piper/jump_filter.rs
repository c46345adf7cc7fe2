//! Filters joint positions: accepts those that the arm can have reached since the last accepted ones.
//!
//! These controllers occasionally report a wrong position. A set that jumps is rejected; three consecutive ones that
//! agree are accepted: then the arm or its zero points were moved without feedback.

use super::SPEED;
use super::protocol::{WireJoints, millidegrees};
use dimos_core::clock::Mono;

/// Steps are rejected beyond this [rad] plus what the arm's speed allows, times a margin.
const STEP: f64 = 0.02;
const SPEED_MARGIN: f64 = 1.5;
/// Period of the arm [s]: sets that arrive together were not measured together.
const PERIOD: f64 = 0.005;
/// Consecutive rejected sets that agree, before they are accepted.
const AGREEING: u32 = 3;
/// Consecutive accepted sets that end a dispute, and its maximum duration [s].
const UNDISPUTED: u32 = 5;
const DISPUTE: f64 = 0.1;

/// The accepted joint positions, and rejected ones.
#[derive(Debug, Clone, Copy, Default)]
pub struct JumpFilter {
    /// The accepted positions [0.001°].
    pub joints: WireJoints,
    /// When they arrived; `Mono::ZERO`: never.
    pub at: Mono,
    /// When positions were last accepted because they agreed; `Mono::ZERO`: never.
    pub jumped_at: Mono,
    /// The last rejected set, when it arrived, and how many consecutive ones agree with it.
    refused: WireJoints,
    refused_at: Mono,
    agreeing: u32,
    /// Consecutive accepted sets.
    undisputed: u32,
}

impl JumpFilter {
    /// Takes a set that arrived at `now`. Returns whether it is accepted.
    pub fn take(&mut self, joints: WireJoints, now: Mono) -> bool {
        if self.at == Mono::ZERO || reachable(&joints, &self.joints, now.seconds_since(self.at)) {
            self.undisputed = self.undisputed.saturating_add(1);
            self.agreeing = 0;
            (self.joints, self.at) = (joints, now);
            return true;
        }
        let agrees = self.agreeing > 0 && reachable(&joints, &self.refused, now.seconds_since(self.refused_at));
        self.agreeing = if agrees { self.agreeing + 1 } else { 1 };
        (self.refused, self.refused_at, self.undisputed) = (joints, now, 0);
        if self.agreeing < AGREEING {
            return false;
        }
        self.agreeing = 0;
        (self.joints, self.at, self.jumped_at) = (joints, now, now);
        true
    }

    /// Returns whether sets were rejected recently, so that the accepted ones may be wrong.
    pub fn disputed(&self, now: Mono) -> bool {
        let lately = self.refused_at != Mono::ZERO && now.seconds_since(self.refused_at) < DISPUTE;
        lately && self.undisputed < UNDISPUTED
    }
}

/// Returns whether an arm at `from` can be at `to` after `dt` [s].
fn reachable(to: &WireJoints, from: &WireJoints, dt: f64) -> bool {
    let reach = millidegrees(SPEED_MARGIN * SPEED * dt.clamp(PERIOD, 60.0) + STEP);
    to.iter().zip(from).all(|(to, from)| to.saturating_sub(*from).saturating_abs() <= reach)
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(n: u64) -> Mono {
        Mono(1_000_000_000 + n * 1_000_000)
    }

    #[test]
    fn unreachable_positions_are_rejected() {
        let mut belief = JumpFilter::default();
        assert!(belief.take([10_000; 6], ms(0)) && belief.take([12_000; 6], ms(5)), "0.035 rad in 5 ms");
        assert!(!belief.disputed(ms(5)));
        assert!(!belief.take([15_000; 6], ms(10)), "0.052 rad in 5 ms");
        assert!(belief.disputed(ms(10)));
        assert_eq!((belief.joints, belief.at), ([12_000; 6], ms(5)));
        assert!(belief.take([15_000; 6], ms(15)), "but in 10 ms");
        // One joint is enough to reject a set. The reachable distance grows with time, without bound.
        assert!(!belief.take([15_000, 15_000, 15_000, 75_000, 15_000, 15_000], ms(20)));
        assert!(belief.take([75_000; 6], ms(300)));
    }

    #[test]
    fn three_consecutive_sets_that_agree_are_accepted() {
        let mut belief = JumpFilter::default();
        belief.take([0; 6], ms(0));
        let far = [90_000; 6];
        let took = [far, far, [0; 6], far, [-90_000; 6], far, far, far].map(|joints| belief.take(joints, ms(5)));
        assert_eq!(took, [false, false, true, false, false, false, false, true]);
        assert_eq!(belief.joints, far);
        assert!(belief.disputed(ms(5)), "whichever of them is wrong");
        (0..5).for_each(|i| assert!(belief.take(far, ms(10 + i))));
        assert!(!belief.disputed(ms(15)));
        assert!(!belief.take([0; 6], ms(20)) && belief.disputed(ms(20)) && !belief.disputed(ms(120)));
    }
}

//! What the limits of the user leave of the answers to states: too fast ones are slowed down, and what is missed is
//! made up for, in all joints by the same share, so that a straight motion stays straight.

use super::ceiling::UserLimit;
use super::protocol::DOF;
use super::shaping::PERIOD;

/// Time constant with which missed ways are made up for [s].
const TIME: f64 = 0.05;
/// A smaller difference is none [rad].
const NONE: f64 = 1e-9;

/// The answers of a motion.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CatchingUp {
    /// The last answer that was wanted, and the one that was given.
    last: Option<([f64; DOF], [f64; DOF])>,
}

impl CatchingUp {
    /// Returns the answer to give where `wanted` [rad] is wanted, `cycles` after the last one.
    pub fn take(&mut self, wanted: &[f64; DOF], cycles: u64, user: &[UserLimit; DOF]) -> [f64; DOF] {
        let given = match self.last {
            Some((before, given)) => follow(wanted, &before, &given, cycles.max(1) as f64 * PERIOD, user),
            None => *wanted,
        };
        self.last = Some((*wanted, given));
        given
    }
}

fn follow(
    wanted: &[f64; DOF],
    before: &[f64; DOF],
    given: &[f64; DOF],
    time: f64,
    user: &[UserLimit; DOF],
) -> [f64; DOF] {
    let (mut slower, mut share) = (1.0_f64, (time / TIME).min(1.0));
    let mut behind = 0.0_f64;
    for ((wanted, before), (given, user)) in wanted.iter().zip(before).zip(given.iter().zip(user)) {
        let (own, missed, most) = (wanted - before, before - given, user.velocity * time);
        behind = behind.max(missed.abs());
        if own.abs() > most {
            slower = slower.min(most / own.abs());
        } else if (own + share * missed).abs() > most {
            share = share.min(((most * missed.signum() - own) / missed).max(0.0));
        }
    }
    if slower == 1.0 && behind < NONE {
        return *wanted;
    }
    let share = if slower < 1.0 { 0.0 } else { share };
    std::array::from_fn(|i| {
        let [wanted, before, given] = [wanted, before, given].map(|values| values.get(i).copied().unwrap_or_default());
        given + slower * (wanted - before) + share * (before - given)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    const USER: [UserLimit; DOF] = [UserLimit { velocity: 0.5, acceleration: 7.0 }; DOF];

    #[test]
    fn a_late_setpoint_is_made_up_for_on_the_line_and_within_the_limit() {
        let (mut up, mut last, mut fastest) = (CatchingUp::default(), [0.0; DOF], 0.0_f64);
        let ratio = [1.0, -0.3, 0.5, 0.0, 0.2, -1.0, 0.7];
        for cycle in 0..2000_u32 {
            // 0.5 rad/s to 1 s; four setpoints come late, and then all at once.
            let t = f64::from(if (500..504).contains(&cycle) { 500 } else { cycle.min(1000) });
            let given = up.take(&ratio.map(|ratio| ratio * 0.5e-3 * t), 1, &USER);
            fastest = fastest.max((given[0] - last[0]).abs() / PERIOD);
            for (value, ratio) in given.iter().zip(ratio) {
                assert!((value - ratio * given[0]).abs() < 1e-12, "cycle {cycle}: {given:?}");
            }
            last = given;
        }
        assert!(fastest <= 0.5 + 1e-9, "{fastest}");
        assert!((last[0] - 0.5).abs() < 1e-8, "{last:?}");
    }

    #[test]
    fn answers_within_the_limit_are_given_as_they_are() {
        let mut up = CatchingUp::default();
        for cycle in 0..1000_u32 {
            let wanted = [0.4e-3 * f64::from(cycle); DOF];
            assert_eq!(up.take(&wanted, 1, &USER), wanted);
        }
        // Three states were not answered: three steps at once.
        assert_eq!(up.take(&[0.4e-3 * 1002.0; DOF], 3, &USER), [0.4e-3 * 1002.0; DOF]);
    }
}

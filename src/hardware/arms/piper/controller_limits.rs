//! The limits of the joints: the data sheet's, narrowed by those that the arm's controller has been given.

use super::limits;
use super::protocol::{DOF, MotorLimits};
use crate::joint::JointLimits;

/// A range that is narrower than this is no range [rad].
const NARROWEST: f64 = 0.02;
/// A top speed below this is unusual enough to be mentioned [rad/s].
const SLOW: f64 = 0.1;

/// The limits, and what of the controller's own is odd: each a line for the log.
pub fn narrowed(own: &[Option<MotorLimits>; DOF]) -> (JointLimits, Vec<String>) {
    let mut limits = limits();
    let mut odd = Vec::new();
    let positions = limits.position_lower.iter_mut().zip(&mut limits.position_upper);
    let all = positions.zip(&mut limits.velocity_max).zip(own).zip(1..);
    for ((((lower, upper), speed), own), joint) in all {
        let Some(own) = own else { continue };
        let (low, high) = (f64::from(own.lower) / 10.0, f64::from(own.upper) / 10.0);
        let (inner, outer) = (lower.max(low.to_radians()), upper.min(high.to_radians()));
        if outer - inner >= NARROWEST {
            (*lower, *upper) = (inner, outer);
        } else {
            odd.push(format!(
                "joint {joint}: the controller's limits of {low} to {high} deg leave no range: those of the data sheet are \
                 used, {:.1} to {:.1} deg",
                lower.to_degrees(),
                upper.to_degrees()
            ));
        }
        let own_speed = f64::from(own.speed) * 1e-3;
        if own.speed == 0 {
            odd.push(format!(
                "joint {joint}: the controller's top speed is 0: that of the data sheet is used, {speed} rad/s"
            ));
            continue;
        }
        *speed = speed.min(own_speed);
        if own_speed < SLOW {
            odd.push(format!(
                "joint {joint}: the controller has been given a top speed of {own_speed} rad/s, which it moves with at most\n\
                 hint: MotorAngleLimitMaxSpdSet of the vendor's SDK sets another one"
            ));
        }
    }
    (limits, odd)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn with(joint: usize, lower: i16, upper: i16, speed: u16) -> (JointLimits, Vec<String>) {
        let mut own = [None; DOF];
        own[joint - 1] = Some(MotorLimits { lower, upper, speed });
        narrowed(&own)
    }

    #[test]
    fn sensible_limits_narrow_those_of_the_sheet_without_a_word() {
        let (narrow, odd) = with(1, -900, 900, 1500);
        let lower = narrow.position_lower[0].to_degrees();
        assert!((lower + 90.0).abs() < 1e-9 && narrow.velocity_max[0] == 1.5 && odd.is_empty());
        assert_eq!(with(2, -1800, 1800, 9000), (limits(), vec![]), "never wider than the sheet");
        assert_eq!(narrowed(&[None; DOF]), (limits(), vec![]));
    }

    #[test]
    fn nonsense_is_dropped_with_a_warning() {
        for (lower, upper) in [(-1, -1), (900, -900), (-1800, -10), (0, 10)] {
            let (same, odd) = with(2, lower, upper, 3000);
            assert_eq!(same, limits());
            let begin = format!("joint 2: the controller's limits of {} to ", f64::from(lower) / 10.0);
            assert!(odd.len() == 1 && odd[0].starts_with(&begin) && odd[0].ends_with("0.0 to 179.9 deg"), "{odd:?}");
        }
        let (same, odd) = with(3, -1700, 0, 0);
        assert!(same.velocity_max == limits().velocity_max && odd.len() == 1, "{odd:?}");
    }

    #[test]
    fn a_speed_that_is_hardly_one_is_taken_with_a_warning() {
        let (slow, odd) = with(6, -1200, 1200, 1);
        assert_eq!(slow.velocity_max[5], 0.001);
        assert!(
            odd.len() == 1
                && odd[0].contains("joint 6")
                && odd[0].contains("0.001 rad/s")
                && odd[0].contains("\nhint: "),
            "{odd:?}"
        );
    }
}

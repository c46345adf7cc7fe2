//! Joint limits: those of the data sheet, narrowed by those of the arm's controller.

use super::model::Model;
use super::protocol::{DOF, MotorLimits};
use dimos_core::joint::JointLimits;

/// A narrower range is invalid [rad].
const MIN_RANGE: f64 = 0.02;
/// A lower top speed causes a warning [rad/s].
const LOW_SPEED: f64 = 0.1;

/// Returns the limits, and a log line for each unusual limit of the controller.
pub fn narrowed(model: Model, own: &[Option<MotorLimits>; DOF]) -> (JointLimits, Vec<String>) {
    let mut limits = model.limits();
    let mut odd = Vec::new();
    let positions = limits.position_lower.iter_mut().zip(&mut limits.position_upper);
    let all = positions.zip(&mut limits.velocity_max).zip(own).zip(1..);
    for ((((lower, upper), speed), own), joint) in all {
        let Some(own) = own else { continue };
        let (low, high) = (f64::from(own.lower) / 10.0, f64::from(own.upper) / 10.0);
        let (inner, outer) = (lower.max(low.to_radians()), upper.min(high.to_radians()));
        if outer - inner >= MIN_RANGE {
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
        if own_speed < LOW_SPEED {
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
        narrowed(Model::Piper, &own)
    }

    #[test]
    fn valid_limits_narrow_those_of_the_sheet_silently() {
        let (narrow, odd) = with(1, -900, 900, 1500);
        let lower = narrow.position_lower[0].to_degrees();
        assert!((lower + 90.0).abs() < 1e-9 && narrow.velocity_max[0] == 1.5 && odd.is_empty());
        assert_eq!(with(2, -1800, 1800, 9000), (Model::Piper.limits(), vec![]), "never wider than the sheet");
        assert_eq!(narrowed(Model::Piper, &[None; DOF]), (Model::Piper.limits(), vec![]));
    }

    #[test]
    fn invalid_limits_are_ignored_with_a_warning() {
        for (lower, upper) in [(-1, -1), (900, -900), (-1800, -10), (0, 10)] {
            let (same, odd) = with(2, lower, upper, 3000);
            assert_eq!(same, Model::Piper.limits());
            let begin = format!("joint 2: the controller's limits of {} to ", f64::from(lower) / 10.0);
            assert!(odd.len() == 1 && odd[0].starts_with(&begin) && odd[0].ends_with("0.0 to 179.9 deg"), "{odd:?}");
        }
        let (same, odd) = with(3, -1700, 0, 0);
        assert!(same.velocity_max == Model::Piper.limits().velocity_max && odd.len() == 1, "{odd:?}");
    }

    #[test]
    fn a_very_low_speed_is_accepted_with_a_warning() {
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

//! Grippers: positions in their own unit, or from 0, closed, to 1, open.

use super::names::Names;

/// Unit of a gripper's position.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scale {
    /// 0 closed, 1 open.
    Normalized,
    /// Its own: m or rad.
    Native,
}

fn range(names: &Names, arm: &str) -> Option<[f64; 2]> {
    names.grippers.iter().find(|gripper| gripper.arm == arm).and_then(|gripper| gripper.range)
}

/// Returns a position in the scale of the caller; `None`: unknown.
pub fn position(names: &Names, arm: &str, scale: Scale, native: Option<f64>) -> Option<f64> {
    match scale {
        Scale::Native => native,
        Scale::Normalized => {
            let [closed, open] = range(names, arm)?;
            native.map(|native| (native - closed) / (open - closed)).filter(|value| value.is_finite())
        }
    }
}

/// Returns the position to command [m or rad]; `None`: not one number, or outside the range.
pub fn target(names: &Names, arm: &str, scale: Scale, value: Option<f64>) -> Option<f64> {
    let value = value?;
    match (scale, range(names, arm)) {
        (Scale::Normalized, Some([closed, open])) => {
            (0.0..=1.0).contains(&value).then_some(closed + value * (open - closed))
        }
        (Scale::Normalized, None) => None,
        (Scale::Native, Some([a, b])) => (a.min(b)..=a.max(b)).contains(&value).then_some(value),
        // The run checks the value: the adapter reports no range.
        (Scale::Native, None) => Some(value),
    }
}

#[cfg(test)]
mod tests {
    use super::super::names::Gripper;
    use super::*;

    #[test]
    fn a_position_is_a_fraction_of_the_range_in_either_direction() {
        for (range, half) in [([0.0, 0.08], 0.04), ([0.0, -1.2], -0.6)] {
            let gripper = Gripper { arm: "arm".into(), range: Some(range) };
            let names = Names { grippers: vec![gripper], ..Names::default() };
            assert_eq!(target(&names, "arm", Scale::Normalized, Some(0.5)), Some(half));
            assert_eq!(position(&names, "arm", Scale::Normalized, Some(half)), Some(0.5));
            assert_eq!(target(&names, "arm", Scale::Native, Some(half)), Some(half));
            for wrong in [None, Some(-0.1), Some(1.1), Some(f64::NAN)] {
                assert_eq!(target(&names, "arm", Scale::Normalized, wrong), None);
            }
            assert_eq!(target(&names, "arm", Scale::Native, Some(2.0)), None);
            assert_eq!(position(&names, "arm", Scale::Normalized, None), None);
            assert_eq!(target(&names, "other", Scale::Normalized, Some(0.5)), None);
        }
    }
}

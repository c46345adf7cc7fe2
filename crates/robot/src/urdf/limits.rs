//! Limits of joints: `limit` and `safety_controller`.

use std::f64::consts::PI;

use super::Reader;
use crate::model::{JointKind, Limits};
use crate::xml::Element;
use dimos_yaml::Diag;

/// Range of a revolute joint beyond which its unit is doubted [rad]: two turns to each side, with digits rounded away.
const WIDE: f64 = 4.0 * PI + 0.01;

impl Reader<'_> {
    pub(super) fn limits(&mut self, element: &Element, kind: JointKind) -> Option<Limits> {
        let bounded = matches!(kind, JointKind::Revolute | JointKind::Prismatic);
        let Some(limit) = element.child("limit").filter(|_| kind != JointKind::Fixed) else {
            if !bounded {
                return Some(Limits::NONE);
            }
            let hint = "add <limit lower=\"…\" upper=\"…\" velocity=\"…\" effort=\"…\"/>, or make it continuous";
            let diag = Diag::error(format!("this {} joint has no `limit`", kind.name()));
            self.report(element.at, diag.hint(hint));
            return None;
        };
        let mut limits = Limits::NONE;
        let mut fine = true;
        if bounded {
            match self.range(limit) {
                Some([lower, upper]) => (limits.lower, limits.upper) = (lower, upper),
                None => fine = false,
            }
            fine = fine && self.soft_limits(element, kind, &mut limits).is_some();
            if fine {
                self.doubt(limit, kind, &limits);
            }
        }
        let missing = limit.attribute("velocity").is_none();
        if bounded && missing && self.version < 2 {
            self.error(limit.at, "this limit has no `velocity`");
        } else if bounded && missing {
            let what = "this limit has no `velocity`: it counts as none";
            self.report(limit.at, Diag::warning(what).hint("`max_velocity` of a blueprint's robot limits it"));
        }
        limits.velocity = self.rate(limit, "velocity")?;
        limits.effort = self.rate(limit, "effort")?;
        let rates = [self.rate(limit, "acceleration")?, self.rate(limit, "deceleration")?];
        limits.acceleration = Some(rates[0].min(rates[1])).filter(|v| v.is_finite());
        limits.jerk = self.rate(limit, "jerk").filter(|v| v.is_finite());
        (fine && !(bounded && missing && self.version < 2)).then_some(limits)
    }

    /// Returns the lower and upper limit [rad or m]. An omitted one is zero before version 1.2.
    fn range(&mut self, limit: &Element) -> Option<[f64; 2]> {
        let lacks = |name: &str| limit.attribute(name).is_none();
        if let Some(name) = ["lower", "upper"].into_iter().find(|name| self.version >= 2 && lacks(name)) {
            self.error(limit.at, format!("this limit has no `{name}`: version 1.2 needs it"));
            return None;
        }
        let (lower, upper) = (self.number_or(limit, "lower", 0.0), self.number_or(limit, "upper", 0.0));
        let (lower, upper) = (lower?, upper?);
        if lower > upper {
            let diag = Diag::error(format!("the lower limit {lower} is above the upper limit {upper}"));
            let at = limit.attribute("lower").map_or(limit.at, |a| a.at);
            self.report(at, diag.hint("are they swapped?"));
            return None;
        }
        Some([lower, upper])
    }

    /// Narrows limits to the soft limits of a joint, each where it is given. As MoveIt does; fails if none are left.
    fn soft_limits(&mut self, element: &Element, kind: JointKind, limits: &mut Limits) -> Option<()> {
        let Some(soft) = element.child("safety_controller") else { return Some(()) };
        let lower = self.number_or(soft, "soft_lower_limit", limits.lower);
        let upper = self.number_or(soft, "soft_upper_limit", limits.upper);
        let (lower, upper) = (lower?.max(limits.lower), upper?.min(limits.upper));
        let name = element.attribute("name").map(|a| a.value.clone()).unwrap_or_default();
        if lower > upper {
            let what = format!("no position is left for the joint `{name}`: {lower} to {upper}");
            self.report(soft.at, Diag::error(what).hint("soft limits narrow those of `limit`; are they swapped?"));
            return None;
        }
        if (lower, upper) != (limits.lower, limits.upper) {
            self.narrowed.push((soft.at, format!("{name} to {lower} … {upper} {}", kind.unit())));
            (limits.lower, limits.upper) = (lower, upper);
        }
        Some(())
    }

    /// Warns of a range that was probably not meant.
    fn doubt(&mut self, limit: &Element, kind: JointKind, limits: &Limits) {
        let (lower, upper, unit) = (limits.lower, limits.upper, kind.unit());
        if lower == upper {
            let what = format!("this joint cannot move: its range is {lower} to {upper} {unit}");
            self.report(limit.at, Diag::warning(what).hint("give `lower` and `upper`, or make it fixed"));
        } else if kind == JointKind::Revolute && upper - lower > WIDE {
            let what = format!("the range of this joint is {lower} to {upper} rad: is it in degrees?");
            let hint = format!("a URDF is in radians: {upper}° are {:.4} rad", upper.to_radians());
            self.report(limit.at, Diag::warning(what).hint(hint));
        }
    }

    /// Returns a positive limit; infinite if omitted. Exporters write zero for an unknown limit.
    fn rate(&mut self, limit: &Element, name: &str) -> Option<f64> {
        let mut value = self.number_or(limit, name, f64::INFINITY)?;
        let at = limit.attribute(name).map_or(limit.at, |a| a.at);
        // An extension before version 1.2, written with a minus by those who think of MoveIt's.
        if name == "deceleration" && self.version < 2 {
            value = value.abs();
        }
        if value < 0.0 {
            self.error(at, format!("the {name} limit {value} is negative"));
            return None;
        }
        if value == 0.0 {
            if name == "velocity" {
                let what = "a velocity limit of 0 counts as not given";
                self.report(at, Diag::warning(what).hint("give the joint's actual limit"));
            }
            return Some(f64::INFINITY);
        }
        Some(value)
    }
}

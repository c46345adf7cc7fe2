//! The load at an arm's flange, as its controller needs it to compensate gravity and to detect collisions.

/// Differences from the written load that a controller may read back: mass [kg], centre [m], inertia [kg·m²].
const TOLERANCE: (f64, f64, f64) = (0.005, 0.001, 1e-3);
/// Largest mass [kg] and distance of the centre from the flange [m]: more is a mistake in the unit.
const LARGEST: (f64, f64) = (1000.0, 5.0);

/// Gravity in the base frame of an upright arm: a unit vector.
pub const UPRIGHT: [f64; 3] = [0.0, 0.0, -1.0];

/// A rigid body at the flange: tool and workpiece together.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Load {
    /// Mass [kg].
    pub mass: f64,
    /// Centre of mass in the flange frame [m].
    pub center: [f64; 3],
    /// Inertia about the centre of mass, along the axes of the flange frame: xx, xy, xz, yy, yz, zz [kg·m²]. All zero:
    /// a point mass, or unknown.
    pub inertia: [f64; 6],
}

impl Load {
    /// Checks the values; the error says what is wrong.
    pub fn check(&self) -> Result<(), String> {
        if !(0.0..=LARGEST.0).contains(&self.mass) {
            return Err(format!("the mass is {} kg, must be within 0 to {} kg", self.mass, LARGEST.0));
        }
        if let Some(far) = self.center.iter().find(|v| !(-LARGEST.1..=LARGEST.1).contains(*v)) {
            return Err(format!("the centre is {far} m from the flange, must be within {} m", LARGEST.1));
        }
        let [xx, xy, xz, yy, yz, zz] = self.inertia;
        let determinant = xx * (yy * zz - yz * yz) - xy * (xy * zz - yz * xz) + xz * (xy * yz - yy * xz);
        let minors = [xx * yy - xy * xy, xx * zz - xz * xz, yy * zz - yz * yz];
        // A thin body has minors of zero, which rounding makes negative.
        let size = 1e-3 * (xx + yy + zz);
        let semidefinite = [xx, yy, zz].iter().all(|v| *v >= 0.0)
            && minors.iter().all(|v| *v >= -size * size)
            && determinant >= -size.powi(3);
        if self.inertia.iter().any(|v| !v.is_finite()) || !semidefinite {
            return Err(format!("the inertia {:?} kg·m² is not that of a body", self.inertia));
        }
        Ok(())
    }

    /// What to do about a load that is too heavy.
    pub const TOO_HEAVY: &str = "masses are in kg; take a lighter tool or workpiece, or a larger arm";

    /// Refuses a load that is heavier than the arm's rated payload [kg].
    pub fn within(&self, most: Option<f64>) -> Result<(), String> {
        match most.filter(|most| self.mass > *most) {
            Some(most) => Err(format!("the arm takes at most {most:.1} kg, not {} kg", self.mass)),
            None => Ok(()),
        }
    }

    /// Returns the load of both bodies together.
    pub fn plus(&self, other: &Self) -> Self {
        if self.mass <= 0.0 {
            return *other;
        }
        if other.mass <= 0.0 {
            return *self;
        }
        let mass = self.mass + other.mass;
        let mut center = [0.0; 3];
        for ((c, a), b) in center.iter_mut().zip(self.center).zip(other.center) {
            *c = (self.mass * a + other.mass * b) / mass;
        }
        let mut inertia = [0.0; 6];
        for body in [self, other] {
            let [dx, dy, dz] =
                [0, 1, 2].map(|i: usize| body.center.get(i).zip(center.get(i)).map_or(0.0, |(a, b)| a - b));
            let shift = [dy * dy + dz * dz, -dx * dy, -dx * dz, dx * dx + dz * dz, -dy * dz, dx * dx + dy * dy];
            for ((sum, own), shift) in inertia.iter_mut().zip(body.inertia).zip(shift) {
                *sum += own + body.mass * shift;
            }
        }
        Self { mass, center, inertia }
    }

    /// Returns the rest of this load beside a part of it; `None` if that is no part of it. Unknown inertia stays so.
    pub fn without(&self, part: &Self) -> Option<Self> {
        let mass = self.mass - part.mass;
        if mass < -TOLERANCE.0 {
            return None;
        }
        if mass <= TOLERANCE.0 {
            return Some(Self::default());
        }
        let mut center = [0.0; 3];
        for ((c, all), of_part) in center.iter_mut().zip(self.center).zip(part.center) {
            *c = (self.mass * all - part.mass * of_part) / mass;
        }
        let mut rest = Self { mass, center, inertia: [0.0; 6] };
        if self.inertia.iter().any(|v| *v != 0.0) {
            // Without inertia of its own, the rest adds what its distance does.
            let bare = part.plus(&rest).inertia;
            rest.inertia =
                std::array::from_fn(|i| self.inertia.get(i).zip(bare.get(i)).map_or(0.0, |(all, bare)| all - bare));
        }
        rest.check().is_ok().then_some(rest)
    }

    /// Returns whether a controller that was set to this load may report `other`: rounded, and without the inertia or
    /// with the centre of no mass.
    pub fn agrees_with(&self, other: &Self) -> bool {
        let close = |a: &[f64], b: &[f64], by: f64| a.iter().zip(b).all(|(a, b)| (a - b).abs() <= by);
        let no_inertia = other.inertia.iter().all(|v| *v == 0.0);
        let largest = self.inertia.iter().fold(0.0, |most: f64, v| most.max(v.abs()));
        close(&[self.mass], &[other.mass], TOLERANCE.0)
            && (self.mass <= TOLERANCE.0 || close(&self.center, &other.center, TOLERANCE.1))
            && (no_inertia || close(&self.inertia, &other.inertia, TOLERANCE.2.max(0.01 * largest)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_bodies_are_one_load_with_the_parallel_axis_theorem() {
        let at = |x: f64, mass: f64| Load { mass, center: [x, 0.0, 0.0], inertia: [0.0; 6] };
        let both = at(0.1, 1.0).plus(&at(0.3, 3.0));
        assert!((both.mass - 4.0).abs() < 1e-12 && (both.center[0] - 0.25).abs() < 1e-12, "{both:?}");
        // Two point masses: the reduced mass 3/4 kg at 0.2 m.
        let expected = [0.0, 0.0, 0.0, 0.03, 0.0, 0.03];
        assert!(both.inertia.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{both:?}");
        let tool = Load { mass: 0.8, center: [0.0, 0.01, 0.05], inertia: [1e-3, 1e-5, 0.0, 2e-3, 0.0, 3e-3] };
        assert_eq!(tool.plus(&Load::default()), tool);
        assert_eq!(Load::default().plus(&Load::default()), Load::default());
        // Off the diagonal: one body at (d, d, 0) about the common centre.
        let diagonal = Load { mass: 1.0, center: [0.2, 0.2, 0.0], inertia: [0.0; 6] };
        let xy = diagonal.plus(&Load { mass: 1.0, ..Load::default() }).inertia[1];
        assert!((xy + 2.0 * 0.01).abs() < 1e-12, "{xy}");
    }

    #[test]
    fn the_rest_of_a_load_and_its_part_are_the_load() {
        let tool = Load { mass: 0.73, center: [-0.01, 0.0, 0.03], inertia: [1e-3, 0.0, 0.0, 2.5e-3, 0.0, 1.7e-3] };
        let part = Load { mass: 0.5, center: [0.0, 0.02, 0.12], inertia: [1e-3, 1e-4, 0.0, 1e-3, 0.0, 2e-3] };
        let both = tool.plus(&part);
        let rest = both.without(&tool).unwrap();
        assert!(part.agrees_with(&rest) && (rest.inertia[1] - 1e-4).abs() < 1e-9, "{rest:?}");
        assert_eq!(tool.without(&tool), Some(Load::default()));
        assert_eq!(part.without(&tool), None, "less than its part");
        let unknown = Load { inertia: [0.0; 6], ..both };
        assert_eq!(unknown.without(&tool).unwrap().inertia, [0.0; 6]);
        let thin = Load { inertia: [1e-4; 6], ..both };
        assert_eq!(thin.without(&tool), None, "what remains is no body");
    }

    #[test]
    fn a_load_that_is_read_back_may_be_rounded_but_not_another() {
        let load = Load { mass: 1.5, center: [0.0, 0.02, 0.1], inertia: [0.01, 0.0, 0.0, 0.01, 0.0, 0.02] };
        assert!(load.agrees_with(&Load { mass: 1.501, inertia: [0.0; 6], ..load }), "no inertia is reported");
        assert!(!load.agrees_with(&Load { mass: 1.6, ..load }));
        assert!(!load.agrees_with(&Load { center: [0.0, 0.02, 0.11], ..load }));
        assert!(!load.agrees_with(&Load { inertia: [0.02, 0.0, 0.0, 0.01, 0.0, 0.02], ..load }));
        assert!(
            Load::default().agrees_with(&Load { center: [0.0, 0.0, 0.1], ..Load::default() }),
            "no mass, no centre"
        );
    }

    #[test]
    fn mistakes_in_the_unit_are_found() {
        let load = Load { mass: 1.5, ..Load::default() };
        assert!(load.check().is_ok());
        assert!(Load { mass: -0.1, ..load }.check().unwrap_err().contains("-0.1 kg"));
        assert!(Load { mass: f64::NAN, ..load }.check().is_err());
        assert!(Load { center: [0.0, 0.0, 50.0], ..load }.check().unwrap_err().contains("50 m"));
        assert!(Load { inertia: [-1.0, 0.0, 0.0, 0.0, 0.0, 0.0], ..load }.check().is_err());
    }
}

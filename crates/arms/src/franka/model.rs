//! The models: dimensions and limits.

use std::f64::consts::FRAC_PI_2;

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::ceiling::toward;
use super::protocol::{DOF, Interface};
use dimos_core::joint::JointLimits;

/// The arms that this adapter knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Model {
    /// Franka Emika Robot (Panda).
    Fer,
    /// Franka Research 3.
    #[default]
    Fr3,
}

/// Share of the vendor's acceleration and jerk that the coordinator uses. The rest is for what smooths setpoints.
const SHARE: f64 = 0.7;
/// Share of the speeds that the vendor suggests for an FR3 which the controller allows everywhere in the suggested
/// range.
const EVERYWHERE: f64 = 0.95;
/// Share of the published speeds that the coordinator uses where it may use a joint's whole range.
const PLANNED: f64 = 0.95;
/// How far before the place where an FR3 allows no speed the coordinator's range ends [rad]. The coordinator itself
/// keeps `MARGIN` more [rad].
const END: f64 = 0.02;
const MARGIN: f64 = 0.01;
/// Jerk limit as a multiple of the acceleration limit [1/s].
const JERK: f64 = 500.0;

/// What the controller allows a joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointRange {
    /// Lowest and highest position [rad].
    pub lower: f64,
    /// Highest position [rad].
    pub upper: f64,
    /// Top speed [rad/s].
    pub velocity: f64,
    /// Acceleration [rad/s²].
    pub acceleration: f64,
    /// Jerk [rad/s³].
    pub jerk: f64,
    /// Offset [rad/s] and deceleration [rad/s²] of the speed limit near the ends of the range; `None`: the top speed
    /// everywhere.
    pub braking: Option<(f64, f64)>,
}

impl JointRange {
    /// Returns the lowest and the highest velocity at a position [rad/s].
    pub fn velocities(&self, position: f64) -> (f64, f64) {
        let Some((offset, deceleration)) = self.braking else { return (-self.velocity, self.velocity) };
        let toward = |room: f64| ((2.0 * deceleration * room).max(0.0).sqrt() - offset).clamp(0.0, self.velocity);
        (-toward(position - self.lower), toward(self.upper - position))
    }

    /// Returns how far from an end of the range the coordinator's range ends [rad]: an FR3 allows no speed close to it.
    fn dead_end(&self) -> f64 {
        self.braking.map_or(MARGIN, |(offset, deceleration)| offset * offset / (2.0 * deceleration) + END)
    }

    /// Returns the acceleration with which a joint that brakes to the end of the coordinator's range stays below the
    /// speeds that are allowed on the way [rad/s²].
    fn planned_acceleration(&self) -> f64 {
        if self.braking.is_none() {
            return self.acceleration;
        }
        let top = PLANNED * self.velocity;
        // Braking from the speed that is allowed at a distance takes v²/2a: 2 % steps from 0.1 mrad to 5 rad.
        let ways = (0..550).map(|i| 1e-4 * 1.02_f64.powi(i));
        ways.fold(self.acceleration, |least, way| {
            let (allowed, _) = toward(self, way + self.dead_end() + MARGIN, PLANNED);
            if allowed >= top { least } else { least.min(allowed * allowed / (2.0 * way)) }
        })
    }
}

impl Model {
    /// Returns the name in a blueprint.
    pub fn option(self) -> &'static str {
        match self {
            Self::Fer => "fer",
            Self::Fr3 => "fr3",
        }
    }

    /// Returns the highest speed of the end effector [m/s]: 97 % of the vendor's limit of Cartesian velocity.
    pub fn tool_speed(self) -> f64 {
        0.97 * match self {
            Self::Fer => 1.7,
            Self::Fr3 => 3.0,
        }
    }

    /// Returns the vendor's name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fer => "FER",
            Self::Fr3 => "FR3",
        }
    }

    /// Returns the version of the interface that its controller speaks.
    pub fn interface(self) -> Interface {
        match self {
            Self::Fer => Interface::Five,
            Self::Fr3 => Interface::Ten,
        }
    }

    /// Returns the published ranges of the joints. An FR3 reports its own.
    pub fn ranges(self) -> [JointRange; DOF] {
        // Lowest and highest position, top speed, acceleration, offset and deceleration near the ends.
        type Row = (f64, f64, f64, f64, f64, f64);
        const FER: [Row; DOF] = [
            (-2.8973, 2.8973, 2.175, 15.0, 0.0, 0.0),
            (-1.7628, 1.7628, 2.175, 7.5, 0.0, 0.0),
            (-2.8973, 2.8973, 2.175, 10.0, 0.0, 0.0),
            (-3.0718, -0.0698, 2.175, 12.5, 0.0, 0.0),
            (-2.8973, 2.8973, 2.61, 15.0, 0.0, 0.0),
            (-0.0175, 3.7525, 2.61, 20.0, 0.0, 0.0),
            (-2.8973, 2.8973, 2.61, 20.0, 0.0, 0.0),
        ];
        const FR3: [Row; DOF] = [
            (-2.9007, 2.9007, 2.62, 10.0, 0.6599, 6.0),
            (-1.8361, 1.8361, 2.62, 10.0, 0.2517, 2.585),
            (-2.9007, 2.9007, 2.62, 10.0, 0.2000, 3.5),
            (-3.0770, -0.1169, 2.62, 10.0, 0.3533, 4.0),
            (-2.8763, 2.8763, 5.26, 10.0, 0.5757, 17.0),
            (0.4398, 4.6216, 4.18, 10.0, 0.4878, 5.5),
            (-3.0508, 3.0508, 5.26, 10.0, 0.4628, 17.0),
        ];
        let rows = match self {
            Self::Fer => FER,
            Self::Fr3 => FR3,
        };
        rows.map(|(lower, upper, velocity, acceleration, offset, deceleration)| JointRange {
            lower,
            upper,
            velocity,
            acceleration,
            jerk: JERK * acceleration,
            braking: (deceleration > 0.0).then_some((offset, deceleration)),
        })
    }

    /// Returns the limits for the coordinator. With `full`, up to the ends of the joints' ranges, with accelerations
    /// with which an FR3 stays below the speeds that it allows there. Otherwise the range and nearly the speed that the
    /// vendor suggests for planners.
    pub fn limits(self, full: bool) -> JointLimits {
        self.limits_of(&self.ranges(), full)
    }

    /// Returns the same for a robot that reports these ranges.
    pub fn limits_of(self, ranges: &[JointRange; DOF], full: bool) -> JointLimits {
        let of = |value: fn(&JointRange) -> f64| ranges.iter().map(value).collect::<Vec<_>>();
        let suggested_range = self == Self::Fr3 && !full;
        let mut limits = JointLimits {
            position_lower: of(|range| range.lower + range.dead_end()),
            position_upper: of(|range| range.upper - range.dead_end()),
            velocity_max: of(|range| PLANNED * range.velocity),
            acceleration_max: of(if suggested_range {
                |range| SHARE * range.acceleration
            } else {
                |range| range.planned_acceleration().min(SHARE * range.acceleration)
            }),
            jerk_max: of(|range| SHARE * range.jerk),
        };
        if suggested_range {
            let suggested: [(f64, f64, f64); DOF] = [
                (-2.3476, 2.3476, 2.0),
                (-1.5454, 1.5454, 1.0),
                (-2.4937, 2.4937, 1.5),
                (-2.7714, -0.4226, 1.25),
                (-2.5100, 2.5100, 3.0),
                (0.7773, 4.2841, 1.5),
                (-2.7045, 2.7045, 3.0),
            ];
            let narrow = |list: &mut Vec<f64>, to: fn(f64, (f64, f64, f64)) -> f64| {
                list.iter_mut().zip(suggested).for_each(|(value, row)| *value = to(*value, row));
            };
            narrow(&mut limits.position_lower, |value, row| value.max(row.0));
            narrow(&mut limits.position_upper, |value, row| value.min(row.1));
            narrow(&mut limits.velocity_max, |value, row| value.min(EVERYWHERE * row.2));
        }
        limits
    }

    /// Returns the transform of one joint at a position [rad], or of the flange after the last one: both models have
    /// the same dimensions.
    pub fn link(joint: usize, position: f64) -> Option<Isometry3<f64>> {
        // Denavit-Hartenberg parameters as the vendor has them (Craig): a, d [m], alpha in quarters of a turn.
        const DH: [(f64, f64, f64); DOF] = [
            (0.0, 0.333, 0.0),
            (0.0, 0.0, -1.0),
            (0.0, 0.316, 1.0),
            (0.0825, 0.0, 1.0),
            (-0.0825, 0.384, -1.0),
            (0.0, 0.0, 1.0),
            (0.088, 0.0, 1.0),
        ];
        let (a, d, quarters) = *DH.get(joint)?;
        let turn = |axis, angle| UnitQuaternion::from_axis_angle(&axis, angle);
        let twist =
            Isometry3::from_parts(Translation3::new(a, 0.0, 0.0), turn(Vector3::x_axis(), quarters * FRAC_PI_2));
        Some(twist * Isometry3::from_parts(Translation3::new(0.0, 0.0, d), turn(Vector3::z_axis(), position)))
    }

    /// Distance from the last joint to the flange [m].
    pub const FLANGE: f64 = 0.107;
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_fr3_may_use_the_suggested_speed_everywhere_in_the_suggested_range() {
        let (ranges, boxed) = (Model::Fr3.ranges(), Model::Fr3.limits(false));
        for (joint, range) in ranges.iter().enumerate() {
            let (low, high) = (boxed.position_lower[joint], boxed.position_upper[joint]);
            for i in 0..=100 {
                let (lowest, highest) = range.velocities(low + (high - low) * f64::from(i) / 100.0);
                let top = boxed.velocity_max[joint] - 2e-3;
                assert!(lowest <= -top && highest >= top, "joint {}: {lowest} {highest}", joint + 1);
            }
            assert_eq!(range.velocities(range.upper).1, 0.0);
            assert_eq!(range.velocities(range.lower).0, 0.0);
        }
    }

    #[test]
    fn an_fer_has_its_top_speed_everywhere() {
        let range = Model::Fer.ranges()[0];
        assert_eq!(range.velocities(2.8), (-2.175, 2.175));
    }

    #[test]
    fn upright_at_zero() {
        let end = (0..DOF).fold(Isometry3::identity(), |pose, joint| pose * Model::link(joint, 0.0).unwrap());
        let flange = end * Translation3::new(0.0, 0.0, Model::FLANGE);
        // 0.333 + 0.316 + 0.384 up, the flange down again by 0.107, beside the axis by 0.088.
        assert!((flange.translation.vector - Vector3::new(0.088, 0.0, 0.926)).norm() < 1e-9, "{flange}");
    }
}

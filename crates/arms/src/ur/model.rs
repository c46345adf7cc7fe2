//! The models: dimensions, joint limits, and how a controller names them.

use std::f64::consts::{FRAC_PI_2, TAU};

use nalgebra::{Isometry3, Translation3, UnitQuaternion, Vector3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::DOF;
use dimos_core::arm::Dh;
use dimos_core::joint::JointLimits;

/// The arms that this adapter knows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum Model {
    /// UR3 (CB3).
    Ur3,
    /// UR3e.
    Ur3e,
    /// UR5 (CB3).
    Ur5,
    /// UR5e.
    #[default]
    Ur5e,
    /// UR7e: a UR5e with a larger payload.
    Ur7e,
    /// UR8 Long.
    Ur8long,
    /// UR10 (CB3).
    Ur10,
    /// UR10e.
    Ur10e,
    /// UR12e: a UR10e by another name.
    Ur12e,
    /// UR15.
    Ur15,
    /// UR16e.
    Ur16e,
    /// UR18.
    Ur18,
    /// UR20.
    Ur20,
    /// UR30.
    Ur30,
}

/// Range of an endless joint each way [rad]: 159 turns. A position of that size is exact to 1e-13 rad, and the wrist
/// turns for more than 2 minutes at top speed to get there.
const ENDLESS: f64 = 1000.0;
/// Acceleration [rad/s²] and jerk [rad/s³] of every joint. The vendor publishes none: these are ours.
const ACCELERATION: f64 = 8.0;
const JERK: f64 = 200.0;

/// Published figures of a model: name, type in the primary interface, d1, a2, a3, d4, d5, d6 [m], top speeds of joints
/// 1, 2, 3 and of the wrists [deg/s], rated payload [kg].
struct Sheet {
    name: &'static str,
    kind: u32,
    size: [f64; 6],
    speed: [f64; 4],
    payload: f64,
}

impl Model {
    /// All models.
    pub const ALL: [Self; 14] = [
        Self::Ur3,
        Self::Ur3e,
        Self::Ur5,
        Self::Ur5e,
        Self::Ur7e,
        Self::Ur8long,
        Self::Ur10,
        Self::Ur10e,
        Self::Ur12e,
        Self::Ur15,
        Self::Ur16e,
        Self::Ur18,
        Self::Ur20,
        Self::Ur30,
    ];

    fn sheet(self) -> Sheet {
        let sheet = |name, kind, size, speed, payload| Sheet { name, kind, size, speed, payload };
        let (small, middle) = ([180.0, 180.0, 180.0, 360.0], [180.0; 4]);
        let (large, largest) = ([120.0, 120.0, 180.0, 180.0], [120.0, 120.0, 150.0, 210.0]);
        // The joints of UR8 Long, UR15 and UR18 are the same; the speeds are those published of the UR18, and the
        // controller reports the arm's own.
        let newer = [180.0, 180.0, 240.0, 300.0];
        match self {
            Self::Ur3 => sheet("UR3", 3, [0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819], small, 3.0),
            Self::Ur3e => sheet("UR3e", 3, [0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921], small, 3.0),
            Self::Ur5 => sheet("UR5", 1, [0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823], middle, 5.0),
            Self::Ur5e => sheet("UR5e", 1, [0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996], middle, 5.0),
            Self::Ur7e => Sheet { name: "UR7e", payload: 7.5, ..Self::Ur5e.sheet() },
            Self::Ur8long => sheet("UR8Long", 6, [0.2186, -0.8989, -0.7149, 0.1824, 0.1361, 0.1434], newer, 8.0),
            Self::Ur10 => sheet("UR10", 2, [0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922], large, 10.0),
            Self::Ur10e => sheet("UR10e", 2, [0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655], large, 12.5),
            Self::Ur12e => Sheet { name: "UR12e", ..Self::Ur10e.sheet() },
            Self::Ur15 => sheet("UR15", 9, [0.2186, -0.6475, -0.5164, 0.1824, 0.1361, 0.1434], newer, 15.0),
            Self::Ur18 => sheet("UR18", 5, [0.2186, -0.475, -0.3389, 0.1824, 0.1361, 0.1434], newer, 18.0),
            Self::Ur16e => sheet("UR16e", 4, [0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655], large, 16.0),
            Self::Ur20 => sheet("UR20", 7, [0.2363, -0.862, -0.7287, 0.201, 0.1593, 0.1543], largest, 20.0),
            Self::Ur30 => sheet("UR30", 8, [0.2363, -0.637, -0.5037, 0.201, 0.1593, 0.1543], largest, 30.0),
        }
    }

    /// Returns the model of a type in the primary interface and of the major version of the controller's software: the
    /// CB3 and the e-Series arm of a size have the same type. `None` for one that this adapter does not know.
    pub fn of(kind: u32, major: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.is(kind, major))
    }

    /// Returns whether an arm with this type and software may be this model. A UR7e has the type of a UR5e, and a UR12e
    /// that of a UR10e.
    pub fn is(self, kind: u32, major: u8) -> bool {
        self.kind() == kind && self.is_cb3() == (major < 5)
    }

    /// Returns the type in the primary interface.
    pub fn kind(self) -> u32 {
        self.sheet().kind
    }

    /// Returns whether the arm belongs to the CB3 series.
    pub fn is_cb3(self) -> bool {
        matches!(self, Self::Ur3 | Self::Ur5 | Self::Ur10)
    }

    /// Returns the vendor's name.
    pub fn name(self) -> &'static str {
        self.sheet().name
    }

    /// Returns the name in a blueprint.
    pub fn option(self) -> String {
        self.name().to_ascii_lowercase()
    }

    /// Returns the rated payload [kg].
    pub fn payload(self) -> f64 {
        self.sheet().payload
    }

    /// Returns how often the controller sends its state, and its control rate [Hz].
    pub fn rate(self) -> f64 {
        if self.is_cb3() { 125.0 } else { 500.0 }
    }

    /// Returns whether a joint, counted from 0, turns without end: wrist 3 of the smallest arms.
    pub fn is_endless(self, joint: usize) -> bool {
        joint == DOF - 1 && matches!(self, Self::Ur3 | Self::Ur3e)
    }

    /// Returns the published joint limits. An arm's safety configuration may narrow them.
    pub fn limits(self) -> JointLimits {
        let [base, shoulder, elbow, wrist] = self.sheet().speed.map(f64::to_radians);
        let range = |joint| if self.is_endless(joint) { ENDLESS } else { TAU };
        JointLimits {
            position_lower: (0..DOF).map(|joint| -range(joint)).collect(),
            position_upper: (0..DOF).map(range).collect(),
            velocity_max: vec![base, shoulder, elbow, wrist, wrist, wrist],
            acceleration_max: vec![ACCELERATION; DOF],
            jerk_max: vec![JERK; DOF],
        }
    }

    /// Returns the Denavit-Hartenberg parameters of each joint by the data sheet.
    pub fn dh(self) -> [Dh; DOF] {
        let [d1, a2, a3, d4, d5, d6] = self.sheet().size;
        let quarter = FRAC_PI_2;
        [(0.0, d1, quarter), (a2, 0.0, 0.0), (a3, 0.0, 0.0), (0.0, d4, quarter), (0.0, d5, -quarter), (0.0, d6, 0.0)]
            .map(|(a, d, alpha)| Dh { theta: 0.0, a, d, alpha })
    }

    /// Returns the transform of one joint at a position [rad].
    pub fn link(self, joint: usize, position: f64) -> Option<Isometry3<f64>> {
        let Dh { theta, a, d, alpha } = *self.dh().get(joint)?;
        let turn = Isometry3::from_parts(
            Translation3::new(0.0, 0.0, d),
            UnitQuaternion::from_axis_angle(&Vector3::z_axis(), theta + position),
        );
        let twist = UnitQuaternion::from_axis_angle(&Vector3::x_axis(), alpha);
        Some(turn * Isometry3::from_parts(Translation3::new(a, 0.0, 0.0), twist))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_type_and_the_series_make_the_model() {
        assert_eq!((Model::of(1, 3), Model::of(1, 5)), (Some(Model::Ur5), Some(Model::Ur5e)));
        assert_eq!((Model::of(2, 3), Model::of(2, 5)), (Some(Model::Ur10), Some(Model::Ur10e)));
        assert_eq!(
            (Model::of(4, 5), Model::of(7, 5), Model::of(8, 5)),
            (Some(Model::Ur16e), Some(Model::Ur20), Some(Model::Ur30))
        );
        assert_eq!(
            (Model::of(5, 5), Model::of(6, 5), Model::of(9, 10)),
            (Some(Model::Ur18), Some(Model::Ur8long), Some(Model::Ur15))
        );
        assert_eq!((Model::of(10, 5), Model::of(4, 3)), (None, None));
        for model in Model::ALL {
            assert!(model.is(model.kind(), if model.is_cb3() { 3 } else { 5 }));
            assert_eq!(serde_json::to_value(model).unwrap(), model.option());
        }
    }

    #[test]
    fn stretched_along_minus_x_at_zero() {
        let end = (0..DOF).fold(Isometry3::identity(), |pose, joint| pose * Model::Ur5e.link(joint, 0.0).unwrap());
        let at = end.translation.vector;
        // The vendor's own figure for a UR5e at zero: x = −817.2, y = −232.9, z = 62.8 mm.
        assert!((at - Vector3::new(-0.8172, -0.2329, 0.0628)).norm() < 1e-9, "{at}");
    }
}

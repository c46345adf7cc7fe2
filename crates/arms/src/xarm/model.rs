//! The models: their identities and joint limits.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_core::joint::JointLimits;

/// The arms that speak this protocol.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Model {
    /// xArm 5.
    Xarm5,
    /// xArm 6.
    Xarm6,
    /// xArm 7.
    Xarm7,
    /// Lite 6.
    Lite6,
    /// 850.
    Xarm850,
}

/// What a controller reports about its arm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// Number of joints.
    pub axes: usize,
    /// The vendor's number for the kind of arm.
    pub kind: u16,
    /// Serial number of the arm, or its beginning.
    pub serial: String,
}

/// Top speed [rad/s], acceleration [rad/s²] and jerk [rad/s³] of every joint of every model. The acceleration is that
/// of the vendor's own examples, 500°/s²; with the API's maximum, more than twice that, arms report abnormal currents
/// (error 31).
pub const VELOCITY: f64 = std::f64::consts::PI;
const ACCELERATION: f64 = 8.726_646;
const JERK: f64 = 500.0;

/// Ranges [rad] that several models share.
const TURN: (f64, f64) = (-2.0 * std::f64::consts::PI, 2.0 * std::f64::consts::PI);
const SHOULDER: (f64, f64) = (-2.059488, 2.094395);
const WRIST: (f64, f64) = (-1.692969, std::f64::consts::PI);
const SHOULDER_1305: (f64, f64) = (-2.042035, 2.024581);
const ELBOW_1305: (f64, f64) = (-3.822271, 0.174532);

const XARM5: [(f64, f64); 5] = [TURN, SHOULDER, (-3.92699, 0.191986), WRIST, TURN];
const XARM6: [(f64, f64); 6] = [TURN, SHOULDER, (-3.92699, 0.191986), TURN, WRIST, TURN];
const XARM6_OF_1: [(f64, f64); 6] = [TURN, SHOULDER, (-0.191986, 3.92699), TURN, WRIST, TURN];
const XARM6_WIDE: [(f64, f64); 6] = [TURN, TURN, TURN, TURN, WRIST, TURN];
const XARM7: [(f64, f64); 7] = [TURN, SHOULDER, TURN, (-0.191986, 3.92699), TURN, WRIST, TURN];
const XARM7_OF_3: [(f64, f64); 7] = [TURN, SHOULDER, TURN, (-3.92699, 0.191986), TURN, WRIST, TURN];
const XARM7_MIRROR: [(f64, f64); 7] =
    [TURN, (-2.094395, 2.059488), TURN, (-3.92699, 0.191986), TURN, (-std::f64::consts::PI, 1.692969), TURN];
const LITE6: [(f64, f64); 6] = [TURN, (-2.617994, 2.617994), (-0.061087, 5.235988), TURN, (-2.164208, 2.164208), TURN];
const XARM850: [(f64, f64); 6] =
    [TURN, (-2.303835, 2.303835), (-4.223697, 0.061087), TURN, (-2.164208, 2.164208), TURN];

const XARM5_1305: [(f64, f64); 5] = [TURN, SHOULDER_1305, ELBOW_1305, WRIST, TURN];
const XARM6_1305: [(f64, f64); 6] = [TURN, SHOULDER_1305, ELBOW_1305, TURN, WRIST, TURN];
const XARM7_1305: [(f64, f64); 7] = [TURN, SHOULDER_1305, TURN, (-0.10472, 3.92699), TURN, WRIST, TURN];

impl Model {
    /// Returns the rated payload [kg], of the vendor's data sheets.
    pub fn payload(self) -> f64 {
        match self {
            Self::Xarm5 => 3.0,
            Self::Xarm6 | Self::Xarm850 => 5.0,
            Self::Xarm7 => 3.5,
            Self::Lite6 => 0.6,
        }
    }

    /// Returns the default model with this number of joints.
    pub fn of_dof(dof: usize) -> Option<Self> {
        match dof {
            5 => Some(Self::Xarm5),
            6 => Some(Self::Xarm6),
            7 => Some(Self::Xarm7),
            _ => None,
        }
    }

    /// Returns the model of an identity.
    pub fn of(identity: &Identity) -> Option<Self> {
        match (identity.axes, identity.kind) {
            (6, 9) => Some(Self::Lite6),
            (6, 12) => Some(Self::Xarm850),
            (5, 5) => Some(Self::Xarm5),
            (6, 6 | 8 | 11) => Some(Self::Xarm6),
            (7, 3 | 7 | 13) => Some(Self::Xarm7),
            _ => None,
        }
    }

    /// Returns the number of joints.
    pub fn axes(self) -> usize {
        match self {
            Self::Xarm5 => 5,
            Self::Xarm7 => 7,
            _ => 6,
        }
    }

    /// Returns the name on the arm.
    pub fn name(self) -> &'static str {
        match self {
            Self::Xarm5 => "xArm 5",
            Self::Xarm6 => "xArm 6",
            Self::Xarm7 => "xArm 7",
            Self::Lite6 => "Lite 6",
            Self::Xarm850 => "850",
        }
    }

    /// Returns the article for the name in a sentence.
    pub fn article(self) -> &'static str {
        if self == Self::Lite6 { "a" } else { "an" }
    }

    /// Returns the highest speed of the tool [m/s]: 5 % below what its manual allows. In servo mode the box of an xArm
    /// stops above 1.0 to 1.2 m/s, with error 60 or 24 (xArm-Python-SDK #94, #124; xarm_ros2 #112).
    pub fn tool_speed(self) -> f64 {
        match self {
            Self::Lite6 => 0.475,
            _ => 0.95,
        }
    }

    /// Returns the name in a blueprint.
    pub fn option(self) -> &'static str {
        match self {
            Self::Xarm5 => "xarm5",
            Self::Xarm6 => "xarm6",
            Self::Xarm7 => "xarm7",
            Self::Lite6 => "lite6",
            Self::Xarm850 => "xarm850",
        }
    }

    /// Returns the top speed of the TCP in planned moves [mm/s].
    pub fn line_speed(self) -> f64 {
        if self == Self::Lite6 { 500.0 } else { 1000.0 }
    }

    /// Returns the position of the flange with all joints at zero: x, z [mm]; it points down, and y is 0.
    pub fn zero_pose(self) -> (f64, f64) {
        match self {
            Self::Xarm5 | Self::Xarm6 => (207.0, 112.0),
            Self::Xarm7 => (206.0, 120.5),
            Self::Lite6 => (87.0, 154.2),
            Self::Xarm850 => (150.0, 238.0),
        }
    }

    /// Returns the joint limits of this model: the narrower ones if series differ. Variants, such as mirrored arms,
    /// have others: [`Identity::limits`].
    pub fn limits(self) -> JointLimits {
        limits_of(match self {
            Self::Xarm5 => &XARM5_1305,
            Self::Xarm6 => &XARM6_1305,
            Self::Xarm7 => &XARM7_1305,
            Self::Lite6 => &LITE6,
            Self::Xarm850 => &XARM850,
        })
    }
}

impl Identity {
    /// Returns the joint limits of this arm; `None` for an unknown variant.
    pub fn limits(&self) -> Option<JointLimits> {
        let newer = self.is_of_series_1305();
        Some(limits_of(match (Model::of(self)?, self.kind) {
            (Model::Xarm6, 8) => &XARM6_OF_1,
            (Model::Xarm6, 11) => &XARM6_WIDE,
            (Model::Xarm7, 3) => &XARM7_OF_3,
            (Model::Xarm7, 13) => &XARM7_MIRROR,
            (Model::Xarm5, _) if newer => &XARM5_1305,
            (Model::Xarm6, _) if newer => &XARM6_1305,
            (Model::Xarm7, _) if newer => &XARM7_1305,
            (Model::Xarm5, _) => &XARM5,
            (Model::Xarm6, _) => &XARM6,
            (Model::Xarm7, _) => &XARM7,
            (Model::Lite6, _) => &LITE6,
            (Model::Xarm850, _) => &XARM850,
        }))
    }

    /// Returns whether digits three to six of the serial number are those of the newer series.
    fn is_of_series_1305(&self) -> bool {
        let digits = self.serial.get(2..6).and_then(|digits| digits.parse().ok());
        digits.is_some_and(|series: u16| (1305..8500).contains(&series))
    }
}

fn limits_of(ranges: &[(f64, f64)]) -> JointLimits {
    JointLimits {
        position_lower: ranges.iter().map(|range| range.0).collect(),
        position_upper: ranges.iter().map(|range| range.1).collect(),
        velocity_max: vec![VELOCITY; ranges.len()],
        acceleration_max: vec![ACCELERATION; ranges.len()],
        jerk_max: vec![JERK; ranges.len()],
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn limits_follow_the_kind_and_the_serial_number() {
        let arm = |axes, kind, serial: &str| Identity { axes, kind, serial: serial.into() };
        let elbow = |identity: Identity, joint: usize| {
            let limits = identity.limits().unwrap();
            assert_eq!(limits.position_lower.len(), identity.axes);
            (limits.position_lower[joint].to_degrees().round(), limits.position_upper[joint].to_degrees().round())
        };
        assert_eq!(elbow(arm(6, 6, "XI1302"), 2), (-225.0, 11.0));
        assert_eq!(elbow(arm(6, 6, "XI1305"), 2), (-219.0, 10.0));
        assert_eq!(elbow(arm(6, 6, "XI"), 2), (-225.0, 11.0));
        assert_eq!(elbow(arm(7, 7, "XS1305"), 3), (-6.0, 225.0));
        assert_eq!(elbow(arm(7, 13, "CS1305"), 3), (-225.0, 11.0));
        assert_eq!(elbow(arm(6, 9, "LI1006"), 2), (-4.0, 300.0));
        assert_eq!(elbow(arm(6, 12, "FX8510"), 2), (-242.0, 4.0));
        assert_eq!(arm(8, 7, "").limits(), None);
        for model in [Model::Xarm5, Model::Xarm6, Model::Xarm7, Model::Lite6, Model::Xarm850] {
            assert_eq!(model.limits().position_lower.len(), model.axes());
        }
    }
}

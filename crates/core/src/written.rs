//! What a number that a person typed can mean: lengths are in m, angles in rad. The same sentences wherever one is
//! typed: in the shell, a blueprint, a job, a file of obstacles, a request.

use std::f64::consts::TAU;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Longest length [m]; a larger number is one in mm.
pub const LONGEST: f64 = 10.0;
/// Highest speed of a tool [m/s], of a joint [rad/s], and acceleration of a joint [rad/s²].
const FASTEST: f64 = 10.0;
const FASTEST_JOINT: f64 = 20.0;
const QUICKEST_JOINT: f64 = 200.0;
/// Length above which the unit is doubted [m].
pub const LONG: f64 = 5.0;

/// Refuses an angle of more than a turn [rad].
pub fn angle(value: f64) -> Result<(), String> {
    match value.abs() <= TAU {
        true => Ok(()),
        false => Err(format!("angles are in rad, at most a turn: {value}° is {:.4} rad", value.to_radians())),
    }
}

/// Refuses a length or coordinate beyond [`LONGEST`] [m].
pub fn length(value: f64) -> Result<(), String> {
    match value.abs() <= LONGEST {
        true => Ok(()),
        false => Err(format!("lengths are in m, at most {LONGEST}: {value} mm is {} m", rounded(value / 1000.0))),
    }
}

/// Refuses a padding beyond 1 m, and one below 0.
pub fn padding(value: f64) -> Result<(), String> {
    match (0.0..=1.0).contains(&value) {
        true => Ok(()),
        false => Err(format!("padding is {value}, must be within 0–1 m")),
    }
}

/// Refuses a speed of the tool that no arm has [m/s].
pub fn tool_speed(value: f64) -> Result<(), String> {
    match value.abs() <= FASTEST {
        true => Ok(()),
        false => {
            Err(format!("tool speeds are in m/s, at most {FASTEST}: {value} mm/s is {} m/s", rounded(value / 1000.0)))
        }
    }
}

/// Refuses a speed that no joint has [rad/s].
pub fn joint_speed(value: f64) -> Result<(), String> {
    rate(value, FASTEST_JOINT, "/s")
}

/// Refuses an acceleration that no joint has [rad/s²].
pub fn joint_acceleration(value: f64) -> Result<(), String> {
    rate(value, QUICKEST_JOINT, "/s²")
}

fn rate(value: f64, most: f64, per: &str) -> Result<(), String> {
    match value.abs() <= most {
        true => Ok(()),
        false => {
            Err(format!("joints have at most {most} rad{per}: {value}°{per} is {:.4} rad{per}", value.to_radians()))
        }
    }
}

/// Returns a hint for a joint position [rad] that is probably one in degrees.
pub fn degrees(position: f64) -> Option<String> {
    (position.abs() > TAU).then(|| format!("positions are in rad: {position}° is {:.4} rad", position.to_radians()))
}

/// Returns a doubt about the first of these lengths that is far for an arm's cell [m].
pub fn doubt(values: &[f64]) -> Option<String> {
    let far = values.iter().find(|value| value.abs() > LONG)?;
    Some(format!("{far} m is far for an arm's cell: is it in m?"))
}

/// Shape of an obstacle. Its frame is at its centre; the axis of a cylinder is z.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub enum ShapeSpec {
    /// Edge lengths x, y, z [m].
    Box([f64; 3]),
    /// Radius [m].
    Sphere(f64),
    /// Radius and length [m].
    Cylinder([f64; 2]),
    /// A mesh file (STL, OBJ, DAE): relative to the file that names it; in a request an absolute path.
    Mesh(String),
    /// A point cloud file (PLY), named alike.
    Cloud(String),
}

impl ShapeSpec {
    /// Returns its lengths [m].
    pub fn sizes(&self) -> &[f64] {
        match self {
            Self::Box(size) => size,
            Self::Sphere(radius) => std::slice::from_ref(radius),
            Self::Cylinder(size) => size,
            Self::Mesh(_) | Self::Cloud(_) => &[],
        }
    }

    /// Returns what is wrong with its lengths, if anything.
    pub fn sizes_valid(&self) -> Result<(), String> {
        self.sizes().iter().try_for_each(|size| match *size > 0.0 {
            true => length(*size),
            false => Err(format!("a size of the shape is {size}, must be above 0")),
        })
    }

    /// Returns what is wrong with a shape in a request, if anything.
    pub fn valid(&self) -> Result<(), String> {
        match self {
            Self::Mesh(path) | Self::Cloud(path) if !path.starts_with('/') => {
                Err(format!("{path:?} is not an absolute path"))
            }
            _ => self.sizes_valid().map_err(|wrong| format!("shape: {wrong}")),
        }
    }
}

/// A number without the last digits of a division.
fn rounded(value: f64) -> f64 {
    (value * 1e9).round() / 1e9
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_in_another_unit_is_said_in_ours() {
        assert!(angle(TAU).is_ok() && angle(-TAU).is_ok() && angle(f64::NAN).is_err());
        assert_eq!(angle(-180.0).unwrap_err(), "angles are in rad, at most a turn: -180° is -3.1416 rad");
        assert!(length(-10.0).is_ok() && length(f64::INFINITY).is_err());
        assert_eq!(length(350.1).unwrap_err(), "lengths are in m, at most 10: 350.1 mm is 0.3501 m");
        assert_eq!(tool_speed(250.0).unwrap_err(), "tool speeds are in m/s, at most 10: 250 mm/s is 0.25 m/s");
        assert_eq!(joint_speed(60.0).unwrap_err(), "joints have at most 20 rad/s: 60°/s is 1.0472 rad/s");
        assert!(joint_acceleration(60.0).is_ok() && padding(0.02).is_ok() && padding(20.0).is_err());
        assert_eq!(degrees(-90.0).unwrap(), "positions are in rad: -90° is -1.5708 rad");
        assert_eq!(degrees(6.0), None);
        assert_eq!(doubt(&[5.0, -4.0]), None);
        assert_eq!(doubt(&[1.0, -6.0]).unwrap(), "-6 m is far for an arm's cell: is it in m?");
    }
}

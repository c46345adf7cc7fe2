//! Poses as people and controllers write them, and as the program computes with them ([`Isometry3`]).
//!
//! Lengths are in m, angles in rad. Roll, pitch and yaw turn about fixed axes: R = Rz(yaw)·Ry(pitch)·Rx(roll), as in
//! URDF. Quaternions are x, y, z, w.

use std::f64::consts::PI;

use nalgebra::{Isometry3, Quaternion, Translation3, UnitQuaternion};

/// Returns the pose with this position [m] and these roll, pitch, yaw [rad].
pub fn from_xyz_rpy(xyz: [f64; 3], [roll, pitch, yaw]: [f64; 3]) -> Isometry3<f64> {
    Isometry3::from_parts(xyz.into(), UnitQuaternion::from_euler_angles(roll, pitch, yaw))
}

/// Cosine of the pitch below which roll and yaw turn about the same axis: the yaw is then all of it.
const GIMBAL_LOCK: f64 = 1e-7;

/// An angle this close to -π is written as π [rad]: rounding alone decides between them.
const HALF_TURN: f64 = 1e-9;

/// Returns position [m] and roll, pitch, yaw [rad] of a pose. At a pitch of ±π/2 the roll is zero; a half turn is π.
pub fn to_xyz_rpy(pose: &Isometry3<f64>) -> ([f64; 3], [f64; 3]) {
    let r = pose.rotation.to_rotation_matrix();
    let cos_pitch = r[(0, 0)].hypot(r[(1, 0)]);
    let pitch = (-r[(2, 0)]).atan2(cos_pitch);
    let (roll, yaw) = match cos_pitch > GIMBAL_LOCK {
        true => (r[(2, 1)].atan2(r[(2, 2)]), r[(1, 0)].atan2(r[(0, 0)])),
        false => (0.0, (-r[(0, 1)]).atan2(r[(1, 1)])),
    };
    let signed = |angle: f64| if angle < HALF_TURN - PI { PI } else { angle };
    (pose.translation.vector.into(), [signed(roll), pitch, signed(yaw)])
}

/// Returns the name of the point whose pose is an arm's: a link, or the tool on it.
pub fn tcp_name(link: &str, tool: bool) -> String {
    if tool { format!("the tool on {link}") } else { link.to_owned() }
}

/// Returns the pose with this position [m] and this orientation: the quaternion, which is normalized, else roll, pitch
/// and yaw [rad], else none.
pub fn from_written(xyz: [f64; 3], quat: Option<[f64; 4]>, rpy: Option<[f64; 3]>) -> Isometry3<f64> {
    match quat {
        Some([x, y, z, w]) => {
            let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
            Isometry3::from_parts(Translation3::from(xyz), rotation)
        }
        None => from_xyz_rpy(xyz, rpy.unwrap_or_default()),
    }
}

#[cfg(test)]
mod tests {
    use std::f64::consts::FRAC_PI_2;

    use nalgebra::{Point3, Vector3};

    use super::*;

    #[test]
    fn angles_turn_about_fixed_axes_roll_first() {
        let pose = from_xyz_rpy([1.0, 2.0, 3.0], [FRAC_PI_2, 0.0, FRAC_PI_2]);
        // Roll takes y to z, which yaw leaves; yaw takes x to y.
        assert!((pose.rotation * Vector3::y() - Vector3::z()).norm() < 1e-12);
        assert!((pose.rotation * Vector3::x() - Vector3::y()).norm() < 1e-12);
        assert_eq!(pose * Point3::origin(), Point3::new(1.0, 2.0, 3.0));
    }

    #[test]
    fn what_is_written_comes_back() {
        let (xyz, rpy) = ([0.1, -0.2, 0.3], [0.4, -0.5, 2.6]);
        let (there, back) = to_xyz_rpy(&from_xyz_rpy(xyz, rpy));
        assert!(there == xyz && back.iter().zip(rpy).all(|(a, b)| (a - b).abs() < 1e-12), "{back:?}");
    }

    #[test]
    fn a_half_turn_has_one_sign() {
        for (roll, yaw) in [(PI, 0.3), (-PI, 0.3), (-PI + 1e-12, -PI), (PI - 1e-12, -PI + 4e-16)] {
            let (_, [r, _, y]) = to_xyz_rpy(&from_xyz_rpy([0.0; 3], [roll, 0.2, yaw]));
            assert!((r - PI).abs() < 1e-11, "{r} for {roll}");
            assert!((y - yaw).abs() < 1e-11 || (y - PI).abs() < 1e-11, "{y} for {yaw}");
        }
        let (_, [roll, ..]) = to_xyz_rpy(&from_xyz_rpy([0.0; 3], [-PI + 1e-6, 0.0, 0.0]));
        assert!((roll + PI - 1e-6).abs() < 1e-12, "{roll}");
    }

    /// Gimbal lock is common: a gripper that points forwards.
    #[test]
    fn angles_of_a_level_tool_give_the_same_orientation() {
        for pitch in [FRAC_PI_2, -FRAC_PI_2] {
            for k in 0..200 {
                let off = 1e-9 * f64::from(k - 100) * f64::from(k % 7);
                let turns = UnitQuaternion::from_euler_angles(0.1 * f64::from(k), pitch + off, 0.03 * f64::from(k));
                // Rounding of a product of rotations, as in forward kinematics.
                let pose = Isometry3::from_parts(
                    Translation3::identity(),
                    turns * UnitQuaternion::from_euler_angles(0.3, 0.0, 0.0),
                );
                let (_, rpy) = to_xyz_rpy(&pose);
                let error = from_xyz_rpy([0.0; 3], rpy).rotation.angle_to(&pose.rotation);
                assert!(error < 2e-7, "{k}: {rpy:?} is {error} rad off");
            }
        }
    }

    #[test]
    fn a_quaternion_is_normalized_and_goes_before_angles() {
        let half = from_written([0.0; 3], Some([0.0, 0.0, 2.0, 0.0]), Some([0.1, 0.2, 0.3]));
        assert!((half.rotation * Vector3::x() + Vector3::x()).norm() < 1e-12);
        let angles = from_written([0.0; 3], None, Some([0.1, 0.2, 0.3]));
        assert_eq!(angles, from_xyz_rpy([0.0; 3], [0.1, 0.2, 0.3]));
        assert_eq!(from_written([1.0, 0.0, 0.0], None, None), Isometry3::translation(1.0, 0.0, 0.0));
    }
}

//! The masses of the emulated arm: those of §6 of the sheet, as bodies that its joints carry. Written a second time, on
//! purpose without the program's dynamics.

use nalgebra::{Isometry3, Point3, Vector3};

use super::super::protocol::DOF;
use super::kinematics::Links;
use dimos_core::joint::{Joints, MAX_DOF, joints_of};
use dimos_hardware::sim::reach::Chain;
use dimos_hardware::sim::weight::Masses;

/// Standard gravity [m/s²].
const G: f64 = 9.80665;
/// Mass after each joint [kg], and its centre in the frame after that joint [m].
const BODIES: [(f64, [f64; 3]); DOF] = [
    (2.6, [0.0, 0.0, -0.0212721]),
    (3.2, [0.0, 0.0, 0.199587]),
    (2.0, [0.125, 0.0, 0.0]),
    (0.5, [-0.035, 0.0, 0.0]),
    (0.7, [0.0, 0.0, 0.0]),
    (0.4, [0.07, 0.0, 0.0]),
];
/// Inertia of each joint about its axis in a usual pose, that of its motor included [kg·m²].
const INERTIA: [f64; DOF] = [0.8, 1.0, 0.4, 0.08, 0.08, 0.05];

/// Returns the masses of an arm whose position control has this stiffness [Nm/rad].
pub fn of(stiffness: f64) -> Masses {
    let mut inertia = [0.05; MAX_DOF];
    inertia.iter_mut().zip(INERTIA).for_each(|(to, value)| *to = value);
    Masses { gravity, inertia, stiffness }
}

/// Returns the torques that hold the arm, upright, at positions [rad]: for each joint the moment about its axis of the
/// weight of all bodies after it.
fn gravity(q: &Joints) -> Joints {
    let mut torques = [0.0; DOF];
    let mut frame = Isometry3::identity();
    // Place and direction of the axes so far [m].
    let mut axes = [(Vector3::zeros(), Vector3::zeros()); DOF];
    for (j, (mass, center)) in BODIES.iter().enumerate() {
        let Some(link) = q.get(j).and_then(|q| Links.link(j, *q)) else { break };
        frame *= link;
        if let Some(axis) = axes.get_mut(j) {
            *axis = (frame.translation.vector, frame.rotation * Links.axis(j));
        }
        let at = frame * Point3::from(*center);
        let weight = Vector3::new(0.0, 0.0, -G * mass);
        for (torque, (place, axis)) in torques.iter_mut().zip(&axes).take(j + 1) {
            *torque -= axis.dot(&(at.coords - place).cross(&weight));
        }
    }
    joints_of(&torques)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::FRAC_PI_2;

    #[test]
    fn the_weight_is_that_of_the_sheet() {
        // The upper arm points up, the forearm forward: the elbow carries what is in front of it.
        let elbow = 2.0 * 0.125 + 0.5 * 0.265 + 0.7 * 0.3 + 0.4 * 0.37;
        let torques = gravity(&joints_of(&[0.3, 0.0, 0.0, 0.0, 0.0, 0.0]));
        assert!((torques[2] + G * elbow).abs() < 1e-9 && (torques[1] + G * elbow).abs() < 1e-9, "{torques:?}");
        assert!(torques[0].abs() < 1e-12 && torques[3].abs() < 1e-12, "{torques:?}");
        let hanging = gravity(&joints_of(&[0.0, 0.0, FRAC_PI_2, 0.0, 0.0, 0.0]));
        assert!(hanging[2].abs() < 1e-9, "the forearm hangs: {hanging:?}");
    }
}

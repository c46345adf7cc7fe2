//! Test of a kinematic chain, for the arms' tests.

use super::*;
use crate::pose::{from_xyz_rpy, to_xyz_rpy};

/// Checks that the inverse from `start` leads back to the pose of `there`, and fails for a pose out of reach.
pub fn leads_back<const N: usize>(chain: &impl Chain, start: [f64; N], there: [f64; N]) {
    let (xyz, rpy) = to_xyz_rpy(&chain.forward(&there));
    let goal = from_xyz_rpy(xyz, rpy);
    let found = chain.inverse(&goal, &start).unwrap();
    assert!((chain.forward(&found).translation.vector - goal.translation.vector).norm() < 1e-5);
    assert_eq!(chain.inverse(&from_xyz_rpy([5.0, 0.0, 0.0], [0.0; 3]), &start), None);
}

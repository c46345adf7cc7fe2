//! Test of a kinematic chain, for the arms' tests.

use super::*;

/// Checks that the inverse from `start` leads back to the pose of `there`, and fails for a pose out of reach.
pub fn leads_back<const N: usize>(chain: &impl Chain, start: [f64; N], there: [f64; N]) {
    let goal = from_values(to_values(&chain.forward(&there)));
    let found = chain.inverse(&goal, &start).unwrap();
    assert!((chain.forward(&found).translation.vector - goal.translation.vector).norm() < 1e-5);
    assert_eq!(chain.inverse(&from_values([5.0, 0.0, 0.0, 0.0, 0.0, 0.0]), &start), None);
}

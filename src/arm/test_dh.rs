//! What tests compare an arm's dimensions with.

use nalgebra::Matrix4;

use super::Dh;

/// The product of the matrices of all joints, as textbooks have it: shares nothing with the program.
pub fn product(dh: &[Dh], q: &[f64]) -> Matrix4<f64> {
    dh.iter().zip(q).fold(Matrix4::identity(), |before, (dh, q)| {
        let ((st, ct), (sa, ca)) = ((dh.theta + q).sin_cos(), dh.alpha.sin_cos());
        let rows = [
            [ct, -st * ca, st * sa, dh.a * ct],
            [st, ct * ca, -ct * sa, dh.a * st],
            [0.0, sa, ca, dh.d],
            [0.0, 0.0, 0.0, 1.0],
        ];
        before * Matrix4::from_fn(|i, j| rows[i][j])
    })
}

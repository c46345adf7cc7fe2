//! What tests of all crates compare an arm's dimensions with.

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

/// A UR5e whose axes are off by less than a milliradian and a millimetre, as a fit has them: the frames of joints 2 and
/// 3 are hundreds of metres away.
pub const FAR_AWAY: [Dh; 6] = [
    Dh { theta: -0.00020000000600000018, a: 0.00039999999199999956, d: 0.162699999976, alpha: 1.5710963267928966 },
    Dh { theta: 2.098870680437141, a: 0.21500894765079231, d: 264.8859262294122, alpha: 0.0013892443931384714 },
    Dh { theta: -2.9949260586669872, a: -0.2431937656730391, d: -424.1382037796513, alpha: 0.0019209372399950906 },
    Dh { theta: 0.8964556382492318, a: -0.0008329271700449597, d: 159.38550985984153, alpha: 1.5701965268618963 },
    Dh { theta: -0.0005003199966525113, a: 0.0002601199765320025, d: 0.09889298061388459, alpha: -1.5709963267895632 },
    Dh { theta: -0.0004000000053332294, a: 0.0, d: 0.09941994002213486, alpha: 0.0 },
];

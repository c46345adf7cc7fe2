//! Two boxes: separating axis test (Gottschalk, Lin and Manocha, "OBBTree", 1996), with the width of the gap.

use glamx::{DAffine3, DVec3};

use super::point::local;

/// Returns the widest gap between two boxes over the fifteen candidate axes [m]: a lower bound of their distance, not
/// positive exactly if they overlap.
pub fn gap(a: &DAffine3, half_a: DVec3, b: &DAffine3, half_b: DVec3) -> f64 {
    let t = local(b.translation, a).to_array();
    let (ha, hb) = (half_a.to_array(), half_b.to_array());
    let axes_a = [a.matrix3.x_axis, a.matrix3.y_axis, a.matrix3.z_axis];
    let axes_b = [b.matrix3.x_axis, b.matrix3.y_axis, b.matrix3.z_axis];
    // r[i][j]: axis j of `b` in the frame of `a`.
    let r: [[f64; 3]; 3] = std::array::from_fn(|i| std::array::from_fn(|j| axes_a[i].dot(axes_b[j])));
    let mut widest = f64::NEG_INFINITY;
    for i in 0..3 {
        let reach = ha[i] + hb[0] * r[i][0].abs() + hb[1] * r[i][1].abs() + hb[2] * r[i][2].abs();
        widest = widest.max(t[i].abs() - reach);
        let along = t[0] * r[0][i] + t[1] * r[1][i] + t[2] * r[2][i];
        let reach = hb[i] + ha[0] * r[0][i].abs() + ha[1] * r[1][i].abs() + ha[2] * r[2][i].abs();
        widest = widest.max(along.abs() - reach);
    }
    for i in 0..3 {
        let (i1, i2) = ((i + 1) % 3, (i + 2) % 3);
        for j in 0..3 {
            let (j1, j2) = ((j + 1) % 3, (j + 2) % 3);
            let length = (1.0 - r[i][j] * r[i][j]).max(0.0).sqrt();
            // Parallel edges span no axis; the face axes suffice.
            if length < 1e-6 {
                continue;
            }
            let along = t[i2] * r[i1][j] - t[i1] * r[i2][j];
            let reach =
                ha[i1] * r[i2][j].abs() + ha[i2] * r[i1][j].abs() + hb[j1] * r[i][j2].abs() + hb[j2] * r[i][j1].abs();
            widest = widest.max((along.abs() - reach) / length);
        }
    }
    widest
}

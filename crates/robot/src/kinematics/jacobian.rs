//! Geometric Jacobian, and measures of singularity.

use glamx::{DAffine3, DVec3};

use super::{Kinematics, Motion};

/// Velocity of a link at unit speed of one joint: linear velocity of its origin, then angular velocity, both in the
/// root's frame.
pub type Column = [f64; 6];

impl Kinematics {
    /// Computes one column per joint: the velocity of `link`'s origin and the link's angular velocity at unit speed of
    /// that joint, in the root's frame. `frames` come from [`Kinematics::forward`].
    pub fn jacobian(&self, link: usize, frames: &[DAffine3], columns: &mut [Column]) {
        let origin = self.link_frame(link, frames).translation;
        self.jacobian_at(self.body_of(link), origin, frames, columns);
    }

    /// Same for any point fixed to a body, given in the root's frame [m].
    pub fn jacobian_at(&self, body: usize, point: DVec3, frames: &[DAffine3], columns: &mut [Column]) {
        columns.fill([0.0; 6]);
        for b in self.ancestors(body) {
            let (Some(own), Some(frame)) = (self.bodies.get(b), frames.get(b)) else { return };
            let Some(column) = columns.get_mut(own.variable) else { return };
            let axis = frame.matrix3.z_axis * own.multiplier;
            let (linear, angular) = match own.motion {
                Motion::Turn => (axis.cross(point - frame.translation), axis),
                Motion::Slide => (axis, DVec3::ZERO),
            };
            // Contributions of mimic joints of the same joint add up.
            for (sum, part) in column.iter_mut().zip(linear.to_array().into_iter().chain(angular.to_array())) {
                *sum += part;
            }
        }
    }
}

/// A symmetric 6 × 6 matrix; only the lower triangle is used.
pub type Gram = [[f64; 6]; 6];

/// Returns `J·Jᵀ` of a Jacobian given by columns, plus `damping` on the diagonal.
pub fn gram(columns: &[Column], damping: f64) -> Gram {
    let mut gram = [[0.0; 6]; 6];
    for column in columns {
        for (row, a) in gram.iter_mut().zip(column) {
            for (sum, b) in row.iter_mut().zip(column) {
                *sum += a * b;
            }
        }
    }
    for (i, row) in gram.iter_mut().enumerate() {
        row[i] += damping;
    }
    gram
}

/// Returns the lower triangle `L` of `L·Lᵀ = gram`; `None` if the matrix is not positive definite.
pub fn cholesky(gram: &Gram) -> Option<Gram> {
    let mut l = [[0.0; 6]; 6];
    for i in 0..6 {
        for k in 0..=i {
            let dot: f64 = l[i].iter().zip(&l[k]).take(k).map(|(a, b)| a * b).sum();
            let sum = gram[i][k] - dot;
            if i == k {
                if sum <= 0.0 || !sum.is_finite() {
                    return None;
                }
                l[i][i] = sum.sqrt();
            } else {
                l[i][k] = sum / l[k][k];
            }
        }
    }
    Some(l)
}

/// Returns the `x` of `L·Lᵀ·x = b`.
pub fn solve(l: &Gram, b: &Column) -> Column {
    let mut x = *b;
    for i in 0..6 {
        for j in 0..i {
            x[i] -= l[i][j] * x[j];
        }
        x[i] /= l[i][i];
    }
    for i in (0..6).rev() {
        for j in i + 1..6 {
            x[i] -= l[j][i] * x[j];
        }
        x[i] /= l[i][i];
    }
    x
}

/// Returns Yoshikawa's manipulability `sqrt(det(J·Jᵀ))`; 0 for fewer than six joints.
pub fn manipulability(columns: &[Column]) -> f64 {
    cholesky(&gram(columns, 0.0)).map_or(0.0, |l| (0..6).map(|i| l[i][i]).product())
}

/// Returns the smallest singular value of a Jacobian given by columns, with angular rows weighted by `length` [m] so
/// that metres and radians are comparable. Uses the smaller side, so that five joints are not always singular.
pub fn smallest_singular_value(columns: &[Column], length: f64) -> f64 {
    let mut weighted = nalgebra::SMatrix::<f64, 6, 6>::zeros();
    for column in columns {
        let c = [column[0], column[1], column[2], column[3] * length, column[4] * length, column[5] * length];
        for i in 0..6 {
            for k in 0..6 {
                weighted[(i, k)] += c[i] * c[k];
            }
        }
    }
    let mut values = [0.0; 6];
    for (to, from) in values.iter_mut().zip(weighted.symmetric_eigenvalues().iter()) {
        *to = *from;
    }
    values.sort_by(|a, b| b.total_cmp(a));
    let rank = columns.len().clamp(1, 6);
    values[rank - 1].max(0.0).sqrt()
}

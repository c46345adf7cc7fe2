//! The fastest clock of a path: the rate `r(x)` at which a given motion `q(x)` runs so that it takes the least time and
//! every joint keeps its velocity, acceleration and jerk limits.
//!
//! With `b = r²`, `q̇ = q'·√b`, `q̈ = q''·b + q'·b'/2` and `q⃛ = √b·(q'''·b + 3/2·q''·b' + q'·b''/2)`: the first two
//! are linear in `b` (Verscheure et al., "Time-optimal path tracking for robots: a convex optimization approach",
//! 2009), the third is not convex, but nearly so. `b` is a quadratic B-spline: its second derivative is constant in a
//! cell. The duration `∫1/√b dx` is minimized with logarithmic barriers by Newton's method (Boyd and Vandenberghe,
//! "Convex Optimization", 2004, chapter 11); a limit at one place concerns three neighbouring coefficients, so a step
//! is the solution of a system with five diagonals.
//!
//! At a rest `q' = q'' = 0`: where the given motion rests, its clock does not, and nothing is singular.

use crate::states::{Eight, JOINTS};

/// Places of a cell at which the limits hold: both ends and the middle.
const PLACES: usize = 3;

/// What a unit of `b` and of its derivatives uses of the limits of eight joints, at one place of the path.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Use {
    /// Part of the acceleration limit per `b`, `b'`.
    pub acceleration: [Eight; 2],
    /// Part of the jerk limit per `b`, `b'`, `b''`, all times `√b`.
    pub jerk: [Eight; 3],
}

/// A path, its limits, and how its clock is searched.
#[derive(Debug, Clone)]
pub struct PathClock<'a> {
    /// What the limits allow, at the ends and middles of all cells in order: two per cell and one at the end; of each
    /// place as many blocks as the joints need.
    pub uses: &'a [Use],
    /// Highest `b` at the same places.
    pub most: &'a [f64],
    /// Length of a cell in the given motion's time [s].
    pub step: f64,
    /// Settings.
    pub settings: Barrier,
}

/// Settings of the interior-point method.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Barrier {
    /// Weight of the barriers at the beginning and at the end, in durations per cell: the result is slower than the
    /// optimum by about three times the last.
    pub weights: [f64; 2],
    /// Factor from one weight to the next.
    pub reduction: f64,
    /// Steps of Newton's method per weight, at most.
    pub steps: usize,
    /// Squared decrement, in weights, below which the next weight follows.
    pub decrement: f64,
}

impl Default for Barrier {
    fn default() -> Self {
        Self { weights: [0.1, 1e-3], reduction: 0.2, steps: 12, decrement: 0.3 }
    }
}

/// The quadratic B-splines of a cell at one of its places: values, first and second derivatives.
type Basis = [[f64; 3]; 3];

/// Derivatives of the objective: gradient, and the diagonals of the Hessian from the main one on.
#[derive(Debug, Clone, Default)]
struct Slopes {
    gradient: Vec<f64>,
    diagonals: [Vec<f64>; 3],
}

impl PathClock<'_> {
    /// Returns the number of cells.
    pub fn cells(&self) -> usize {
        self.most.len().saturating_sub(1) / 2
    }

    /// Returns the coefficients of `b`, two more than cells, beginning from some that keep all limits; `None` if those
    /// do not.
    ///
    /// # Panics
    /// If the numbers of coefficients, places and uses do not belong together.
    pub fn fastest(&self, mut b: Vec<f64>) -> Option<Vec<f64>> {
        let cells = self.cells();
        assert_eq!(b.len(), cells + 2, "coefficients of all cells");
        assert_eq!(self.uses.len() % self.most.len(), 0, "as many blocks at each place");
        let bases = self.bases();
        let mut slopes = Slopes::default();
        let [first, last] = self.settings.weights;
        let (mut part, mut trial) = (first, b.clone());
        loop {
            let weight = part * self.duration(&b) / cells as f64;
            let mut value = self.objective(&bases, &b, weight)?;
            for _ in 0..self.settings.steps {
                self.slopes(&bases, &b, weight, &mut slopes);
                let Some(step) = newton(&mut slopes) else { break };
                let descent: f64 = step.iter().zip(&slopes.gradient).map(|(s, g)| s * g).sum();
                if -descent <= self.settings.decrement * weight {
                    break;
                }
                let mut length = 1.0;
                let found = (0..40).find_map(|_| {
                    trial.iter_mut().zip(&b).zip(&step).for_each(|((t, b), s)| *t = b + length * s);
                    let reached =
                        self.objective(&bases, &trial, weight).filter(|v| *v <= value + 0.1 * length * descent);
                    length *= 0.5;
                    reached
                });
                let Some(reached) = found else { break };
                std::mem::swap(&mut b, &mut trial);
                value = reached;
            }
            if part <= last {
                return Some(b);
            }
            part = (part * self.settings.reduction).max(last);
        }
    }

    /// Returns the duration with these coefficients [s], by Simpson's rule.
    pub fn duration(&self, b: &[f64]) -> f64 {
        let bases = self.bases();
        let cell = |cell: &[f64]| {
            let at = |k: usize| 1.0 / dot(&bases[k][0], cell).sqrt();
            (at(0) + 4.0 * at(1) + at(2)) * self.step / 6.0
        };
        b.windows(3).map(cell).sum()
    }

    /// Returns `b` and its first two derivatives at part `u` (0–1) of a cell.
    ///
    /// # Panics
    /// If there is no such cell.
    pub fn at(&self, b: &[f64], cell: usize, u: f64) -> [f64; 3] {
        basis(u, self.step).map(|of| dot(&of, &b[cell..cell + 3]))
    }

    fn bases(&self) -> [Basis; PLACES] {
        [0.0, 0.5, 1.0].map(|u| basis(u, self.step))
    }

    fn uses_at(&self, place: usize) -> &[Use] {
        let blocks = self.uses.len() / self.most.len();
        &self.uses[place * blocks..(place + 1) * blocks]
    }

    /// Returns the duration and the weighted barriers; `None` if a limit is exceeded.
    fn objective(&self, bases: &[Basis; PLACES], b: &[f64], weight: f64) -> Option<f64> {
        let (mut duration, mut barriers) = (0.0, 0.0);
        for (i, cell) in b.windows(3).enumerate() {
            for (k, (basis, share)) in bases.iter().zip([1.0, 4.0, 1.0]).enumerate() {
                let place = 2 * i + k;
                let [b0, b1, b2] = basis.map(|of| dot(&of, cell));
                let room = 1.0 - b0 / self.most[place];
                if b0.is_nan() || b0 <= 0.0 || room.is_nan() || room <= 0.0 {
                    return None;
                }
                let root = b0.sqrt();
                duration += share / root;
                let mut product = [1.0; JOINTS];
                let mut largest = [0.0_f64; JOINTS];
                for used in self.uses_at(place) {
                    let ([a0, a1], [j0, j1, j2]) = (&used.acceleration, &used.jerk);
                    for n in 0..JOINTS {
                        let a = a0[n] * b0 + a1[n] * b1;
                        let j = root * (j0[n] * b0 + j1[n] * b1 + j2[n] * b2);
                        let (a, j) = (a * a, j * j);
                        product[n] *= (1.0 - a) * (1.0 - j);
                        let more = if a > j { a } else { j };
                        largest[n] = if more > largest[n] { more } else { largest[n] };
                    }
                }
                if largest.iter().any(|part| *part >= 1.0) {
                    return None;
                }
                let four: [f64; 4] = std::array::from_fn(|n| product[n] * product[n + 4]);
                barriers -= (room * four[0] * four[1]).ln() + (four[2] * four[3]).ln();
            }
        }
        let value = duration * self.step / 6.0 + weight * barriers;
        value.is_finite().then_some(value)
    }

    /// Computes gradient and Hessian of the objective. The jerk's own curvature is left out: so the Hessian is positive
    /// definite.
    fn slopes(&self, bases: &[Basis; PLACES], b: &[f64], weight: f64, out: &mut Slopes) {
        out.gradient.clear();
        out.gradient.resize(b.len(), 0.0);
        for diagonal in &mut out.diagonals {
            diagonal.clear();
            diagonal.resize(b.len(), 0.0);
        }
        for (i, cell) in b.windows(3).enumerate() {
            for (k, (basis, share)) in bases.iter().zip([1.0, 4.0, 1.0]).enumerate() {
                let place = 2 * i + k;
                let values = basis.map(|of| dot(&of, cell));
                let (mut gradient, mut curvature) = barrier(self.uses_at(place), values);
                let [b0, ..] = values;
                let room = 1.0 / (self.most[place] - b0);
                let time = share * self.step / 6.0 / (b0 * b0.sqrt());
                gradient.iter_mut().for_each(|g| *g *= weight);
                curvature.iter_mut().for_each(|c| *c *= weight);
                gradient[0] += weight * room - 0.5 * time;
                curvature[0] += weight * room * room + 0.75 * time / b0;
                let [c00, c01, c02, c11, c12, c22] = curvature;
                let rows = [[c00, c01, c02], [c01, c11, c12], [c02, c12, c22]];
                for m in 0..3 {
                    out.gradient[i + m] += (0..3).map(|d| basis[d][m] * gradient[d]).sum::<f64>();
                    let row: [f64; 3] = std::array::from_fn(|d| (0..3).map(|e| basis[e][m] * rows[e][d]).sum());
                    for n in m..3 {
                        out.diagonals[n - m][i + m] += (0..3).map(|d| row[d] * basis[d][n]).sum::<f64>();
                    }
                }
            }
        }
    }
}

/// Returns gradient and curvature of the barriers of joints with respect to `b` and its derivatives.
fn barrier(uses: &[Use], [b0, b1, b2]: [f64; 3]) -> ([f64; 3], [f64; 6]) {
    let (root, mut gradients, mut curvatures) = (b0.sqrt(), [[0.0; JOINTS]; 3], [[0.0; JOINTS]; 6]);
    let inverse = 0.5 / root;
    for used in uses {
        let ([a0, a1], [j0, j1, j2]) = (&used.acceleration, &used.jerk);
        for n in 0..JOINTS {
            let a = a0[n] * b0 + a1[n] * b1;
            let room = 1.0 / (1.0 - a * a);
            let (slope, bend) = (2.0 * a * room, 2.0 * (1.0 + a * a) * room * room);
            gradients[0][n] += slope * a0[n];
            gradients[1][n] += slope * a1[n];
            curvatures[0][n] += bend * a0[n] * a0[n];
            curvatures[1][n] += bend * a0[n] * a1[n];
            curvatures[3][n] += bend * a1[n] * a1[n];
            let sum = j0[n] * b0 + j1[n] * b1 + j2[n] * b2;
            let j = root * sum;
            let room = 1.0 / (1.0 - j * j);
            let (slope, bend) = (2.0 * j * room, 2.0 * (1.0 + j * j) * room * room);
            let by = [inverse * sum + root * j0[n], root * j1[n], root * j2[n]];
            let mut c = 0;
            for d in 0..3 {
                gradients[d][n] += slope * by[d];
                for e in d..3 {
                    curvatures[c][n] += bend * by[d] * by[e];
                    c += 1;
                }
            }
        }
    }
    (gradients.map(|of| of.iter().sum()), curvatures.map(|of| of.iter().sum()))
}

/// Returns the Newton step, by the factorization L·D·Lᵀ of a matrix with five diagonals; `None` if it is not positive
/// definite. Overwrites the diagonals.
fn newton(slopes: &mut Slopes) -> Option<Vec<f64>> {
    let [main, first, second] = &mut slopes.diagonals;
    let n = main.len();
    let mut x: Vec<f64> = slopes.gradient.iter().map(|g| -g).collect();
    for i in 0..n {
        let pivot = main[i];
        if pivot.is_nan() || pivot <= 0.0 {
            return None;
        }
        let inverse = 1.0 / pivot;
        let (one, two) = (first[i] * inverse, second[i] * inverse);
        if i + 1 < n {
            main[i + 1] -= one * first[i];
            x[i + 1] -= one * x[i];
        }
        if i + 2 < n {
            first[i + 1] -= one * second[i];
            main[i + 2] -= two * second[i];
            x[i + 2] -= two * x[i];
        }
        x[i] *= inverse;
        (first[i], second[i]) = (one, two);
    }
    for i in (0..n).rev() {
        let after = |k: usize| x.get(i + k).copied().unwrap_or(0.0);
        x[i] -= first[i] * after(1) + second[i] * after(2);
    }
    Some(x)
}

fn basis(u: f64, step: f64) -> Basis {
    let (one, two) = (1.0 / step, 1.0 / (step * step));
    [
        [0.5 * (1.0 - u) * (1.0 - u), 0.5 + u - u * u, 0.5 * u * u],
        [(u - 1.0) * one, (1.0 - 2.0 * u) * one, u * one],
        [two, -2.0 * two, two],
    ]
}

fn dot(of: &[f64; 3], cell: &[f64]) -> f64 {
    of[0] * cell[0] + of[1] * cell[1] + of[2] * cell[2]
}

//! Sampling of configurations: a low-discrepancy sequence, shifted by a seed.

use crate::robot::model::Limits;
use crate::robot::random::Random;

const PRIMES: [u64; 40] = [
    3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61, 67, 71, 73, 79, 83, 89, 97, 101, 103, 107, 109,
    113, 127, 131, 137, 139, 149, 151, 157, 163, 167, 173, 179,
];

/// Halton sequence (one prime per joint) with a random shift (Cranley and Patterson, 1976): evenly spread and different
/// for every seed. Joints beyond the table of primes get pseudo-random values.
#[derive(Debug, Clone)]
pub struct Sampler {
    low: Vec<f64>,
    width: Vec<f64>,
    shift: Vec<f64>,
    index: u64,
    random: Random,
}

impl Sampler {
    /// Creates a sampler between limits; joints without limits are sampled within one turn around `middle`.
    pub fn new(limits: &[Limits], middle: &[f64], seed: u64) -> Self {
        let mut random = Random::new(seed);
        let turn = std::f64::consts::PI;
        let around = |j: usize| middle.get(j).copied().unwrap_or(0.0);
        let low: Vec<f64> = limits
            .iter()
            .enumerate()
            .map(|(j, l)| if l.lower.is_finite() { l.lower } else { around(j) - turn })
            .collect();
        let high = |(j, l): (usize, &Limits)| if l.upper.is_finite() { l.upper } else { around(j) + turn };
        let width = limits.iter().enumerate().map(high).zip(&low).map(|(h, l)| (h - l).max(0.0)).collect();
        // Seed 0 is the unshifted sequence.
        let shift = limits.iter().map(|_| if seed == 0 { 0.0 } else { random.unit() }).collect();
        Self { low, width, shift, index: 0, random }
    }

    /// Writes the next sample.
    pub fn next(&mut self, q: &mut [f64]) {
        self.index += 1;
        for (j, x) in q.iter_mut().enumerate() {
            let part = match PRIMES.get(j) {
                Some(&base) => (radical_inverse(base, self.index) + self.shift.get(j).unwrap_or(&0.0)).fract(),
                None => self.random.unit(),
            };
            *x = self.low.get(j).unwrap_or(&0.0) + part * self.width.get(j).unwrap_or(&0.0);
        }
    }
}

/// Returns the digits of `index` mirrored at the radix point.
fn radical_inverse(base: u64, mut index: u64) -> f64 {
    let (mut value, mut scale) = (0.0, 1.0 / base as f64);
    while index > 0 {
        value += (index % base) as f64 * scale;
        index /= base;
        scale /= base as f64;
    }
    value
}

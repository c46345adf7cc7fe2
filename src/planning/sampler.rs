//! Sampling of configurations: a low-discrepancy sequence, shifted by a seed.

use std::sync::LazyLock;

use dimos_kernels::block::LANES;

use super::nearest::Row;
use crate::robot::model::Limits;
use crate::robot::random::Random;

const PRIMES: [u64; 40] = [
    3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61, 67, 71, 73, 79, 83, 89, 97, 101, 103, 107, 109,
    113, 127, 131, 137, 139, 149, 151, 157, 163, 167, 173, 179,
];

/// Values in the table of radii.
const RADII: usize = 256;
/// Most numbers in a table of low digits.
const TABLE: u64 = 256;

/// For each prime, the values of the low digits of all numbers up to a power of it.
static LOW_DIGITS: LazyLock<Vec<Vec<f64>>> = LazyLock::new(|| {
    let table = |base: &u64| {
        let power = std::iter::successors(Some(*base), |p| Some(p * base)).take_while(|p| *p <= TABLE).last();
        (0..power.unwrap_or(*base)).map(|index| radical_inverse(*base, index)).collect()
    };
    PRIMES.iter().map(table).collect()
});

/// Halton sequence (one prime per joint) with a random shift (Cranley and Patterson, 1976): evenly spread and different
/// for every seed. Joints beyond the table of primes get pseudo-random values.
#[derive(Debug, Clone)]
pub struct Sampler {
    axes: Vec<Axis>,
    index: u64,
    random: Random,
    /// Values of u^(1/n); empty until they are needed.
    radii: Vec<f64>,
}

/// One joint.
#[derive(Debug, Clone)]
struct Axis {
    low: f64,
    width: f64,
    shift: f64,
    /// Place in the table of low digits.
    place: usize,
    /// Value of the other digits.
    high: f64,
}

impl Sampler {
    /// Creates a sampler between limits; joints without limits are sampled within one turn around `middle`.
    pub fn new(limits: &[Limits], middle: &[f64], seed: u64) -> Self {
        let mut random = Random::new(seed);
        let turn = std::f64::consts::PI;
        let axis = |(j, l): (usize, &Limits)| {
            let around = middle.get(j).copied().unwrap_or(0.0);
            let low = if l.lower.is_finite() { l.lower } else { around - turn };
            let high = if l.upper.is_finite() { l.upper } else { around + turn };
            // Seed 0 is the unshifted sequence.
            let shift = if seed == 0 { 0.0 } else { random.unit() };
            Axis { low, width: (high - low).max(0.0), shift, place: 0, high: 0.0 }
        };
        let axes = limits.iter().enumerate().map(axis).collect();
        Self { axes, index: 0, random, radii: Vec::new() }
    }

    /// Writes the next samples.
    pub fn fill(&mut self, samples: &mut [Row]) {
        for (j, (row, axis)) in samples.iter_mut().zip(&mut self.axes).enumerate() {
            let Some(table) = LOW_DIGITS.get(j) else {
                row.iter_mut().for_each(|x| *x = axis.low + self.random.unit() * axis.width);
                continue;
            };
            let mut done = 0;
            while done < LANES {
                axis.place += 1;
                if axis.place >= table.len() {
                    axis.place = 0;
                    let power = table.len() as u64;
                    axis.high = radical_inverse(PRIMES[j], (self.index + done as u64 + 1) / power) / power as f64;
                }
                // Neighbours in the table are of neighbouring samples.
                let run = (table.len() - axis.place).min(LANES - done);
                for (x, low) in row[done..done + run].iter_mut().zip(&table[axis.place..axis.place + run]) {
                    let part = low + axis.high + axis.shift;
                    *x = axis.low + (if part < 1.0 { part } else { part - 1.0 }) * axis.width;
                }
                done += run;
                axis.place += run - 1;
            }
        }
        self.index += LANES as u64;
    }

    /// Writes a sample that is evenly distributed in a ball about a configuration, moved to the limits where it is
    /// outside of them.
    pub fn fill_from_ball(
        &mut self,
        (center, radius): (&[f64], f64),
        limits: &[Limits],
        lane: usize,
        samples: &mut [Row],
    ) {
        let mut squared = 0.0;
        for row in samples.iter_mut() {
            // Close to a normal distribution, which has no preferred direction: a sum of four numbers of 16 bits.
            let bits = self.random.bits();
            let sum: u64 = [0, 16, 32, 48].iter().map(|shift| (bits >> shift) & 0xffff).sum();
            let x = sum as f64 - 2.0 * f64::from(u16::MAX);
            row[lane] = x;
            squared += x * x;
        }
        let scale = radius * self.part_of_radius(samples.len()) / squared.sqrt().max(1e-9);
        for ((row, c), l) in samples.iter_mut().zip(center).zip(limits) {
            row[lane] = (c + row[lane] * scale).max(l.lower).min(l.upper);
        }
    }

    /// Returns the distance from the middle of a sample in a ball of radius 1: u^(1/n) for an even u, from a table.
    fn part_of_radius(&mut self, joints: usize) -> f64 {
        if self.radii.is_empty() {
            let part = |k: usize| (k as f64 / RADII as f64).powf(1.0 / joints.max(1) as f64);
            self.radii = (0..=RADII).map(part).collect();
        }
        let at = self.random.unit() * RADII as f64;
        let below = (at as usize).min(RADII - 1);
        self.radii[below] + (at - below as f64) * (self.radii[below + 1] - self.radii[below])
    }

    /// Returns a random index below `n`.
    pub fn below(&mut self, n: usize) -> usize {
        self.random.below(n)
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_sequence_is_the_halton_sequence() {
        let limits = [Limits { lower: 0.0, upper: 1.0, ..Limits::NONE }; 9];
        let mut sampler = Sampler::new(&limits, &[], 0);
        let mut rows = [[0.0; LANES]; 9];
        for batch in 0..2500 {
            sampler.fill(&mut rows);
            for (row, base) in rows.iter().zip(PRIMES) {
                for (lane, x) in row.iter().enumerate() {
                    let index = (batch * LANES + lane + 1) as u64;
                    assert!((x - radical_inverse(base, index)).abs() < 1e-12, "{index} in base {base}");
                }
            }
        }
    }

    #[test]
    fn samples_in_a_ball_fill_it_evenly_and_keep_the_limits() {
        let limits = [Limits { lower: -1.5, upper: 3.0, ..Limits::NONE }; 3];
        let mut sampler = Sampler::new(&limits, &[], 1);
        let (mut rows, mut inner, mut at_limit) = ([[0.0; LANES]; 3], 0, 0);
        for number in 0..8000 {
            sampler.fill_from_ball((&[0.0, 0.0, 1.0], 2.0), &limits, number % LANES, &mut rows);
            let q = rows.map(|row| row[number % LANES]);
            let away = (q[0] * q[0] + q[1] * q[1] + (q[2] - 1.0) * (q[2] - 1.0)).sqrt();
            assert!(away <= 2.0 + 1e-12 && q.iter().all(|x| *x >= -1.5 && *x <= 3.0));
            inner += usize::from(away < 1.0);
            at_limit += usize::from(q[0] == -1.5);
        }
        // Half the radius holds an eighth of the volume.
        assert!((800..1200).contains(&inner) && at_limit > 50, "{inner} {at_limit}");
    }
}

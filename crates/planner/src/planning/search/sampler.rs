//! Sampling of configurations: a low-discrepancy sequence, shifted by a seed.

use std::sync::OnceLock;

use dimos_kernels::Width;
use dimos_kernels::block::Lanes;
use dimos_kernels::halton::{Halton, VARIABLES};

use dimos_robot::model::Limits;
use dimos_robot::random::Random;

/// Steps of the table of radii.
const RADII: usize = 256;

/// Returns u^(1/n) for u from 0 to 1 in even steps, where n is the number of joints. A table takes longer to make than
/// most searches: it is made once.
fn radii(joints: usize) -> &'static [f64] {
    static TABLES: [OnceLock<Vec<f64>>; VARIABLES + 1] = [const { OnceLock::new() }; VARIABLES + 1];
    // With more joints than that, all samples are about as far away.
    let joints = joints.clamp(1, VARIABLES);
    let part = |k: usize| (k as f64 / RADII as f64).powf(1.0 / joints as f64);
    TABLES[joints].get_or_init(|| (0..=RADII).map(part).collect())
}

/// The Halton sequence with a random shift: evenly spread and different for every seed. Joints that it is too short for
/// get pseudo-random values.
#[derive(Debug, Clone)]
pub struct Sampler {
    halton: Halton,
    /// Least value and range of the other joints.
    others: Vec<(f32, f32)>,
    random: Random,
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
            let shift = if seed == 0 { 0.0 } else { random.unit() as f32 };
            [low as f32, (high - low).max(0.0) as f32, shift]
        };
        let axes: Vec<[f32; 3]> = limits.iter().enumerate().map(axis).collect();
        let others = axes.iter().skip(VARIABLES).map(|[low, width, _]| (*low, *width)).collect();
        Self { halton: Halton::new(axes.into_iter(), Width::widest()), others, random }
    }

    /// Writes the next samples, a block for each joint, in single precision: rounding may move one a little out of the
    /// limits.
    pub fn fill(&mut self, samples: &mut [Lanes]) {
        self.halton.next(samples);
        for (block, (low, width)) in samples.iter_mut().skip(VARIABLES).zip(&self.others) {
            block.0.iter_mut().for_each(|x| *x = low + self.random.unit() as f32 * width);
        }
    }

    /// Writes a sample that is evenly distributed in a ball about a configuration, moved to the limits where it is
    /// outside of them.
    pub fn fill_from_ball(
        &mut self,
        (center, radius): (&[f64], f64),
        limits: &[Limits],
        lane: usize,
        samples: &mut [Lanes],
    ) {
        let mut squared = 0.0;
        for row in samples.iter_mut() {
            // Close to a normal distribution, which has no preferred direction: a sum of four numbers of 16 bits.
            let bits = self.random.bits();
            let sum: u64 = [0, 16, 32, 48].iter().map(|shift| (bits >> shift) & 0xffff).sum();
            let x = sum as f64 - 2.0 * f64::from(u16::MAX);
            row.0[lane] = x as f32;
            squared += x * x;
        }
        let scale = radius * self.part_of_radius(samples.len()) / squared.sqrt().max(1e-9);
        for ((row, c), l) in samples.iter_mut().zip(center).zip(limits) {
            row.0[lane] = (c + f64::from(row.0[lane]) * scale).max(l.lower).min(l.upper) as f32;
        }
    }

    /// Returns the distance from the middle of a sample in a ball of radius 1: u^(1/n) for an even u, from a table.
    fn part_of_radius(&mut self, joints: usize) -> f64 {
        let radii = radii(joints);
        let at = self.random.unit() * RADII as f64;
        let below = (at as usize).min(RADII - 1);
        radii[below] + (at - below as f64) * (radii[below + 1] - radii[below])
    }

    /// Returns a random index below `n`.
    pub fn below(&mut self, n: usize) -> usize {
        self.random.below(n)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dimos_kernels::block::LANES;

    #[test]
    fn more_joints_than_the_sequence_has_variables_are_sampled_between_their_limits() {
        let limits: Vec<Limits> =
            (0..43).map(|j| Limits { lower: f64::from(j), upper: f64::from(j + 1), ..Limits::NONE }).collect();
        let mut samples = vec![Lanes::splat(f32::NAN); limits.len()];
        Sampler::new(&limits, &[], 7).fill(&mut samples);
        for (block, l) in samples.iter().zip(&limits) {
            assert!(block.0.iter().all(|x| (l.lower - 1e-5..l.upper + 1e-5).contains(&f64::from(*x))), "{block:?}");
            assert!(block.0.windows(2).any(|pair| pair[0] != pair[1]));
        }
    }

    #[test]
    fn samples_in_a_ball_fill_it_evenly_and_keep_the_limits() {
        let limits = [Limits { lower: -1.5, upper: 3.0, ..Limits::NONE }; 3];
        let mut sampler = Sampler::new(&limits, &[], 1);
        let (mut rows, mut inner, mut at_limit) = ([Lanes::splat(0.0); 3], 0, 0);
        for number in 0..8000 {
            sampler.fill_from_ball((&[0.0, 0.0, 1.0], 2.0), &limits, number % LANES, &mut rows);
            let q = rows.map(|row| f64::from(row.0[number % LANES]));
            let away = (q[0] * q[0] + q[1] * q[1] + (q[2] - 1.0) * (q[2] - 1.0)).sqrt();
            // In single precision.
            assert!(away <= 2.0 + 3.0 * f64::from(f32::EPSILON) && q.iter().all(|x| *x >= -1.5 && *x <= 3.0));
            inner += usize::from(away < 1.0);
            at_limit += usize::from(q[0] == -1.5);
        }
        // Half the radius holds an eighth of the volume.
        assert!((800..1200).contains(&inner) && at_limit > 50, "{inner} {at_limit}");
    }
}

//! The Halton sequence, sixteen points at a time: evenly spread points of a box. A shift makes another sequence of it,
//! as even (Cranley and Patterson, "Randomization of number theoretic methods for multiple integration", 1976).

use std::sync::OnceLock;

use crate::Width;
use crate::block::{Block, LANES, Lanes, Portable};
use crate::width::Vectors;

/// The base of each variable; without 2, in which there are too few digits for a table.
const PRIMES: [u64; VARIABLES] = [
    3, 5, 7, 11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47, 53, 59, 61, 67, 71, 73, 79, 83, 89, 97, 101, 103, 107, 109,
    113, 127, 131, 137, 139, 149, 151, 157, 163, 167, 173, 179,
];
/// Variables of a point, at most.
pub const VARIABLES: usize = 40;
/// Most numbers in a table of low digits.
const TABLE: u64 = 1024;

/// For each prime, the values of the low digits of all numbers up to a power of it; then the first sixteen again.
static LOW_DIGITS: [OnceLock<Vec<f32>>; VARIABLES] = [const { OnceLock::new() }; VARIABLES];

fn low_digits(variable: usize) -> &'static [f32] {
    LOW_DIGITS[variable].get_or_init(|| {
        let base = PRIMES[variable];
        let power = std::iter::successors(Some(base), |p| Some(p * base)).take_while(|p| *p <= TABLE).last();
        let power = power.unwrap_or(base);
        (0..power + LANES as u64).map(|index| radical_inverse(base, index % power) as f32).collect()
    })
}

/// A sequence of points.
#[derive(Debug, Clone)]
pub struct Halton {
    axes: Vec<Axis>,
    width: Width,
}

/// One variable.
#[derive(Debug, Clone)]
struct Axis {
    low: f32,
    width: f32,
    shift: f32,
    base: u64,
    table: &'static [f32],
    /// Place of the next point in the table.
    place: usize,
    /// The next point's digits that are not in the table, and their value.
    rest: u64,
    high: f32,
}

impl Axis {
    fn high(&self, rest: u64) -> f32 {
        let power = (self.table.len() - LANES) as f64;
        (radical_inverse(self.base, rest) / power) as f32
    }
}

impl Halton {
    /// Creates a sequence; of each variable the least value, the range and the shift, a part of the range below 1.
    /// Variables beyond [`VARIABLES`] are left out.
    pub fn new(axes: impl Iterator<Item = [f32; 3]>, width: Width) -> Self {
        let axis = |(j, [low, width, shift]): (usize, [f32; 3])| Axis {
            low,
            width,
            shift,
            base: PRIMES[j],
            table: low_digits(j),
            place: 1,
            rest: 0,
            high: 0.0,
        };
        Self { axes: axes.take(VARIABLES).enumerate().map(axis).collect(), width }
    }

    /// Writes the next sixteen points, a block per variable. Rounding may move one a little out of its range.
    pub fn next(&mut self, points: &mut [Lanes]) {
        match self.width.0 {
            // SAFETY: only `Width` makes one, and only of vectors that this processor has.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { next_avx512(&mut self.axes, points) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { next_avx2(&mut self.axes, points) },
            Vectors::Portable => next::<Portable>(&mut self.axes, points),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn next_avx512(axes: &mut [Axis], points: &mut [Lanes]) {
    next::<crate::block::x86::Avx512>(axes, points);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn next_avx2(axes: &mut [Axis], points: &mut [Lanes]) {
    next::<crate::block::x86::Avx2>(axes, points);
}

#[inline(always)]
fn next<B: Block>(axes: &mut [Axis], points: &mut [Lanes]) {
    for (axis, point) in axes.iter_mut().zip(points) {
        let mut low = Lanes::splat(0.0);
        low.0.copy_from_slice(&axis.table[axis.place..axis.place + LANES]);
        let mut high = B::splat(axis.high);
        // The lanes before the table begins again; every table is longer than a block.
        let before = axis.table.len() - LANES - axis.place;
        axis.place += LANES;
        if before <= LANES {
            axis.place = LANES - before;
            axis.rest += 1;
            axis.high = axis.high(axis.rest);
            let first = u16::MAX.checked_shr((LANES - before) as u32).unwrap_or(0);
            high = B::select(B::mask(first), high, B::splat(axis.high));
        }
        let one = B::splat(1.0);
        let part = B::load(&low).add(high).add(B::splat(axis.shift));
        let part = B::select(B::less(part, one), part, part.sub(one));
        part.mul_add(B::splat(axis.width), B::splat(axis.low)).store(point);
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
    fn the_sequence_is_the_halton_sequence_on_every_width() {
        let axes = || (0..VARIABLES).map(|_| [0.0, 1.0, 0.0]);
        let mut sequences: Vec<Halton> = Width::usable().into_iter().map(|width| Halton::new(axes(), width)).collect();
        let mut points = vec![[Lanes::splat(0.0); VARIABLES]; sequences.len()];
        for batch in 0..2500 {
            for (sequence, points) in sequences.iter_mut().zip(&mut points) {
                sequence.next(points);
            }
            assert!(points.iter().all(|other| other == &points[0]));
            for (row, base) in points[0].iter().zip(PRIMES) {
                for (lane, x) in row.0.iter().enumerate() {
                    let index = (batch * LANES + lane + 1) as u64;
                    let exact = radical_inverse(base, index);
                    // Single precision, rounded three times.
                    let error = (f64::from(*x) - exact).abs();
                    assert!(error < 1.5 * f64::from(f32::EPSILON), "{index} in base {base}: {x}, {exact}");
                }
            }
        }
    }

    #[test]
    fn points_are_shifted_in_their_range() {
        let mut sequences = [0.0, 0.75].map(|shift| Halton::new([[-1.0, 4.0, shift]].into_iter(), Width::widest()));
        let mut points = [[Lanes::splat(0.0); 1]; 2];
        for _ in 0..100 {
            sequences.iter_mut().zip(&mut points).for_each(|(sequence, point)| sequence.next(point));
            for (plain, shifted) in points[0][0].0.iter().zip(points[1][0].0) {
                let expected = if plain + 3.0 < 3.0 { plain + 3.0 } else { plain - 1.0 };
                assert!((shifted - expected).abs() < 1e-5 && (-1.0..=3.0).contains(&shifted), "{plain} {shifted}");
            }
        }
    }
}

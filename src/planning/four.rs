//! Four numbers at a time: what the compiler makes vector instructions of. (It does not where `array::map` or
//! `array::from_fn` is used.)

use std::ops::{Add, Mul, Sub};

/// One number of each of four joints.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Four(pub [f64; 4]);

impl Four {
    /// Number of lanes.
    pub const LEN: usize = 4;

    /// Returns where fours begin that hold all of `len` values; the last two may overlap.
    pub fn starts(len: usize) -> impl Iterator<Item = usize> {
        (0..len).step_by(Self::LEN).map(move |first| first.min(len.saturating_sub(Self::LEN)))
    }

    /// Returns four of `values` from `first` on; 0 where there are fewer than four.
    #[inline(always)]
    pub fn load(values: &[f64], first: usize) -> Self {
        if let Some([a, b, c, d]) = values.get(first..first + Self::LEN) {
            return Self([*a, *b, *c, *d]);
        }
        let at = |k: usize| values.get(first + k).copied().unwrap_or(0.0);
        Self([at(0), at(1), at(2), at(3)])
    }

    #[inline(always)]
    fn pairs(self, other: Self, f: impl Fn(f64, f64) -> f64) -> Self {
        let (Self(a), Self(b)) = (self, other);
        Self([f(a[0], b[0]), f(a[1], b[1]), f(a[2], b[2]), f(a[3], b[3])])
    }

    /// Returns the magnitude of each.
    #[inline(always)]
    pub fn abs(self) -> Self {
        self.pairs(self, |a, _| a.abs())
    }

    /// Returns the larger of each pair.
    #[inline(always)]
    pub fn max(self, other: Self) -> Self {
        self.pairs(other, |a, b| if a > b { a } else { b })
    }

    /// Returns `factor` where the number is below 0, and 0 elsewhere.
    #[inline(always)]
    pub fn where_negative(self, factor: f64) -> Self {
        self.pairs(self, |a, _| if a < 0.0 { factor } else { 0.0 })
    }

    /// Returns the largest.
    pub fn largest(self) -> f64 {
        self.0.iter().copied().fold(f64::NEG_INFINITY, f64::max)
    }
}

impl Add for Four {
    type Output = Self;

    #[inline(always)]
    fn add(self, other: Self) -> Self {
        self.pairs(other, |a, b| a + b)
    }
}

impl Sub for Four {
    type Output = Self;

    #[inline(always)]
    fn sub(self, other: Self) -> Self {
        self.pairs(other, |a, b| a - b)
    }
}

impl Mul for Four {
    type Output = Self;

    #[inline(always)]
    fn mul(self, other: Self) -> Self {
        self.pairs(other, |a, b| a * b)
    }
}

impl Mul<f64> for Four {
    type Output = Self;

    #[inline(always)]
    fn mul(self, factor: f64) -> Self {
        self.pairs(self, |a, _| a * factor)
    }
}

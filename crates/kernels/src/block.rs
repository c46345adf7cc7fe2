//! Sixteen single-precision numbers, one per configuration, in the registers of each kind of processor.

#[cfg(target_arch = "x86_64")]
pub(crate) mod x86;

/// Number of lanes of a block.
pub const LANES: usize = 16;

/// One number per lane in memory; aligned for the widest vectors.
#[derive(Debug, Clone, Copy, PartialEq)]
#[repr(C, align(64))]
pub struct Lanes(pub [f32; LANES]);

impl Lanes {
    /// The same number in every lane.
    pub const fn splat(x: f32) -> Self {
        Self([x; LANES])
    }
}

/// Sixteen numbers and the operations that kernels need. Each operation rounds once, as IEEE 754 says, so all
/// implementations give the same bits.
pub trait Block: Copy {
    /// One bit per lane.
    type Mask: Copy;

    /// The same number in every lane.
    fn splat(x: f32) -> Self;
    /// Reads a block.
    fn load(from: &Lanes) -> Self;
    /// Writes a block.
    fn store(self, to: &mut Lanes);
    /// `self + b`.
    fn add(self, b: Self) -> Self;
    /// `self - b`.
    fn sub(self, b: Self) -> Self;
    /// `self * b`.
    fn mul(self, b: Self) -> Self;
    /// `self / b`.
    fn div(self, b: Self) -> Self;
    /// `self * b + c`, rounded once.
    fn mul_add(self, b: Self, c: Self) -> Self;
    /// `c - self * b`, rounded once.
    fn neg_mul_add(self, b: Self, c: Self) -> Self;
    /// The smaller number of each lane; `b` if one is not a number.
    fn min(self, b: Self) -> Self;
    /// The larger number of each lane; `b` if one is not a number.
    fn max(self, b: Self) -> Self;
    /// The nearest integer, of two the even one.
    fn round(self) -> Self;
    /// The square root.
    fn sqrt(self) -> Self;
    /// The absolute value.
    fn abs(self) -> Self;
    /// Lanes in which `self < b`.
    fn less(self, b: Self) -> Self::Mask;
    /// `a` in the lanes of the mask, `b` in the others.
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self;
    /// The mask as bits, lane 0 lowest.
    fn bits(mask: Self::Mask) -> u16;
    /// The mask with these bits.
    fn mask(bits: u16) -> Self::Mask;
    /// The largest number of each of six blocks, in every lane: the sides of a box. None of them is not a number.
    fn largest(six: [Self; 6]) -> [Self; 6];

    /// `-self`.
    #[inline(always)]
    fn neg(self) -> Self {
        Self::splat(0.0).sub(self)
    }
}

/// Sixteen numbers in an array: for processors without wider vectors, where the compiler uses those of four lanes.
#[derive(Clone, Copy)]
pub struct Portable([f32; LANES]);

impl Portable {
    #[inline(always)]
    fn zip(self, b: Self, f: impl Fn(f32, f32) -> f32) -> Self {
        Self(std::array::from_fn(|i| f(self.0[i], b.0[i])))
    }
}

impl Block for Portable {
    type Mask = [bool; LANES];

    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self([x; LANES])
    }

    #[inline(always)]
    fn load(from: &Lanes) -> Self {
        Self(from.0)
    }

    #[inline(always)]
    fn store(self, to: &mut Lanes) {
        to.0 = self.0;
    }

    #[inline(always)]
    fn add(self, b: Self) -> Self {
        self.zip(b, |a, b| a + b)
    }

    #[inline(always)]
    fn sub(self, b: Self) -> Self {
        self.zip(b, |a, b| a - b)
    }

    #[inline(always)]
    fn mul(self, b: Self) -> Self {
        self.zip(b, |a, b| a * b)
    }

    #[inline(always)]
    fn div(self, b: Self) -> Self {
        self.zip(b, |a, b| a / b)
    }

    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i].mul_add(b.0[i], c.0[i])))
    }

    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Self(std::array::from_fn(|i| (-self.0[i]).mul_add(b.0[i], c.0[i])))
    }

    #[inline(always)]
    fn min(self, b: Self) -> Self {
        self.zip(b, |a, b| if a < b { a } else { b })
    }

    #[inline(always)]
    fn max(self, b: Self) -> Self {
        self.zip(b, |a, b| if a > b { a } else { b })
    }

    #[inline(always)]
    fn round(self) -> Self {
        Self(self.0.map(f32::round_ties_even))
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(std::array::from_fn(|i| self.0[i].sqrt()))
    }

    #[inline(always)]
    fn abs(self) -> Self {
        Self(std::array::from_fn(|i| self.0[i].abs()))
    }

    #[inline(always)]
    fn less(self, b: Self) -> Self::Mask {
        std::array::from_fn(|i| self.0[i] < b.0[i])
    }

    #[inline(always)]
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self {
        Self(std::array::from_fn(|i| if mask[i] { a.0[i] } else { b.0[i] }))
    }

    #[inline(always)]
    fn bits(mask: Self::Mask) -> u16 {
        mask.iter().enumerate().fold(0, |bits, (i, set)| bits | (u16::from(*set) << i))
    }

    #[inline(always)]
    fn mask(bits: u16) -> Self::Mask {
        std::array::from_fn(|i| bits >> i & 1 == 1)
    }

    #[inline(always)]
    fn largest(six: [Self; 6]) -> [Self; 6] {
        six.map(|block| {
            let mut most = block.0[0];
            for i in 1..LANES {
                most = if block.0[i] > most { block.0[i] } else { most };
            }
            Self::splat(most)
        })
    }
}

//! Blocks in the vectors of x86 processors. Their methods may only run where the processor has the feature: kernels are
//! called through [`crate::Width`], which asks the processor.

use std::arch::x86_64::*;

use super::{Block, Lanes};

/// Rounds to nearest, without exceptions.
const NEAREST: i32 = _MM_FROUND_TO_NEAREST_INT | _MM_FROUND_NO_EXC;

/// Sixteen lanes of AVX-512.
#[derive(Clone, Copy)]
pub(crate) struct Avx512(__m512);

// SAFETY of all blocks below: these types are used only in functions that enable the feature, which `Width` calls
// only where the processor has it.
impl Block for Avx512 {
    type Mask = u16;

    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self(unsafe { _mm512_set1_ps(x) })
    }

    #[inline(always)]
    fn load(from: &Lanes) -> Self {
        Self(unsafe { _mm512_load_ps(from.0.as_ptr()) })
    }

    #[inline(always)]
    fn store(self, to: &mut Lanes) {
        unsafe { _mm512_store_ps(to.0.as_mut_ptr(), self.0) }
    }

    #[inline(always)]
    fn add(self, b: Self) -> Self {
        Self(unsafe { _mm512_add_ps(self.0, b.0) })
    }

    #[inline(always)]
    fn sub(self, b: Self) -> Self {
        Self(unsafe { _mm512_sub_ps(self.0, b.0) })
    }

    #[inline(always)]
    fn mul(self, b: Self) -> Self {
        Self(unsafe { _mm512_mul_ps(self.0, b.0) })
    }

    #[inline(always)]
    fn div(self, b: Self) -> Self {
        Self(unsafe { _mm512_div_ps(self.0, b.0) })
    }

    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        Self(unsafe { _mm512_fmadd_ps(self.0, b.0, c.0) })
    }

    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        Self(unsafe { _mm512_fnmadd_ps(self.0, b.0, c.0) })
    }

    #[inline(always)]
    fn min(self, b: Self) -> Self {
        Self(unsafe { _mm512_min_ps(self.0, b.0) })
    }

    #[inline(always)]
    fn max(self, b: Self) -> Self {
        Self(unsafe { _mm512_max_ps(self.0, b.0) })
    }

    #[inline(always)]
    fn round(self) -> Self {
        Self(unsafe { _mm512_roundscale_ps::<NEAREST>(self.0) })
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        Self(unsafe { _mm512_sqrt_ps(self.0) })
    }

    #[inline(always)]
    fn abs(self) -> Self {
        Self(unsafe { _mm512_abs_ps(self.0) })
    }

    #[inline(always)]
    fn less(self, b: Self) -> Self::Mask {
        unsafe { _mm512_cmp_ps_mask::<_CMP_LT_OQ>(self.0, b.0) }
    }

    #[inline(always)]
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self {
        Self(unsafe { _mm512_mask_blend_ps(mask, b.0, a.0) })
    }

    #[inline(always)]
    fn bits(mask: Self::Mask) -> u16 {
        mask
    }

    #[inline(always)]
    fn mask(bits: u16) -> Self::Mask {
        bits
    }

    #[inline(always)]
    fn largest([a, b, c, d, e, f]: [Self; 6]) -> [Self; 6] {
        unsafe {
            // Two blocks become one of twice four numbers, and four become one of four times four.
            let (ab, cd, ef) = (Self::halves(a.0, b.0), Self::halves(c.0, d.0), Self::halves(e.0, f.0));
            let (abcd, efef) = (Self::quarters(Self::pairs(ab, cd)), Self::quarters(Self::pairs(ef, ef)));
            [
                Self(_mm512_shuffle_f32x4::<0x00>(abcd, abcd)),
                Self(_mm512_shuffle_f32x4::<0x55>(abcd, abcd)),
                Self(_mm512_shuffle_f32x4::<0xAA>(abcd, abcd)),
                Self(_mm512_shuffle_f32x4::<0xFF>(abcd, abcd)),
                Self(_mm512_shuffle_f32x4::<0x00>(efef, efef)),
                Self(_mm512_shuffle_f32x4::<0x55>(efef, efef)),
            ]
        }
    }
}

impl Avx512 {
    /// The larger of the halves of `a`, then of those of `b`.
    #[inline(always)]
    unsafe fn halves(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_max_ps(_mm512_shuffle_f32x4::<0x44>(a, b), _mm512_shuffle_f32x4::<0xEE>(a, b)) }
    }

    /// The larger of the quarters of each half of `a`, then of those of `b`.
    #[inline(always)]
    unsafe fn pairs(a: __m512, b: __m512) -> __m512 {
        unsafe { _mm512_max_ps(_mm512_shuffle_f32x4::<0x88>(a, b), _mm512_shuffle_f32x4::<0xDD>(a, b)) }
    }

    /// The largest number of each quarter, in all lanes of it.
    #[inline(always)]
    unsafe fn quarters(a: __m512) -> __m512 {
        unsafe {
            let two = _mm512_max_ps(a, _mm512_permute_ps::<0x4E>(a));
            _mm512_max_ps(two, _mm512_permute_ps::<0xB1>(two))
        }
    }
}

/// Sixteen lanes in two vectors of AVX2.
#[derive(Clone, Copy)]
pub(crate) struct Avx2(__m256, __m256);

impl Block for Avx2 {
    type Mask = (__m256, __m256);

    #[inline(always)]
    fn splat(x: f32) -> Self {
        let one = unsafe { _mm256_set1_ps(x) };
        Self(one, one)
    }

    #[inline(always)]
    fn load(from: &Lanes) -> Self {
        let at = from.0.as_ptr();
        unsafe { Self(_mm256_load_ps(at), _mm256_load_ps(at.add(8))) }
    }

    #[inline(always)]
    fn store(self, to: &mut Lanes) {
        let at = to.0.as_mut_ptr();
        unsafe {
            _mm256_store_ps(at, self.0);
            _mm256_store_ps(at.add(8), self.1);
        }
    }

    #[inline(always)]
    fn add(self, b: Self) -> Self {
        unsafe { Self(_mm256_add_ps(self.0, b.0), _mm256_add_ps(self.1, b.1)) }
    }

    #[inline(always)]
    fn sub(self, b: Self) -> Self {
        unsafe { Self(_mm256_sub_ps(self.0, b.0), _mm256_sub_ps(self.1, b.1)) }
    }

    #[inline(always)]
    fn mul(self, b: Self) -> Self {
        unsafe { Self(_mm256_mul_ps(self.0, b.0), _mm256_mul_ps(self.1, b.1)) }
    }

    #[inline(always)]
    fn div(self, b: Self) -> Self {
        unsafe { Self(_mm256_div_ps(self.0, b.0), _mm256_div_ps(self.1, b.1)) }
    }

    #[inline(always)]
    fn mul_add(self, b: Self, c: Self) -> Self {
        unsafe { Self(_mm256_fmadd_ps(self.0, b.0, c.0), _mm256_fmadd_ps(self.1, b.1, c.1)) }
    }

    #[inline(always)]
    fn neg_mul_add(self, b: Self, c: Self) -> Self {
        unsafe { Self(_mm256_fnmadd_ps(self.0, b.0, c.0), _mm256_fnmadd_ps(self.1, b.1, c.1)) }
    }

    #[inline(always)]
    fn min(self, b: Self) -> Self {
        unsafe { Self(_mm256_min_ps(self.0, b.0), _mm256_min_ps(self.1, b.1)) }
    }

    #[inline(always)]
    fn max(self, b: Self) -> Self {
        unsafe { Self(_mm256_max_ps(self.0, b.0), _mm256_max_ps(self.1, b.1)) }
    }

    #[inline(always)]
    fn round(self) -> Self {
        unsafe { Self(_mm256_round_ps::<NEAREST>(self.0), _mm256_round_ps::<NEAREST>(self.1)) }
    }

    #[inline(always)]
    fn sqrt(self) -> Self {
        unsafe { Self(_mm256_sqrt_ps(self.0), _mm256_sqrt_ps(self.1)) }
    }

    #[inline(always)]
    fn abs(self) -> Self {
        unsafe {
            let sign = _mm256_set1_ps(-0.0);
            Self(_mm256_andnot_ps(sign, self.0), _mm256_andnot_ps(sign, self.1))
        }
    }

    #[inline(always)]
    fn less(self, b: Self) -> Self::Mask {
        unsafe { (_mm256_cmp_ps::<_CMP_LT_OQ>(self.0, b.0), _mm256_cmp_ps::<_CMP_LT_OQ>(self.1, b.1)) }
    }

    #[inline(always)]
    fn select(mask: Self::Mask, a: Self, b: Self) -> Self {
        unsafe { Self(_mm256_blendv_ps(b.0, a.0, mask.0), _mm256_blendv_ps(b.1, a.1, mask.1)) }
    }

    #[inline(always)]
    fn bits(mask: Self::Mask) -> u16 {
        let (low, high) = unsafe { (_mm256_movemask_ps(mask.0), _mm256_movemask_ps(mask.1)) };
        low as u16 | (high as u16) << 8
    }

    #[inline(always)]
    fn mask(bits: u16) -> Self::Mask {
        unsafe {
            let (all, lanes) = (_mm256_set1_epi32(i32::from(bits)), _mm256_setr_epi32(1, 2, 4, 8, 16, 32, 64, 128));
            let high = _mm256_slli_epi32::<8>(lanes);
            let set = |lanes| _mm256_castsi256_ps(_mm256_cmpeq_epi32(_mm256_and_si256(all, lanes), lanes));
            (set(lanes), set(high))
        }
    }

    #[inline(always)]
    fn largest([a, b, c, d, e, f]: [Self; 6]) -> [Self; 6] {
        unsafe {
            // Two blocks become one vector of twice four numbers, and four become one of four times two.
            let (ab, cd, ef) = (Self::halves(a, b), Self::halves(c, d), Self::halves(e, f));
            let (acbd, eeff) = (Self::quarters(ab, cd), Self::quarters(ef, ef));
            let (ab, cd) = (_mm256_permute_ps::<0x00>(acbd), _mm256_permute_ps::<0xAA>(acbd));
            [Self::lower(ab), Self::upper(ab), Self::lower(cd), Self::upper(cd), Self::lower(eeff), Self::upper(eeff)]
        }
    }
}

impl Avx2 {
    /// The larger of the quarters of `a`, two by two, then of those of `b`.
    #[inline(always)]
    unsafe fn halves(a: Self, b: Self) -> __m256 {
        unsafe {
            let (a, b) = (_mm256_max_ps(a.0, a.1), _mm256_max_ps(b.0, b.1));
            _mm256_max_ps(_mm256_permute2f128_ps::<0x20>(a, b), _mm256_permute2f128_ps::<0x31>(a, b))
        }
    }

    /// The largest number of each half of `a` twice, each before that of the same half of `b`, twice too.
    #[inline(always)]
    unsafe fn quarters(a: __m256, b: __m256) -> __m256 {
        unsafe {
            let two = _mm256_max_ps(_mm256_shuffle_ps::<0x44>(a, b), _mm256_shuffle_ps::<0xEE>(a, b));
            _mm256_max_ps(two, _mm256_permute_ps::<0xB1>(two))
        }
    }

    /// The lower half in all quarters.
    #[inline(always)]
    unsafe fn lower(a: __m256) -> Self {
        let half = unsafe { _mm256_permute2f128_ps::<0x00>(a, a) };
        Self(half, half)
    }

    /// The upper half in all quarters.
    #[inline(always)]
    unsafe fn upper(a: __m256) -> Self {
        let half = unsafe { _mm256_permute2f128_ps::<0x11>(a, a) };
        Self(half, half)
    }
}

//! Sine and cosine in one go.

use crate::block::Block;

/// π in two parts: its single-precision value, and what that lacks.
const PI: (f32, f32) = (std::f32::consts::PI, -8.742_278e-8);
/// Coefficients of sin(r)/r in r², from r⁰; the polynomial is within 7e-9 of the sine for |r| ≤ π/2.
const SIN: [f32; 5] = [1.0, -0.166_666_58, 0.008_333_051, -0.000_198_090_4, 2.605_151_6e-6];
/// Coefficients of cos(r) in r², from r⁰; within 3e-10 of the cosine for |r| ≤ π/2.
const COS: [f32; 6] = [1.0, -0.5, 0.041_666_634, -0.001_388_836_1, 2.476_012_7e-5, -2.605_093e-7];

/// Returns sine and cosine of angles of some whole turns [rad]; the error is below 3e-7.
#[inline(always)]
pub fn sin_cos<B: Block>(x: B) -> (B, B) {
    let half_turns = x.mul(B::splat(std::f32::consts::FRAC_1_PI)).round();
    let r = half_turns.neg_mul_add(B::splat(PI.1), half_turns.neg_mul_add(B::splat(PI.0), x));
    // An odd number of half turns changes the sign of both: its half is a half away from an integer.
    let half = half_turns.mul(B::splat(0.5));
    let away = half.sub(half.round());
    let sign = away.mul(away).neg_mul_add(B::splat(8.0), B::splat(1.0));
    let u = r.mul(r);
    (polynomial(&SIN, u).mul(r).mul(sign), polynomial(&COS, u).mul(sign))
}

#[inline(always)]
fn polynomial<B: Block, const N: usize>(coefficients: &[f32; N], u: B) -> B {
    let mut sum = B::splat(coefficients[N - 1]);
    for i in (0..N - 1).rev() {
        sum = sum.mul_add(u, B::splat(coefficients[i]));
    }
    sum
}

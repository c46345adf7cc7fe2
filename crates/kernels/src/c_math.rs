//! The C library's sine, logarithm and the like, replaced by those of the crate `libm` in every program that contains
//! this package.
//!
//! C libraries differ in the last bit: by version, by processor, and by whether it has fused multiply-add. A plan or a
//! tick would then depend on the computer. `f64::sin`, ours or a library's, becomes a call of the symbol `sin`, and the
//! linker prefers the one defined here. What IEEE 754 rounds once (`sqrt`, `fma`, `floor`, `fmod`) is equal everywhere
//! and stays the C library's. A test asks the built program which symbols it still takes from the C library.

macro_rules! functions {
    ($float:ty: $($name:ident($($x:ident),+))+) => {$(
        // SAFETY: the C library's name, arguments and result.
        #[unsafe(no_mangle)]
        extern "C" fn $name($($x: $float),+) -> $float {
            libm::$name($($x),+)
        }
    )+};
}

functions! { f64:
    sin(x) cos(x) tan(x) asin(x) acos(x) atan(x) atan2(y, x) hypot(x, y) cbrt(x) pow(x, y)
    sinh(x) cosh(x) tanh(x) asinh(x) acosh(x) atanh(x)
    exp(x) exp2(x) exp10(x) expm1(x) log(x) log2(x) log10(x) log1p(x)
}

functions! { f32:
    sinf(x) cosf(x) tanf(x) asinf(x) acosf(x) atanf(x) atan2f(y, x) hypotf(x, y) cbrtf(x) powf(x, y)
    sinhf(x) coshf(x) tanhf(x) asinhf(x) acoshf(x) atanhf(x)
    expf(x) exp2f(x) exp10f(x) expm1f(x) logf(x) log2f(x) log10f(x) log1pf(x)
}

/// Both in one call: what the compiler makes of a sine and a cosine of the same angle.
///
/// # Safety
///
/// As in C: both pointers are valid for a write.
// SAFETY: the C library's name, arguments and result.
#[unsafe(no_mangle)]
unsafe extern "C" fn sincos(x: f64, sine: *mut f64, cosine: *mut f64) {
    let (s, c) = libm::sincos(x);
    // SAFETY: the caller's promise.
    unsafe { (*sine, *cosine) = (s, c) }
}

/// [`sincos`] in single precision.
///
/// # Safety
///
/// As in C: both pointers are valid for a write.
// SAFETY: the C library's name, arguments and result.
#[unsafe(no_mangle)]
unsafe extern "C" fn sincosf(x: f32, sine: *mut f32, cosine: *mut f32) {
    let (s, c) = libm::sincosf(x);
    // SAFETY: the caller's promise.
    unsafe { (*sine, *cosine) = (s, c) }
}

#[cfg(test)]
mod tests {
    use std::hint::black_box;

    /// An angle, or another number, that no compiler has computed with in advance.
    fn numbers() -> impl Iterator<Item = f64> {
        (0..20_000).map(|i| black_box((f64::from(i) - 10_000.0) * 0.00123))
    }

    #[test]
    fn methods_of_numbers_are_those_of_the_crate() {
        for x in numbers() {
            let ours = [x.sin(), x.cos(), x.tan(), x.exp(), x.cbrt(), x.atan2(0.7), x.hypot(0.3), x.abs().ln()];
            let crates = [
                libm::sin(x),
                libm::cos(x),
                libm::tan(x),
                libm::exp(x),
                libm::cbrt(x),
                libm::atan2(x, 0.7),
                libm::hypot(x, 0.3),
                libm::log(x.abs()),
            ];
            assert_eq!(ours.map(f64::to_bits), crates.map(f64::to_bits), "{x}");
            assert_eq!((x as f32).sin().to_bits(), libm::sinf(x as f32).to_bits(), "{x}");
        }
    }

    #[test]
    fn sine_and_cosine_in_one_call_are_those_of_two() {
        for x in numbers().chain([1e-9, 1.2e-8, 2e-8, 1e6, 1e300]) {
            let (s, c) = libm::sincos(x);
            assert_eq!((s.to_bits(), c.to_bits()), (libm::sin(x).to_bits(), libm::cos(x).to_bits()), "{x}");
        }
    }
}

//! The vectors that the processor has.

/// Which vectors kernels use; always some that this processor has. All give the same bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Width(pub(crate) Vectors);

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Vectors {
    /// Sixteen lanes at a time (x86 with AVX-512).
    #[cfg(target_arch = "x86_64")]
    Avx512,
    /// Twice eight lanes at a time (x86 with AVX2 and FMA).
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// Whatever the compiler makes of arrays: four lanes at a time on ARM; slow on x86 without FMA.
    Portable,
}

impl Width {
    /// Returns the widest vectors of this processor.
    pub fn widest() -> Self {
        #[cfg(target_arch = "x86_64")]
        {
            if is_x86_feature_detected!("avx512f") && is_x86_feature_detected!("fma") {
                return Self(Vectors::Avx512);
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                return Self(Vectors::Avx2);
            }
        }
        Self(Vectors::Portable)
    }

    /// Returns the widths that this processor can use, widest first.
    pub fn usable() -> Vec<Self> {
        let mut widths = vec![Self::widest()];
        #[cfg(target_arch = "x86_64")]
        if widths == [Self(Vectors::Avx512)] && is_x86_feature_detected!("avx2") {
            widths.push(Self(Vectors::Avx2));
        }
        if !widths.contains(&Self(Vectors::Portable)) {
            widths.push(Self(Vectors::Portable));
        }
        widths
    }
}

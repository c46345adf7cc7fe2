//! The vectors that the processor has.

/// Which vectors kernels use. All give the same bits.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Width {
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
                return Self::Avx512;
            }
            if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
                return Self::Avx2;
            }
        }
        Self::Portable
    }

    /// Returns the widths that this processor can use, widest first.
    pub fn usable() -> Vec<Self> {
        let mut widths = Vec::new();
        #[cfg(target_arch = "x86_64")]
        match Self::widest() {
            Self::Avx512 => widths.extend([Self::Avx512, Self::Avx2]),
            Self::Avx2 => widths.push(Self::Avx2),
            Self::Portable => {}
        }
        widths.push(Self::Portable);
        widths
    }
}

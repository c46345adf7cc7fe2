//! The vectors that the processor has.

use std::sync::OnceLock;

/// Width of the vectors that kernels use, always one that this processor has. All give the same bits.
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

/// The width that [`Width::prefer`] has set.
static PREFERRED: OnceLock<Width> = OnceLock::new();

impl Width {
    /// Returns the vectors to use: the widest of this processor, unless others were preferred.
    pub fn widest() -> Self {
        PREFERRED.get().copied().unwrap_or_else(|| Self::usable().first().copied().unwrap_or(Self(Vectors::Portable)))
    }

    /// Makes [`widest`](Self::widest) return this one from now on: to compare widths in one program. Returns whether it
    /// is the first that is preferred; later ones are not.
    pub fn prefer(self) -> bool {
        PREFERRED.set(self).is_ok()
    }

    /// Returns the widths that this processor can use, widest first.
    pub fn usable() -> Vec<Self> {
        let mut widths = Vec::new();
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("fma") {
            if is_x86_feature_detected!("avx512f") {
                widths.push(Self(Vectors::Avx512));
            }
            if is_x86_feature_detected!("avx2") {
                widths.push(Self(Vectors::Avx2));
            }
        }
        widths.push(Self(Vectors::Portable));
        widths
    }

    /// Returns its name: `avx512`, `avx2` or `portable`.
    pub fn name(self) -> &'static str {
        match self.0 {
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => "avx512",
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => "avx2",
            Vectors::Portable => "portable",
        }
    }
}

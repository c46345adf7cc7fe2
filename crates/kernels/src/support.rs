//! The vertex of a convex body that is farthest in a direction, eight at a time, in double precision: most of the work
//! of an exact distance.

use crate::Width;
use crate::width::Vectors;

const GROUP: usize = 8;

/// Vertices of a convex body [m], by coordinate, in groups.
#[derive(Debug, Clone)]
pub struct Vertices {
    groups: Vec<[[f64; GROUP]; 3]>,
    width: Width,
}

impl Vertices {
    /// Groups vertices; `None` if there are none.
    pub fn new(vertices: &[[f64; 3]], width: Width) -> Option<Self> {
        let last = *vertices.last()?;
        // The last group is filled with one vertex, which is then found at its first place.
        let group = |part: &[[f64; 3]]| -> [[f64; GROUP]; 3] {
            std::array::from_fn(|axis| std::array::from_fn(|lane| part.get(lane).unwrap_or(&last)[axis]))
        };
        Some(Self { groups: vertices.chunks(GROUP).map(group).collect(), width })
    }

    /// Returns the vertex that is farthest in a direction; of several, always the same.
    pub fn farthest(&self, direction: [f64; 3]) -> [f64; 3] {
        match self.width.0 {
            // SAFETY: only `Width` makes one, and only of vectors that this processor has.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { avx512(&self.groups, direction) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { avx2(&self.groups, direction) },
            Vectors::Portable => find(&self.groups, direction),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn avx512(groups: &[[[f64; GROUP]; 3]], direction: [f64; 3]) -> [f64; 3] {
    find(groups, direction)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn avx2(groups: &[[[f64; GROUP]; 3]], direction: [f64; 3]) -> [f64; 3] {
    find(groups, direction)
}

#[inline(always)]
fn find(groups: &[[[f64; GROUP]; 3]], [x, y, z]: [f64; 3]) -> [f64; 3] {
    let mut most = [f64::NEG_INFINITY; GROUP];
    let mut at = [0_u64; GROUP];
    for (i, [a, b, c]) in groups.iter().enumerate() {
        for lane in 0..GROUP {
            let far = a[lane] * x + b[lane] * y + c[lane] * z;
            let better = far > most[lane];
            most[lane] = if better { far } else { most[lane] };
            at[lane] = if better { i as u64 } else { at[lane] };
        }
    }
    let mut best = 0;
    for lane in 1..GROUP {
        if most[lane] > most[best] {
            best = lane;
        }
    }
    let [a, b, c] = &groups[at[best] as usize];
    [a[best], b[best], c[best]]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_width_finds_the_farthest_vertex() {
        let mut state = 1_u64;
        let mut unit = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        };
        assert!(Vertices::new(&[], Width::widest()).is_none());
        for number in 1..40 {
            let points: Vec<[f64; 3]> = (0..number).map(|_| [unit(), unit(), unit()]).collect();
            let direction = [unit(), unit(), unit()];
            let far = |p: &[f64; 3]| p[0] * direction[0] + p[1] * direction[1] + p[2] * direction[2];
            let expected = *points.iter().max_by(|a, b| far(a).total_cmp(&far(b))).unwrap();
            for width in Width::usable() {
                assert_eq!(Vertices::new(&points, width).unwrap().farthest(direction), expected, "{number} {width:?}");
            }
        }
        // A direction that is not a number finds some vertex.
        assert_eq!(Vertices::new(&[[1.0; 3]], Width::widest()).unwrap().farthest([f64::NAN; 3]), [1.0; 3]);
    }
}

//! Which pairs are proven apart on sixteen pieces of a motion whose joints move by different amounts: the next
//! setpoints of a tick, and the braking path from them.

use super::{Buffers, Compared, Gap, Scene, compare};
use crate::block::{Block, Lanes};
use crate::bodies::{forward, point};
#[cfg(target_arch = "x86_64")]
use crate::width::Vectors;

/// For each pair of a scene, how far a variable moves its members relative to each other.
#[derive(Debug, Clone, Default)]
pub struct Levers {
    /// Where the entries of each pair begin.
    first: Vec<u32>,
    /// Variable, and the most that it moves any point of the pair [m/rad or m/m].
    entries: Vec<(u32, f32)>,
}

impl Levers {
    /// Adds the next pair: for each variable, the most that it moves any of its points [m/rad or m/m].
    pub fn push(&mut self, levers: &[f64]) {
        self.first.push(self.entries.len() as u32);
        let moving = levers.iter().enumerate().filter(|(_, lever)| **lever > 0.0);
        // Rounded up.
        self.entries.extend(moving.map(|(variable, lever)| (variable as u32, (lever * (1.0 + 1e-6)) as f32)));
    }

    /// Returns the entries of a pair.
    pub fn of(&self, pair: usize) -> &[(u32, f32)] {
        let end = self.first.get(pair + 1).map_or(self.entries.len(), |end| *end as usize);
        self.first.get(pair).map_or(&[], |first| &self.entries[*first as usize..end])
    }
}

/// Sixteen pieces of a motion.
#[derive(Debug, Clone, Copy)]
pub struct Pieces<'a> {
    /// A configuration in the middle of each: one entry per variable [rad or m].
    pub q: &'a [Lanes],
    /// For each variable, how far it gets from there on the piece at most [rad or m].
    pub half: &'a [Lanes],
    /// Lanes in use, as bits.
    pub lanes: u16,
    /// Addition to the padding of every pair, per lane [m].
    pub margin: &'a Lanes,
    /// For each pair of the scene, its padding [m].
    pub pads: &'a [f32],
    /// Most balls, or pairs of them, that are replaced by their parts for one pair.
    pub visits: usize,
}

impl Scene {
    /// Adds those of `pairs` that are not proven apart to `close`, each with its lanes as bits. Does not allocate once
    /// `buffers` were used for this scene, and while `close` has room for all pairs.
    ///
    /// # Panics
    /// If a slice is too short, or a pair is out of range.
    pub fn close_on_pieces(
        &self,
        pieces: &Pieces<'_>,
        levers: &Levers,
        pairs: &[u32],
        buffers: &mut Buffers,
        close: &mut Vec<(u32, u16)>,
    ) {
        assert!(pieces.q.len() >= self.variables && pieces.half.len() >= self.variables, "an entry per variable");
        buffers.frames.resize(self.bodies.len(), [Lanes::splat(0.0); 12]);
        match self.width.0 {
            // SAFETY: only `Width` makes one, and only of vectors that this processor has.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { avx512(self, pieces, levers, pairs, buffers, close) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { avx2(self, pieces, levers, pairs, buffers, close) },
            _ => find::<crate::block::Portable>(self, pieces, levers, pairs, buffers, close),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn avx512(
    scene: &Scene,
    pieces: &Pieces<'_>,
    levers: &Levers,
    pairs: &[u32],
    buffers: &mut Buffers,
    close: &mut Vec<(u32, u16)>,
) {
    find::<crate::block::x86::Avx512>(scene, pieces, levers, pairs, buffers, close)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2(
    scene: &Scene,
    pieces: &Pieces<'_>,
    levers: &Levers,
    pairs: &[u32],
    buffers: &mut Buffers,
    close: &mut Vec<(u32, u16)>,
) {
    find::<crate::block::x86::Avx2>(scene, pieces, levers, pairs, buffers, close)
}

#[inline(always)]
fn find<B: Block>(
    scene: &Scene,
    pieces: &Pieces<'_>,
    levers: &Levers,
    pairs: &[u32],
    buffers: &mut Buffers,
    close: &mut Vec<(u32, u16)>,
) {
    forward::<B>(&scene.prepared, pieces.q, &mut buffers.frames);
    let frames = &buffers.frames;
    let mut current = usize::MAX;
    let mut center = [B::splat(0.0); 3];
    let margin = B::load(pieces.margin);
    for &index in pairs {
        let Compared { link: at, other, rounding, .. } = &scene.pairs[index as usize];
        let link = &scene.links[*at];
        let Some(root) = link.tree.nodes.first() else {
            close.push((index, pieces.lanes));
            continue;
        };
        if current != *at {
            (current, center) = (*at, point(&frames[link.body], &root.center));
        }
        let mut outer = margin.add(B::splat(pieces.pads[index as usize] + rounding));
        for (variable, lever) in levers.of(index as usize) {
            outer = B::load(&pieces.half[*variable as usize]).mul_add(B::splat(*lever), outer);
        }
        let gap = Gap { outer, inner: f32::NEG_INFINITY, fine: 0.0, visits: pieces.visits };
        let found = compare(scene, frames, link, other, &center, &gap, pieces.lanes);
        if found.close != 0 {
            close.push((index, found.close));
        }
    }
}

//! The nodes of a tree that are nearest to samples: sixteen samples at a time, one per lane, or one sample and sixteen
//! nodes at a time.

use crate::Width;
use crate::block::{Block, LANES, Lanes, Portable};
use crate::width::Vectors;

const TURN: f32 = std::f32::consts::TAU;

/// Configurations, sixteen per group: one block per variable.
#[derive(Debug, Clone)]
pub struct Nodes {
    groups: Vec<Lanes>,
    /// Variables that repeat after a whole turn.
    turns: Vec<bool>,
    number: usize,
    width: Width,
}

/// The nearest node of each sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nearest {
    /// Squared distances; infinite without nodes.
    pub squared: Lanes,
    /// Indices of the nodes: whole numbers.
    node: Lanes,
    /// Number of nodes that were compared.
    pub compared: usize,
}

impl Nearest {
    /// Nothing compared yet.
    pub const NONE: Self = Self { squared: Lanes::splat(f32::INFINITY), node: Lanes::splat(0.0), compared: 0 };

    /// Returns the index of the node nearest to the sample of a lane.
    #[inline]
    pub fn node(&self, lane: usize) -> usize {
        self.node.0[lane] as usize
    }

    /// Returns the distance from that node to the sample of a lane.
    #[inline]
    pub fn distance(&self, lane: usize) -> f64 {
        f64::from(self.squared.0[lane]).sqrt()
    }

    /// Takes a lane of another one, which was compared with the same nodes as the lanes that are used here.
    #[inline]
    pub fn copy_lane(&mut self, lane: usize, other: &Self, from: usize) {
        self.squared.0[lane] = other.squared.0[from];
        self.node.0[lane] = other.node.0[from];
        self.compared = other.compared;
    }
}

/// Largest number of nodes: their indices are exact in single precision.
pub const MOST: usize = 1 << 24;

impl Nodes {
    /// Creates a tree without nodes; `turns` marks the variables of which a whole turn changes nothing.
    pub fn new(turns: &[bool], width: Width) -> Self {
        Self { groups: Vec::new(), turns: turns.to_vec(), number: 0, width }
    }

    /// Returns the number of nodes.
    pub fn len(&self) -> usize {
        self.number
    }

    /// Returns whether there are no nodes.
    pub fn is_empty(&self) -> bool {
        self.number == 0
    }

    /// Adds a node.
    ///
    /// # Panics
    /// If there are too many.
    pub fn add(&mut self, q: &[f64]) {
        assert!(self.number < MOST, "at most {MOST} nodes");
        let lane = self.number % LANES;
        if lane == 0 {
            // Unused lanes hold ∞ or NaN: they are never nearest.
            self.groups.resize(self.groups.len() + self.turns.len(), Lanes::splat(f32::INFINITY));
        }
        let last = self.groups.len() - self.turns.len();
        for (group, q) in self.groups[last..].iter_mut().zip(q) {
            group.0[lane] = *q as f32;
        }
        self.number += 1;
    }

    /// Removes a node: it is nearest to nothing any longer. The indices of the others stay.
    pub fn remove(&mut self, node: usize) {
        let dof = self.turns.len();
        if node < self.number {
            let group = &mut self.groups[node / LANES * dof..][..dof];
            group.iter_mut().for_each(|block| block.0[node % LANES] = f32::INFINITY);
        }
    }

    /// Compares the nodes that were added since with sixteen samples, one block per variable.
    ///
    /// # Panics
    /// If there are too few variables.
    pub fn compare(&self, samples: &[Lanes], nearest: &mut Nearest) {
        assert!(samples.len() >= self.turns.len(), "a sample has {} variables", self.turns.len());
        match self.width.0 {
            // SAFETY: only `Width` makes one, and only of vectors that this processor has.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { compare_avx512(self, samples, nearest) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { compare_avx2(self, samples, nearest) },
            Vectors::Portable => compare::<Portable>(self, samples, nearest),
        }
    }

    /// Returns the node nearest to a configuration, of several the first, and the squared distance.
    ///
    /// # Panics
    /// If there are too few variables.
    pub fn nearest(&self, q: &[f64]) -> (usize, f32) {
        assert!(q.len() >= self.turns.len(), "a configuration has {} variables", self.turns.len());
        match self.width.0 {
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { nearest_avx512(self, q) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { nearest_avx2(self, q) },
            Vectors::Portable => nearest::<Portable>(self, q),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn compare_avx512(nodes: &Nodes, samples: &[Lanes], nearest: &mut Nearest) {
    compare::<crate::block::x86::Avx512>(nodes, samples, nearest);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn compare_avx2(nodes: &Nodes, samples: &[Lanes], nearest: &mut Nearest) {
    compare::<crate::block::x86::Avx2>(nodes, samples, nearest);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn nearest_avx512(nodes: &Nodes, q: &[f64]) -> (usize, f32) {
    nearest::<crate::block::x86::Avx512>(nodes, q)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn nearest_avx2(nodes: &Nodes, q: &[f64]) -> (usize, f32) {
    nearest::<crate::block::x86::Avx2>(nodes, q)
}

/// Returns the squared difference added to a sum; the short way round if the variable turns.
#[inline(always)]
fn add_squared<B: Block>(a: B, b: B, turns: bool, sum: B) -> B {
    let d = a.sub(b);
    let d = if turns { d.mul(B::splat(1.0 / TURN)).round().neg_mul_add(B::splat(TURN), d) } else { d };
    d.mul_add(d, sum)
}

#[inline(always)]
fn compare<B: Block>(nodes: &Nodes, samples: &[Lanes], nearest: &mut Nearest) {
    let dof = nodes.turns.len();
    let (mut best, mut at) = (B::load(&nearest.squared), B::load(&nearest.node));
    for i in nearest.compared..nodes.number {
        let group = &nodes.groups[i / LANES * dof..][..dof];
        let mut squared = B::splat(0.0);
        for j in 0..dof {
            let node = B::splat(group[j].0[i % LANES]);
            squared = add_squared(node, B::load(&samples[j]), nodes.turns[j], squared);
        }
        let closer = B::less(squared, best);
        best = B::select(closer, squared, best);
        at = B::select(closer, B::splat(i as f32), at);
    }
    best.store(&mut nearest.squared);
    at.store(&mut nearest.node);
    nearest.compared = nodes.number;
}

#[inline(always)]
fn nearest<B: Block>(nodes: &Nodes, q: &[f64]) -> (usize, f32) {
    let dof = nodes.turns.len();
    let (mut best, mut at) = (B::splat(f32::INFINITY), B::splat(0.0));
    for i in 0..nodes.number.div_ceil(LANES) {
        let group = &nodes.groups[i * dof..][..dof];
        let mut squared = B::splat(0.0);
        for j in 0..dof {
            squared = add_squared(B::load(&group[j]), B::splat(q[j] as f32), nodes.turns[j], squared);
        }
        let closer = B::less(squared, best);
        best = B::select(closer, squared, best);
        at = B::select(closer, B::splat(i as f32), at);
    }
    let (mut squared, mut group) = (Lanes::splat(0.0), Lanes::splat(0.0));
    best.store(&mut squared);
    at.store(&mut group);
    let mut nearest = (0, f32::INFINITY);
    for lane in 0..LANES {
        let node = group.0[lane] as usize * LANES + lane;
        if squared.0[lane] < nearest.1 || (squared.0[lane] == nearest.1 && node < nearest.0) {
            nearest = (node, squared.0[lane]);
        }
    }
    nearest
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn samples_and_single_configurations_find_the_same_nodes_on_every_width() {
        let mut state = 3_u64;
        let mut number = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 52) as f64 * 6.0 - 6.0
        };
        for turns in [[false; 3], [true, false, true]] {
            let trees: Vec<Nodes> = Width::usable().into_iter().map(|width| Nodes::new(&turns, width)).collect();
            let (mut trees, mut points) = (trees, Vec::new());
            assert!(trees[0].is_empty() && trees[0].nearest(&[0.0; 3]).1 == f32::INFINITY);
            let samples: Vec<Vec<f64>> = (0..LANES).map(|_| vec![number(), number(), number()]).collect();
            let lanes: Vec<Lanes> = (0..3).map(|j| Lanes(std::array::from_fn(|k| samples[k][j] as f32))).collect();
            let mut found = vec![Nearest::NONE; trees.len()];
            for _ in 0..70 {
                points.push(vec![number(), number(), number()]);
                for (tree, found) in trees.iter_mut().zip(&mut found) {
                    tree.add(points.last().unwrap());
                    if points.len() % 3 != 0 {
                        tree.compare(&lanes, found);
                    }
                }
            }
            for (tree, found) in trees.iter().zip(&mut found) {
                tree.compare(&lanes, found);
                assert_eq!(found.compared, tree.len());
                for (lane, sample) in samples.iter().enumerate() {
                    let (node, squared) = tree.nearest(sample);
                    assert_eq!((node, squared), (found.node(lane), found.squared.0[lane]));
                    let apart = |p: &[f64]| -> f64 {
                        let d = p.iter().zip(sample).zip(turns).map(|((a, b), turns)| {
                            let d = a - b;
                            if turns { d - (d / std::f64::consts::TAU).round() * std::f64::consts::TAU } else { d }
                        });
                        d.map(|d| d * d).sum()
                    };
                    let least = points.iter().map(|p| apart(p)).fold(f64::INFINITY, f64::min);
                    assert!((apart(&points[node]) - least).abs() < 1e-4 && (f64::from(squared) - least).abs() < 1e-4);
                }
            }
            assert!(found.iter().all(|one| one == &found[0]));
        }
    }
}

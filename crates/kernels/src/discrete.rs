//! Whether a motion touches anything at samples: a check of covers, sixteen configurations at a time.
//!
//! A discrete check proves nothing between the samples. A swept check does: a ball moves from one sample to the next
//! along an arc that stays within a bulge of its chord, so all places of the ball are within two larger balls, one
//! about each end of the chord. With chord L, bulge b and radius r their radius is √((r + b)² + (L/2)²): some
//! millimetres more.
//!
//! The samples of a block are spread over the whole motion, and later blocks fall between them: most motions that touch
//! are found by the first block (the "rake" of Thomason, Kingston and Kavraki, "Motions in microseconds via vectorized
//! sampling-based planning", 2024). Covers are compared from coarse to fine: the box around all places of a body with
//! those around sixteen obstacles at a time, then the ball around all that the body carries, its links, and their
//! parts.
//!
//! Sixteen configurations that are no motion get a verdict each, by the same comparison; it then continues to the last
//! lane.

mod check;
mod gap;
mod touch;

use std::sync::Arc;

use crate::apart::{Compared, Other, Scene};
use crate::block::{LANES, Lanes};
use crate::bodies::Frames;
use crate::cover::{Node, Tree, enclosing};
use crate::width::Vectors;

/// The links of one body and an obstacle are no pair.
const NO_PAIR: u32 = u32::MAX;

/// Robots and obstacles, prepared for discrete checks.
#[derive(Debug, Clone)]
pub struct Discrete {
    scene: Arc<Scene>,
    carried: Vec<Carried>,
    links: Vec<Member>,
    obstacles: Vec<Standing>,
    boxes: Vec<Boxes>,
    /// For each obstacle of each body, the pairs of the body's links.
    pairs: Vec<u32>,
    bodies: Vec<BodyPair>,
    link_pairs: Vec<LinkPair>,
    /// Largest error of a distance [m].
    rounding: f32,
}

/// Links and obstacles of one body.
#[derive(Debug, Clone)]
struct Carried {
    body: usize,
    /// A ball around all.
    center: [f32; 3],
    radius: f32,
    /// Its links.
    links: (u32, u32),
    /// Its obstacles.
    obstacles: (u32, u32),
    /// The boxes around them, sixteen per group.
    groups: (u32, u32),
}

#[derive(Debug, Clone)]
struct Member {
    tree: Arc<Tree>,
    /// One of its pairs with obstacles.
    pair: u32,
}

/// An obstacle that a body may touch.
#[derive(Debug, Clone, Copy)]
struct Standing {
    other: Other,
    /// Index of the pair of the first link in `pairs`.
    pairs: u32,
}

/// Boxes around sixteen obstacles in the world: corners [m]. Unused boxes are at ∞.
#[derive(Debug, Clone, Copy)]
struct Boxes {
    low: [Lanes; 3],
    high: [Lanes; 3],
}

/// Two bodies whose links may touch.
#[derive(Debug, Clone, Copy)]
struct BodyPair {
    a: u32,
    b: u32,
    pairs: (u32, u32),
}

#[derive(Debug, Clone, Copy)]
struct LinkPair {
    a: u32,
    b: u32,
    pair: u32,
}

/// A motion, its samples, and what is kept in mind from one to the next.
#[derive(Debug, Clone, Copy)]
pub struct Motion<'a> {
    /// Where it begins: one entry per variable [rad or m]. This configuration is no sample.
    pub from: &'a [f64],
    /// Where it ends; the last sample.
    pub to: &'a [f64],
    /// Number of blocks of sixteen samples.
    pub blocks: usize,
    /// Number of blocks that are left out: the first one is spread over the whole motion, as a motion of one block is.
    pub skipped: usize,
    /// For each pair of the scene, its padding [m].
    pub pads: &'a [f64],
    /// The largest of them.
    pub pad: f64,
    /// A pair that is likely to touch: it is compared first.
    pub likely: Option<u32>,
    /// The proof that is asked for.
    pub proof: Proof<'a>,
}

/// The proof that a check without contact gives.
#[derive(Debug, Clone, Copy)]
pub enum Proof<'a> {
    /// Nothing, not even at the samples: numbers are rounded.
    None,
    /// That nothing touches at the samples.
    Samples,
    /// That nothing touches on the whole motion, from its beginning, which is then the first sample.
    Motion {
        /// For each pair of the scene, the most that it can approach on a motion of which this one is a part [m].
        reach: &'a [f64],
        /// Length of this motion as a part of that one: 1 for the whole.
        part: f64,
        /// The sum of the angles by which all joints turn [rad].
        turn: f64,
    },
}

/// Buffers of a check.
#[derive(Debug, Clone, Default)]
pub struct Buffers {
    q: Vec<Lanes>,
    frames: Vec<Frames>,
    centers: Vec<[Lanes; 3]>,
    /// Pairs that touched lately, at configurations that were checked each for itself.
    frequent: Vec<u32>,
}

impl Discrete {
    /// Prepares the pairs of a scene.
    pub fn new(scene: Arc<Scene>) -> Self {
        let mut made = Self {
            carried: Vec::new(),
            links: Vec::new(),
            obstacles: Vec::new(),
            boxes: Vec::new(),
            pairs: Vec::new(),
            bodies: Vec::new(),
            link_pairs: Vec::new(),
            rounding: scene.pairs.iter().map(|pair| pair.rounding).fold(0.0, f32::max),
            scene: scene.clone(),
        };
        // The bodies that move farthest come first, and their links follow each other.
        let mut bodies: Vec<usize> = scene.links.iter().map(|link| link.body).collect();
        bodies.sort_unstable_by(|a, b| b.cmp(a));
        bodies.dedup();
        let mut place = vec![(0, 0); scene.links.len()];
        for body in bodies {
            let own: Vec<usize> = (0..scene.links.len()).filter(|&l| scene.links[l].body == body).collect();
            let first = made.links.len() as u32;
            for &link in &own {
                place[link] = (made.carried.len() as u32, made.links.len() as u32);
                made.links.push(Member { tree: scene.links[link].tree.clone(), pair: NO_PAIR });
            }
            let (center, radius) = around(own.iter().map(|&link| &*scene.links[link].tree));
            let links = (first, made.links.len() as u32);
            made.carried.push(Carried { body, center, radius, links, obstacles: (0, 0), groups: (0, 0) });
        }
        for number in 0..made.carried.len() {
            made.add_obstacles(number, &place);
        }
        made.add_links(&place);
        made
    }

    /// Adds the obstacles of a body.
    fn add_obstacles(&mut self, number: usize, place: &[(u32, u32)]) {
        let scene = self.scene.clone();
        let links = self.carried[number].links;
        let first = self.obstacles.len() as u32;
        let mut places: Vec<Option<usize>> = Vec::new();
        for (index, compared) in scene.pairs.iter().enumerate() {
            let Compared { link, other, obstacle: Some(obstacle), .. } = *compared else { continue };
            let (body, member) = place[link];
            if body as usize != number {
                continue;
            }
            places.resize(places.len().max(obstacle + 1), None);
            let pairs = *places[obstacle].get_or_insert_with(|| {
                self.obstacles.push(Standing { other, pairs: self.pairs.len() as u32 });
                self.pairs.resize(self.pairs.len() + (links.1 - links.0) as usize, NO_PAIR);
                self.pairs.len() - (links.1 - links.0) as usize
            });
            self.pairs[pairs + (member - links.0) as usize] = index as u32;
            self.links[member as usize].pair = index as u32;
        }
        let groups = self.boxes.len() as u32;
        for group in self.obstacles[first as usize..].chunks(LANES) {
            let none = [Lanes::splat(f32::INFINITY); 3];
            let mut boxes = Boxes { low: none, high: none };
            for (lane, standing) in group.iter().enumerate() {
                let (low, high) = scene.bounds(&standing.other);
                for axis in 0..3 {
                    (boxes.low[axis].0[lane], boxes.high[axis].0[lane]) = (low[axis], high[axis]);
                }
            }
            self.boxes.push(boxes);
        }
        self.carried[number].obstacles = (first, self.obstacles.len() as u32);
        self.carried[number].groups = (groups, self.boxes.len() as u32);
    }

    /// Adds the pairs of links.
    fn add_links(&mut self, place: &[(u32, u32)]) {
        let mut found: Vec<(u32, u32, LinkPair)> = Vec::new();
        for (index, compared) in self.scene.pairs.iter().enumerate() {
            if let Other::Link(other) = compared.other {
                let ((p, a), (q, b)) = (place[compared.link], place[other]);
                found.push((p, q, LinkPair { a, b, pair: index as u32 }));
            }
        }
        found.sort_by_key(|(p, q, pair)| (*p, *q, pair.pair));
        for (p, q, pair) in found {
            let at = self.link_pairs.len() as u32;
            match self.bodies.last_mut() {
                Some(last) if (last.a, last.b) == (p, q) => last.pairs.1 = at + 1,
                _ => self.bodies.push(BodyPair { a: p, b: q, pairs: (at, at + 1) }),
            }
            self.link_pairs.push(pair);
        }
    }

    /// Returns a pair that touches at one of the samples of a motion.
    ///
    /// # Panics
    /// If a slice is too short.
    pub fn touching(&self, motion: &Motion<'_>, buffers: &mut Buffers) -> Option<u32> {
        let scene = &*self.scene;
        assert!(motion.from.len() >= scene.variables && motion.to.len() >= scene.variables, "a configuration is whole");
        assert!(motion.pads.len() >= scene.pairs.len(), "every pair has a padding");
        if let Proof::Motion { reach, .. } = motion.proof {
            assert!(reach.len() >= scene.pairs.len(), "every pair has a reach");
        }
        self.make_room(buffers);
        match scene.width.0 {
            // SAFETY: only `Width` makes one, and only of vectors that this processor has.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { avx512(self, motion, buffers) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { avx2(self, motion, buffers) },
            Vectors::Portable => check::check::<crate::block::Portable>(self, motion, buffers),
        }
    }

    /// Returns the lanes of `sought` in which something touches. The sixteen configurations are independent of each
    /// other: `q` has one entry per variable. `pads` and `pad` are those of a [`Motion`].
    ///
    /// # Panics
    /// If a slice is too short.
    pub fn touching_lanes(&self, q: &[Lanes], (pads, pad): (&[f64], f64), sought: u16, buffers: &mut Buffers) -> u16 {
        let scene = &*self.scene;
        assert!(q.len() >= scene.variables, "a configuration is whole");
        assert!(pads.len() >= scene.pairs.len(), "every pair has a padding");
        self.make_room(buffers);
        buffers.q.copy_from_slice(&q[..scene.variables]);
        // Buffers may have been used for another scene.
        buffers.frequent.retain(|pair| (*pair as usize) < scene.pairs.len());
        let none = &[][..];
        let motion =
            Motion { from: none, to: none, blocks: 1, skipped: 0, pads, pad, likely: None, proof: Proof::None };
        match scene.width.0 {
            // SAFETY: only `Width` makes one, and only of vectors that this processor has.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { each_avx512(self, &motion, sought, buffers) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { each_avx2(self, &motion, sought, buffers) },
            Vectors::Portable => check::check_each::<crate::block::Portable>(self, &motion, sought, buffers),
        }
    }

    fn make_room(&self, buffers: &mut Buffers) {
        // Most often there is room: then nothing is made to fill it.
        let zero = Lanes::splat(0.0);
        buffers.q.resize(self.scene.variables, zero);
        buffers.frames.resize_with(self.scene.bodies.len(), || [zero; 12]);
        buffers.centers.resize_with(self.carried.len(), || [zero; 3]);
    }
}

/// Returns a ball around trees.
fn around<'a>(trees: impl Iterator<Item = &'a Tree>) -> ([f32; 3], f32) {
    let roots: Vec<Node> = trees.filter_map(|tree| tree.nodes.first().copied()).collect();
    match roots[..] {
        [] => ([0.0; 3], 0.0),
        [only] => (only.center, only.radius),
        _ => enclosing(&roots),
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn avx512(discrete: &Discrete, motion: &Motion<'_>, buffers: &mut Buffers) -> Option<u32> {
    check::check::<crate::block::x86::Avx512>(discrete, motion, buffers)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2(discrete: &Discrete, motion: &Motion<'_>, buffers: &mut Buffers) -> Option<u32> {
    check::check::<crate::block::x86::Avx2>(discrete, motion, buffers)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn each_avx512(discrete: &Discrete, motion: &Motion<'_>, sought: u16, buffers: &mut Buffers) -> u16 {
    check::check_each::<crate::block::x86::Avx512>(discrete, motion, sought, buffers)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn each_avx2(discrete: &Discrete, motion: &Motion<'_>, sought: u16, buffers: &mut Buffers) -> u16 {
    check::check_each::<crate::block::x86::Avx2>(discrete, motion, sought, buffers)
}

#[cfg(test)]
mod tests;

//! Pairs of links, and of links and obstacles, proven apart: at sixteen configurations, each with a stretch
//! of motion about it.
//!
//! A pair is apart in a lane if the balls of both covers are farther from each other than a margin: the pair's padding,
//! and the most that both can approach each other on the stretch. Balls that are not are replaced by their parts. A
//! pair whose smallest balls are too close is left to the caller, who can be exact. A pair touches in the middle of a
//! stretch if balls that are inside of both are closer than its padding.

use std::sync::Arc;

use crate::block::{Block, Lanes, Portable};
use crate::bodies::{Body, Frames, Prepared, between, carried, forward, point, seen_from};
use crate::cover::{Node, Tree};
use crate::obstacle::{BoxCore, Core, CylinderCore, Obstacle, Placed, Squared};
use crate::width::{Vectors, Width};

/// Errors of single precision: a constant part [m], and one per metre of distance from the origin. Frames are a product
/// of up to some twenty rotations, each rounded to 6e-8; measured errors are a tenth of this. One body as it is seen
/// from another adds one product.
const ROUNDING: (f64, f64) = (1e-5, 4e-6);
/// Most balls, or pairs of them, that are replaced by their parts for one pair; the rest is left to the caller. More
/// would take longer than to be exact.
const VISITS: usize = 48;
/// A ball is good enough if it is outside of its solid by no more than this part of the motion on half a stretch.
const FINE: f32 = 0.5;
/// Most balls that wait for their turn: each visit removes one and adds two. Trees are not deeper, so that it also
/// holds for more visits.
const STACK: usize = VISITS + 2;

/// A link: its cover, carried by a body.
#[derive(Debug, Clone)]
pub struct Link {
    /// Index of the body.
    pub body: usize,
    /// The balls, in the body's frame.
    pub tree: Arc<Tree>,
    /// The farthest that any of its points gets from the origin of the world [m].
    pub extent: f64,
}

/// A pair that may touch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Pair {
    /// Two links, by index.
    Links(usize, usize),
    /// A link and an obstacle, by index.
    Obstacle(usize, usize),
}

/// The other member of a pair with a link.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Other {
    Link(usize),
    /// Core and radius.
    Box(BoxCore, f32),
    /// Core and radius.
    Cylinder(CylinderCore, f32),
    /// Body and index in `trees`, and the radius.
    Cover(usize, usize, f32),
}

/// A pair, prepared.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Compared {
    pub link: usize,
    pub other: Other,
    /// Index of the obstacle, if it is one.
    pub obstacle: Option<usize>,
    /// Largest error of the distance [m].
    pub rounding: f32,
}

/// Robots and obstacles, prepared for lanes.
#[derive(Debug, Clone)]
pub struct Scene {
    pub(crate) bodies: Vec<Body>,
    pub(crate) prepared: Prepared,
    pub(crate) links: Vec<Link>,
    pub(crate) trees: Vec<Arc<Tree>>,
    pub(crate) pairs: Vec<Compared>,
    pub(crate) variables: usize,
    pub(crate) width: Width,
}

/// Sixteen stretches of motion.
#[derive(Debug, Clone, Copy)]
pub struct Stretches<'a> {
    /// The configuration in the middle of each stretch: one entry per variable [rad or m].
    pub q: &'a [Lanes],
    /// Half of the length of each, as a part of the motion.
    pub half: f32,
    /// Lanes in use, as bits.
    pub lanes: u16,
    /// For each pair of the scene, the most that it can approach on the whole motion [m].
    pub reach: &'a [f64],
    /// For each pair of the scene, its padding [m].
    pub pads: &'a [f64],
    /// A pair that is likely to touch: it is compared first.
    pub likely: Option<u32>,
    /// Whether to end at a pair that surely touches; otherwise it is one that is close.
    pub ends_at_touch: bool,
}

/// Buffers of a query.
#[derive(Debug, Clone, Default)]
pub struct Buffers {
    frames: Vec<Frames>,
}

impl Scene {
    /// Prepares robots and obstacles.
    ///
    /// # Panics
    /// If an index is out of range, or a body does not follow its parent.
    pub fn new(bodies: Vec<Body>, links: Vec<Link>, obstacles: &[Obstacle], pairs: &[Pair], width: Width) -> Self {
        let mut variables = 0;
        for (i, body) in bodies.iter().enumerate() {
            if let Body::Moving { parent, joint } = body {
                assert!(*parent < i, "a body follows its parent");
                variables = variables.max(joint.variable + 1);
            }
        }
        assert!(links.iter().all(|link| link.body < bodies.len()), "a link has a body");
        let mut trees = Vec::new();
        let others: Vec<Other> = obstacles
            .iter()
            .map(|obstacle| {
                let radius = obstacle.radius as f32;
                match &obstacle.core {
                    Core::Box { frame, half } => {
                        Other::Box(BoxCore { placed: Placed::new(frame), half: half.map(|x| x as f32) }, radius)
                    }
                    Core::Cylinder { frame, half, radius: around } => {
                        let (half, around) = (*half as f32, *around as f32);
                        Other::Cylinder(CylinderCore { placed: Placed::new(frame), half, radius: around }, radius)
                    }
                    Core::Cover { body, tree, .. } => {
                        assert!(*body < bodies.len(), "a cover has a body");
                        trees.push(tree.clone());
                        Other::Cover(*body, trees.len() - 1, radius)
                    }
                }
            })
            .collect();
        let pairs = pairs
            .iter()
            .map(|pair| match *pair {
                Pair::Links(a, b) => {
                    assert!(a < links.len() && b < links.len(), "a pair has two links");
                    let rounding = rounding(links[a].extent, links[b].extent);
                    Compared { link: a, other: Other::Link(b), obstacle: None, rounding }
                }
                Pair::Obstacle(link, obstacle) => {
                    assert!(link < links.len(), "a pair has a link");
                    let rounding = rounding(links[link].extent, obstacles[obstacle].extent());
                    Compared { link, other: others[obstacle], obstacle: Some(obstacle), rounding }
                }
            })
            .collect();
        Self { prepared: Prepared::new(&bodies), bodies, links, trees, pairs, variables, width }
    }

    /// Returns the box around an obstacle in the world: its lowest and highest corner [m], rounded outwards.
    pub(crate) fn bounds(&self, other: &Other) -> ([f32; 3], [f32; 3]) {
        match other {
            Other::Box(core, radius) => core.placed.bounds(core.half, *radius),
            Other::Cylinder(core, radius) => core.placed.bounds([core.radius, core.radius, core.half], *radius),
            Other::Cover(body, tree, radius) => match (&self.bodies[*body], self.trees[*tree].nodes.first()) {
                (Body::Fixed(frame), Some(root)) => {
                    let placed = Placed::new(frame);
                    placed.moved(root.center).bounds([0.0; 3], root.radius + radius)
                }
                _ => ([f32::NEG_INFINITY; 3], [f32::INFINITY; 3]),
            },
            Other::Link(_) => ([f32::NEG_INFINITY; 3], [f32::INFINITY; 3]),
        }
    }

    /// Adds the pairs that are not proven apart to `close`, each with its lanes as bits; considers only `pairs`. Ends
    /// and returns the pair if one surely touches in the middle of a stretch.
    ///
    /// # Panics
    /// If a slice is too short, or a pair is out of range.
    pub fn close(
        &self,
        stretches: &Stretches<'_>,
        pairs: &[u32],
        buffers: &mut Buffers,
        close: &mut Vec<(u32, u16)>,
    ) -> Option<u32> {
        assert!(stretches.q.len() >= self.variables, "a configuration has {} entries", self.variables);
        buffers.frames.resize(self.bodies.len(), [Lanes::splat(0.0); 12]);
        match self.width.0 {
            // SAFETY: only `Width` makes one, and only of vectors that this processor has.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { avx512(self, stretches, pairs, buffers, close) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { avx2(self, stretches, pairs, buffers, close) },
            Vectors::Portable => find::<Portable>(self, stretches, pairs, buffers, close),
        }
    }
}

fn rounding(one: f64, other: f64) -> f32 {
    (ROUNDING.0 + ROUNDING.1 * (one + other)) as f32
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,fma")]
fn avx512(
    scene: &Scene,
    stretches: &Stretches<'_>,
    pairs: &[u32],
    buffers: &mut Buffers,
    close: &mut Vec<(u32, u16)>,
) -> Option<u32> {
    find::<crate::block::x86::Avx512>(scene, stretches, pairs, buffers, close)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
fn avx2(
    scene: &Scene,
    stretches: &Stretches<'_>,
    pairs: &[u32],
    buffers: &mut Buffers,
    close: &mut Vec<(u32, u16)>,
) -> Option<u32> {
    find::<crate::block::x86::Avx2>(scene, stretches, pairs, buffers, close)
}

/// Lanes as bits.
#[derive(Clone, Copy)]
struct Found {
    /// In these the pair is not proven apart.
    close: u16,
    /// In these it touches.
    touch: u16,
}

#[inline(always)]
fn find<B: Block>(
    scene: &Scene,
    stretches: &Stretches<'_>,
    pairs: &[u32],
    buffers: &mut Buffers,
    close: &mut Vec<(u32, u16)>,
) -> Option<u32> {
    forward::<B>(&scene.prepared, stretches.q, &mut buffers.frames);
    let frames = &buffers.frames;
    let mut current = usize::MAX;
    let mut center = [B::splat(0.0); 3];
    for i in 0..=pairs.len() {
        let index = if i == 0 { stretches.likely } else { Some(pairs[i - 1]) };
        let Some(index) = index else { continue };
        let Compared { link: at, other, rounding, .. } = &scene.pairs[index as usize];
        let link = &scene.links[*at];
        let (frame, nodes) = (&frames[link.body], &link.tree.nodes[..]);
        let Some(root) = nodes.first() else {
            if i != 0 {
                close.push((index, stretches.lanes));
            }
            continue;
        };
        if current != *at {
            (current, center) = (*at, point(frame, &root.center));
        }
        let (pad, reach) = (stretches.pads[index as usize] as f32, stretches.reach[index as usize] as f32);
        let moved = stretches.half * reach;
        let outer = B::splat(pad + rounding + moved);
        let inner = if stretches.ends_at_touch { pad - rounding } else { f32::NEG_INFINITY };
        let gap = Gap { outer, inner, fine: moved * FINE, visits: VISITS };
        let found = compare(scene, frames, link, other, &center, &gap, stretches.lanes);
        if found.touch != 0 {
            return Some(index);
        }
        if found.close != 0 && i != 0 {
            close.push((index, found.close));
        }
    }
    None
}

/// Compares a link, whose largest ball is at `center`, with something else.
#[inline(always)]
fn compare<B: Block>(
    scene: &Scene,
    frames: &[Frames],
    link: &Link,
    other: &Other,
    center: &[B; 3],
    gap: &Gap<B>,
    lanes: u16,
) -> Found {
    let (frame, nodes) = (&frames[link.body], &link.tree.nodes[..]);
    match other {
        Other::Box(core, radius) => to_core(frame, nodes, center, &gap.more(*radius), lanes, core),
        Other::Cylinder(core, radius) => to_core(frame, nodes, center, &gap.more(*radius), lanes, core),
        Other::Cover(body, tree, radius) => {
            to_cover(frame, nodes, &frames[*body], &scene.trees[*tree].nodes, &gap.more(*radius), lanes)
        }
        Other::Link(b) => {
            let b = &scene.links[*b];
            to_cover(frame, nodes, &frames[b.body], &b.tree.nodes, gap, lanes)
        }
    }
}

/// Distances that decide for two balls: apart beyond `outer`, touching within `inner` [m].
#[derive(Clone, Copy)]
struct Gap<B> {
    outer: B,
    inner: f32,
    /// A ball that is outside of its solid by no more than this is not replaced by its parts.
    fine: f32,
    /// Most balls, or pairs of them, that are replaced by their parts.
    visits: usize,
}

impl<B: Block> Gap<B> {
    #[inline(always)]
    fn more(&self, radius: f32) -> Self {
        Self { outer: self.outer.add(B::splat(radius)), inner: self.inner + radius, ..*self }
    }

    /// Compares the squared distance of the centres of a ball and something else; `inner` is negative without an inner
    /// ball.
    #[inline(always)]
    fn compare(&self, squared: B, radius: f32, inner: f32, lanes: u16) -> Found {
        let reach = self.outer.add(B::splat(radius));
        let close = !B::bits(B::less(reach.mul(reach), squared)) & lanes;
        let within = if inner < 0.0 { 0.0 } else { (inner + self.inner).max(0.0) };
        let touch = if close == 0 || within == 0.0 { 0 } else { B::bits(B::less(squared, B::splat(within * within))) };
        Found { close, touch: touch & lanes }
    }

    /// Compares two balls whose centres have this squared distance.
    #[inline(always)]
    fn compare_balls(&self, squared: B, one: &Node, two: &Node, lanes: u16) -> Found {
        let inner = if one.inner.min(two.inner) < 0.0 { -1.0 } else { one.inner + two.inner };
        self.compare(squared, one.radius + two.radius, inner, lanes)
    }

    /// Returns whether two balls are not replaced by their parts: they have none, or are fine enough.
    #[inline(always)]
    fn are_last(&self, one: &Node, two: &Node) -> bool {
        (one.count == 0 && two.count == 0) || one.radius - one.inner + two.radius - two.inner <= self.fine
    }
}

/// Finds the lanes in which the smallest balls of a cover are close to a core.
#[inline(always)]
fn to_core<B: Block, C: Squared>(
    frame: &Frames,
    nodes: &[Node],
    center: &[B; 3],
    gap: &Gap<B>,
    lanes: u16,
    core: &C,
) -> Found {
    let all = gap.compare(core.squared(center), nodes[0].radius, nodes[0].inner, lanes);
    if all.close == 0 || all.touch != 0 || nodes[0].count == 0 || nodes[0].radius - nodes[0].inner <= gap.fine {
        return all;
    }
    let mut close = 0;
    let mut stack = [(0, 0); STACK];
    let (mut open, mut visits) = (1, 0);
    stack[0] = (0, all.close);
    while open > 0 {
        open -= 1;
        let (at, lanes) = stack[open];
        let lanes = lanes & !close;
        if lanes == 0 {
            continue;
        }
        visits += 1;
        if visits > gap.visits {
            close |= lanes;
            continue;
        }
        let parent = &nodes[at as usize];
        for i in parent.first..parent.first + parent.count {
            let node = &nodes[i as usize];
            let found = gap.compare(core.squared(&point(frame, &node.center)), node.radius, node.inner, lanes);
            if found.touch != 0 {
                return found;
            }
            if found.close == 0 {
                continue;
            }
            if node.count == 0 || node.radius - node.inner <= gap.fine || open == STACK {
                close |= found.close;
            } else {
                stack[open] = (i, found.close);
                open += 1;
            }
        }
    }
    Found { close, touch: 0 }
}

/// Finds the lanes in which the smallest balls of two covers are close to each other.
#[inline(always)]
fn to_cover<B: Block>(f: &Frames, a: &[Node], g: &Frames, b: &[Node], gap: &Gap<B>, lanes: u16) -> Found {
    let (Some(one), Some(two)) = (a.first(), b.first()) else { return Found { close: lanes, touch: 0 } };
    let squared = between(&point::<B>(f, &one.center), &point(g, &two.center));
    let all = gap.compare_balls(squared, one, two, lanes);
    if all.close == 0 || all.touch != 0 || gap.are_last(one, two) {
        return all;
    }
    let f = seen_from::<B>(f, g);
    let mut close = 0;
    let mut stack = [(0, 0, 0); STACK];
    let (mut open, mut visits) = (1, 0);
    stack[0] = (0, 0, all.close);
    while open > 0 {
        open -= 1;
        let (i, j, lanes) = stack[open];
        let lanes = lanes & !close;
        if lanes == 0 {
            continue;
        }
        visits += 1;
        if visits > gap.visits {
            close |= lanes;
            continue;
        }
        let (one, two) = (&a[i as usize], &b[j as usize]);
        // The larger ball is replaced by its parts.
        let first = one.count != 0 && (two.count == 0 || one.radius >= two.radius);
        let (parent, rest, nodes) = if first { (one, two, a) } else { (two, one, b) };
        let center = carried::<B>(!first, &f, &rest.center);
        let (start, end) = (parent.first, parent.first + parent.count);
        // Two at a time: neither waits for the other.
        for at in (start..end).step_by(2) {
            let (x, y) = (&nodes[at as usize], &nodes[(at + 1).min(end - 1) as usize]);
            let from_x = between(&carried::<B>(first, &f, &x.center), &center);
            let from_y = between(&carried::<B>(first, &f, &y.center), &center);
            let of_x = gap.compare_balls(from_x, x, rest, lanes);
            let of_y = gap.compare_balls(from_y, y, rest, if at + 1 < end { lanes } else { 0 });
            for (part, node, found) in [(at, x, of_x), (at + 1, y, of_y)] {
                if found.touch != 0 {
                    return found;
                }
                if found.close == 0 {
                    continue;
                }
                if open == STACK || gap.are_last(node, rest) {
                    close |= found.close;
                } else {
                    stack[open] = if first { (part, j, found.close) } else { (i, part, found.close) };
                    open += 1;
                }
            }
        }
    }
    Found { close, touch: 0 }
}

mod sweep;

pub use sweep::{Levers, Pieces};

#[cfg(test)]
mod tests;

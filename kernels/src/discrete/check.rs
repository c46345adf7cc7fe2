//! The check itself, for one width.

use crate::apart::{Compared, Other, Scene};
use crate::block::{Block, LANES, Lanes};
use crate::bodies::{Frames, between, forward, point};
use crate::cover::Node;
use crate::obstacle::Squared;

use super::{Buffers, Carried, Discrete, Motion, NO_PAIR, Proof, Standing};

/// Most balls that wait to be replaced by their parts, for one pair; a pair that needs more counts as touching.
const STACK: usize = 64;
/// How much nearer than their radii balls count as touching.
#[derive(Debug, Clone, Copy)]
struct Gap {
    /// Padding and bulge [m].
    more: f32,
    /// Square of half of a chord [m²].
    squared: f32,
    /// Padding, without the rest [m].
    pad: f32,
    rounding: f32,
}

impl Gap {
    #[inline(always)]
    fn new(pad: f32, reach: f32, steps: &Steps) -> Self {
        let chord = reach * steps.part;
        // The second derivative of a place is at most twice the product of what turns and what moves.
        let bulge = 0.25 * steps.turn * chord;
        Self { more: pad + bulge, squared: 0.25 * chord * chord, pad, rounding: steps.rounding }
    }

    /// Returns the squared distance below which a ball touches.
    #[inline(always)]
    fn squared(&self, radius: f32) -> f32 {
        let radius = radius + self.more;
        let reach = radius.mul_add(radius, self.squared).sqrt() + self.rounding;
        reach * reach
    }

    #[inline(always)]
    fn more(&self, radius: f32) -> Self {
        Self { more: self.more + radius, pad: self.pad + radius, ..*self }
    }
}

/// The steps between samples.
#[derive(Debug, Clone, Copy)]
struct Steps {
    /// The part of the motion between two samples, if it is swept.
    part: f32,
    /// The sum of the angles by which the joints turn on it [rad].
    turn: f32,
    rounding: f32,
}

#[inline(always)]
fn reach_of(motion: &Motion<'_>, pair: u32) -> f32 {
    match motion.proof {
        Proof::Motion { reach, .. } => reach[pair as usize] as f32,
        _ => 0.0,
    }
}

#[inline(always)]
fn gap_of(motion: &Motion<'_>, pair: u32, steps: &Steps) -> Gap {
    Gap::new(motion.pads[pair as usize] as f32, reach_of(motion, pair), steps)
}

/// Returns a pair that touches in any lane of any block.
#[inline(always)]
pub(super) fn check<B: Block>(discrete: &Discrete, motion: &Motion<'_>, buffers: &mut Buffers) -> Option<u32> {
    let scene = &*discrete.scene;
    let blocks = motion.blocks.max(1);
    let (first, part, steps) = match motion.proof {
        Proof::Motion { turn, .. } => {
            let part = 1.0 / (LANES * blocks - 1) as f32;
            (1, part, Steps { part, turn: turn as f32 * part, rounding: discrete.rounding })
        }
        Proof::Samples => {
            (0, 1.0 / (LANES * blocks) as f32, Steps { part: 0.0, turn: 0.0, rounding: discrete.rounding })
        }
        Proof::None => (0, 1.0 / (LANES * blocks) as f32, Steps { part: 0.0, turn: 0.0, rounding: 0.0 }),
    };
    for block in 0..blocks {
        // Samples number i, in lane k: i = (k + 1) · blocks − block, from 1.
        for j in 0..scene.variables {
            let (from, to) = (motion.from[j], motion.to[j]);
            let (start, delta) = (from as f32, (to - from) as f32);
            let mut lanes = [0.0; LANES];
            for k in 0..LANES {
                let i = (k + 1) * blocks - block - first;
                lanes[k] = (i as f32 * part).mul_add(delta, start);
            }
            buffers.q[j] = Lanes(lanes);
        }
        let found = check_block::<B>(discrete, motion, block == 0, &steps, buffers);
        if found.is_some() {
            return found;
        }
    }
    None
}

#[inline(always)]
fn check_block<B: Block>(
    discrete: &Discrete,
    motion: &Motion<'_>,
    first: bool,
    steps: &Steps,
    buffers: &mut Buffers,
) -> Option<u32> {
    let scene = &*discrete.scene;
    forward::<B>(&scene.prepared, &buffers.q, &mut buffers.frames);
    let frames = &buffers.frames[..];
    if let Some(likely) = motion.likely.filter(|_| first) {
        let Compared { link, other, .. } = &scene.pairs[likely as usize];
        let (link, gap) = (&scene.links[*link], gap_of(motion, likely, steps));
        if pair_touches::<B>(scene, frames, link.body, &link.tree.nodes, other, &gap, false) {
            return Some(likely);
        }
    }
    let most = motion.pad as f32;
    for number in 0..discrete.carried.len() {
        let carried = &discrete.carried[number];
        let center = point::<B>(&frames[carried.body], &carried.center);
        for i in 0..3 {
            center[i].store(&mut buffers.centers[number][i]);
        }
        if carried.groups.0 == carried.groups.1 {
            continue;
        }
        let mut reach = 0.0_f32;
        if steps.part != 0.0 {
            for member in carried.links.0..carried.links.1 {
                let pair = discrete.links[member as usize].pair;
                reach = if pair == NO_PAIR { reach } else { reach.max(reach_of(motion, pair)) };
            }
        }
        let gap = Gap::new(most, reach, steps);
        let around = gap.squared(carried.radius).sqrt();
        let (mut low, mut high) = ([B::splat(0.0); 3], [B::splat(0.0); 3]);
        for i in 0..3 {
            low[i] = B::splat(-center[i].neg().largest() - around);
            high[i] = B::splat(center[i].largest() + around);
        }
        for group in carried.groups.0..carried.groups.1 {
            let boxes = &discrete.boxes[group as usize];
            let mut apart = 0;
            for i in 0..3 {
                apart |= B::bits(B::less(high[i], B::load(&boxes.low[i])));
                apart |= B::bits(B::less(B::load(&boxes.high[i]), low[i]));
            }
            let mut close = !apart;
            while close != 0 {
                let lane = close.trailing_zeros();
                close &= close - 1;
                let at = carried.obstacles.0 + (group - carried.groups.0) * LANES as u32 + lane;
                if at >= carried.obstacles.1 {
                    break;
                }
                let standing = &discrete.obstacles[at as usize];
                if !near::<B>(scene, frames, &standing.other, &center, &gap.more(carried.radius)) {
                    continue;
                }
                let found = body_touches::<B>(discrete, motion, frames, carried, standing, steps);
                if found.is_some() {
                    return found;
                }
            }
        }
    }
    for bodies in &discrete.bodies {
        let pairs = &discrete.link_pairs[bodies.pairs.0 as usize..bodies.pairs.1 as usize];
        let (a, b) = (&buffers.centers[bodies.a as usize], &buffers.centers[bodies.b as usize]);
        let (one, two) = (&discrete.carried[bodies.a as usize], &discrete.carried[bodies.b as usize]);
        let squared = between(&load::<B>(a), &load(b));
        let mut reach = 0.0_f32;
        if steps.part != 0.0 {
            for pair in pairs {
                reach = reach.max(reach_of(motion, pair.pair));
            }
        }
        if !any_below::<B>(squared, Gap::new(most, reach, steps).squared(one.radius + two.radius)) {
            continue;
        }
        let (f, g) = (&frames[one.body], &frames[two.body]);
        for pair in pairs {
            let (a, b) = (&discrete.links[pair.a as usize].tree.nodes, &discrete.links[pair.b as usize].tree.nodes);
            if covers_touch::<B>(f, a, g, b, &gap_of(motion, pair.pair, steps)) {
                return Some(pair.pair);
            }
        }
    }
    None
}

/// Returns a pair of a body's links and an obstacle that touches in any lane.
#[inline(always)]
fn body_touches<B: Block>(
    discrete: &Discrete,
    motion: &Motion<'_>,
    frames: &[Frames],
    carried: &Carried,
    standing: &Standing,
    steps: &Steps,
) -> Option<u32> {
    let (first, last) = carried.links;
    for member in first..last {
        let pair = discrete.pairs[(standing.pairs + member - first) as usize];
        if pair == NO_PAIR {
            continue;
        }
        let (nodes, gap) = (&discrete.links[member as usize].tree.nodes, gap_of(motion, pair, steps));
        // The ball of the only link of a body is that of the body: it is near.
        let only = last - first == 1;
        if pair_touches::<B>(&discrete.scene, frames, carried.body, nodes, &standing.other, &gap, only) {
            return Some(pair);
        }
    }
    None
}

#[inline(always)]
fn load<B: Block>(point: &[Lanes; 3]) -> [B; 3] {
    [B::load(&point[0]), B::load(&point[1]), B::load(&point[2])]
}

/// Returns whether a number is smaller than another in any lane; so is what is not a number.
#[inline(always)]
fn any_below<B: Block>(squared: B, limit: f32) -> bool {
    B::bits(B::less(B::splat(limit), squared)) != u16::MAX
}

/// Returns whether points are nearer to an obstacle than a distance in any lane.
#[inline(always)]
fn near<B: Block>(scene: &Scene, frames: &[Frames], other: &Other, center: &[B; 3], gap: &Gap) -> bool {
    match other {
        Other::Box(core, radius) => any_below::<B>(core.squared(center), gap.squared(*radius)),
        Other::Cylinder(core, radius) => any_below::<B>(core.squared(center), gap.squared(*radius)),
        Other::Cover(body, tree, radius) => {
            let Some(root) = scene.trees[*tree].nodes.first() else { return true };
            let squared = between(&point::<B>(&frames[*body], &root.center), center);
            any_below::<B>(squared, gap.squared(*radius + root.radius))
        }
        Other::Link(_) => true,
    }
}

/// Returns whether a cover touches something in any lane; `near`: its largest ball is known to do so.
#[inline(always)]
fn pair_touches<B: Block>(
    scene: &Scene,
    frames: &[Frames],
    body: usize,
    nodes: &[Node],
    other: &Other,
    gap: &Gap,
    near: bool,
) -> bool {
    let frame = &frames[body];
    match other {
        Other::Box(core, radius) => cover_touches::<B, _>(frame, nodes, &gap.more(*radius), core, near),
        Other::Cylinder(core, radius) => cover_touches::<B, _>(frame, nodes, &gap.more(*radius), core, near),
        Other::Cover(fixed, tree, radius) => {
            covers_touch::<B>(frame, nodes, &frames[*fixed], &scene.trees[*tree].nodes, &gap.more(*radius))
        }
        Other::Link(other) => {
            let other = &scene.links[*other];
            covers_touch::<B>(frame, nodes, &frames[other.body], &other.tree.nodes, gap)
        }
    }
}

/// Returns whether the smallest balls of a cover touch a core in any lane.
#[inline(always)]
fn cover_touches<B: Block, C: Squared>(frame: &Frames, nodes: &[Node], gap: &Gap, core: &C, near: bool) -> bool {
    let Some(root) = nodes.first() else { return true };
    let mut stack = [0; STACK];
    let mut open = 1;
    if near && root.count != 0 {
        open = 0;
        for part in root.first..root.first + root.count.min(STACK as u32) {
            stack[open] = part;
            open += 1;
        }
    }
    while open > 0 {
        open -= 1;
        let node = &nodes[stack[open] as usize];
        let squared = core.squared(&point::<B>(frame, &node.center));
        if !any_below::<B>(squared, gap.squared(node.radius)) {
            continue;
        }
        if node.count == 0 || open + node.count as usize > STACK || surely::<B>(squared, node.inner, gap) {
            return true;
        }
        for part in node.first..node.first + node.count {
            stack[open] = part;
            open += 1;
        }
    }
    false
}

/// Returns whether balls inside of solids touch in any lane.
#[inline(always)]
fn surely<B: Block>(squared: B, inner: f32, gap: &Gap) -> bool {
    let within = inner + gap.pad;
    inner >= 0.0 && B::bits(B::less(squared, B::splat(within * within))) != 0
}

/// Returns whether the smallest balls of two covers touch in any lane.
#[inline(always)]
fn covers_touch<B: Block>(f: &Frames, a: &[Node], g: &Frames, b: &[Node], gap: &Gap) -> bool {
    if a.is_empty() || b.is_empty() {
        return true;
    }
    let mut stack = [(0, 0); STACK];
    let mut open = 1;
    while open > 0 {
        open -= 1;
        let (i, j) = stack[open];
        let (one, two) = (&a[i as usize], &b[j as usize]);
        let squared = between(&point::<B>(f, &one.center), &point(g, &two.center));
        if !any_below::<B>(squared, gap.squared(one.radius + two.radius)) {
            continue;
        }
        // The larger ball is replaced by its parts.
        let first = one.count != 0 && (two.count == 0 || one.radius >= two.radius);
        let parent = if first { one } else { two };
        let inner = if one.inner.min(two.inner) < 0.0 { -1.0 } else { one.inner + two.inner };
        if parent.count == 0 || open + parent.count as usize > STACK || surely::<B>(squared, inner, gap) {
            return true;
        }
        for part in parent.first..parent.first + parent.count {
            stack[open] = if first { (part, j) } else { (i, part) };
            open += 1;
        }
    }
    false
}

//! Where covers touch obstacles and each other, from their largest balls to the smallest.

use crate::apart::{Other, Scene};
use crate::block::Block;
use crate::bodies::{Frames, between, point};
use crate::cover::Node;
use crate::obstacle::Squared;

use super::gap::Gap;

/// Most balls that wait to be replaced by their parts, for one pair. A pair that needs more counts as touching, unless
/// each lane counts: then nothing is said of its lanes.
const STACK: usize = 64;

/// Lanes in which something touches. All that is sought is the first of them, or for `EACH` lane whether it is one.
pub(super) struct Touching {
    sought: u16,
    /// Those found so far.
    pub lanes: u16,
}

impl Touching {
    #[inline(always)]
    pub fn among(sought: u16) -> Self {
        Self { sought, lanes: 0 }
    }

    /// The lanes that are still to be checked.
    #[inline(always)]
    pub fn left<const EACH: bool>(&self) -> u16 {
        // Until the first one is found, these are all: a constant, which costs nothing.
        if EACH { self.sought & !self.lanes } else { u16::MAX }
    }

    /// Takes lanes that touch; returns whether no more are sought.
    #[inline(always)]
    pub fn ends<const EACH: bool>(&mut self, lanes: u16) -> bool {
        self.lanes |= lanes;
        lanes != 0 && (!EACH || self.left::<EACH>() == 0)
    }
}

/// Returns the lanes in which a number is smaller than another; so is what is not a number.
#[inline(always)]
pub(super) fn below<B: Block>(squared: B, limit: f32) -> u16 {
    !B::bits(B::less(B::splat(limit), squared))
}

/// Returns the lanes in which points are nearer to an obstacle than a distance.
#[inline(always)]
pub(super) fn near<B: Block, const SWEPT: bool>(
    scene: &Scene,
    frames: &[Frames],
    other: &Other,
    center: &[B; 3],
    gap: &Gap<SWEPT>,
) -> u16 {
    match other {
        Other::Box(core, radius) => below::<B>(core.squared(center), gap.squared(*radius)),
        Other::Cylinder(core, radius) => below::<B>(core.squared(center), gap.squared(*radius)),
        Other::Cover(body, tree, radius) => {
            let Some(root) = scene.trees[*tree].nodes.first() else { return u16::MAX };
            let squared = between(&point::<B>(&frames[*body], &root.center), center);
            below::<B>(squared, gap.squared(*radius + root.radius))
        }
        Other::Link(_) => u16::MAX,
    }
}

/// Returns the lanes of `left` in which a cover touches something; unless for `EACH` lane, not all of them. `near`: its
/// largest ball is known to do so.
#[inline(always)]
pub(super) fn pair_touches<B: Block, const EACH: bool, const SWEPT: bool>(
    scene: &Scene,
    frames: &[Frames],
    body: usize,
    nodes: &[Node],
    other: &Other,
    gap: &Gap<SWEPT>,
    (near, left): (bool, u16),
) -> u16 {
    let frame = &frames[body];
    match other {
        Other::Box(core, radius) => {
            cover_touches::<B, _, EACH, SWEPT>(frame, nodes, &gap.more(*radius), core, (near, left))
        }
        Other::Cylinder(core, radius) => {
            cover_touches::<B, _, EACH, SWEPT>(frame, nodes, &gap.more(*radius), core, (near, left))
        }
        Other::Cover(fixed, tree, radius) => {
            let (fixed, other) = (&frames[*fixed], &scene.trees[*tree].nodes);
            covers_touch::<B, EACH, SWEPT>(frame, nodes, fixed, other, &gap.more(*radius), left)
        }
        Other::Link(other) => {
            let other = &scene.links[*other];
            covers_touch::<B, EACH, SWEPT>(frame, nodes, &frames[other.body], &other.tree.nodes, gap, left)
        }
    }
}

/// Returns lanes of `left` in which the smallest balls of a cover touch a core.
#[inline(always)]
fn cover_touches<B: Block, C: Squared, const EACH: bool, const SWEPT: bool>(
    frame: &Frames,
    nodes: &[Node],
    gap: &Gap<SWEPT>,
    core: &C,
    (near, left): (bool, u16),
) -> u16 {
    let Some(root) = nodes.first() else { return left };
    let mut touching = Touching::among(left);
    // For each ball the lanes in which it may be close: the result of a lane does not depend on the others.
    let (mut stack, mut stack_lanes) = ([0; STACK], [0; STACK]);
    stack_lanes[0] = u16::MAX;
    let mut open = 1;
    if near && root.count != 0 {
        open = 0;
        for part in root.first..root.first + root.count.min(STACK as u32) {
            (stack[open], stack_lanes[open]) = (part, u16::MAX);
            open += 1;
        }
    }
    while open > 0 {
        open -= 1;
        let node = &nodes[stack[open] as usize];
        let squared = core.squared(&point::<B>(frame, &node.center));
        let lanes = if EACH { stack_lanes[open] } else { u16::MAX } & touching.left::<EACH>();
        let close = below::<B>(squared, gap.squared(node.radius)) & lanes;
        if close == 0 {
            continue;
        }
        let Some(close) =
            settle::<B, EACH, SWEPT>(squared, (node.inner, gap), (node.count, open), close, &mut touching)
        else {
            break;
        };
        if close == 0 {
            continue;
        }
        for part in node.first..node.first + node.count {
            (stack[open], stack_lanes[open]) = (part, close);
            open += 1;
        }
    }
    touching.lanes
}

/// Decides the lanes in which a bounding ball is `close`. A ball without parts counts as touching; otherwise the ball
/// inside the solid decides. Returns the lanes whose parts must be compared, `None` once every sought lane is decided.
/// `count`: number of parts of the ball; `open`: number of balls on the stack.
#[inline(always)]
fn settle<B: Block, const EACH: bool, const SWEPT: bool>(
    squared: B,
    (inner, gap): (f32, &Gap<SWEPT>),
    (count, open): (u32, usize),
    close: u16,
    touching: &mut Touching,
) -> Option<u16> {
    let full = open + count as usize > STACK;
    let sure = if count == 0 || (full && !EACH) { close } else { surely::<B, SWEPT>(squared, inner, gap) & close };
    if touching.ends::<EACH>(sure) {
        return None;
    }
    Some(if EACH && full { 0 } else { close & touching.left::<EACH>() })
}

/// Returns the lanes in which balls inside of solids touch.
#[inline(always)]
fn surely<B: Block, const SWEPT: bool>(squared: B, inner: f32, gap: &Gap<SWEPT>) -> u16 {
    let within = inner + gap.pad;
    if inner >= 0.0 { B::bits(B::less(squared, B::splat(within * within))) } else { 0 }
}

/// Returns lanes of `left` in which the smallest balls of two covers touch.
#[inline(always)]
pub(super) fn covers_touch<B: Block, const EACH: bool, const SWEPT: bool>(
    f: &Frames,
    a: &[Node],
    g: &Frames,
    b: &[Node],
    gap: &Gap<SWEPT>,
    left: u16,
) -> u16 {
    if a.is_empty() || b.is_empty() {
        return left;
    }
    let mut touching = Touching::among(left);
    let (mut stack, mut stack_lanes) = ([(0, 0); STACK], [0; STACK]);
    stack_lanes[0] = u16::MAX;
    let mut open = 1;
    while open > 0 {
        open -= 1;
        let (i, j) = stack[open];
        let (one, two) = (&a[i as usize], &b[j as usize]);
        let squared = between(&point::<B>(f, &one.center), &point(g, &two.center));
        let lanes = if EACH { stack_lanes[open] } else { u16::MAX } & touching.left::<EACH>();
        let close = below::<B>(squared, gap.squared(one.radius + two.radius)) & lanes;
        if close == 0 {
            continue;
        }
        // The larger ball is replaced by its parts.
        let first = one.count != 0 && (two.count == 0 || one.radius >= two.radius);
        let parent = if first { one } else { two };
        let inner = if one.inner.min(two.inner) < 0.0 { -1.0 } else { one.inner + two.inner };
        let Some(close) = settle::<B, EACH, SWEPT>(squared, (inner, gap), (parent.count, open), close, &mut touching)
        else {
            break;
        };
        if close == 0 {
            continue;
        }
        for part in parent.first..parent.first + parent.count {
            stack[open] = if first { (part, j) } else { (i, part) };
            stack_lanes[open] = close;
            open += 1;
        }
    }
    touching.lanes
}

//! The check itself, for one width.

use crate::apart::Compared;
use crate::block::{Block, LANES, Lanes};
use crate::bodies::{Frames, between, forward, point};

use super::gap::{Gap, Steps, gap_of, reach_of};
use super::touch::{Touching, below, covers_touch, near, pair_touches};
use super::{Buffers, Carried, Discrete, Motion, NO_PAIR, Proof, Standing};

/// Pairs in contact at recent configurations, which [`check_each`] compares first: this many at most.
const FREQUENT: usize = 8;
/// Extra distance beyond which [`check_each`] skips a group for all lanes [m]: larger than any rounding error, so that
/// the verdict of a lane does not depend on the other lanes.
const ROUNDING: f32 = 1e-5;

/// Returns a pair that touches in any lane of any block.
#[inline(always)]
pub(super) fn check<B: Block>(discrete: &Discrete, motion: &Motion<'_>, buffers: &mut Buffers) -> Option<u32> {
    let (samples, rounding) = ((LANES * motion.blocks.max(1)) as f32, discrete.rounding);
    match motion.proof {
        Proof::Motion { turn, .. } => {
            // Its beginning is the first sample.
            let part = 1.0 / (samples - 1.0);
            let steps = Steps::<true> { part, turn: turn as f32 * part, rounding };
            check_blocks::<B, true>(discrete, motion, 1, &steps, buffers)
        }
        Proof::Samples | Proof::None => {
            let rounding = if matches!(motion.proof, Proof::None) { 0.0 } else { rounding };
            let steps = Steps::<false> { part: 1.0 / samples, turn: 0.0, rounding };
            check_blocks::<B, false>(discrete, motion, 0, &steps, buffers)
        }
    }
}

/// Returns a pair that touches in any lane of any block, of which the first one begins with sample `first`.
#[inline(always)]
fn check_blocks<B: Block, const SWEPT: bool>(
    discrete: &Discrete,
    motion: &Motion<'_>,
    first: usize,
    steps: &Steps<SWEPT>,
    buffers: &mut Buffers,
) -> Option<u32> {
    let blocks = motion.blocks.max(1);
    for block in motion.skipped..blocks {
        // Samples number i, in lane k: i = (k + 1) · blocks − block, from 1.
        let mut parts = Lanes::splat(0.0);
        for (k, part) in parts.0.iter_mut().enumerate() {
            *part = ((k + 1) * blocks - block - first) as u32 as f32 * steps.part;
        }
        let parts = B::load(&parts);
        for ((q, from), to) in buffers.q.iter_mut().zip(motion.from).zip(motion.to) {
            parts.mul_add(B::splat((to - from) as f32), B::splat(*from as f32)).store(q);
        }
        let mut found = Found::among(u16::MAX);
        check_block::<B, false, SWEPT>(discrete, motion, block == 0, steps, buffers, &mut found);
        if found.pair != NO_PAIR {
            return Some(found.pair);
        }
    }
    None
}

/// Returns the lanes of `sought` in which anything touches. `motion` has no proof and no likely pair.
#[inline(always)]
pub(super) fn check_each<B: Block>(
    discrete: &Discrete,
    motion: &Motion<'_>,
    sought: u16,
    buffers: &mut Buffers,
) -> u16 {
    let steps = Steps::<false> { part: 0.0, turn: 0.0, rounding: 0.0 };
    let mut found = Found::among(sought);
    check_block::<B, true, false>(discrete, motion, true, &steps, buffers, &mut found);
    let pair = found.pair;
    if pair != NO_PAIR && !buffers.frequent.contains(&pair) {
        buffers.frequent.truncate(FREQUENT - 1);
        buffers.frequent.push(pair);
    }
    found.touching.lanes
}

/// Compares the pairs that touched lately; returns whether the check is over.
#[inline(always)]
fn check_frequent<B: Block, const SWEPT: bool>(
    discrete: &Discrete,
    motion: &Motion<'_>,
    steps: &Steps<SWEPT>,
    buffers: &mut Buffers,
    found: &mut Found,
) -> bool {
    for place in 0..buffers.frequent.len() {
        let pair = buffers.frequent[place];
        let touching = compare::<B, true, SWEPT>(discrete, motion, pair, steps, &buffers.frames, found);
        if touching != 0 && place > 0 {
            buffers.frequent.swap(place, place - 1);
        }
        if found.ends::<true>(pair, touching) {
            return true;
        }
    }
    found.pair = NO_PAIR;
    false
}

/// Returns the lanes in which one pair touches.
#[inline(always)]
fn compare<B: Block, const EACH: bool, const SWEPT: bool>(
    discrete: &Discrete,
    motion: &Motion<'_>,
    pair: u32,
    steps: &Steps<SWEPT>,
    frames: &[Frames],
    found: &Found,
) -> u16 {
    let scene = &*discrete.scene;
    let Compared { link, other, .. } = &scene.pairs[pair as usize];
    let (link, gap) = (&scene.links[*link], gap_of(motion, pair, steps));
    let left = (false, found.left::<EACH>());
    pair_touches::<B, EACH, SWEPT>(scene, frames, link.body, &link.tree.nodes, other, &gap, left)
}

/// A pair that touches, and the lanes in which any does.
struct Found {
    pair: u32,
    touching: Touching,
}

impl Found {
    #[inline(always)]
    fn among(sought: u16) -> Self {
        Self { pair: NO_PAIR, touching: Touching::among(sought) }
    }

    /// The lanes that are still to be checked.
    #[inline(always)]
    fn left<const EACH: bool>(&self) -> u16 {
        self.touching.left::<EACH>()
    }

    /// Takes the lanes in which a pair touches; returns whether the check is over.
    #[inline(always)]
    fn ends<const EACH: bool>(&mut self, pair: u32, lanes: u16) -> bool {
        if lanes != 0 {
            self.pair = pair;
        }
        self.touching.ends::<EACH>(lanes)
    }
}

/// Checks a block: to the first pair that touches in any lane, or for `EACH` lane whether something touches in it.
#[inline(always)]
fn check_block<B: Block, const EACH: bool, const SWEPT: bool>(
    discrete: &Discrete,
    motion: &Motion<'_>,
    first: bool,
    steps: &Steps<SWEPT>,
    buffers: &mut Buffers,
    found: &mut Found,
) {
    let scene = &*discrete.scene;
    forward::<B>(&scene.prepared, &buffers.q, &mut buffers.frames);
    if EACH && check_frequent::<B, SWEPT>(discrete, motion, steps, buffers, found) {
        return;
    }
    let frames = &buffers.frames[..];
    if let Some(likely) = motion.likely.filter(|_| first) {
        let touching = compare::<B, EACH, SWEPT>(discrete, motion, likely, steps, frames, found);
        if found.ends::<EACH>(likely, touching) {
            return;
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
        if SWEPT {
            for member in carried.links.0..carried.links.1 {
                let pair = discrete.links[member as usize].pair;
                reach = if pair == NO_PAIR { reach } else { reach.max(reach_of(motion, pair)) };
            }
        }
        let gap = Gap::new(most, reach, steps);
        let around = gap.distance(carried.radius) + if EACH { ROUNDING } else { 0.0 };
        let [x, y, z] = center;
        let mut sides = [x, y, z, x.neg(), y.neg(), z.neg()];
        if EACH {
            let (left, none) = (B::mask(found.left::<EACH>()), B::splat(f32::NEG_INFINITY));
            for side in &mut sides {
                *side = B::select(left, *side, none);
            }
        }
        // The box around all places, whose lower corner is that of the negative numbers.
        let (sides, around) = (B::largest(sides), B::splat(around));
        let high = [sides[0].add(around), sides[1].add(around), sides[2].add(around)];
        let low = [sides[3].add(around).neg(), sides[4].add(around).neg(), sides[5].add(around).neg()];
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
                let around = carried.radius + if EACH { ROUNDING } else { 0.0 };
                let near = near::<B, SWEPT>(scene, frames, &standing.other, &center, &gap.more(around));
                if near & found.left::<EACH>() == 0 {
                    continue;
                }
                if body_touches::<B, EACH, SWEPT>(discrete, motion, frames, (carried, near), standing, steps, found) {
                    return;
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
        if SWEPT {
            for pair in pairs {
                reach = reach.max(reach_of(motion, pair.pair));
            }
        }
        let around = one.radius + two.radius + if EACH { ROUNDING } else { 0.0 };
        let near = below::<B>(squared, Gap::new(most, reach, steps).squared(around)) & found.left::<EACH>();
        if near == 0 {
            continue;
        }
        let (f, g) = (&frames[one.body], &frames[two.body]);
        for pair in pairs {
            let (a, b) = (&discrete.links[pair.a as usize].tree.nodes, &discrete.links[pair.b as usize].tree.nodes);
            let touching =
                covers_touch::<B, EACH, SWEPT>(f, a, g, b, &gap_of(motion, pair.pair, steps), found.left::<EACH>());
            if found.ends::<EACH>(pair.pair, touching) {
                return;
            }
        }
    }
}

/// Checks the pairs of a body's links and an obstacle; returns whether the check is over.
#[inline(always)]
fn body_touches<B: Block, const EACH: bool, const SWEPT: bool>(
    discrete: &Discrete,
    motion: &Motion<'_>,
    frames: &[Frames],
    (carried, near): (&Carried, u16),
    standing: &Standing,
    steps: &Steps<SWEPT>,
    found: &mut Found,
) -> bool {
    let (first, last) = carried.links;
    for member in first..last {
        let pair = discrete.pairs[(standing.pairs + member - first) as usize];
        if pair == NO_PAIR {
            continue;
        }
        let (nodes, gap) = (&discrete.links[member as usize].tree.nodes, gap_of(motion, pair, steps));
        // The ball of the only link of a body is that of the body: it is near.
        let only = (last - first == 1, found.left::<EACH>() & if EACH { near } else { u16::MAX });
        let touching =
            pair_touches::<B, EACH, SWEPT>(&discrete.scene, frames, carried.body, nodes, &standing.other, &gap, only);
        if found.ends::<EACH>(pair, touching) {
            return true;
        }
    }
    false
}

#[inline(always)]
fn load<B: Block>(point: &[Lanes; 3]) -> [B; 3] {
    [B::load(&point[0]), B::load(&point[1]), B::load(&point[2])]
}

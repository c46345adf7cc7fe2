//! The fast part of the exact checker: sixteen configurations at a time, with covers instead of solids. What it finds
//! apart is apart; the rest is for the exact part.

use std::sync::Arc;

use dimos_kernels::Width;
use dimos_kernels::apart::{self, Buffers, Stretches};
use dimos_kernels::block::{LANES, Lanes};
use dimos_kernels::bodies::Body;
use dimos_kernels::chain::Frame;
use dimos_kernels::discrete::{self, Discrete, Motion, Proof};
use dimos_kernels::obstacle::{Core, Obstacle};
use glamx::DAffine3;

use super::checker::Samples;
use super::report::Pair;
use super::scene::{LinkShape, PlacedObstacle, Scene};
use super::{cover, shape};

/// A motion that is longer than a number of blocks by less than this part of one is not.
const ROUNDING: f64 = 1e-4;
/// Most blocks of samples of one motion.
const MOST_BLOCKS: f64 = 4096.0;

/// A scene in lanes, and buffers.
#[derive(Debug, Clone)]
pub(super) struct InLanes {
    scene: Arc<apart::Scene>,
    discrete: Arc<Discrete>,
    buffers: Buffers,
    samples: discrete::Buffers,
    /// Samples per length of a motion [1/rad].
    samples_per_rad: f64,
    /// For each entry of a configuration, the number of joints that it moves, each with its multiplier.
    turned: Vec<f64>,
    /// One entry per joint.
    pub q: Vec<Lanes>,
    /// The pairs that are not apart, each with its lanes.
    pub close: Vec<(u32, u16)>,
    /// All pairs.
    pub all: Arc<[u32]>,
    /// No motion.
    pub none: Arc<[f64]>,
}

impl InLanes {
    /// Prepares a scene; `pairs` are those of the checker, `samples_per_rad` is that of its settings.
    pub fn new(scene: &Scene, pairs: &[Pair], samples_per_rad: f64) -> Self {
        let all: Arc<[u32]> = (0..pairs.len() as u32).collect();
        let in_lanes = Arc::new(compile(scene, pairs));
        let mut turned = vec![0.0; scene.dof()];
        for robot in &scene.robots {
            for (_, joint) in (1..robot.kinematics.bodies()).filter_map(|body| robot.kinematics.joint(body)) {
                turned[robot.first_joint + joint.variable] += joint.multiplier.abs();
            }
        }
        Self {
            discrete: Arc::new(Discrete::new(in_lanes.clone())),
            scene: in_lanes,
            buffers: Buffers::default(),
            samples: discrete::Buffers::default(),
            samples_per_rad,
            turned,
            q: vec![Lanes::splat(0.0); scene.dof()],
            close: Vec::new(),
            none: vec![0.0; all.len()].into(),
            all,
        }
    }

    /// Fills `close` with the pairs of `pairs` that are not proven apart in the first `lanes` lanes; ends and returns
    /// the pair if one surely touches. `half`: half of the length of each stretch, as a part of the motion; `reach`:
    /// the most that each pair can approach on the whole motion, `pads`: the padding of each [m]; `likely` is compared
    /// first.
    pub fn find(
        &mut self,
        (lanes, half): (usize, f64),
        reach: &[f64],
        pads: &[f64],
        pairs: &[u32],
        likely: Option<usize>,
    ) -> Option<usize> {
        self.close.clear();
        let lanes = u16::MAX >> (LANES - lanes.clamp(1, LANES));
        let likely = likely.map(|pair| pair as u32);
        let stretches = Stretches { q: &self.q, half: half as f32, lanes, reach, pads, likely, ends_at_touch: true };
        self.scene.close(&stretches, pairs, &mut self.buffers, &mut self.close).map(|pair| pair as usize)
    }

    /// Returns a pair that touches at samples of a motion, or that does not prove what it has to, and the number of
    /// those that were checked. `likely` is compared first; each of `parts` of the motion gets as many samples as the
    /// whole of it would.
    pub fn touching(
        &mut self,
        samples: Samples,
        (from, to): (&[f64], &[f64]),
        (pads, pad): (&[f64], f64),
        likely: Option<usize>,
        proof: Proof<'_>,
        parts: f64,
    ) -> (Option<usize>, u64) {
        let length = from.iter().zip(to).map(|(a, b)| (b - a) * (b - a)).sum::<f64>().sqrt();
        // An edge of a search is 1 rad long, more or less by rounding, and gets no block for the rounding.
        let whole = length * parts * self.samples_per_rad / LANES as f64 - ROUNDING;
        let blocks = whole.ceil().clamp(1.0, MOST_BLOCKS) as usize;
        let (blocks, skipped) = match samples {
            Samples::All => (blocks, 0),
            Samples::First => (1, 0),
            Samples::Rest => (blocks, 1),
        };
        let motion = Motion { from, to, blocks, skipped, pads, pad, likely: likely.map(|pair| pair as u32), proof };
        let found = self.discrete.touching(&motion, &mut self.samples).map(|pair| pair as usize);
        (found, ((blocks - skipped) * LANES) as u64)
    }

    /// Returns those of `lanes` in which something touches. `q`: a block per joint [rad or m].
    pub fn touching_lanes(&mut self, q: &[Lanes], pads: (&[f64], f64), lanes: u16) -> u16 {
        self.discrete.touching_lanes(q, pads, lanes, &mut self.samples)
    }

    /// Returns the sum of the angles by which all joints turn on a motion [rad].
    pub fn turn(&self, from: &[f64], to: &[f64]) -> f64 {
        self.turned.iter().zip(from.iter().zip(to)).map(|(number, (a, b))| number * (b - a).abs()).sum()
    }

    /// Sets one configuration, without motion.
    pub fn set(&mut self, q: &[f64]) {
        for (to, q) in self.q.iter_mut().zip(q) {
            *to = Lanes::splat(*q as f32);
        }
    }
}

/// Prepares a scene in lanes; `pairs` are those of the checker.
pub(super) fn compile(scene: &Scene, pairs: &[Pair]) -> apart::Scene {
    let mut bodies = Vec::new();
    for robot in &scene.robots {
        let first = bodies.len();
        bodies.push(Body::Fixed(frame(&robot.base)));
        for body in 1..robot.kinematics.bodies() {
            let Some((parent, mut joint)) = robot.kinematics.joint(body) else { continue };
            joint.variable += robot.first_joint;
            bodies.push(Body::Moving { parent: first + parent, joint });
        }
    }
    let link = |link: &LinkShape| {
        let base = scene.robots.get(link.robot).map_or(0.0, |robot| robot.base.translation.length());
        apart::Link { body: link.frame, tree: cover::of_link(&link.solids), extent: base + reach(link) }
    };
    let links = scene.links.iter().map(link).collect();
    let obstacles: Vec<Obstacle> = scene.obstacles.iter().map(|o| obstacle(o, &mut bodies)).collect();
    let pair = |pair: &Pair| match *pair {
        Pair::Links(a, b) => apart::Pair::Links(a, b),
        Pair::Obstacle(link, obstacle) => apart::Pair::Obstacle(link, obstacle),
    };
    let pairs: Vec<apart::Pair> = pairs.iter().map(pair).collect();
    apart::Scene::new(bodies, links, &obstacles, &pairs, Width::widest())
}

fn frame(at: &DAffine3) -> Frame {
    Frame { rotation: at.matrix3.to_cols_array_2d(), translation: at.translation.to_array() }
}

/// Returns the most that any point of a link is away from its robot's base, over all joints [m].
fn reach(link: &LinkShape) -> f64 {
    link.levers.iter().copied().fold(link.ball.0.length() + link.ball.1, f64::max)
}

/// Returns an obstacle; a body is added for one that is a cover.
fn obstacle(standing: &PlacedObstacle, bodies: &mut Vec<Body>) -> Obstacle {
    let solid = &standing.solid;
    let boxed = |half: [f64; 3]| Core::Box { frame: frame(&solid.frame), half };
    let core = match &solid.core {
        shape::Core::Point => boxed([0.0; 3]),
        shape::Core::Segment { half } => boxed([0.0, 0.0, *half]),
        shape::Core::Box { half } => boxed(half.to_array()),
        shape::Core::Cylinder { half, radius } => {
            Core::Cylinder { frame: frame(&solid.frame), half: *half, radius: *radius }
        }
        shape::Core::Hull(_) | shape::Core::Mesh(_) | shape::Core::Cloud(_) => {
            bodies.push(Body::Fixed(frame(&solid.frame)));
            let (center, radius) = solid.ball();
            let extent = center.length() + radius;
            Core::Cover { body: bodies.len() - 1, tree: solid.cover().clone(), extent }
        }
    };
    Obstacle { core, radius: solid.radius }
}

#[cfg(test)]
mod tests;

//! The fast part of the exact checker: sixteen configurations at a time, with covers instead of solids. What it finds
//! apart is apart; the rest is for the exact part.

use std::sync::Arc;

use dimos_kernels::Width;
use dimos_kernels::apart::{self, Buffers, Stretches};
use dimos_kernels::block::{LANES, Lanes};
use dimos_kernels::bodies::Body;
use dimos_kernels::chain::Frame;
use dimos_kernels::cover::{Place, Tree};
use dimos_kernels::obstacle::{Core, Obstacle};
use glamx::DAffine3;

use super::report::Pair;
use super::scene::{LinkShape, PlacedObstacle, Scene};
use super::shape;

/// A scene in lanes, and buffers.
#[derive(Debug, Clone)]
pub(super) struct InLanes {
    scene: Arc<apart::Scene>,
    buffers: Buffers,
    /// One entry per joint.
    pub q: Vec<Lanes>,
    /// The pairs that are not apart, each with its lanes.
    pub close: Vec<(u32, u16)>,
    /// All pairs.
    pub all: Arc<[u32]>,
    /// No motion.
    pub none: Arc<[f64]>,
    margins: Vec<f64>,
}

impl InLanes {
    /// Prepares a scene; `pairs` are those of the checker.
    pub fn new(scene: &Scene, pairs: &[Pair]) -> Self {
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
            apart::Link { body: link.frame, tree: Arc::new(cover(link)), extent: base + reach(link) }
        };
        let links = scene.links.iter().map(link).collect();
        let obstacles: Vec<Obstacle> = scene.obstacles.iter().map(|o| obstacle(o, &mut bodies)).collect();
        let pair = |pair: &Pair| match *pair {
            Pair::Links(a, b) => apart::Pair::Links(a, b),
            Pair::Obstacle(link, obstacle) => apart::Pair::Obstacle(link, obstacle),
        };
        let all: Arc<[u32]> = (0..pairs.len() as u32).collect();
        let pairs: Vec<apart::Pair> = pairs.iter().map(pair).collect();
        let scene_in_lanes = apart::Scene::new(bodies, links, &obstacles, &pairs, Width::widest());
        Self {
            scene: Arc::new(scene_in_lanes),
            buffers: Buffers::default(),
            q: vec![Lanes::splat(0.0); scene.dof()],
            close: Vec::new(),
            none: vec![0.0; all.len()].into(),
            all,
            margins: Vec::new(),
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

    /// Fills `close` with the pairs that may be closer than `margin` [m] at up to sixteen configurations.
    pub fn find_closer(&mut self, configurations: &[Vec<f64>], margin: f64) {
        self.close.clear();
        for (lane, configuration) in configurations.iter().enumerate().take(LANES) {
            for (to, q) in self.q.iter_mut().zip(configuration) {
                to.0[lane] = *q as f32;
            }
        }
        self.margins.clear();
        self.margins.resize(self.all.len(), margin);
        let lanes = u16::MAX >> (LANES - configurations.len().clamp(1, LANES));
        let (q, reach, pads) = (&self.q, &self.none, &self.margins);
        let stretches = Stretches { q, half: 0.0, lanes, reach, pads, likely: None, ends_at_touch: false };
        self.scene.close(&stretches, &self.all, &mut self.buffers, &mut self.close);
    }

    /// Sets one configuration, without motion.
    pub fn set(&mut self, q: &[f64]) {
        for (to, q) in self.q.iter_mut().zip(q) {
            *to = Lanes::splat(*q as f32);
        }
    }
}

fn frame(at: &DAffine3) -> Frame {
    Frame { rotation: at.matrix3.to_cols_array_2d(), translation: at.translation.to_array() }
}

/// Returns the most that any point of a link is away from its robot's base, over all joints [m].
fn reach(link: &LinkShape) -> f64 {
    link.levers.iter().copied().fold(link.ball.0.length() + link.ball.1, f64::max)
}

/// Returns the cover of a link.
fn cover(link: &LinkShape) -> Tree {
    let place = |solid: &shape::Solid| Place {
        rotation: solid.frame.matrix3.to_cols_array_2d(),
        translation: solid.frame.translation.to_array(),
        radius: solid.radius,
    };
    Tree::join(&link.solids.iter().map(|solid| (&**solid.cover(), place(solid))).collect::<Vec<_>>())
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

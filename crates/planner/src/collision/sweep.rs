//! Proves pairs apart on pieces of a motion for the collision guard of the tick: with covers alone, in lanes, without
//! allocating. A pair that covers cannot prove apart counts as close.

use std::sync::Arc;

use dimos_kernels::apart::{self, Buffers, Levers, Pieces};
use dimos_kernels::block::{LANES, Lanes};

use super::lanes::compile;
use super::report::Pair;
use super::scene::Scene;
use super::settings::GuardSettings;

/// A scene prepared for the tick, with buffers for sixteen pieces of a motion.
#[derive(Debug)]
pub struct Sweep {
    scene: Arc<Scene>,
    lanes: apart::Scene,
    levers: Levers,
    pairs: Vec<Pair>,
    buffers: Buffers,
    q: Vec<Lanes>,
    half: Vec<Lanes>,
    close: Vec<(u32, u16)>,
    settings: GuardSettings,
}

impl Sweep {
    /// Number of pieces that are checked together.
    pub const PIECES: usize = LANES;

    /// Prepares all pairs of a scene that can move. Allocates all that later calls need.
    pub fn new(scene: &Arc<Scene>, settings: &GuardSettings) -> Self {
        let moves = |pair: &Pair| match *pair {
            Pair::Links(a, b) => scene.links[a].moves || scene.links[b].moves,
            Pair::Obstacle(link, _) => scene.links[link].moves,
        };
        // A link's pairs follow each other, so that its largest ball is placed once.
        let pairs: Vec<Pair> = scene.all_pairs().filter(moves).collect();
        let mut levers = Levers::default();
        let mut links = scene.pairs.iter();
        for pair in &pairs {
            match *pair {
                Pair::Obstacle(link, _) => levers.push(&scene.links[link].levers),
                // In the order of the scene.
                Pair::Links(a, b) => {
                    let own = links.find(|pair| (pair.a, pair.b) == (a, b));
                    levers.push(own.map_or(&[], |pair| &pair.levers));
                }
            }
        }
        let zero = vec![Lanes::splat(0.0); scene.dof()];
        let mut made = Self {
            lanes: compile(scene, &pairs),
            scene: scene.clone(),
            levers,
            close: Vec::with_capacity(pairs.len()),
            pairs,
            buffers: Buffers::default(),
            q: zero.clone(),
            half: zero,
            settings: *settings,
        };
        let (pads, none) = (vec![0.0; made.pairs.len()], Lanes::splat(0.0));
        made.close(1, &none, &pads, &[]);
        made
    }

    /// Returns the number of joints.
    pub fn dof(&self) -> usize {
        self.q.len()
    }

    /// Returns the number of pairs.
    pub fn pairs(&self) -> usize {
        self.pairs.len()
    }

    /// Returns the names of a pair: a link, and another link or an obstacle.
    pub fn names(&self, pair: usize) -> [&str; 2] {
        let link = |index: usize| self.scene.links.get(index).map_or("", |link| &link.name);
        match self.pairs.get(pair) {
            Some(Pair::Links(a, b)) => [link(*a), link(*b)],
            Some(Pair::Obstacle(a, o)) => [link(*a), self.scene.obstacles.get(*o).map_or("", |o| &o.name)],
            None => ["", ""],
        }
    }

    /// Returns whether both are links of the same robot, or objects that it holds.
    pub fn is_of_one_robot(&self, pair: usize) -> bool {
        let robot = |link: usize| self.scene.links.get(link).map(|link| link.robot);
        matches!(self.pairs.get(pair), Some(Pair::Links(a, b)) if robot(*a) == robot(*b))
    }

    /// Returns the distance that the members of a pair keep besides a margin: how far their robots may be from their
    /// models [m].
    pub fn apart(&self, pair: usize) -> f64 {
        match self.pairs.get(pair) {
            Some(Pair::Links(a, b)) => self.scene.apart(*a) + self.scene.apart(*b),
            Some(Pair::Obstacle(link, _)) => self.scene.apart(*link),
            None => 0.0,
        }
    }

    /// Returns the joints that move the members of a pair relative to each other, and how far they move any of their
    /// points at most [m/rad or m/m].
    pub fn levers(&self, pair: usize) -> &[(u32, f32)] {
        self.levers.of(pair)
    }

    /// Sets a joint on a piece: the position in its middle, and how far the joint gets from there at most [rad or m].
    pub fn set(&mut self, piece: usize, joint: usize, middle: f64, half: f64) {
        if let (Some(q), Some(around)) = (self.q.get_mut(joint), self.half.get_mut(joint))
            && let (Some(q), Some(around)) = (q.0.get_mut(piece), around.0.get_mut(piece))
        {
            *q = middle as f32;
            // Rounding error of the middle, rounded up.
            *around = ((half + (middle - f64::from(*q)).abs()) * (1.0 + 1e-6)) as f32;
        }
    }

    /// Returns those of `pairs` that are not proven farther apart than their `pads` plus `margin` [m] on the pieces
    /// whose bits are set in `pieces`, each with those pieces. Does not allocate.
    pub fn close(&mut self, pieces: u16, margin: &Lanes, pads: &[f32], pairs: &[u32]) -> &[(u32, u16)] {
        self.close.clear();
        let asked = Pieces { q: &self.q, half: &self.half, lanes: pieces, margin, pads, visits: self.settings.visits };
        self.lanes.close_on_pieces(&asked, &self.levers, pairs, &mut self.buffers, &mut self.close);
        &self.close
    }

    /// Returns the distance of a pair that is proven where all pieces were set to the same [m]: to 0.01 mm, at most
    /// `top` and at least `-deepest` of the settings; `None` if none is proven. Does not allocate.
    pub fn distance(&mut self, pair: u32, top: f32, pads: &[f32]) -> Option<f32> {
        let pad = pads.get(pair as usize).copied()?;
        let (mut top, mut span) = (top, top + self.settings.deepest);
        for _ in 0..self.settings.scales {
            // Each scale divides one part of the scale before.
            let part = span / Self::PIECES as f32;
            let mut margin = Lanes::splat(0.0);
            for (k, lane) in margin.0.iter_mut().enumerate() {
                *lane = top - part * (k as f32 + 1.0) - pad;
            }
            let close = self.close(u16::MAX, &margin, pads, &[pair]).first().map_or(0, |(_, lanes)| *lanes);
            let unproven = close.trailing_ones();
            if unproven as usize == Self::PIECES {
                return None;
            }
            top -= part * unproven as f32;
            span = part;
        }
        Some(top - span)
    }
}

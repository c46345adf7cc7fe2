//! Padding: the distance that pairs keep. Closer counts as touching, in configurations and in proofs of motions.

use super::exact::{ExactChecker, Gap};
use super::report::{Contact, Pair};

impl ExactChecker {
    /// The same checker with a distance [m] that moving links keep from obstacles and from the links of other robots.
    /// Pairs of links of one robot keep none: links of one arm are close to each other by design.
    pub fn with_padding(mut self, padding: f64) -> Self {
        for (pad, pair) in self.pads.iter_mut().zip(&self.pairs) {
            *pad = match *pair {
                Pair::Obstacle(..) => padding,
                Pair::Links(a, b) if self.scene.links[a].robot != self.scene.links[b].robot => padding,
                Pair::Links(..) => 0.0,
            };
        }
        self
    }

    /// The distance that a pair keeps [m], by its index in [`closer_than_padding`](Self::closer_than_padding).
    pub fn pad(&self, pair: usize) -> f64 {
        self.pads.get(pair).copied().unwrap_or(0.0)
    }

    /// Changes the distance that a pair keeps [m].
    pub fn set_pad(&mut self, pair: usize, pad: f64) {
        if let Some(own) = self.pads.get_mut(pair) {
            *own = pad;
        }
    }

    /// The pairs that are closer than they keep at a configuration, by index; their contacts have true distances.
    pub fn closer_than_padding(&mut self, q: &[f64]) -> Vec<(usize, Contact)> {
        self.place(q);
        let near = (0..self.pairs.len()).filter(|i| self.gap(*i, 0.0) == Gap::Touch).collect::<Vec<_>>();
        near.into_iter().filter_map(|i| Some((i, self.contact(self.pairs[i])?))).collect()
    }

    /// Whether one pair, by index, keeps its distance at a configuration.
    pub fn keeps(&mut self, pair: usize, q: &[f64]) -> bool {
        self.place(q);
        self.gap(pair, 0.0) != Gap::Touch
    }

    /// The index of the pair of a link and another link or obstacle, by name.
    pub fn pair_index(&self, link: &str, other: &str) -> Option<usize> {
        let scene = &self.scene;
        self.pairs.iter().position(|pair| match *pair {
            Pair::Obstacle(l, o) => scene.links[l].name == link && scene.obstacles[o].name == other,
            Pair::Links(a, b) => scene.links[a].name == link && scene.links[b].name == other,
        })
    }
}

//! Padding: the minimum distance of pairs. Closer counts as touching, in configurations and in motions.

use super::exact::{ExactChecker, Gap};
use super::report::{Contact, Pair};

impl ExactChecker {
    /// Sets the padding [m] of moving links to obstacles and to the links of other robots; robots that may be off their
    /// models add that distance. Pairs of links of one robot
    /// have none: they are close to each other by design.
    pub fn with_padding(mut self, padding: f64) -> Self {
        let apart = |link| self.scene.apart(link);
        for (pad, pair) in self.pads.iter_mut().zip(&self.pairs) {
            *pad = match *pair {
                Pair::Obstacle(link, _) => padding + apart(link),
                Pair::Links(a, b) if self.scene.links[a].robot != self.scene.links[b].robot => {
                    padding + apart(a) + apart(b)
                }
                Pair::Links(..) => 0.0,
            };
        }
        self.most_pad = self.pads.iter().copied().fold(0.0, f64::max);
        self
    }

    /// Sets the padding of all pairs [m], those of links of one robot included: to measure what is close.
    pub fn with_margin(mut self, margin: f64) -> Self {
        self.pads.fill(margin);
        self.most_pad = margin.max(0.0);
        self
    }

    /// Returns the padding of a pair [m], by its index in [`closer_than_padding`](Self::closer_than_padding).
    pub fn pad(&self, pair: usize) -> f64 {
        self.pads.get(pair).copied().unwrap_or(0.0)
    }

    /// Sets the padding of a pair [m].
    pub fn set_pad(&mut self, pair: usize, pad: f64) {
        if let Some(own) = self.pads.get_mut(pair) {
            *own = pad;
            self.most_pad = self.most_pad.max(pad);
        }
    }

    /// Returns the pairs that are closer than their padding at a configuration, by index; contacts report true
    /// distances.
    pub fn closer_than_padding(&mut self, q: &[f64]) -> Vec<(usize, Contact)> {
        self.place(q);
        let near = (0..self.pairs.len()).filter(|i| self.gap(*i, 0.0) == Gap::Touch).collect::<Vec<_>>();
        near.into_iter().filter_map(|i| Some((i, self.contact(self.pairs[i])?))).collect()
    }

    /// Returns whether a pair, by index, keeps its padding at a configuration.
    pub fn keeps(&mut self, pair: usize, q: &[f64]) -> bool {
        self.place(q);
        self.gap(pair, 0.0) != Gap::Touch
    }

    /// Returns the index of the pair of a link and another link or obstacle, by name.
    pub fn pair_index(&self, link: &str, other: &str) -> Option<usize> {
        let scene = &self.scene;
        self.pairs.iter().position(|pair| match *pair {
            Pair::Obstacle(l, o) => scene.links[l].name == link && scene.obstacles[o].name == other,
            Pair::Links(a, b) => scene.links[a].name == link && scene.links[b].name == other,
        })
    }
}

//! How far apart covers can prove the links of one robot. Some are closer to each other by design than their covers are
//! fine: asking for more would forbid poses that are free.

use std::collections::BTreeMap;
use std::sync::Arc;

use dimos_kernels::block::Lanes;

use super::allowed_pairs::sample;
use super::exact::ExactChecker;
use super::scene::Scene;
use super::settings::{CheckSettings, GuardSettings};
use super::sweep::Sweep;
use dimos_robot::random::Random;

/// Distances that the guard keeps between the links of one robot.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct OwnMargins {
    margin: f32,
    /// Pairs with less, by the names of both links.
    less: BTreeMap<[String; 2], f32>,
}

impl OwnMargins {
    /// Finds the pairs for which covers prove less than `margin` [m] in poses in which they do not touch. The same
    /// scene gives the same result.
    pub fn of(scene: &Arc<Scene>, margin: f64, settings: &GuardSettings) -> Self {
        let margin = margin as f32;
        let (mut sweep, mut random) = (Sweep::new(scene, settings), Random::new(1));
        let mut exact = ExactChecker::new(scene.clone(), CheckSettings::default());
        let own: Vec<u32> = (0..sweep.pairs() as u32).filter(|pair| sweep.is_of_one_robot(*pair as usize)).collect();
        let pads = vec![margin; sweep.pairs()];
        let mut less = BTreeMap::new();
        for _ in 0..settings.poses {
            let q: Vec<f64> = scene.limits().iter().map(|l| sample(l.lower, l.upper, &mut random)).collect();
            for (joint, at) in q.iter().enumerate() {
                (0..Sweep::PIECES).for_each(|piece| sweep.set(piece, joint, *at, 0.0));
            }
            let close: Vec<u32> =
                sweep.close(1, &Lanes::splat(0.0), &pads, &own).iter().map(|(pair, _)| *pair).collect();
            for pair in close {
                let [link, other] = sweep.names(pair as usize).map(str::to_owned);
                let apart = exact.pair_index(&link, &other).is_some_and(|index| exact.keeps(index, &q));
                if let Some(distance) = sweep.distance(pair, margin, &pads).filter(|_| apart) {
                    let least = less.entry([link, other]).or_insert(margin);
                    *least = least.min(distance - settings.slack);
                }
            }
        }
        Self { margin, less }
    }

    /// Returns the distance that two links of one robot keep, by name [m]; negative where their covers overlap.
    pub fn get(&self, names: [&str; 2]) -> f32 {
        if self.less.is_empty() {
            return self.margin;
        }
        self.less.get(&names.map(str::to_owned)).copied().unwrap_or(self.margin)
    }

    /// Returns the pairs that covers do not tell apart when they nearly touch, with the distance that they are kept.
    pub fn overlapping(&self) -> impl Iterator<Item = (&[String; 2], f32)> {
        self.less.iter().filter(|(_, distance)| **distance <= 0.0).map(|(names, distance)| (names, *distance))
    }
}

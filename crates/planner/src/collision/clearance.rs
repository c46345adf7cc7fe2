//! The clearance that motions are proven to keep, between their samples, too.

use std::collections::HashMap;

use super::checker::{CollisionChecker, Stop};
use super::exact::ExactChecker;
use super::report::Pair;
use super::settings::ClearanceSettings;

/// A motion: straight from one configuration to another [rad or m].
pub type Motion = [Vec<f64>; 2];

/// A distance that motions keep.
#[derive(Debug, Clone, PartialEq)]
pub struct Clearance {
    /// All things that can collide and move relative to each other are proven to stay this far apart [m].
    pub distance: f64,
    /// The pair that is not proven to stay farther apart; `None` if no pair comes close.
    pub pair: Option<[String; 2]>,
}

/// How a distance is proven.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum By {
    /// With covers only: up to some millimetres are missed.
    Covers,
    /// Also with solids, where that does not take long.
    Limited,
    /// With solids, however long it takes.
    Solids,
    /// With solids, and pieces of a motion that are small compared to the distance.
    Fine,
}

impl ExactChecker {
    /// Returns the distance that motions keep, regardless of the padding; they must be proven free. It may be some
    /// millimetres less than the true one, 0.5 mm if `exact`, a part of it if below 1 mm; at most 0.2 m. Links that
    /// triangles decide about are measured by covers unless `exact`: then 0 may stand for some millimetres. `None` if
    /// nothing can collide, or if stopped.
    pub fn clearance_along(&mut self, motions: &[Motion], exact: bool, stop: &Stop) -> Option<Clearance> {
        if self.pairs.is_empty() {
            return None;
        }
        let (pads, most_pad, fine) = (self.pads.clone(), self.most_pad, self.settings.clearance.fine);
        // The same configurations are checked with many distances, and triangles take long.
        self.known = self.has_surfaces.then(HashMap::new);
        let mut clearance = self.search_clearance(motions, exact, stop);
        // Triangles take longer than all else of a request: only the level `exact` measures with them.
        let by_covers = self.known.is_some() && !exact;
        if let Some(coarse) = clearance.as_mut().filter(|clearance| clearance.distance < fine && !by_covers)
            && let Some(fine) = self.refined(motions, coarse, stop)
        {
            *coarse = fine;
        }
        self.known = None;
        (self.pads, self.most_pad, self.resolution) = (pads, most_pad, self.settings.certification.resolution);
        clearance
    }

    /// Returns a small distance in its own measure; all motions keep the coarse one. `None` if stopped.
    fn refined(&mut self, motions: &[Motion], coarse: &Clearance, stop: &Stop) -> Option<Clearance> {
        let mut clearance = Clearance { distance: 2.0 * self.settings.clearance.near, pair: coarse.pair.clone() };
        for motion in motions {
            if !self.keeps_on(motion, clearance.distance, By::Fine, stop) {
                let (distance, pair) = self.clearance_of(motion, (coarse.distance, clearance.distance), By::Fine, stop);
                clearance = Clearance { distance, pair: pair.and_then(|pair| self.names(pair)) };
            }
        }
        (!stop.is_over()).then_some(clearance)
    }

    fn search_clearance(&mut self, motions: &[Motion], exact: bool, stop: &Stop) -> Option<Clearance> {
        let ClearanceSettings { tried: [.., largest], near, .. } = self.settings.clearance;
        let mut clearance = Clearance { distance: largest, pair: None };
        // The longest come closest, most often: after them, one check is enough for each of the others.
        let length = |[a, b]: &Motion| a.iter().zip(b).map(|(a, b)| (b - a) * (b - a)).sum::<f64>();
        let mut order: Vec<(f64, &Motion)> = motions.iter().map(|motion| (length(motion), motion)).collect();
        order.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        for (_, motion) in order {
            if self.keeps_on(motion, clearance.distance, By::Covers, stop) {
                continue;
            }
            let mut least = self.clearance_of(motion, (0.0, clearance.distance), By::Covers, stop);
            let by = if exact { By::Solids } else { By::Limited };
            if exact || (least.0 < near && self.known.is_none()) {
                let high = if exact { clearance.distance } else { clearance.distance.min(2.0 * near) };
                least = match self.keeps_on(motion, high, by, stop) {
                    true if high < clearance.distance => (high, least.1),
                    true => continue,
                    false => self.clearance_of(motion, (least.0, high), by, stop),
                };
            }
            if stop.is_over() {
                return None;
            }
            clearance = Clearance { distance: least.0, pair: least.1.and_then(|pair| self.names(pair)) };
        }
        Some(clearance)
    }

    /// Returns the distance that one motion keeps, and the pair that ends it: at least `low`, and less than `high`.
    fn clearance_of(
        &mut self,
        motion: &Motion,
        (mut low, mut high): (f64, f64),
        by: By,
        stop: &Stop,
    ) -> (f64, Option<usize>) {
        let ClearanceSettings { tried, relative, absolute, fine, finest, .. } = self.settings.clearance;
        let mut pair = self.witness;
        for tried in tried.into_iter().filter(|tried| (low..high).contains(tried)).collect::<Vec<_>>() {
            if !self.keeps_on(motion, tried, by, stop) {
                (high, pair) = (tried, self.witness);
                break;
            }
            low = tried;
        }
        let width = |low: f64, high: f64| match by {
            By::Fine if low < fine => finest.max(relative * high),
            By::Solids | By::Fine => absolute,
            By::Covers | By::Limited => absolute.max(relative * high),
        };
        while high - low > width(low, high) {
            let middle = 0.5 * (low + high);
            if self.keeps_on(motion, middle, by, stop) {
                low = middle;
            } else {
                (high, pair) = (middle, self.witness);
            }
        }
        (low, pair)
    }

    fn keeps_on(&mut self, [from, to]: &Motion, distance: f64, by: By, stop: &Stop) -> bool {
        self.pads.fill(distance);
        self.most_pad = distance;
        match by {
            By::Covers => self.is_free_by_covers(from, to, stop),
            By::Limited => self.is_free_within(self.settings.clearance.budget, (from, to), false, stop),
            By::Solids => self.motion_is_free(from, to, stop),
            By::Fine => {
                // Never coarser than what all proofs use.
                let ClearanceSettings { relative, fine_budget, .. } = self.settings.clearance;
                self.resolution = self.settings.certification.resolution.min(relative * distance);
                self.is_free_within(fine_budget, (from, to), false, stop)
            }
        }
    }

    /// Returns the names of a pair's members.
    fn names(&self, pair: usize) -> Option<[String; 2]> {
        let link = |l: usize| self.scene.links.get(l).map(|link| link.name.clone());
        Some(match *self.pairs.get(pair)? {
            Pair::Links(a, b) => [link(a)?, link(b)?],
            Pair::Obstacle(l, o) => [link(l)?, self.scene.obstacles.get(o)?.name.clone()],
        })
    }
}

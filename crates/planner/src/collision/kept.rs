//! The distance that motions are proven to keep: between their samples, too.

use super::checker::{CollisionChecker, Resolution, Stop};
use super::exact::ExactChecker;
use super::report::Pair;

/// Distances that are tried first, one after the other [m]: most motions are closest at a few of them. The last is the
/// largest that is looked for.
const TRIED: [f64; 6] = [0.002, 0.005, 0.0125, 0.03, 0.08, 0.2];
/// A distance is found to this part of it, or to a number of metres.
const PART: f64 = 0.1;
const COARSE: f64 = 5e-4;
/// Below this distance [m], what covers miss is much of it: solids are checked.
const NEAR: f64 = 0.005;
/// Below this distance [m], a number of metres says little: it is found to a part of it, down to the finest.
const FINE: f64 = 1e-3;
const FINEST: f64 = 1e-6;

/// Number of exact checks of configurations for a distance that need not be kept.
const EXACT_CHECKS: u64 = 24;
/// The same for a small distance: what slides along something needs most.
const FINE_CHECKS: u64 = 65_536;

/// A motion: straight from one configuration to another [rad or m].
pub type Motion = [Vec<f64>; 2];

/// A distance that motions keep.
#[derive(Debug, Clone, PartialEq)]
pub struct Kept {
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
    /// With solids, and pieces of a motion that are small beside the distance.
    Fine,
}

impl ExactChecker {
    /// Returns the distance that motions keep, regardless of the padding; they must be proven free. It may be some
    /// millimetres less than the true one, 0.5 mm if `exact`, a part of it if below 1 mm; at most 0.2 m. `None` if
    /// nothing can collide, or if stopped.
    pub fn kept_on(&mut self, motions: &[Motion], exact: bool, stop: &Stop) -> Option<Kept> {
        if self.pairs.is_empty() {
            return None;
        }
        let (pads, most_pad, resolution) = (self.pads.clone(), self.most_pad, self.resolution);
        let mut kept = self.search_kept(motions, exact, stop);
        if let Some(coarse) = kept.as_mut().filter(|kept| kept.distance < FINE)
            && let Some(fine) = self.refined(motions, coarse, stop)
        {
            *coarse = fine;
        }
        (self.pads, self.most_pad, self.resolution) = (pads, most_pad, resolution);
        kept
    }

    /// Returns a small distance in its own measure; all motions keep the coarse one. `None` if stopped.
    fn refined(&mut self, motions: &[Motion], coarse: &Kept, stop: &Stop) -> Option<Kept> {
        let mut kept = Kept { distance: 2.0 * NEAR, pair: coarse.pair.clone() };
        for motion in motions {
            if !self.keeps_on(motion, kept.distance, By::Fine, stop) {
                let (distance, pair) = self.kept_on_one(motion, (coarse.distance, kept.distance), By::Fine, stop);
                kept = Kept { distance, pair: pair.and_then(|pair| self.names(pair)) };
            }
        }
        (!stop.is_over()).then_some(kept)
    }

    fn search_kept(&mut self, motions: &[Motion], exact: bool, stop: &Stop) -> Option<Kept> {
        let mut kept = Kept { distance: TRIED[TRIED.len() - 1], pair: None };
        // The longest come closest, most often: after them, one check is enough for each of the others.
        let length = |[a, b]: &Motion| a.iter().zip(b).map(|(a, b)| (b - a) * (b - a)).sum::<f64>();
        let mut order: Vec<(f64, &Motion)> = motions.iter().map(|motion| (length(motion), motion)).collect();
        order.sort_by(|(a, _), (b, _)| b.total_cmp(a));
        for (_, motion) in order {
            if self.keeps_on(motion, kept.distance, By::Covers, stop) {
                continue;
            }
            let mut least = self.kept_on_one(motion, (0.0, kept.distance), By::Covers, stop);
            let by = if exact { By::Solids } else { By::Limited };
            if exact || least.0 < NEAR {
                let high = if exact { kept.distance } else { kept.distance.min(2.0 * NEAR) };
                least = match self.keeps_on(motion, high, by, stop) {
                    true if high < kept.distance => (high, least.1),
                    true => continue,
                    false => self.kept_on_one(motion, (least.0, high), by, stop),
                };
            }
            if stop.is_over() {
                return None;
            }
            kept = Kept { distance: least.0, pair: least.1.and_then(|pair| self.names(pair)) };
        }
        Some(kept)
    }

    /// Returns the distance that one motion keeps, and the pair that ends it: at least `low`, and less than `high`.
    fn kept_on_one(
        &mut self,
        motion: &Motion,
        (mut low, mut high): (f64, f64),
        by: By,
        stop: &Stop,
    ) -> (f64, Option<usize>) {
        let mut pair = self.witness;
        for tried in TRIED.into_iter().filter(|tried| (low..high).contains(tried)).collect::<Vec<_>>() {
            if !self.keeps_on(motion, tried, by, stop) {
                (high, pair) = (tried, self.witness);
                break;
            }
            low = tried;
        }
        let width = |low: f64, high: f64| match by {
            By::Fine if low < FINE => FINEST.max(PART * high),
            By::Solids | By::Fine => COARSE,
            By::Covers | By::Limited => COARSE.max(PART * high),
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
            By::Limited => self.is_free_within(EXACT_CHECKS, (from, to), false, stop),
            By::Solids => self.motion_is_free(from, to, stop),
            By::Fine => {
                // Never coarser than what all proofs use.
                self.resolution.motion = Resolution::default().motion.min(PART * distance);
                self.is_free_within(FINE_CHECKS, (from, to), false, stop)
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

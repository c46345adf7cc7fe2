//! Padding: the distance that plans keep from obstacles and other arms (`planner.padding`), and its exceptions: pairs
//! that are closer at the start or goal, near that configuration, and pairs that are closer in every configuration.
//! Contact is never allowed.

use std::f64::consts::TAU;
use std::sync::Arc;

use dimos_kernels::block::{LANES, Lanes};

use super::settings::PaddingSettings;
use crate::collision::allowed_pairs::sample;
use crate::collision::checker::Samples;
use crate::collision::clearance::{Clearance, Motion};
use crate::collision::report::{Contact, Pair};
use crate::collision::{CollisionChecker, ExactChecker, Scene, Stop};
use crate::planning::search::path::between;
use crate::planning::settings::PlannerSettings;
use dimos_core::named::named;
use dimos_robot::model::Limits;
use dimos_robot::random::Random;

named! {
    /// Where an exception from the padding applies.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum Near {
        /// Near the start.
        Start = "start",
        /// Near the goal.
        Goal = "goal",
        /// In every configuration: the pair is always closer than the padding.
        Everywhere = "everywhere",
    }
}

/// An exception from the padding: a pair and where it applies.
#[derive(Debug, Clone, PartialEq)]
pub struct PaddingException {
    /// Where it applies.
    pub near: Near,
    /// The start or goal configuration [rad].
    pub center: Vec<f64>,
    /// Radius around it [rad, Euclidean over all joints].
    pub radius: f64,
    /// The link.
    pub link: String,
    /// The link or obstacle close to it.
    pub other: String,
    /// Distance at the start or goal [m]; negative: penetration depth.
    pub distance: f64,
}

/// A ball of configurations around a start or goal in which some pairs may be closer.
#[derive(Debug, Clone)]
struct Zone {
    center: Vec<f64>,
    radius: f64,
    checker: ExactChecker,
}

/// A collision checker with padding. Contacts report true distances: above 0 within the padding.
#[derive(Debug, Clone)]
pub struct Padded {
    padding: f64,
    full: ExactChecker,
    bare: ExactChecker,
    zones: Vec<Zone>,
    exceptions: Vec<PaddingException>,
    settings: PaddingSettings,
}

impl Padded {
    /// Creates a checker of a scene with `padding` [m] everywhere.
    pub fn new(scene: Arc<Scene>, padding: f64, settings: &PlannerSettings) -> Self {
        let bare = ExactChecker::new(scene, settings.check);
        Self {
            padding,
            full: bare.clone().with_padding(padding),
            bare,
            zones: Vec::new(),
            exceptions: Vec::new(),
            settings: settings.padding,
        }
    }

    /// Returns the padding [m].
    pub fn padding(&self) -> f64 {
        self.padding
    }

    /// Returns the exceptions.
    pub fn exceptions(&self) -> &[PaddingException] {
        &self.exceptions
    }

    /// Returns the pairs in contact that no planned joint moves, by name: they are not checked.
    pub fn fixed_contacts(&self) -> Vec<[String; 2]> {
        self.bare.fixed_contacts()
    }

    /// Returns whether nothing touches, regardless of the padding.
    pub fn touches_nothing(&mut self, q: &[f64]) -> bool {
        self.bare.is_free(q)
    }

    /// Returns the distance that motions are proven to keep, regardless of the padding; see
    /// [`ExactChecker::clearance_along`].
    pub fn clearance_along(&mut self, motions: &[Motion], exact: bool, stop: &Stop) -> Option<Clearance> {
        self.bare.clearance_along(motions, exact, stop)
    }

    /// Adds exceptions from the padding around a start or goal, for the pairs that are closer there.
    pub fn relax(&mut self, near: Near, center: &[f64]) {
        if self.full.is_free(center) {
            return;
        }
        let closer = self.full.closer_than_padding(center);
        let closer: Vec<_> = closer.into_iter().filter(|(pair, _)| self.full.pad(*pair) > 0.0).collect();
        if closer.is_empty() || self.zones.iter().any(|zone| zone.center == center) {
            return;
        }
        let (always, here): (Vec<_>, Vec<_>) = closer.into_iter().partition(|(pair, _)| self.is_always_closer(*pair));
        for (pair, contact) in always {
            let radius = f64::INFINITY;
            self.exceptions.push(exception(Near::Everywhere, Vec::new(), radius, &contact));
            self.set_pad_of_all(pair, 0.0);
        }
        if here.is_empty() {
            return;
        }
        let mut zone = Zone { center: center.to_vec(), radius: 0.0, checker: self.full.clone() };
        for (pair, contact) in &here {
            zone.checker.set_pad(*pair, self.settings.distance_ratio * contact.distance.max(0.0));
        }
        zone.radius = self.reach(&mut zone);
        let noted = here.iter().map(|(_, contact)| exception(near, center.to_vec(), zone.radius, contact));
        self.exceptions.extend(noted);
        self.zones.push(zone);
    }

    /// Repeats earlier exceptions in a world that may have changed; pairs added since keep the full padding.
    pub fn relax_again(&mut self, before: &[PaddingException]) {
        for exception in before.iter().filter(|exception| exception.near == Near::Everywhere) {
            if let Some(pair) = self.full.pair_index(&exception.link, &exception.other) {
                self.set_pad_of_all(pair, 0.0);
            }
        }
        for exception in before.iter().filter(|exception| exception.near != Near::Everywhere) {
            let Some(pair) = self.full.pair_index(&exception.link, &exception.other) else { continue };
            let at = self.zones.iter().position(|zone| zone.center == exception.center).unwrap_or(self.zones.len());
            if at == self.zones.len() {
                let (center, radius) = (exception.center.clone(), exception.radius);
                self.zones.push(Zone { center, radius, checker: self.full.clone() });
            }
            if let Some(zone) = self.zones.get_mut(at) {
                zone.checker.set_pad(pair, self.settings.revalidation_ratio * exception.distance.max(0.0));
            }
        }
        self.exceptions = before.to_vec();
    }

    fn set_pad_of_all(&mut self, pair: usize, pad: f64) {
        self.full.set_pad(pair, pad);
        self.zones.iter_mut().for_each(|zone| zone.checker.set_pad(pair, pad));
    }

    /// Returns whether a pair is closer than the padding in all sampled configurations.
    fn is_always_closer(&mut self, pair: usize) -> bool {
        let mut random = Random::new(0);
        let limits = self.full.limits().to_vec();
        (0..self.settings.poses).all(|_| {
            let q: Vec<f64> = limits.iter().map(|l| sample(l.lower, l.upper, &mut random)).collect();
            !self.full.keeps(pair, &q)
        })
    }

    /// Returns the radius at which a zone contains a configuration with the full padding.
    fn reach(&mut self, zone: &mut Zone) -> f64 {
        let mut random = Random::new(0);
        let limits = self.full.limits().to_vec();
        for radius in self.settings.radii {
            for _ in 0..self.settings.tries {
                let away: Vec<f64> = zone.center.iter().map(|_| random.between(-1.0, 1.0)).collect();
                let length = away.iter().map(|x| x * x).sum::<f64>().sqrt().max(1e-9);
                let part = radius * random.between(0.2, 1.0) / length;
                let inside = |((c, d), l): ((&f64, &f64), &Limits)| (c + d * part).max(l.lower).min(l.upper);
                let to: Vec<f64> = zone.center.iter().zip(&away).zip(&limits).map(inside).collect();
                if self.full.is_free(&to) && zone.checker.motion_is_free(&zone.center, &to, &Stop::never()) {
                    return radius;
                }
            }
        }
        self.settings.radii[self.settings.radii.len() - 1]
    }

    /// Returns the parts of a motion at which it enters or leaves a zone.
    fn cuts(&self, from: &[f64], to: &[f64]) -> Vec<f64> {
        let mut cuts = Vec::new();
        let mut met = false;
        for zone in &self.zones {
            // |from + t·d − center|² = radius²
            let away = zone.away(from, self.full.turns());
            let d: Vec<f64> = from.iter().zip(to).map(|(a, b)| b - a).collect();
            let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
            let (a, b, c) = (dot(&d, &d), dot(&away, &d), dot(&away, &away) - zone.radius * zone.radius);
            met |= c <= 0.0;
            let root = b * b - a * c;
            if a > 0.0 && root >= 0.0 {
                let ends = [(-b - root.sqrt()) / a, (-b + root.sqrt()) / a];
                met |= ends[0] <= 1.0 && ends[1] >= 0.0;
                cuts.extend(ends.into_iter().filter(|t| *t > 1e-9 && *t < 1.0 - 1e-9));
            }
        }
        if !met {
            return Vec::new();
        }
        cuts.extend([0.0, 1.0]);
        cuts.sort_by(f64::total_cmp);
        cuts
    }
}

impl Zone {
    /// Returns the offset of a configuration from the center, the short way round for continuous joints.
    fn away(&self, q: &[f64], turns: &[bool]) -> Vec<f64> {
        let apart = |((q, center), turns): ((&f64, &f64), &bool)| {
            let d = q - center;
            if *turns { d - (d / TAU).round() * TAU } else { d }
        };
        q.iter().zip(&self.center).zip(turns).map(apart).collect()
    }

    fn holds(&self, q: &[f64], turns: &[bool]) -> bool {
        self.away(q, turns).iter().map(|x| x * x).sum::<f64>() <= self.radius * self.radius * (1.0 + 1e-9)
    }
}

fn exception(near: Near, center: Vec<f64>, radius: f64, contact: &Contact) -> PaddingException {
    let (link, other, distance) = (contact.link.clone(), contact.other.clone(), contact.distance);
    PaddingException { near, center, radius, link, other, distance }
}

impl CollisionChecker for Padded {
    fn dof(&self) -> usize {
        self.full.dof()
    }

    fn limits(&self) -> &[Limits] {
        self.full.limits()
    }

    fn turns(&self) -> &[bool] {
        self.full.turns()
    }

    fn is_free(&mut self, q: &[f64]) -> bool {
        let Self { full, zones, .. } = self;
        full.is_free(q) || zones.iter_mut().any(|zone| zone.holds(q, full.turns()) && zone.checker.is_free(q))
    }

    fn motion_is_free(&mut self, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        if self.full.motion_is_free(from, to, stop) {
            return true;
        }
        let cuts = if stop.is_over() { Vec::new() } else { self.cuts(from, to) };
        let (mut a, mut b, mut middle) = (from.to_vec(), from.to_vec(), from.to_vec());
        let Self { full, zones, .. } = self;
        let mut piece_is_free = |pair: &[f64]| {
            between(from, to, pair[0], &mut a);
            between(from, to, pair[1], &mut b);
            between(from, to, 0.5 * (pair[0] + pair[1]), &mut middle);
            zones.iter_mut().any(|zone| zone.holds(&middle, full.turns()) && zone.checker.motion_is_free(&a, &b, stop))
                || full.motion_is_free(&a, &b, stop)
        };
        !cuts.is_empty() && cuts.windows(2).all(&mut piece_is_free)
    }

    fn certify_within_budget(&mut self, from: &[f64], to: &[f64], looks_free: bool, stop: &Stop) -> bool {
        self.full.certify_within_budget(from, to, looks_free, stop)
            || (!self.cuts(from, to).is_empty() && self.motion_is_free(from, to, stop))
    }

    fn motion_looks_free(&mut self, from: &[f64], to: &[f64]) -> bool {
        self.motion_looks_free_at(Samples::All, from, to)
    }

    fn motion_looks_free_at(&mut self, samples: Samples, from: &[f64], to: &[f64]) -> bool {
        // Close to a start or goal, where the padding is less, a motion is proven or not.
        self.full.motion_looks_free_at(samples, from, to)
            || (!self.cuts(from, to).is_empty() && self.motion_is_free(from, to, &Stop::never()))
    }

    fn any_contact_batch(&mut self, q: &[Lanes], lanes: u16) -> u16 {
        let blocked = self.full.any_contact_batch(q, lanes);
        if self.zones.is_empty() {
            return blocked;
        }
        let in_zone = |lane: usize| {
            let at: Vec<f64> = q.iter().map(|block| f64::from(block.0[lane])).collect();
            self.zones.iter().any(|zone| zone.holds(&at, self.full.turns()))
        };
        // Close to a start or goal, the padding is less.
        (0..LANES).filter(|lane| blocked >> lane & 1 == 1 && !in_zone(*lane)).fold(0, |all, lane| all | 1 << lane)
    }

    fn first_contact(&mut self, q: &[f64]) -> Option<Pair> {
        if self.is_free(q) { None } else { self.full.first_contact(q) }
    }

    fn clearance(&mut self, q: &[f64]) -> Option<Contact> {
        self.bare.clearance(q)
    }

    fn contacts(&mut self, q: &[f64]) -> Vec<Contact> {
        let Self { full, zones, .. } = self;
        let zone = zones.iter_mut().find(|zone| zone.holds(q, full.turns()));
        zone.map_or_else(|| full.contacts(q), |zone| zone.checker.contacts(q))
    }

    fn checks(&self) -> u64 {
        let own = [&self.full, &self.bare].into_iter().chain(self.zones.iter().map(|zone| &zone.checker));
        own.map(CollisionChecker::checks).sum()
    }
}

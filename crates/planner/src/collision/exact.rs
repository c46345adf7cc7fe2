//! The exact checker: every solid against every other, in double precision, with bounding balls of links to exclude
//! most.

use std::collections::HashMap;
use std::sync::Arc;

use dimos_kernels::block::Lanes;
use dimos_kernels::discrete::Proof;
use glamx::{DAffine3, DVec3};

use dimos_robot::model::Limits;

use super::checker::{CollisionChecker, Samples, Stop};
use super::lanes::InLanes;
use super::motion::Pieces;
use super::pairs::general::{Nearest, distance_up_to, nearest};
use super::pairs::{self, Placed, point};
use super::report::{Contact, Measured, Pair};
use super::scene::{LinkShape, Scene};
use super::settings::{CertificationSettings, CheckSettings};
use super::shape::Core;

/// Distance of a pair compared to a margin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Gap {
    /// Farther apart than the margin.
    Far,
    /// Within the margin.
    Close,
    /// Touching.
    Touch,
}

/// Checks configurations and motions of one scene. Does not allocate once its buffers have grown.
#[derive(Debug, Clone)]
pub struct ExactChecker {
    pub(super) scene: Arc<Scene>,
    pub(super) settings: CheckSettings,
    /// Resolution of the proof under way [m]: finer for small clearances.
    pub(super) resolution: f64,
    frames: Vec<DAffine3>,
    /// Checked pairs, those of the links that move most first. Pair indices refer to this list.
    pub(super) pairs: Vec<Pair>,
    /// Index of a pair of links in the scene, parallel to `pairs`.
    pub(super) link_pairs: Vec<usize>,
    /// The pair that touched last: likely to touch again.
    pub(super) witness: Option<usize>,
    pub(super) pieces: Pieces,
    /// Excludes most pairs, sixteen configurations at a time.
    pub(super) lanes: InLanes,
    pub(super) checks: u64,
    /// Number of exact checks of configurations after which the check of a motion gives up.
    pub(super) exact_checks_left: u64,
    /// Padding of each pair [m], parallel to `pairs`: closer counts as touching.
    pub(super) pads: Vec<f64>,
    /// The largest of them.
    pub(super) most_pad: f64,
    /// Pairs in contact that no joint moves: no motion changes that, so they are not checked.
    still: Vec<Pair>,
    /// Whether triangles decide about any link.
    pub(super) has_surfaces: bool,
    /// Hash of the configuration that all frames are at.
    placed: u64,
    /// While a clearance is searched: for pairs and configurations, the distance and the most that was searched [m].
    pub(super) known: Option<HashMap<(u32, u64), (f64, f64)>>,
}

impl ExactChecker {
    /// Creates a checker of a scene.
    pub fn new(scene: Arc<Scene>, settings: CheckSettings) -> Self {
        let frames = scene.frames();
        let moves = |pair: &Pair| match *pair {
            Pair::Links(a, b) => scene.links[a].moves || scene.links[b].moves,
            Pair::Obstacle(link, _) => scene.links[link].moves,
        };
        let (mut pairs, still): (Vec<Pair>, Vec<Pair>) = scene.all_pairs().partition(moves);
        let link_pair = |pair: &Pair| match *pair {
            Pair::Links(a, b) => scene.pairs.iter().position(|p| (p.a, p.b) == (a, b)).unwrap_or_default(),
            Pair::Obstacle(..) => 0,
        };
        // Links far from the base move most; contacts with obstacles are more frequent than between links.
        let order = |pair: &Pair| match *pair {
            Pair::Obstacle(link, o) => (0, usize::MAX - link, o),
            Pair::Links(a, b) => (1, usize::MAX - b, a),
        };
        pairs.sort_by_key(order);
        let link_pairs = pairs.iter().map(link_pair).collect();
        let pieces = Pieces::new(scene.dof(), pairs.len());
        let pads = vec![0.0; pairs.len()];
        let lanes = InLanes::new(&scene, &pairs, settings.samples_per_rad);
        let mut made = Self {
            pads,
            most_pad: 0.0,
            exact_checks_left: u64::MAX,
            still,
            has_surfaces: scene.has_surfaces(),
            placed: 0,
            known: None,
            frames,
            pairs,
            link_pairs,
            resolution: settings.certification.resolution,
            settings,
            witness: None,
            pieces,
            lanes,
            checks: 0,
            scene: scene.clone(),
        };
        made.place(&vec![0.0; scene.dof()]);
        made.still = made.still.iter().copied().filter(|pair| made.gap_of(*pair, 0.0, 0.0) == Gap::Touch).collect();
        made
    }

    /// Returns the pairs in contact that no joint moves, by name: they are not checked.
    pub fn fixed_contacts(&self) -> Vec<[String; 2]> {
        self.still.iter().filter_map(|pair| self.scene.names(*pair)).collect()
    }

    /// Returns the scene.
    pub fn scene(&self) -> &Arc<Scene> {
        &self.scene
    }

    /// Returns the index of a pair that touches at a configuration.
    pub(super) fn first_touch(&mut self, q: &[f64]) -> Option<usize> {
        let pads = (&self.pads[..], self.most_pad);
        let finite = q.iter().all(|x| x.is_finite());
        if finite && self.lanes.touching(Samples::All, (q, q), pads, self.witness, Proof::Samples, 1.0).0.is_none() {
            self.checks += 1;
            return None;
        }
        self.lanes.set(q);
        let (none, all) = (self.lanes.none.clone(), self.lanes.all.clone());
        let found = self.lanes.find((1, 0.0), &none, &self.pads, &all, self.witness);
        if found.is_some() || self.lanes.close.is_empty() {
            self.checks += 1;
            self.witness = found.or(self.witness);
            return found;
        }
        self.place(q);
        let touches = |i: &usize| self.gap(*i, 0.0) == Gap::Touch;
        let found = self.lanes.close.iter().map(|(pair, _)| *pair as usize).find(touches);
        self.witness = found.or(self.witness);
        found
    }

    /// Moves all frames to a configuration.
    pub(super) fn place(&mut self, q: &[f64]) {
        self.checks += 1;
        self.scene.forward(q, &mut self.frames);
        if self.known.is_some() {
            // FNV-1a, a number at a time.
            self.placed = q.iter().fold(0xcbf2_9ce4_8422_2325, |hash: u64, x| {
                (hash ^ x.to_bits()).wrapping_mul(0x0000_0100_0000_01b3).rotate_left(23)
            });
        }
    }

    /// Returns the current distance of a pair, by index, beyond its padding.
    pub(super) fn gap(&self, pair: usize, margin: f64) -> Gap {
        self.gap_of(self.pairs[pair], self.pads[pair], margin)
    }

    /// Returns the current distance of a pair, by index, beyond its padding; remembers the distance if
    /// [`Self::known`] does, for later checks of the same configuration with another padding.
    pub(super) fn gap_once(&mut self, pair: usize, margin: f64) -> Gap {
        let pad = self.pads[pair];
        let Some(known) = self.known.as_ref() else { return self.gap(pair, margin) };
        let key = (pair as u32, self.placed);
        let found = known.get(&key).copied().filter(|(distance, cutoff)| distance < cutoff || pad + margin < *cutoff);
        let distance = found.map_or_else(
            || {
                let cutoff = (pad + margin) * 1.5 + self.settings.clearance.near;
                let distance = self.distance_up_to(self.pairs[pair], cutoff);
                if let Some(known) = self.known.as_mut() {
                    known.insert(key, (distance, cutoff));
                }
                distance
            },
            |(distance, _)| distance,
        );
        match distance - pad {
            d if d <= 0.0 => Gap::Touch,
            d if d <= margin => Gap::Close,
            _ => Gap::Far,
        }
    }

    /// Returns the current distance of a pair, at most `cutoff` [m]; 0 or less if it touches.
    fn distance_up_to(&self, pair: Pair, cutoff: f64) -> f64 {
        let least = self.least_distance(pair);
        if least >= cutoff {
            return cutoff;
        }
        let mut best = cutoff;
        let mut see = |one: &super::Solid, f: &DAffine3, other: &Placed, radius: f64| {
            let (placed, radii) = (one.place(f), one.radius + radius);
            if pairs::gap(&placed, other) - radii < best {
                let cores = distance_up_to(&placed.decisive(), &other.decisive(), best + radii);
                best = best.min(cores - radii);
            }
        };
        match pair {
            Pair::Links(a, b) => {
                let (first, second) = (&self.scene.links[a], &self.scene.links[b]);
                let (f, g) = (&self.frames[first.frame], &self.frames[second.frame]);
                for one in &first.solids {
                    second.solids.iter().for_each(|two| see(one, f, &two.place(g), two.radius));
                }
            }
            Pair::Obstacle(link, obstacle) => {
                let (link, standing) = (&self.scene.links[link], &self.scene.obstacles[obstacle]);
                let f = &self.frames[link.frame];
                link.solids.iter().for_each(|one| see(one, f, &standing.placed(), standing.solid.radius));
            }
        }
        best
    }

    /// Returns whether a pair touches at the current configuration, without padding.
    pub(super) fn touches(&self, pair: Pair) -> bool {
        self.gap_of(pair, 0.0, 0.0) == Gap::Touch
    }

    fn gap_of(&self, pair: Pair, pad: f64, margin: f64) -> Gap {
        match pair {
            Pair::Links(a, b) => self.gap_of_links(a, b, pad, margin),
            Pair::Obstacle(link, obstacle) => self.gap_to_obstacle(link, obstacle, pad, margin),
        }
    }

    fn center(&self, link: &LinkShape) -> DVec3 {
        self.frames[link.frame].transform_point3(link.ball.0)
    }

    fn gap_to_obstacle(&self, link: usize, obstacle: usize, pad: f64, margin: f64) -> Gap {
        let (link, standing) = (&self.scene.links[link], &self.scene.obstacles[obstacle]);
        let (guard, half) = &standing.guard;
        let extra = standing.solid.radius + pad + margin;
        let reach = link.ball.1 + extra;
        if outside(self.center(link), guard, *half) > reach * reach {
            return Gap::Far;
        }
        let frame = &self.frames[link.frame];
        let mut worst = Gap::Far;
        for solid in &link.solids {
            let radii = solid.radius + standing.solid.radius + pad;
            if let Core::Point = solid.core {
                // The obstacle's bounding box first: that decides most cases, and all distant ones.
                let center = frame.transform_point3(solid.frame.translation);
                let squared = outside(center, guard, *half);
                if squared > radii * radii {
                    let reach = radii + margin;
                    worst = if squared <= reach * reach { Gap::Close } else { worst };
                    continue;
                }
                if standing.boxy {
                    return Gap::Touch;
                }
            }
            let placed = solid.place(frame);
            match gap_of_cores(&placed, &standing.placed(), radii, margin) {
                Gap::Touch => return Gap::Touch,
                Gap::Close => worst = Gap::Close,
                Gap::Far => {}
            }
        }
        worst
    }

    fn gap_of_links(&self, a: usize, b: usize, pad: f64, margin: f64) -> Gap {
        let (first, second) = (&self.scene.links[a], &self.scene.links[b]);
        let (center, radius) = (self.center(second), second.ball.1);
        let reach = first.ball.1 + radius + pad + margin;
        if self.center(first).distance_squared(center) > reach * reach {
            return Gap::Far;
        }
        let (f, g) = (&self.frames[first.frame], &self.frames[second.frame]);
        let mut worst = Gap::Far;
        for one in &first.solids {
            let placed = one.place(f);
            if let Placed::Point(p) = placed {
                let reach = one.radius + radius + pad + margin;
                if p.distance_squared(center) > reach * reach {
                    continue;
                }
            }
            for two in &second.solids {
                if let (Placed::Point(p), Core::Point) = (placed, &two.core) {
                    let squared = p.distance_squared(g.transform_point3(two.frame.translation));
                    let radii = one.radius + two.radius + pad;
                    let reach = radii + margin;
                    if squared <= radii * radii {
                        return Gap::Touch;
                    }
                    worst = if squared <= reach * reach { Gap::Close } else { worst };
                    continue;
                }
                match gap_of_cores(&placed, &two.place(g), one.radius + two.radius + pad, margin) {
                    Gap::Touch => return Gap::Touch,
                    Gap::Close => worst = Gap::Close,
                    Gap::Far => {}
                }
            }
        }
        worst
    }

    pub(super) fn contact(&self, pair: Pair) -> Option<Contact> {
        let scene = &*self.scene;
        let (l, name) = match pair {
            Pair::Links(a, b) => (a, &scene.links[b].name),
            Pair::Obstacle(l, o) => (l, &scene.obstacles[o].name),
        };
        let link = &scene.links[l];
        let mut best: Option<Contact> = None;
        let mut see = |one: &super::Solid, other: &Placed, radius: f64| {
            let (found, by) = measured(&one.place(&self.frames[link.frame]), other);
            let distance = found.distance - one.radius - radius;
            if best.as_ref().is_none_or(|b| distance < b.distance) {
                let towards = (found.b - found.a).normalize_or_zero() * found.distance.signum();
                let (on_link, on_other) = (found.a + towards * one.radius, found.b - towards * radius);
                let (link, other) = (link.name.clone(), name.clone());
                best = Some(Contact { pair, link, other, distance, on_link, on_other, by });
            }
        };
        for one in &link.solids {
            match pair {
                Pair::Links(_, b) => {
                    let LinkShape { solids, frame, .. } = &scene.links[b];
                    solids.iter().for_each(|two| see(one, &two.place(&self.frames[*frame]), two.radius));
                }
                Pair::Obstacle(_, o) => see(one, &scene.obstacles[o].placed(), scene.obstacles[o].solid.radius),
            }
        }
        best
    }

    /// Returns a lower bound of a pair's distance, from the links' bounding balls.
    fn least_distance(&self, pair: Pair) -> f64 {
        let ball = |l: usize| (self.center(&self.scene.links[l]), self.scene.links[l].ball.1);
        match pair {
            Pair::Links(a, b) => ball(a).0.distance(ball(b).0) - ball(a).1 - ball(b).1,
            Pair::Obstacle(l, o) => {
                let standing = &self.scene.obstacles[o];
                outside(ball(l).0, &standing.guard.0, standing.guard.1).sqrt() - standing.solid.radius - ball(l).1
            }
        }
    }
}

/// Returns the closest points of two cores, and what they are measured by.
fn measured(a: &Placed, b: &Placed) -> (Nearest, Measured) {
    let rough = |placed: &Placed| matches!(placed, Placed::Hull(_, hull) if hull.is_rough());
    let by = if rough(a) || rough(b) { Measured::Hull } else { Measured::Shapes };
    if !(a.has_surface() || b.has_surface()) {
        return (nearest(a, b), by);
    }
    let found = nearest(&a.decisive(), &b.decisive());
    if found.distance > 0.0 {
        return (found, by);
    }
    // How deep triangles are in each other is not known: no deeper than their hulls.
    let hulls = nearest(a, b);
    (Nearest { distance: hulls.distance.min(0.0), ..hulls }, if by == Measured::Hull { by } else { Measured::Depth })
}

/// Returns the distance of two cores beyond their radii: that of triangles, where a hull has some.
fn gap_of_cores(a: &Placed, b: &Placed, radii: f64, margin: f64) -> Gap {
    gap_of_these(&a.decisive(), &b.decisive(), radii, margin)
}

fn gap_of_these(a: &Placed, b: &Placed, radii: f64, margin: f64) -> Gap {
    use Placed::{Cylinder, Point, Segment};
    let closed_form = matches!(
        (a, b),
        (Point(_), Point(_) | Segment(..) | Placed::Box(..) | Cylinder(..))
            | (Segment(..), Point(_) | Segment(..) | Placed::Box(..))
            | (Placed::Box(..), Point(_) | Segment(..))
            | (Cylinder(..), Point(_))
    );
    if closed_form {
        return match pairs::distance(a, b) - radii {
            d if d <= 0.0 => Gap::Touch,
            d if d <= margin => Gap::Close,
            _ => Gap::Far,
        };
    }
    // Most pairs are far.
    if pairs::gap(a, b) > radii + margin || (margin > 0.0 && !pairs::within(a, b, radii + margin)) {
        Gap::Far
    } else if pairs::within(a, b, radii) {
        Gap::Touch
    } else if margin > 0.0 {
        Gap::Close
    } else {
        Gap::Far
    }
}

/// Returns the squared distance of a point from a box.
fn outside(p: DVec3, frame: &DAffine3, half: DVec3) -> f64 {
    (point::local(p, frame).abs() - half).max(DVec3::ZERO).length_squared()
}

impl Scene {
    /// Returns the names of a pair's members.
    fn names(&self, pair: Pair) -> Option<[String; 2]> {
        let link = |l: usize| self.links.get(l).map(|link| link.name.clone());
        Some(match pair {
            Pair::Links(a, b) => [link(a)?, link(b)?],
            Pair::Obstacle(l, o) => [link(l)?, self.obstacles.get(o)?.name.clone()],
        })
    }

    /// Returns every pair that must not touch.
    pub fn all_pairs(&self) -> impl Iterator<Item = Pair> + '_ {
        let checked = move |l: usize, o: &usize| !self.touch.contains(&(l, *o));
        let obstacle =
            move |l: usize| (0..self.obstacles.len()).filter(move |o| checked(l, o)).map(move |o| Pair::Obstacle(l, o));
        let links = self.pairs.iter().map(|p| Pair::Links(p.a, p.b));
        (0..self.links.len()).flat_map(obstacle).chain(links)
    }
}

impl CollisionChecker for ExactChecker {
    fn dof(&self) -> usize {
        self.scene.dof()
    }

    fn limits(&self) -> &[Limits] {
        self.scene.limits()
    }

    fn turns(&self) -> &[bool] {
        self.scene.turns()
    }

    fn is_free(&mut self, q: &[f64]) -> bool {
        self.first_contact(q).is_none()
    }

    fn motion_is_free(&mut self, from: &[f64], to: &[f64], stop: &Stop) -> bool {
        self.check_motion(from, to, stop)
    }

    fn certify_within_budget(&mut self, from: &[f64], to: &[f64], looks_free: bool, stop: &Stop) -> bool {
        let CertificationSettings { budget, mesh_budget, .. } = self.settings.certification;
        let budget = if self.has_surfaces { mesh_budget } else { budget };
        self.is_free_within(budget, (from, to), looks_free, stop)
    }

    fn motion_looks_free(&mut self, from: &[f64], to: &[f64]) -> bool {
        self.motion_looks_free_at(Samples::All, from, to)
    }

    fn motion_looks_free_at(&mut self, samples: Samples, from: &[f64], to: &[f64]) -> bool {
        let pads = (&self.pads[..], self.most_pad);
        let (found, looked) = self.lanes.touching(samples, (from, to), pads, self.witness, Proof::None, 1.0);
        self.checks += looked;
        self.witness = found.or(self.witness);
        found.is_none()
    }

    fn any_contact_batch(&mut self, q: &[Lanes], lanes: u16) -> u16 {
        self.checks += u64::from(lanes.count_ones());
        self.lanes.touching_lanes(q, (&self.pads, self.most_pad), lanes)
    }

    fn first_contact(&mut self, q: &[f64]) -> Option<Pair> {
        self.first_touch(q).map(|i| self.pairs[i])
    }

    fn clearance(&mut self, q: &[f64]) -> Option<Contact> {
        self.place(q);
        let mut best: Option<Contact> = None;
        // Only pairs that a motion can change: a base on its table keeps its distance.
        for pair in self.pairs.clone() {
            if best.as_ref().is_none_or(|b| self.least_distance(pair) < b.distance)
                && let Some(contact) = self.contact(pair)
                && best.as_ref().is_none_or(|b| contact.distance < b.distance)
            {
                best = Some(contact);
            }
        }
        best
    }

    fn contacts(&mut self, q: &[f64]) -> Vec<Contact> {
        self.place(q);
        let all = self.pairs.iter().zip(&self.pads);
        let touching = all.filter(|(pair, pad)| self.gap_of(**pair, **pad, 0.0) == Gap::Touch);
        let mut contacts: Vec<Contact> = touching.filter_map(|(pair, _)| self.contact(*pair)).collect();
        contacts.sort_by(|a, b| a.distance.total_cmp(&b.distance));
        contacts
    }

    fn checks(&self) -> u64 {
        self.checks
    }
}

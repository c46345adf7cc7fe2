//! Whether a start or a goal is enclosed: whether a joint that must move to the other end of the path cannot leave a
//! part of its range.
//!
//! One tree with short edges explores what can be reached (LaValle, 1998). A joint that does not get farther says
//! little: among many joints, one is often slow. It is believed in two cases:
//! - a **pocket**: no joint gets farther, other than those that have their whole range;
//! - a **wall**: at some position of the joint, on the way to the other end, the arm touches whatever the others do.
//!
//! It is no proof: a narrow way out may be missed. So it is asked only once a search has taken long.

use super::nearest::Tree;
use super::path::{between, unwind};
use super::settings::EnclosureSettings;
use crate::collision::checker::{CollisionChecker, Stop};
use crate::collision::report::{Contact, Pair};
use dimos_robot::random::Random;

/// An enclosure of a configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct Enclosed {
    /// The joint that cannot get to the other end.
    pub joint: usize,
    /// The part of its range that was reached [rad or m].
    pub reached: [f64; 2],
    /// Contacts beyond that, the most frequent pair first.
    pub contacts: Vec<Contact>,
}

impl Enclosed {
    /// Returns the pairs in the way as text.
    pub fn pairs(&self) -> String {
        let pairs: Vec<String> = self.contacts.iter().map(named).collect();
        pairs.join("; ")
    }
}

fn named(contact: &Contact) -> String {
    let kind = if matches!(contact.pair, Pair::Links(..)) { "link" } else { "obstacle" };
    format!("link {:?} and {kind} {:?}{}", contact.link, contact.other, contact.note())
}

/// Returns what encloses `from`, if nothing leads to any of `others`. Where covers touch, solids decide. The same
/// settings and seed explore the same way.
pub fn enclosed<C: CollisionChecker>(
    checker: &mut C,
    from: &[f64],
    others: &[Vec<f64>],
    (settings, seed): (&EnclosureSettings, u64),
    stop: &Stop,
) -> Option<Enclosed> {
    if from.len() > settings.max_joints {
        return None;
    }
    let mut explored = Explored::new(checker, from, (settings, seed));
    explored.grow(checker, others, settings.edges / 2, stop)?;
    explored.halfway.clone_from(&explored.reached);
    explored.grow(checker, others, settings.edges / 2, stop)?;
    let (pocket, turns) = (explored.is_pocket(), checker.turns().to_vec());
    let mut widest: Option<(usize, f64, f64)> = None;
    for other in others {
        let gap = |joint: usize| explored.gap(joint, other[joint]).filter(|_| !turns[joint]).map(|gap| (joint, gap));
        let mut gaps: Vec<(usize, f64)> = (0..from.len()).filter_map(gap).collect();
        gaps.sort_by(|(_, a), (_, b)| b.total_cmp(a));
        let mut encloses = |joint: usize| pocket || explored.is_walled(checker, joint, other[joint], stop);
        let (joint, gap) = gaps.into_iter().find(|(joint, _)| encloses(*joint))?;
        if widest.is_none_or(|(.., most)| gap > most) {
            widest = Some((joint, other[joint], gap));
        }
    }
    let (joint, other, _) = widest?;
    let reached = explored.reached[joint];
    Some(Enclosed { joint, reached, contacts: explored.in_the_way(checker, joint, other > reached[1]) })
}

/// The set of configurations that were reached.
struct Explored {
    settings: EnclosureSettings,
    tree: Tree,
    random: Random,
    /// Where samples are drawn, per joint [rad or m].
    ranges: Vec<[f64; 2]>,
    /// Range that was reached, per joint.
    reached: Vec<[f64; 2]>,
    /// The same after half of the edges.
    halfway: Vec<[f64; 2]>,
    sample: Vec<f64>,
    at: Vec<f64>,
}

impl Explored {
    fn new<C: CollisionChecker>(checker: &C, from: &[f64], (settings, seed): (&EnclosureSettings, u64)) -> Self {
        let mut tree = Tree::new(checker.turns());
        tree.add(from, None);
        let pi = std::f64::consts::PI;
        let finite = |limit: f64, otherwise: f64| if limit.is_finite() { limit } else { otherwise };
        let ranges = checker.limits().iter().zip(from);
        let ranges = ranges.map(|(l, q)| [finite(l.lower, q - pi), finite(l.upper, q + pi)]).collect();
        let reached: Vec<[f64; 2]> = from.iter().map(|q| [*q; 2]).collect();
        let (halfway, random, sample, at) = (reached.clone(), Random::new(seed), from.to_vec(), from.to_vec());
        Self { settings: *settings, tree, random, ranges, reached, halfway, sample, at }
    }

    /// Returns the range of a joint [rad or m].
    fn range(&self, joint: usize) -> f64 {
        let [low, high] = self.ranges[joint];
        high - low
    }

    /// Returns whether a joint got no farther, downwards and upwards, in the second half of the edges.
    fn still(&self, joint: usize) -> [bool; 2] {
        let ([low, high], [low_before, high_before]) = (self.reached[joint], self.halfway[joint]);
        let most = self.settings.still.min(self.settings.still_part * self.range(joint));
        [low_before - low <= most, high - high_before <= most]
    }

    /// Returns whether no joint gets farther, other than those that have their whole range.
    fn is_pocket(&self) -> bool {
        let whole =
            |joint: usize| self.reached[joint][1] - self.reached[joint][0] >= self.settings.whole * self.range(joint);
        (0..self.reached.len()).all(|joint| whole(joint) || self.still(joint) == [true; 2])
    }

    /// Returns how far a position is outside of what was reached [rad or m], if that is far and the joint got no
    /// farther on that side.
    fn gap(&self, joint: usize, other: f64) -> Option<f64> {
        let [low, high] = self.reached[joint];
        let (below, above) = (low - other, other - high);
        let gap = below.max(above);
        (gap >= self.settings.gap && self.still(joint)[usize::from(above > below)]).then_some(gap)
    }

    /// Tries this number of edges; `None` if it was stopped.
    fn grow<C: CollisionChecker>(
        &mut self,
        checker: &mut C,
        others: &[Vec<f64>],
        edges: usize,
        stop: &Stop,
    ) -> Option<()> {
        let turns = checker.turns().to_vec();
        for edge in 0..edges {
            if edge.is_multiple_of(self.settings.bias) && stop.is_over() {
                return None;
            }
            self.draw(others, edge);
            let (nearest, far) = self.tree.nearest(&self.sample);
            if far < 1e-6 {
                continue;
            }
            let node = self.tree.node(nearest);
            unwind(&mut self.sample, node, &turns);
            between(node, &self.sample, (self.settings.step / far).min(1.0), &mut self.at);
            let free = checker.motion_looks_free(node, &self.at)
                || (checker.is_free(&self.at) && checker.motion_is_free(node, &self.at, stop));
            if free {
                for ([low, high], q) in self.reached.iter_mut().zip(&self.at) {
                    (*low, *high) = (low.min(*q), high.max(*q));
                }
                self.tree.add(&self.at, Some(nearest));
            }
        }
        Some(())
    }

    fn draw(&mut self, others: &[Vec<f64>], edge: usize) {
        let bias = self.settings.bias;
        if let Some(other) = others.get((edge / bias) % others.len().max(1)).filter(|_| edge.is_multiple_of(bias)) {
            return self.sample.copy_from_slice(other);
        }
        self.draw_anywhere(edge % 4 == 1);
    }

    /// Draws a configuration, near to one that was reached or not.
    fn draw_anywhere(&mut self, near: bool) {
        let nearby = self.settings.nearby;
        let around = near.then(|| self.random.below(self.tree.len()));
        let around = around.map(|node| self.tree.node(node));
        for (joint, (q, [low, high])) in self.sample.iter_mut().zip(&self.ranges).enumerate() {
            *q = match around.and_then(|node| node.get(joint)) {
                Some(near) => self.random.between((near - nearby).max(*low), (near + nearby).min(*high)),
                None => self.random.between(*low, *high),
            };
        }
    }

    /// Returns whether a joint has a position, between what was reached and `other`, at which nothing is free.
    fn is_walled<C: CollisionChecker>(&mut self, checker: &mut C, joint: usize, other: f64, stop: &Stop) -> bool {
        let [low, high] = self.reached[joint];
        let (edge, far) = if other > high { (high, other - high) } else { (low, other - low) };
        let EnclosureSettings { walls, first_wall, tries, last_tries, .. } = self.settings;
        let walls = (0..walls as i32).map(|k| first_wall * 2.0_f64.powi(k)).take_while(|away| *away < far.abs());
        let walls = walls.map(|away| edge + away * far.signum());
        let blocked: Vec<f64> = walls.filter(|&at| self.is_blocked(checker, (joint, at), tries, stop)).collect();
        // The middle one is the most likely.
        blocked.get(blocked.len() / 2).is_some_and(|&at| self.is_blocked(checker, (joint, at), last_tries, stop))
    }

    /// Returns whether none of a number of configurations with a joint at a position is free.
    fn is_blocked<C: CollisionChecker>(
        &mut self,
        checker: &mut C,
        (joint, at): (usize, f64),
        tries: usize,
        stop: &Stop,
    ) -> bool {
        (0..tries).all(|number| {
            self.draw_anywhere(number % 2 == 1);
            self.sample[joint] = at;
            let q = &self.sample;
            !(stop.is_over() || checker.motion_looks_free(q, q) || checker.is_free(q))
        })
    }

    /// Returns what touches a little beyond the configurations that reached the end of a joint's part.
    fn in_the_way<C: CollisionChecker>(&self, checker: &mut C, joint: usize, above: bool) -> Vec<Contact> {
        let sign = if above { 1.0 } else { -1.0 };
        let mut ends: Vec<usize> = (0..self.tree.len()).collect();
        ends.sort_by(|a, b| (sign * self.tree.node(*b)[joint]).total_cmp(&(sign * self.tree.node(*a)[joint])));
        let mut seen: Vec<(usize, Contact)> = Vec::new();
        for node in ends.into_iter().take(self.settings.probes) {
            let mut q = self.tree.node(node).to_vec();
            q[joint] += sign * self.settings.beyond;
            let Some(contact) = checker.contacts(&q).into_iter().next() else { continue };
            match seen.iter_mut().find(|(_, other)| other.pair == contact.pair) {
                Some((times, _)) => *times += 1,
                None => seen.push((1, contact)),
            }
        }
        seen.sort_by_key(|(times, _)| std::cmp::Reverse(*times));
        seen.into_iter().take(self.settings.named).map(|(_, contact)| contact).collect()
    }
}

//! Whether a start or a goal is enclosed: whether a joint that must move to the other end of the path cannot leave a
//! part of its range, however the others move.
//!
//! One tree with short edges explores what can be reached (LaValle, 1998). It is no proof: a narrow way out may be
//! missed. So it is asked only once a search has taken long, and is believed only if what it reaches has not become
//! wider in the second half of its edges.

use super::nearest::Tree;
use super::path::{between, unwind};
use crate::collision::checker::{CollisionChecker, Stop};
use crate::collision::report::{Contact, Pair};
use crate::robot::random::Random;

/// Most joints: with those of two arms, so few edges reach too little to say anything.
const JOINTS: usize = 8;
/// Edges that are tried.
const EDGES: usize = 6000;
/// Length of an edge [rad].
const STEP: f64 = 0.15;
/// A quarter of the samples are within this distance of what is reached [rad].
const NEARBY: f64 = 0.5;
/// One of this number of samples is the other end of the path.
const BIAS: usize = 8;
/// How much wider the part of a joint's range may become in the second half of the edges [rad].
const STILL: f64 = 0.02;
/// How far outside of that part the other end must be [rad].
const GAP: f64 = 0.1;
/// Configurations at its end that are checked for what is in the way.
const LOOKS: usize = 40;
/// How far they are moved on [rad].
const BEYOND: f64 = 0.05;
/// Most pairs that are named.
const NAMED: usize = 3;

/// What encloses a configuration.
#[derive(Debug, Clone, PartialEq)]
pub struct Enclosed {
    /// The joint that cannot get to the other end.
    pub joint: usize,
    /// The part of its range that was reached [rad or m].
    pub reached: [f64; 2],
    /// What touches beyond that, the most frequent pair first.
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
    format!("link {:?} and {kind} {:?}", contact.link, contact.other)
}

/// Returns what encloses `from`, if each of `others` is outside of what was reached from it. The same seed explores the
/// same way.
pub fn enclosed<C: CollisionChecker>(
    checker: &mut C,
    from: &[f64],
    others: &[Vec<f64>],
    seed: u64,
    stop: &Stop,
) -> Option<Enclosed> {
    if from.len() > JOINTS {
        return None;
    }
    let mut explored = Explored::new(checker, from, seed);
    explored.grow(checker, others, EDGES / 2, stop)?;
    let before = explored.reached.clone();
    explored.grow(checker, others, EDGES / 2, stop)?;
    let turns = checker.turns().to_vec();
    let still = |joint: &usize| {
        let ([low, high], [low_before, high_before]) = (explored.reached[*joint], before[*joint]);
        !turns[*joint] && low_before - low <= STILL && high - high_before <= STILL
    };
    let joints: Vec<usize> = (0..from.len()).filter(still).collect();
    let gap = |other: &[f64], joint: usize| {
        let [low, high] = explored.reached[joint];
        (low - other[joint]).max(other[joint] - high)
    };
    let mut widest: Option<(usize, &Vec<f64>, f64)> = None;
    for other in others {
        let joint = joints.iter().copied().max_by(|a, b| gap(other, *a).total_cmp(&gap(other, *b)))?;
        let wide = gap(other, joint);
        if wide < GAP {
            return None;
        }
        if widest.is_none_or(|(.., most)| wide > most) {
            widest = Some((joint, other, wide));
        }
    }
    let (joint, other, _) = widest?;
    let reached = explored.reached[joint];
    Some(Enclosed { joint, reached, contacts: explored.in_the_way(checker, joint, other[joint] > reached[1]) })
}

/// What can be reached.
struct Explored {
    tree: Tree,
    random: Random,
    /// Where samples are drawn, per joint [rad or m].
    ranges: Vec<[f64; 2]>,
    /// What was reached, per joint.
    reached: Vec<[f64; 2]>,
    sample: Vec<f64>,
    at: Vec<f64>,
}

impl Explored {
    fn new<C: CollisionChecker>(checker: &C, from: &[f64], seed: u64) -> Self {
        let mut tree = Tree::new(checker.turns());
        tree.add(from, None);
        let pi = std::f64::consts::PI;
        let finite = |limit: f64, otherwise: f64| if limit.is_finite() { limit } else { otherwise };
        let ranges = checker.limits().iter().zip(from);
        let ranges = ranges.map(|(l, q)| [finite(l.lower, q - pi), finite(l.upper, q + pi)]).collect();
        let reached = from.iter().map(|q| [*q; 2]).collect();
        Self { tree, random: Random::new(seed), ranges, reached, sample: from.to_vec(), at: from.to_vec() }
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
            if edge.is_multiple_of(BIAS) && stop.is_over() {
                return None;
            }
            self.draw(others, edge);
            let (nearest, far) = self.tree.nearest(&self.sample);
            if far < 1e-6 {
                continue;
            }
            let node = self.tree.node(nearest);
            unwind(&mut self.sample, node, &turns);
            between(node, &self.sample, (STEP / far).min(1.0), &mut self.at);
            // Where covers touch, what they cover may be free.
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
        if let Some(other) = others.get((edge / BIAS) % others.len().max(1)).filter(|_| edge.is_multiple_of(BIAS)) {
            return self.sample.copy_from_slice(other);
        }
        let around = (edge % 4 == 1).then(|| self.random.below(self.tree.len()));
        let around = around.map(|node| self.tree.node(node));
        for (joint, (q, [low, high])) in self.sample.iter_mut().zip(&self.ranges).enumerate() {
            *q = match around.and_then(|node| node.get(joint)) {
                Some(near) => self.random.between((near - NEARBY).max(*low), (near + NEARBY).min(*high)),
                None => self.random.between(*low, *high),
            };
        }
    }

    /// Returns what touches a little beyond the configurations that reached the end of a joint's part.
    fn in_the_way<C: CollisionChecker>(&self, checker: &mut C, joint: usize, above: bool) -> Vec<Contact> {
        let sign = if above { 1.0 } else { -1.0 };
        let mut ends: Vec<usize> = (0..self.tree.len()).collect();
        ends.sort_by(|a, b| (sign * self.tree.node(*b)[joint]).total_cmp(&(sign * self.tree.node(*a)[joint])));
        let mut seen: Vec<(usize, Contact)> = Vec::new();
        for node in ends.into_iter().take(LOOKS) {
            let mut q = self.tree.node(node).to_vec();
            q[joint] += sign * BEYOND;
            let Some(contact) = checker.contacts(&q).into_iter().next() else { continue };
            match seen.iter_mut().find(|(_, other)| other.pair == contact.pair) {
                Some((times, _)) => *times += 1,
                None => seen.push((1, contact)),
            }
        }
        seen.sort_by_key(|(times, _)| std::cmp::Reverse(*times));
        seen.into_iter().take(NAMED).map(|(_, contact)| contact).collect()
    }
}

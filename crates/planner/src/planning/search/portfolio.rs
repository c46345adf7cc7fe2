//! Several searches for one path, a quantum of each in turn: with long and with short edges; with edges that are
//! checked at samples only, which is quick, and with proven ones, which reach where covers are too thick. Whichever
//! finds a path first by the count of edges, not by time: the same request gives the same path.

use crate::collision::checker::{CollisionChecker, Stop};

use super::edges::{EdgeCheck, EdgeChecker};
use super::level::Level;
use super::path::Path;
use super::rrt_connect::{Quantum, Search, SearchCount};
use super::settings::{PlanSettings, PortfolioSettings, RrtSettings};

/// Why a search returned without a path.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Halt {
    /// It has taken long. Returned once; the search can be continued.
    TookLong,
    /// Stopped by its deadline or a cancel.
    Stopped,
    /// Reached its maximum number of samples or nodes.
    Exhausted,
}

/// A path that was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// Its configurations.
    pub path: Path,
    /// How its edges were checked.
    pub edges: EdgeCheck,
}

/// The searches.
#[derive(Debug, Clone)]
pub struct Portfolio {
    start: Vec<f64>,
    goals: Vec<Vec<f64>>,
    members: Vec<Member>,
    search: RrtSettings,
    turns: PortfolioSettings,
    level: Level,
    turn: usize,
    round: u32,
    took_long: bool,
    /// Statistics of searches that ended.
    ended: SearchCount,
}

#[derive(Debug, Clone)]
struct Member {
    range: f64,
    /// Place in the order of the ranges.
    number: u64,
    seed: u64,
    edges: EdgeCheck,
    /// Prepared at its first turn.
    search: Option<Search>,
}

impl Portfolio {
    /// Prepares the searches from `start` to any of `goals`; all of them must be free. `level`: that of the settings,
    /// or one that proves more.
    pub fn new(start: &[f64], goals: &[Vec<f64>], settings: &PlanSettings, level: Level) -> Self {
        let PlanSettings { seed, search, portfolio: turns, .. } = *settings;
        // A search is large to move: room for all of them.
        let (mut members, mut ranges) = (Vec::with_capacity(2 * search.ranges.len()), search.ranges);
        if start.len() > turns.joints_of_one_arm {
            ranges.reverse();
        }
        for edges in [EdgeCheck::Coarse, EdgeCheck::Exact] {
            if (level == Level::Fast && edges == EdgeCheck::Exact)
                || (level == Level::Exact && edges == EdgeCheck::Coarse)
            {
                continue;
            }
            for (number, range) in (0..).zip(ranges) {
                let seed = if number == 0 { seed } else { seed.rotate_left(32) + number };
                members.push(Member { range, number, seed, edges, search: None });
            }
        }
        Self {
            start: start.to_vec(),
            goals: goals.to_vec(),
            members,
            search,
            turns,
            level,
            turn: 0,
            round: 0,
            took_long: false,
            ended: SearchCount::default(),
        }
    }

    /// Returns the statistics of all searches.
    pub fn count(&self) -> SearchCount {
        let counts = self.members.iter().filter_map(|member| member.search.as_ref().map(Search::count));
        counts.fold(self.ended, |sum, count| SearchCount {
            samples: sum.samples + count.samples,
            nodes: sum.nodes + count.nodes,
        })
    }

    /// Returns the next path. At the next call, the search that found it checks the edges of its paths as far as the
    /// level asks for, or has ended if it did so before; the others continue.
    pub fn next<C: CollisionChecker>(&mut self, checker: &mut C, stop: &Stop) -> Result<Candidate, Halt> {
        loop {
            let count = self.count();
            if stop.is_over() {
                return Err(Halt::Stopped);
            }
            let (most, turns) = (&self.search, &self.turns);
            if self.members.is_empty() || count.samples >= most.max_samples || count.nodes >= most.max_nodes {
                return Err(Halt::Exhausted);
            }
            if self.turn >= self.members.len() {
                self.turn = 0;
                self.round = (self.round + 1).min(turns.doublings);
            }
            if self.round == turns.long_rounds && !std::mem::replace(&mut self.took_long, true) {
                return Err(Halt::TookLong);
            }
            let Member { range, number, seed, edges, search } = &mut self.members[self.turn];
            let (start, goals) = (&self.start, &self.goals);
            let search = search.get_or_insert_with(|| {
                Search::new(start, goals, (checker.limits(), checker.turns()), most, *range, *seed)
            });
            let checked = *edges;
            let main_share = if start.len() > turns.joints_of_one_arm { 1 } else { turns.main_share };
            let share = if *number == 0 { main_share } else { 1 };
            let cost = if checked == EdgeCheck::Exact { turns.proof_cost } else { 1 };
            let quantum = Quantum {
                edges: (turns.first_quantum << self.round) * share / cost,
                samples: most.max_samples - count.samples,
                nodes: most.max_nodes - count.nodes,
            };
            let mut check = EdgeChecker { checker, edges: checked, stop };
            if let Some(path) = search.run(&mut check, quantum, stop) {
                if checked == EdgeCheck::Coarse {
                    *edges = if self.level.proves() { EdgeCheck::Certified } else { EdgeCheck::Sampled };
                } else {
                    let count = search.count();
                    self.ended.samples += count.samples;
                    self.ended.nodes += count.nodes;
                    self.members.remove(self.turn);
                }
                return Ok(Candidate { path, edges: checked });
            }
            self.turn += 1;
        }
    }
}

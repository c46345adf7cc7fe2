//! Refinement: a path that was found is made shorter, for as many rounds as are asked for. In turn, another search
//! tries another way, and random cuts shorten the best path. A search uses samples only where a shorter path may
//! pass: their distances from start and goal add up to less than the best length (Gammell, Srinivasa and Barfoot,
//! "Informed RRT*", 2014).
//!
//! The rounds are counted, so the same request gives the same path, and more rounds never give a longer one.

use crate::collision::checker::{CollisionChecker, Stop};
use dimos_robot::random::Random;

use super::edges::{EdgeCheck, EdgeChecker};
use super::path::{Path, between, distance, length, tidy};
use super::path_planner::is_proven;
use super::rrt_connect::Search;
use super::settings::{PlanSettings, RefineSettings, RrtSettings};
use super::shortcut::{IsFree, shorten};

/// Makes a free path from its first configuration to any of `goals` shorter. Returns the given path and shorter ones,
/// the shortest last, and the number of rounds, at most `settings.refine`; fewer if stopped.
pub fn refine<C: CollisionChecker>(
    checker: &mut C,
    path: Path,
    goals: &[Vec<f64>],
    settings: &PlanSettings,
    stop: &Stop,
) -> (Vec<Path>, u32) {
    let Some(start) = path.first().cloned() else { return (vec![path], 0) };
    let RefineSettings { cuts, min_gain, distinct, .. } = settings.refinement;
    let mut all = vec![path];
    let mut random = Random::new(settings.seed);
    for round in 0..settings.refine {
        let best = &all[all.len() - 1];
        // Nothing is shorter than a straight line to the nearest goal.
        if stop.is_over() || best.len() <= 2 {
            return (all, round);
        }
        let tried = if round % 2 == 0 {
            cut(best, cuts, &mut random, &mut |a, b| checker.motion_looks_free(a, b))
        } else {
            // The longest edges last: with them the path was found, most likely.
            let ranges = &settings.search.ranges;
            let range = ranges[(round as usize / 2 + 1) % ranges.len()];
            let search = (&settings.search, range, random.bits());
            another(checker, (&start, goals), length(best), search, settings, stop)
        };
        let shorter = tried.filter(|tried| length(tried) < length(best) - min_gain);
        if let Some(shorter) = shorter
            && is_proven(checker, &shorter, settings.level, stop)
        {
            // Of many that are hardly shorter, the last is enough.
            if let [.., before, last] = &all[..]
                && length(last) > distinct * length(before)
            {
                all.pop();
            }
            all.push(shorter);
        }
    }
    (all, settings.refine)
}

/// Searches for another path that is shorter than `most` [rad].
fn another<C: CollisionChecker>(
    checker: &mut C,
    (start, goals): (&[f64], &[Vec<f64>]),
    most: f64,
    (search, range, seed): (&RrtSettings, f64, u64),
    settings: &PlanSettings,
    stop: &Stop,
) -> Option<Path> {
    let turns = checker.turns().to_vec();
    let limits = checker.limits().to_vec();
    let mut search = Search::new(start, goals, (&limits, &turns), search, range, seed).shorter_than(most);
    // Only a proof follows.
    let edges = if settings.level.proves() { EdgeCheck::Coarse } else { EdgeCheck::Sampled };
    let found = search.run(&mut EdgeChecker { checker, edges, stop }, settings.refinement.effort, stop)?;
    Some(shorten(&found, &turns, &settings.shortcut, &mut |a, b| checker.motion_looks_free(a, b)))
}

/// Cuts from random places of a path to others (Geraerts and Overmars, 2007); `None` if none makes it shorter.
pub(in crate::planning) fn cut(path: &Path, cuts: usize, random: &mut Random, is_free: IsFree<'_>) -> Option<Path> {
    let (mut path, mut whole, mut shorter) = (path.clone(), length(path), false);
    for _ in 0..cuts {
        // A straight path has no corner to cut.
        if path.len() <= 2 {
            break;
        }
        let (a, b) = (random.between(0.0, whole), random.between(0.0, whole));
        let (first, last) = (place(&path, a.min(b)), place(&path, a.max(b)));
        if first.0 == last.0 || !is_free(&first.1, &last.1) {
            continue;
        }
        path.splice(first.0 + 1..=last.0, [first.1, last.1]);
        path = tidy(path);
        (whole, shorter) = (length(&path), true);
    }
    shorter.then_some(path)
}

/// Returns the configuration of a path after a length [rad], and the index of its edge.
fn place(path: &Path, after: f64) -> (usize, Vec<f64>) {
    let mut left = after;
    for (i, edge) in path.windows(2).enumerate() {
        let own = distance(&edge[0], &edge[1]);
        if left <= own || i + 2 == path.len() {
            let mut at = edge[0].clone();
            between(&edge[0], &edge[1], if own > 0.0 { (left / own).min(1.0) } else { 0.0 }, &mut at);
            return (i, at);
        }
        left -= own;
    }
    (0, path[0].clone())
}

//! Path search: from a start to the nearest reachable goal, collision-free at the checker's resolution.

use std::time::{Duration, Instant};

use crate::collision::checker::{CollisionChecker, Stop};
use crate::collision::report::Contact;
use dimos_robot::random::Random;

use super::edges::EdgeCheck;
use super::enclosure::{Enclosed, enclosed};
use super::level::Level;
use super::path::{Path, between, distance, length, unwind};
use super::portfolio::{Candidate, Halt, Portfolio};
use super::refine::{cut, refine};
use super::rrt_connect::SearchCount;
use super::sampled::Sampled;
use super::settings::{EnclosureSettings, EscapeSettings, PlanSettings};
use super::shortcut::shorten;
use crate::planning::timing::settings::TimingSettings;
use crate::planning::timing::{Timed, TimingError, time};
use dimos_core::joint::JointBounds;

/// A path and statistics of its search.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Configurations joined by straight lines, from the start to one of the goals.
    pub path: Path,
    /// Its length [rad].
    pub length: f64,
    /// Joints of the goal that were moved to their limits: index and requested position [rad or m].
    pub clamped: Vec<(usize, f64)>,
    /// Whether the straight line was free.
    pub straight: bool,
    /// Whether every edge is proven free; otherwise it was only checked at samples.
    pub proven: bool,
    /// The seed used.
    pub seed: u64,
    /// Statistics of the tree search.
    pub count: SearchCount,
    /// Collision checks made.
    pub checks: u64,
    /// Duration of the search.
    pub search_time: Duration,
    /// Duration of the shortcutting.
    pub shorten_time: Duration,
    /// The paths that refinement made shorter, the longest first, each with what was `clamped`: one of them may be the
    /// quicker motion.
    pub longer: Vec<(Path, Vec<(usize, f64)>)>,
    /// Rounds of refinement.
    pub refined: u32,
    /// Their duration.
    pub refine_time: Duration,
}

impl Plan {
    /// Returns the path of the quickest motion, with what was `clamped`: the shortest path may turn more often than
    /// others, or by more of the slower joints. `names`, `bounds`, `settings` and `free` are those of the timing.
    pub fn quickest(
        self,
        names: &[String],
        bounds: &[JointBounds],
        settings: &TimingSettings,
        mut free: impl FnMut(&[f64], &[f64]) -> bool,
    ) -> Way {
        let mut ways = self.longer;
        ways.push((self.path, self.clamped));
        if ways.len() == 1 {
            return ways.pop().unwrap_or_default();
        }
        let duration = |timed: Result<Timed, TimingError>| timed.map_or(f64::INFINITY, |timed| timed.duration);
        // Corners that collide are passed closer, which takes longer: the shortest of these times may not be possible,
        // but most often it is, and the checks of all others are spared.
        let bound = |way: &Way| duration(time(names, &way.0, bounds, settings, |_, _| true));
        let mut ways: Vec<(f64, Way)> = ways.into_iter().rev().map(|way| (bound(&way), way)).collect();
        ways.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut best = (f64::INFINITY, 0);
        for (i, (bound, way)) in ways.iter().enumerate() {
            if *bound >= best.0 {
                break;
            }
            let duration = duration(time(names, &way.0, bounds, settings, &mut free));
            if duration < best.0 {
                best = (duration, i);
            }
        }
        ways.swap_remove(best.1).1
    }
}

/// A path, and the joints of its goal that were moved to their limits: index and requested position [rad or m].
type Way = (Path, Clamped);

/// Why no path was found.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlanError {
    /// A configuration has the wrong number of joints or a position that is not finite.
    #[error("the {0} is not a configuration of {1} joints with finite positions")]
    Shape(&'static str, usize),
    /// The list of goals is empty.
    #[error("no goal given")]
    NoGoal,
    /// A position is outside its limits.
    #[error("joint {joint} of the {which} is at {}", describe_outside(*.position, *.lower, *.upper))]
    Outside {
        /// "start" or "goal".
        which: &'static str,
        /// Index of the joint.
        joint: usize,
        /// Its position [rad or m].
        position: f64,
        /// Lowest position.
        lower: f64,
        /// Highest position.
        upper: f64,
    },
    /// The start or every goal collides.
    #[error("the {which} collides: {}", describe_contacts(.contacts))]
    Collides {
        /// "start" or "goal".
        which: &'static str,
        /// The contacts, the deepest first.
        contacts: Vec<Contact>,
    },
    /// No way out of the start, or of every goal, was found.
    #[error("the {which} is enclosed, between {}", .enclosed.pairs())]
    Enclosed {
        /// "start" or "goal".
        which: &'static str,
        /// The enclosure; of several goals, that of the nearest.
        enclosed: Enclosed,
    },
    /// Covers touch at the start, or at every goal: only a proof can say whether solids do.
    #[error("nothing looks free at the start or at every goal")]
    Covered,
    /// The timeout was reached.
    #[error("no path found in time, after {} samples and {} nodes", .0.samples, .0.nodes)]
    Timeout(SearchCount),
    /// The request was cancelled.
    #[error("cancelled")]
    Cancelled,
    /// The search reached its maximum number of samples or nodes.
    #[error("no path found with {} samples and {} nodes", .0.samples, .0.nodes)]
    Exhausted(SearchCount),
}

/// Returns the number of digits that tell a position from the limit that it exceeds.
pub(in crate::planning) fn digits_outside(position: f64, lower: f64, upper: f64) -> usize {
    let limit = if position < lower { lower } else { upper };
    let same = |digits: &usize| format!("{position:.digits$}") == format!("{limit:.digits$}");
    4 + (4..9).take_while(same).count()
}

fn describe_outside(position: f64, lower: f64, upper: f64) -> String {
    let digits = digits_outside(position, lower, upper);
    format!("{position:.digits$}, outside {lower:.digits$} to {upper:.digits$}")
}

fn describe_contacts(contacts: &[Contact]) -> String {
    let first: Vec<String> = contacts.iter().take(3).map(Contact::to_string).collect();
    let more = contacts.len().saturating_sub(3);
    first.join("; ") + &if more > 0 { format!("; and {more} more") } else { String::new() }
}

/// Plans from `start` to the nearest reachable one of `goals`; for continuous joints, positions a whole turn apart are
/// the same goal. The same checker, settings and goals give the same path unless the timeout is reached.
pub fn plan<C: CollisionChecker>(
    checker: &mut C,
    start: &[f64],
    goals: &[Vec<f64>],
    settings: &PlanSettings,
    stop: &Stop,
) -> Result<Plan, PlanError> {
    let began = Instant::now();
    let looked = checker.checks();
    let lead = lead_in(checker, start, settings, stop)?;
    let from = lead.last().map_or(start, Vec::as_slice).to_vec();
    let (goals, clamped) = usable_goals(checker, &from, goals, settings)?;
    // Where covers overlap at a sample, the line may still be free: a detour would be a surprise.
    let mut line_is_free = |goal: &&Vec<f64>| {
        !stop.is_over()
            && match settings.level {
                Level::Fast => checker.motion_looks_free(&from, goal),
                Level::Certified if !checker.motion_looks_free(&from, goal) => {
                    checker.certify_within_budget(&from, goal, false, stop)
                }
                Level::Certified | Level::Exact => checker.motion_is_free(&from, goal, stop),
            }
    };
    let straight = goals.iter().find(&mut line_is_free).map(|goal| vec![from.clone(), goal.clone()]);
    let mut count = SearchCount::default();
    let mut search_time = began.elapsed();
    let is_straight = straight.is_some();
    let path = match straight {
        Some(line) => line,
        None => {
            // Where covers touch already, no edge would look free.
            let mut looks_free = |q: &Vec<f64>| checker.motion_looks_free(q, q);
            let covered = settings.level != Level::Exact
                && !stop.is_over()
                && (!looks_free(&from) || !goals.iter().any(looks_free));
            let level = match settings.level {
                Level::Fast if covered => return Err(PlanError::Covered),
                Level::Certified if covered => Level::Exact,
                level => level,
            };
            let mut searches = Portfolio::new(&from, &goals, settings, level);
            loop {
                let found = searches.next(checker, stop);
                count = searches.count();
                let found = match found {
                    Ok(found) => found,
                    Err(Halt::TookLong) => {
                        // Whatever the level: where only covers touch, nothing is enclosed.
                        not_enclosed(checker, &from, &goals, (&settings.enclosure, settings.seed), stop)?;
                        continue;
                    }
                    Err(Halt::Stopped) if stop.is_cancelled() => return Err(PlanError::Cancelled),
                    Err(Halt::Stopped) => return Err(PlanError::Timeout(count)),
                    Err(Halt::Exhausted) => return Err(PlanError::Exhausted(count)),
                };
                search_time = began.elapsed();
                if let Some((path, sampling)) = finished(checker, &found, count.nodes, settings, stop) {
                    search_time += sampling;
                    break path;
                }
            }
        }
    };
    let shorten_time = began.elapsed() - search_time;
    let refining = Instant::now();
    let stop = settings.refine_time.map_or_else(|| stop.halfway(), |time| stop.or_at(refining + time));
    let (paths, rounds) = refine(checker, path, &goals, settings, &stop);
    let whole = |mut path: Path| {
        let reached = goals.iter().position(|goal| path.last() == Some(goal));
        path.splice(..1, lead.iter().cloned());
        (path, reached.and_then(|goal| clamped.get(goal).cloned()).unwrap_or_default())
    };
    let mut longer: Vec<Way> = paths.into_iter().map(whole).collect();
    let (path, clamped) = longer.pop().unwrap_or_default();
    Ok(Plan {
        clamped,
        length: length(&path),
        path,
        straight: is_straight,
        proven: settings.level.proves(),
        seed: settings.seed,
        count,
        checks: checker.checks() - looked,
        search_time,
        shorten_time,
        longer,
        refined: rounds,
        refine_time: refining.elapsed(),
    })
}

/// Fails if every goal, or the start, is enclosed.
fn not_enclosed<C: CollisionChecker>(
    checker: &mut C,
    start: &[f64],
    goals: &[Vec<f64>],
    how: (&EnclosureSettings, u64),
    stop: &Stop,
) -> Result<(), PlanError> {
    let to = [start.to_vec()];
    let mut nearest = None;
    // A wall between them is clearer from the goal: the start has most of the space as a rule.
    if goals.iter().all(|goal| enclosed(checker, goal, &to, how, stop).map(|e| nearest.get_or_insert(e)).is_some())
        && let Some(enclosed) = nearest
    {
        return Err(PlanError::Enclosed { which: "goal", enclosed });
    }
    match enclosed(checker, start, goals, how, stop) {
        Some(enclosed) => Err(PlanError::Enclosed { which: "start", enclosed }),
        None => Ok(()),
    }
}

/// Shortens a path that was found, and checks what is left of it as far as the level asks for; `None` if it cannot be
/// used. `nodes`: those of the search. Also returns the duration of the checks that the search left out.
fn finished<C: CollisionChecker>(
    checker: &mut C,
    found: &Candidate,
    nodes: usize,
    settings: &PlanSettings,
    stop: &Stop,
) -> Option<(Path, Duration)> {
    let turns = checker.turns().to_vec();
    let (rounds, none) = (&settings.shortcut, Duration::ZERO);
    if matches!(found.edges, EdgeCheck::Certified | EdgeCheck::Exact) {
        // Where covers touch, nothing looks free.
        let look = found.edges == EdgeCheck::Certified;
        let mut is_free = |a: &[f64], b: &[f64]| {
            (!look || checker.motion_looks_free(a, b)) && checker.certify_within_budget(a, b, look, stop)
        };
        return Some((shorten(&found.path, &turns, rounds, &mut is_free), none));
    }
    // A proof samples all that it needs.
    let samples_left = found.edges == EdgeCheck::Coarse && !settings.level.proves();
    let mut sampled = Sampled::default();
    let mut looks_free = |a: &[f64], b: &[f64]| {
        let free = !stop.is_over() && checker.motion_looks_free(a, b);
        if samples_left && free {
            sampled.add(a, b);
        }
        free
    };
    let short = shorten(&found.path, &turns, rounds, &mut looks_free);
    let [fewest, most] = rounds.cuts;
    let cuts = (nodes / rounds.nodes_per_cut).clamp(fewest, most);
    let short = cut(&short, cuts, &mut Random::new(settings.seed), &mut looks_free).unwrap_or(short);
    if samples_left {
        let began = Instant::now();
        let looks_free =
            |edge: &[Vec<f64>]| sampled.has(&edge[0], &edge[1]) || checker.motion_looks_free(&edge[0], &edge[1]);
        return short.windows(2).all(looks_free).then(|| (short, began.elapsed()));
    }
    is_proven(checker, &short, settings.level, stop).then_some((short, none))
}

/// Returns whether a path that looks free is proven, if its level asks for that.
pub(in crate::planning) fn is_proven<C: CollisionChecker>(
    checker: &mut C,
    path: &Path,
    level: Level,
    stop: &Stop,
) -> bool {
    !level.proves() || path.windows(2).all(|edge| checker.certify_within_budget(&edge[0], &edge[1], true, stop))
}

/// Returns the path from the start to a configuration inside the limits and free of contact: usually just the start.
fn lead_in<C: CollisionChecker>(
    checker: &mut C,
    start: &[f64],
    settings: &PlanSettings,
    stop: &Stop,
) -> Result<Path, PlanError> {
    check_shape(checker, "start", start)?;
    let mut lead = vec![start.to_vec()];
    let inside = clamped(checker, start);
    for (joint, (&position, &clamped)) in start.iter().zip(&inside).enumerate() {
        if (position - clamped).abs() > settings.limit_tolerance {
            return Err(outside(checker, "start", joint, position));
        }
    }
    if inside != start {
        lead.push(inside.clone());
    }
    if checker.is_free(&inside) {
        return Ok(lead);
    }
    let contacts = checker.contacts(&inside);
    let depth = contacts.first().map_or(0.0, |c| -c.distance);
    let way = (&settings.escape, settings.seed);
    match (depth <= settings.escape.max_depth).then(|| escape(checker, &inside, depth, way, stop)).flatten() {
        Some(free) => {
            lead.push(free);
            Ok(lead)
        }
        None => Err(PlanError::Collides { which: "start", contacts }),
    }
}

/// Returns a free configuration close by that is reached without deeper penetration.
fn escape<C: CollisionChecker>(
    checker: &mut C,
    from: &[f64],
    depth: f64,
    (settings, seed): (&EscapeSettings, u64),
    stop: &Stop,
) -> Option<Vec<f64>> {
    let EscapeSettings { depth_tolerance, samples, tries, first_step, growth, .. } = *settings;
    let mut random = Random::new(seed);
    let mut at = from.to_vec();
    for k in 0..tries {
        if stop.is_over() {
            return None;
        }
        let size = first_step + growth * f64::from(k) / f64::from(tries);
        let moved: Vec<f64> = from.iter().map(|x| x + random.between(-size, size)).collect();
        let to = clamped(checker, &moved);
        let deepest = depth + depth_tolerance;
        let deeper = |checker: &mut C, q: &[f64]| checker.contacts(q).first().is_some_and(|c| -c.distance > deepest);
        let mut passes = |part: f64| {
            between(from, &to, part, &mut at);
            !deeper(checker, &at)
        };
        if (1..=samples).all(|i| passes(f64::from(i) / f64::from(samples))) && checker.is_free(&to) {
            return Some(to);
        }
    }
    None
}

/// Joints of one goal that were moved to their limits: index and requested position [rad or m].
type Clamped = Vec<(usize, f64)>;

/// Returns the goals inside the limits and free, the nearest first, each with its joints that were moved to their
/// limits; or why there are none. For continuous joints, the nearest of the equivalent positions is used.
fn usable_goals<C: CollisionChecker>(
    checker: &mut C,
    from: &[f64],
    goals: &[Vec<f64>],
    settings: &PlanSettings,
) -> Result<(Path, Vec<Clamped>), PlanError> {
    let mut usable: Vec<(Vec<f64>, Clamped)> = Vec::new();
    let mut why = PlanError::NoGoal;
    for goal in goals {
        check_shape(checker, "goal", goal)?;
        let mut goal = goal.clone();
        unwind(&mut goal, from, checker.turns());
        let inside = clamped(checker, &goal);
        let moved = goal.iter().zip(&inside).enumerate().filter(|(_, (a, b))| a != b);
        let clamped: Clamped = moved.map(|(joint, (asked, _))| (joint, *asked)).collect();
        let far = goal.iter().zip(&inside).position(|(a, b)| (a - b).abs() > settings.goal_tolerance);
        if let Some(joint) = far {
            why = outside(checker, "goal", joint, goal[joint]);
        } else if !checker.is_free(&inside) {
            why = PlanError::Collides { which: "goal", contacts: checker.contacts(&inside) };
        } else {
            usable.push((inside, clamped));
        }
    }
    usable.sort_by(|(a, _), (b, _)| distance(from, a).total_cmp(&distance(from, b)));
    if usable.is_empty() { Err(why) } else { Ok(usable.into_iter().unzip()) }
}

fn check_shape<C: CollisionChecker>(checker: &C, which: &'static str, q: &[f64]) -> Result<(), PlanError> {
    let fine = q.len() == checker.dof() && q.iter().all(|x| x.is_finite());
    if fine { Ok(()) } else { Err(PlanError::Shape(which, checker.dof())) }
}

fn clamped<C: CollisionChecker>(checker: &C, q: &[f64]) -> Vec<f64> {
    q.iter().zip(checker.limits()).map(|(x, l)| x.max(l.lower).min(l.upper)).collect()
}

fn outside<C: CollisionChecker>(checker: &C, which: &'static str, joint: usize, position: f64) -> PlanError {
    let limits = checker.limits()[joint];
    PlanError::Outside { which, joint, position, lower: limits.lower, upper: limits.upper }
}

//! The way back along a recorded motion: from where an arm is now to where it was at rest before.

use super::motion::RecordedMotion;

/// An arm that moves less than this within [`WINDOW`] is at rest [rad].
const STILL: f64 = 2e-3;
/// Time for that [s].
const WINDOW: f64 = 0.1;
/// Distance between the arm and the path within which it is on it [rad, largest of all joints].
pub const ON_PATH: f64 = 0.02;
/// Distance from the goal of a way back within which an arm has arrived there [rad].
const ARRIVED: f64 = 5e-3;
/// Deviation of the shortened path from the recorded one [rad].
const TOLERANCE: f64 = 2e-4;

/// Part of the path of a tool centre point that is shorter counts as noise [m].
const NOISE: f64 = 2e-3;

/// How far back.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Back<'a> {
    /// To where the arm was at rest before its last motions: this many, at least 1.
    Motions(u32),
    /// By this much time of motion [s]; rests do not count.
    Time(f64),
    /// By this length of the path of the tool centre point [m], whose positions [m] have been these, with their times
    /// [ns since 1970].
    Distance(f64, &'a [(u64, [f64; 3])]),
}

/// A way back.
#[derive(Debug, Clone, PartialEq)]
pub struct Retrace {
    /// Joint positions [rad]: the newest first, the goal last.
    pub path: Vec<Vec<f64>>,
    /// Time in the log of the goal [ns since 1970].
    pub time: u64,
    /// Duration of the recorded motion that it retraces [s].
    pub duration: f64,
    /// Whether the arm was at rest at the goal.
    pub at_rest: bool,
}

/// Why there is no way back.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum RetraceError {
    /// The rows do not reach back far enough.
    #[error("the log has no such motion")]
    TooShort,
    /// The arm is not where they end.
    #[error("{joint} is {by:.3} rad from where the log ends: the arm was moved without a record")]
    Elsewhere {
        /// The joint.
        joint: String,
        /// By how much [rad].
        by: f64,
    },
}

/// Returns the way back of an arm that is at `now` [rad]. `motion` has only its joints, in the same order. `from`: the
/// arm retraced the log to this time [ns since 1970] before, or was stopped on that way; the way continues from there.
pub fn retrace(
    motion: &RecordedMotion,
    now: &[f64],
    from: Option<u64>,
    back: Back<'_>,
) -> Result<Retrace, RetraceError> {
    let (rows, period) = (motion.rows.as_slice(), motion.period);
    let end = rows.len().checked_sub(1).ok_or(RetraceError::TooShort)?;
    let time = |k: usize| motion.last.saturating_sub(((end - k) as f64 * period * 1e9) as u64);
    let resumed = from.and_then(|from| {
        let first = (0..rows.len()).find(|k| time(*k) + 1_000 >= from)?;
        if apart(&rows[first], now) <= ARRIVED {
            return Some(first);
        }
        let nearest = (first..=end).map(|k| (k, apart(&rows[k], now)));
        let nearest = nearest.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, by)| *by <= ON_PATH)?;
        // The way back itself passed there as well, later.
        (first..=end).find(|k| apart(&rows[*k], now) <= nearest.1 + STILL)
    });
    let end = resumed.unwrap_or(end);
    let off = |j: usize| (rows[end][j] - now[j]).abs();
    let worst = (0..now.len()).max_by(|a, b| off(*a).total_cmp(&off(*b))).ok_or(RetraceError::TooShort)?;
    if off(worst) > ON_PATH {
        return Err(RetraceError::Elsewhere { joint: motion.joints[worst].clone(), by: off(worst) });
    }
    let window = ((WINDOW / period).round() as usize).max(1);
    let moves = |k: &usize| *k >= window && apart(&rows[*k], &rows[*k - window]) >= STILL;
    let moved_before = |k: usize| (0..=k).rev().find(moves).ok_or(RetraceError::TooShort);
    let begin = moved_before(end)?;
    let goal = match back {
        Back::Motions(count) => {
            let mut goal = end;
            for _ in 0..count.max(1) {
                let moving = moved_before(goal)?;
                let still = (0..moving).rev().find(|k| !moves(k)).ok_or(RetraceError::TooShort)?;
                // Motions begin slowly: a little earlier it was fully at rest.
                goal = (0..=still).rev().take(2 * window).take_while(|k| !moves(k)).last().unwrap_or(still);
            }
            goal
        }
        Back::Time(seconds) => {
            let steps = ((seconds / period).round() as usize).max(1);
            (0..=begin).rev().filter(moves).nth(steps + window).ok_or(RetraceError::TooShort)?
        }
        Back::Distance(metres, tcp) => {
            let at = passed(tcp, time(end), metres).ok_or(RetraceError::TooShort)?;
            (0..=begin).rev().find(|k| time(*k) <= at).ok_or(RetraceError::TooShort)?
        }
    };
    let whole: Vec<&Vec<f64>> = rows[goal..=begin].iter().rev().collect();
    let mut tolerance = TOLERANCE;
    let path = loop {
        let short = shortened(&whole, tolerance);
        if short.len() < dimos_rpc::api::MAX_RETRACE {
            break short;
        }
        tolerance *= 2.0;
    };
    // A row counts as moving for the window after the motion too.
    let moving = (goal..=begin).filter(moves).count().saturating_sub(window);
    Ok(Retrace { path, time: time(goal), duration: moving as f64 * period, at_rest: !moves(&goal) })
}

/// Returns when a tool centre point was this far back along its path from where it was at `end` [m, ns].
fn passed(tcp: &[(u64, [f64; 3])], end: u64, metres: f64) -> Option<u64> {
    let mut way = tcp.iter().rev().skip_while(|(time, _)| *time > end);
    let (&(mut at, mut from), mut left) = (way.next()?, metres);
    for (time, xyz) in way {
        let step = xyz.iter().zip(&from).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        if step < NOISE {
            continue;
        }
        if step >= left {
            return Some(at - ((at - time) as f64 * left / step) as u64);
        }
        (at, from, left) = (*time, *xyz, left - step);
    }
    None
}

/// Returns the largest difference of a joint [rad].
fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Returns the rows that a path needs in order to stay within `tolerance` [rad] of all: Douglas and Peucker, without
/// recursion.
fn shortened(rows: &[&Vec<f64>], tolerance: f64) -> Vec<Vec<f64>> {
    let mut kept = vec![false; rows.len()];
    let mut open = vec![(0, rows.len().saturating_sub(1))];
    while let Some((a, b)) = open.pop() {
        (kept[a], kept[b]) = (true, true);
        let farthest = (a + 1..b).map(|k| (k, off_line(rows[k], rows[a], rows[b])));
        if let Some((k, _)) = farthest.max_by(|x, y| x.1.total_cmp(&y.1)).filter(|(_, off)| *off > tolerance) {
            open.extend([(a, k), (k, b)]);
        }
    }
    rows.iter().zip(kept).filter(|(_, kept)| *kept).map(|(row, _)| (*row).clone()).collect()
}

/// Returns the distance of a configuration from the straight piece between two others [rad].
fn off_line(q: &[f64], a: &[f64], b: &[f64]) -> f64 {
    let dot = |f: &dyn Fn(usize) -> f64| (0..q.len()).map(f).sum::<f64>();
    let length = dot(&|j| (b[j] - a[j]).powi(2));
    let along = if length > 0.0 { dot(&|j| (q[j] - a[j]) * (b[j] - a[j])) / length } else { 0.0 };
    let along = along.clamp(0.0, 1.0);
    dot(&|j| (q[j] - a[j] - along * (b[j] - a[j])).powi(2)).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    const DT: f64 = 0.01;

    /// Two joints: rest at 0, to 1 along a curve, rest, to 2, and a stop on the way to 3.
    fn record() -> RecordedMotion {
        let mut rows = vec![vec![0.0, 0.0]; 50];
        let mut ramp = |from: f64, to: f64| {
            rows.extend((1..=100).map(|k| {
                let x = from + (to - from) * f64::from(k) / 100.0;
                vec![x, 0.3 * (x * 3.0).sin()]
            }));
            let last = rows.last().unwrap().clone();
            rows.extend(std::iter::repeat_n(last, 50));
        };
        ramp(0.0, 1.0);
        ramp(1.0, 2.0);
        ramp(2.0, 2.4);
        let joints = vec!["a".to_owned(), "b".to_owned()];
        RecordedMotion { joints, period: DT, rows, last: 10_000_000_000, lost: 0, grips: Vec::new() }
    }

    fn at(x: f64) -> Vec<f64> {
        vec![x, 0.3 * (x * 3.0).sin()]
    }

    #[test]
    fn the_way_back_ends_where_the_arm_rested_before_and_stays_on_the_recorded_path() {
        let motion = record();
        for (count, goal) in [(1, 2.0), (2, 1.0), (3, 0.0)] {
            let found = retrace(&motion, &at(2.4), None, Back::Motions(count)).unwrap();
            assert!(found.at_rest && apart(found.path.last().unwrap(), &at(goal)) < 1e-9, "{count}: {found:?}");
            assert!(apart(&found.path[0], &at(2.4)) < 1e-9);
            let on_curve = |q: &Vec<f64>| (q[1] - 0.3 * (q[0] * 3.0).sin()).abs() < 1e-9;
            assert!(found.path.iter().all(on_curve) && found.path.len() < 120, "{}", found.path.len());
            // Between its points it keeps to the curve too.
            let middles = found.path.windows(2).map(|w| [0.5 * (w[0][0] + w[1][0]), 0.5 * (w[0][1] + w[1][1])]);
            assert!(middles.into_iter().all(|m| (m[1] - 0.3 * (m[0] * 3.0).sin()).abs() < 3e-4));
        }
        assert_eq!(retrace(&motion, &at(2.4), None, Back::Motions(4)), Err(RetraceError::TooShort));
        let back = retrace(&motion, &at(2.4), None, Back::Time(0.5)).unwrap();
        assert!(!back.at_rest && (back.path.last().unwrap()[0] - 2.2).abs() < 0.01, "{back:?}");
    }

    #[test]
    fn a_distance_counts_along_the_path_of_the_tool_and_rests_and_noise_do_not() {
        let motion = record();
        // The tool moves by 0.1 m per radian of the first joint, there and back again in x, and trembles at rest.
        let begin = motion.last - ((motion.rows.len() - 1) as f64 * DT * 1e9) as u64;
        let tremble = |k: usize| if k.is_multiple_of(2) { 1e-4 } else { -1e-4 };
        let tcp: Vec<(u64, [f64; 3])> = (0..)
            .zip(&motion.rows)
            .map(|(k, q)| (begin + k as u64 * 10_000_000, [0.1 * q[0], 0.2, tremble(k)]))
            .collect();
        for (metres, goal) in [(0.02, 2.2), (0.1, 1.4), (0.15, 0.9)] {
            let found = retrace(&motion, &at(2.4), None, Back::Distance(metres, &tcp)).unwrap();
            let x = found.path.last().unwrap()[0];
            assert!((x - goal).abs() < 0.02, "{metres}: {x}");
        }
        let far = retrace(&motion, &at(2.4), None, Back::Distance(0.3, &tcp));
        assert_eq!(far, Err(RetraceError::TooShort));
        assert_eq!(retrace(&motion, &at(2.4), None, Back::Distance(0.1, &[])), Err(RetraceError::TooShort));
    }

    #[test]
    fn an_arm_that_is_elsewhere_is_refused() {
        let wrong = retrace(&record(), &[2.4, 0.9], None, Back::Motions(1)).unwrap_err();
        assert!(matches!(&wrong, RetraceError::Elsewhere { joint, .. } if joint == "b"), "{wrong}");
        assert!(retrace(&record(), &[2.41, at(2.4)[1]], None, Back::Motions(1)).is_ok());
    }

    /// The log of a way back is no motion to retrace.
    #[test]
    fn a_second_way_back_continues_from_the_first() {
        let mut motion = record();
        let first = retrace(&motion, &at(2.4), None, Back::Motions(1)).unwrap();
        // The first way back, and a rest there.
        let added: Vec<Vec<f64>> = (1..=80).map(|k| at(2.4 - 0.4 * f64::from(k) / 80.0)).collect();
        motion.rows.extend(added.clone());
        motion.rows.extend(std::iter::repeat_n(at(2.0), 40));
        motion.last += 1_200_000_000;
        let second = retrace(&motion, &at(2.0), Some(first.time), Back::Motions(1)).unwrap();
        assert!(apart(second.path.last().unwrap(), &at(1.0)) < 1e-9, "{second:?}");
        let again = retrace(&motion, &at(2.0), None, Back::Motions(1)).unwrap();
        assert!(apart(again.path.last().unwrap(), &at(2.4)) < 1e-9, "the log alone leads there again");
        // Stopped on the way: to the same goal.
        let mut stopped = record();
        stopped.rows.extend_from_slice(&added[..40]);
        stopped.last += 400_000_000;
        let rest = retrace(&stopped, &at(2.2), Some(first.time), Back::Motions(1)).unwrap();
        assert!(apart(rest.path.last().unwrap(), &at(2.0)) < 1e-9, "{rest:?}");
    }
}

//! Slows a timed motion down where a tool would be too fast. The path stays the same, and with it the proof that it is
//! free: only the time along it is stretched, smoothly, so that the joints keep their limits.
//!
//! With `r(t)` the rate of the given time, the joints move with `r·v` and accelerate with `r·(r'·v + r·a)`. `r` is the
//! highest rate that the tool allows, its minimum over a window and then its mean over windows half as long: so it is
//! never above what the tool allows, and has a continuous derivative. The window that gives the shortest motion wins.

use std::collections::VecDeque;
use std::ops::Range;

use dimos_kernels::states::States;

use super::settings::ToolTimingSettings;
use super::verify::excess;
use dimos_core::joint::JointBounds;
use dimos_core::trajectory::{Cursor, JointTrajectory, JointValues, Sample, Spline, TrajectoryPoint};
use dimos_robot::kinematics::tool_speed::ToolSpeed;

/// The tools of arms that move together, each with a speed limit.
#[derive(Debug, Clone, Default)]
pub struct Tools(Vec<Tool>);

#[derive(Debug, Clone)]
struct Tool {
    /// The joints of its arm among those that move.
    joints: Range<usize>,
    speed: ToolSpeed,
    /// Highest speed [m/s].
    limit: f64,
}

impl Tools {
    /// Adds the tool of an arm whose joints are these among those that move; `limit` is its highest speed [m/s].
    pub fn push(&mut self, joints: Range<usize>, speed: ToolSpeed, limit: f64) {
        self.0.push(Tool { joints, speed, limit });
    }

    /// Returns the largest part of its speed limit that a tool has, with the joints at these positions [rad or m] and
    /// velocities [rad/s or m/s]; 0 without a tool.
    pub fn part(&mut self, positions: &[f64], velocities: &[f64]) -> f64 {
        let part = |Tool { joints, speed, limit }: &mut Tool| {
            let [q, v] = [positions, velocities].map(|values| values.get(joints.clone()).unwrap_or_default());
            speed.at(q, v) / *limit
        };
        self.0.iter_mut().map(part).fold(0.0, f64::max)
    }

    /// Returns the same path with tools that keep their speed at a part of it, 0 to 1; `None` if they do already.
    pub fn slowed(
        &mut self,
        motion: &JointTrajectory,
        bounds: &[JointBounds],
        speed: f64,
        settings: &ToolTimingSettings,
    ) -> Option<JointTrajectory> {
        if self.0.is_empty() {
            return None;
        }
        slowed(motion, bounds, settings, |q, v| self.part(q, v) / speed)
    }
}

/// Returns the same path with a tool that keeps its speed; `None` if it does already. `part` returns the part of its
/// speed limit that the tool has, at positions [rad or m] and velocities [rad/s or m/s] of the joints. A motion that
/// is not valid stays as it is.
pub fn slowed(
    motion: &JointTrajectory,
    bounds: &[JointBounds],
    settings: &ToolTimingSettings,
    mut part: impl FnMut(&[f64], &[f64]) -> f64,
) -> Option<JointTrajectory> {
    let ToolTimingSettings { step, max_steps, point_interval, share, windows } = *settings;
    let spline = Spline::new(motion).ok()?;
    let step = step.max(spline.duration() / max_steps as f64);
    let steps = (spline.duration() / step).ceil() as usize;
    let step = spline.duration() / steps.max(1) as f64;
    let (mut walk, mut allowed) = (Walk::new(&spline), Vec::with_capacity(steps + 1));
    for i in 0..=steps {
        let (q, v, _) = walk.at(i as f64 * step);
        allowed.push((share / part(q, v)).min(1.0));
    }
    if allowed.iter().all(|rate| *rate >= share) {
        return None;
    }
    let longest = bounds.iter().map(|b| b.velocity / b.acceleration).fold(0.0, f64::max);
    let warped = windows.iter().filter_map(|factor| {
        let half = ((factor * longest / step) as usize).clamp(2, steps.max(2));
        let mut states = warped(&spline, &rates(&allowed, half), step, (point_interval, share))?;
        let slower = excess(&states, bounds, true).slower();
        states.stretch(if slower > 1.0 { slower * (1.0 + 1e-9) } else { 1.0 });
        Some(trajectory(motion, &states))
    });
    // As a whole, at the rate of its fastest moment: always within the joints' limits.
    let lowest = allowed.iter().copied().fold(1.0, f64::min);
    let all = warped.chain([motion.scaled(lowest)]);
    let quickest = all.min_by(|a, b| a.duration().total_cmp(&b.duration()))?;
    // Its points are joined by polynomials: whatever they add is seen here.
    let spline = Spline::new(&quickest).ok()?;
    let mut walk = Walk::new(&spline);
    let fastest = (0..=steps).map(|i| {
        let (q, v, _) = walk.at(spline.duration() * i as f64 / steps.max(1) as f64);
        part(q, v)
    });
    let fastest = fastest.fold(0.0, f64::max);
    Some(if fastest > 1.0 { quickest.scaled(1.0 / fastest) } else { quickest })
}

/// Returns rates that change smoothly and are nowhere above the allowed ones: `half` steps on both sides count.
fn rates(allowed: &[f64], half: usize) -> Vec<f64> {
    let lowest = lowest_around(allowed, half);
    let once = mean_around(&lowest, half - half / 2);
    mean_around(&once, half / 2)
}

/// Returns the lowest value within `half` steps of each.
fn lowest_around(values: &[f64], half: usize) -> Vec<f64> {
    let mut kept: VecDeque<usize> = VecDeque::new();
    let mut next = 0;
    let mut lowest = |i: usize| {
        while next < values.len() && next <= i + half {
            while kept.back().is_some_and(|last| values[*last] >= values[next]) {
                kept.pop_back();
            }
            kept.push_back(next);
            next += 1;
        }
        while kept.front().is_some_and(|first| first + half < i) {
            kept.pop_front();
        }
        kept.front().map_or(values[i], |first| values[*first])
    };
    (0..values.len()).map(&mut lowest).collect()
}

/// Returns the mean within `half` steps of each; the first and the last value continue beyond the ends.
fn mean_around(values: &[f64], half: usize) -> Vec<f64> {
    let at = |i: isize| values[i.clamp(0, values.len() as isize - 1) as usize];
    let half = half as isize;
    let mut sum: f64 = (-half..=half).map(at).sum();
    let mut means = Vec::with_capacity(values.len());
    for i in 0..values.len() as isize {
        means.push(sum / (2 * half + 1) as f64);
        sum += at(i + half + 1) - at(i - half);
    }
    means
}

/// Returns the states of a motion whose time runs at these rates, one for each `step` [s] of it; rates from `share` on
/// count as constant.
fn warped(spline: &Spline, rates: &[f64], step: f64, (point_interval, share): (f64, f64)) -> Option<States> {
    let mut times = vec![0.0];
    for pair in rates.windows(2) {
        // Exact for a rate that is linear in the given time.
        let (a, b) = (pair[0], pair[1]);
        let passed = if (a - b).abs() < 1e-9 { step / a } else { step * (a / b).ln() / (a - b) };
        times.push(times.last()? + passed);
    }
    let mut states = States::new(spline.joints(), rates.len());
    let mut walk = Walk::new(spline);
    let mut push = |given: f64| {
        let at = given / step;
        let i = (at as usize).min(rates.len().checked_sub(2)?);
        let (x, a, b) = (at - i as f64, rates[i], rates[i + 1]);
        // The derivative is continuous: between the two that the neighbours give.
        let slope = |i: usize| (rates[(i + 1).min(rates.len() - 1)] - rates[i.saturating_sub(1)]) / (2.0 * step);
        let (rate, change) = (a + x * (b - a), slope(i) * (1.0 - x) + slope(i + 1) * x);
        let passed = if (a - b).abs() < 1e-9 { x * step / a } else { step * (rate / a).ln() / (b - a) };
        let (q, v, acceleration) = walk.at(given);
        let joints = q.iter().zip(v).zip(acceleration);
        states.push(times[i] + passed, joints.map(|((q, v), a)| [*q, rate * v, rate * (change * v + rate * a)]));
        Some(())
    };
    // At the points of the given motion its acceleration may bend; between them the rate does where it changes.
    for pair in spline.times().windows(2) {
        push(pair[0])?;
        let steady = |t: f64| rates.get((t / step) as usize).is_some_and(|rate| *rate >= share);
        let pieces = ((pair[1] - pair[0]) / point_interval).ceil() as usize;
        let is_steady =
            (0..=4 * pieces).all(|k| steady(pair[0] + (pair[1] - pair[0]) * k as f64 / (4 * pieces) as f64));
        for k in (1..pieces).filter(|_| !is_steady) {
            push(pair[0] + (pair[1] - pair[0]) * k as f64 / pieces as f64)?;
        }
    }
    push(spline.duration())?;
    states.are_finite_and_in_order().then_some(states)
}

/// Returns states as a trajectory that begins and ends where the given one does.
fn trajectory(given: &JointTrajectory, states: &States) -> JointTrajectory {
    let list = |state, which| JointValues::from_slice(states.values(state, which));
    let point = |(i, time): (usize, &f64)| TrajectoryPoint {
        time_from_start: *time,
        positions: list(i, 0),
        velocities: list(i, 1),
        accelerations: list(i, 2),
    };
    let mut points: Vec<TrajectoryPoint> = states.times().iter().enumerate().map(point).collect();
    if let ([first, .., last], [start, .., goal]) = (points.as_mut_slice(), given.points.as_slice()) {
        first.positions.clone_from(&start.positions);
        last.positions.clone_from(&goal.positions);
    }
    JointTrajectory { joint_names: given.joint_names.clone(), points }
}

/// Positions, velocities and accelerations along a motion.
struct Walk<'a> {
    spline: &'a Spline,
    cursor: Cursor,
    samples: Vec<Sample>,
    values: [Vec<f64>; 3],
}

impl<'a> Walk<'a> {
    fn new(spline: &'a Spline) -> Self {
        let joints = spline.joints();
        let values = std::array::from_fn(|_| vec![0.0; joints]);
        Self { spline, cursor: Cursor::default(), samples: vec![Sample::default(); joints], values }
    }

    fn at(&mut self, time: f64) -> (&[f64], &[f64], &[f64]) {
        self.spline.sample(time.min(self.spline.duration()), &mut self.cursor, &mut self.samples);
        let [q, v, a] = &mut self.values;
        for (i, sample) in self.samples.iter().enumerate() {
            (q[i], v[i], a[i]) = (sample.position, sample.velocity, sample.acceleration);
        }
        (q, v, a)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::planning::timing::settings::TimingSettings;
    use crate::planning::timing::time;

    /// A joint of 1 m whose end may have 0.8 m/s near 0, and more elsewhere.
    #[test]
    fn only_where_the_tool_is_too_fast_the_motion_is_slower_and_the_joint_keeps_its_limits() {
        let bounds = [JointBounds { velocity: 3.0, acceleration: 8.0, jerk: 200.0, ..JointBounds::NONE }];
        let path = [vec![-2.5], vec![2.5]];
        let timed = time(&["joint".to_owned()], &path, &bounds, &TimingSettings::default(), |_, _| true).unwrap();
        let (motion, settings) = (timed.trajectory, ToolTimingSettings::default());
        let part = |q: &[f64], v: &[f64]| v[0].abs() / if q[0].abs() < 0.3 { 0.8 } else { 3.2 };
        let slower = slowed(&motion, &bounds, &settings, part).unwrap();
        let spline = Spline::new(&slower).unwrap();
        let mut walk = Walk::new(&spline);
        for k in 0..=(spline.duration() / 1e-3) as usize {
            let (q, v, a) = walk.at(k as f64 * 1e-3);
            assert!(part(q, v) <= 1.0 + 1e-9, "{} at {}", v[0], q[0]);
            assert!(a[0].abs() <= 8.0 * 1.001 && v[0] >= -1e-9);
        }
        assert_eq!((spline.start(0), spline.goal(0)), (-2.5, 2.5));
        assert!(spline.duration() < 1.7 * motion.duration(), "{} after {}", spline.duration(), motion.duration());
        assert_eq!(
            slowed(&slower, &bounds, &settings, |q, v| 0.99 * part(q, v)),
            None,
            "it keeps the tool's speed now"
        );
    }
}

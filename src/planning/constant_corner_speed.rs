//! The quickest motion along a path that passes each corner at constant speed: double-S profiles on the lines between
//! them ([`double_s`](super::double_s)). It keeps velocity, acceleration and jerk limits by construction, and every
//! speed of a corner follows from its limits in closed form.
//!
//! With jerk limits the curvature of a corner rises linearly, stays, and falls, each over a third of it: at constant
//! speed the jerk is constant in each third. Without, the curvature is constant. So every piece of the motion is a
//! cubic in time.
//!
//! Good where lines are long compared to the corners.

use super::double_s::{LineLimits, State};
use super::four::Four;
use super::path::Path;
use super::topp::JointBound;
use crate::trajectory::TrajectoryPoint;

/// Minimum time between points [s]: polynomials through closer ones would amplify rounding errors of positions.
const MIN_INTERVAL: f64 = 1e-4;
/// Shortest time from zero to full acceleration [s], in a motion in which any joint has a jerk limit.
const MIN_RAMP: f64 = 0.005;
/// A turn larger than this is a reversal, which cannot be blended: the speed would be zero in it.
const REVERSAL: f64 = 1.99;

/// Part of the limits left to rounding errors.
const ROUNDING: f64 = 1e-9;
/// A corner passed at less than this part of its own speed counts as slowed down by the lines beside it; more than one
/// in this number of them, and another way to pass corners is worth its computing time.
const SLOWED: f64 = 0.9;
const MOST_SLOWED: usize = 8;
/// A corner that is passed in this many times of what it takes to reach full acceleration is short: a changing speed
/// gains less there than the change takes.
const SHORT: f64 = 7.0;

/// A path whose corners are blended, and its limits.
#[derive(Debug)]
pub(super) struct RoundedPath<'a> {
    path: &'a Path,
    /// Numbers per configuration: joints, filled up to whole blocks.
    stride: usize,
    /// Direction of each line, of length 1.
    directions: Vec<f64>,
    lines: Vec<Line>,
    /// One per configuration; those of the ends are rests.
    corners: Vec<Corner>,
    jerk: bool,
    /// Longest time from zero to full acceleration of a joint [s]; 0 without jerk limits.
    ramp: f64,
}

/// A line between two configurations.
#[derive(Debug, Clone, Copy)]
struct Line {
    /// Its length with the parts that corners take [rad].
    length: f64,
    limits: LineLimits,
}

/// A blended corner.
#[derive(Debug, Clone, Copy, Default)]
struct Corner {
    /// Length taken from the lines on both sides [rad]; 0: the motion rests.
    half: f64,
    /// Norm of the change of direction.
    turn: f64,
    /// Largest part of the acceleration and jerk limits that a joint's change of direction uses [s²/rad, s³/rad].
    used: [f64; 2],
}

/// The direction in a corner is that before it, and `part` of its change.
#[derive(Debug, Clone, Copy)]
struct Progress {
    /// Integral of `part` over the corner so far, in lengths of the corner.
    area: f64,
    /// Part of the turn, from 0 to 1.
    part: f64,
    /// Derivative of `part` over the corner.
    curvature: f64,
}

/// Returns the progress at part `x` (0–1) of a corner.
fn progress(jerk: bool, x: f64) -> Progress {
    if !jerk {
        return Progress { area: 0.5 * x * x, part: x, curvature: 1.0 };
    }
    if x > 0.5 {
        let Progress { area, part, curvature } = progress(jerk, 1.0 - x);
        return Progress { area: x - 0.5 + area, part: 1.0 - part, curvature };
    }
    // Slope 4.5 over the first third, up to 1.5.
    let (ramp, flat) = (x.min(1.0 / 3.0), (x - 1.0 / 3.0).max(0.0));
    let part = 2.25 * ramp * ramp + 1.5 * flat;
    let area = 0.75 * ramp * ramp * ramp + flat * (0.25 + 0.75 * flat);
    Progress { area, part, curvature: 4.5 * ramp }
}

/// Limits as factors, filled up to whole blocks.
struct Inverse {
    velocity: Vec<f64>,
    acceleration: Vec<f64>,
    jerk: Vec<f64>,
}

impl Inverse {
    fn of(bounds: &[JointBound], stride: usize) -> Self {
        let list = |of: fn(&JointBound) -> f64| {
            let mut list: Vec<f64> = bounds.iter().map(|b| (1.0 + ROUNDING) / of(b)).collect();
            list.resize(stride, 0.0);
            list
        };
        Self { velocity: list(|b| b.velocity), acceleration: list(|b| b.acceleration), jerk: list(|b| b.jerk) }
    }
}

/// Returns the largest `|value|·factor`.
fn most(values: &[f64], factors: &[f64]) -> f64 {
    let used = |first: usize| Four::load(values, first).abs() * Four::load(factors, first);
    Four::starts(values.len()).fold(Four::default(), |most, first| most.max(used(first))).largest()
}

impl<'a> RoundedPath<'a> {
    /// Blends the corners of a path without repeated configurations. At configuration `i` the motion stays within
    /// `deviation[i]` [rad, Euclidean] of the path; it rests where that is 0.
    pub fn new(path: &'a Path, bounds: &[JointBound], deviation: &[f64]) -> Self {
        let dof = bounds.len();
        let stride = dof.next_multiple_of(Four::LEN);
        let inverse = Inverse::of(bounds, stride);
        let jerk = inverse.jerk.iter().any(|inverse| *inverse > 0.0);
        let ramps = bounds.iter().map(|b| b.acceleration / b.jerk).filter(|_| jerk);
        let ramp = ramps.fold(0.0, f64::max);
        let mut directions = vec![0.0; stride * path.len().saturating_sub(1)];
        let mut lines = Vec::with_capacity(path.len());
        for (pair, direction) in path.windows(2).zip(directions.chunks_exact_mut(stride)) {
            let (a, b) = (&pair[0], &pair[1]);
            let mut square = 0.0;
            for ((d, a), b) in direction.iter_mut().zip(a).zip(b) {
                *d = b - a;
                square += *d * *d;
            }
            let length = square.sqrt();
            let inverse_length = 1.0 / length.max(f64::MIN_POSITIVE);
            direction.iter_mut().for_each(|d| *d *= inverse_length);
            let acceleration = 1.0 / most(direction, &inverse.acceleration);
            let jerk_limit = 1.0 / most(direction, &inverse.jerk);
            // Of joints without jerk limits among others: points of the motion have one acceleration.
            let jerk_limit = if jerk { jerk_limit.min(acceleration / MIN_RAMP) } else { jerk_limit };
            let limits = LineLimits { speed: 1.0 / most(direction, &inverse.velocity), acceleration, jerk: jerk_limit };
            lines.push(Line { length, limits });
        }
        let mut rounded =
            Self { path, stride, directions, lines, corners: vec![Corner::default(); path.len()], jerk, ramp };
        let mut turn = vec![0.0; stride];
        for i in 1..path.len().saturating_sub(1) {
            let mut square = 0.0;
            for ((t, before), after) in turn.iter_mut().zip(rounded.direction(i - 1)).zip(rounded.direction(i)) {
                *t = after - before;
                square += *t * *t;
            }
            let used = [most(&turn, &inverse.acceleration), most(&turn, &inverse.jerk)];
            rounded.corners[i] = Corner { half: 0.0, turn: square.sqrt(), used };
            rounded.blend(i, deviation.get(i).copied().unwrap_or(0.0));
        }
        rounded
    }

    /// Blends corner `i` within another deviation [rad].
    pub fn blend(&mut self, i: usize, deviation: f64) {
        let room = 0.5 * self.lines[i - 1].length.min(self.lines[i].length);
        let jerk = self.jerk;
        let corner = &mut self.corners[i];
        // The middle of the corner is farthest from the path: 2·half·turn·∫σ over its first half.
        let length = deviation / (2.0 * progress(jerk, 0.5).area * corner.turn.max(1e-9));
        corner.half = if corner.turn > REVERSAL || deviation <= 0.0 { 0.0 } else { length.min(room) };
    }

    fn direction(&self, line: usize) -> &[f64] {
        &self.directions[line * self.stride..(line + 1) * self.stride]
    }

    /// Returns the length of a line between its corners [rad].
    fn straight(&self, line: usize) -> f64 {
        let (Line { length, .. }, [a, b]) = (self.lines[line], [line, line + 1].map(|i| self.corners[i].half));
        let straight = length - a - b;
        if straight > 1e-9 * length { straight } else { 0.0 }
    }

    /// Returns the maximum constant speed in corner `i`, regardless of the lines [rad/s]; 0 where the motion rests.
    fn corner_speed(&self, i: usize) -> f64 {
        if self.corners[i].half <= 0.0 {
            return 0.0;
        }
        let (corner, [before, after]) = (&self.corners[i], [i - 1, i].map(|line| self.lines[line].limits.speed));
        let [acceleration, jerk] = corner.used;
        let length = 2.0 * corner.half;
        let most = before.min(after);
        if self.jerk {
            // Largest curvature and change of curvature for a unit turn and length.
            most.min((length / (1.5 * acceleration)).sqrt()).min((length * length / (4.5 * jerk)).cbrt())
        } else {
            most.min((length / acceleration).sqrt())
        }
    }

    /// Writes the configuration at part `x` (0–1) of corner `i`.
    pub fn in_corner(&self, i: usize, x: f64, out: &mut [f64]) {
        let half = self.corners[i].half;
        let area = 2.0 * half * progress(self.jerk, x).area;
        let along = 2.0 * half * x - half - area;
        let (before, after) = (self.direction(i - 1), self.direction(i));
        for ((q, at), (before, after)) in out.iter_mut().zip(&self.path[i]).zip(before.iter().zip(after)) {
            *q = at + before * along + after * area;
        }
    }

    /// Writes the ends of the part of a line between its corners.
    pub fn ends_of_line(&self, line: usize, from: &mut [f64], to: &mut [f64]) {
        let [first, last] = [line, line + 1].map(|i| self.corners[i].half);
        for ((from, to), ((a, b), d)) in
            from.iter_mut().zip(to).zip(self.path[line].iter().zip(&self.path[line + 1]).zip(self.direction(line)))
        {
            (*from, *to) = (a + d * first, b - d * last);
        }
    }

    /// Returns the number of straight pieces that follow corner `i` within `sagitta` [rad]; 0 for a rest.
    pub fn pieces(&self, i: usize, sagitta: f64) -> usize {
        let corner = &self.corners[i];
        let bend = 2.0 * corner.turn * corner.half * if self.jerk { 1.5 } else { 1.0 };
        if corner.half > 0.0 { (bend / (8.0 * sagitta)).sqrt().ceil().max(2.0) as usize } else { 0 }
    }

    /// Returns the speeds at all configurations [rad/s].
    pub fn speeds(&self) -> Vec<f64> {
        let last = self.path.len() - 1;
        let mut speeds: Vec<f64> = (0..=last).map(|i| self.corner_speed(i)).collect();
        let reached = |line: usize, from: f64, most: f64| match self.straight(line) {
            0.0 => most.min(from),
            length => self.lines[line].limits.reached(from, most, length),
        };
        for i in (0..last).rev() {
            speeds[i] = reached(i, speeds[i + 1], speeds[i]);
        }
        for i in 0..last {
            speeds[i + 1] = reached(i, speeds[i], speeds[i + 1]);
        }
        speeds
    }

    /// Returns whether a motion that changes its speed in corners would hardly be quicker: the lines are long enough
    /// for most corners to be passed about as fast as they allow, and no corner takes long.
    pub fn suits(&self, speeds: &[f64]) -> bool {
        let (mut slowed, mut time, mut number) = (0, 0.0, 0);
        for (i, (corner, speed)) in self.corners.iter().zip(speeds).enumerate() {
            if corner.half > 0.0 {
                slowed += usize::from(*speed < SLOWED * self.corner_speed(i));
                time += 2.0 * corner.half / speed;
                number += 1;
            }
        }
        let short = !self.jerk || time <= SHORT * self.ramp * number as f64;
        MOST_SLOWED * slowed <= number && short && time.is_finite()
    }

    /// Returns the duration at these speeds [s].
    pub fn duration(&self, speeds: &[f64]) -> f64 {
        let line = |(i, line): (usize, &Line)| match self.straight(i) {
            0.0 => 0.0,
            length => line.limits.duration(speeds[i], speeds[i + 1], length),
        };
        let corner = |(corner, speed): (&Corner, &f64)| if corner.half > 0.0 { 2.0 * corner.half / speed } else { 0.0 };
        self.lines.iter().enumerate().map(line).sum::<f64>() + self.corners.iter().zip(speeds).map(corner).sum::<f64>()
    }

    /// Returns the motion at these speeds, from rest to rest.
    pub fn motion(&self, speeds: &[f64]) -> Vec<TrajectoryPoint> {
        let last = self.path.len() - 1;
        let mut points: Vec<TrajectoryPoint> = Vec::with_capacity(if self.jerk { 11 } else { 5 } * self.path.len());
        let mut start = 0.0;
        points.push(self.point(0, 0.0, &State::default()));
        for line in 0..last {
            let (from, to) = (speeds[line], speeds[line + 1]);
            let begin = self.corners[line].half;
            let mut end = State { speed: from, ..State::default() };
            let length = self.straight(line);
            if length > 0.0 {
                let mut before = points.last().map_or(0.0, |p| p.time_from_start);
                self.lines[line].limits.travel(from, to, length, |state| {
                    if start + state.time - before >= MIN_INTERVAL {
                        points.push(self.point(line, begin + state.at, &State { time: start + state.time, ..state }));
                        before = start + state.time;
                    }
                    end = state;
                });
                start += end.time;
                // The end of the line in place of a point just before it.
                if before < start && points.len() > 1 {
                    points.pop();
                    points.push(self.point(line, begin + length, &State { time: start, acceleration: 0.0, ..end }));
                }
            }
            let half = self.corners[line + 1].half;
            if half > 0.0 {
                let time = 2.0 * half / to;
                if self.jerk && time > 3.0 * MIN_INTERVAL {
                    points.extend(
                        [1.0, 2.0].map(|k| self.point_in_corner(line + 1, k / 3.0, start + time * k / 3.0, to)),
                    );
                }
                start += time;
                points.push(self.point(line + 1, half, &State { time: start, speed: to, ..State::default() }));
            }
        }
        points
    }

    /// Returns the point on a line at `at` from its first configuration.
    fn point(&self, line: usize, at: f64, state: &State) -> TrajectoryPoint {
        let dof = self.path[0].len();
        let (line, at) = if line + 1 < self.path.len() { (line, at) } else { (line - 1, self.lines[line - 1].length) };
        let (q, direction) = (&self.path[line], &self.direction(line)[..dof]);
        TrajectoryPoint {
            time_from_start: state.time,
            positions: q.iter().zip(direction).map(|(q, d)| q + d * at).collect(),
            velocities: direction.iter().map(|d| d * state.speed).collect(),
            accelerations: match self.jerk {
                true => direction.iter().map(|d| d * state.acceleration).collect(),
                false => Vec::new(),
            },
        }
    }
    /// Returns the point at part `x` (0–1) of a corner that is passed at constant speed.
    fn point_in_corner(&self, i: usize, x: f64, time: f64, speed: f64) -> TrajectoryPoint {
        let (q, dof, half) = (&self.path[i], self.path[i].len(), self.corners[i].half);
        let (before, after) = (&self.direction(i - 1)[..dof], &self.direction(i)[..dof]);
        let Progress { area, part, curvature } = progress(self.jerk, x);
        let (along, area, square) =
            (half * (2.0 * x - 1.0), 2.0 * half * area, curvature * speed * speed / (2.0 * half));
        let both = || before.iter().zip(after);
        TrajectoryPoint {
            time_from_start: time,
            positions: q.iter().zip(both()).map(|(q, (a, b))| q + a * along + (b - a) * area).collect(),
            velocities: both().map(|(a, b)| (a + (b - a) * part) * speed).collect(),
            accelerations: both().map(|(a, b)| (b - a) * square).collect(),
        }
    }
}

//! The quickest motion along a path that passes each corner at constant speed: double-S profiles on the lines between
//! them ([`double_s`](dimos_core::double_s)). It keeps velocity, acceleration and jerk limits by construction, and
//! every speed of a corner follows from its limits in closed form.
//!
//! With jerk limits the curvature of a corner rises linearly, stays, and falls, each over a third of it: at constant
//! speed the jerk is constant in each third. Without, the curvature is constant. So every piece of the motion is a
//! cubic in time.
//!
//! Good where lines are long compared to the corners.

use dimos_kernels::Width;
use dimos_kernels::states::{Blocks, Eight, JOINTS, States, Station};

use super::blend::REVERSAL;
use super::settings::CornerSettings;
use dimos_core::double_s::{LineLimits, State};
use dimos_core::joint::JointBounds;

/// Minimum time between points [s]: polynomials through closer ones would amplify rounding errors of positions.
const MIN_INTERVAL: f64 = 1e-4;
/// Part of the limits left to rounding errors.
const ROUNDING: f64 = 1e-9;
/// A path whose corners are blended, and its limits.
#[derive(Debug)]
pub(in crate::planning) struct RoundedPath {
    /// Joints of a configuration.
    joints: usize,
    /// Blocks per configuration.
    blocks: usize,
    /// The path's configurations.
    configurations: Vec<Eight>,
    /// Direction of each line, of length 1.
    directions: Vec<Eight>,
    lines: Vec<Line>,
    /// One per configuration; those of the ends are rests.
    corners: Vec<Corner>,
    jerk: bool,
    /// Longest time from zero to full acceleration of a joint [s]; 0 without jerk limits.
    ramp: f64,
    settings: CornerSettings,
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
    /// Maximum constant speed, regardless of the lines' lengths [rad/s]; 0 where the motion rests.
    speed: f64,
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
#[inline]
fn progress(jerk: bool, x: f64) -> Progress {
    if !jerk {
        return Progress { area: 0.5 * x * x, part: x, curvature: 1.0 };
    }
    // The second half mirrors the first, whose curvature has slope 4.5 over the first third, up to 1.5.
    let near = x.min(1.0 - x);
    let (ramp, flat) = (near.min(1.0 / 3.0), (near - 1.0 / 3.0).max(0.0));
    let part = 2.25 * ramp * ramp + 1.5 * flat;
    let area = 0.75 * ramp * ramp * ramp + flat * (0.25 + 0.75 * flat);
    let (area, part) = if x > 0.5 { (x - 0.5 + area, 1.0 - part) } else { (area, part) };
    Progress { area, part, curvature: 4.5 * ramp }
}

/// Limits as factors, block by block.
struct Inverse {
    velocity: Vec<Eight>,
    acceleration: Vec<Eight>,
    jerk: Vec<Eight>,
}

impl Inverse {
    fn of(bounds: &[JointBounds]) -> Self {
        let list = |of: fn(&JointBounds) -> f64| {
            let block = |bounds: &[JointBounds]| {
                let mut block = [0.0; JOINTS];
                block.iter_mut().zip(bounds).for_each(|(inverse, b)| *inverse = (1.0 + ROUNDING) / of(b));
                block
            };
            bounds.chunks(JOINTS).map(block).collect()
        };
        Self { velocity: list(|b| b.velocity), acceleration: list(|b| b.acceleration), jerk: list(|b| b.jerk) }
    }
}

/// Returns the largest `|value|·factor`.
fn most(values: &[Eight], factors: &[Eight]) -> f64 {
    let mut most = [0.0_f64; JOINTS];
    for (values, factors) in values.iter().zip(factors) {
        for k in 0..JOINTS {
            let used = values[k].abs() * factors[k];
            most[k] = if used > most[k] { used } else { most[k] };
        }
    }
    halved(most, |a, b| if b > a { b } else { a })
}

/// Combines all numbers of a block, half of them with the other half: none waits for seven others.
fn halved(block: Eight, of: impl Fn(f64, f64) -> f64) -> f64 {
    let four: [f64; 4] = std::array::from_fn(|k| of(block[k], block[k + 4]));
    of(of(four[0], four[2]), of(four[1], four[3]))
}

/// Writes the difference of two directions or configurations; returns its length.
fn difference(from: &[Eight], to: &[Eight], out: &mut [Eight]) -> f64 {
    let mut square = [0.0; JOINTS];
    for ((out, from), to) in out.iter_mut().zip(from).zip(to) {
        for k in 0..JOINTS {
            out[k] = to[k] - from[k];
            square[k] += out[k] * out[k];
        }
    }
    halved(square, |a, b| a + b).sqrt()
}

impl RoundedPath {
    /// Blends the corners of a path without repeated configurations. At configuration `i` the motion stays within
    /// `deviation[i]` [rad, Euclidean] of the path; it rests where that is 0.
    pub fn new(path: &[Vec<f64>], bounds: &[JointBounds], deviation: &[f64], settings: &CornerSettings) -> Self {
        let blocks = bounds.len().div_ceil(JOINTS);
        let inverse = Inverse::of(bounds);
        let jerk = inverse.jerk.as_flattened().iter().any(|inverse| *inverse > 0.0);
        let ramps = bounds.iter().map(|b| b.acceleration / b.jerk).filter(|_| jerk);
        let ramp = ramps.fold(0.0, f64::max);
        let mut configurations = vec![[0.0; JOINTS]; blocks * path.len()];
        for (q, blocks) in path.iter().zip(configurations.chunks_exact_mut(blocks)) {
            blocks.as_flattened_mut()[..q.len()].copy_from_slice(q);
        }
        let mut directions = vec![[0.0; JOINTS]; blocks * path.len().saturating_sub(1)];
        let mut lines = Vec::with_capacity(path.len());
        for (i, direction) in directions.chunks_exact_mut(blocks).enumerate() {
            let [from, to] = [i, i + 1].map(|i| &configurations[i * blocks..(i + 1) * blocks]);
            let length = difference(from, to, direction);
            let inverse_length = 1.0 / length.max(f64::MIN_POSITIVE);
            direction.as_flattened_mut().iter_mut().for_each(|d| *d *= inverse_length);
            let acceleration = 1.0 / most(direction, &inverse.acceleration);
            // Of joints without jerk limits among others: points of the motion have one acceleration.
            let ramped = |limit: f64| limit.min(acceleration / settings.min_ramp);
            let jerk = if jerk { ramped(1.0 / most(direction, &inverse.jerk)) } else { f64::INFINITY };
            let limits = LineLimits { speed: 1.0 / most(direction, &inverse.velocity), acceleration, jerk };
            lines.push(Line { length, limits });
        }
        let corners = vec![Corner::default(); path.len()];
        let (joints, settings) = (bounds.len(), *settings);
        let mut rounded = Self { joints, blocks, configurations, directions, lines, corners, jerk, ramp, settings };
        let mut turn = vec![[0.0; JOINTS]; blocks];
        for i in 1..path.len().saturating_sub(1) {
            let length = difference(rounded.direction(i - 1), rounded.direction(i), &mut turn);
            let used = [most(&turn, &inverse.acceleration), if jerk { most(&turn, &inverse.jerk) } else { 0.0 }];
            rounded.corners[i] = Corner { turn: length, used, ..Corner::default() };
            rounded.blend(i, deviation.get(i).copied().unwrap_or(0.0));
        }
        rounded
    }

    /// Blends corner `i` within another deviation [rad].
    pub fn blend(&mut self, i: usize, deviation: f64) {
        let [before, after] = [i - 1, i].map(|line| &self.lines[line]);
        let (room, jerk) = (0.5 * before.length.min(after.length), self.jerk);
        let most = before.limits.speed.min(after.limits.speed);
        let corner = &mut self.corners[i];
        // The middle of the corner is farthest from the path: 2·half·turn·∫σ over its first half.
        let length = deviation / (2.0 * progress(jerk, 0.5).area * corner.turn.max(1e-9));
        corner.half = if corner.turn > REVERSAL || deviation <= 0.0 { 0.0 } else { length.min(room) };
        let ([used, used_jerk], length) = (corner.used, 2.0 * corner.half);
        corner.speed = if corner.half <= 0.0 {
            0.0
        } else if jerk {
            // Largest curvature and change of curvature for a unit turn and length.
            most.min((length / (1.5 * used)).sqrt()).min((length * length / (4.5 * used_jerk)).cbrt())
        } else {
            most.min((length / used).sqrt())
        };
    }

    fn direction(&self, line: usize) -> &[Eight] {
        &self.directions[line * self.blocks..(line + 1) * self.blocks]
    }

    /// Returns the length of a line between its corners [rad].
    fn straight(&self, line: usize) -> f64 {
        let (Line { length, .. }, [a, b]) = (self.lines[line], [line, line + 1].map(|i| self.corners[i].half));
        let straight = length - a - b;
        if straight > 1e-9 * length { straight } else { 0.0 }
    }

    fn as_blocks(&self) -> Blocks<'_> {
        let (configurations, directions) = (&self.configurations, &self.directions);
        Blocks { configurations, directions, each: self.blocks }
    }

    /// Writes the ends of the straight pieces that follow corner `i` within `sagitta` [rad], in blocks; nothing for a
    /// rest. Returns the number of blocks of each.
    pub fn corner(&self, i: usize, sagitta: f64, factors: &mut Vec<[f64; 2]>, out: &mut Vec<Eight>) -> usize {
        let pieces = self.pieces(i, sagitta);
        let (length, step, jerk) = (2.0 * self.corners[i].half, 1.0 / pieces.max(1) as f64, self.jerk);
        let ends = if pieces > 0 { pieces + 1 } else { 0 };
        factors.clear();
        factors.extend((0..ends).map(|k| {
            let x = k as f64 * step;
            let after = length * progress(jerk, x).area;
            [length * (x - 0.5) - after, after]
        }));
        self.as_blocks().places(i, factors, out, Width::widest());
        self.blocks
    }

    /// Writes the ends of the part of a line between its corners.
    pub fn ends_of_line(&self, line: usize, from: &mut [f64], to: &mut [f64]) {
        let [first, last] = [line, line + 1].map(|i| self.corners[i].half);
        let [a, b] = [line, line + 1].map(|i| self.configurations[i * self.blocks..].as_flattened());
        let ends = a.iter().zip(b).zip(self.direction(line).as_flattened());
        for ((from, to), ((a, b), d)) in from.iter_mut().zip(to).zip(ends) {
            (*from, *to) = (a + d * first, b - d * last);
        }
    }

    /// Returns the number of straight pieces that follow corner `i` within `sagitta` [rad]; 0 for a rest.
    fn pieces(&self, i: usize, sagitta: f64) -> usize {
        let corner = &self.corners[i];
        let bend = 2.0 * corner.turn * corner.half * if self.jerk { 1.5 } else { 1.0 };
        if corner.half > 0.0 { (bend / (8.0 * sagitta)).sqrt().ceil().max(2.0) as usize } else { 0 }
    }

    /// Returns the speeds at all configurations [rad/s].
    pub fn speeds(&self) -> Vec<f64> {
        let last = self.corners.len() - 1;
        let mut speeds: Vec<f64> = self.corners.iter().map(|corner| corner.speed).collect();
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
        for (corner, speed) in self.corners.iter().zip(speeds) {
            if corner.half > 0.0 {
                slowed += usize::from(*speed < self.settings.slowed * corner.speed);
                time += 2.0 * corner.half / speed;
                number += 1;
            }
        }
        let short = !self.jerk || time <= self.settings.short * self.ramp * number as f64;
        self.settings.corners_per_slowed * slowed <= number && short && time.is_finite()
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
    pub fn motion(&self, speeds: &[f64]) -> States {
        let stations = self.stations(speeds);
        let mut states = States::new(self.joints, stations.len());
        states.extend(&stations, self.as_blocks(), Width::widest());
        states
    }

    /// Returns where the jerk changes at these speeds.
    fn stations(&self, speeds: &[f64]) -> Vec<Station> {
        let last = self.corners.len() - 1;
        let mut stations: Vec<Station> = Vec::with_capacity(if self.jerk { 11 } else { 5 } * self.corners.len());
        let mut start = 0.0;
        stations.push(Station::default());
        for line in 0..last {
            let (from, to) = (speeds[line], speeds[line + 1]);
            let begin = self.corners[line].half;
            let mut end = State { speed: from, ..State::default() };
            let length = self.straight(line);
            if length > 0.0 {
                let mut before = stations.last().map_or(0.0, |s| s.time);
                self.lines[line].limits.travel(from, to, length, |state| {
                    if start + state.time - before >= MIN_INTERVAL {
                        stations.push(on_line(line, begin, start, state));
                        before = start + state.time;
                    }
                    end = state;
                });
                // The end of the line in place of a point just before it.
                if before < start + end.time && stations.len() > 1 {
                    stations.pop();
                    stations.push(on_line(line, begin, start, State { at: length, acceleration: 0.0, ..end }));
                }
                start += end.time;
            }
            let half = self.corners[line + 1].half;
            if half > 0.0 {
                let time = 2.0 * half / to;
                if self.jerk && time > 3.0 * MIN_INTERVAL {
                    for x in [1.0 / 3.0, 2.0 / 3.0] {
                        stations.push(self.in_third(line + 1, x, start + time * x, to));
                    }
                }
                start += time;
                let after = [half, to, 0.0];
                stations.push(Station { time: start, at: line + 1, before: [0.0; 3], after });
            }
        }
        stations
    }

    /// Returns the station at part `x` (0–1) of a corner that is passed at constant speed.
    fn in_third(&self, i: usize, x: f64, time: f64, speed: f64) -> Station {
        let half = self.corners[i].half;
        let Progress { area, part, curvature } = progress(self.jerk, x);
        let (along, area, bend) = (half * (2.0 * x - 1.0), 2.0 * half * area, curvature * speed * speed / (2.0 * half));
        let (before, after) = ([along - area, (1.0 - part) * speed, -bend], [area, part * speed, bend]);
        Station { time, at: i, before, after }
    }
}

/// Returns the station of a state on a line that begins at time `start` and `begin` from its first configuration.
fn on_line(line: usize, begin: f64, start: f64, state: State) -> Station {
    let after = [begin + state.at, state.speed, state.acceleration];
    Station { time: start + state.time, at: line, before: [0.0; 3], after }
}

//! Motions in double precision, eight joints at a time: the states of all joints at given times, and the most that the
//! spline through them needs.

use crate::Width;
use crate::width::Vectors;

/// Number of joints that are computed together.
pub const JOINTS: usize = 8;
/// One number of each of eight joints; 0 beyond the last joint.
pub type Eight = [f64; JOINTS];

/// Largest effect of rounding of positions on the factors of a quintic's speed: thirty times four units.
const POSITION_ROUNDING: f64 = 120.0 * f64::EPSILON;

/// Times, and the position, velocity and acceleration of all joints at each.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct States {
    joints: usize,
    blocks: usize,
    times: Vec<f64>,
    /// Of each time the positions, the velocities, the accelerations.
    values: Vec<Eight>,
}

/// A state on a rounded path. Position, velocity and acceleration are sums of the direction of the line before a
/// configuration, times `before`, and of the line after it, times `after`; the position is relative to the
/// configuration.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Station {
    /// Time since the start [s].
    pub time: f64,
    /// Index of the configuration.
    pub at: usize,
    /// Factors of the direction before [rad, rad/s, rad/s²].
    pub before: [f64; 3],
    /// Factors of the direction after.
    pub after: [f64; 3],
}

impl States {
    /// Creates a list without states, with room for `capacity` of them.
    pub fn new(joints: usize, capacity: usize) -> Self {
        let blocks = joints.div_ceil(JOINTS);
        let (times, values) = (Vec::with_capacity(capacity), Vec::with_capacity(capacity * 3 * blocks));
        Self { joints, blocks, times, values }
    }

    /// Returns the times [s].
    pub fn times(&self) -> &[f64] {
        &self.times
    }

    /// Returns the time of the last state [s]; 0 without one.
    pub fn duration(&self) -> f64 {
        self.times.last().copied().unwrap_or(0.0)
    }

    /// Returns the positions, velocities and accelerations of all states, if a block holds all joints.
    pub fn in_one_block(&self) -> Option<&[[Eight; 3]]> {
        (self.blocks == 1).then(|| self.values.as_chunks().0)
    }

    /// Returns whether there are two states, all values are finite, and each time is later than the one before it.
    pub fn are_finite_and_in_order(&self) -> bool {
        let in_order = self.times.windows(2).fold(true, |good, pair| good & (pair[0] < pair[1]));
        // Zero times a number is not a number unless that is finite.
        let mut zero = [0.0; JOINTS];
        for row in &self.values {
            for k in 0..JOINTS {
                zero[k] += row[k] * 0.0;
            }
        }
        self.times.len() > 1 && in_order && self.duration().is_finite() && zero == [0.0; JOINTS]
    }

    /// Returns the positions (0), velocities (1) or accelerations (2) of a state.
    ///
    /// # Panics
    /// If there is no such state.
    #[inline]
    pub fn values(&self, state: usize, which: usize) -> &[f64] {
        let first = (3 * state + which) * self.blocks;
        &self.values[first..first + self.blocks].as_flattened()[..self.joints]
    }

    /// The same, to be written.
    ///
    /// # Panics
    /// If there is no such state.
    pub fn values_mut(&mut self, state: usize, which: usize) -> &mut [f64] {
        let first = (3 * state + which) * self.blocks;
        &mut self.values[first..first + self.blocks].as_flattened_mut()[..self.joints]
    }

    /// Adds a state: position, velocity and acceleration of each joint.
    pub fn push(&mut self, time: f64, joints: impl Iterator<Item = [f64; 3]>) {
        let first = self.values.len();
        self.times.push(time);
        self.values.resize(first + 3 * self.blocks, [0.0; JOINTS]);
        for (j, three) in joints.take(self.joints).enumerate() {
            for (which, value) in three.into_iter().enumerate() {
                self.values[first + which * self.blocks + j / JOINTS][j % JOINTS] = value;
            }
        }
    }

    /// Removes the last state.
    pub fn pop(&mut self) {
        self.times.pop();
        self.values.truncate(3 * self.blocks * self.times.len());
    }

    /// Adds the states of another list, `start` later, without its first if there are some already.
    pub fn append(&mut self, other: &Self, start: f64) {
        let skip = usize::from(!self.times.is_empty());
        self.times.extend(other.times.iter().skip(skip).map(|time| time + start));
        self.values.extend_from_slice(&other.values[(3 * skip * other.blocks).min(other.values.len())..]);
    }

    /// Stretches the same motion in time by a factor.
    pub fn stretch(&mut self, factor: f64) {
        if factor == 1.0 {
            return;
        }
        let inverse = 1.0 / factor;
        self.times.iter_mut().for_each(|time| *time *= factor);
        for state in self.values.chunks_exact_mut(3 * self.blocks.max(1)) {
            let (_, derivatives) = state.split_at_mut(self.blocks);
            let (velocities, accelerations) = derivatives.split_at_mut(self.blocks);
            velocities.as_flattened_mut().iter_mut().for_each(|v| *v *= inverse);
            accelerations.as_flattened_mut().iter_mut().for_each(|a| *a *= inverse * inverse);
        }
    }

    /// Adds the states of a rounded path at these stations.
    ///
    /// # Panics
    /// If a station is at no configuration of the path, or that has another number of blocks.
    pub fn extend(&mut self, stations: &[Station], path: Blocks<'_>, width: Width) {
        assert_eq!(path.each, self.blocks, "configurations of as many joints");
        self.times.extend(stations.iter().map(|station| station.time));
        self.values.reserve(stations.len() * 3 * self.blocks);
        match width.0 {
            // SAFETY: only `Width` makes one, and only of vectors that this processor has.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { extend_avx512(self, stations, path) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { extend_avx2(self, stations, path) },
            Vectors::Portable => extend(self, stations, path),
        }
    }

    /// Returns upper bounds of the speed, acceleration and jerk of a block of joints on the spline through the states:
    /// quintic, or cubic without regard to accelerations. Exact where the acceleration is constant, or linear without a
    /// change of its sign.
    ///
    /// # Panics
    /// If there is no such block.
    pub fn most(&self, block: usize, quintic: bool, width: Width) -> [Eight; 3] {
        assert!(block < self.blocks, "{} blocks", self.blocks);
        match width.0 {
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { most_avx512(self, block, quintic) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { most_avx2(self, block, quintic) },
            Vectors::Portable => most(self, block, quintic),
        }
    }
}

/// The configurations and lines of a path, one after the other, each in blocks.
#[derive(Debug, Clone, Copy)]
pub struct Blocks<'a> {
    /// All configurations [rad].
    pub configurations: &'a [Eight],
    /// The direction of each line, of length 1.
    pub directions: &'a [Eight],
    /// Number of blocks of a configuration.
    pub each: usize,
}

impl Blocks<'_> {
    /// Returns a configuration and the directions before and after it; at both ends of the path they are the same.
    #[inline(always)]
    fn around(&self, at: usize) -> [&[Eight]; 3] {
        let (first, last) = (at * self.each, self.directions.len() - self.each);
        let (before, after) = (first.saturating_sub(self.each), first.min(last));
        [
            &self.configurations[first..first + self.each],
            &self.directions[before..before + self.each],
            &self.directions[after..after + self.each],
        ]
    }

    /// Replaces `out` by the positions of stations at configuration `at`, given the factors of the directions before
    /// and after it [rad].
    ///
    /// # Panics
    /// If there is no such configuration.
    pub fn places(self, at: usize, factors: &[[f64; 2]], out: &mut Vec<Eight>, width: Width) {
        out.clear();
        match width.0 {
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx512 => unsafe { places_avx512(self, at, factors, out) },
            // SAFETY: see above.
            #[cfg(target_arch = "x86_64")]
            Vectors::Avx2 => unsafe { places_avx2(self, at, factors, out) },
            Vectors::Portable => places(self, at, factors, out),
        }
    }
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn extend_avx512(states: &mut States, stations: &[Station], path: Blocks<'_>) {
    extend(states, stations, path);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn extend_avx2(states: &mut States, stations: &[Station], path: Blocks<'_>) {
    extend(states, stations, path);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn places_avx512(path: Blocks<'_>, at: usize, factors: &[[f64; 2]], out: &mut Vec<Eight>) {
    places(path, at, factors, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn places_avx2(path: Blocks<'_>, at: usize, factors: &[[f64; 2]], out: &mut Vec<Eight>) {
    places(path, at, factors, out);
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f")]
fn most_avx512(states: &States, block: usize, quintic: bool) -> [Eight; 3] {
    most(states, block, quintic)
}

#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2")]
fn most_avx2(states: &States, block: usize, quintic: bool) -> [Eight; 3] {
    most(states, block, quintic)
}

/// Returns `base + u·x + v·y`.
#[inline(always)]
fn sum(base: &Eight, (u, x): (&Eight, f64), (v, y): (&Eight, f64)) -> Eight {
    let mut sum = [0.0; JOINTS];
    for k in 0..JOINTS {
        sum[k] = base[k] + u[k] * x + v[k] * y;
    }
    sum
}

// No closures here: they are compiled without the vectors of their caller where they are not inlined.
#[inline(always)]
fn extend(states: &mut States, stations: &[Station], path: Blocks<'_>) {
    let zero = [0.0; JOINTS];
    for Station { at, before: [x0, x1, x2], after: [y0, y1, y2], .. } in stations {
        let [q, u, v] = path.around(*at);
        if let ([q], [u], [v]) = (q, u, v) {
            let velocity = sum(&zero, (u, *x1), (v, *y1));
            states.values.extend_from_slice(&[sum(q, (u, *x0), (v, *y0)), velocity, sum(&zero, (u, *x2), (v, *y2))]);
            continue;
        }
        for (which, (x, y)) in [(x0, y0), (x1, y1), (x2, y2)].into_iter().enumerate() {
            for b in 0..path.each {
                let base = if which == 0 { &q[b] } else { &zero };
                states.values.push(sum(base, (&u[b], *x), (&v[b], *y)));
            }
        }
    }
}

#[inline(always)]
fn places(path: Blocks<'_>, at: usize, factors: &[[f64; 2]], out: &mut Vec<Eight>) {
    let [q, before, after] = path.around(at);
    out.reserve(factors.len() * path.each);
    for [x, y] in factors {
        for b in 0..path.each {
            out.push(sum(&q[b], (&before[b], *x), (&after[b], *y)));
        }
    }
}

#[inline(always)]
fn most(states: &States, block: usize, quintic: bool) -> [Eight; 3] {
    let mut most = [[0.0; JOINTS]; 3];
    let mut rows = states.values.chunks_exact(3 * states.blocks);
    let (Some(mut last), Some(mut time)) = (rows.next(), states.times.first().copied()) else { return most };
    for (row, now) in rows.zip(&states.times[1..]) {
        let h = now - time;
        let (p0, v0, a0) = (&last[block], &last[states.blocks + block], &last[2 * states.blocks + block]);
        let (p1, v1, a1) = (&row[block], &row[states.blocks + block], &row[2 * states.blocks + block]);
        let inverse = 1.0 / h;
        for k in 0..JOINTS {
            let (ends, speeds) = ([p0[k], p1[k]], [v0[k], v1[k]]);
            let used = if quintic {
                of_quintic(ends, speeds, [a0[k], a1[k]], h, inverse)
            } else {
                of_cubic(ends, speeds, inverse)
            };
            for which in 0..3 {
                most[which][k] = larger(most[which][k], used[which]);
            }
        }
        (last, time) = (row, *now);
    }
    most
}

#[inline(always)]
fn larger(a: f64, b: f64) -> f64 {
    if a > b { a } else { b }
}

/// Returns upper bounds of the speed, acceleration and jerk of one joint on a quintic segment of duration `h` between
/// two states.
#[inline(always)]
fn of_quintic([p0, p1]: [f64; 2], [v0, v1]: [f64; 2], [a0, a1]: [f64; 2], h: f64, inverse: f64) -> [f64; 3] {
    // Speed is v0 + x·(c1 + x·(c2 + x·(c3 + x·c4))), with x from 0 to 1 and c1 = a0·h. In a cubic, `second` and `first`
    // would be 0: what v1 and p1 are beyond a linear acceleration. Then c4 = 30·first, c3 = −60·first − 2·second.
    let (c1, b1) = (a0 * h, a1 * h);
    let bend = b1 - c1;
    let second = (v1 - v0 - (c1 + b1) * 0.5).abs();
    let first = ((p1 - p0) * inverse - (v0 + v1) * 0.5 + bend * (1.0 / 12.0)).abs() * 30.0;
    let noise = larger(p0.abs(), p1.abs()) * (POSITION_ROUNDING * inverse);
    let (first, bend) = (larger(first - noise, 0.0), bend.abs());
    // Beyond the line between the values at the ends: at most 1/4 of a square's factor, 0.385 of a cube's and 0.473 of
    // a fourth power's. A speed whose acceleration does not change its sign has its extremes at the ends.
    let turns = if c1 * b1 < 0.0 { 0.25 } else { 0.0 };
    let speed = larger(v0.abs(), v1.abs()) + first * 1.25 + second * 0.8 + turns * (first + second * 3.0 + bend * 0.5);
    let acceleration = larger(c1.abs(), b1.abs()) + first * 3.04 + second * 1.5;
    // Beyond its mean.
    let jerk = bend + first * 14.0 + second * 6.0;
    [speed, acceleration * inverse, jerk * (inverse * inverse)]
}

/// Returns upper bounds of the speed, acceleration and jerk of one joint on a cubic segment between two states.
#[inline(always)]
fn of_cubic([p0, p1]: [f64; 2], [v0, v1]: [f64; 2], inverse: f64) -> [f64; 3] {
    let d = (p1 - p0) * (6.0 * inverse);
    // Change of speed over the segment at the rate of either end.
    let (c0, c1) = (d - v0 * 4.0 - v1 * 2.0, v0 * 2.0 + v1 * 4.0 - d);
    let change = (c1 - c0).abs();
    let turns = if c0 * c1 < 0.0 { 0.125 } else { 0.0 };
    let speed = larger(v0.abs(), v1.abs()) + turns * change;
    [speed, larger(c0.abs(), c1.abs()) * inverse, change * (inverse * inverse)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn all_widths_give_the_same_states_and_bounds() {
        let mut state = 3_u64;
        let mut number = || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
        };
        for joints in [1_usize, 7, 8, 14] {
            let blocks = joints.div_ceil(JOINTS);
            let mut rows =
                |n: usize| -> Vec<Eight> { (0..n * blocks).map(|_| std::array::from_fn(|_| number())).collect() };
            let (path, directions) = (rows(5), rows(4));
            let station = |k: usize| Station {
                time: 0.1 * k as f64,
                at: k % 5,
                before: [0.1, 0.2, 0.3 * k as f64],
                after: [0.01 * k as f64, 0.5, -0.1],
            };
            let stations: Vec<Station> = (0..40).map(station).collect();
            let made: Vec<_> = Width::usable()
                .into_iter()
                .map(|width| {
                    let mut states = States::new(joints, stations.len());
                    let whole = Blocks { configurations: &path, directions: &directions, each: blocks };
                    states.extend(&stations, whole, width);
                    let mut places = vec![[7.0; JOINTS]];
                    whole.places(2, &[[0.1, 0.01 * 2.0], [0.0, 0.0]], &mut places, width);
                    assert_eq!(places[..blocks].as_flattened()[..joints], *states.values(2, 0));
                    let most = |block| [true, false].map(|quintic| states.most(block, quintic, width));
                    let most: Vec<_> = (0..blocks).map(most).collect();
                    (states, most)
                })
                .collect();
            assert!(made.iter().all(|one| one == &made[0]), "{joints} joints");
            // One state by its definition: the last direction serves the last configuration.
            let (states, j) = (&made[0].0, joints - 1);
            let of = |rows: &[Eight], row: usize| rows[row * blocks + j / JOINTS][j % JOINTS];
            for (k, s) in stations.iter().enumerate() {
                let (u, v) = (of(&directions, s.at.saturating_sub(1)), of(&directions, s.at.min(3)));
                let expected = of(&path, s.at) + u * s.before[0] + v * s.after[0];
                assert!((states.values(k, 0)[j] - expected).abs() < 1e-15 && states.values(k, 0).len() == joints);
                assert!((states.values(k, 2)[j] - (u * s.before[2] + v * s.after[2])).abs() < 1e-12);
            }
        }
    }
}

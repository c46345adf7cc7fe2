//! Jerk limiting along a curve: `s(t)` is averaged over a time window.
//!
//! The average of a rest-to-rest motion is a rest-to-rest motion along the same curve, longer by the window `W`. Its
//! acceleration is `(ṡ(t) − ṡ(t − W)) / W`, which has no jumps. Its jerk is `(s̈(t) − s̈(t − W)) / W`, constant between
//! the times at which `s̈` jumps now or jumped a window ago. So the average is evaluated from one of these times to the
//! next, in exact cubics.
//!
//! The time-optimal motion without jerk limits is averaged. Its average is faster than the motion where that is
//! slowest, in a corner: pieces that exceed the limits get a lower pace, in a few rounds; any remaining excess slows
//! down the whole motion.

use dimos_kernels::states::States;

use super::blend::{Curve, Jet, Piece};
use super::settings::TimingSettings;
use super::topp::{GridPoint, Pace, speed_grid};
use super::verify::Excess;
use dimos_core::joint::JointBounds;

/// Minimum time between knots [s]: polynomials through closer ones would amplify rounding errors of positions.
const MIN_KNOT_INTERVAL: f64 = 1e-4;

/// Returns the knots of a curve's motion, to be joined by quintics.
pub(in crate::planning) fn averaged(curve: &Curve, bounds: &[JointBounds], settings: &TimingSettings) -> States {
    let gauge = Gauge::new(curve, bounds);
    // Time from zero to full acceleration.
    let window = bounds.iter().filter(|b| b.jerk.is_finite()).map(|b| b.acceleration / b.jerk).fold(1e-6, f64::max);
    let mut best: Option<(f64, Motion)> = None;
    // Twice the window: from full acceleration to full deceleration. Where a line is too short for full acceleration,
    // half of that suffices.
    let windows: &[f64] = if curve.len() > 1 { &[2.0] } else { &[1.0, 2.0] };
    for factor in windows {
        let most = best.as_ref().map_or(f64::INFINITY, |b| b.0);
        let found = paced(curve, bounds, &gauge, (window * factor, most), settings);
        let found = found.map(|motion| (motion.needed(&gauge), motion)).filter(|found| found.0 < most);
        best = found.or(best);
    }
    best.map(|(_, motion)| motion.knots(curve)).unwrap_or_default()
}

/// Returns the time-optimal motion with paces at which its average approximately keeps the limits; `None` if it takes
/// longer than `most` [s].
fn paced(
    curve: &Curve,
    bounds: &[JointBounds],
    gauge: &Gauge<'_>,
    (window, most): (f64, f64),
    settings: &TimingSettings,
) -> Option<Motion> {
    let (constraints, speed_grid) = speed_grid(curve, bounds, settings.corner_intervals);
    let mut paces = vec![Pace::FULL; curve.len()];
    let mut slower = vec![1.0; curve.len()];
    let mut rounds = 0;
    loop {
        let motion =
            Motion { phases: phases(&speed_grid.timed(&speed_grid.fastest(&constraints, &paces), &paces)), window };
        if motion.duration() > most {
            return None;
        }
        slower.fill(1.0);
        for leg in motion.walk(curve) {
            let factor = gauge.slower(&leg);
            if factor > settings.jerk.correction_ratio {
                slower[leg.sources.0..=leg.sources.1].iter_mut().for_each(|s| *s = f64::max(*s, factor));
            }
        }
        if rounds == settings.jerk.rounds || slower.iter().all(|s| *s <= 1.0) {
            return Some(motion);
        }
        rounds += 1;
        for ((pace, slower), piece) in paces.iter_mut().zip(&slower).zip(curve) {
            pace.acceleration /= slower * slower;
            pace.x /= if piece.bends { slower * slower } else { 1.0 };
        }
    }
}

/// A motion and its averaging window [s].
struct Motion {
    phases: Vec<Phase>,
    window: f64,
}

impl Motion {
    /// Duration of the average after slowing it down to keep all limits [s].
    fn needed(&self, gauge: &Gauge<'_>) -> f64 {
        self.duration() * self.walk(gauge.curve).map(|leg| gauge.slower(&leg)).fold(1.0, f64::max)
    }

    /// Duration of the average [s].
    fn duration(&self) -> f64 {
        self.phases.last().map_or(0.0, |phase| phase.end) + self.window
    }

    fn walk<'a>(&'a self, curve: &'a Curve) -> Walk<'a> {
        Walk { phases: &self.phases, curve, window: self.window, now: 0, before: 0, time: 0.0, here: Knot::default() }
    }

    /// Returns the average at the ends of its legs.
    fn knots(&self, curve: &Curve) -> States {
        let joints = curve.first().map_or(0, |piece| piece.start.len());
        let mut states = States::new(joints, 2 * self.phases.len() + curve.len());
        add(&mut states, curve, &Knot::default(), 0.0);
        let (mut last, mut end) = (0.0, None);
        for leg in self.walk(curve) {
            if leg.time - last >= MIN_KNOT_INTERVAL {
                add(&mut states, curve, &leg.to, leg.time);
                last = leg.time;
            }
            end = Some(leg);
        }
        // The last knot is the end, at rest.
        if let Some(leg) = end {
            if states.times().len() > 1 {
                states.pop();
            }
            add(&mut states, curve, &Knot { v: 0.0, a: 0.0, ..leg.to }, leg.time);
        }
        states
    }
}

/// Adds the state at a knot.
fn add(states: &mut States, curve: &Curve, knot: &Knot, time: f64) {
    let state = |jet: Jet| [jet.q, jet.d1 * knot.v, jet.d2 * knot.v * knot.v + jet.d1 * knot.a];
    states.push(time, curve[knot.piece].jets(knot.at).map(state));
}

/// A phase of constant acceleration of the parameter.
#[derive(Debug, Clone, Copy)]
struct Phase {
    /// Time at its end [s].
    end: f64,
    /// The acceleration.
    u: f64,
    /// Index of its piece.
    piece: usize,
}

/// Returns the phases between the grid points of a motion.
fn phases(grid: &[GridPoint]) -> Vec<Phase> {
    let phase = |pair: &[GridPoint]| {
        let (a, b) = (&pair[0], &pair[1]);
        let length = b.s - a.s;
        (b.time > a.time).then(|| Phase { end: b.time, u: 0.5 * (b.x - a.x) / length, piece: b.piece })
    };
    grid.windows(2).filter_map(phase).collect()
}

/// Position along the curve, and its derivatives.
#[derive(Debug, Clone, Copy, Default)]
struct Knot {
    piece: usize,
    at: f64,
    v: f64,
    a: f64,
}

/// A leg between two knots: constant jerk.
#[derive(Debug, Clone, Copy)]
struct Leg {
    from: Knot,
    /// On the piece of `from`.
    to: Knot,
    jerk: f64,
    /// Time at its end [s].
    time: f64,
    /// First and last piece whose motion is averaged in it.
    sources: (usize, usize),
}

/// Iterates over the legs of the average.
struct Walk<'a> {
    phases: &'a [Phase],
    curve: &'a Curve,
    window: f64,
    /// Index of the current phase, and one more than that of the phase a window ago: 0 is the rest before the start.
    now: usize,
    before: usize,
    time: f64,
    here: Knot,
}

impl Iterator for Walk<'_> {
    type Item = Leg;

    fn next(&mut self) -> Option<Leg> {
        let end_of = |k: usize| if k == 0 { 0.0 } else { self.phases.get(k - 1).map_or(f64::INFINITY, |p| p.end) };
        let u_of = |k: usize| if k == 0 { 0.0 } else { self.phases.get(k - 1).map_or(0.0, |p| p.u) };
        let last = self.phases.len().checked_sub(1).filter(|last| self.before <= last + 1)?;
        let (now, before) = (end_of(self.now + 1), end_of(self.before) + self.window);
        let time = now.min(before);
        let (u_now, u_before) = (u_of(self.now + 1), u_of(self.before));
        let jerk = (u_now - u_before) / self.window;
        let from = self.here;
        let length = self.curve[from.piece].length;
        let step = time - self.time;
        let mut to = moved(&from, jerk, step);
        let sources =
            (self.phases[self.before.saturating_sub(1).min(last)].piece, self.phases[self.now.min(last)].piece);
        let sources = (sources.0.min(from.piece), sources.1.max(from.piece));
        if to.at > length && from.piece + 1 < self.curve.len() {
            // Ends earlier if it enters the next piece.
            let part = crossing(&from, jerk, step, length);
            to = moved(&from, jerk, part);
            to.at = length;
            self.time += part;
            self.here = Knot { piece: from.piece + 1, at: 0.0, ..to };
            return Some(Leg { from, to, jerk, time: self.time, sources });
        }
        self.time = time;
        self.here = to;
        if now <= time {
            self.now += 1;
        }
        if before <= time {
            self.before += 1;
        }
        Some(Leg { from, to, jerk, time, sources })
    }
}

/// Returns the state after time `t` at constant jerk.
fn moved(from: &Knot, jerk: f64, t: f64) -> Knot {
    Knot {
        piece: from.piece,
        at: from.at + t * (from.v + t * (0.5 * from.a + t * jerk / 6.0)),
        v: from.v + t * (from.a + 0.5 * t * jerk),
        a: from.a + t * jerk,
    }
}

/// Returns when a motion reaches `at`, which it does before `most`.
fn crossing(from: &Knot, jerk: f64, most: f64, at: f64) -> f64 {
    let (mut low, mut high, mut t) = (0.0, most, most);
    for _ in 0..60 {
        let knot = moved(from, jerk, t);
        let over = knot.at - at;
        if over > 0.0 {
            high = t;
        } else {
            low = t;
        }
        if over.abs() <= 1e-15 || high - low <= 1e-15 {
            break;
        }
        let newton = t - over / knot.v;
        t = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
    }
    t
}

/// Measures how much of the limits a motion along a curve uses.
struct Gauge<'a> {
    curve: &'a Curve,
    /// Inverse of the velocity, acceleration and jerk limit of each joint.
    inverse: Vec<[f64; 3]>,
    /// For each line, the largest part of each limit that a unit speed, acceleration and jerk of the parameter uses.
    lines: Vec<[f64; 3]>,
}

impl<'a> Gauge<'a> {
    fn new(curve: &'a Curve, bounds: &[JointBounds]) -> Self {
        let over = |b: &JointBounds| [1.0 / b.velocity, 1.0 / b.acceleration, 1.0 / b.jerk];
        let inverse: Vec<[f64; 3]> = bounds.iter().map(over).collect();
        let line = |piece: &Piece| {
            let most = |limit: usize| {
                piece.direction.iter().zip(&inverse).map(|(d, i)| d.abs() * i[limit]).fold(0.0, f64::max)
            };
            [most(0), most(1), most(2)]
        };
        let lines = curve.iter().map(line).collect();
        Self { curve, inverse, lines }
    }

    /// Returns the factor by which a leg must be slowed down to keep the limits.
    fn slower(&self, leg: &Leg) -> f64 {
        let piece = &self.curve[leg.from.piece];
        let mut most = [0.0_f64; 3];
        let mut see = |used: [f64; 3]| most.iter_mut().zip(used).for_each(|(m, u)| *m = if u > *m { u } else { *m });
        for knot in [&leg.from, &leg.to] {
            let (v, a, j) = (knot.v, knot.a, leg.jerk);
            if !piece.bends {
                let [velocity, acceleration, jerk] = self.lines[leg.from.piece];
                see([velocity * v, acceleration * a.abs(), jerk * j.abs()]);
                continue;
            }
            let t = piece.progress(knot.at);
            let (curved, changed) = (t.d1 * v * v, v * (3.0 * t.d1 * a + t.d2 * v * v));
            for ((direction, turn), [velocity, acceleration, jerk]) in
                piece.direction.iter().zip(&piece.turn).zip(&self.inverse)
            {
                let d1 = direction + turn * t.part;
                see([
                    (d1 * v).abs() * velocity,
                    (d1 * a + turn * curved).abs() * acceleration,
                    (d1 * j + turn * changed).abs() * jerk,
                ]);
            }
        }
        let [velocity, acceleration, jerk] = most;
        Excess { velocity, acceleration, jerk }.slower()
    }
}

//! Bounded jerk along a curve: `s(t)` averaged over a window of time.
//!
//! The average of a motion from rest to rest is one from rest to rest, along the same curve, longer by the window `W`;
//! its acceleration is `(ṡ(t) − ṡ(t − W)) / W`, so it has no jumps, and its jerk is `(s̈(t) − s̈(t − W)) / W`: constant
//! between the times where `s̈` jumps now or jumped a window ago. So the average is walked through from one of these
//! times to the next, in exact cubics.
//!
//! What is averaged is found in two ways, and the shorter motion is taken: [`steady`] keeps the limits by construction
//! and is good where lines are long. Else it is the fastest motion without jerk limits. Its average is faster than
//! itself where that is slowest, in a corner, and pieces where it uses more than the limits get a slower pace, a few
//! times; what is left then slows down the whole.

use crate::trajectory::TrajectoryPoint;

use super::blend::{Curve, Piece};
use super::steady::steady;
use super::topp::{GridPoint, JointBound, Pace, course};
use super::verify::Excess;

/// Times that the paces are corrected.
const ROUNDS: usize = 5;
/// More than this part of the limits is corrected.
const ENOUGH: f64 = 1.01;
/// Knots closer in time than this are one [s]: polynomials through closer ones would show the rounding of positions.
const CLOSE: f64 = 1e-4;

/// The knots of a curve's motion, to be joined by quintics.
pub(super) fn averaged(curve: &Curve, bounds: &[JointBound]) -> Vec<TrajectoryPoint> {
    let gauge = Gauge::new(curve, bounds);
    // From no acceleration to all of it.
    let window = bounds.iter().filter(|b| b.jerk.is_finite()).map(|b| b.acceleration / b.jerk).fold(1e-6, f64::max);
    let steady = steady(curve, bounds, window).map(|points| Motion { phases: phases(&points), window });
    let mut best: Option<(f64, Motion)> = steady.map(|motion| (motion.needed(&gauge), motion));
    // Twice the window: from all of it forwards to all of it backwards. Where a line is so short that it never is all of
    // it, half of that will do.
    let windows: &[f64] = if curve.len() > 1 { &[2.0] } else { &[1.0, 2.0] };
    for factor in windows {
        let most = best.as_ref().map_or(f64::INFINITY, |b| b.0);
        let found = paced(curve, bounds, &gauge, window * factor, most);
        let found = found.map(|motion| (motion.needed(&gauge), motion)).filter(|found| found.0 < most);
        best = found.or(best);
    }
    best.map(|(_, motion)| motion.knots(curve)).unwrap_or_default()
}

/// The fastest motion with paces at which its average keeps the limits, mostly; nothing where it takes longer than
/// `most` [s].
fn paced(curve: &Curve, bounds: &[JointBound], gauge: &Gauge<'_>, window: f64, most: f64) -> Option<Motion> {
    let (walls, course) = course(curve, bounds);
    let mut paces = vec![Pace::FULL; curve.len()];
    let mut slower = vec![1.0; curve.len()];
    let mut rounds = 0;
    loop {
        let motion = Motion { phases: phases(&course.timed(&course.fastest(&walls, &paces), &paces)), window };
        if motion.duration() > most {
            return None;
        }
        slower.fill(1.0);
        for leg in motion.walk(curve) {
            let factor = gauge.slower(&leg);
            if factor > ENOUGH {
                slower[leg.sources.0..=leg.sources.1].iter_mut().for_each(|s| *s = f64::max(*s, factor));
            }
        }
        if rounds == ROUNDS || slower.iter().all(|s| *s <= 1.0) {
            return Some(motion);
        }
        rounds += 1;
        for ((pace, slower), piece) in paces.iter_mut().zip(&slower).zip(curve) {
            pace.acceleration /= slower * slower;
            pace.x /= if piece.bends { slower * slower } else { 1.0 };
        }
    }
}

/// A motion, and the window it is averaged over [s].
struct Motion {
    phases: Vec<Phase>,
    window: f64,
}

impl Motion {
    /// Time that the average takes when it is so slow that it keeps all limits [s].
    fn needed(&self, gauge: &Gauge<'_>) -> f64 {
        self.duration() * self.walk(gauge.curve).map(|leg| gauge.slower(&leg)).fold(1.0, f64::max)
    }

    /// Time that the average takes [s].
    fn duration(&self) -> f64 {
        self.phases.last().map_or(0.0, |phase| phase.end) + self.window
    }

    fn walk<'a>(&'a self, curve: &'a Curve) -> Walk<'a> {
        Walk { phases: &self.phases, curve, window: self.window, now: 0, before: 0, time: 0.0, here: Place::default() }
    }

    /// The average at the ends of its legs.
    fn knots(&self, curve: &Curve) -> Vec<TrajectoryPoint> {
        let mut points: Vec<TrajectoryPoint> = Vec::with_capacity(2 * self.phases.len() + curve.len());
        points.push(knot(curve, &Place::default(), 0.0));
        let (mut last, mut end) = (0.0, None);
        for leg in self.walk(curve) {
            if leg.time - last >= CLOSE {
                points.push(knot(curve, &leg.to, leg.time));
                last = leg.time;
            }
            end = Some(leg);
        }
        // It ends where it ends, at rest.
        if let Some(leg) = end {
            if points.len() > 1 {
                points.pop();
            }
            points.push(knot(curve, &Place { v: 0.0, a: 0.0, ..leg.to }, leg.time));
        }
        points
    }
}

fn knot(curve: &Curve, place: &Place, time: f64) -> TrajectoryPoint {
    let piece = &curve[place.piece];
    let empty = || Vec::with_capacity(piece.start.len());
    let mut point =
        TrajectoryPoint { time_from_start: time, positions: empty(), velocities: empty(), accelerations: empty() };
    for jet in piece.jets(place.at) {
        point.positions.push(jet.q);
        point.velocities.push(jet.d1 * place.v);
        point.accelerations.push(jet.d2 * place.v * place.v + jet.d1 * place.a);
    }
    point
}

/// A time of constant acceleration of the parameter.
#[derive(Debug, Clone, Copy)]
struct Phase {
    /// Time at its end [s].
    end: f64,
    /// The acceleration.
    u: f64,
    /// The piece it is on.
    piece: usize,
}

/// The phases between the points of a motion.
fn phases(grid: &[GridPoint]) -> Vec<Phase> {
    let phase = |pair: &[GridPoint]| {
        let (a, b) = (&pair[0], &pair[1]);
        let length = b.s - a.s;
        (b.time > a.time).then(|| Phase { end: b.time, u: 0.5 * (b.x - a.x) / length, piece: b.piece })
    };
    grid.windows(2).filter_map(phase).collect()
}

/// Where the average is, and how it moves.
#[derive(Debug, Clone, Copy, Default)]
struct Place {
    piece: usize,
    at: f64,
    v: f64,
    a: f64,
}

/// From one knot to the next: constant jerk.
#[derive(Debug, Clone, Copy)]
struct Leg {
    from: Place,
    /// On the piece of `from`.
    to: Place,
    jerk: f64,
    /// Time at its end [s].
    time: f64,
    /// The pieces whose motion is averaged in it, first and last.
    sources: (usize, usize),
}

/// Goes along the average, leg by leg.
struct Walk<'a> {
    phases: &'a [Phase],
    curve: &'a Curve,
    window: f64,
    /// Index of the phase now, and of that a window ago, one more: 0 is the rest before the start.
    now: usize,
    before: usize,
    time: f64,
    here: Place,
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
            // Into the next piece before that.
            let part = crossing(&from, jerk, step, length);
            to = moved(&from, jerk, part);
            to.at = length;
            self.time += part;
            self.here = Place { piece: from.piece + 1, at: 0.0, ..to };
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

/// A place some time later, at constant jerk.
fn moved(from: &Place, jerk: f64, t: f64) -> Place {
    Place {
        piece: from.piece,
        at: from.at + t * (from.v + t * (0.5 * from.a + t * jerk / 6.0)),
        v: from.v + t * (from.a + 0.5 * t * jerk),
        a: from.a + t * jerk,
    }
}

/// When a motion comes to `at`, which it does before `most`.
fn crossing(from: &Place, jerk: f64, most: f64, at: f64) -> f64 {
    let (mut low, mut high, mut t) = (0.0, most, most);
    for _ in 0..60 {
        let place = moved(from, jerk, t);
        let over = place.at - at;
        if over > 0.0 {
            high = t;
        } else {
            low = t;
        }
        if over.abs() <= 1e-15 || high - low <= 1e-15 {
            break;
        }
        let newton = t - over / place.v;
        t = if newton > low && newton < high { newton } else { 0.5 * (low + high) };
    }
    t
}

/// What a motion along a curve uses of the limits.
struct Gauge<'a> {
    curve: &'a Curve,
    /// One over each limit.
    inverse: Vec<JointBound>,
    /// On each line, the largest part of each limit that a parameter's speed, acceleration and jerk of 1 takes.
    lines: Vec<[f64; 3]>,
}

impl<'a> Gauge<'a> {
    fn new(curve: &'a Curve, bounds: &[JointBound]) -> Self {
        let over = |b: &JointBound| JointBound {
            velocity: 1.0 / b.velocity,
            acceleration: 1.0 / b.acceleration,
            jerk: 1.0 / b.jerk,
        };
        let inverse: Vec<JointBound> = bounds.iter().map(over).collect();
        let line = |piece: &Piece| {
            let most = |limit: fn(&JointBound) -> f64| {
                piece.direction.iter().zip(&inverse).map(|(d, i)| d.abs() * limit(i)).fold(0.0, f64::max)
            };
            [most(|i| i.velocity), most(|i| i.acceleration), most(|i| i.jerk)]
        };
        let lines = curve.iter().map(line).collect();
        Self { curve, inverse, lines }
    }

    /// By which factor a leg must be slower to keep the limits.
    fn slower(&self, leg: &Leg) -> f64 {
        let piece = &self.curve[leg.from.piece];
        let mut most = [0.0_f64; 3];
        let mut see = |used: [f64; 3]| most.iter_mut().zip(used).for_each(|(m, u)| *m = if u > *m { u } else { *m });
        for place in [&leg.from, &leg.to] {
            let (v, a, j) = (place.v, place.a, leg.jerk);
            if !piece.bends {
                let [velocity, acceleration, jerk] = self.lines[leg.from.piece];
                see([velocity * v, acceleration * a.abs(), jerk * j.abs()]);
                continue;
            }
            let t = piece.turned(place.at);
            let (curved, changed) = (t.d1 * v * v, v * (3.0 * t.d1 * a + t.d2 * v * v));
            for ((direction, turn), inverse) in piece.direction.iter().zip(&piece.turn).zip(&self.inverse) {
                let d1 = direction + turn * t.part;
                see([
                    (d1 * v).abs() * inverse.velocity,
                    (d1 * a + turn * curved).abs() * inverse.acceleration,
                    (d1 * j + turn * changed).abs() * inverse.jerk,
                ]);
            }
        }
        let [velocity, acceleration, jerk] = most;
        Excess { velocity, acceleration, jerk }.slower()
    }
}

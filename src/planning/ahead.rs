//! What is in the way of a motion under way, in a world that has changed since it was planned, and where the motion
//! comes to rest when it is cancelled.

use super::leaving::passes;
use super::path::between;
use super::setup::Setup;
use super::solve::{Failure, Found, stage};
use crate::collision::report::Contact;
use crate::collision::world::World;
use crate::collision::{CollisionChecker, Stop};
use crate::trajectory::{Cursor, Sample, Spline};

/// Length of the pieces of the motion that are looked at [s]: between their ends it hardly leaves the straight line.
const PIECE: f64 = 0.02;
/// A stretch this close to the line between its ends is straight [rad].
const STRAIGHT: f64 = 5e-5;
/// Looks for the contact on a piece that is not free.
const LOOKS: u32 = 32;
/// How long a cancel may take to reach the tick, with two ticks more: as much later the motion slows down [s].
const DELAY: f64 = 0.03;
/// Slowest joint that counts when the motion slows down [rad/s], as the trajectory task has it.
const SLOWEST: f64 = 1e-3;
/// Part of the acceleration limit that slowing down may always use, as the trajectory task has it.
const LEAST: f64 = 0.1;

/// What is in the way of a motion.
#[derive(Debug, Clone, PartialEq)]
pub struct Blocked {
    /// Up to here it keeps its distance [s since the motion's start].
    pub free_until: f64,
    /// What is in the way, with names and distances.
    pub what: String,
}

/// Looks at the rest of a motion, from `elapsed` [s] on, in the world as it is now, with all robots where they are now
/// [rad]. `None`: nothing is in the way. An error: that was not found out, or not in time.
pub fn look_ahead(
    setup: &Setup,
    world: &World,
    found: &Found,
    positions: &[Vec<f64>],
    elapsed: f64,
    stop: &Stop,
) -> Result<Option<Blocked>, Failure> {
    let spline = Spline::new(&found.trajectory).map_err(|e| Failure::new(e.to_string()))?;
    let mut stage = stage(setup, world, &found.robots, positions, setup.padding)?;
    let checker = &mut stage.checker;
    checker.give_up_again(&found.given_up);
    let way = samples(&spline, elapsed);
    let last = way.len() - 1;
    // Stretches that are not looked at yet, the earliest last. One that is not straight or not free is cut in two.
    let mut stretches = vec![(0, last)];
    while let Some((first, end)) = stretches.pop() {
        let ((time, from), (_, to)) = (&way[first], &way[end]);
        if is_straight(&way[first..=end]) && passes(checker, found.leaving.as_ref(), from, to, stop) {
            continue;
        }
        if stop.is_over() {
            return Err(Failure::new("whether its way is still free was not found out in time"));
        }
        if end - first > 1 {
            let middle = first + (end - first) / 2;
            stretches.extend([(middle, end), (first, middle)]);
            continue;
        }
        let mut q = from.clone();
        let contact = (0..=LOOKS).find_map(|k| {
            between(from, to, f64::from(k) / f64::from(LOOKS), &mut q);
            checker.contacts(&q).into_iter().next()
        });
        let what = contact.map_or_else(|| "its way is no longer free".to_owned(), |c| in_the_way(&c, setup.padding));
        return Ok(Some(Blocked { free_until: *time, what }));
    }
    Ok(None)
}

/// Where a motion is at times from `elapsed` to its end [s, rad].
fn samples(spline: &Spline, elapsed: f64) -> Vec<(f64, Vec<f64>)> {
    let mut cursor = Cursor::default();
    let mut samples = vec![Sample::default(); spline.joints()];
    let duration = spline.duration();
    let begin = elapsed.clamp(0.0, duration);
    let pieces = ((duration - begin) / PIECE).ceil().max(1.0) as usize;
    let mut at = |k: usize| {
        let time = begin + (duration - begin) * k as f64 / pieces as f64;
        spline.sample(time, &mut cursor, &mut samples);
        (time, samples.iter().map(|sample| sample.position).collect())
    };
    (0..=pieces).map(&mut at).collect()
}

/// Whether a stretch of a motion is a straight line from its first to its last configuration.
fn is_straight(way: &[(f64, Vec<f64>)]) -> bool {
    let (Some((_, a)), Some((_, b))) = (way.first(), way.last()) else { return true };
    let along: Vec<f64> = a.iter().zip(b).map(|(a, b)| b - a).collect();
    let square: f64 = along.iter().map(|d| d * d).sum();
    way.iter().all(|(_, q)| {
        let dot: f64 = q.iter().zip(a).zip(&along).map(|((q, a), d)| (q - a) * d).sum();
        let part = if square > 0.0 { (dot / square).clamp(0.0, 1.0) } else { 0.0 };
        let off = q.iter().zip(a).zip(&along).map(|((q, a), d)| (q - a - d * part).powi(2)).sum::<f64>();
        way.len() <= 2 || off <= STRAIGHT * STRAIGHT
    })
}

/// A contact in words; where nothing touches yet, with the distance that is kept.
pub(super) fn in_the_way(contact: &Contact, padding: f64) -> String {
    let kept = format!(", closer than the padding of {:.1} mm", padding * 1e3);
    format!("{contact}{}", if contact.distance > 0.0 { kept } else { String::new() })
}

/// Whether a motion that is cancelled now, at `elapsed` [s], rests before `free_until` [s], with what a request needs to
/// reach the tick. The other parameters are those of [`rest_after_cancel`].
pub fn rests_before(free_until: f64, spline: &Spline, acceleration: &[f64], elapsed: f64, dt: f64) -> bool {
    rest_after_cancel(spline, acceleration, elapsed + DELAY + 2.0 * dt, dt) <= free_until
}

/// When a motion that is cancelled at `elapsed` [s] is at rest, in its own time [s]: it slows down along its path as
/// the trajectory task does in ticks of `dt` [s]. `acceleration`: the limits of its joints [rad/s²].
pub fn rest_after_cancel(spline: &Spline, acceleration: &[f64], elapsed: f64, dt: f64) -> f64 {
    let mut cursor = Cursor::default();
    let mut samples = vec![Sample::default(); acceleration.len()];
    let (mut elapsed, mut rate) = (elapsed, 1.0);
    while rate > 0.0 && elapsed < spline.duration() {
        elapsed += dt * rate;
        spline.sample(elapsed, &mut cursor, &mut samples);
        let slowdown = |(limit, s): (&f64, &Sample)| {
            let spare = (limit - s.acceleration.abs() * rate * rate).max(LEAST * limit);
            spare / s.velocity.abs().max(SLOWEST)
        };
        let steepest = acceleration.iter().zip(&samples).map(slowdown).fold(f64::MAX, f64::min);
        rate -= dt * steepest.max(f64::MIN_POSITIVE);
    }
    elapsed
}

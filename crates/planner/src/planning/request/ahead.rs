//! Checks the rest of a running motion against a world that has changed since it was planned, and predicts where the
//! motion stops after a cancel.

use super::pipeline::{PlanFailure, PlannedMotion, stage};
use super::settings::LookAheadSettings;
use super::start_contact::passes;
use crate::collision::clearance::Motion;
use crate::collision::report::Contact;
use crate::collision::world::World;
use crate::collision::{CollisionChecker, Stop};
use crate::planning::scene::planning_scene::PlanningScene;
use crate::planning::search::path::between;
use crate::planning::search::path_planner::digits_outside;
use dimos_core::trajectory::{Cursor, Sample, Spline};

/// Delay of a cancel on its way to the tick, besides two ticks: deceleration begins this much later [s].
const DELAY: f64 = 0.03;
/// Slowest joint that counts during deceleration [rad/s]; same value as in the trajectory task.
const SLOWEST: f64 = 1e-3;
/// Part of the acceleration limit that deceleration may always use; same value as in the trajectory task.
const LEAST: f64 = 0.1;

/// Where a running motion is blocked.
#[derive(Debug, Clone, PartialEq)]
pub struct Blocked {
    /// The motion keeps its distance until here [s since its start].
    pub free_until: f64,
    /// Contact that blocks it: names and distance.
    pub what: String,
}

/// Checks the rest of a motion, from `elapsed` [s] on, against the current world and the current positions of all
/// robots [rad]. Returns `None` if it is free, and an error if the check failed or ran out of time.
pub fn look_ahead(
    setup: &PlanningScene,
    world: &World,
    found: &PlannedMotion,
    positions: &[Vec<f64>],
    elapsed: f64,
    stop: &Stop,
) -> Result<Option<Blocked>, PlanFailure> {
    let spline = Spline::new(&found.trajectory).map_err(|e| PlanFailure::new(e.to_string()))?;
    let mut stage = stage(setup, world, &found.robots, positions, found.padding, &found.touch)?;
    let checker = &mut stage.checker;
    checker.relax_again(&found.exceptions);
    let settings = &setup.settings.look_ahead;
    let way = samples(&spline, elapsed, settings.slice);
    // Slices still to check, the earliest last. A slice that is blocked is split in two.
    let mut stretches = straight_slices(&way, settings.straight);
    while let Some((first, end)) = stretches.pop() {
        let ((time, from), (_, to)) = (&way[first], &way[end]);
        if passes(checker, found.level, found.escape_path.as_ref(), (from, to), stop) {
            continue;
        }
        if stop.is_over() {
            return Err(PlanFailure::new("no time left to check the rest of the motion"));
        }
        if end - first > 1 {
            let middle = first + (end - first) / 2;
            stretches.extend([(middle, end), (first, middle)]);
            continue;
        }
        let mut q = from.clone();
        let contact = (0..=settings.samples).find_map(|k| {
            between(from, to, f64::from(k) / f64::from(settings.samples), &mut q);
            checker.contacts(&q).into_iter().next()
        });
        let what = contact
            .map_or_else(|| "the rest of the motion is blocked".to_owned(), |c| describe_contact(&c, found.padding));
        return Ok(Some(Blocked { free_until: *time, what }));
    }
    Ok(None)
}

/// Returns a motion as straight pieces, as long as possible.
pub(in crate::planning) fn straight_motions(spline: &Spline, settings: &LookAheadSettings) -> Vec<Motion> {
    let way = samples(spline, 0.0, settings.slice);
    straight_slices(&way, settings.straight)
        .into_iter()
        .map(|(first, end)| [way[first].1.clone(), way[end].1.clone()])
        .collect()
}

/// Samples a motion from `elapsed` to its end, every `slice` [s, rad].
fn samples(spline: &Spline, elapsed: f64, slice: f64) -> Vec<(f64, Vec<f64>)> {
    let mut cursor = Cursor::default();
    let mut samples = vec![Sample::default(); spline.joints()];
    let duration = spline.duration();
    let begin = elapsed.clamp(0.0, duration);
    let pieces = ((duration - begin) / slice).ceil().max(1.0) as usize;
    let mut at = |k: usize| {
        let time = begin + (duration - begin) * k as f64 / pieces as f64;
        spline.sample(time, &mut cursor, &mut samples);
        (time, samples.iter().map(|sample| sample.position).collect())
    };
    (0..=pieces).map(&mut at).collect()
}

/// Divides a motion into slices that are straight within `deviation` [rad], as long as possible: index of the first and
/// last sample of each, the last slice first.
fn straight_slices(way: &[(f64, Vec<f64>)], deviation: f64) -> Vec<(usize, usize)> {
    let last = way.len() - 1;
    let (mut slices, mut first) = (Vec::new(), 0);
    while first < last {
        let (mut end, mut step) = (first + 1, 1);
        while step > 0 {
            if end + step <= last && is_straight(&way[first..=end + step], deviation) {
                end += step;
                step *= 2;
            } else {
                step /= 2;
            }
        }
        slices.push((first, end));
        first = end;
    }
    slices.reverse();
    slices
}

/// Returns whether a slice of a motion is a straight line between its first and its last configuration.
fn is_straight(way: &[(f64, Vec<f64>)], deviation: f64) -> bool {
    let (Some((_, a)), Some((_, b))) = (way.first(), way.last()) else { return true };
    let along: Vec<f64> = a.iter().zip(b).map(|(a, b)| b - a).collect();
    let square: f64 = along.iter().map(|d| d * d).sum();
    way.iter().all(|(_, q)| {
        let dot: f64 = q.iter().zip(a).zip(&along).map(|((q, a), d)| (q - a) * d).sum();
        let part = if square > 0.0 { (dot / square).clamp(0.0, 1.0) } else { 0.0 };
        let off = q.iter().zip(a).zip(&along).map(|((q, a), d)| (q - a - d * part).powi(2)).sum::<f64>();
        way.len() <= 2 || off <= deviation * deviation
    })
}

/// Describes a contact; if nothing touches, adds the padding that is violated.
pub(in crate::planning) fn describe_contact(contact: &Contact, padding: f64) -> String {
    if contact.distance <= 0.0 {
        return contact.to_string();
    }
    let digits = digits_outside(contact.distance, padding, f64::INFINITY);
    format!("{contact:.digits$}, closer than the padding of {padding:.digits$} m")
}

/// Returns whether a motion cancelled at `elapsed` [s] stops before `free_until` [s], including the delay of
/// the request. The other parameters are those of [`rest_after_cancel`].
pub fn rests_before(free_until: f64, spline: &Spline, acceleration: &[f64], elapsed: f64, dt: f64) -> bool {
    rest_after_cancel(spline, acceleration, elapsed + DELAY + 2.0 * dt, dt) <= free_until
}

/// Returns when a motion cancelled at `elapsed` [s] is at rest, in the motion's own time [s]. It decelerates along
/// its path as the trajectory task does, in ticks of `dt` [s]; `acceleration` holds the limits of its joints [rad/s²].
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

#[cfg(test)]
mod tests {
    use glamx::DVec3;

    use super::*;
    use crate::collision::report::{Measured, Pair};

    #[test]
    fn a_distance_that_is_hardly_too_small_does_not_look_like_the_padding() {
        let contact = |distance: f64| Contact {
            pair: Pair::Obstacle(0, 0),
            link: "tip".into(),
            other: "post".into(),
            distance,
            on_link: DVec3::ZERO,
            on_other: DVec3::ZERO,
            by: Measured::Shapes,
        };
        for (distance, text) in [
            (0.002, "link \"tip\" is 0.0020 m from obstacle \"post\", closer than the padding of 0.0030 m"),
            (0.002_996, "link \"tip\" is 0.002996 m from obstacle \"post\", closer than the padding of 0.003000 m"),
            (-0.002, "link \"tip\" is 0.0020 m deep in obstacle \"post\""),
        ] {
            assert_eq!(describe_contact(&contact(distance), 0.003), text);
        }
    }
}

//! When a motion passes the waypoints of its request.

use super::legs::Leg;
use dimos_core::trajectory::{Cursor, JointTrajectory, Sample, Spline};

/// Step of the search [s], and its largest number.
const PASS_STEP: f64 = 0.002;
const MAX_PASS_STEPS: f64 = 20_000.0;
/// Two passes of a place that are equally near within this are the same place [rad].
const AS_NEAR: f64 = 1e-3;

/// Returns when a motion is nearest to the ends of its legs but the last [s], in their order.
pub(in crate::planning) fn times_at_waypoints(trajectory: &JointTrajectory, legs: &[Leg]) -> Vec<f64> {
    let Ok(spline) = Spline::new(trajectory) else { return Vec::new() };
    let (mut cursor, mut samples) = (Cursor::default(), vec![Sample::default(); spline.joints()]);
    let step = PASS_STEP.max(spline.duration() / MAX_PASS_STEPS);
    let mut from = 0.0;
    let mut pass = |leg: &Leg| {
        let end = leg.path.last()?;
        let mut apart = |time: f64| {
            spline.sample(time, &mut cursor, &mut samples);
            samples.iter().zip(end).map(|(sample, q)| (sample.position - q).powi(2)).sum::<f64>().sqrt()
        };
        let steps = ((spline.duration() - from) / step).ceil() as usize;
        let all: Vec<f64> = (0..=steps).map(|k| apart(from + step * k as f64)).collect();
        let least = all.iter().copied().fold(f64::INFINITY, f64::min);
        // A path may come there once more: the first time counts.
        let near = all.iter().position(|distance| *distance <= least + AS_NEAR)?;
        let beyond = all.iter().skip(near).position(|distance| *distance > least + AS_NEAR);
        let until = beyond.map_or(all.len(), |count| near + count);
        let first = all.get(near..until)?.iter().enumerate().min_by(|a, b| a.1.total_cmp(b.1))?.0;
        from = (from + step * (near + first) as f64).min(spline.duration());
        Some(from)
    };
    legs.split_last().map_or(&[][..], |(_, before)| before).iter().filter_map(&mut pass).collect()
}

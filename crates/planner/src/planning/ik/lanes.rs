//! Attempts in lanes: sixteen at a time towards one pose.

use dimos_kernels::Width;
use dimos_kernels::block::{LANES, Lanes};
use dimos_kernels::chain::{Chain, Frame};
use dimos_kernels::ik::{Solver, Until, lane};
use glamx::DAffine3;

use super::settings::IkSettings;
use super::{Ik, PoseError, settings_met};
use crate::collision::allowed_pairs::sample;
use crate::planning::search::path::distance;
use dimos_robot::kinematics::Kinematics;
use dimos_robot::random::Random;

/// The latest attempts, and what makes them.
#[derive(Debug, Clone)]
pub(super) struct Attempts {
    solver: Solver,
    q: Vec<Lanes>,
}

impl Attempts {
    /// Prepares attempts for a link; `None` if no joint moves it.
    pub(super) fn new(kinematics: &Kinematics, link: usize) -> Option<Self> {
        let (joints, offset) = kinematics.chain(link);
        let chain = Chain::new(&joints, &columns(&offset))?;
        let limits: Vec<(f64, f64)> = kinematics.limits().iter().map(|l| (l.lower, l.upper)).collect();
        Some(Self { solver: Solver::new(chain, &limits, Width::widest()), q: vec![Lanes::splat(0.0); limits.len()] })
    }
}

impl Ik<'_> {
    /// Makes sixteen attempts from random configurations, the first from `near` if `from_seed`; adds those that reach
    /// the pose to `reached`, nearest first. Returns the same as [`Self::attempt_from`].
    pub(super) fn attempt(
        &mut self,
        target: &DAffine3,
        near: &[f64],
        settings: &IkSettings,
        from_seed: bool,
        random: &mut Random,
        reached: &mut Vec<Vec<f64>>,
    ) -> PoseError {
        let until = if settings.solutions > 1 { Until::All } else { Until::First };
        let limits = self.kinematics.limits();
        let error = self.attempt_from(target, near, settings, until, reached, |lane, v| match lane {
            0 if from_seed => near[v],
            _ => sample(limits[v].lower, limits[v].upper, random),
        });
        reached.sort_by(|a, b| distance(near, a).total_cmp(&distance(near, b)));
        error
    }

    /// Makes attempts from `start` (of a lane and a variable), within the limits; adds those that reach the pose. If
    /// none does, returns the error of the closest, and leaves its configuration in `q`.
    pub(super) fn attempt_from(
        &mut self,
        target: &DAffine3,
        near: &[f64],
        settings: &IkSettings,
        until: Until,
        reached: &mut Vec<Vec<f64>>,
        mut start: impl FnMut(usize, usize) -> f64,
    ) -> PoseError {
        let arrived = match &mut self.lanes {
            None => 1,
            Some(attempts) => {
                for (values, near) in attempts.q.iter_mut().zip(near) {
                    *values = Lanes::splat(*near as f32);
                }
                for &v in attempts.solver.chain().variables() {
                    let limits = &self.kinematics.limits()[v];
                    for lane in 0..LANES {
                        attempts.q[v].0[lane] = start(lane, v).max(limits.lower).min(limits.upper) as f32;
                    }
                }
                let steps = settings.steps;
                attempts.solver.descend(&columns(target), !settings.position_only, &mut attempts.q, steps, until)
            }
        };
        let lanes = (0..LANES).filter(|lane| arrived >> lane & 1 == 1);
        // Near a singularity single precision may not get there.
        let lanes = lanes.chain((arrived == 0).then(|| self.closest_lane(target, near, settings)));
        let mut error = PoseError { linear: glamx::DVec3::ZERO, angular: glamx::DVec3::ZERO };
        for lane in lanes {
            self.take(lane, near);
            error = self.reach(target, near, settings);
            if settings_met(&error, settings) {
                reached.push(self.q.clone());
            }
        }
        error
    }

    /// Copies a lane into `q`. A joint that does not move the link keeps its exact position of `near`.
    fn take(&mut self, number: usize, near: &[f64]) {
        self.q.clear();
        self.q.extend_from_slice(near);
        let Some(attempts) = &self.lanes else { return };
        for &v in attempts.solver.chain().variables() {
            let limits = &self.kinematics.limits()[v];
            let at = lane(&attempts.q[v..=v], number).next().unwrap_or(near[v]);
            self.q[v] = at.max(limits.lower).min(limits.upper);
        }
    }

    /// Returns the lane that came closest.
    fn closest_lane(&mut self, target: &DAffine3, near: &[f64], settings: &IkSettings) -> usize {
        let mut best = (f64::INFINITY, 0);
        for lane in 0..LANES {
            self.take(lane, near);
            let error = self.error(target, settings).squared();
            if error < best.0 {
                best = (error, lane);
            }
        }
        best.1
    }
}

/// Converts a frame.
pub(super) fn columns(frame: &DAffine3) -> Frame {
    Frame { rotation: frame.matrix3.to_cols_array_2d(), translation: frame.translation.to_array() }
}

#[cfg(test)]
mod tests;

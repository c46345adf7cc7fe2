//! The solution closest to a seed. The plain search returns whatever branch its random starts find; here it also starts
//! around the seed, and each solution of a redundant arm moves towards the seed while its link stays at the pose.

use dimos_kernels::block::LANES;
use dimos_kernels::ik::Until;
use glamx::DAffine3;

use super::settings::{ClosestSettings, IkSettings};
use super::{Ik, IkFailure, settings_met};
use crate::collision::checker::Stop;
use crate::planning::search::path::distance;
use dimos_robot::kinematics::jacobian::{cholesky, gram, solve as solve_gram};
use dimos_robot::random::Random;

/// Starts per standard deviation: two of them fill the lanes.
const STARTS: usize = LANES / 2;

impl Ik<'_> {
    /// Same as [`Ik::solve`], but searches for the closest solution to `near` in a bounded number of attempts: for six
    /// joints all branches are usually found, for more the closest point of each branch. Takes up to eight times as
    /// long.
    pub fn closest(
        &mut self,
        target: &DAffine3,
        near: &[f64],
        settings: &IkSettings,
        mut valid: impl FnMut(&[f64]) -> bool,
        stop: &Stop,
    ) -> Result<Vec<Vec<f64>>, IkFailure> {
        let plain = self.solve(target, near, settings, &mut valid, stop);
        let mut found = plain.as_ref().cloned().unwrap_or_default();
        let mut random = Random::new(settings.seed ^ 0x5EED);
        let ClosestSettings { spreads, same, same_branch, .. } = settings.closest;
        for spreads in spreads.chunks(LANES / STARTS) {
            if stop.is_over() {
                break;
            }
            self.attempt_around(target, near, settings, spreads, &mut random, &mut found);
        }
        for q in &mut found {
            let moved = self.approach(target, near, q, settings);
            if valid(&moved) {
                *q = moved;
            }
        }
        found.retain(|q| valid(q));
        found.sort_by(|a, b| distance(near, a).total_cmp(&distance(near, b)));
        let task = if settings.position_only { 3 } else { 6 };
        let same = if near.len() > task { same_branch } else { same };
        let mut apart: Vec<Vec<f64>> = Vec::new();
        for q in found {
            if !apart.iter().any(|other| distance(other, &q) < same) {
                apart.push(q);
            }
        }
        if apart.is_empty() { plain } else { Ok(apart) }
    }

    /// Makes one attempt per lane from configurations around a seed, as many per standard deviation [rad or m].
    fn attempt_around(
        &mut self,
        target: &DAffine3,
        near: &[f64],
        settings: &IkSettings,
        spreads: &[f64],
        random: &mut Random,
        reached: &mut Vec<Vec<f64>>,
    ) {
        let limits = self.kinematics.limits();
        self.attempt_from(target, near, settings, Until::All, reached, |lane, v| {
            // The sum of three has a standard deviation of one, and no tails.
            let away: f64 = (0..3).map(|_| random.between(-1.0, 1.0)).sum();
            let spread = spreads.get(lane / STARTS).map_or(0.0, |s| s.min(0.5 * (limits[v].upper - limits[v].lower)));
            near[v] + spread * away
        });
    }

    /// Returns the configuration reached from a solution by moving towards `near` with the link at its pose.
    fn approach(&mut self, target: &DAffine3, near: &[f64], from: &[f64], settings: &IkSettings) -> Vec<f64> {
        let ClosestSettings { steps, max_step, min_part, min_motion, .. } = settings.closest;
        let (mut best, mut part) = (from.to_vec(), 1.0);
        for _ in 0..steps {
            self.q.clone_from(&best);
            self.error(target, settings);
            let longest = self.free_motion(near, settings);
            if longest < min_motion {
                break;
            }
            let scale = part * (max_step / longest).min(1.0);
            for ((q, m), l) in self.q.iter_mut().zip(&self.motion).zip(self.kinematics.limits()) {
                *q = (*q + m * scale).max(l.lower).min(l.upper);
            }
            let error = self.descend(target, settings);
            if settings_met(&error, settings) && distance(near, &self.q) < distance(near, &best) - min_motion {
                best.clone_from(&self.q);
                part = f64::min(1.0, 2.0 * part);
            } else {
                part *= 0.5;
                if part < min_part {
                    break;
                }
            }
        }
        best
    }

    /// Computes, into `motion`, the part of the way from `q` to `near` that does not move the link and does not push a
    /// joint beyond its limit; frames must be those of `q`. Returns the motion of the joint that moves most.
    fn free_motion(&mut self, near: &[f64], settings: &IkSettings) -> f64 {
        let mut blocked = vec![false; self.q.len()];
        loop {
            self.kinematics.jacobian(self.link, &self.frames, &mut self.columns);
            let mut moves = [0.0; 6];
            for (j, column) in self.columns.iter_mut().enumerate() {
                if settings.position_only {
                    column[3..].fill(0.0);
                }
                let towards = if blocked[j] { 0.0 } else { near[j] - self.q[j] };
                if blocked[j] {
                    column.fill(0.0);
                }
                self.motion[j] = towards;
                moves.iter_mut().zip(column.iter()).for_each(|(m, c)| *m += c * towards);
            }
            let Some(l) = cholesky(&gram(&self.columns, 1e-9)) else { return 0.0 };
            let x = solve_gram(&l, &moves);
            for (motion, column) in self.motion.iter_mut().zip(&self.columns) {
                *motion -= column.iter().zip(&x).map(|(c, x)| c * x).sum::<f64>();
            }
            let limits = self.kinematics.limits();
            let pushes = |j: usize| {
                let (q, m, l) = (self.q[j], self.motion[j], limits[j]);
                (m > 0.0 && q >= l.upper - 1e-9) || (m < 0.0 && q <= l.lower + 1e-9)
            };
            let Some(next) = (0..blocked.len()).find(|j| !blocked[*j] && pushes(*j)) else {
                return self.motion.iter().fold(0.0, |most: f64, m| most.max(m.abs()));
            };
            blocked[next] = true;
        }
    }
}

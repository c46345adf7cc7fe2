//! Inverse kinematics: joint positions for a pose of a link. Damped least squares from a seed and from random
//! configurations, sixteen at a time in single precision; those that arrive take the last steps in double precision.
//! Every returned configuration reaches the pose within the tolerances, is inside the limits, and passes the caller's
//! test; otherwise the failure says what is missing.

pub mod cartesian;
pub mod reach;
pub mod settings;

mod closest;
mod lanes;

use dimos_kernels::block::LANES;
use glamx::{DAffine3, DVec3};

use crate::collision::checker::Stop;
use dimos_robot::kinematics::Kinematics;
use dimos_robot::kinematics::jacobian::{Column, cholesky, gram, solve as solve_gram};
use dimos_robot::kinematics::step::rotation_between;
use dimos_robot::random::Random;

use self::settings::{DescentSettings, IkSettings};
use crate::planning::search::path::distance;

/// Why no solution was found.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{}", self.message())]
pub struct IkFailure {
    /// Position error of the best attempt [m].
    pub position: f64,
    /// Orientation error of the best attempt [rad].
    pub rotation: f64,
    /// Configuration of the best attempt.
    pub best: Vec<f64>,
    /// The joint limit that kept it from coming closer: index and name.
    pub limit: Option<(usize, String)>,
    /// Solutions that the caller rejected.
    pub rejected: usize,
    /// Attempts made.
    pub attempts: usize,
    /// Whether it was stopped before all attempts were made.
    pub stopped: bool,
}

impl IkFailure {
    fn message(&self) -> String {
        let n = self.attempts;
        if self.rejected > 0 {
            return format!("all {} configurations that reach the pose collide ({n} attempts)", self.rejected);
        }
        let missing = format!("{:.4} m and {:.2}°", self.position, self.rotation.to_degrees());
        let limit = self.limit.as_ref().map(|(_, joint)| format!("; limited by joint {joint:?}"));
        let stopped = if self.stopped { ", stopped early" } else { "" };
        format!(
            "no IK solution after {n} attempts: the closest pose is {missing} away{stopped}{}",
            limit.unwrap_or_default()
        )
    }
}

/// Solver for poses of one link; reuses its buffers.
#[derive(Debug, Clone)]
pub struct Ik<'a> {
    kinematics: &'a Kinematics,
    link: usize,
    frames: Vec<DAffine3>,
    columns: Vec<Column>,
    q: Vec<f64>,
    motion: Vec<f64>,
    /// `None` if no joint moves the link.
    lanes: Option<lanes::Attempts>,
}

/// Distance of a configuration from a pose.
#[derive(Debug, Clone, Copy)]
struct PoseError {
    linear: DVec3,
    angular: DVec3,
}

impl PoseError {
    fn squared(&self) -> f64 {
        self.linear.length_squared() + self.angular.length_squared()
    }
}

impl<'a> Ik<'a> {
    /// Creates a solver for a link (index in the model).
    pub fn new(kinematics: &'a Kinematics, link: usize) -> Self {
        let n = kinematics.dof();
        let (frames, columns) = (kinematics.frames(), vec![[0.0; 6]; n]);
        let lanes = lanes::Attempts::new(kinematics, link);
        Self { kinematics, link, frames, columns, q: vec![0.0; n], motion: vec![0.0; n], lanes }
    }

    /// Returns configurations in which the link is at `target` (in the root's frame), the nearest to `near` first;
    /// skips those that are not `valid`. The same settings give the same solutions.
    pub fn solve(
        &mut self,
        target: &DAffine3,
        near: &[f64],
        settings: &IkSettings,
        mut valid: impl FnMut(&[f64]) -> bool,
        stop: &Stop,
    ) -> Result<Vec<Vec<f64>>, IkFailure> {
        let mut random = Random::new(settings.seed);
        let mut found: Vec<Vec<f64>> = Vec::new();
        let mut failure = IkFailure {
            position: f64::INFINITY,
            rotation: f64::INFINITY,
            best: near.to_vec(),
            limit: None,
            rejected: 0,
            attempts: 0,
            stopped: false,
        };
        let wanted = settings.solutions.max(1);
        let (mut best, mut reached) = (f64::INFINITY, Vec::new());
        loop {
            let out_of_reach = found.is_empty() && failure.rejected == 0;
            let most = if out_of_reach { settings.attempts.max(1) } else { settings.attempts / 16 };
            if found.len() >= wanted || failure.attempts >= most {
                break;
            }
            if failure.attempts > 0 && stop.is_over() {
                failure.stopped = true;
                break;
            }
            let from_seed = failure.attempts == 0;
            let error = self.attempt(target, near, settings, from_seed, &mut random, &mut reached);
            failure.attempts += LANES;
            if reached.is_empty() && error.squared() < best {
                best = error.squared();
                (failure.position, failure.rotation) = (error.linear.length(), error.angular.length());
                failure.best.clone_from(&self.q);
            }
            for q in reached.drain(..) {
                let new = found.len() < wanted && !found.iter().any(|other| distance(other, &q) < settings.same);
                if new && valid(&q) {
                    found.push(q);
                } else if new {
                    failure.rejected += 1;
                }
            }
        }
        if found.is_empty() {
            failure.limit = self.limiting_joint(target, &failure.best, settings);
            return Err(failure);
        }
        found.sort_by(|a, b| distance(near, a).total_cmp(&distance(near, b)));
        Ok(found)
    }

    /// Makes one attempt from a configuration near a solution; `None` if it does not converge.
    pub fn follow(&mut self, target: &DAffine3, from: &[f64], settings: &IkSettings) -> Option<Vec<f64>> {
        self.q.clear();
        self.q.extend_from_slice(from);
        let error = self.descend(target, settings);
        settings_met(&error, settings).then(|| self.q.clone())
    }

    /// Returns the link's pose at a configuration.
    pub fn pose(&mut self, q: &[f64]) -> DAffine3 {
        self.kinematics.forward(q, &mut self.frames);
        self.kinematics.link_frame(self.link, &self.frames)
    }

    /// Returns the joint at its limit that would have to exceed it most to come closer to a pose.
    pub fn limiting_joint(&mut self, target: &DAffine3, q: &[f64], settings: &IkSettings) -> Option<(usize, String)> {
        self.q.clear();
        self.q.extend_from_slice(q);
        let error = self.error(target, settings);
        self.aim(&error, 1e-4, settings);
        let limits = self.kinematics.limits();
        let beyond = |j: usize| (q[j] + self.motion[j] - limits[j].upper).max(limits[j].lower - q[j] - self.motion[j]);
        let at_limit = |j: &usize| q[*j] >= limits[*j].upper - 1e-6 || q[*j] <= limits[*j].lower + 1e-6;
        let joints = (0..q.len()).filter(at_limit).filter(|j| beyond(*j) > 0.0);
        joints.max_by(|a, b| beyond(*a).total_cmp(&beyond(*b))).map(|j| (j, self.kinematics.names()[j].clone()))
    }

    fn error(&mut self, target: &DAffine3, settings: &IkSettings) -> PoseError {
        self.kinematics.forward(&self.q, &mut self.frames);
        let at = self.kinematics.link_frame(self.link, &self.frames);
        let angular = if settings.position_only { DVec3::ZERO } else { rotation_between(&at.matrix3, &target.matrix3) };
        PoseError { linear: target.translation - at.translation, angular }
    }

    /// Computes the damped step towards a pose, into `motion`; frames must be those of `q`.
    fn aim(&mut self, error: &PoseError, damping: f64, settings: &IkSettings) {
        self.kinematics.jacobian(self.link, &self.frames, &mut self.columns);
        if settings.position_only {
            self.columns.iter_mut().for_each(|c| c[3..].fill(0.0));
        }
        let (l, a) = (error.linear, error.angular);
        let x = cholesky(&gram(&self.columns, damping)).map(|c| solve_gram(&c, &[l.x, l.y, l.z, a.x, a.y, a.z]));
        for (motion, column) in self.motion.iter_mut().zip(&self.columns) {
            *motion = x.map_or(0.0, |x| column.iter().zip(&x).map(|(a, b)| a * b).sum());
        }
    }

    /// Descends from `q`; a solution is shifted by whole turns to the positions nearest to `near`. Returns the
    /// remaining error.
    fn reach(&mut self, target: &DAffine3, near: &[f64], settings: &IkSettings) -> PoseError {
        let error = self.descend(target, settings);
        if settings_met(&error, settings) {
            self.kinematics.unwind(&mut self.q, near, |_| true);
        }
        error
    }

    /// Descends from `q` until the pose is reached or progress ends; returns the remaining error.
    fn descend(&mut self, target: &DAffine3, settings: &IkSettings) -> PoseError {
        let DescentSettings { damping, min_damping, max_step, progress, max_idle } = settings.descent;
        let mut error = self.error(target, settings);
        let (mut best, mut idle) = (error.squared(), 0);
        for _ in 0..settings.steps {
            if settings_met(&error, settings) || idle > max_idle {
                break;
            }
            self.aim(&error, damping * error.squared() + min_damping, settings);
            let longest = self.motion.iter().fold(0.0, |most: f64, m| most.max(m.abs()));
            let scale = if longest > max_step { max_step / longest } else { 1.0 };
            for ((q, m), l) in self.q.iter_mut().zip(&self.motion).zip(self.kinematics.limits()) {
                *q = (*q + m * scale).max(l.lower).min(l.upper);
            }
            error = self.error(target, settings);
            idle = if error.squared() < progress * best { 0 } else { idle + 1 };
            best = best.min(error.squared());
        }
        error
    }
}

fn settings_met(error: &PoseError, settings: &IkSettings) -> bool {
    error.linear.length() <= settings.position && error.angular.length() <= settings.rotation
}

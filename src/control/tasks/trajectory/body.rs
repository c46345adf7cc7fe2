//! Executes a trajectory: commands positions along it, from the arm's position until the arm has arrived.

use super::params::TrajectoryParams;
use crate::clock::Mono;
use crate::control::path_clock::PathClock;
use crate::control::rate::RateLimits;
use crate::control::request::Motion;
use crate::control::task_body::{Claim, Context, OnCancel, Step, Target, TaskBody};
use crate::joint::TICK_STANDSTILL;
use crate::telemetry::{Outcome, Reason, TaskState, TaskView};
use crate::trajectory::{Cursor, Sample, smooth_step};

/// Minimum time for fading out the offset between the last command and the first point [s].
const SHORTEST_FADE: f64 = 0.2;

/// State of a trajectory task.
#[derive(Debug)]
pub struct TrajectoryTask {
    params: TrajectoryParams,
    cursor: Cursor,
    /// Time along the trajectory.
    clock: PathClock,
    slowing: bool,
    /// Whether the arm has begun to follow it.
    begun: bool,
    /// Whether its last point was commanded.
    at_end: bool,
    /// Time since the last point [s].
    settling: f64,
    /// Offset of the last command from the first point, per joint [rad].
    offsets: Vec<f64>,
    fade: f64,
    samples: Vec<Sample>,
    last: TaskView,
}

impl TrajectoryTask {
    /// Creates a task for up to `width` joints.
    pub fn new(params: TrajectoryParams, width: usize) -> Self {
        Self {
            params,
            cursor: Cursor::default(),
            clock: PathClock::default(),
            slowing: false,
            begun: false,
            at_end: false,
            settling: 0.0,
            offsets: Vec::with_capacity(width),
            fade: SHORTEST_FADE,
            samples: Vec::with_capacity(width),
            last: TaskView::default(),
        }
    }

    /// Returns the first joint that is too far from the start, and its offset [rad].
    fn away_from_start(&self, cx: &Context<'_>, motion: &Motion) -> Option<(u16, f64)> {
        motion.joints.iter().enumerate().find_map(|(k, &joint)| {
            let error = cx.joint(joint).position - motion.spline.start(k);
            let away = error.is_nan() || error.abs() > self.params.start_position_tolerance;
            away.then_some((joint, error))
        })
    }

    /// Starts a motion.
    fn start(&mut self, cx: &Context<'_>, motion: &Motion) {
        self.cursor = Cursor::default();
        self.clock.start(cx.speed);
        (self.slowing, self.begun, self.at_end, self.settling) = (false, false, false, 0.0);
        self.samples.clear();
        self.samples.resize(motion.joints.len(), Sample::default());
        self.last = TaskView { motion: motion.id, ..TaskView::default() };
        self.set_out(cx, motion);
    }

    /// Sets the offsets of the last commands from the first point, and the time for fading them out.
    fn set_out(&mut self, cx: &Context<'_>, motion: &Motion) {
        self.fade = SHORTEST_FADE;
        self.offsets.clear();
        for (k, &joint) in motion.joints.iter().enumerate() {
            let view = cx.joint(joint);
            let offset = view.commanded - motion.spline.start(k);
            self.offsets.push(offset);
            // Fading may use a quarter of the joint's velocity and acceleration limits: the peaks of a quintic step are
            // 1.875 offset / T and 5.774 offset / T².
            let by_speed = 1.875 * offset.abs() / (0.25 * view.velocity_limit);
            let by_acceleration = (5.774 * offset.abs() / (0.25 * view.acceleration)).sqrt();
            self.fade = self.fade.max(by_speed).max(by_acceleration);
        }
    }

    fn off_path(&self, cx: &Context<'_>, motion: &Motion) -> Option<Reason> {
        let tolerance = self.params.path_tolerance;
        if tolerance <= 0.0 {
            return None;
        }
        let mut errors = motion.joints.iter().map(|&j| (j, cx.joint(j).tracking_error));
        errors.find(|(_, e)| e.abs() > tolerance).map(|(j, e)| Reason::PathTolerance(j, e))
    }

    /// Returns the first joint that has not arrived, and its error [rad].
    fn away_from_goal(&self, cx: &Context<'_>, motion: &Motion) -> Option<(u16, f64)> {
        motion.joints.iter().zip(&self.samples).find_map(|(&joint, sample)| {
            let view = cx.joint(joint);
            let error = view.position - sample.position;
            let arrived = error.abs() <= self.params.goal_tolerance && view.velocity.abs() <= TICK_STANDSTILL;
            (!arrived).then_some((joint, error))
        })
    }
}

impl TaskBody for TrajectoryTask {
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        let Target::Trajectory(motion) = target else { return Err(Outcome::WrongTask(cx.task)) };
        self.check_start(cx, motion)?;
        self.start(cx, motion);
        Ok(())
    }

    fn check_start(&self, cx: &Context<'_>, motion: &Motion) -> Result<(), Outcome> {
        let away = self.away_from_start(cx, motion);
        away.map_or(Ok(()), |(joint, error)| Err(Outcome::StartStateMismatch(joint, error.abs())))
    }

    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step {
        let Some(motion) = cx.motion else { return Step::Continue };
        let granted = cx.granted;
        if !granted {
            if self.slowing {
                return Step::End(TaskState::Aborted, Reason::Cancelled);
            }
            if !self.begun {
                // The offsets change while the arm decelerates and changes its mode for the motion.
                self.set_out(cx, motion);
                if let Some((joint, error)) = self.away_from_start(cx, motion) {
                    return Step::End(TaskState::Aborted, Reason::PathTolerance(joint, error));
                }
            }
        }
        self.begun |= granted;
        if granted {
            if let Some(reason) = self.off_path(cx, motion) {
                return Step::End(TaskState::Aborted, reason);
            }
            self.clock.advance(cx.dt);
        }
        let duration = motion.spline.duration();
        motion.spline.sample(self.clock.elapsed(), &mut self.cursor, &mut self.samples);
        note_progress(&mut self.last, self.clock.elapsed(), duration);
        if self.slowing {
            self.clock.slow_down(cx.dt * steepest_slowdown(cx, motion, &self.samples, self.clock.rate()));
            if self.clock.rate() <= 0.0 || self.clock.elapsed() >= duration {
                return Step::End(TaskState::Aborted, Reason::Cancelled);
            }
        } else if granted && !self.clock.runs_at(cx.speed) {
            self.clock.approach(cx.speed, rate_limits(cx, motion, &self.samples, self.clock.rate()), cx.dt);
        }
        if granted && self.at_end {
            self.settling += cx.dt;
            match self.away_from_goal(cx, motion) {
                None => return Step::End(TaskState::Completed, Reason::None),
                Some((joint, error)) if self.settling > self.params.goal_time => {
                    return Step::End(TaskState::Aborted, Reason::GoalTolerance(joint, error));
                }
                Some(_) => {}
            }
        }
        self.at_end = self.clock.elapsed() >= duration.max(self.fade);
        self.clock.mark(cx.now);
        let left = 1.0 - smooth_step(self.clock.elapsed() / self.fade);
        for (k, &joint) in motion.joints.iter().enumerate() {
            let (Some(s), Some(offset)) = (self.samples.get(k), self.offsets.get(k)) else { continue };
            claims.push(Claim { joint, value: s.position + offset * left });
        }
        Step::Continue
    }

    /// The coordinator owns the motion; the progress of the last one stays for the status.
    fn end(&mut self) {}

    fn cancel(&mut self) -> OnCancel {
        self.slowing = true;
        OnCancel::Decelerate
    }

    fn applies_speed(&self) -> bool {
        true
    }

    fn rewind(&mut self, at: Mono, now: Mono) {
        if self.begun {
            self.clock.rewind(at, now);
            self.at_end = false;
        }
    }

    fn describe(&self, view: &mut TaskView) {
        (view.motion, view.progress) = (self.last.motion, self.last.progress);
        (view.elapsed, view.remaining) = (self.last.elapsed, self.last.remaining);
    }
}

fn note_progress(view: &mut TaskView, elapsed: f64, duration: f64) {
    view.elapsed = elapsed;
    view.remaining = (duration - elapsed).max(0.0);
    view.progress = (elapsed / duration).min(1.0);
}

/// Returns how fast the rate may fall [1/s] so that no joint exceeds its acceleration limit: along a path q(s)
/// with s' = r, q'' = q_ss r² + q_s r'. Uses at least a tenth of the limit where the path itself needs all of it.
fn steepest_slowdown(cx: &Context<'_>, motion: &Motion, samples: &[Sample], rate: f64) -> f64 {
    let mut steepest = f64::MAX;
    for (&joint, s) in motion.joints.iter().zip(samples) {
        let limit = cx.joint(joint).acceleration;
        let spare = (limit - s.acceleration.abs() * rate * rate).max(0.1 * limit);
        steepest = steepest.min(spare / s.velocity.abs().max(1e-3));
    }
    steepest
}

/// Returns how fast the rate may rise: see [`steepest_slowdown`], and q''' = … + q_s r'' for the jerk.
fn rate_limits(cx: &Context<'_>, motion: &Motion, samples: &[Sample], rate: f64) -> RateLimits {
    let mut second = f64::MAX;
    for (&joint, s) in motion.joints.iter().zip(samples) {
        second = second.min(cx.joint(joint).jerk / s.velocity.abs().max(1e-3));
    }
    RateLimits { first: steepest_slowdown(cx, motion, samples, rate), second }
}

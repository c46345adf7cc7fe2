//! Executes a trajectory: commands positions along it, from the arm's position until the arm has arrived.

use super::params::TrajectoryParams;
use crate::limit::WAY_BACK;
use crate::path_clock::PathClock;
use crate::rate::RateLimits;
use crate::request::Motion;
use crate::task_body::{Claim, Context, OnCancel, Step, Target, TaskBody};
use dimos_core::clock::Mono;
use dimos_core::joint::{POSITION_MARGIN, TICK_STANDSTILL};
use dimos_core::telemetry::{Outcome, Reason, TaskState, TaskView};
use dimos_core::trajectory::{Cursor, Sample, smooth_step};

/// Minimum time for fading out the offset between the last command and the first point [s].
const SHORTEST_FADE: f64 = 0.2;

/// A motion continues after a gap if the arm rests within this distance of its path [rad]: 2 mm at 0.5 m.
const REJOIN_TOLERANCE: f64 = 0.004;
/// Part of the path on which the point nearest to the arm is searched [s], in this many steps.
const REJOIN_TIME: f64 = 1.0;
const REJOIN_STEPS: u32 = 400;

/// State of a trajectory task.
#[derive(Debug)]
pub struct TrajectoryTask {
    params: TrajectoryParams,
    cursor: Cursor,
    /// Time along the trajectory.
    clock: PathClock,
    slowing: bool,
    /// Why it slows down, other than for a cancel.
    ended: Option<Reason>,
    /// When the arm began to follow it; `None`: it has not.
    began: Option<Mono>,
    /// Whether the arm has begun to follow it.
    begun: bool,
    /// Whether its last point was commanded.
    at_end: bool,
    /// Time since the last point [s].
    settling: f64,
    /// Offset of the last command from the first point, per joint [rad].
    offsets: Vec<f64>,
    /// Time along the path over which they fade out, and where that begins [s].
    fade: f64,
    fade_from: f64,
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
            ended: None,
            began: None,
            begun: false,
            at_end: false,
            settling: 0.0,
            offsets: Vec::with_capacity(width),
            fade: SHORTEST_FADE,
            fade_from: 0.0,
            samples: Vec::with_capacity(width),
            last: TaskView::default(),
        }
    }

    /// Returns the first joint that is too far from the start, and its offset [rad].
    fn away_from_start(&self, cx: &Context<'_>, motion: &Motion) -> Option<(u16, f64)> {
        motion.joints.iter().enumerate().find_map(|(k, &joint)| {
            // What is commanded counts: an arm that droops is read below it.
            let view = cx.joint(joint);
            let here = if view.droop > 0.0 { view.commanded } else { view.position };
            let error = here - motion.spline.start(k);
            let away = error.is_nan() || error.abs() > self.params.start_position_tolerance;
            away.then_some((joint, error))
        })
    }

    /// Starts a motion.
    fn start(&mut self, cx: &Context<'_>, motion: &Motion) {
        self.cursor = Cursor::default();
        self.clock.start(cx.speed);
        (self.slowing, self.begun, self.at_end, self.settling) = (false, false, false, 0.0);
        (self.ended, self.began) = (None, None);
        self.samples.clear();
        self.samples.resize(motion.joints.len(), Sample::default());
        self.last = TaskView { motion: motion.id, ..TaskView::default() };
        self.set_out(cx, motion);
    }

    /// Sets the offsets of the last commands from the first point, and the time for fading them out.
    fn set_out(&mut self, cx: &Context<'_>, motion: &Motion) {
        self.fade_from = 0.0;
        let starts = |k: usize| motion.spline.start(k);
        self.set_offsets(cx, motion, starts);
    }

    /// Sets the offsets of the last commands from a point of the path, and the time for fading them out.
    fn set_offsets(&mut self, cx: &Context<'_>, motion: &Motion, point: impl Fn(usize) -> f64) {
        self.fade = SHORTEST_FADE;
        self.offsets.clear();
        for (k, &joint) in motion.joints.iter().enumerate() {
            let view = cx.joint(joint);
            let offset = view.commanded - point(k);
            self.offsets.push(offset);
            // Fading may use a quarter of the joint's velocity and acceleration limits: the peaks of a quintic step are
            // 1.875 offset / T and 5.774 offset / T².
            let by_speed = 1.875 * offset.abs() / (0.25 * view.velocity_limit);
            let by_acceleration = (5.774 * offset.abs() / (0.25 * view.acceleration)).sqrt();
            self.fade = self.fade.max(by_speed).max(by_acceleration);
        }
    }

    /// Joints outside their ranges go back slowly: the time along the path is slowed down for all.
    fn return_slowly(&mut self, cx: &Context<'_>, motion: &Motion) {
        for (&joint, sample) in motion.joints.iter().zip(&self.samples) {
            let view = cx.joint(joint);
            let outside = (view.lower - view.commanded).max(view.commanded - view.upper) > POSITION_MARGIN;
            if outside && sample.velocity.abs() > WAY_BACK {
                self.clock.limit(WAY_BACK / sample.velocity.abs());
            }
        }
    }

    /// Slows down if a condition that is awaited is met, or can no longer be judged.
    fn judge_until(&mut self, cx: &Context<'_>, motion: &Motion) {
        let Some(until) = motion.until.as_ref().filter(|_| !self.slowing) else { return };
        let time = cx.now.seconds_since(*self.began.get_or_insert(cx.now));
        let ended = match until.met(&cx.sensed(until.arm), self.clock.elapsed(), time) {
            Ok(None) => return,
            Ok(Some((condition, value))) => Reason::Until(condition, value),
            Err(condition) => Reason::Unsensed(until.arm, condition),
        };
        (self.slowing, self.ended) = (true, Some(ended));
    }

    /// Returns how it ends after it has slowed down.
    fn ended(&self) -> Step {
        match self.ended {
            Some(reason @ Reason::Until(..)) => Step::End(TaskState::Completed, reason),
            Some(reason) => Step::End(TaskState::Aborted, reason),
            None => Step::End(TaskState::Aborted, Reason::Cancelled),
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

    /// Returns why the arm has not arrived: of the first joint that is not at its goal, or still moves.
    fn away_from_goal(&self, cx: &Context<'_>, motion: &Motion) -> Option<Reason> {
        motion.joints.iter().zip(&self.samples).find_map(|(&joint, sample)| {
            let view = cx.joint(joint);
            let error = view.position - sample.position;
            if error.is_nan() || error.abs() > self.params.goal_tolerance.max(view.droop) {
                return Some(Reason::GoalTolerance(joint, error));
            }
            let moves = view.velocity.abs() > TICK_STANDSTILL;
            moves.then_some(Reason::GoalVelocity(joint, view.velocity))
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
                return self.ended();
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
            self.judge_until(cx, motion);
            if self.slowing {
                // Before the step: the first command after a cancel is slower already.
                self.clock.slow_down(cx.dt * braking_slowdown(cx, motion, &self.samples, self.clock.rate()));
            }
            self.clock.advance(cx.dt);
        }
        let duration = motion.spline.duration();
        motion.spline.sample(self.clock.elapsed(), &mut self.cursor, &mut self.samples);
        note_progress(&mut self.last, self.clock.elapsed(), duration);
        if self.slowing {
            // An arm that its controller has stopped on its way needs no deceleration.
            if self.clock.rate() <= 0.0 || self.clock.elapsed() >= duration || cx.dt == 0.0 {
                return self.ended();
            }
        } else if granted && !self.clock.runs_at(cx.speed) {
            self.clock.approach(cx.speed, rate_limits(cx, motion, &self.samples, self.clock.rate()), cx.dt);
        }
        self.return_slowly(cx, motion);
        if granted && self.at_end {
            self.settling += cx.dt;
            match self.away_from_goal(cx, motion) {
                None => return Step::End(TaskState::Completed, Reason::None),
                Some(reason) if self.settling > self.params.goal_time => {
                    return Step::End(TaskState::Aborted, reason);
                }
                Some(_) => {}
            }
        }
        self.at_end = self.clock.elapsed() >= duration.max(self.fade_from + self.fade);
        self.clock.mark(cx.now);
        let left = 1.0 - smooth_step((self.clock.elapsed() - self.fade_from) / self.fade);
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

    fn rejoin(&mut self, cx: &Context<'_>, at: Mono, tolerance: f64) -> Result<(), (u16, f64)> {
        let Some(motion) = cx.motion.filter(|_| self.begun) else { return Ok(()) };
        let from = self.clock.at_tick(at);
        let left = 1.0 - smooth_step((from - self.fade_from) / self.fade);
        let mut nearest = (from, f64::INFINITY, 0);
        for step in 0..=REJOIN_STEPS {
            let elapsed = from + REJOIN_TIME * f64::from(step) / f64::from(REJOIN_STEPS);
            motion.spline.sample(elapsed, &mut Cursor::default(), &mut self.samples);
            let (mut furthest, mut of) = (0.0, 0);
            for ((&joint, sample), offset) in motion.joints.iter().zip(&self.samples).zip(&self.offsets) {
                let away = (cx.joint(joint).commanded - sample.position - offset * left).abs();
                if away > furthest {
                    (furthest, of) = (away, joint);
                }
            }
            if furthest < nearest.1 - 1e-12 {
                nearest = (elapsed, furthest, of);
            }
        }
        let (elapsed, away, joint) = nearest;
        if away > tolerance.max(REJOIN_TOLERANCE) {
            return Err((joint, away));
        }
        self.clock.rest_at(elapsed.min(motion.spline.duration()));
        (self.at_end, self.fade_from) = (false, self.clock.elapsed());
        motion.spline.sample(self.clock.elapsed(), &mut self.cursor, &mut self.samples);
        let samples = std::mem::take(&mut self.samples);
        self.set_offsets(cx, motion, |k| samples.get(k).map_or(0.0, |sample| sample.position));
        self.samples = samples;
        Ok(())
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

/// Returns how fast the rate falls [1/s] so that every joint decelerates along the path within its acceleration limit:
/// what the path itself accelerates a joint by is taken from it first. See [`steepest_slowdown`].
fn braking_slowdown(cx: &Context<'_>, motion: &Motion, samples: &[Sample], rate: f64) -> f64 {
    let mut steepest = f64::MAX;
    for (&joint, s) in motion.joints.iter().zip(samples) {
        let limit = cx.joint(joint).acceleration;
        let along = s.acceleration * s.velocity.signum() * rate * rate;
        steepest = steepest.min((limit + along).max(0.1 * limit) / s.velocity.abs().max(1e-3));
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

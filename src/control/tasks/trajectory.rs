//! Executes a trajectory: positions along its curve, from where the arm is, until the arm has arrived.

use crate::clock::Mono;
use crate::control::config::TrajectoryParams;
use crate::control::path_clock::{PathClock, RateLimits};
use crate::control::request::Motion;
use crate::control::task::{Claim, Context};
use crate::telemetry::{Outcome, Reason, TaskState, TaskView};
use crate::trajectory::{Cursor, Sample};

/// An arrived joint moves no faster than this [rad/s].
const STANDSTILL: f64 = 0.05;
/// The shortest time over which the difference between the first point and the last command is faded out [s].
const SHORTEST_FADE: f64 = 0.2;

/// State of a trajectory task.
#[derive(Debug)]
pub struct TrajectoryTask {
    params: TrajectoryParams,
    motion: Option<Box<Motion>>,
    cursor: Cursor,
    /// Time along the trajectory.
    clock: PathClock,
    slowing: bool,
    /// The arm has taken it up.
    begun: bool,
    /// Its last point was commanded.
    at_end: bool,
    /// Time since then [s].
    settling: f64,
    /// What the last commands were ahead of the first point, joint by joint [rad].
    offsets: Vec<f64>,
    fade: f64,
    samples: Vec<Sample>,
    last: TaskView,
}

impl TrajectoryTask {
    /// A task for up to `width` joints.
    pub fn new(params: TrajectoryParams, width: usize) -> Self {
        Self {
            params,
            motion: None,
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

    /// Whether a motion may start from the present state.
    pub fn check_start(&self, cx: &Context<'_>, motion: &Motion) -> Result<(), Outcome> {
        match self.away_from_start(cx, motion) {
            Some((joint, error)) => Err(Outcome::StartStateMismatch(joint, error.abs())),
            None => Ok(()),
        }
    }

    /// The first joint that is too far from the start, and how far it is ahead of it [rad].
    fn away_from_start(&self, cx: &Context<'_>, motion: &Motion) -> Option<(u16, f64)> {
        motion.joints.iter().enumerate().find_map(|(k, &joint)| {
            let error = cx.joint(joint).position - motion.spline.start(k);
            let away = error.is_nan() || error.abs() > self.params.start_position_tolerance;
            away.then_some((joint, error))
        })
    }

    /// Takes on a motion. Answers the one before, if any.
    pub fn start(&mut self, cx: &Context<'_>, motion: Box<Motion>) -> Option<Box<Motion>> {
        self.cursor = Cursor::default();
        self.clock.start();
        (self.slowing, self.begun, self.at_end, self.settling) = (false, false, false, 0.0);
        self.samples.clear();
        self.samples.resize(motion.joints.len(), Sample::default());
        self.last = TaskView { motion: motion.id, remaining: motion.spline.duration(), ..TaskView::default() };
        let before = self.motion.replace(motion);
        self.set_out(cx);
        before
    }

    /// Notes what the last commands are ahead of the first point, and over which time that is faded out.
    fn set_out(&mut self, cx: &Context<'_>) {
        let Some(motion) = self.motion.as_deref() else { return };
        self.fade = SHORTEST_FADE;
        self.offsets.clear();
        for (k, &joint) in motion.joints.iter().enumerate() {
            let view = cx.joint(joint);
            let offset = view.commanded - motion.spline.start(k);
            self.offsets.push(offset);
            // The fade may use a quarter of the joint's speed and acceleration: peaks of a quintic step are
            // 1.875 offset / T and 5.774 offset / T².
            let by_speed = 1.875 * offset.abs() / (0.25 * view.velocity_limit);
            let by_acceleration = (5.774 * offset.abs() / (0.25 * view.acceleration)).sqrt();
            self.fade = self.fade.max(by_speed).max(by_acceleration);
        }
    }

    /// Nothing reached an arm since the tick of `at`: goes back to what was commanded then, at rest.
    pub fn rewind(&mut self, at: Mono, now: Mono) {
        if self.begun {
            self.clock.rewind(at, now);
            self.at_end = false;
        }
    }

    /// From now on slow down along the path.
    pub fn slow_down(&mut self) {
        self.slowing = true;
    }

    /// Gives the motion back.
    pub fn take(&mut self) -> Option<Box<Motion>> {
        self.motion.take()
    }

    /// Fills in the claims of this tick, or says how it ended. `granted`: the claims of the last tick went out.
    pub fn compute(&mut self, cx: &Context<'_>, granted: bool, claims: &mut Vec<Claim>) -> Option<(TaskState, Reason)> {
        if !granted {
            if self.slowing {
                return Some((TaskState::Aborted, Reason::Cancelled));
            }
            if !self.begun {
                // While the arm slows down and changes its mode for it, the way to the start changes.
                self.set_out(cx);
                let away = self.motion.as_deref().and_then(|motion| self.away_from_start(cx, motion));
                if let Some((joint, error)) = away {
                    return Some((TaskState::Aborted, Reason::PathTolerance(joint, error)));
                }
            }
        }
        self.begun |= granted;
        let motion = self.motion.as_deref()?;
        if granted {
            if let Some(reason) = self.off_path(cx, motion) {
                return Some((TaskState::Aborted, reason));
            }
            self.clock.advance(cx.dt);
        }
        let duration = motion.spline.duration();
        motion.spline.sample(self.clock.elapsed(), &mut self.cursor, &mut self.samples);
        note_progress(&mut self.last, self.clock.elapsed(), duration);
        if self.slowing {
            self.clock.slow_down(cx.dt * steepest_slowdown(cx, motion, &self.samples, self.clock.rate()));
            if self.clock.rate() <= 0.0 || self.clock.elapsed() >= duration {
                return Some((TaskState::Aborted, Reason::Cancelled));
            }
        } else if granted && !self.clock.full() {
            self.clock.speed_up(rate_limits(cx, motion, &self.samples, self.clock.rate()), cx.dt);
        }
        if granted && self.at_end {
            self.settling += cx.dt;
            match self.away_from_goal(cx, motion) {
                None => return Some((TaskState::Completed, Reason::None)),
                Some((joint, error)) if self.settling > self.params.goal_time => {
                    return Some((TaskState::Aborted, Reason::GoalTolerance(joint, error)));
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
        None
    }

    fn off_path(&self, cx: &Context<'_>, motion: &Motion) -> Option<Reason> {
        let tolerance = self.params.path_tolerance;
        if tolerance <= 0.0 {
            return None;
        }
        let mut errors = motion.joints.iter().map(|&j| (j, cx.joint(j).tracking_error));
        errors.find(|(_, e)| e.abs() > tolerance).map(|(j, e)| Reason::PathTolerance(j, e))
    }

    /// The first joint that has not arrived, and its error [rad].
    fn away_from_goal(&self, cx: &Context<'_>, motion: &Motion) -> Option<(u16, f64)> {
        motion.joints.iter().zip(&self.samples).find_map(|(&joint, sample)| {
            let view = cx.joint(joint);
            let error = view.position - sample.position;
            let arrived = error.abs() <= self.params.goal_tolerance && view.velocity.abs() <= STANDSTILL;
            (!arrived).then_some((joint, error))
        })
    }

    /// Adds the motion's progress to what is told of the task.
    pub fn describe(&self, view: &mut TaskView) {
        (view.motion, view.progress) = (self.last.motion, self.last.progress);
        (view.elapsed, view.remaining) = (self.last.elapsed, self.last.remaining);
    }
}

fn note_progress(view: &mut TaskView, elapsed: f64, duration: f64) {
    view.elapsed = elapsed;
    view.remaining = (duration - elapsed).max(0.0);
    view.progress = (elapsed / duration).min(1.0);
}

/// How fast the speed along the path may fall [1/s] so that no joint exceeds its acceleration: along a path q(s)
/// with s' = r, q'' = q_ss r² + q_s r'. At least a tenth of the acceleration is used where the path itself needs all.
fn steepest_slowdown(cx: &Context<'_>, motion: &Motion, samples: &[Sample], rate: f64) -> f64 {
    let mut steepest = f64::MAX;
    for (&joint, s) in motion.joints.iter().zip(samples) {
        let limit = cx.joint(joint).acceleration;
        let spare = (limit - s.acceleration.abs() * rate * rate).max(0.1 * limit);
        steepest = steepest.min(spare / s.velocity.abs().max(1e-3));
    }
    steepest
}

/// How fast the speed along the path may rise: see [`steepest_slowdown`], and q''' = … + q_s r'' for the jerk.
fn rate_limits(cx: &Context<'_>, motion: &Motion, samples: &[Sample], rate: f64) -> RateLimits {
    let mut second = f64::MAX;
    for (&joint, s) in motion.joints.iter().zip(samples) {
        second = second.min(cx.joint(joint).jerk / s.velocity.abs().max(1e-3));
    }
    RateLimits { first: steepest_slowdown(cx, motion, samples, rate), second }
}

/// 0 → 1 with zero velocity and acceleration at both ends.
fn smooth_step(x: f64) -> f64 {
    let x = x.clamp(0.0, 1.0);
    x * x * x * (10.0 + x * (6.0 * x - 15.0))
}

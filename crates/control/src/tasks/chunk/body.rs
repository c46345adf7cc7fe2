//! Follows chunks. A chunk replaces the rest of the one before it from its own start on; actions whose time is over are
//! skipped. At each change of the curve the motion so far is blended into it.

use super::blend::Blend;
use super::curve::SHARE;
use super::params::ChunkParams;
use crate::config::JUMP;
use crate::request::Motion;
use crate::task_body::{Claim, Context, Step, Target, TaskBody};
use dimos_core::clock::Mono;
use dimos_core::joint::{JointBounds, Joints, MAX_DOF};
use dimos_core::telemetry::{Outcome, Reason, TaskState};
use dimos_core::trajectory::{Cursor, MAX_ACTIONS, Sample};

/// Factor of the limits that leaves room for rounding.
const ROUNDING: f64 = 0.99;

/// A point of the curve: position, velocity and acceleration of each joint.
type Knot = [Sample; MAX_DOF];

/// The curve of a chunk, in memory that is never freed.
#[derive(Debug)]
struct Curve {
    start: Mono,
    /// Time between two points [s].
    period: f64,
    count: usize,
    knots: Box<[Knot]>,
}

impl Curve {
    fn new() -> Self {
        let knots = vec![[Sample::default(); MAX_DOF]; MAX_ACTIONS].into_boxed_slice();
        Self { start: Mono::ZERO, period: 1.0, count: 0, knots }
    }

    /// Copies the points of a motion.
    fn copy(&mut self, motion: &Motion, start: Mono) {
        let times = motion.spline.times();
        (self.start, self.count) = (start, times.len().min(self.knots.len()));
        self.period = motion.spline.duration() / times.len().saturating_sub(1).max(1) as f64;
        let mut cursor = Cursor::default();
        for (knot, time) in self.knots.iter_mut().zip(times) {
            motion.spline.sample(*time, &mut cursor, knot);
        }
    }

    /// Returns the time since the start [s]; negative before it.
    fn elapsed(&self, now: Mono) -> f64 {
        if now >= self.start { now.seconds_since(self.start) } else { -self.start.seconds_since(now) }
    }

    fn duration(&self) -> f64 {
        self.period * self.count.saturating_sub(1) as f64
    }

    /// Returns a joint at a time [s since the start]: a cubic between two points, which continues beyond the ends.
    fn at(&self, joint: usize, t: f64) -> Sample {
        let last = self.count.saturating_sub(2);
        let k = ((t / self.period).max(0.0) as usize).min(last);
        let of = |k: usize| self.knots.get(k).and_then(|knot| knot.get(joint)).copied().unwrap_or_default();
        let (from, to) = (of(k), of(k + 1));
        let x = t - k as f64 * self.period;
        let jerk = (to.acceleration - from.acceleration) / self.period;
        Sample {
            position: from.position + x * (from.velocity + x * (from.acceleration / 2.0 + x * jerk / 6.0)),
            velocity: from.velocity + x * (from.acceleration + x * jerk / 2.0),
            acceleration: from.acceleration + x * jerk,
        }
    }
}

/// What the joints are blended into.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Phase {
    /// The present chunk.
    Follow,
    /// Rest, after the end of the last chunk.
    Rest,
}

/// State of a chunk task.
#[derive(Debug)]
pub struct ChunkTask {
    params: ChunkParams,
    present: Curve,
    /// The newest chunk, until its start.
    next: Curve,
    waiting: bool,
    phase: Phase,
    /// Where the joints rest after the end of the last chunk [rad].
    rest: Joints,
    /// When that blend began.
    blend_from: Mono,
    blend: Blend,
    /// The motion in the last tick, and the tick's time.
    last: Knot,
    last_tick: Mono,
}

impl ChunkTask {
    /// Creates a task without a chunk.
    pub fn new(params: ChunkParams) -> Self {
        Self {
            params,
            present: Curve::new(),
            next: Curve::new(),
            waiting: false,
            phase: Phase::Rest,
            rest: Joints::default(),
            blend_from: Mono::ZERO,
            blend: Blend::default(),
            last: [Sample::default(); MAX_DOF],
            last_tick: Mono::ZERO,
        }
    }

    /// Returns the motion of a joint at a time.
    fn motion(&self, joint: usize, now: Mono) -> Sample {
        let offset = self.blend.at(joint, now.seconds_since(self.blend_from));
        let base = match self.phase {
            Phase::Follow => self.present.at(joint, self.present.elapsed(now)),
            Phase::Rest => Sample { position: self.rest.get(joint).copied().unwrap_or_default(), ..Sample::default() },
        };
        Sample {
            position: base.position + offset.position,
            velocity: base.velocity + offset.velocity,
            acceleration: base.acceleration + offset.acceleration,
        }
    }

    /// Blends the motion so far, that of the last tick, into the present chunk or to rest, from `before` on.
    fn change(&mut self, cx: &Context<'_>, before: Mono, phase: Phase) {
        (self.phase, self.blend_from) = (phase, before);
        let elapsed = self.present.elapsed(before);
        let (last, present) = (&self.last, &self.present);
        // A curve has its share of the limits already.
        let share = ROUNDING * if phase == Phase::Follow { 1.0 - SHARE } else { 1.0 };
        let limits = |j: usize| {
            let view = cx.joints.get(j).map(|&joint| cx.joint(joint)).unwrap_or_default();
            JointBounds { acceleration: share * view.acceleration, jerk: share * view.jerk, ..JointBounds::NONE }
        };
        let is = |j: usize| last.get(j).copied().unwrap_or_default();
        self.blend = Blend::begin(cx.joints.len(), |j, duration| {
            let is = is(j);
            let offset = match phase {
                Phase::Follow => {
                    let curve = present.at(j, elapsed);
                    Sample {
                        position: is.position - curve.position,
                        velocity: is.velocity - curve.velocity,
                        acceleration: is.acceleration - curve.acceleration,
                    }
                }
                Phase::Rest => Sample { position: -way_to_rest(&is, duration), ..is },
            };
            (offset, limits(j))
        });
        let duration = self.blend.duration();
        for (j, rest) in self.rest.iter_mut().enumerate() {
            let is = is(j);
            *rest = is.position + way_to_rest(&is, duration);
        }
    }

    /// Takes over the motion as commanded: not all of the last tick was.
    fn rebase(&mut self, cx: &Context<'_>) {
        for (sample, &joint) in self.last.iter_mut().zip(cx.joints) {
            let view = cx.joint(joint);
            *sample = Sample { position: view.commanded, velocity: view.commanded_velocity, acceleration: 0.0 };
        }
    }
}

/// Returns how far a joint still moves while it decelerates to rest within a time [s] with the least jerk [rad].
fn way_to_rest(motion: &Sample, duration: f64) -> f64 {
    motion.velocity * duration / 2.0 + motion.acceleration * duration * duration / 12.0
}

impl TaskBody for ChunkTask {
    fn accept(&mut self, cx: &Context<'_>, target: &Target<'_>) -> Result<(), Outcome> {
        let Target::Chunk(motion, start) = target else { return Err(Outcome::WrongTask(cx.task)) };
        let points = motion.spline.times().len();
        let ends = start.after(std::time::Duration::from_secs_f64(motion.spline.duration()));
        if points > MAX_ACTIONS || motion.spline.joints() != cx.joints.len() || ends <= cx.now {
            return Err(Outcome::InvalidTarget(cx.task));
        }
        self.next.copy(motion, *start);
        // Compared where it takes over with what the joints do there: a jump is not what a policy wants.
        let takes_over = cx.now.max(*start);
        for (j, &joint) in cx.joints.iter().enumerate() {
            let before = match (cx.active, self.phase) {
                (true, Phase::Follow) => {
                    let elapsed = self.present.elapsed(takes_over).min(self.present.duration());
                    self.present.at(j, elapsed).position
                }
                (true, Phase::Rest) => self.rest.get(j).copied().unwrap_or_default(),
                (false, _) => cx.joint(joint).commanded,
            };
            let step = (self.next.at(j, self.next.elapsed(takes_over)).position - before).abs();
            if step > JUMP {
                self.waiting = false;
                return Err(Outcome::StartStateMismatch(joint, step));
            }
        }
        self.waiting = true;
        if !cx.active {
            self.rebase(cx);
            self.last_tick = cx.now;
            self.change(cx, cx.now, Phase::Rest);
        }
        Ok(())
    }

    fn compute(&mut self, cx: &Context<'_>, claims: &mut Vec<Claim>) -> Step {
        let period = std::time::Duration::from_secs_f64(cx.dt);
        let before = cx.now.before(period);
        // After lost ticks the motion continues where it was: it does not catch up in a jump.
        let lost = cx.now.seconds_since(self.last_tick) > 1.5 * cx.dt;
        if !cx.granted {
            self.rebase(cx);
        }
        let begins = self.waiting && cx.now >= self.next.start;
        if begins {
            std::mem::swap(&mut self.present, &mut self.next);
            self.waiting = false;
        }
        let over = self.phase == Phase::Follow && self.present.elapsed(cx.now) > self.present.duration();
        match self.phase {
            _ if begins => self.change(cx, before, Phase::Follow),
            _ if over => self.change(cx, before, Phase::Rest),
            phase if lost || !cx.granted => self.change(cx, before, phase),
            Phase::Rest if !self.waiting && self.has_rested(cx.now) => {
                return Step::End(TaskState::Idle, Reason::Timeout);
            }
            _ => {}
        }
        self.last_tick = cx.now;
        for (j, &joint) in cx.joints.iter().enumerate() {
            let sample = self.motion(j, cx.now);
            if let Some(last) = self.last.get_mut(j) {
                *last = sample;
            }
            claims.push(Claim { joint, value: sample.position });
        }
        Step::Continue
    }

    fn end(&mut self) {
        (self.waiting, self.phase) = (false, Phase::Rest);
    }
}

impl ChunkTask {
    /// Returns whether the joints have rested for the timeout.
    fn has_rested(&self, now: Mono) -> bool {
        now.seconds_since(self.blend_from) > self.blend.duration() + self.params.timeout
    }
}

//! Judges one true arm and the commands to it, against what was requested of it. Shares nothing with
//! `dimos::control`.

#![allow(clippy::needless_range_loop, reason = "joints are indices into several arrays at once")]

use dimos::arm::{ArmCommand, Supervision};
use dimos::control::config::ArmConfig;
use dimos::joint::{ControlMode, JointLimits, Joints, MAX_DOF};

/// Until a wrong motion is noticed [s]: a tracking error lasts 0.1 s, a wrong velocity 0.2 s; and some readings.
const DETECTION: f64 = 0.25;
/// Of the arm's model at rest [rad].
const SLACK: f64 = 0.003;
/// An arm that rests for this long has ended its motion [s].
const RESTED: f64 = 0.1;
/// How long it may take to the arm's own stop besides braking [s], and from rest [ticks].
const STOP: (f64, u32) = (0.5, 2);

/// A rule that was broken: the worst case of each in a trial.
#[derive(Debug, Clone)]
pub struct Violation {
    pub rule: Rule,
    /// Since the trial began [s].
    pub at: f64,
    pub arm: usize,
    pub joint: usize,
    /// By how much: rad, times the limit, or s.
    pub excess: f64,
    pub text: String,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Rule {
    /// (a) A joint leaves what was requested [rad].
    Path,
    /// (a) A joint moves although nothing was requested [rad].
    Unasked,
    /// (b) Setpoints against their limits [times].
    Setpoint,
    /// (c) A stop is not taken [s].
    Stop,
    /// (d) Panic, not finite, outside of the limits.
    Sound,
    /// An honest arm is held, or its motion does not end as it should.
    Honest,
}

pub const RULES: [Rule; 6] = [Rule::Path, Rule::Unasked, Rule::Setpoint, Rule::Stop, Rule::Sound, Rule::Honest];

impl Rule {
    pub fn name(self) -> &'static str {
        match self {
            Self::Path => "a path",
            Self::Unasked => "a unasked",
            Self::Setpoint => "b setpoint",
            Self::Stop => "c stop",
            Self::Sound => "d sound",
            Self::Honest => "honest",
        }
    }
}

/// What was written last.
#[derive(Debug, Clone, Copy)]
struct Wire {
    at: f64,
    values: Joints,
    velocity: Joints,
    mode: ControlMode,
    start: u32,
}

#[derive(Debug, Clone, Copy)]
struct PendingStop {
    at: f64,
    ticks: u32,
    seq: u32,
    /// Latest time [s]; `None`: the setpoints were at rest.
    by: Option<f64>,
}

#[derive(Debug)]
pub struct Judge {
    arm: usize,
    dof: usize,
    s: Supervision,
    limits: JointLimits,
    period: f64,
    noise: f64,
    /// How much later than that a wrong motion may be noticed [s].
    pub late: f64,
    /// What was requested, and the highest speed of it, per joint.
    low: Vec<f64>,
    high: Vec<f64>,
    speed: Vec<f64>,
    /// Something is requested.
    active: bool,
    /// The motion has ended and the arm rests: since then nothing may move.
    resting: bool,
    ended: f64,
    at_rest_since: Option<f64>,
    /// Velocities were commanded beside a lie: where the joints are is known to this only [rad], 0: exactly.
    blind: f64,
    wire: Option<Wire>,
    /// How far out the setpoints of this start may be.
    bounds: [(f64, f64); MAX_DOF],
    stop: Option<PendingStop>,
    last: ArmCommand,
    /// When the setpoints moved last [s].
    moved: f64,
    pub found: Vec<Violation>,
}

impl Judge {
    /// Of an arm that is at `q` [rad] and whose readings have this noise [rad].
    pub fn new(arm: usize, config: &ArmConfig, q: &[f64], noise: f64, period: f64) -> Self {
        Self {
            arm,
            dof: config.dof,
            s: config.supervision,
            limits: config.limits.clone(),
            period,
            noise,
            late: 0.0,
            low: q.to_vec(),
            high: q.to_vec(),
            speed: vec![0.0; config.dof],
            active: false,
            resting: true,
            ended: 0.0,
            at_rest_since: None,
            blind: 0.0,
            wire: None,
            bounds: [(0.0, 0.0); MAX_DOF],
            stop: None,
            last: ArmCommand::default(),
            moved: f64::NEG_INFINITY,
            found: Vec::new(),
        }
    }

    pub fn report(&mut self, rule: Rule, at: f64, joint: usize, excess: f64, text: impl FnOnce() -> String) {
        let arm = self.arm;
        match self.found.iter_mut().find(|v| v.rule == rule) {
            // The first is where it began; how bad it becomes is counted on.
            Some(found) => found.excess = found.excess.max(excess),
            None => self.found.push(Violation { rule, at, arm, joint, excess, text: text() }),
        }
    }

    /// Returns whether the last motion is over, and nothing may move.
    pub fn rests(&self) -> bool {
        self.resting
    }

    /// A joint may be asked to go to a position, at a speed [rad, rad/s].
    pub fn request(&mut self, joint: usize, to: f64, speed: f64) {
        (self.low[joint], self.high[joint]) = (self.low[joint].min(to), self.high[joint].max(to));
        self.speed[joint] = self.speed[joint].max(speed.abs().min(self.limits.velocity_max[joint]));
    }

    /// The motors come on, or a person moves the arm while they are off. `extra`: how far a joint may move by that.
    pub fn placed(&mut self, q: &[f64], extra: impl Fn(usize) -> f64) {
        for j in 0..self.dof {
            (self.low[j], self.high[j]) = (q[j] - extra(j), q[j] + extra(j));
        }
        self.speed.fill(0.0);
        self.blind = 0.0;
        (self.resting, self.wire, self.at_rest_since) = (true, None, None);
    }

    /// Velocities are commanded while what is read is off by this [rad].
    pub fn blind(&mut self, off: f64) {
        self.blind = self.blind.max(self.s.tracking_tolerance + 0.05).max(off + 0.05);
    }

    /// It may move by this much more: a step that looks like noise [rad].
    pub fn widen(&mut self, by: f64) {
        self.low.iter_mut().for_each(|low| *low -= by);
        self.high.iter_mut().for_each(|high| *high += by);
    }

    /// Judges the true joints [rad] of an arm whose motors are on. `active`: something is requested of the arm.
    pub fn joints(&mut self, now: f64, q: &[f64], at_rest: bool, active: bool) {
        if self.active && !active {
            self.ended = now;
        }
        self.active = active;
        self.resting &= !active;
        self.at_rest_since = at_rest.then(|| self.at_rest_since.unwrap_or(now));
        if !active && !self.resting {
            let rested = self.at_rest_since.is_some_and(|since| now - since.max(self.ended) > RESTED);
            let braking = (0..self.dof).map(|j| self.speed[j] / self.limits.acceleration_max[j]).fold(0.0, f64::max);
            if rested || now - self.ended > braking + 3.0 * self.s.lag + 0.8 {
                let unknown = self.blind;
                for j in 0..self.dof {
                    (self.low[j], self.high[j]) = (q[j] - unknown, q[j] + unknown);
                }
                self.speed.fill(0.0);
                self.resting = true;
            }
        }
        let still = self.s.relief + self.s.accuracy + self.noise + SLACK;
        for j in 0..self.dof {
            let (v, a) = (self.speed[j], self.limits.acceleration_max[j]);
            let margin = if self.resting {
                still
            } else {
                still
                    + self.s.droop
                    + self.s.tracking_tolerance
                    + v * (self.s.lag + DETECTION + self.late)
                    + v * v / (2.0 * a)
            };
            let out = (self.low[j] - q[j]).max(q[j] - self.high[j]);
            let rule = if self.resting { Rule::Unasked } else { Rule::Path };
            if out > margin || out.is_nan() {
                let (q, low, high) = (q[j], self.low[j], self.high[j]);
                self.report(rule, now, j, out - margin, || {
                    format!("joint at {q:.4}, requested {low:.4} to {high:.4}, margin {margin:.4} rad")
                });
            }
        }
    }

    /// Judges the command of a tick, and what of it was written.
    pub fn command(&mut self, now: f64, command: &ArmCommand, written: bool, q: &[f64]) {
        let finite = |values: &Joints| values.iter().all(|v| v.is_finite());
        if !finite(&command.values) || !finite(&command.velocity) || !command.rest.is_none_or(|rest| finite(&rest)) {
            self.report(Rule::Sound, now, 0, f64::INFINITY, || format!("not finite: {:?}", command.values));
        }
        if let Some(stop) = &mut self.stop {
            stop.ticks += 1;
            let stop = *stop;
            let late = match stop.by {
                Some(by) => now - by,
                None => f64::from(stop.ticks) * self.period - (f64::from(STOP.1) + 0.5) * self.period,
            };
            if command.stop_seq != stop.seq {
                self.stop = None;
            } else if late > 0.0 {
                let from = if stop.by.is_some() { "in motion" } else { "at rest" };
                self.report(Rule::Stop, now, 0, late, || {
                    format!("{:.3} s after a stop {from} the arm has not got its own", now - stop.at)
                });
            }
        }
        self.last = *command;
        let Some(mode) = command.mode.filter(|_| written) else { return };
        self.wire(now, command, mode, q);
    }

    fn wire(&mut self, now: f64, command: &ArmCommand, mode: ControlMode, q: &[f64]) {
        let mut velocity = [0.0; MAX_DOF];
        let velocities = mode == ControlMode::Velocity;
        let last = self.wire.filter(|wire| wire.mode == mode && wire.start == command.start_seq);
        if last.is_none() {
            if let Some(before) = self.wire.filter(|wire| now - wire.at < 1.5 * self.period) {
                for j in 0..self.dof {
                    let v = before.velocity[j];
                    if v.abs() > 1e-6 {
                        self.report(Rule::Setpoint, now, j, f64::INFINITY, || {
                            format!("a start while setpoints move at {v}")
                        });
                    }
                }
            }
            for j in 0..self.dof {
                // Where the arm may rest outside of its range it may start.
                let (lower, upper) = (self.limits.position_lower[j], self.limits.position_upper[j]);
                let beyond = self.s.outside + self.s.accuracy;
                let start = command.values[j].clamp(lower - beyond, upper + beyond);
                let low = if velocities { lower } else { lower.min(q[j]).min(start) };
                self.bounds[j] = (low, if velocities { upper } else { upper.max(q[j]).max(start) });
            }
        }
        let dt = last.map_or(self.period, |wire| now - wire.at);
        let before = last.map(|wire| wire.values);
        let speed = last.map_or([0.0; MAX_DOF], |wire| wire.velocity);
        for j in 0..self.dof {
            let value = command.values[j];
            velocity[j] = if velocities { value } else { before.map_or(0.0, |before| (value - before[j]) / dt) };
            let (top, most) = (self.limits.velocity_max[j], self.limits.acceleration_max[j] * dt);
            let (v, change) = (velocity[j], (velocity[j] - speed[j]).abs());
            if v.abs() > top * (1.0 + 1e-6) + 1e-9 {
                self.report(Rule::Setpoint, now, j, v.abs() / top, || format!("{v:.4} rad/s (limit {top:.4})"));
            }
            if dt < 1.5 * self.period && change > most * 1.002 + 1e-6 {
                let a = change / dt;
                self.report(Rule::Setpoint, now, j, change / most, || {
                    format!(
                        "velocity {:.4} to {v:.4} rad/s in one period: {a:.2} rad/s² (limit {:.2})",
                        speed[j],
                        most / dt
                    )
                });
            }
            let (lower, upper) = self.bounds[j];
            let out = (lower - value).max(value - upper);
            if !velocities && out > 1e-9 {
                self.report(Rule::Sound, now, j, out, || {
                    format!("setpoint {value:.4} outside {lower:.4} to {upper:.4}")
                });
            }
        }
        if velocity.iter().any(|v| v.abs() > 1e-9) {
            self.moved = now;
        }
        self.wire = Some(Wire { at: now, values: command.values, velocity, mode, start: command.start_seq });
    }

    /// An operator's stop goes to the next tick.
    pub fn stop_asked(&mut self, now: f64, enabled: bool) {
        if !enabled {
            return;
        }
        let speed = self.wire.filter(|wire| now - wire.at < 1.5 * self.period && self.last.mode.is_some());
        let braking = |j: usize| speed.map_or(0.0, |w| w.velocity[j].abs() / self.limits.acceleration_max[j]);
        let longest = (0..self.dof).map(braking).fold(0.0, f64::max);
        // Setpoints at rest for less than the lag: the arm still follows them.
        let moves = self.last.mode.is_some() && now - self.moved <= self.s.lag + self.period;
        let by = moves.then_some(now + longest + STOP.0);
        self.stop = Some(PendingStop { at: now, ticks: 0, seq: self.last.stop_seq, by });
    }
}

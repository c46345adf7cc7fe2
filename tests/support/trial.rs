//! One trial: a coordinator on a virtual clock between a true arm and, perhaps, a lie. A sequence of requests drawn
//! from a seed, and the judgement.

#![allow(clippy::needless_range_loop, reason = "joints are indices into several arrays at once")]

use std::collections::VecDeque;
use std::time::Duration;

use dimos::arm::ArmState;
use dimos::clock::Mono;
use dimos::control::coordinator::{Coordinator, TickTime};
use dimos::control::request::{Envelope, Request};
use dimos::joint::{ControlMode, Joints};
use dimos::robot::random::Random;
use dimos::telemetry::{Cause, Event, Outcome, Phase, TaskState, TaskView};

use super::arm_rows::Row;
use super::lies::{Kind, Lie, Span};
use super::motion_judge::{Judge, Rule, Violation};
use super::true_arm::TrueArm;

/// The types of the tasks, each once at most.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Act {
    Trajectory,
    Servo,
    Velocity,
    Chunk,
    Pose,
    Twist,
    Follow,
}

/// A hand that moves a leader: speed [rad/s] and how long [s].
#[derive(Debug, Clone, Copy)]
pub struct Hand {
    pub speed: f64,
    pub phase: f64,
}

/// A jump that an operator accepts, with a look at the arm [rad].
pub(super) const ACCEPTED: f64 = 0.05;

pub struct Trial {
    pub seed: u64,
    pub row: Row,
    pub rate: f64,
    /// Its main task.
    pub act: Act,
    /// The lie, and the arm that it is about: 0, or 1 for the leader.
    pub lie: Option<(usize, Lie)>,
    pub lied_at: Option<(f64, String)>,
    /// Number of the last written setpoint when the motors came on.
    pub(super) written_before: u64,
    pub random: Random,
    /// For noise, so that the requests are the same with and without it.
    pub(super) noise: Random,
    pub coordinator: Coordinator,
    pub arms: Vec<TrueArm>,
    pub judges: Vec<Judge>,
    pub now: Mono,
    pub(super) began: Mono,
    pub(super) inbox: VecDeque<Envelope>,
    pub(super) next_id: u64,
    pub(super) outcomes: Vec<(u64, Outcome)>,
    pub phases: Vec<(Phase, Cause)>,
    pub tasks: Vec<TaskView>,
    /// What each task is, in their order.
    pub acts: Vec<Act>,
    pub said: Vec<ArmState>,
    pub commands: Vec<dimos::arm::ArmCommand>,
    pub hand: Option<Hand>,
    pub(super) hand_time: f64,
    /// Velocities that are requested now [rad/s], their integral, and when they were.
    pub velocities: Option<(Joints, Joints, f64)>,
    /// Of a follower: whether what is read of the leader counts as requested.
    pub(super) led_by_reading: bool,
    /// States are late for some ticks from time to time.
    pub late_states: bool,
    pub(super) late_left: Vec<usize>,
    pub verbose: bool,
    /// Residuals of a recording, played back over the readings: per joint, at this period [s].
    pub recorded: Option<(f64, Vec<Vec<f64>>)>,
}

impl Trial {
    pub fn seconds(&self) -> f64 {
        self.now.seconds_since(self.began)
    }

    pub fn task(&self, act: Act) -> Option<u16> {
        self.acts.iter().position(|a| *a == act).map(|i| i as u16)
    }

    pub fn send(&mut self, request: Request) -> u64 {
        let id = self.next_id;
        self.next_id += 1;
        if matches!(request, Request::Stop { .. }) {
            let now = self.seconds();
            self.judges[0].stop_asked(now + 1.0 / self.rate, self.arms[0].enabled);
        }
        self.inbox.push_back(Envelope { id, origin: None, request });
        id
    }

    pub fn ask(&mut self, request: Request) -> Outcome {
        let stop = matches!(request, Request::Stop { .. });
        let id = self.send(request);
        self.tick();
        if stop && self.phases[0].0 != Phase::Held && self.arms[0].enabled {
            let (now, phase) = (self.seconds(), self.phases[0].0);
            self.judges[0].report(Rule::Stop, now, 0, f64::INFINITY, || format!("{phase:?} after a stop"));
        }
        self.outcomes.iter().rev().find(|(i, _)| *i == id).map_or(Outcome::ShuttingDown, |(_, outcome)| *outcome)
    }

    pub fn phase(&self) -> Phase {
        self.phases[0].0
    }

    /// Returns whether something moves the arm.
    pub fn is_active(&self) -> bool {
        self.tasks.iter().any(|task| matches!(task.state, TaskState::Executing | TaskState::Cancelling))
    }

    pub fn begin_lie(&mut self) {
        let now = self.seconds();
        let text = self.lie.as_mut().map(|(arm, lie)| {
            lie.begin();
            format!("{:?} {} about arm {arm}", lie.occasion, lie.text())
        });
        self.lied_at = text.map(|text| (now, text));
    }

    /// The motors of the arm are switched.
    pub fn switch(&mut self, on: bool) {
        self.arms[0].switch(on);
        if on {
            self.written_before = self.said[0].written;
            self.place();
        }
    }

    /// Whether nothing was written since the motors came on: where the arm is, only its readings say.
    pub fn is_unplaced(&self) -> bool {
        self.arms[0].enabled && self.said[0].written == self.written_before
    }

    /// The arm is enabled where its readings say that it is.
    pub fn place(&mut self) {
        let (said, truth) = (self.said[0], &self.arms[0]);
        let (s, l) = (&self.row.arm.supervision, &self.row.arm.limits);
        // What was wrong before the motors came on cannot be seen, unless the controller itself says where it is.
        let lie = self.lie.as_ref().filter(|(arm, lie)| *arm == 0 && lie.is_told());
        let seen =
            truth.traits.reports_commanded && !lie.is_some_and(|(_, lie)| lie.of_adapter && lie.kind.is_constant());
        let hidden = lie.is_some_and(|(_, lie)| !matches!(lie.kind, Kind::Huge | Kind::Noise)) && !seen;
        let inside = |j: usize| {
            let (low, high) = (l.position_lower[j] - s.outside, l.position_upper[j] + s.outside);
            (low..=high).contains(&said.position[j])
        };
        let hidden = hidden && (0..truth.dof).all(inside);
        // Slower than a joint that counts as at rest, until the setpoint is taken.
        let crept = lie.map_or(0.0, |(_, lie)| 0.35 * lie.slow_rate());
        let extra = |j: usize| {
            let off = (said.position[j] - truth.q[j]).abs();
            let (v, a) = (truth.traits.v_max[j], l.acceleration_max[j]);
            // It is held as soon as the joint is seen to move.
            let stopped = if self.row.goal_only { f64::INFINITY } else { v * (s.lag + 0.15) + v * v / (2.0 * a) };
            // On its way there it may reach a speed from which it brakes as far again, and farther where it brakes less
            // hard than it follows a step.
            let again = 2.2f64.max(1.2 + 20.0 / a);
            let off = match hidden {
                true => (again * off).min(stopped) + 0.02f64.max(2.0 * s.accuracy),
                // An operator has seen a jump, and has accepted a small one.
                false if lie.is_some() => (again * off.min(ACCEPTED)).min(stopped),
                false => 0.0,
            };
            off + crept + truth.traits.droop[j].abs()
        };
        self.judges[0].placed(&truth.q, extra);
    }

    /// What counts as the leader's motion from now on.
    pub fn follow_begins(&mut self) {
        self.led_by_reading = match self.lie.as_ref().filter(|(arm, _)| *arm == 1) {
            None => true,
            Some((_, lie)) => {
                let certain = matches!(lie.kind, Kind::TurnLost | Kind::Huge) || matches!(lie.span, Span::Readings(_));
                !(certain || (lie.kind == Kind::Zero && !lie.has_begun()))
            }
        };
    }

    pub fn tick(&mut self) {
        let dt = 1.0 / self.rate;
        let period = Duration::from_nanos((1e9 / self.rate).round() as u64);
        self.now = self.now.after(period);
        let now = self.seconds();
        self.move_hand(dt);
        for i in 0..self.arms.len() {
            self.arms[i].silent = false;
            if self.late_states && self.arms[i].enabled {
                // Late states, of an age that the row allows.
                let most = (0.6 * self.row.arm.supervision.stale_after.as_secs_f64() * self.rate) as usize;
                let left = &mut self.late_left[i];
                *left = match *left {
                    0 if self.noise.below(80) == 0 => self.noise.below(most),
                    left => left.saturating_sub(1),
                };
                self.arms[i].silent = *left > 0;
            }
            if let Some((every, rows)) = self.recorded.as_ref().filter(|_| i == 0) {
                let row = &rows[(now / every) as usize % rows.len()];
                let count = row.len();
                self.arms[i].residual.iter_mut().enumerate().for_each(|(j, residual)| *residual = row[j % count]);
            }
            let truth = self.arms[i].observe(self.now, &mut self.noise);
            self.said[i] = match &mut self.lie {
                Some((arm, lie)) if *arm == i => lie.tell(&truth, dt, &mut self.noise),
                _ => truth,
            };
        }
        let time = TickTime { now: self.now, next: self.now.after(period), skipped: 0, late_ns: 0, woke_late_ns: 0 };
        let inbox = &mut self.inbox;
        let output = self.coordinator.tick(time, &self.said, || inbox.pop_front());
        self.commands.clone_from(&output.commands);
        self.tasks.clone_from(&output.tasks);
        self.phases.clear();
        self.phases.extend(output.arms.iter().map(|sample| (sample.phase, sample.cause)));
        for event in &output.events {
            if let Event::Request(id, outcome) = event {
                self.outcomes.push((*id, *outcome));
            }
            if self.verbose && !matches!(event, Event::Limited(..)) {
                println!("{now:8.3} {event:?}");
            }
        }
        output.retired.clear();
        self.requested(now, dt);
        let active = self.is_active();
        let own = self.arms[0].traits.reports_commanded;
        let lie = self.lie.as_ref().filter(|(arm, lie)| *arm == 0 && lie.is_told());
        let lied = lie.is_some();
        let false_own = lie.is_some_and(|(_, lie)| lie.of_adapter && lie.kind.is_constant());
        for (i, arm) in self.arms.iter_mut().enumerate() {
            let command = &self.commands[i];
            arm.take(command, &self.said[i]);
            if i == 0 && lied && command.mode == Some(ControlMode::Velocity) {
                // An adapter whose setpoints are as wrong as its readings cannot say how far off an arm is that
                // velocities stopped on its way to a false pose.
                let off = |j: usize| (self.said[i].position[j] - arm.q[j]).abs();
                match own {
                    false => self.judges[i].blind(0.0),
                    true if false_own => self.judges[i].blind((0..arm.dof).map(off).fold(0.0, f64::max)),
                    true => {}
                }
            }
            let written = arm.written.is_some_and(|(at, ..)| at == command.at);
            self.judges[i].command(now, command, written, &arm.q);
            arm.advance(dt);
            if arm.enabled {
                self.judges[i].joints(now, &arm.q, arm.at_rest(), active && i == 0);
            }
        }
        if self.verbose {
            self.show(now);
        }
    }

    /// Adds what streams ask for now.
    fn requested(&mut self, now: f64, dt: f64) {
        if let Some((v, at, since)) = &mut self.velocities
            && self.acts.iter().zip(&self.tasks).any(|(a, t)| *a == Act::Velocity && t.state == TaskState::Executing)
            && now - *since < 0.2 + 2.0 * dt
        {
            for j in 0..self.row.arm.dof {
                at[j] += v[j] * dt;
                self.judges[0].request(j, at[j], v[j]);
            }
        }
        let follows =
            self.acts.iter().zip(&self.tasks).any(|(a, t)| *a == Act::Follow && t.state == TaskState::Executing);
        if follows && self.arms.len() > 1 {
            for j in 0..self.row.arm.dof {
                let (low, high) = (self.row.arm.limits.position_lower[j], self.row.arm.limits.position_upper[j]);
                let truth = self.arms[1].q[j];
                self.judges[0].request(j, truth, 1.0);
                let said = self.said[1].position[j];
                if self.led_by_reading && said.is_finite() && (said - truth).abs() < 3.2 {
                    self.judges[0].request(j, said.clamp(low, high), 1.0);
                }
            }
        }
    }

    fn move_hand(&mut self, dt: f64) {
        let Some(hand) = self.hand else { return };
        self.hand_time += dt;
        let Some(leader) = self.arms.get_mut(1) else { return };
        for j in 0..leader.dof {
            let v = hand.speed * (2.5 * self.hand_time + hand.phase + j as f64).sin();
            leader.v[j] = v;
            leader.q[j] += v * dt;
        }
    }

    fn show(&self, now: f64) {
        let joint = self.lie.as_ref().map_or(0, |(_, lie)| lie.first_joint());
        let (c, arm, said) = (&self.commands[0], &self.arms[0], &self.said[0]);
        println!(
            "{now:8.3} {:?} {:?} true {:.4} said {:.4} v {:.3} command {:?} {:.4} start {} stop {} seq {} written {} lie {}",
            self.phases[0].0,
            self.phases[0].1,
            arm.q[joint],
            said.position[joint],
            said.velocity[joint],
            c.mode,
            c.values[joint],
            c.start_seq,
            c.stop_seq,
            c.seq,
            said.written,
            self.lie.as_ref().is_some_and(|(_, lie)| lie.is_told()),
        );
    }

    pub fn run_for(&mut self, seconds: f64) {
        (0..(seconds * self.rate).ceil() as u64).for_each(|_| self.tick());
    }

    pub fn run_until(&mut self, limit: f64, mut done: impl FnMut(&Self) -> bool) -> bool {
        for _ in 0..(limit * self.rate).ceil() as u64 {
            if done(self) {
                return true;
            }
            self.tick();
        }
        done(self)
    }

    /// Returns what was found, with what this trial is.
    pub fn found(mut self) -> Vec<Violation> {
        let truth = self.lied_at.as_ref().map_or(String::new(), |(at, text)| format!(" since {at:.3} s {text}"));
        let what = format!("{:?} at {} Hz,{truth}", self.act, self.rate);
        let all = self.judges.iter_mut().flat_map(|judge| std::mem::take(&mut judge.found));
        all.map(|v| Violation { text: format!("{} ({what})", v.text), ..v }).collect()
    }
}

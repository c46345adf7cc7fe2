//! What is asked of an arm in a trial: enabled, moved by every type of task, stopped, reset, disabled, in an order
//! drawn from the seed; when the lie begins; and what an honest arm must make of it.

use std::panic::{AssertUnwindSafe, catch_unwind};

use dimos::control::request::{Goal, Motion, Request};
use dimos::control::tasks::chunk::curve;
use dimos::joint::joints_of;
use dimos::telemetry::{Cause, Outcome, Phase, TaskState};
use dimos::trajectory::Spline;
use glamx::{DAffine3, DQuat};

use super::lies::Occasion;
use super::motion_judge::{Rule, Violation};
use super::rig::motion;
use super::trial::{ACCEPTED, Act, Hand, Trial};

/// Runs the trial of a seed and returns the rules that it broke.
pub fn trial(seed: u64, honest: bool, verbose: bool) -> Vec<Violation> {
    trial_with(seed, honest, verbose, |_| {})
}

pub fn trial_with(seed: u64, honest: bool, verbose: bool, change: impl FnOnce(&mut Trial)) -> Vec<Violation> {
    let run = catch_unwind(AssertUnwindSafe(|| {
        let mut trial = Trial::new(seed, honest);
        trial.verbose = verbose;
        change(&mut trial);
        trial.script();
        trial.found()
    }));
    run.unwrap_or_else(|panic| {
        let text = panic.downcast_ref::<String>().cloned();
        let text = text.or(panic.downcast_ref::<&str>().map(|s| (*s).to_owned())).unwrap_or_default();
        vec![Violation { rule: Rule::Sound, at: 0.0, arm: 0, joint: 0, excess: f64::INFINITY, text }]
    })
}

/// A joint may rest this far from its setpoint after its arm's own stop [rad].
const STOPPED_SHORT: f64 = 0.01;

impl Trial {
    fn script(&mut self) {
        let occasion = self.lie.as_ref().map(|(_, lie)| lie.occasion);
        let is = |wanted: Occasion| occasion == Some(wanted);
        self.run_for(0.03);
        if is(Occasion::Start) {
            self.begin_lie();
        }
        self.wait(0.05, 0.15);
        if is(Occasion::Disabled) {
            self.begin_lie();
            self.wait(0.05, 0.4);
        }
        self.enable(is(Occasion::Enabling));
        if self.random.below(2) == 0 && !is(Occasion::Motion) {
            self.any_motion(false);
        }
        match occasion {
            Some(Occasion::Idle) => {
                self.wait(0.05, 0.2);
                self.begin_lie();
                self.wait(0.3, 0.8);
            }
            Some(Occasion::Motion) => self.motion(self.act, Some(true)),
            Some(Occasion::Stopping) => self.motion(self.act, Some(false)),
            Some(Occasion::Held) => {
                if self.random.below(2) == 0 {
                    self.motion(self.act, Some(false));
                }
                self.stop();
                self.begin_lie();
                self.wait(0.2, 0.7);
                self.stop();
            }
            _ => self.motion(self.act, None),
        }
        for _ in 0..1 + self.random.below(2) {
            match self.random.below(5) {
                0 => self.wait(0.1, 0.4),
                1 => self.stop(),
                2 => self.disable(),
                3 => self.any_motion(true),
                _ => {}
            }
            if self.phase() != Phase::Ready {
                if self.random.below(2) == 0 {
                    self.stop();
                }
                self.wait(0.05, 0.3);
                let seen = self.phases[0].1;
                let mismatch =
                    matches!(seen, Cause::StartMismatch(..) | Cause::PositionJump(..) | Cause::ReadingInconsistent(..));
                self.ask(Request::Reset { arm: 0 });
                self.wait(0.02, 0.2);
                if mismatch {
                    // An operator has seen both poses, and takes the one that is read. The arm is held once it is seen
                    // to move, and brakes from the speed that it has by then.
                    for j in 0..self.row.arm.dof {
                        let (said, truth) = (self.said[0].position[j], self.arms[0].q[j]);
                        let v = self.row.arm.limits.velocity_max[j];
                        for past in [-1.0, 1.0] {
                            let to = said + past * ((said - truth).abs() + 0.02);
                            self.judges[0].request(j, to, v);
                        }
                    }
                }
                self.enable(false);
            }
            self.any_motion(false);
        }
        self.stop();
        self.run_for(0.3);
    }

    fn wait(&mut self, least: f64, most: f64) {
        let seconds = self.random.between(least, most);
        self.run_for(seconds);
    }

    fn some_ticks(&mut self, most: usize) {
        let ticks = self.random.below(most);
        (0..ticks).for_each(|_| self.tick());
    }

    fn enable(&mut self, lie: bool) {
        if !self.arms[0].enabled {
            self.switch(true);
            self.wait(0.02, 0.08);
            self.run_until(0.1, |trial| trial.said[0].enabled);
        } else if self.is_unplaced() {
            self.place();
        }
        if lie {
            let s = &self.row.arm.supervision;
            let unseen = 0.02f64.max(2.0 * s.accuracy).max(s.accuracy + s.droop);
            self.judges[0].widen(unseen);
            self.begin_lie();
            self.some_ticks(4);
        } else if self.lied_at.is_some() {
            // Its own stop may have met it short of its setpoint: that much looks like a lie.
            let (said, truth) = (&self.said[0].position, &self.arms[0].q);
            let off = said.iter().zip(truth).fold(0.0, |most: f64, (said, q)| most.max((said - q).abs()));
            // Or an operator has seen that much at a reset, and has accepted it.
            let seen = if off <= ACCEPTED { 2.2 * off } else { 0.0 };
            self.judges[0].widen(STOPPED_SHORT.max(seen));
        }
        let outcome = self.ask(Request::Enabled { arm: 0, outside: false });
        if lie {
            // Until then, a step that looks like motion is where the arm has been moved. On its way there it may reach
            // a speed from which it brakes as far again.
            let (said, truth) = (&self.said[0].position, &self.arms[0].q);
            let step = said.iter().zip(truth).fold(0.0, |most: f64, (said, q)| most.max((said - q).abs()));
            self.judges[0].widen((2.2 * step).min(0.2));
        }
        self.run_until(0.5, |trial| trial.phase() == Phase::Ready);
        self.run_for(0.05);
        self.is_ready(&format!("enabled ({outcome:?})"));
    }

    /// An honest arm is ready now.
    fn is_ready(&mut self, when: &str) {
        if self.lie.is_none() && self.phase() != Phase::Ready {
            let (now, (phase, cause)) = (self.seconds(), self.phases[0]);
            self.judges[0].report(Rule::Honest, now, 0, 1.0, || format!("{when}: {phase:?}, {cause:?}"));
        }
    }

    fn stop(&mut self) {
        let arm = (self.random.below(2) == 0).then_some(0);
        self.ask(Request::Stop { arm });
        // Longer than any stop takes.
        let l = &self.row.arm.limits;
        let braking = l.velocity_max.iter().zip(&l.acceleration_max).map(|(v, a)| v / a).fold(0.0, f64::max);
        self.run_for(0.6 + braking);
    }

    fn disable(&mut self) {
        self.ask(Request::PrepareDisable { arm: 0 });
        self.run_until(2.0, |trial| trial.arms[0].at_rest() && trial.commands[0].mode.is_none());
        self.switch(false);
        self.wait(0.05, 0.2);
    }

    fn any_motion(&mut self, cut_short: bool) {
        let acts = [Act::Trajectory, Act::Servo, Act::Chunk, Act::Velocity];
        let act = acts[self.random.below(if self.row.has_velocity() { 4 } else { 3 })];
        self.motion(act, None);
        if cut_short {
            self.ask(Request::Cancel { task: None });
            self.run_for(0.1);
        }
    }

    /// A motion of a task. `event`: the lie begins during it, or (false) it is stopped and the lie begins then.
    fn motion(&mut self, act: Act, event: Option<bool>) {
        let Some(task) = self.task(act) else { return };
        let dof = self.row.arm.dof;
        let seconds = self.random.between(0.5, 1.0);
        let event_at = event.map(|_| self.random.between(0.05, 0.8) * seconds);
        let l = self.row.arm.limits.clone();
        let here: Vec<f64> = match self.commands[0].mode {
            Some(mode) if mode.is_position() => self.commands[0].values[..dof].to_vec(),
            _ => self.said[0].position[..dof].to_vec(),
        };
        let known = |j: usize| here[j] > l.position_lower[j] - 0.3 && here[j] < l.position_upper[j] + 0.3;
        if !(0..dof).all(known) {
            // No client plans from there.
            return self.run_for(0.2);
        }
        // An end effector's pose is near: joints go there without a detour.
        let far = if matches!(act, Act::Pose | Act::Twist) { 0.3 } else { 1.0 };
        let part = self.random.between(0.15, 0.85);
        let inside = |j: usize, q: f64| q.clamp(l.position_lower[j] + 0.02, l.position_upper[j] - 0.02);
        // A rest-to-rest motion of this time, within this part of the limits.
        let most = |j: usize| {
            (part * l.velocity_max[j] * seconds / 1.9)
                .min(part * l.acceleration_max[j] * seconds * seconds / 6.0)
                .min(0.9)
        };
        let away: Vec<f64> = (0..dof).map(|j| far * most(j) * self.random.between(-1.0, 1.0)).collect();
        let goal: Vec<f64> = (0..dof).map(|j| inside(j, here[j] + away[j])).collect();
        let peak = |j: usize| 1.9 * (goal[j] - here[j]).abs() / seconds;
        let mut accepted = Vec::new();
        let begun = self.seconds();
        match act {
            Act::Trajectory => {
                let joints: Vec<u16> = (0..dof as u16).collect();
                let motion = motion(self.next_motion(), &joints, &[(0.0, &here), (seconds, &goal)]);
                for j in 0..dof {
                    self.judges[0].request(j, here[j], peak(j));
                    self.judges[0].request(j, goal[j], peak(j));
                }
                accepted.push(self.ask(Request::Execute { task, motion }));
            }
            Act::Chunk => {
                let names: Vec<String> = (0..dof).map(|j| format!("j{j}")).collect();
                let points = (0..=(seconds * 30.0) as usize).map(|k| {
                    let part = 0.5 - 0.5 * (std::f64::consts::PI * (k as f64 / 30.0 / seconds)).cos();
                    (0..dof).map(|j| here[j] + part * 0.5 * (goal[j] - here[j])).collect()
                });
                let points: Vec<Vec<f64>> = points.collect();
                if points.iter().flatten().any(|q| !q.is_finite()) {
                    return;
                }
                let spline = Spline::new(&curve(&names, &points, 1.0 / 30.0, &l)).unwrap();
                let motion =
                    Box::new(Motion { id: self.next_motion(), joints: (0..dof as u16).collect(), spline, until: None });
                for j in 0..dof {
                    self.judges[0].request(j, here[j], peak(j));
                    self.judges[0].request(j, goal[j], peak(j));
                }
                let start = self.now;
                accepted.push(self.ask(Request::Chunk { task, start, motion }));
            }
            Act::Follow => {
                self.follow_begins();
                self.hand = Some(Hand { speed: self.random.between(0.05, 0.4), phase: self.random.between(0.0, 6.0) });
                accepted.push(self.ask(Request::Start { task }));
            }
            _ => {}
        }
        let (pose, twist) = self.cartesian(&here, &goal, seconds);
        let every = 1 + self.random.below((0.03 * self.rate) as usize) as u64;
        let ticks = (seconds * self.rate) as u64;
        let mut lied = false;
        for k in 0..ticks {
            let t = self.seconds() - begun;
            let (held, refused) = (self.phase() == Phase::Held, accepted.iter().any(|o| *o != Outcome::Accepted));
            if event_at.is_some_and(|at| t >= at) && !lied {
                lied = true;
                if event == Some(false) {
                    self.send(Request::Stop { arm: None });
                    self.some_ticks(5);
                }
                self.begin_lie();
                if event == Some(false) {
                    self.run_for(0.7);
                    break;
                }
            }
            if held || refused {
                self.run_for(0.2);
                break;
            }
            if k % every == 0 && !matches!(act, Act::Trajectory | Act::Chunk | Act::Follow) {
                let t = t / seconds;
                let smooth = t * t * (3.0 - 2.0 * t);
                let request = match act {
                    Act::Servo => {
                        let target: Vec<f64> = (0..dof).map(|j| here[j] + smooth * (goal[j] - here[j])).collect();
                        (0..dof).for_each(|j| self.judges[0].request(j, target[j], peak(j)));
                        Request::Servo { task, target: joints_of(&target) }
                    }
                    Act::Velocity => {
                        // There, and back.
                        let v: Vec<f64> = away.iter().map(|d| d / seconds * if t < 0.6 { 1.0 } else { -1.0 }).collect();
                        let now = self.seconds();
                        let at = self.velocities.filter(|_| k > 0).map_or(joints_of(&self.arms[0].q), |(_, at, _)| at);
                        self.velocities = Some((joints_of(&v), at, now));
                        Request::Velocity { task, target: joints_of(&v) }
                    }
                    Act::Pose => {
                        self.detour(&here, &goal);
                        Request::CartesianTarget { task, goal: pose }
                    }
                    _ => {
                        self.detour(&here, &goal);
                        Request::CartesianTarget { task, goal: twist }
                    }
                };
                accepted.push(self.ask(request));
            } else {
                self.tick();
            }
        }
        self.hand = None;
        let ends = self.random.below(3);
        if ends > 0 && act != Act::Trajectory {
            self.ask(Request::Cancel { task: Some(task) });
        }
        let patience = if act == Act::Follow && ends == 0 { 0.2 } else { 3.0 };
        self.run_until(patience, |trial| !trial.is_active());
        self.velocities = None;
        if act == Act::Follow && ends == 0 {
            self.ask(Request::Cancel { task: None });
            self.run_until(1.0, |trial| !trial.is_active());
        }
        // Late enough for its end to be judged.
        self.run_for(0.05);
        self.went_well(act, &accepted, event);
    }

    /// The motion of an honest arm ends as it should.
    fn went_well(&mut self, act: Act, accepted: &[Outcome], event: Option<bool>) {
        if self.lie.is_some() || event.is_some() {
            return;
        }
        self.is_ready(&format!("after {act:?}"));
        let task = self.task(act).map(|task| self.tasks[usize::from(task)]).unwrap_or_default();
        let refused = accepted.iter().find(|outcome| **outcome != Outcome::Accepted);
        let ended = act != Act::Trajectory || task.state == TaskState::Completed;
        if refused.is_some() || !ended {
            let (now, phase) = (self.seconds(), self.phases[0]);
            self.judges[0].report(Rule::Honest, now, 0, 1.0, || {
                format!("{act:?}: {refused:?}, {:?} {:?}, {phase:?}", task.state, task.reason)
            });
        }
    }

    /// Joints on their way to a pose that is near: on the straight line of its frame they are not on that of the
    /// joints.
    fn detour(&mut self, here: &[f64], goal: &[f64]) {
        for (j, (from, to)) in here.iter().zip(goal).enumerate() {
            self.judges[0].request(j, from.min(*to) - 0.25, 0.5);
            self.judges[0].request(j, from.max(*to) + 0.25, 0.5);
        }
    }

    fn next_motion(&mut self) -> u64 {
        self.random.bits() >> 1
    }

    /// A pose at the goal, and a twist that leads there at first.
    fn cartesian(&self, here: &[f64], goal: &[f64], seconds: f64) -> (Goal, Goal) {
        let still = Goal::Twist { linear: [0.0; 3], angular: [0.0; 3], tool: false };
        let Some(robot) = self.row.robot.as_ref().filter(|_| self.act == Act::Pose || self.act == Act::Twist) else {
            return (still, still);
        };
        let at = |q: &[f64]| -> DAffine3 {
            let mut frames = robot.kinematics.frames();
            robot.kinematics.forward(q, &mut frames);
            robot.kinematics.link_frame(robot.link, &frames)
        };
        let near: Vec<f64> = here.iter().zip(goal).map(|(a, b)| a + 1e-4 * (b - a)).collect();
        let (from, next, to) = (at(here), at(&near), at(goal));
        let linear = (next.translation - from.translation) / (1e-4 * seconds);
        let turn = DQuat::from_mat3(&(next.matrix3 * from.matrix3.transpose()));
        let angular = turn.to_scaled_axis() / (1e-4 * seconds);
        let slower = (0.15 / linear.length().max(1e-9)).min(0.6 / angular.length().max(1e-9)).min(1.0);
        let pose = Goal::Pose {
            position: to.translation.to_array(),
            orientation: DQuat::from_mat3(&to.matrix3).normalize().to_array(),
        };
        let (linear, angular) = ((linear * slower).to_array(), (angular * slower).to_array());
        (pose, Goal::Twist { linear, angular, tool: false })
    }
}

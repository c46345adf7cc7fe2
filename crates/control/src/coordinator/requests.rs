//! How the coordinator handles requests, each with one outcome.

use super::Coordinator;
use crate::arm_control::ArmControl;
use crate::request::{Envelope, Motion, Request};
use crate::speed_override::SpeedOverride;
use crate::task::{Task, Tick};
use crate::task_body::Target;
use dimos_core::arm::GripperUnit;
use dimos_core::clock::Mono;
use dimos_core::telemetry::{Cause, Event, Interruption, LedBy, Origin, Outcome, Reason, TaskState};

impl Coordinator {
    /// Handles a request and reports its outcome.
    pub(super) fn handle(&mut self, now: Mono, envelope: Envelope) {
        let origin = envelope.origin;
        let outcome = match envelope.request {
            Request::Shutdown => {
                self.shutting_down = true;
                for arm in 0..self.arms.len() as u16 {
                    self.with_arm(arm, |a| {
                        if a.failsafe.led_by().is_some() {
                            a.prepare_disable(now);
                        }
                        Outcome::Accepted
                    });
                }
                self.cancel(None, Reason::Cancelled)
            }
            Request::Stop { arm } => self.stop(arm, now),
            Request::Cancel { task } => self.cancel(task, Reason::Cancelled),
            Request::WayBlocked { task, motion, in_time } => self.way_blocked(now, (task, motion), in_time),
            Request::Execute { motion, .. } | Request::Chunk { motion, .. } if self.shutting_down => {
                self.output.retired.push(motion);
                Outcome::ShuttingDown
            }
            _ if self.shutting_down => Outcome::ShuttingDown,
            Request::Execute { task, motion } => self.execute(now, task, motion, origin),
            Request::Servo { task, target } => self.offer(now, task, &Target::Positions(target), origin),
            Request::Velocity { task, target } => self.offer(now, task, &Target::Velocities(target), origin),
            Request::Chunk { task, start, motion } => {
                let outcome = self.offer(now, task, &Target::Chunk(&motion, start), origin);
                self.output.retired.push(motion);
                outcome
            }
            Request::CartesianTarget { task, goal } => self.offer(now, task, &Target::EndEffector(goal), origin),
            Request::Start { task } => self.offer(now, task, &Target::Start, origin),
            Request::Tool { task, tool } => match self.tasks.get_mut(task as usize) {
                Some(t) => t.set_tool(&tool).err().unwrap_or(Outcome::Accepted),
                None => Outcome::WrongTask(task),
            },
            Request::ArmTool { arm, tool } => self.with_arm(arm, |a| {
                a.set_tool(&tool);
                Outcome::Accepted
            }),
            Request::Reset { arm } => self.with_arm(arm, |a| a.reset(arm, now)),
            Request::Enabled { arm, outside } => self.with_arm(arm, |a| a.activate(arm, outside, now)),
            Request::PrepareDisable { arm } => {
                let outcome = self.with_arm(arm, |a| {
                    a.prepare_disable(now);
                    Outcome::Accepted
                });
                self.interrupt(arm.into(), Interruption::Disabled);
                self.end_tasks_of_held_arms();
                outcome
            }
            Request::Lead { by: LedBy::Controller, .. } if self.speed.paused => Outcome::Paused,
            Request::Lead { arm, by } => match self.task_of_arm(arm) {
                Some(task) => Outcome::AlreadyExecuting(task),
                None => match self.still_valid(arm, origin) {
                    Ok(()) => {
                        let outcome = self.with_arm(arm, |a| a.lead(by, arm, now));
                        if outcome == Outcome::Accepted {
                            self.commanded_by(arm, origin.unwrap_or_default().client);
                        }
                        outcome
                    }
                    Err(superseded) => superseded,
                },
            },
            Request::Speed { fraction } => self.change_speed(|speed| speed.set(fraction)),
            Request::EndNative { arm } => self.end_native(arm, now),
            Request::Pause { on } => {
                // The controller of an arm knows no pause: its motion ends.
                for arm in 0..if on { self.arms.len() as u16 } else { 0 } {
                    self.end_native(arm, now);
                }
                self.change_speed(|speed| speed.paused = on)
            }
            Request::Gripper { arm, opening, force, speed } => self.gripper(arm, (opening, force, speed), origin),
            Request::LeaseTaken { arm, client } => {
                self.commanded_by(arm, client);
                Outcome::Accepted
            }
            Request::LeaseEnded { arm, client } => self.lease_ended(arm, client),
        };
        self.output.report(Event::Request(envelope.id, outcome));
    }

    /// Changes an arm and reports a change of its phase.
    fn with_arm(&mut self, arm: u16, act: impl FnOnce(&mut ArmControl) -> Outcome) -> Outcome {
        let Some(a) = self.arms.get_mut(arm as usize) else { return Outcome::StartStateUnavailable(arm) };
        let before = a.failsafe.phase();
        let outcome = act(a);
        if a.failsafe.phase() != before {
            self.output.report(Event::Arm(arm, a.failsafe.phase(), a.failsafe.cause()));
        }
        outcome
    }

    /// Returns the first active task that moves a joint of an arm.
    fn task_of_arm(&self, arm: u16) -> Option<u16> {
        self.tasks.iter().position(|task| task.is_active() && self.moves(task, arm)).map(|task| task as u16)
    }

    /// Returns whether a task moves a joint of an arm.
    pub(super) fn moves(&self, task: &Task, arm: u16) -> bool {
        task.moving_joints().iter().any(|joint| self.arm_of.get(usize::from(*joint)) == Some(&arm))
    }

    /// Ends the motion of an arm's own controller.
    fn end_native(&mut self, arm: u16, now: Mono) -> Outcome {
        self.with_arm(arm, |a| if a.end_native(now) { Outcome::Cancelled } else { Outcome::AlreadyStopped })
    }

    fn stop(&mut self, arm: Option<u16>, now: Mono) -> Outcome {
        if let Some(arm) = arm.filter(|&arm| arm as usize >= self.arms.len()) {
            return Outcome::StartStateUnavailable(arm);
        }
        for i in (0..self.arms.len()).filter(|&i| arm.is_none_or(|arm| arm as usize == i)) {
            if let Some(a) = self.arms.get_mut(i) {
                a.stop_again();
            }
            self.hold(i, Cause::Operator, now);
            self.interrupt(i, Interruption::Stopped);
        }
        Outcome::Accepted
    }

    fn change_speed(&mut self, change: impl FnOnce(&mut SpeedOverride)) -> Outcome {
        let before = self.speed;
        change(&mut self.speed);
        if self.speed != before {
            self.output.report(Event::Speed(self.speed.fraction, self.speed.paused));
        }
        Outcome::Accepted
    }

    /// Ends a motion whose way is blocked: along its path, or by holding its arms.
    fn way_blocked(&mut self, now: Mono, (task, motion): (u16, u64), in_time: bool) -> Outcome {
        let Some(moving) = self.tasks.get(usize::from(task)) else { return Outcome::WrongTask(task) };
        if moving.motion_id() != Some(motion) {
            return Outcome::AlreadyStopped;
        }
        if in_time {
            return self.cancel(Some(task), Reason::WayBlocked);
        }
        // All of them before the task ends with the first.
        for arm in 0..self.arms.len() {
            if self.tasks.get(usize::from(task)).is_some_and(|task| self.moves(task, arm as u16)) {
                self.latch(arm, Cause::WayBlocked, now);
            }
        }
        self.end_tasks_of_held_arms();
        Outcome::Accepted
    }

    fn cancel(&mut self, which: Option<u16>, reason: Reason) -> Outcome {
        if let Some(task) = which.filter(|&t| t as usize >= self.tasks.len()) {
            return Outcome::WrongTask(task);
        }
        let mut outcome = Outcome::AlreadyStopped;
        for t in 0..self.tasks.len() {
            if which.is_some_and(|w| w as usize != t) {
                continue;
            }
            if let Some(task) = self.tasks.get_mut(t)
                && let Some(motion) = task.cancel(reason)
            {
                self.output.retired.extend(motion);
                outcome = Outcome::Cancelled;
                let event = Event::Task(t as u16, task.state, task.reason);
                self.output.report(event);
            }
        }
        outcome
    }

    fn execute(&mut self, now: Mono, task: u16, motion: Box<Motion>, origin: Option<Origin>) -> Outcome {
        let outcome = self.offer(now, task, &Target::Trajectory(&motion), origin);
        let done = match self.tasks.get_mut(task as usize) {
            Some(t) if outcome == Outcome::Accepted => t.keep(motion),
            _ => Some(motion),
        };
        self.output.retired.extend(done);
        outcome
    }

    /// Offers a target to a task.
    pub(super) fn offer(&mut self, now: Mono, task: u16, target: &Target<'_>, origin: Option<Origin>) -> Outcome {
        self.try_offer(now, task, target, origin).err().unwrap_or(Outcome::Accepted)
    }

    fn try_offer(&mut self, now: Mono, task: u16, target: &Target<'_>, origin: Option<Origin>) -> Result<(), Outcome> {
        let t = self.tasks.get(task as usize).ok_or(Outcome::WrongTask(task))?;
        t.check(target)?;
        let joints = match target {
            Target::Trajectory(motion) => &motion.joints,
            _ => &t.joints,
        };
        self.admit(joints)?;
        let valid = joints.iter().try_for_each(|joint| match self.arm_of.get(usize::from(*joint)) {
            Some(arm) => self.still_valid(*arm, origin),
            None => Ok(()),
        });
        let tick = Tick { now, dt: self.step, speed: self.speed, views: &self.joints, sensed: &self.sensed };
        let t = self.tasks.get_mut(task as usize).ok_or(Outcome::WrongTask(task))?;
        // That the arm is elsewhere says more.
        t.check_start(&tick, target)?;
        valid?;
        let begins = t.accept(&tick, target)?;
        let client = origin.unwrap_or_default().client;
        t.client = client;
        if begins {
            self.output.report(Event::Task(task, TaskState::Executing, Reason::None));
        }
        for arm in 0..self.arms.len() as u16 {
            let of_arm = |joint: &u16| self.arm_of.get(usize::from(*joint)) == Some(&arm);
            let moved = match target {
                Target::Trajectory(motion) => motion.joints.iter().any(of_arm),
                _ => self.tasks.get(usize::from(task)).is_some_and(|task| task.joints.iter().any(of_arm)),
            };
            if moved {
                self.commanded_by(arm, client);
            }
        }
        Ok(())
    }

    fn admit(&self, joints: &[u16]) -> Result<(), Outcome> {
        for &joint in joints {
            let arm = self.arm_of.get(joint as usize).copied().unwrap_or(u16::MAX);
            let Some(a) = self.arms.get(arm as usize) else { return Err(Outcome::StartStateUnavailable(arm)) };
            a.failsafe.admits(arm)?;
            if !a.freshness().fresh {
                return Err(Outcome::StartStateUnavailable(arm));
            }
        }
        Ok(())
    }

    fn gripper(
        &mut self,
        arm: u16,
        (opening, force, speed): (f64, Option<f64>, Option<f64>),
        origin: Option<Origin>,
    ) -> Outcome {
        let valid = self.still_valid(arm, origin);
        let Some(a) = self.arms.get_mut(arm as usize) else { return Outcome::StartStateUnavailable(arm) };
        if !a.config().gripper {
            return Outcome::NoGripper(arm);
        }
        let info = a.config().gripper_info;
        // The angle of a rotary jaw may be negative.
        if !opening.is_finite() || (info.unit == GripperUnit::Meters && opening < 0.0) {
            return Outcome::GripperOutOfLimits(arm, opening);
        }
        match (force, info.force_range) {
            (None, _) => {}
            (Some(_), None) => return Outcome::NoGripperForce(arm),
            (Some(force), Some((least, most))) if (least..=most).contains(&force) => {}
            (Some(force), Some(_)) => return Outcome::GripperForceOutOfLimits(arm, force),
        }
        if speed.is_some_and(|speed| !(info.has_speed && speed > 0.0 && speed <= 1.0)) {
            return Outcome::NoGripperSpeed(arm);
        }
        match a.failsafe.admits(arm).and(valid) {
            Ok(()) => {
                a.set_gripper(opening, force, speed);
                self.commanded_by(arm, origin.unwrap_or_default().client);
                Outcome::Accepted
            }
            Err(outcome) => outcome,
        }
    }
}

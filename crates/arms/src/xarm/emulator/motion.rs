//! Requests that move the arm: planned moves of mode 0, setpoints of mode 1, velocities of mode 4. Fields that several
//! registers share are read by [`MoveRequest`].

use std::time::Duration;

use super::super::model::VELOCITY;
use super::controlled_arm::{ControlledArm, JOINT_LIMIT, Refusal};
use super::controller::{Controller, state};
use super::move_request::{Frame, MoveRequest, Orientation, Target};
use super::queue::{Goal, Move, QUEUE};
use super::registers::{BAD_PARAMETER, NO_SOLUTION, QUEUE_FULL};
use super::wire::{number, numbers};
use Refusal::{Error, NotNow, Warning};
use dimos_hardware::sim::reach::Chain;

/// Acceleration of a move that has none [rad/s²].
const ACCELERATION: f64 = 20.0;
/// Longest pause in the queue [s].
const LONGEST_PAUSE: f32 = 86_400.0;
/// Result of a check: no solution of the inverse kinematics.
const UNREACHABLE: u8 = 40;

/// Returns whether a register moves the arm.
pub(super) fn is_motion(register: u8) -> bool {
    matches!(register, 21..=30 | 81..=83 | 92 | 93)
}

/// Returns the mode in which a register moves the arm.
fn mode_of(register: u8) -> u8 {
    match register {
        29 | 30 | 93 => 1,
        81 => 4,
        82 => 5,
        _ => 0,
    }
}

impl<A: ControlledArm> Controller<A> {
    pub(super) fn motion(&mut self, register: u8, data: &[u8], out: &mut Vec<u8>) -> Result<(), Refusal> {
        if !self.arm.is_ready() || self.state != state::STANDING || self.mode != mode_of(register) {
            return Err(NotNow);
        }
        match register {
            29 => {
                let target = self.checked(numbers::<7>(data).ok_or(Warning(BAD_PARAMETER))?.map(f64::from))?;
                self.servo(&target)
            }
            30 | 93 => {
                let request = MoveRequest::servo(register, data).ok_or(Warning(BAD_PARAMETER))?;
                let target = self.resolve(&request, self.judge.last_setpoint().unwrap_or(self.seven()))?;
                let target = self.checked(target)?;
                self.servo(&target)
            }
            81 => {
                let speeds = numbers::<7>(data).ok_or(Warning(BAD_PARAMETER))?;
                if !speeds.iter().all(|speed| speed.is_finite()) {
                    return Err(Warning(BAD_PARAMETER));
                }
                if let Some(code) = self.too_fast(&speeds.map(f64::from)) {
                    return Err(Error(code));
                }
                let duration = number(data, 29, 0).filter(|duration| *duration > 0.0);
                let duration = duration.map(|duration| Duration::from_secs_f32(duration.min(3600.0)));
                self.judge.turns_at(&speeds.map(f64::from));
                self.arm.keep_velocity(&speeds.map(f64::from), duration)
            }
            26 => {
                let time = number(data, 0, 0).filter(|time| (0.0..=LONGEST_PAUSE).contains(time));
                let time = Duration::from_secs_f32(time.ok_or(Warning(BAD_PARAMETER))?);
                self.enqueue(Move { goal: Goal::Pause(time), speed: 0.0, acceleration: 0.0 }, out)
            }
            // Circles and Cartesian velocities: not emulated.
            27 | 82 => Err(NotNow),
            _ => {
                let request = MoveRequest::planned(register, data).ok_or(Warning(BAD_PARAMETER))?;
                self.plan(&request, data, out)
            }
        }
    }

    /// Executes a setpoint, unless it asks for more than the joints can do.
    fn servo(&mut self, target: &[f64; 7]) -> Result<(), Refusal> {
        let (now, at) = (self.arm.now(), self.seven());
        if self.chain.is_some() {
            let reduced = self.settings.reduced.active.map(|limits| f64::from(limits.joint_speed));
            let top = reduced.map_or(VELOCITY, |reduced| reduced.min(VELOCITY));
            self.judge.setpoint(target, &at, top, now).map_err(Error)?;
        }
        self.arm.follow(target)
    }

    fn plan(&mut self, request: &MoveRequest, data: &[u8], out: &mut Vec<u8>) -> Result<(), Refusal> {
        if request.checks_only {
            let result = match self.goal(request, data) {
                Ok(_) => 0,
                Err(Error(code)) => code,
                Err(Warning(NO_SOLUTION)) => UNREACHABLE,
                Err(refusal) => return Err(refusal),
            };
            self.put_queue(out);
            out.push(result);
            return Ok(());
        }
        let goal = self.goal(request, data)?;
        let speed = f64::from(request.speed);
        // In reduced mode the box plans slower moves (our choice).
        let reduced = self.settings.reduced.active;
        let speed = match (&request.target, reduced) {
            _ if speed.is_nan() => speed,
            (Target::Joints(_) | Target::JointChange(_), Some(limits)) => speed.min(limits.joint_speed.into()),
            (_, Some(limits)) => speed.min(limits.line_speed.into()),
            _ => speed,
        };
        let speed = match (&request.target, &goal) {
            _ if speed.is_nan() => 0.0,
            (Target::Joints(_) | Target::JointChange(_), _) => speed,
            (_, Goal::Line(line)) => line.joint_speed(speed / 1000.0),
            // The tool's way is not straight here: the joints go together (our choice).
            _ => (speed / 1000.0).clamp(0.01, 1.0) * VELOCITY,
        };
        let acceleration = Some(f64::from(request.acceleration)).filter(|value| *value > 0.0);
        let acceleration = match request.target {
            Target::Joints(_) | Target::JointChange(_) => acceleration.unwrap_or(ACCELERATION),
            Target::Pose(..) => ACCELERATION,
        };
        self.enqueue(Move { goal, speed, acceleration }, out)?;
        if request.has_result {
            out.push(0);
        }
        Ok(())
    }

    /// Returns where a planned move ends. A request that is repeated until its outcome is known keeps the goal that it
    /// had at first: the arm's positions are noisy.
    fn goal(&mut self, request: &MoveRequest, data: &[u8]) -> Result<Goal, Refusal> {
        if let Some(goal) = self.repeated(data) {
            return Ok(goal);
        }
        let from = self.planned_end();
        let goal = match self.chain {
            None if matches!(request.target, Target::Pose(..)) => {
                let way = self.arm.line(&from, request).ok_or(NotNow)?;
                for point in way.points() {
                    self.checked(*point)?;
                }
                Goal::Line(way)
            }
            _ => {
                let target = self.resolve(request, from)?;
                Goal::Joints(self.checked(target)?)
            }
        };
        self.keep_goal(data, &goal);
        Ok(goal)
    }

    /// Returns the joints [rad] of a target, from joints at which the motion begins.
    fn resolve(&self, request: &MoveRequest, from: [f64; 7]) -> Result<[f64; 7], Refusal> {
        let (values, frame, orientation) = match request.target {
            Target::Joints(joints) => return Ok(kept(joints.map(f64::from), from)),
            Target::JointChange(change) => {
                let mut target = from;
                // The client sends infinite changes of the joints that stay.
                let changes = target.iter_mut().zip(change).filter(|(_, change)| *change != f32::INFINITY);
                changes.for_each(|(value, change)| *value += f64::from(change));
                return Ok(target);
            }
            Target::Pose(values, frame, orientation) => (values, frame, orientation),
        };
        let chain = self.chain.ok_or(NotNow)?;
        let start = self.tcp_of(chain, &from);
        let goal = frame.goal(&start, values, orientation).ok_or(Warning(BAD_PARAMETER))?;
        let goal = self.base().inverse() * goal * self.tool_offset().inverse();
        chain.inverse(&goal, &from).ok_or(Warning(NO_SOLUTION))
    }

    /// Returns the joints [rad] at which the last of the queued moves ends.
    fn planned_end(&self) -> [f64; 7] {
        let ends = self.queue.iter().rev().chain(&self.current).find_map(|queued| queued.goal.end());
        ends.unwrap_or_else(|| self.seven())
    }

    fn enqueue(&mut self, next: Move, out: &mut Vec<u8>) -> Result<(), Refusal> {
        if self.queue.len() >= QUEUE {
            return Err(Warning(QUEUE_FULL));
        }
        if self.queue.is_empty() && !self.is_busy() {
            // Begins at once, so that the response says whether the arm takes it.
            self.start(&next)?;
            self.current = Some(next);
        } else {
            self.queue.push_back(next);
        }
        self.forget_goal();
        let count = self.queue.len() + usize::from(self.current.is_some());
        out.extend((count as u16).to_be_bytes());
        Ok(())
    }

    pub(super) fn checked(&self, target: [f64; 7]) -> Result<[f64; 7], Refusal> {
        if !target.iter().all(|value| value.is_finite()) {
            return Err(Warning(BAD_PARAMETER));
        }
        let within = self.arm.is_within(&target) && !self.leaves_reduced_range(&target);
        if within { Ok(target) } else { Err(Error(JOINT_LIMIT)) }
    }

    pub(super) fn inverse(&self, pose: [f32; 6]) -> Result<[f64; 7], Refusal> {
        let target = Target::Pose(pose, Frame::Base, Orientation::RollPitchYaw);
        self.resolve(&MoveRequest::to(target), self.seven())
    }
}

/// Replaces infinite joints, which stand for "unchanged", by those at the start.
fn kept(mut joints: [f64; 7], from: [f64; 7]) -> [f64; 7] {
    for (value, start) in joints.iter_mut().zip(from) {
        *value = if *value == f64::INFINITY { start } else { *value };
    }
    joints
}

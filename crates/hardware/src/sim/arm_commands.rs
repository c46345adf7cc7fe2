//! Commands of a [`SimArm`], and when it refuses them.

use std::time::Duration;

use super::{Refusal, STREAM, SimArm};
use crate::sim::faults::FaultKind;
use crate::sim::weight::Drive;
use dimos_core::arm::Setpoint;
use dimos_core::joint::{ControlMode, MAX_DOF};

impl SimArm {
    /// Changes the mode; only while the arm is at rest.
    pub fn set_mode(&mut self, mode: ControlMode) -> Result<(), Refusal> {
        if mode == self.mode {
            return Ok(());
        }
        if self.plant.moving() {
            return Err(Refusal::Moving);
        }
        self.plant.stop();
        self.mode = mode;
        Ok(())
    }

    /// Switches all motors on, holding the current position, or off.
    pub fn enable(&mut self, on: bool) -> Result<(), Refusal> {
        if on && self.error != 0 {
            return Err(Refusal::InError);
        }
        if self.mode == ControlMode::Impedance {
            self.plant.stop();
        }
        (0..self.dof()).for_each(|joint| self.enable_joint(joint, on));
        Ok(())
    }

    /// Switches the motor of one joint (index from 0), also in error. With the fault `sag`, the arm sinks when its last
    /// motor comes on.
    pub fn enable_joint(&mut self, joint: usize, on: bool) {
        let before = self.plant.enabled();
        self.switch(joint, on);
        if !before
            && self.plant.enabled()
            && let Some(fault) = self.take_fault(FaultKind::Sag)
        {
            self.plant.sag(fault.amount);
        }
    }

    pub(super) fn switch(&mut self, joint: usize, on: bool) {
        self.switches += u32::from(joint < self.dof() && self.plant.motor(joint) != on);
        self.plant.enable_joint(joint, on);
    }

    /// Switches all motors off.
    pub(super) fn switch_off(&mut self) {
        (0..self.dof()).for_each(|joint| self.switch(joint, false));
    }

    /// Clears the error; refused while the E-stop line is open.
    pub fn clear_error(&mut self) -> Result<(), Refusal> {
        if self.estop_open {
            return Err(Refusal::InError);
        }
        self.error = 0;
        Ok(())
    }

    /// Lets the arm be guided by hand until it is stopped or enabled; only while it is at rest.
    pub fn guide(&mut self) -> Result<(), Refusal> {
        self.ready()?;
        self.set_mode(ControlMode::Impedance)?;
        self.plant.guide();
        Ok(())
    }

    /// Decelerates to rest; the motors stay on.
    pub fn stop(&mut self) {
        self.plant.stop();
    }

    /// Moves to `target` [rad] at a fraction of the top speed; requires position mode.
    pub fn move_to(&mut self, target: &[f64], speed: f64) -> Result<(), Refusal> {
        self.may_move(ControlMode::Position)?;
        self.within(target)?;
        self.plant.move_to(target, speed);
        Ok(())
    }

    /// Follows a setpoint [rad]; requires servo mode.
    pub fn servo(&mut self, target: &[f64]) -> Result<(), Refusal> {
        self.may_move(ControlMode::ServoPosition)?;
        self.within(target)?;
        self.plant.assist(&[]);
        self.plant.servo(target);
        Ok(())
    }

    /// Follows a setpoint with all that it has, in servo or impedance mode: efforts add to those of the arm's own
    /// control, and in impedance mode take the place of it, with stiffness and damping. When it has expired, an arm in
    /// impedance mode decelerates and holds.
    pub fn follow(&mut self, setpoint: &Setpoint) -> Result<(), Refusal> {
        let joints = setpoint.position.get(..self.dof()).unwrap_or_default();
        if self.mode != ControlMode::Impedance {
            self.servo(joints)?;
            self.setpoint = Some(*setpoint);
            self.plant.assist(setpoint.effort.as_ref().map_or(&[], |effort| &effort[..]));
            return Ok(());
        }
        self.ready()?;
        self.within(joints)?;
        let (Some(stiffness), Some(damping)) = (setpoint.stiffness, setpoint.damping) else {
            return Err(Refusal::WrongMode);
        };
        let effort = setpoint.effort.unwrap_or_default();
        let mut drives = [Drive::default(); MAX_DOF];
        for (i, drive) in drives.iter_mut().enumerate() {
            let of = |list: &[f64; MAX_DOF]| list.get(i).copied().unwrap_or_default();
            *drive = Drive {
                position: of(&setpoint.position),
                velocity: of(&setpoint.velocity),
                stiffness: of(&stiffness),
                damping: of(&damping),
                effort: of(&effort),
            };
        }
        self.plant.comply(&drives);
        self.setpoint = Some(*setpoint);
        self.setpoint_until =
            setpoint.valid_for().map(|time| self.advanced_to.after(Duration::from_secs_f64(time.clamp(0.0, 60.0))));
        Ok(())
    }

    /// Keeps velocities [rad/s] for the arm's default time; requires velocity mode.
    pub fn velocity(&mut self, velocities: &[f64]) -> Result<(), Refusal> {
        self.velocity_for(velocities, self.velocity_timeout)
    }

    /// Keeps velocities [rad/s] for this time, or until the next command if `None`; requires velocity mode.
    pub fn velocity_for(&mut self, velocities: &[f64], duration: Option<Duration>) -> Result<(), Refusal> {
        self.may_move(ControlMode::Velocity)?;
        self.velocity_until = duration.map(|duration| self.advanced_to.after(duration));
        self.plant.velocity(velocities);
        Ok(())
    }

    /// Takes a goal [rad] as servos without modes do: goals in quick succession are followed as a stream, others are
    /// moves at a fraction of the top speed. With `direct`, every goal is followed. A goal that arrives while the
    /// motors are off is kept for [`SimArm::resume_goal`].
    pub fn take_goal(&mut self, goal: &[f64], speed: f64, direct: bool) {
        let mut joints = [0.0; MAX_DOF];
        joints.iter_mut().zip(goal).for_each(|(joint, value)| *joint = *value);
        let (pause, step) =
            self.goal.replace((joints, self.advanced_to)).map_or((f64::MAX, f64::MAX), |(before, at)| {
                let steps = before.iter().zip(&joints).map(|(a, b)| (a - b).abs());
                (self.advanced_to.seconds_since(at), steps.fold(0.0, f64::max))
            });
        let streamed = pause < STREAM.0 && step < STREAM.1;
        // What bridges gaps sees that a goal is repeated: it has arrived.
        if direct || (streamed && (step > 0.0 || self.plant.bridges_gaps())) {
            self.plant.servo(goal);
        } else if !streamed {
            self.plant.move_to(goal, speed);
        }
    }

    /// Sets the top speed of a joint [rad/s], as servos have one each.
    pub fn limit_speed(&mut self, joint: usize, speed: f64) {
        self.plant.limit_speed(joint, speed);
    }

    /// Moves at top speed to the last goal since power-up, if there is one, as some servos do when their motors come
    /// on.
    pub fn resume_goal(&mut self) {
        if let Some((goal, _)) = self.goal {
            self.plant.move_to(&goal, 1.0);
        }
    }

    /// Refuses motion while the motors are off or the arm is in error.
    pub fn ready(&self) -> Result<(), Refusal> {
        match (self.error, self.plant.enabled()) {
            (0, true) => Ok(()),
            (0, false) => Err(Refusal::Disabled),
            _ => Err(Refusal::InError),
        }
    }

    /// Refuses motion as [`SimArm::ready`] does, and commands of another mode.
    pub fn may_move(&self, mode: ControlMode) -> Result<(), Refusal> {
        self.ready()?;
        if !self.has_modes || self.mode == mode { Ok(()) } else { Err(Refusal::WrongMode) }
    }

    /// Refuses positions [rad] outside the limits.
    pub fn within(&self, positions: &[f64]) -> Result<(), Refusal> {
        let mut range = self.limits.position_lower.iter().zip(&self.limits.position_upper).zip(positions);
        let inside =
            range.all(|((lower, upper), value)| (lower - self.tolerance..=upper + self.tolerance).contains(value));
        if inside { Ok(()) } else { Err(Refusal::OutOfRange) }
    }
}

//! Optional parts: status of the joints, and the gripper.

use std::f64::consts::TAU;

use super::DOF;
use super::adapter::{So101Adapter, counts_of_speed};
use super::protocol::{TURN, register};
use dimos_core::arm::{GripperUnit, JointStatus};
use dimos_hardware::adapter::{AdapterError, AdapterResult, Gripper, JointMonitor};
use dimos_hardware::adapter_util::{fill, within};

/// Unit of the servos' currents [A].
const AMPERE: f64 = 6.5e-3;

impl JointMonitor for So101Adapter {
    /// The load is the duty cycle of the motor: the servos measure no torque.
    fn read_joint_status(&mut self, joints: &mut [JointStatus]) -> AdapterResult<()> {
        for (joint, servo) in joints.iter_mut().zip(&self.recent()?) {
            *joint = JointStatus {
                temperature: Some(servo.temperature.into()),
                current: Some(f64::from(servo.current) * AMPERE),
                voltage: Some(f64::from(servo.voltage) * 0.1),
                load: Some(f64::from(servo.load) * 1e-3),
                error: Some(servo.error.into()),
            };
        }
        Ok(())
    }

    fn read_calibration_offsets(&mut self, offsets: &mut [f64]) -> AdapterResult<bool> {
        fill(offsets, &self.offsets.map(|offset| f64::from(offset) * TAU / TURN));
        Ok(true)
    }
}

/// The jaw's angle counts from closed, the lower end of its range: wherever the calibration has its zero.
impl Gripper for So101Adapter {
    fn get_gripper_unit(&self) -> GripperUnit {
        GripperUnit::Radians
    }

    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        let position = self.recent()?.get(DOF).map_or(0, |servo| servo.position);
        if self.missing.contains(DOF) {
            return Ok(None);
        }
        Ok(Some(f64::from(position - self.range(DOF).low) * TAU / TURN))
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        let range = self.range(DOF);
        let open = f64::from(range.high - range.low) * TAU / TURN;
        within("gripper angle", position, (0.0, open), "rad")?;
        // Goals that were written since the last state are in the servos only.
        let servos = self.fetch()?;
        if !servos.get(DOF).is_some_and(|servo| servo.on) {
            return Err(AdapterError::Rejected("the motor of the gripper is off".into()));
        }
        if servos.get(DOF).is_some_and(|servo| servo.top_speed != self.gripper_speed) {
            self.bus.write(*self.bus.ids().end(), register::TOP_SPEED, &self.gripper_speed.to_le_bytes())?;
        }
        let goal = range.low + (position * TURN / TAU).round() as i32;
        self.gripper_goal = Some(goal);
        let mut goals = servos.map(|servo| servo.goal);
        goals.iter_mut().skip(DOF).for_each(|to| *to = goal);
        self.write_goals_of_enabled(&servos, goals)
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        let range = self.range(DOF);
        Some((0.0, f64::from(range.high - range.low) * TAU / TURN))
    }

    fn has_gripper_speed(&self) -> bool {
        true
    }

    fn set_gripper_speed(&mut self, fraction: Option<f64>) {
        self.gripper_speed = fraction.map_or(0, counts_of_speed);
    }
}

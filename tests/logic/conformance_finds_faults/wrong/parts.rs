//! Optional parts of a wrong arm: condition of its drives, gripper, force sensor.

use super::*;

impl<const MISTAKE: u8> JointMonitor for Wrong<MISTAKE> {
    fn read_joint_status(&mut self, joints: &mut [JointStatus]) -> AdapterResult<()> {
        self.inner.joint_monitor().ok_or(AdapterError::Unsupported)?.read_joint_status(joints)?;
        if MISTAKE == STATUS_SHIFTED {
            joints.rotate_left(1);
        }
        Ok(())
    }
}

impl<const MISTAKE: u8> Wrong<MISTAKE> {
    /// A gripper's position as an adapter sees it that takes open for closed.
    fn reversed(&mut self, position: f64) -> f64 {
        let range = self.inner.gripper().and_then(|gripper| gripper.get_gripper_range());
        range.filter(|_| MISTAKE == GRIPPER_REVERSED).map_or(position, |(closed, open)| closed + open - position)
    }
}

impl<const MISTAKE: u8> Gripper for Wrong<MISTAKE> {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        let position = self.inner.gripper().map_or(Ok(None), |gripper| gripper.read_gripper_position())?;
        let position = position.map(|position| self.reversed(position));
        Ok(position.map(|metres| if MISTAKE == GRIPPER_IN_MILLIMETRES { 1000.0 * metres } else { metres }))
    }
    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        self.inner.gripper().and_then(|gripper| gripper.get_gripper_force_range())
    }
    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        let gripper = self.inner.gripper().ok_or(AdapterError::Unsupported)?;
        let (least, most) = gripper.get_gripper_force_range().ok_or(AdapterError::Unsupported)?;
        self.force = (least..=most).contains(&force).then_some(force);
        match MISTAKE {
            FORCE_CONTROL_ONLY_CLAIMED => Err(AdapterError::Unsupported),
            FORCE_CLAMPS => gripper.write_gripper_position_with_force(position, force.max(least).min(most)),
            FORCE_IS_LOST if (least..=most).contains(&force) => gripper.write_gripper_position(position),
            _ => gripper.write_gripper_position_with_force(position, force),
        }
    }
    fn read_gripper_force(&mut self) -> AdapterResult<Option<f64>> {
        self.inner.gripper().map_or(Ok(None), |gripper| gripper.read_gripper_force())
    }
    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        self.inner.gripper().and_then(|gripper| gripper.get_gripper_range())
    }
    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        match MISTAKE {
            GRIPPER_IGNORES_STOP if self.stopped => return Ok(()),
            STOP_LOCKS_GRIPPER if self.stopped => return Err(AdapterError::Rejected("stopped".into())),
            _ => self.gripper = position,
        }
        let position = self.reversed(position);
        if let Some(goal) = self.goal.filter(|_| MISTAKE == GRIPPER_HURRIES_JOINTS) {
            self.inner.write_joint_positions(&goal, 1.0)?;
        }
        let gripper = self.inner.gripper().ok_or(AdapterError::Unsupported)?;
        match (MISTAKE, self.force) {
            (GRIPPER_CLAMPS, _) => gripper.write_gripper_position(position.clamp(0.0, 0.08)),
            (FORCE_REMAINS, Some(force)) => gripper.write_gripper_position_with_force(position, force),
            _ => gripper.write_gripper_position(position),
        }
    }
}

impl<const MISTAKE: u8> ForceTorque for Wrong<MISTAKE> {
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        Err(AdapterError::Unsupported)
    }
}

//! The parts of an xArm that other arms may lack: load, gripper, force/torque sensor, poses.

use super::{LINE_ACCELERATION, SLOWEST, XArmAdapter, stated};
use crate::xarm::protocol::commands::Command;
use crate::xarm::protocol::gripper::{FORCE_RANGE_G2, GripperKind};
use crate::xarm::report_validity::MM_PER_M;
use dimos_core::arm::{ControllerPose, ForceUnit, GripperUnit, Load, Pose};
use dimos_hardware::adapter::{AdapterError, AdapterResult, Cartesian, ForceTorque, Gripper, Payload};

impl Payload for XArmAdapter {
    /// The controller keeps no inertia.
    fn read_payload(&mut self) -> AdapterResult<Option<Load>> {
        let [mass, x, y, z] = self.recent()?.condition().load;
        Ok(Some(Load { mass, center: [x, y, z].map(|v| v / MM_PER_M), inertia: [0.0; 6] }))
    }

    fn write_payload(&mut self, load: &Load) -> AdapterResult<()> {
        let [x, y, z] = load.center.map(|v| v * MM_PER_M);
        self.target = None;
        self.with(|session| session.set_load([load.mass, x, y, z]))
    }

    fn resets_controller(&self) -> bool {
        true
    }

    fn read_mounting(&mut self) -> AdapterResult<Option<[f64; 3]>> {
        Ok(self.recent()?.condition().gravity)
    }
}

impl Gripper for XArmAdapter {
    fn read_gripper_position(&mut self) -> AdapterResult<Option<f64>> {
        Ok(self.recent()?.gripper().opening())
    }

    fn get_gripper_unit(&self) -> GripperUnit {
        if self.options.gripper.is_on_off() { GripperUnit::OnOff } else { GripperUnit::Meters }
    }

    fn read_gripper_holds(&mut self) -> AdapterResult<Option<bool>> {
        Ok(self.recent()?.gripper().holds())
    }

    fn get_gripper_range(&mut self) -> Option<(f64, f64)> {
        self.options.gripper.widest().map(|widest| (0.0, widest))
    }

    fn write_gripper_position(&mut self, position: f64) -> AdapterResult<()> {
        self.with(|session| session.gripper().go_to(position))
    }

    /// The vendor gives the force of a G2 as a number from 1 to 100.
    fn get_gripper_force_unit(&self) -> ForceUnit {
        ForceUnit::Percent
    }

    fn has_gripper_speed(&self) -> bool {
        !self.options.gripper.is_on_off()
    }

    fn set_gripper_speed(&mut self, fraction: Option<f64>) {
        let _ = self.with(|session| {
            session.gripper().set_speed(fraction);
            Ok(())
        });
    }

    fn get_gripper_force_range(&mut self) -> Option<(f64, f64)> {
        (self.options.gripper == GripperKind::XarmG2).then_some(FORCE_RANGE_G2)
    }

    fn write_gripper_position_with_force(&mut self, position: f64, force: f64) -> AdapterResult<()> {
        self.with(|session| session.gripper().grip(position, force))
    }
}

impl ForceTorque for XArmAdapter {
    fn read_force_torque(&mut self) -> AdapterResult<Option<[f64; 6]>> {
        Ok(self.recent()?.wrench())
    }
}

impl Cartesian for XArmAdapter {
    fn read_cartesian_position(&mut self) -> AdapterResult<Option<ControllerPose>> {
        let session = self.recent()?;
        Ok(Some(stated(session.motion().0, session.condition())))
    }

    fn write_cartesian_position(&mut self, pose: &Pose, velocity: f64) -> AdapterResult<()> {
        let ([x, y, z], [roll, pitch, yaw]) = (pose.xyz.map(|v| v * MM_PER_M), pose.rpy);
        let pose = [x, y, z, roll, pitch, yaw];
        if !pose.iter().all(|value| value.is_finite()) {
            return Err(AdapterError::Rejected("the pose is not finite".into()));
        }
        let speed = self.speed(velocity, self.model.line_speed(), SLOWEST.1);
        self.target = None;
        self.with(|session| session.plan(&Command::MoveLine { pose, speed, acceleration: LINE_ACCELERATION }))
    }
}

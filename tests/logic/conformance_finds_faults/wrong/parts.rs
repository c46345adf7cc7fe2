//! Optional parts of a wrong arm: condition of its drives, gripper, force sensor.

use super::*;
use dimos::hardware::registry::{Emulator, EmulatorAddress, Truth};
use dimos::hardware::sim::faults::Fault;

/// An emulator that does not say which setpoints arrived.
struct Blind(Box<dyn Emulator>);

impl Emulator for Blind {
    fn address(&self) -> String {
        self.0.address()
    }
    fn inject(&self, fault: Fault) -> Result<(), String> {
        self.0.inject(fault)
    }
    fn truth(&self) -> Truth {
        Truth { setpoint: None, ..self.0.truth() }
    }
}

/// Starts one.
pub fn blind(config: &AdapterConfig, address: &EmulatorAddress) -> AdapterResult<Box<dyn Emulator>> {
    Ok(Box::new(Blind((yourarm::SPEC.emulate.unwrap())(config, address)?)))
}

impl<const MISTAKE: u8> Payload for Wrong<MISTAKE> {
    fn read_payload(&mut self) -> AdapterResult<Option<Load>> {
        let load = self.inner.payload().ok_or(AdapterError::Unsupported)?.read_payload()?;
        Ok(if matches!(MISTAKE, IGNORES_PAYLOAD | PAYLOAD_IN_GRAMS) { self.load.or(load) } else { load })
    }
    fn write_payload(&mut self, load: &Load) -> AdapterResult<()> {
        self.load = Some(*load);
        let payload = self.inner.payload().ok_or(AdapterError::Unsupported)?;
        match MISTAKE {
            IGNORES_PAYLOAD => Ok(()),
            PAYLOAD_IN_GRAMS => payload.write_payload(&Load { mass: 1e-3 * load.mass, ..*load }),
            _ => payload.write_payload(load),
        }
    }
    fn write_mounting(&mut self, gravity: [f64; 3]) -> AdapterResult<()> {
        self.inner.payload().ok_or(AdapterError::Unsupported)?.write_mounting(gravity)
    }
}

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

//! A gripper and a force/torque sensor with their own connections: their threads read them, the arm's state has it.

use super::Worker;
use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};
use dimos_core::arm::{GripperInfo, Interference};
use std::time::Duration;

/// A force that was measured longer ago is not known: a tool may press on while its sensor is silent.
const FORCE_IS_KNOWN: Duration = Duration::from_millis(100);

impl Worker {
    /// Returns an error if the arm itself has a part that also has its own connection.
    pub(super) fn check_peripherals(&self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        let both = |part: &str, without: &str| {
            let what = format!("the arm has a {part} of its own, and the blueprint another one");
            Err(AdapterError::Rejected(format!("{what}\nhint: {without}")))
        };
        if self.config.peripherals.gripper.is_some() && adapter.gripper().is_some() {
            return both("gripper", "set `options.gripper: none`, or remove `gripper` beside it");
        }
        if self.config.peripherals.force_torque.is_some() && adapter.force_torque().is_some() {
            return both("force/torque sensor", "remove `force_torque`: the arm's own is read");
        }
        Ok(())
    }

    /// Returns units and ranges of the gripper.
    pub(super) fn gripper_info(&self, adapter: &mut dyn ManipulatorAdapter) -> Option<GripperInfo> {
        match &self.config.peripherals.gripper {
            Some(gripper) => gripper.gripper_info(),
            None => adapter.gripper().map(|gripper| gripper.info()),
        }
    }

    /// Takes what their threads have read last.
    pub(super) fn read_peripherals(&mut self) {
        if let Some(gripper) = &mut self.config.peripherals.gripper {
            let state = gripper.state();
            (self.state.gripper, self.state.gripper_force) = (state.position, state.force);
            self.health.set_gripper_holds(state.holds);
        }
        if let Some(sensor) = &mut self.config.peripherals.force_torque {
            let state = sensor.state();
            let is_recent = self.config.clock.now().since(state.at) <= FORCE_IS_KNOWN;
            self.set_wrench(state.wrench.filter(|_| is_recent));
        }
    }

    /// Holds an arm that has lost its gripper with what that holds.
    pub(super) fn hold_for_peripherals(&mut self) {
        let missed = self.config.peripherals.gripper.as_ref().is_some_and(|gripper| gripper.is_missed());
        match (missed, self.state.interference) {
            (true, Interference::None) => self.state.interference = Interference::Tool,
            (false, Interference::Tool) => self.state.interference = Interference::None,
            _ => {}
        }
    }

    /// Holds a gripper that moves: the arm was stopped.
    pub(super) fn stop_peripherals(&mut self) {
        if let Some(gripper) = &mut self.config.peripherals.gripper {
            gripper.stop();
        }
    }
}

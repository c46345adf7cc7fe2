//! A peripheral as the device thread of its arm sees it: neither side ever waits for the other.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::{Command, PeripheralState, Shared};
use crate::device::Health;
use dimos_core::arm::{ArmCommand, GripperInfo};
use dimos_rt::slot::{SlotReader, SlotWriter};
use dimos_rt::wake::Wake;

/// The peripherals of an arm.
#[derive(Default)]
pub struct Ports {
    /// Its gripper, if that has its own connection.
    pub gripper: Option<Port>,
    /// Its force/torque sensor, if that has its own connection.
    pub force_torque: Option<Port>,
}

/// The arm's end of the slots.
pub struct Port {
    commands: SlotWriter<Command>,
    states: SlotReader<PeripheralState>,
    command: Command,
    wake: Wake,
    shared: Arc<Shared>,
    info: Option<GripperInfo>,
}

impl Port {
    pub(super) fn new(
        commands: SlotWriter<Command>,
        states: SlotReader<PeripheralState>,
        (wake, shared): (Wake, Arc<Shared>),
        info: Option<GripperInfo>,
    ) -> Self {
        Self { commands, states, command: Command::default(), wake, shared, info }
    }

    /// Sets where the answers to gripper commands are. Only the first call has an effect.
    pub fn answer_to(&self, arm: Arc<Health>) {
        let _ = self.shared.arm.set(arm);
    }

    /// Returns units and ranges, if it is a gripper.
    pub fn gripper_info(&self) -> Option<GripperInfo> {
        self.info
    }

    /// Returns its latest state.
    pub fn state(&mut self) -> PeripheralState {
        self.states.read()
    }

    /// Returns whether it was lost with what it holds.
    pub fn is_missed(&self) -> bool {
        self.shared.missed.load(Ordering::Acquire)
    }

    /// Passes a gripper command on; its thread answers it.
    pub fn command(&mut self, of: &ArmCommand) {
        self.command = Command {
            seq: of.gripper_seq,
            position: of.gripper,
            force: of.gripper_force,
            speed: of.gripper_speed,
            ..self.command
        };
        self.send();
    }

    /// Holds a gripper that moves: the arm was stopped.
    pub fn stop(&mut self) {
        self.command.stops = self.command.stops.wrapping_add(1);
        self.send();
    }

    fn send(&mut self) {
        self.commands.write(&self.command);
        self.wake.raise();
    }
}

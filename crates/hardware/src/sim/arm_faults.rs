//! Faults of a [`SimArm`] and of its wire.

use super::{Delivery, SimArm};
use crate::sim::faults::{DEFAULT_STALL, Fault, FaultKind, check_kind};
use dimos_core::clock::Mono;

impl SimArm {
    /// Plays the arm's faults that are due at the time of the last [`SimArm::integrate`].
    pub fn apply_faults(&mut self) {
        if let Some(fault) = self.take_fault(FaultKind::Estop) {
            self.press_estop();
            self.estop_until = fault.left(self.script_time()).map(|left| self.advanced_to.after(left));
        }
        if let Some(fault) = self.take_fault(FaultKind::ErrorCode) {
            self.fail_joint(fault.joint.saturating_sub(1), fault.code);
        }
        let pushed = self.take_fault(FaultKind::Pushed).map(|fault| (fault.joint.saturating_sub(1), fault));
        self.plant.hand(pushed.filter(|(_, f)| f.duration > 0.0).map(|(joint, f)| (joint, f.amount / f.duration)));
        if let Some((joint, fault)) = pushed.filter(|(_, fault)| fault.duration == 0.0) {
            self.plant.push(joint, fault.amount);
        }
        let nudged = self.take_fault(FaultKind::Nudged).map(|fault| (fault.joint.saturating_sub(1), fault.amount));
        self.plant.nudge(nudged);
        if let Some(fault) = self.take_fault(FaultKind::MotorOff) {
            self.switch(fault.joint.saturating_sub(1), false);
        }
        let blocked = self.take_fault(FaultKind::Blocked).map(|fault| fault.joint.saturating_sub(1));
        (0..self.dof()).for_each(|joint| self.plant.block(joint, blocked == Some(joint)));
    }

    /// Injects a fault that begins `fault.at` seconds after `now`; the error lists the kinds that can be played.
    pub fn inject(&mut self, fault: Fault, now: Mono) -> Result<(), String> {
        check_kind(&format!("the {} emulator", self.name), &fault, self.playable)?;
        let t = self.first_client.map_or(0.0, |first| now.seconds_since(first));
        self.script.inject(fault, t);
        Ok(())
    }

    /// Returns the fault of this kind that is due now, and counts it as played.
    pub fn take_fault(&mut self, kind: FaultKind) -> Option<Fault> {
        self.take_fault_if(kind, |_| true)
    }

    /// As above, for a fault that `wanted` accepts; others remain.
    pub fn take_fault_if(&mut self, kind: FaultKind, wanted: impl Fn(&Fault) -> bool) -> Option<Fault> {
        let t = self.script_time();
        self.script.take_if(kind, t, wanted)
    }

    /// Changes true positions [rad] and velocities [rad/s] to what the arm reports instead of them now: its setpoints
    /// if it reports those, and what faults make of them.
    pub fn misread(&mut self, positions: &mut [f64], velocities: &mut [f64]) {
        let (now, dof) = (self.script_time(), self.dof());
        let faults: Vec<Fault> = self.script.take_all(FaultKind::Misread, now).collect();
        let (Some(positions), Some(velocities)) = (positions.get_mut(..dof), velocities.get_mut(..dof)) else { return };
        if self.reports_commanded {
            positions.iter_mut().zip(self.plant.commanded()).for_each(|(said, commanded)| *said = commanded);
        }
        self.misreadings.apply(&faults, now, positions, velocities);
    }

    /// Returns whether a fault of this kind with a duration is active now. Does not count it as played.
    pub fn fault_lasts(&self, kind: FaultKind) -> bool {
        self.script.lasts(kind, self.script_time())
    }

    /// Returns whether a command without a response that has just arrived was lost on its way instead.
    pub fn loses_command(&mut self) -> bool {
        self.take_fault(FaultKind::LostCommand).is_some()
    }

    /// Returns how the response or report that is due now is delivered.
    pub fn delivery(&mut self) -> Delivery {
        if self.body.as_ref().is_some_and(|body| body.ended().is_some()) {
            return Delivery::Silent;
        }
        let t = self.script_time();
        let left = |fault: &Fault| fault.left(t);
        if let Some(fault) = self.take_fault(FaultKind::PowerLoss) {
            let dark = left(&fault).unwrap_or_default();
            self.restart();
            self.powered_up = self.advanced_to.after(dark);
            return Delivery::PowerLoss(dark);
        }
        if let Some(fault) = self.take_fault(FaultKind::Stall) {
            return Delivery::Stall(left(&fault).unwrap_or(DEFAULT_STALL));
        }
        if let Some(fault) = self.take_fault(FaultKind::Disconnect) {
            return Delivery::Disconnect(left(&fault).unwrap_or_default());
        }
        if let Some(fault) = self.take_fault(FaultKind::NoBuffers) {
            return Delivery::NoBuffers(left(&fault).is_some());
        }
        let faults = [
            (FaultKind::BusOff, Delivery::BusOff),
            (FaultKind::Silent, Delivery::Silent),
            (FaultKind::Truncated, Delivery::Truncated),
            (FaultKind::Corrupt, Delivery::Corrupt),
            (FaultKind::Garbage, Delivery::Garbage),
        ];
        let struck = faults.iter().find(|(kind, _)| self.take_fault(*kind).is_some());
        struck.map_or(Delivery::Send, |(_, delivery)| *delivery)
    }

    fn script_time(&self) -> f64 {
        self.first_client.map_or(0.0, |first| self.advanced_to.seconds_since(first))
    }
}

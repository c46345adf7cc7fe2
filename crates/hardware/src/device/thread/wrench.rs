//! Force and torque at the arm's end, less what was tared.

use super::Worker;
use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};

/// Force and torque [N, N, N, Nm, Nm, Nm].
pub type Wrench = [f64; 6];

impl Worker {
    /// Reads the wrench, if the arm has one.
    pub(super) fn read_wrench(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        let measured = adapter.force_torque().map_or(Ok(None), |sensor| sensor.read_force_torque())?;
        self.measured_wrench = measured;
        self.state.wrench = measured.map(|measured| less(&measured, &self.tare));
        Ok(())
    }

    /// Makes the present wrench zero. Returns what was measured.
    pub(super) fn take_tare(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<Wrench> {
        if !self.connected {
            return Err(AdapterError::NotConnected);
        }
        if adapter.force_torque().is_none() {
            return Err(AdapterError::Unsupported);
        }
        self.read_wrench(adapter)?;
        let Some(measured) = self.measured_wrench.filter(|wrench| wrench.iter().all(|value| value.is_finite())) else {
            let what = "it reports no force at present\nhint: enable the arm, or switch its sensor on";
            return Err(AdapterError::Rejected(what.to_owned()));
        };
        self.tare = measured;
        self.state.wrench = Some(less(&measured, &self.tare));
        Ok(measured)
    }
}

fn less(wrench: &Wrench, tare: &Wrench) -> Wrench {
    let mut net = *wrench;
    net.iter_mut().zip(tare).for_each(|(value, tare)| *value -= tare);
    net
}

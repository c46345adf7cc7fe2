//! Force and torque at the arm's end, less what was tared.

use super::Worker;
use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};

/// Force and torque [N, N, N, Nm, Nm, Nm].
pub type Wrench = [f64; 6];

impl Worker {
    /// Takes what the arm's own sensor or that with its own connection has measured.
    pub(super) fn set_wrench(&mut self, measured: Option<Wrench>) {
        self.measured_wrench = measured;
        self.state.wrench = measured.map(|measured| less(&measured, &self.tare));
    }

    /// Makes the present wrench zero. Returns what was measured.
    pub(super) fn take_tare(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<Wrench> {
        if !self.connected {
            return Err(AdapterError::NotConnected);
        }
        match adapter.force_torque() {
            _ if self.config.peripherals.force_torque.is_some() => self.read_peripherals(),
            Some(sensor) => {
                let measured = sensor.read_force_torque()?;
                self.set_wrench(measured);
            }
            None => return Err(AdapterError::Unsupported),
        }
        let Some(measured) = self.measured_wrench.filter(|wrench| wrench.iter().all(|value| value.is_finite())) else {
            let what = "it reports no force at present\nhint: enable the arm, or switch its sensor on";
            return Err(AdapterError::Rejected(what.to_owned()));
        };
        self.tare = measured;
        self.set_wrench(Some(measured));
        Ok(measured)
    }
}

fn less(wrench: &Wrench, tare: &Wrench) -> Wrench {
    let mut net = *wrench;
    net.iter_mut().zip(tare).for_each(|(value, tare)| *value -= tare);
    net
}

//! Connecting: checks that the servos are those of this arm, calibrated and set as the blueprint says. Enables and
//! moves nothing.

use super::adapter::So101Adapter;
use super::protocol::{register, signed};
use super::settings;
use dimos_hardware::adapter::{AdapterError, AdapterResult};

impl So101Adapter {
    /// Checks that the servos are those of this arm, calibrated as the blueprint says.
    pub(super) fn introduce(&mut self) -> AdapterResult<()> {
        let at = self.bus.address().to_string();
        for (i, id) in self.bus.ids().enumerate() {
            self.firmware = self.bus.identify(id)?;
            let [low0, low1, high0, high1] = self.bus.read::<4>(id, register::RANGE)?;
            let found = (u16::from_le_bytes([low0, low1]), u16::from_le_bytes([high0, high1]));
            let offset = signed(u16::from_le_bytes(self.bus.read::<2>(id, register::OFFSET)?), 11);
            self.offsets.get_mut(i).into_iter().for_each(|to| *to = offset);
            let range = self.range(i);
            let same = (found.0.into(), found.1.into()) == range.registers;
            if range.offset.is_some_and(|expected| !same || offset != expected) {
                return Err(AdapterError::Rejected(format!(
                    "so101 at {at}: {} has the range {} to {} and the offset {offset}, not those of the calibration \
                     file\nhint: write the file to the servos (dimos arm calibrate so101 --address {at} --restore FILE), \
                     or name another",
                    self.bus.servo(id),
                    found.0,
                    found.1
                )));
            }
        }
        self.check_settings()?;
        self.fetch().map(drop)
    }

    /// Checks the settings that the servos keep, and writes those that differ if the blueprint says so.
    fn check_settings(&mut self) -> AdapterResult<()> {
        let at = self.bus.address().to_string();
        let found = settings::check(&mut self.bus)?;
        if found.is_empty() {
            return Ok(());
        }
        if self.write_settings {
            if self.fetch()?.iter().any(|servo| servo.on) {
                let what = format!("so101 at {at}: settings cannot be written while motors are on");
                return Err(AdapterError::Rejected(format!(
                    "{what}\nhint: support the arm and switch its power off and on"
                )));
            }
            tracing::warn!("so101 at {at}: {} settings are written to the servos", found.len());
            return settings::write(&mut self.bus);
        }
        let hint = format!("dimos arm configure so101 --address {at}");
        if let Some(mode) = found.iter().find(|setting| setting.register == u16::from(register::MODE)) {
            let what = format!("so101 at {at}: {} is in control mode {}, not 0 (position)", mode.motor, mode.found);
            return Err(AdapterError::Rejected(format!("{what}\nhint: {hint}")));
        }
        // A warning at each reconnect would repeat what the log has already.
        if found != self.warned {
            let list = found.iter().map(|s| format!("{}: {} is {}, not {}", s.motor, s.name, s.found, s.wanted));
            let list = list.collect::<Vec<_>>().join("; ");
            tracing::warn!("so101 at {at}: the servos have other settings ({hint} writes them): {list}");
            self.warned = found;
        }
        Ok(())
    }
}

//! Payload, inputs and outputs, and the condition of each joint.

use std::time::Duration;

use super::adapter::UrAdapter;
use super::program;
use super::protocol::state::State;
use crate::hardware::adapter::{AdapterError, AdapterResult};

/// How long a setting may take to show in the state.
const SHOWN: Duration = Duration::from_millis(500);
/// Masses [kg] and lengths [m] closer than this are equal.
const SAME: f64 = 1e-4;

impl UrAdapter {
    /// Returns the newest state, with temperatures, currents and voltages of the joints, inputs, outputs and payload;
    /// `None` while not connected. Never waits.
    pub fn state(&self) -> Option<&State> {
        self.session.as_ref().map(|session| session.state().0)
    }

    /// Sets the payload: mass [kg], centre of gravity in the flange's frame [m] and, with software 5.10 or newer,
    /// inertia (xx, yy, zz, xy, xz, yz [kg·m²]). Waits until the state shows it. A wrong payload causes protective
    /// stops, and motion when the brakes are released.
    pub fn set_payload(&mut self, mass: f64, cog: [f64; 3], inertia: Option<[f64; 6]>) -> AdapterResult<()> {
        let most = 1.2 * self.options.model.payload();
        let finite = cog.iter().chain(inertia.iter().flatten()).all(|value| value.is_finite());
        if !finite || !(0.0..=most).contains(&mass) {
            let what = format!("a payload of {mass} kg is not between 0 and {most:.1} kg");
            return Err(AdapterError::Rejected(what));
        }
        let new = self.session.as_ref().is_some_and(|session| {
            let [major, minor, _] = session.rtde.software;
            (major, minor) >= (5, 10)
        });
        if inertia.is_some() && !new {
            return Err(AdapterError::Unsupported);
        }
        self.with(|session| {
            session.primary.run(&program::payload(mass, cog, inertia))?;
            let shown = session.wait(SHOWN, |session| {
                session.primary.check()?;
                let state = session.state().0;
                let same = |(a, b): (&f64, &f64)| (a - b).abs() < SAME;
                let cog_is = state.payload_cog.iter().zip(&cog).all(same);
                Ok(((state.payload - mass).abs() < SAME && cog_is).then_some(()))
            })?;
            shown.ok_or_else(|| AdapterError::Timeout(format!("the payload does not show within {SHOWN:?}")))
        })
    }

    /// Sets a digital output: 0 to 7 standard, 8 to 15 configurable, 16 and 17 tool. Waits until the state shows it.
    pub fn set_digital_output(&mut self, number: u8, on: bool) -> AdapterResult<()> {
        self.with(|session| {
            session.rtde.digital(number, on)?;
            let shown =
                session.wait(SHOWN, |s| Ok(((s.state().0.digital_out >> number & 1 == 1) == on).then_some(())))?;
            shown
                .ok_or_else(|| AdapterError::Timeout(format!("digital output {number} does not show within {SHOWN:?}")))
        })
    }

    /// Sets an analog output, 0 or 1, to a fraction of its range: of 0 to 10 V, or of 4 to 20 mA.
    pub fn set_analog_output(&mut self, number: u8, voltage: bool, fraction: f64) -> AdapterResult<()> {
        self.with(|session| session.rtde.analog(number, voltage, fraction))
    }

    /// Sets the voltage of the tool's supply: 0, 12 or 24 V. Waits until the state shows it.
    pub fn set_tool_voltage(&mut self, volts: u8) -> AdapterResult<()> {
        if !matches!(volts, 0 | 12 | 24) {
            return Err(AdapterError::Rejected(format!("the tool's supply has 0, 12 or 24 V, not {volts} V")));
        }
        self.with(|session| {
            session.primary.run(&program::tool_voltage(volts))?;
            let shown = session.wait(SHOWN, |s| Ok((s.state().0.tool_voltage == i32::from(volts)).then_some(())))?;
            shown.ok_or_else(|| AdapterError::Timeout(format!("the tool's voltage does not show within {SHOWN:?}")))
        })
    }
}

//! Load, inputs and outputs, and the condition of each joint.

use std::time::Duration;

use super::adapter::UrAdapter;
use super::model::Model;
use super::program;
use super::protocol::state::State;
use dimos_core::arm::{AnalogUnit, IoInfo, IoState, JointStatus, Load};
use dimos_hardware::adapter::{AdapterError, AdapterResult, Io, JointMonitor, Payload};
use dimos_hardware::adapter_util::fill;

/// How long a setting may take to show in the state.
const SHOWN: Duration = Duration::from_millis(500);
/// How long the refusal of a program may take that shows nothing in the state.
const REFUSED: Duration = Duration::from_millis(150);
/// Number of digital inputs, and of outputs: 8 standard, 8 configurable, 2 of the tool.
pub(super) const DIGITAL: u8 = 18;
/// Range of analogue outputs: from 0 to this [V], or between these [A].
const VOLTS: f64 = 10.0;
const AMPERES: (f64, f64) = (0.004, 0.02);
/// Units of analogue channels by the bits that say which of them are voltages.
const INPUT_UNITS: [[AnalogUnit; 4]; 16] = units();
const OUTPUT_UNITS: [[AnalogUnit; 2]; 4] = units();
/// Mode codes of joints that have failed: not responding, violation, fault.
const FAILED: [i32; 3] = [245, 251, 252];
/// Masses [kg] and lengths [m] closer than this are equal.
const SAME: f64 = 1e-4;

/// Returns the largest payload that a controller takes [kg]: a little more than the rated one.
pub(super) fn max_payload(model: Model) -> f64 {
    1.2 * model.payload()
}

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
        let most = max_payload(self.options.model);
        let finite = cog.iter().chain(inertia.iter().flatten()).all(|value| value.is_finite());
        if !finite || !(0.0..=most).contains(&mass) {
            let what = format!("a payload of {mass} kg is not between 0 and {most:.1} kg");
            return Err(AdapterError::Rejected(what));
        }
        let new = self.session.as_ref().is_some_and(|session| session.keeps_inertia());
        if inertia.is_some() && !new {
            return Err(AdapterError::Unsupported);
        }
        self.with(|session| {
            session.run_program(&program::payload(mass, cog, inertia))?;
            let shown = session.wait(SHOWN, |session| {
                session.check_program()?;
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
            session.with_outputs(|outputs| outputs.digital(number, on))?;
            let shown =
                session.wait(SHOWN, |s| Ok(((s.state().0.digital_out >> number & 1 == 1) == on).then_some(())))?;
            shown
                .ok_or_else(|| AdapterError::Timeout(format!("digital output {number} does not show within {SHOWN:?}")))
        })
    }

    /// Sets an analogue output, 0 or 1, to a fraction of its range: of 0 to 10 V, or of 4 to 20 mA. Waits until the
    /// state shows it.
    pub fn set_analog_output(&mut self, number: u8, voltage: bool, fraction: f64) -> AdapterResult<()> {
        let value = if voltage { VOLTS * fraction } else { AMPERES.0 + (AMPERES.1 - AMPERES.0) * fraction };
        let close = 0.01 * if voltage { VOLTS } else { AMPERES.1 };
        self.with(|session| {
            session.with_outputs(|outputs| outputs.analog(number, voltage, fraction))?;
            let shown = session.wait(SHOWN, |session| {
                let state = session.state().0;
                let kind = state.analog_kinds >> (2 + number) & 1 == u32::from(voltage);
                let is = state.analog_out.get(usize::from(number)).is_some_and(|is| (is - value).abs() < close);
                Ok((kind && is).then_some(()))
            })?;
            shown.ok_or_else(|| {
                AdapterError::Timeout(format!("analogue output {number} does not show within {SHOWN:?}"))
            })
        })
    }

    /// Sets the voltage of the tool's supply: 0, 12 or 24 V. Waits until the state shows it.
    pub fn set_tool_voltage(&mut self, volts: u8) -> AdapterResult<()> {
        if !matches!(volts, 0 | 12 | 24) {
            return Err(AdapterError::Rejected(format!("the tool's supply has 0, 12 or 24 V, not {volts} V")));
        }
        self.with(|session| {
            session.run_program(&program::tool_voltage(volts))?;
            let shown = session.wait(SHOWN, |s| Ok((s.state().0.tool_voltage == i32::from(volts)).then_some(())))?;
            shown.ok_or_else(|| AdapterError::Timeout(format!("the tool's voltage does not show within {SHOWN:?}")))
        })
    }
}

#[allow(clippy::indexing_slicing, reason = "computed when compiled")]
const fn units<const N: usize, const KINDS: usize>() -> [[AnalogUnit; N]; KINDS] {
    let mut all = [[AnalogUnit::Ampere; N]; KINDS];
    let mut bits = 0;
    while bits < KINDS {
        let mut channel = 0;
        while channel < N {
            if bits >> channel & 1 == 1 {
                all[bits][channel] = AnalogUnit::Volt;
            }
            channel += 1;
        }
        bits += 1;
    }
    all
}

/// Bits of the digital channels; the state has room for more.
fn digital(bits: u64) -> u32 {
    (bits & ((1 << DIGITAL) - 1)) as u32
}

/// Digital channels as in RTDE. Analogue inputs: 0, 1 of the controller, 2, 3 of the tool; outputs 0, 1 of the
/// controller. Their units are those that are set at the pendant.
impl Io for UrAdapter {
    fn get_io(&self) -> IoInfo {
        const INPUTS: &[[AnalogUnit; 4]; 16] = &INPUT_UNITS;
        const OUTPUTS: &[[AnalogUnit; 2]; 4] = &OUTPUT_UNITS;
        let (kinds, tool) = self.state().map_or((0, 0), |state| (state.analog_kinds, state.tool_analog_kinds));
        IoInfo {
            digital_inputs: DIGITAL,
            digital_outputs: DIGITAL,
            analog_inputs: INPUTS.get((kinds & 3 | (tool & 3) << 2) as usize).map_or(&[], |units| &units[..]),
            analog_outputs: OUTPUTS.get((kinds >> 2 & 3) as usize).map_or(&[], |units| &units[..]),
        }
    }

    fn read_io(&mut self, state: &mut IoState) -> AdapterResult<()> {
        let found = self.recent()?.state().0;
        *state = IoState::default();
        (state.digital_inputs, state.digital_outputs) = (digital(found.digital_in), digital(found.digital_out));
        let [a, b] = found.analog_in;
        let [c, d] = found.tool_analog_in;
        fill(&mut state.analog_inputs, &[a, b, c, d]);
        fill(&mut state.analog_outputs, &found.analog_out);
        Ok(())
    }

    fn write_digital_output(&mut self, output: u8, high: bool) -> AdapterResult<()> {
        self.set_digital_output(output, high)
    }

    fn write_analog_output(&mut self, output: u8, value: f64) -> AdapterResult<()> {
        let units = self.get_io().analog_outputs;
        let Some(unit) = units.get(usize::from(output)) else {
            return Err(AdapterError::Rejected(format!("there is no analogue output {output}")));
        };
        let (low, high, voltage) = match unit {
            AnalogUnit::Volt => (0.0, VOLTS, true),
            AnalogUnit::Ampere => (AMPERES.0, AMPERES.1, false),
        };
        if !(low..=high).contains(&value) {
            let unit = unit.name();
            let what = format!("analogue output {output} takes {low} to {high} {unit}, not {value} {unit}");
            return Err(AdapterError::Rejected(what));
        }
        self.set_analog_output(output, voltage, (value - low) / (high - low))
    }
}

impl Payload for UrAdapter {
    fn read_payload(&mut self) -> AdapterResult<Option<Load>> {
        let session = self.recent()?;
        let state = session.state().0;
        let load = Load { mass: state.payload, center: state.payload_cog, inertia: state.payload_inertia };
        Ok(session.rtde.has("payload").then_some(load))
    }

    /// Software before 5.10 keeps no inertia.
    fn write_payload(&mut self, load: &Load) -> AdapterResult<()> {
        let keeps_inertia = self.session.as_ref().is_some_and(|session| session.keeps_inertia());
        self.set_payload(load.mass, load.center, keeps_inertia.then_some(load.inertia))
    }

    /// The controller does not report the mounting.
    fn write_mounting(&mut self, gravity: [f64; 3]) -> AdapterResult<()> {
        self.with(|session| {
            session.run_program(&program::mounting(gravity))?;
            session.wait(REFUSED, |session| session.check_program().map(|()| None::<()>)).map(drop)
        })
    }
}

impl JointMonitor for UrAdapter {
    fn read_joint_status(&mut self, joints: &mut [JointStatus]) -> AdapterResult<()> {
        let session = self.recent()?;
        let (state, has_voltage) = (session.state().0, session.rtde.has("actual_joint_voltage"));
        for (i, joint) in joints.iter_mut().enumerate() {
            *joint = JointStatus {
                temperature: state.temperature.get(i).copied(),
                current: state.current.get(i).copied(),
                voltage: state.voltage.get(i).copied().filter(|_| has_voltage),
                load: None,
                error: state.joint_mode.get(i).map(|mode| if FAILED.contains(mode) { *mode } else { 0 }),
            };
        }
        Ok(())
    }
}

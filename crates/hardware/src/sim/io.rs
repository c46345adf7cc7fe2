//! Digital and analogue inputs and outputs of a simulated controller.

use super::arm::{self, SimArm};
use super::faults::FaultKind;
use dimos_core::arm::{AnalogUnit, IoInfo, IoState};

/// Digital inputs, and digital outputs.
const DIGITAL: u8 = 8;
/// Analogue inputs, and analogue outputs: 0 to 10 V.
const ANALOG: &[AnalogUnit] = &[AnalogUnit::Volt; 2];
/// Highest voltage [V].
pub const MAX_VOLTAGE: f64 = 10.0;

/// The faults that a [`SimArm`] with inputs and a gripper can play: those of [`arm::PLAYABLE`], of its inputs, and of
/// its [gripper](super::gripper::FAULTS).
pub const PLAYABLE: &[FaultKind] = &arm::playable_and::<{ arm::PLAYABLE.len() + 3 }>(&[
    FaultKind::InputLow,
    super::gripper::FAULTS[0],
    super::gripper::FAULTS[1],
]);

/// Inputs and outputs. All digital inputs are wired to the supply, so they are high; outputs are low, voltages 0 V.
#[derive(Debug, Clone, Copy)]
pub struct SimIo {
    state: IoState,
    /// Inputs that a fault pulls low: bit i is input i.
    pulled_low: u32,
}

impl Default for SimIo {
    fn default() -> Self {
        Self { state: IoState { digital_inputs: (1 << DIGITAL) - 1, ..IoState::default() }, pulled_low: 0 }
    }
}

impl SimIo {
    /// The channels.
    pub const INFO: IoInfo =
        IoInfo { digital_inputs: DIGITAL, digital_outputs: DIGITAL, analog_inputs: ANALOG, analog_outputs: ANALOG };

    /// Plays the fault `input_low` that is due. Call it whenever the arm is advanced.
    pub fn play(&mut self, arm: &mut SimArm) {
        self.pulled_low = 0;
        if let Some(fault) = arm.take_fault(FaultKind::InputLow) {
            let bit = 1_u32.checked_shl(fault.input.into()).unwrap_or(0);
            if fault.duration > 0.0 {
                self.pulled_low = bit;
            } else {
                self.state.digital_inputs &= !bit;
            }
        }
    }

    /// Returns the levels of all channels.
    pub fn state(&self) -> IoState {
        IoState { digital_inputs: self.state.digital_inputs & !self.pulled_low, ..self.state }
    }

    /// Sets the level of a digital input, as the device wired to it does.
    pub fn set_input(&mut self, input: u8, high: bool) {
        set(&mut self.state.digital_inputs, input, high);
    }

    /// Sets a digital output; `false` if there is no such output.
    pub fn set_output(&mut self, output: u8, high: bool) -> bool {
        set(&mut self.state.digital_outputs, output, high)
    }

    /// Sets an analogue output [V], which is wired to the input of the same number; `false` if there is no such
    /// output, or the voltage is out of range.
    pub fn set_voltage(&mut self, output: u8, volts: f64) -> bool {
        let channels = self.state.analog_outputs.iter_mut().zip(&mut self.state.analog_inputs).take(ANALOG.len());
        let Some((to, wired)) = channels.into_iter().nth(output.into()) else { return false };
        let valid = (0.0..=MAX_VOLTAGE).contains(&volts);
        if valid {
            (*to, *wired) = (volts, volts);
        }
        valid
    }
}

fn set(bits: &mut u32, index: u8, high: bool) -> bool {
    if index >= DIGITAL {
        return false;
    }
    *bits = *bits & !(1 << index) | u32::from(high) << index;
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn channels_are_set_one_by_one_and_checked() {
        let mut io = SimIo::default();
        assert_eq!((io.state().digital_inputs, io.state().digital_outputs), (0xFF, 0));
        io.set_input(2, false);
        assert!(io.set_output(3, true) && io.set_output(0, true) && io.set_output(0, false) && !io.set_output(8, true));
        assert!(io.set_voltage(1, 2.5) && !io.set_voltage(0, 10.5) && !io.set_voltage(2, 1.0));
        let state = io.state();
        assert_eq!((state.digital_inputs, state.digital_outputs), (0b1111_1011, 0b1000));
        assert_eq!((state.analog_outputs[..2].to_vec(), state.analog_inputs[1]), (vec![0.0, 2.5], 2.5));
    }
}

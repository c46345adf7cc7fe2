//! Digital and analogue inputs and outputs of an arm's controller. Channels are numbered from 0: `di0`, `do0`, `ai0`,
//! `ao0`.

use crate::named::named;

/// Maximum number of digital inputs, and of digital outputs.
pub const MAX_DIGITAL: u8 = 32;
/// Maximum number of analogue inputs, and of analogue outputs.
pub const MAX_ANALOG: usize = 8;

named! {
    /// Unit of an analogue channel.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum AnalogUnit {
        /// Voltage [V].
        Volt = "V",
        /// Current [A].
        Ampere = "A",
    }
}

/// The channels of a controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct IoInfo {
    /// Number of digital inputs, at most [`MAX_DIGITAL`].
    pub digital_inputs: u8,
    /// Number of digital outputs, at most [`MAX_DIGITAL`].
    pub digital_outputs: u8,
    /// Unit of each analogue input, at most [`MAX_ANALOG`].
    pub analog_inputs: &'static [AnalogUnit],
    /// Unit of each analogue output, at most [`MAX_ANALOG`].
    pub analog_outputs: &'static [AnalogUnit],
}

/// Levels of all channels at one time. Entries without a channel are zero.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct IoState {
    /// Levels of the digital inputs: bit i is input i, 1 = high.
    pub digital_inputs: u32,
    /// Levels of the digital outputs: bit i is output i, 1 = high.
    pub digital_outputs: u32,
    /// Values of the analogue inputs, in their units.
    pub analog_inputs: [f64; MAX_ANALOG],
    /// Values of the analogue outputs, in their units.
    pub analog_outputs: [f64; MAX_ANALOG],
}

impl IoState {
    /// Returns whether a digital input is high.
    pub fn input(&self, index: u8) -> bool {
        self.digital_inputs.checked_shr(index.into()).unwrap_or(0) & 1 != 0
    }

    /// Returns whether a digital output is high.
    pub fn output(&self, index: u8) -> bool {
        self.digital_outputs.checked_shr(index.into()).unwrap_or(0) & 1 != 0
    }
}

/// A channel that can be set, and its new value.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum OutputValue {
    /// Level of a digital output.
    Digital(u8, bool),
    /// Value of an analogue output, in its unit.
    Analog(u8, f64),
}

/// A digital input that stops the arm: while it is open, the arm is held.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StopInput {
    /// Number of the digital input.
    pub input: u8,
    /// Level of the open input: `false` = low. With `false`, a broken wire or a missing supply counts as open.
    pub open: bool,
}

impl StopInput {
    /// Returns whether the input is open.
    pub fn is_open(self, io: &IoState) -> bool {
        io.input(self.input) == self.open
    }
}

/// Returns the number of a channel: 3 of `do3` with the prefix `do`.
pub fn channel(name: &str, prefix: &str) -> Option<u8> {
    let digits = name.strip_prefix(prefix)?;
    let plain = digits.bytes().all(|b| b.is_ascii_digit()) && (digits == "0" || !digits.starts_with('0'));
    digits.parse().ok().filter(|number| plain && *number < MAX_DIGITAL)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stop_input_is_open_at_its_level_only() {
        let io = IoState { digital_inputs: 0b101, ..IoState::default() };
        let open = |input, open| StopInput { input, open }.is_open(&io);
        assert_eq!([open(0, false), open(1, false), open(2, false)], [false, true, false]);
        assert_eq!([open(0, true), open(1, true), open(2, true)], [true, false, true]);
        assert!(open(200, false), "an input that the state lacks is low");
    }

    #[test]
    fn channels_have_one_name() {
        assert_eq!([channel("di0", "di"), channel("do31", "do"), channel("ao2", "ao")], [Some(0), Some(31), Some(2)]);
        for wrong in ["di", "di-1", "di01", "di+1", "di32", "do1", "DI1", "di1 "] {
            assert_eq!(channel(wrong, "di"), None, "{wrong}");
        }
    }
}

//! RS-485 at the tool connector of an e-Series or UR-Series arm. The program that the adapter starts sets it up; the
//! vendor's RS485 URCap, or tool forwarding of PolyScope X, carries its bytes over a TCP port.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::model::Model;
use dimos_hardware::check::{ConfigError, in_range};

/// Rates that the tool has [bit/s].
const RATES: [u32; 8] = [9600, 19_200, 38_400, 57_600, 115_200, 1_000_000, 2_000_000, 5_000_000];

/// Settings of the line, and the tool's supply.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ToolLine {
    /// Supply of the tool: 0, 12 or 24 [V].
    pub voltage: u8,
    /// Rate: 9600, 19200, 38400, 57600, 115200, 1000000, 2000000 or 5000000 [bit/s].
    pub baud: u32,
    /// Parity: 0 none, 1 odd, 2 even.
    pub parity: u8,
    /// Stop bits: 1 or 2.
    pub stop_bits: u8,
    /// Pause after which received bytes are passed on, 1 to 40 characters.
    #[schemars(range(min = 1, max = 40))]
    pub rx_idle_chars: f64,
    /// Pause before bytes are sent, 0 to 40 characters.
    #[schemars(range(min = 0, max = 40))]
    pub tx_idle_chars: f64,
}

impl Default for ToolLine {
    /// The defaults of the vendor's drivers.
    fn default() -> Self {
        Self { voltage: 0, baud: 115_200, parity: 0, stop_bits: 1, rx_idle_chars: 1.5, tx_idle_chars: 3.5 }
    }
}

impl ToolLine {
    /// Refuses settings that the tool does not have, and arms without such a line.
    pub(super) fn check(&self, model: Model) -> Result<(), ConfigError> {
        let wrong = |option: &str, what: &str| Err(ConfigError::new(format!("tool_line.{option}"), what));
        if model.is_cb3() {
            return Err(ConfigError::new("tool_line", format!("a {} has no RS-485 at its tool", model.name())));
        }
        if ![0, 12, 24].contains(&self.voltage) {
            return wrong("voltage", "the tool is supplied with 0, 12 or 24 V");
        }
        if !RATES.contains(&self.baud) {
            return wrong("baud", "the tool has 9600, 19200, 38400, 57600, 115200, 1000000, 2000000 or 5000000 bit/s");
        }
        if self.parity > 2 {
            return wrong("parity", "0 none, 1 odd, 2 even");
        }
        if ![1, 2].contains(&self.stop_bits) {
            return wrong("stop_bits", "1 or 2");
        }
        in_range("tool_line.rx_idle_chars", self.rx_idle_chars, (1.0, 40.0))?;
        in_range("tool_line.tx_idle_chars", self.tx_idle_chars, (0.0, 40.0))
    }

    /// Returns the lines of a program that set it up.
    pub(super) fn script(&self) -> String {
        let Self { voltage, baud, parity, stop_bits, rx_idle_chars, tx_idle_chars } = self;
        format!(
            "  set_tool_voltage({voltage})\n  set_tool_communication(True, {baud}, {parity}, {stop_bits}, \
             {rx_idle_chars:?}, {tx_idle_chars:?})\n"
        )
    }
}

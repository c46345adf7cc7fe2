//! Robotiq's two-finger grippers, on Modbus: on a serial line of this computer, at the tool connector of an arm, or
//! behind Modbus TCP.
//!
//! | file | what it has |
//! |---|---|
//! | [`protocol`] | the registers: action request, status, faults |
//! | [`adapter`] | the gripper as a peripheral |
//! | [`emulator`] | the gripper's side of the registers, with simulated fingers |
//! | [`ft300`] | the force/torque sensors FT 300: registers, adapter and emulator |

pub mod adapter;
pub mod emulator;
pub mod ft300;
pub mod protocol;
#[cfg(test)]
mod tests;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_hardware::check::{ConfigError, in_range};
use dimos_hardware::peripheral::{Part, PeripheralSpec};
use dimos_hardware::registry::{AdapterConfig, AddressForm, Level, OptionsSpec};
use dimos_hardware::sim::faults::{Fault, check_script};
use dimos_hardware::transport::line::{self, LineAddress};
use dimos_hardware::transport::modbus::Framing;

/// Rate of the line from the factory [bit/s].
pub const BAUD: u32 = 115_200;
/// Smallest and largest force between the fingers [N].
pub const FORCES: (f64, f64) = (20.0, 235.0);
/// Slowest and fastest speed of the opening [m/s].
pub const SPEEDS: (f64, f64) = (0.02, 0.15);

/// Options of the gripper.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// The gripper's number on its line, 1 to 247.
    #[schemars(range(min = 1, max = 247))]
    pub unit: u8,
    /// How telegrams are framed: `rtu` or `tcp`. Default: `tcp` at `tcp:HOST:PORT`, else `rtu`. `rtu` there is a
    /// server that carries the bytes of a serial line.
    pub framing: Option<Framing>,
    /// Largest force of commands that state none, 20 to 235 [N].
    #[schemars(range(min = 20, max = 235))]
    pub force: f64,
    /// Speed of commands that state none, as a fraction of 0.15 m/s. The slowest speed is 0.02 m/s.
    #[schemars(range(min = 0.01, max = 1))]
    pub speed: f64,
    /// Opening between the fingertips when the gripper is open [m]. The closed gripper is at 0.
    #[schemars(range(min = 0.001, max = 0.5))]
    pub stroke: f64,
    /// The gripper's own positions, 0 to 255, when it is open and when it is closed: after homing `dimos arm gripper`
    /// shows an opening of `stroke` and of 0 there. Fingertips change them.
    pub open_count: u8,
    /// See `open_count`.
    pub closed_count: u8,
    /// Settings of the emulator.
    pub sim: SimOptions,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            unit: 9,
            framing: None,
            force: 60.0,
            speed: 0.5,
            stroke: 0.085,
            open_count: 3,
            closed_count: 230,
            sim: SimOptions::default(),
        }
    }
}

/// Settings of the emulator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Default)]
#[serde(deny_unknown_fields, default)]
pub struct SimOptions {
    /// Whether it is homed when it starts.
    pub homed: bool,
    /// Faults, and when they begin (seconds after the first request).
    pub faults: Vec<Fault>,
}

fn address(text: &str) -> Result<String, String> {
    LineAddress::parse(text, BAUD).map(|address| address.to_string())
}

fn check(config: &AdapterConfig) -> Result<(), ConfigError> {
    let options: Options = config.options()?;
    if !(1..=247).contains(&options.unit) {
        return Err(ConfigError::new("unit", format!("unit is 1 to 247, not {}", options.unit)));
    }
    in_range("force", options.force, FORCES)?;
    in_range("speed", options.speed, (0.01, 1.0))?;
    in_range("stroke", options.stroke, (0.001, 0.5))?;
    if options.closed_count.saturating_sub(options.open_count) < 50 {
        let what = format!("closed_count is {}, at least 50 more than open_count", options.closed_count);
        return Err(ConfigError::new("closed_count", what));
    }
    if options.framing == Some(Framing::Tcp) && config.address.starts_with('/') {
        let hint = "remove it: a serial line has `rtu`";
        return Err(ConfigError::new("framing", "a serial line has no Modbus TCP").hint(hint));
    }
    check_script("robotiq_2f85", &options.sim.faults, emulator::PLAYABLE).map_err(|error| error.within("sim"))
}

/// The gripper's row.
pub const SPEC: PeripheralSpec = PeripheralSpec {
    name: "robotiq_2f85",
    about: "Robotiq 2F-85 on Modbus; 2F-140 and Hand-E with their own `stroke`",
    part: Part::Gripper,
    level: Level::Emulated,
    native_rate: 50.0,
    address: AddressForm { form: line::FORM, required: true, check: address },
    options: OptionsSpec::of::<Options>(),
    check,
    create: |config| Ok(Box::new(adapter::Robotiq2F::new(config)?)),
    emulate: Some(|config, place| Ok(Box::new(emulator::start(config, place)?))),
};

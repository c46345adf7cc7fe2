//! Any gripper on Modbus, by its registers in the blueprint: where its position is read and where it is sent, and as
//! far as it has them force, speed, a report of what it holds, faults and homing.

pub mod adapter;
pub mod emulator;
#[cfg(test)]
mod tests;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use dimos_core::arm::{ForceUnit, GripperUnit};
use dimos_hardware::check::ConfigError;
use dimos_hardware::peripheral::{Part, PeripheralSpec};
use dimos_hardware::registry::{AdapterConfig, AddressForm, Level, OptionsSpec};
use dimos_hardware::sim::faults::{Fault, check_script};
use dimos_hardware::transport::line::{self, LineAddress};
use dimos_hardware::transport::modbus::{Framing, Table};

/// Rate of a line whose address states none [bit/s].
pub const BAUD: u32 = 115_200;

/// Options of the gripper: its registers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct Options {
    /// The gripper's number on its line, 1 to 247.
    #[schemars(range(min = 1, max = 247))]
    pub unit: u8,
    /// How telegrams are framed: `rtu` or `tcp`. Default: `tcp` at `tcp:HOST:PORT`, else `rtu`.
    pub framing: Option<Framing>,
    /// Unit of its position: `m` of opening, or `rad` of a rotary jaw.
    #[schemars(with = "String")]
    pub position_unit: GripperUnit,
    /// Its position when closed and when open [`position_unit`]. Required.
    pub range: Option<[f64; 2]>,
    /// Where its position is read. Required.
    pub position: Option<Value>,
    /// Where a position is sent. Required.
    pub target: Option<Value>,
    /// Where the largest force is sent. Default: it has no force control.
    pub force: Option<Force>,
    /// Where the speed is sent. Default: it has no speed control.
    pub speed: Option<Speed>,
    /// What is written after each command, in this order: a register that starts the motion, for example.
    pub then: Vec<Write>,
    /// Whether it holds something. Default: it does not report that.
    pub holds: Option<Flag>,
    /// Whether it can be used. Default: always.
    pub homed: Option<Flag>,
    /// What is written to home it, in this order. Default: it needs none.
    pub home: Vec<Write>,
    /// Whether it reports a fault. Default: it reports none.
    pub fault: Option<Flag>,
    /// Settings of the emulator.
    pub sim: SimOptions,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            unit: 1,
            framing: None,
            position_unit: GripperUnit::Meters,
            range: None,
            position: None,
            target: None,
            force: None,
            speed: None,
            then: Vec::new(),
            holds: None,
            homed: None,
            home: Vec::new(),
            fault: None,
            sim: SimOptions::default(),
        }
    }
}

/// A register with a number that goes from one end of the range to the other.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Value {
    /// The register.
    pub register: u16,
    /// `holding` or `input`; what is sent goes to a holding register.
    #[serde(default)]
    pub table: Table,
    /// Its content when the gripper is closed.
    pub closed: u16,
    /// Its content when the gripper is open.
    pub open: u16,
}

/// The register of the largest force.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Force {
    /// The holding register.
    pub register: u16,
    /// Unit of forces: `N`, `Nm` or `%`.
    #[serde(default)]
    #[schemars(with = "String")]
    pub unit: ForceUnit,
    /// Smallest and largest force [`unit`].
    pub range: [f64; 2],
    /// Contents of the register at these.
    pub counts: [u16; 2],
    /// Force of commands that state none [`unit`].
    pub default: f64,
}

/// The register of the speed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Speed {
    /// The holding register.
    pub register: u16,
    /// Contents at rest and at the top speed.
    pub counts: [u16; 2],
    /// Fraction of the top speed of commands that state none, 0.01 to 1.
    #[serde(default = "full")]
    pub default: f64,
}

fn full() -> f64 {
    1.0
}

/// Something that is so if a register has certain contents.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Flag {
    /// The register.
    pub register: u16,
    /// `holding` or `input`.
    #[serde(default)]
    pub table: Table,
    /// The bits that count. Default: all.
    #[serde(default = "all_bits")]
    pub mask: u16,
    /// It is so if these bits have one of these contents.
    pub is: Vec<u16>,
}

fn all_bits() -> u16 {
    u16::MAX
}

impl Flag {
    /// Returns whether it is so at these contents.
    fn holds(&self, contents: u16) -> bool {
        self.is.contains(&(contents & self.mask))
    }
}

/// A value for a holding register.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Write {
    /// The register.
    pub register: u16,
    /// The value.
    pub value: u16,
}

/// Settings of the emulator.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema, Default)]
#[serde(deny_unknown_fields, default)]
pub struct SimOptions {
    /// Faults, and when they begin (seconds after the first request).
    pub faults: Vec<Fault>,
}

/// The registers that are there in any case.
#[derive(Debug, Clone, Copy)]
struct Needed {
    range: [f64; 2],
    position: Value,
    target: Value,
}

impl Options {
    /// Returns what must be given.
    fn needed(&self) -> Result<Needed, ConfigError> {
        let missing = |option: &str, example: &str| {
            ConfigError::new("", format!("`{option}` is missing")).hint(format!("for example `{option}: {example}`"))
        };
        Ok(Needed {
            range: self.range.ok_or_else(|| missing("range", "[0, 0.05]"))?,
            position: self.position.ok_or_else(|| missing("position", "{register: 514, closed: 0, open: 1000}"))?,
            target: self.target.ok_or_else(|| missing("target", "{register: 259, closed: 0, open: 1000}"))?,
        })
    }

    fn read(config: &AdapterConfig) -> Result<(Self, Needed), ConfigError> {
        let options: Self = config.options()?;
        let needed = options.needed()?;
        let wrong = |option: &str, what: &str| Err(ConfigError::new(option, what));
        if !(1..=247).contains(&options.unit) {
            return wrong("unit", "unit is 1 to 247");
        }
        if options.position_unit == GripperUnit::OnOff {
            return wrong("position_unit", "position_unit is `m` or `rad`");
        }
        let [closed, open] = needed.range;
        if !(closed.is_finite() && open.is_finite() && closed != open) {
            return wrong("range", "the gripper has the same position when closed and when open");
        }
        for (option, value) in [("position", needed.position), ("target", needed.target)] {
            if value.closed == value.open {
                return wrong(option, "`closed` and `open` are the same");
            }
        }
        if let Some(Force { range: [least, most], default, .. }) = options.force
            && !(0.0 <= least && least < most && (least..=most).contains(&default))
        {
            return wrong("force", "a range from a smaller to a larger force, and a default within it");
        }
        if options.speed.is_some_and(|speed| !(0.01..=1.0).contains(&speed.default)) {
            return wrong("speed.default", "a fraction of the top speed, 0.01 to 1");
        }
        if options.homed.is_some() == options.home.is_empty() {
            return wrong("home", "`home` and `homed` belong together: what is written, and when it is done");
        }
        check_script("modbus_gripper", &options.sim.faults, emulator::PLAYABLE).map_err(|error| error.within("sim"))?;
        Ok((options, needed))
    }
}

/// The gripper's row.
pub const SPEC: PeripheralSpec = PeripheralSpec {
    name: "modbus_gripper",
    about: "any gripper on Modbus, by its registers in the blueprint",
    part: Part::Gripper,
    level: Level::Emulated,
    native_rate: 25.0,
    address: AddressForm {
        form: line::FORM,
        required: true,
        check: |text| LineAddress::parse(text, BAUD).map(|address| address.to_string()),
    },
    options: OptionsSpec::of::<Options>(),
    check: |config| Options::read(config).map(drop),
    create: |config| Ok(Box::new(adapter::ModbusGripper::new(config)?)),
    emulate: Some(|config, place| Ok(Box::new(emulator::start(config, place)?))),
};

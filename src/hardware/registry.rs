//! The compile-time adapter table: one row per arm, in `arms/mod.rs`. `dimos list-adapters` prints it.

use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::de::DeserializeOwned;

use crate::hardware::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};
use crate::hardware::check::{Checked, ConfigError};
use crate::hardware::sim::faults::Fault;
use crate::joint::{ControlMode, Joints};
use crate::named::named;
use crate::yaml;

named! {
    /// How far an adapter has been proven without its hardware.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum Level {
        /// Passes the conformance suite against a double at its SDK or wire boundary.
        Conformant = "conformant",
        /// Has an emulator of its real wire format, and passes the suite against it.
        Emulated = "emulated",
    }
}

/// The form of an adapter's `address`.
#[derive(Debug, Clone, Copy)]
pub struct AddressForm {
    /// For people, as in a usage line: `HOST[:PORT]`.
    pub form: &'static str,
    /// Whether a blueprint must give one.
    pub required: bool,
    /// The address in full, with whatever it leaves to defaults; or what is wrong with it, in a sentence without full
    /// stop. Never asks the network.
    pub check: fn(&str) -> Result<String, String>,
}

/// The adapter's own options: how to check them in a blueprint, and their JSON Schema.
#[derive(Debug, Clone, Copy)]
pub struct OptionsSpec {
    /// Reports every mistake in the options at `node` into the tree's diagnostics.
    pub check: fn(tree: &mut yaml::Tree, node: yaml::NodeId),
    /// The options' JSON Schema.
    pub schema: fn(&mut SchemaGenerator) -> Schema,
}

impl OptionsSpec {
    /// Options of type `T`, which should `deny_unknown_fields` and have a default for each.
    pub const fn of<T: DeserializeOwned + JsonSchema>() -> Self {
        Self { check: yaml::check::<T>, schema: |generator| T::json_schema(generator) }
    }
}

/// What an adapter is made from.
#[derive(Debug, Clone)]
pub struct AdapterConfig {
    /// The arm's name in the blueprint, for messages.
    pub hardware_id: String,
    /// Where the device is, in the adapter's own form; empty where none is needed.
    pub address: String,
    /// Number of joints the blueprint names.
    pub dof: usize,
    /// The adapter's own options, as given in the blueprint (an object).
    pub options: serde_json::Value,
}

/// A running emulator of one arm: the controller's side of the same wire, with a joint plant behind it.
/// It ends when it is dropped.
pub trait Emulator: Send {
    /// The address at which the adapter reaches it.
    fn address(&self) -> String;
    /// Lets a fault happen `fault.at` seconds from now; an error names the kinds that it can play.
    fn inject(&self, fault: Fault) -> Result<(), String>;
    /// Where the joints truly are behind the wire [rad], for checks and for people; `None` when it does not tell.
    fn true_positions(&self) -> Option<Joints> {
        None
    }
}

/// Where an emulator listens, as far as the arm's transport has a choice.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum EmulatorAddress {
    /// Where only this program finds it, and no privilege is needed: free loopback ports, a bus in memory.
    #[default]
    InProcess,
    /// The arm's own ports on this address, which must be a loopback address.
    Bind(IpAddr),
    /// A CAN interface of the system.
    Can(String),
    /// A new pseudo-terminal.
    Pty,
}

impl EmulatorAddress {
    /// Where an emulator on TCP listens whose arm has its server at `port`; an error where that cannot be.
    pub fn tcp(&self, port: u16) -> AdapterResult<SocketAddr> {
        match self {
            Self::InProcess => Ok(SocketAddr::from(([127, 0, 0, 1], 0))),
            Self::Bind(address) if address.is_loopback() => Ok(SocketAddr::new(*address, port)),
            Self::Bind(address) => Err(AdapterError::Rejected(format!(
                "{address} is not a loopback address: emulators are reachable from this computer only"
            ))),
            Self::Can(_) | Self::Pty => {
                Err(AdapterError::Rejected("this arm speaks TCP: its emulator has a loopback address".to_owned()))
            }
        }
    }
}

/// Starts an emulator for an arm's configuration; `Rejected` for a place that the arm's transport does not have.
pub type Emulate = fn(&AdapterConfig, &EmulatorAddress) -> AdapterResult<Box<dyn Emulator>>;

/// One row of the table.
#[derive(Debug, Clone, Copy)]
pub struct AdapterSpec {
    /// `adapter_type` in a blueprint.
    pub name: &'static str,
    /// One line: which arms this is for.
    pub about: &'static str,
    /// How far it has been proven.
    pub level: Level,
    /// `tcp`, `can`, `serial`, `memory` …
    pub transport: &'static str,
    /// Fewest and most joints.
    pub dof: (usize, usize),
    /// The modes it can be commanded in.
    pub modes: &'static [ControlMode],
    /// Units on the wire, for people: `deg, mm`.
    pub wire_units: &'static str,
    /// How often the device delivers its state [Hz].
    pub native_rate: f64,
    /// How far a joint at rest may be from its setpoint under load [rad].
    pub accuracy: f64,
    /// Time from a setpoint to the measured motion that follows it [s]; `dimos adapter test --lag` measures it.
    pub lag: f64,
    /// Age limit of a state: an arm without a newer one is held. At least three of the device's periods are granted.
    pub stale_after: Duration,
    /// The form of `address`.
    pub address: AddressForm,
    /// Whether the arm keeps its pose when its motors are disabled (brakes), or falls.
    pub holds_when_disabled: bool,
    /// Whether it can have a gripper.
    pub gripper: bool,
    /// The adapter's own options.
    pub options: OptionsSpec,
    /// Whether number of joints and options go together, and what follows from them. Never asks the device.
    pub check: fn(&AdapterConfig) -> Result<Checked, ConfigError>,
    /// Makes an adapter. Does not connect.
    pub create: fn(&AdapterConfig) -> Result<Box<dyn ManipulatorAdapter>, AdapterError>,
    /// Starts an emulator of the arm, for `address: sim`; `None` when the adapter is its own plant.
    pub emulate: Option<Emulate>,
}

/// An adapter that this build does not have: of another system, or behind a cargo feature that is off.
#[derive(Debug, Clone, Copy)]
pub struct Absent {
    /// What its `adapter_type` would be.
    pub name: &'static str,
    /// One line: which arms it is for.
    pub about: &'static str,
    /// The way to get it, as a sentence: `build with --features can`.
    pub remedy: &'static str,
}

/// The address that asks for the emulator.
pub const SIM: &str = "sim";

/// An adapter table: the built-in rows and those of the program that embeds this crate.
#[derive(Debug, Clone, Default)]
pub struct Registry {
    rows: Vec<AdapterSpec>,
    absent: Vec<Absent>,
}

impl Registry {
    /// The arms in the box.
    pub fn builtin() -> Self {
        Self { rows: crate::hardware::arms::TABLE.to_vec(), absent: crate::hardware::arms::ABSENT.to_vec() }
    }

    /// The arms in the box and `more`, which win over rows of the same name.
    pub fn with(more: &[AdapterSpec]) -> Self {
        let mut registry = Self::builtin();
        registry.rows.retain(|row| !more.iter().any(|m| m.name == row.name));
        registry.rows.extend_from_slice(more);
        registry
    }

    /// The same table, that also knows of adapters which this build does not have.
    pub fn lacking(mut self, more: &[Absent]) -> Self {
        self.absent.extend_from_slice(more);
        self
    }

    /// The adapters that this build does not have.
    pub fn absent(&self) -> impl Iterator<Item = &Absent> {
        self.absent.iter().filter(|absent| self.get(absent.name).is_none())
    }

    /// All rows, in table order.
    pub fn rows(&self) -> &[AdapterSpec] {
        &self.rows
    }

    /// The row of a name.
    pub fn get(&self, name: &str) -> Option<&AdapterSpec> {
        self.rows.iter().find(|row| row.name == name)
    }

    /// All names, in table order.
    pub fn names(&self) -> Vec<&'static str> {
        self.rows.iter().map(|row| row.name).collect()
    }
}

/// Names of the built-in adapters.
///
/// ```
/// assert!(dimos::hardware::registry::available().contains(&"yourarm"));
/// ```
pub fn available() -> Vec<&'static str> {
    Registry::builtin().names()
}

/// Makes a built-in adapter by name, the way a run does; it is not connected yet. The address is in the adapter's own
/// form (`dimos list-adapters` shows it). An error names the adapters that there are, or what is wrong with the
/// address.
///
/// ```
/// use dimos::hardware::registry;
///
/// let adapter = registry::create("yourarm", "192.168.1.100", 6)?;
/// assert_eq!(adapter.get_dof(), 6);
/// assert!(!adapter.is_connected());
/// assert!(registry::create("yuorarm", "192.168.1.100", 6).is_err());
/// # Ok::<(), dimos::hardware::adapter::AdapterError>(())
/// ```
pub fn create(name: &str, address: &str, dof: usize) -> AdapterResult<Box<dyn ManipulatorAdapter>> {
    (builtin(name)?.create)(&plain(name, address, dof))
}

/// Starts the emulator of a built-in adapter, which then reaches it at [`Emulator::address`]. `Unsupported` where the
/// adapter has none because it is its own plant.
///
/// ```
/// use dimos::hardware::registry;
///
/// let emulator = registry::emulate("yourarm", 6)?;
/// let mut adapter = registry::create("yourarm", &emulator.address(), 6)?;
/// adapter.connect()?;
/// assert!(adapter.is_connected());
/// let mut positions = [0.0; 6]; // [rad]
/// adapter.read_joint_positions(&mut positions)?;
/// adapter.disconnect();
/// # Ok::<(), dimos::hardware::adapter::AdapterError>(())
/// ```
pub fn emulate(name: &str, dof: usize) -> AdapterResult<Box<dyn Emulator>> {
    let start = builtin(name)?.emulate.ok_or(AdapterError::Unsupported)?;
    start(&plain(name, SIM, dof), &EmulatorAddress::InProcess)
}

fn builtin(name: &str) -> AdapterResult<&'static AdapterSpec> {
    let table = crate::hardware::arms::TABLE;
    table.iter().find(|row| row.name == name).ok_or_else(|| {
        let absent = crate::hardware::arms::ABSENT.iter().find(|absent| absent.name == name);
        AdapterError::Rejected(match absent {
            Some(absent) => format!("adapter {name} is not in this build\nhint: {}", absent.remedy),
            None => format!("no adapter named {name:?}; there are {}", available().join(", ")),
        })
    })
}

/// A configuration without options, for an arm named like its adapter.
fn plain(name: &str, address: &str, dof: usize) -> AdapterConfig {
    AdapterConfig { hardware_id: name.to_owned(), address: address.to_owned(), dof, options: serde_json::Value::Null }
}

//! The compile-time adapter table: one row per arm, in `arms/mod.rs`. `dimos list-adapters` prints it.

use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use schemars::{JsonSchema, Schema, SchemaGenerator};
use serde::de::DeserializeOwned;

use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};
use crate::check::{Checked, ConfigError};
use crate::peripheral::PeripheralSpec;
use crate::service::OpenService;
use crate::sim::faults::Fault;
use crate::wire::Wire;
use dimos_core::arm::{AfterGap, Load, Setpoint, Topology};
use dimos_core::joint::{ControlMode, Joints};
use dimos_core::named::named;
use dimos_yaml as yaml;

named! {
    /// How an adapter was tested without its hardware.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    pub enum Level {
        /// Passes the conformance suite against a mock at its SDK or wire boundary.
        Conformant = "conformant",
        /// Has an emulator with the real wire protocol, and passes the suite against it.
        Emulated = "emulated",
    }
}

/// How an arm may be led by hand, for `dimos arm teach`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Teach {
    /// Its controller compensates gravity: [`HandGuiding`](crate::adapter::HandGuiding).
    HandGuiding,
    /// With its motors off, supported by the hand that leads it: only for a light arm.
    MotorsOff,
    /// It may not, for this reason: a sentence without full stop.
    No(&'static str),
}

/// The form of an adapter's `address`.
#[derive(Debug, Clone, Copy)]
pub struct AddressForm {
    /// Usage text: `HOST[:PORT]`.
    pub form: &'static str,
    /// Whether a blueprint must state an address.
    pub required: bool,
    /// Returns the complete address, with defaults filled in; the error is a sentence without full stop. Never uses the
    /// network.
    pub check: fn(&str) -> Result<String, String>,
}

/// Checks an adapter's own options in a blueprint, and provides their JSON Schema.
#[derive(Debug, Clone, Copy)]
pub struct OptionsSpec {
    /// Reports every mistake in the options at `node` into the tree's diagnostics.
    pub check: fn(tree: &mut yaml::Tree, node: yaml::NodeId),
    /// The options' JSON Schema.
    pub schema: fn(&mut SchemaGenerator) -> Schema,
}

impl OptionsSpec {
    /// Returns the spec of options of type `T`, which should `deny_unknown_fields` and have a default for each.
    pub const fn of<T: DeserializeOwned + JsonSchema>() -> Self {
        Self { check: yaml::check::<T>, schema: |generator| T::json_schema(generator) }
    }
}

/// Configuration of an adapter.
#[derive(Debug, Clone)]
pub struct AdapterConfig {
    /// The arm's `hardware_id`, for messages.
    pub hardware_id: String,
    /// Address of the device, in the adapter's own form; empty if none is needed.
    pub address: String,
    /// Number of joints in the blueprint.
    pub dof: usize,
    /// The adapter's own options, as given in the blueprint (an object).
    pub options: serde_json::Value,
}

/// A running emulator of one arm: the controller's side of the protocol, with simulated joints. It ends when it is
/// dropped.
pub trait Emulator: Send {
    /// Returns the address for the adapter.
    fn address(&self) -> String;
    /// Injects a fault that begins `fault.at` seconds from now; the error lists the faults that the emulator can play.
    fn inject(&self, fault: Fault) -> Result<(), String>;
    /// Returns what is true of the emulated arm, whatever it reports; for checks and for display.
    fn truth(&self) -> Truth {
        Truth::default()
    }
    /// Returns the true joint positions [rad]; `None` if unknown.
    fn true_positions(&self) -> Option<Joints> {
        self.truth().positions
    }
}

/// What is true of an emulated arm. What is unknown is `None`.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Truth {
    /// Joint positions [rad].
    pub positions: Option<Joints>,
    /// Whether all motors of its joints are on, whether or not a client is connected; also `None` if its controller
    /// holds the arm without being asked.
    pub motors_on: Option<bool>,
    /// How often a motor of its joints was switched on or off.
    pub motor_switches: Option<u32>,
    /// Temperatures of the joints' drives [°C].
    pub temperatures: Option<Joints>,
    /// Efforts of the joints' motors [Nm].
    pub efforts: Option<Joints>,
    /// The last setpoint that arrived whole, with what it had besides positions.
    pub setpoint: Option<Setpoint>,
    /// The load at the flange that its controller calculates with.
    pub load: Option<Load>,
    /// Position of its gripper, in the unit of the adapter [m or rad].
    pub gripper_position: Option<f64>,
    /// Largest force that its gripper was given, in the unit of the adapter's force; `None` without force control.
    pub gripper_force: Option<f64>,
}

/// Where an emulator listens.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum EmulatorAddress {
    /// For this program only, without privileges: free loopback ports, or a bus in memory.
    #[default]
    InProcess,
    /// On the arm's own ports of this address, which must be a loopback address.
    Bind(IpAddr),
    /// On a CAN interface of the system.
    Can(String),
    /// On a new pseudo-terminal.
    Pty,
}

impl EmulatorAddress {
    /// Returns a number for the serial number of an emulated arm, another one at each address. `None`: it has the usual
    /// one, as all have that listen for this program only or at 127.0.0.1.
    pub fn number(&self) -> Option<u32> {
        match self {
            Self::Bind(IpAddr::V4(ip)) => Some(ip.to_bits() & 0x00FF_FFFF).filter(|number| *number != 1),
            _ => None,
        }
    }

    /// Returns the TCP address of an emulator whose arm has its server at `port`.
    pub fn tcp(&self, port: u16) -> AdapterResult<SocketAddr> {
        match self {
            Self::InProcess => Ok(SocketAddr::from(([127, 0, 0, 1], 0))),
            Self::Bind(address) if address.is_loopback() => Ok(SocketAddr::new(*address, port)),
            Self::Bind(address) => Err(AdapterError::Rejected(format!(
                "{address} is not a loopback address: only programs of this computer may connect"
            ))),
            Self::Can(_) | Self::Pty => {
                Err(AdapterError::Rejected("this arm speaks TCP: its emulator has a loopback address".to_owned()))
            }
        }
    }
}

/// Starts an emulator for an arm's configuration; `Rejected` for an address that the arm's transport does not support.
pub type Emulate = fn(&AdapterConfig, &EmulatorAddress) -> AdapterResult<Box<dyn Emulator>>;

/// One row of the table.
#[derive(Debug, Clone, Copy)]
pub struct AdapterSpec {
    /// `adapter_type` in a blueprint.
    pub name: &'static str,
    /// Which arms this is for, in one line.
    pub about: &'static str,
    /// How it was tested without the hardware.
    pub level: Level,
    /// `tcp`, `can`, `serial`, `memory` …
    pub transport: &'static str,
    /// Minimum and maximum number of joints.
    pub dof: (usize, usize),
    /// The modes that can be commanded.
    pub modes: &'static [ControlMode],
    /// Units of the protocol: `deg, mm`.
    pub wire_units: &'static str,
    /// Rate at which the device delivers its state [Hz].
    pub native_rate: f64,
    /// Maximum position error of a joint at rest under load [rad].
    pub accuracy: f64,
    /// Smallest step of its position readings [rad].
    pub resolution: f64,
    /// An error code of the device that stops it: the conformance suite plays it.
    pub error_code: u16,
    /// Largest distance of a joint below its setpoint under load, beyond `accuracy` [rad].
    pub droop: f64,
    /// Furthest that the setpoint of a held joint is taken back towards the joint [rad]; 0: the arm's own stop takes
    /// the pressure off.
    pub relief: f64,
    /// How far outside its range a joint may rest and still be enabled [rad].
    pub outside: f64,
    /// Time from a setpoint to the measured motion that follows it [s]; `dimos adapter test --lag` measures it.
    pub lag: f64,
    /// Longest time without a setpoint that the controller bridges.
    pub gap_tolerance: Duration,
    /// What it does beyond that time.
    pub after_gap: AfterGap,
    /// How the joints' readings count turns; [`Checked::topology`] has those of single joints.
    pub topology: Topology,
    /// Maximum age of a state, beyond which the arm is held; at least three periods of the device.
    pub stale_after: Duration,
    /// The form of `address`.
    pub address: AddressForm,
    /// Whether the arm keeps its pose when its motors are disabled (brakes), or falls.
    pub holds_when_disabled: bool,
    /// How it may be led by hand.
    pub teach: Teach,
    /// Whether it can have a gripper.
    pub gripper: bool,
    /// The adapter's own options.
    pub options: OptionsSpec,
    /// Checks whether number of joints and options are consistent, and returns the limits. Never uses the device.
    pub check: fn(&AdapterConfig) -> Result<Checked, ConfigError>,
    /// Creates an adapter. Does not connect.
    pub create: fn(&AdapterConfig) -> Result<Box<dyn ManipulatorAdapter>, AdapterError>,
    /// Starts an emulator of the arm, for `address: sim`; `None` if the adapter simulates the arm itself.
    pub emulate: Option<Emulate>,
    /// Opens the arm's bus for work outside a run, such as calibration; `None` if there is none.
    pub service: Option<OpenService>,
    /// How captures of its protocol are read; `None` if nothing goes over a wire.
    pub wire: Option<Wire>,
}

/// An adapter that this build lacks: of another operating system, or of a disabled cargo feature.
#[derive(Debug, Clone, Copy)]
pub struct Absent {
    /// Its `adapter_type`.
    pub name: &'static str,
    /// Which arms it is for, in one line.
    pub about: &'static str,
    /// How to get it: `build with --features can`.
    pub remedy: &'static str,
}

/// The address that starts the emulator.
pub const SIM: &str = "sim";

/// An adapter table: rows of arms and of their peripherals, and adapters that a build lacks.
#[derive(Debug, Clone, Default)]
pub struct Registry {
    rows: Vec<AdapterSpec>,
    peripherals: Vec<PeripheralSpec>,
    absent: Vec<Absent>,
}

impl Registry {
    /// Adds adapters, which replace rows of the same name.
    pub fn with(mut self, more: &[AdapterSpec]) -> Self {
        self.rows.retain(|row| !more.iter().any(|m| m.name == row.name));
        self.rows.extend_from_slice(more);
        self
    }

    /// Adds peripherals, which replace rows of the same name.
    pub fn with_peripherals(mut self, more: &[PeripheralSpec]) -> Self {
        self.peripherals.retain(|row| !more.iter().any(|m| m.name == row.name));
        self.peripherals.extend_from_slice(more);
        self
    }

    /// Returns the rows of peripherals, in table order.
    pub fn peripherals(&self) -> &[PeripheralSpec] {
        &self.peripherals
    }

    /// Returns the peripheral of a name.
    pub fn peripheral(&self, name: &str) -> Option<&PeripheralSpec> {
        self.peripherals.iter().find(|row| row.name == name)
    }

    /// Adds adapters that this build lacks.
    pub fn lacking(mut self, more: &[Absent]) -> Self {
        self.absent.extend_from_slice(more);
        self
    }

    /// Returns the adapters that this build lacks.
    pub fn absent(&self) -> impl Iterator<Item = &Absent> {
        self.absent.iter().filter(|absent| self.get(absent.name).is_none())
    }

    /// Returns all rows, in table order.
    pub fn rows(&self) -> &[AdapterSpec] {
        &self.rows
    }

    /// Returns the row of a name.
    pub fn get(&self, name: &str) -> Option<&AdapterSpec> {
        self.rows.iter().find(|row| row.name == name)
    }

    /// Returns all names, in table order.
    pub fn names(&self) -> Vec<&'static str> {
        self.rows.iter().map(|row| row.name).collect()
    }
}

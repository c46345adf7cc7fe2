//! The contract with a device that is at an arm and has its own connection: a gripper on another bus, a force/torque
//! sensor. [`Peripheral`] is to it what [`ManipulatorAdapter`](crate::adapter::ManipulatorAdapter) is to an arm. Its
//! device thread ([`device::peripheral`](crate::device::peripheral)) makes all calls; the arm's commands and readings
//! pass through that of the arm.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::adapter::{AdapterError, AdapterResult, ForceTorque, Gripper};
use crate::check::ConfigError;
use crate::registry::{AdapterConfig, AddressForm, Emulate, Level, OptionsSpec};
use dimos_core::named::named;

named! {
    /// The part of an arm that a peripheral is, and its key in `hardware[]` of a blueprint.
    #[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
    #[serde(rename_all = "snake_case")]
    pub enum Part {
        /// A gripper.
        Gripper = "gripper",
        /// A force/torque sensor between flange and tool.
        ForceTorque = "force_torque",
    }
}

impl Part {
    /// Returns it with its words apart.
    pub fn text(self) -> &'static str {
        match self {
            Self::Gripper => "gripper",
            Self::ForceTorque => "force/torque sensor",
        }
    }
}

/// Description of a connected peripheral.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct PeripheralInfo {
    /// Vendor.
    pub vendor: String,
    /// Model.
    pub model: String,
    /// Firmware version, if the device reports it.
    pub firmware_version: Option<String>,
    /// Serial number, if the device reports it.
    pub serial_number: Option<String>,
}

/// Whether a peripheral can be used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Condition {
    /// It can.
    #[default]
    Ready,
    /// It must be homed first, which moves its fingers.
    NotHomed,
    /// It is being homed.
    Homing,
    /// It reports an error: its code, and what that means.
    Fault(i32, &'static str),
}

impl Condition {
    /// Returns its name in rpc.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ready => "ready",
            Self::NotHomed => "not_homed",
            Self::Homing => "homing",
            Self::Fault(..) => "fault",
        }
    }

    /// Fails unless it is ready: the error is the refusal of a command to the gripper of `arm`, with what to do.
    pub fn ready(self, arm: &str) -> AdapterResult<()> {
        let home = format!("hint: `dimos arm gripper {arm} home`, which moves its fingers");
        Err(AdapterError::Rejected(match self {
            Self::Ready => return Ok(()),
            Self::NotHomed => format!("the gripper is not homed\n{home}"),
            Self::Homing => "the gripper is being homed\nhint: wait for its end".to_owned(),
            Self::Fault(code, text) => format!("the gripper reports fault {code}: {text}\n{home}"),
        }))
    }
}

/// A device with its own connection. One device thread owns it and makes all calls. Optional parts as with an arm: it
/// has those of its [`Part`].
pub trait Peripheral: Send {
    /// Connects and verifies the device. Moves and activates nothing.
    fn connect(&mut self) -> AdapterResult<PeripheralInfo>;
    /// Closes the connection. Never fails; has no effect when not connected. A gripper keeps what it holds.
    fn disconnect(&mut self);
    /// Returns whether the connection is up, without asking the device.
    fn is_connected(&self) -> bool;
    /// Reads the device's state, from which the methods of its parts answer until the next reading.
    fn read(&mut self) -> AdapterResult<()>;
    /// Returns whether it can be used, as read last.
    fn condition(&self) -> Condition {
        Condition::Ready
    }
    /// Begins what the device needs before its first command, if that moves it: activation, a search for its ends.
    /// [`condition`](Self::condition) shows the end. `Unsupported` for one that needs none.
    fn home(&mut self) -> AdapterResult<()> {
        Err(AdapterError::Unsupported)
    }
    /// Ends homing where the fingers are; what else moves is held by a command.
    fn halt(&mut self) -> AdapterResult<()> {
        Ok(())
    }
    /// Clears the device's error, as far as that moves nothing.
    fn clear_errors(&mut self) -> AdapterResult<()> {
        Ok(())
    }
    /// Returns whether the arm must be enabled first: its controller powers the device or its line.
    fn waits_for_arm(&self) -> bool {
        false
    }
    /// Returns its gripper. Units and ranges are known before it is connected.
    fn gripper(&mut self) -> Option<&mut dyn Gripper> {
        None
    }
    /// Returns its force/torque sensor.
    fn force_torque(&mut self) -> Option<&mut dyn ForceTorque> {
        None
    }
}

/// One row of the table of peripherals.
#[derive(Debug, Clone, Copy)]
pub struct PeripheralSpec {
    /// `adapter_type` in a blueprint.
    pub name: &'static str,
    /// Which devices this is for, in one line.
    pub about: &'static str,
    /// Which part of an arm it is.
    pub part: Part,
    /// How it was tested without the hardware.
    pub level: Level,
    /// Rate at which its state is read [Hz].
    pub native_rate: f64,
    /// The form of `address`.
    pub address: AddressForm,
    /// Its own options.
    pub options: OptionsSpec,
    /// Checks the options against each other. Never uses the device.
    pub check: fn(&AdapterConfig) -> Result<(), ConfigError>,
    /// Creates an adapter. Does not connect.
    pub create: fn(&AdapterConfig) -> Result<Box<dyn Peripheral>, AdapterError>,
    /// Starts an emulator, for `address: sim`.
    pub emulate: Option<Emulate>,
}

//! Owns the arms: a folder each, with adapter, protocol, emulator and a row of the table. No arm uses another. Used by
//! the run; what an adapter needs is in `dimos-hardware`. A new arm is one folder and one line here.

#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

use dimos_hardware::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};
use dimos_hardware::registry::{Absent, AdapterConfig, AdapterSpec, Emulator, EmulatorAddress, Registry, SIM};

pub mod franka;
pub mod mock;
pub mod piper;
pub mod remote;
pub mod so101;
pub mod ur;
pub mod xarm;
pub mod yourarm;

/// The compile-time adapter table.
pub const TABLE: &[AdapterSpec] =
    &[mock::SPEC, yourarm::SPEC, xarm::SPEC, piper::SPEC, so101::SPEC, ur::SPEC, franka::SPEC, remote::SPEC];

/// Adapters that this build lacks because their cargo feature is off. No built-in adapter has one.
pub const ABSENT: &[Absent] = &[];

/// Returns the table of the built-in adapters.
pub fn registry() -> Registry {
    Registry::default().with(TABLE).lacking(ABSENT)
}

/// Returns the names of the built-in adapters.
///
/// ```
/// assert!(dimos_arms::available().contains(&"yourarm"));
/// ```
pub fn available() -> Vec<&'static str> {
    registry().names()
}

/// Creates a built-in adapter by name, as a run does; it is not connected yet. The address has the adapter's own form
/// (`dimos list-adapters` shows it). The error lists the adapters, or describes what is wrong with the address.
///
/// ```
/// use dimos_arms as registry;
///
/// let adapter = registry::create("yourarm", "192.168.1.100", 6)?;
/// assert_eq!(adapter.get_dof(), 6);
/// assert!(!adapter.is_connected());
/// assert!(registry::create("yuorarm", "192.168.1.100", 6).is_err());
/// # Ok::<(), dimos_hardware::adapter::AdapterError>(())
/// ```
pub fn create(name: &str, address: &str, dof: usize) -> AdapterResult<Box<dyn ManipulatorAdapter>> {
    (builtin(name)?.create)(&plain(name, address, dof))
}

/// Starts the emulator of a built-in adapter, which connects to it at [`Emulator::address`]. `Unsupported` if the
/// adapter simulates its arm itself.
///
/// ```
/// use dimos_arms as registry;
///
/// let emulator = registry::emulate("yourarm", 6)?;
/// let mut adapter = registry::create("yourarm", &emulator.address(), 6)?;
/// adapter.connect()?;
/// assert!(adapter.is_connected());
/// let mut positions = [0.0; 6]; // [rad]
/// adapter.read_joint_positions(&mut positions)?;
/// adapter.disconnect();
/// # Ok::<(), dimos_hardware::adapter::AdapterError>(())
/// ```
pub fn emulate(name: &str, dof: usize) -> AdapterResult<Box<dyn Emulator>> {
    let start = builtin(name)?.emulate.ok_or(AdapterError::Unsupported)?;
    start(&plain(name, SIM, dof), &EmulatorAddress::InProcess)
}

fn builtin(name: &str) -> AdapterResult<&'static AdapterSpec> {
    TABLE.iter().find(|row| row.name == name).ok_or_else(|| {
        let absent = ABSENT.iter().find(|absent| absent.name == name);
        AdapterError::Rejected(match absent {
            Some(absent) => format!("adapter {name} is not in this build\nhint: {}", absent.remedy),
            None => format!("no adapter named {name:?}; available: {}", available().join(", ")),
        })
    })
}

/// Returns a configuration without options, for an arm named like its adapter.
fn plain(name: &str, address: &str, dof: usize) -> AdapterConfig {
    AdapterConfig { hardware_id: name.to_owned(), address: address.to_owned(), dof, options: serde_json::Value::Null }
}

//! Owns the arms: a folder each, with adapter, protocol, emulator and a row of the table. No arm uses another. Used by
//! the run; what an adapter needs is in `dimos-hardware`. A new arm is one folder, a feature and a row here; `mock` and
//! `yourarm` are always there, as are the peripherals: grippers and sensors with their own connections.

#![cfg_attr(
    not(test),
    deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::unreachable, clippy::indexing_slicing)
)]
#![forbid(unsafe_code)]
#![allow(rustdoc::broken_intra_doc_links, reason = "units are in brackets: [rad]")]

use dimos_hardware::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};
use dimos_hardware::peripheral::PeripheralSpec;
use dimos_hardware::registry::{Absent, AdapterConfig, AdapterSpec, Emulator, EmulatorAddress, Registry, SIM};

#[cfg(feature = "franka")]
pub mod franka;
pub mod mock;
pub mod modbus_gripper;
#[cfg(feature = "piper")]
pub mod piper;
#[cfg(feature = "remote")]
pub mod remote;
pub mod robotiq;
#[cfg(feature = "so101")]
pub mod so101;
#[cfg(feature = "ur")]
pub mod ur;
#[cfg(feature = "xarm")]
pub mod xarm;
pub mod yourarm;

/// The compile-time adapter table.
pub const TABLE: &[AdapterSpec] = &[
    mock::SPEC,
    yourarm::SPEC,
    #[cfg(feature = "xarm")]
    xarm::SPEC,
    #[cfg(feature = "piper")]
    piper::SPEC,
    #[cfg(feature = "so101")]
    so101::SPEC,
    #[cfg(feature = "ur")]
    ur::SPEC,
    #[cfg(feature = "franka")]
    franka::SPEC,
    #[cfg(feature = "remote")]
    remote::SPEC,
];

/// The peripherals: devices at an arm with their own connections.
pub const PERIPHERALS: &[PeripheralSpec] = &[robotiq::SPEC, modbus_gripper::SPEC, robotiq::ft300::SPEC];

/// Adapters that this build lacks because their cargo feature is off.
pub const ABSENT: &[Absent] = &[
    #[cfg(not(feature = "xarm"))]
    lacking("xarm", "UFACTORY xArm 5, 6, 7, 850, Lite 6", "build with --features xarm"),
    #[cfg(not(feature = "piper"))]
    lacking("piper", "AgileX Piper", "build with --features piper"),
    #[cfg(not(feature = "so101"))]
    lacking("so101", "SO-101", "build with --features so101"),
    #[cfg(not(feature = "ur"))]
    lacking("ur", "Universal Robots", "build with --features ur"),
    #[cfg(not(feature = "franka"))]
    lacking("franka", "Franka FR3 and FER", "build with --features franka"),
    #[cfg(not(feature = "remote"))]
    lacking("remote", "an adapter in another process", "build with --features remote"),
];

#[allow(dead_code, reason = "not in a build with all arms")]
const fn lacking(name: &'static str, about: &'static str, remedy: &'static str) -> Absent {
    Absent { name, about, remedy }
}

/// Returns the table of the built-in adapters.
pub fn registry() -> Registry {
    Registry::default().with(TABLE).with_peripherals(PERIPHERALS).lacking(ABSENT)
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

//! One run per arm, whatever its addresses: an abstract socket name for each serial number.

use std::collections::BTreeMap;
use std::os::unix::net::UnixListener;
use std::sync::Mutex;

use crate::blueprint::Arm;
use dimos_core::sync::lock;
use dimos_hardware::adapter::ManipulatorInfo;
use dimos_rt::abstract_name::{self, Taken, fit};

/// The serial numbers of a run's arms, held for the lifetime of this value.
#[derive(Debug, Default)]
pub struct SerialLocks {
    /// Whether arms may share a serial number: emulators in a closed world of runs.
    may_share: bool,
    /// Per arm, the name in the kernel.
    held: Mutex<BTreeMap<usize, (String, UnixListener)>>,
}

/// Who has a serial number already.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Holder {
    /// An arm of this run, by its index.
    Arm(usize),
    /// Another process; 0 if unknown.
    Process(u32),
}

impl SerialLocks {
    /// Returns locks without any serial number.
    pub fn new(may_share: bool) -> Self {
        Self { may_share, ..Self::default() }
    }

    /// Takes the serial number that an arm reports, in place of the one it had before; or returns who has it. An
    /// emulated arm, and one that reports none, takes none.
    pub fn take(&self, index: usize, arm: &Arm, info: &ManipulatorInfo, serial: &str) -> Result<(), Holder> {
        // Controllers without a number send blanks or zeros.
        let says = serial.bytes().any(|byte| byte.is_ascii_alphanumeric() && byte != b'0');
        if self.may_share || !arm.is_real() || !says {
            return Ok(());
        }
        let name = fit(format!("dimos/serial/{}/{}", info.vendor, serial.trim()));
        let mut held = lock(&self.held);
        if let Some((other, _)) = held.iter().find(|(_, (held, _))| *held == name) {
            return if *other == index { Ok(()) } else { Err(Holder::Arm(*other)) };
        }
        match abstract_name::take(&name) {
            Ok(listener) => {
                held.insert(index, (name, listener));
                Ok(())
            }
            Err(Taken::By(peer)) => Err(Holder::Process(peer.map_or(0, |peer| peer.pid))),
            // Without the name there is no other sign of a second run, and the address is locked.
            Err(Taken::Io(error)) => {
                tracing::warn!("{}: the serial number cannot be locked: {error}", arm.hardware_id);
                Ok(())
            }
        }
    }
}

impl Holder {
    /// Returns what the user reads of an arm whose serial number is taken.
    pub fn describe(&self, arm: &str, others: &[Arm], serial: &str) -> (String, &'static str) {
        match self {
            Self::Arm(other) => {
                let other = others.get(*other).map_or("another arm", |other| other.hardware_id.as_str());
                let what = format!("{other} and {arm} are one arm: serial {serial}");
                (what, "give each arm the address of its own controller")
            }
            Self::Process(pid) => {
                let pid = if *pid == 0 { "unknown".to_owned() } else { pid.to_string() };
                let what = format!("{arm} (serial {serial}) is commanded by process {pid}, through another address");
                (what, "end that run first: `dimos status` shows it; emulators may share one in DIMOS_WORLD")
            }
        }
    }
}

//! What a check works with: an adapter, the emulator it talks to, and the usual steps.

use std::time::{Duration, Instant};

use crate::hardware::registry::{AdapterConfig, AdapterSpec, Emulator, Place};
use crate::hardware::sim::faults::Fault;
use crate::hardware::spec::{AdapterError, AdapterResult, JointReading, ManipulatorAdapter};
use crate::joint::{ControlMode, JointLimits};

/// Longest wait for something that must happen.
const PATIENCE: Duration = Duration::from_secs(10);
/// When a fault of an arm without an emulator strikes: time since the connection [s].
const STRIKES_AT: f64 = 0.5;

/// An adapter that is not connected yet, and the other end of its wire.
pub struct Context {
    /// The row under test.
    pub row: AdapterSpec,
    /// What the adapter was made from.
    pub config: AdapterConfig,
    /// The other end of the wire; `None` where the adapter is its own plant.
    pub emulator: Option<Box<dyn Emulator>>,
    /// The adapter under test.
    pub adapter: Box<dyn ManipulatorAdapter>,
    /// Counts the thread's allocations so far.
    pub allocations: Option<fn() -> u64>,
    /// Why the check does not apply.
    pub(super) skipped: Option<String>,
    fault: Option<Fault>,
}

impl Context {
    /// A fresh adapter with as many joints as the row allows at most, default options, and a fresh emulator.
    pub(super) fn new(row: &AdapterSpec, allocations: Option<fn() -> u64>) -> Result<Self, String> {
        let mut config = AdapterConfig {
            hardware_id: "conformance".into(),
            address: String::new(),
            dof: row.dof.1,
            options: serde_json::json!({}),
        };
        let emulator =
            row.emulate.map(|start| start(&config, &Place::InProcess)).transpose().map_err(|e| e.to_string())?;
        if let Some(emulator) = &emulator {
            config.address = emulator.address();
        }
        let adapter = (row.create)(&config).map_err(|e| format!("cannot be made: {e}"))?;
        Ok(Self { row: *row, config, emulator, adapter, allocations, skipped: None, fault: None })
    }

    /// Ends a check that does not apply.
    pub fn skip(&mut self, why: &str) -> Result<(), String> {
        self.skipped = Some(why.to_owned());
        Ok(())
    }

    /// Prepares a fault; `false` when the arm's double cannot play it. Comes first in a check.
    pub fn prepare(&mut self, fault: Fault) -> bool {
        let playable = match &self.emulator {
            // A fault in the far future only asks whether it is playable.
            Some(emulator) => emulator.inject(fault.at(1e6)).is_ok(),
            None => {
                let script = serde_json::to_value(fault.at(STRIKES_AT)).unwrap_or_default();
                self.config.options = serde_json::json!({ "faults": [script] });
                (self.row.create)(&self.config).is_ok_and(|adapter| {
                    self.adapter = adapter;
                    true
                })
            }
        };
        self.fault = Some(fault);
        playable
    }

    /// Lets the prepared fault happen, now or soon.
    pub fn strike(&mut self) -> Result<(), String> {
        match (&self.emulator, self.fault.take()) {
            (Some(emulator), Some(fault)) => emulator.inject(fault),
            _ => Ok(()),
        }
    }

    /// Connects.
    pub fn connect(&mut self) -> Result<(), String> {
        self.adapter.connect().map_err(|e| format!("connect: {e}"))
    }

    /// Connects, activates and sets a mode.
    pub fn ready(&mut self, mode: ControlMode) -> Result<(), String> {
        self.connect()?;
        self.adapter.activate().map_err(|e| format!("activate: {e}"))?;
        self.adapter.set_control_mode(mode).map_err(|e| format!("set_control_mode {}: {e}", mode.name()))
    }

    /// Joint positions [rad].
    pub fn positions(&mut self) -> Result<Vec<f64>, String> {
        let mut positions = vec![0.0; self.config.dof];
        self.steadily(|adapter| adapter.read_joint_positions(&mut positions), "read_joint_positions")?;
        Ok(positions)
    }

    /// All of the joints.
    pub fn joints(&mut self) -> Result<JointReading, String> {
        let mut reading = JointReading::default();
        self.steadily(|adapter| adapter.read_joints(&mut reading), "read_joints")?;
        Ok(reading)
    }

    /// The joint limits.
    pub fn limits(&mut self) -> Result<JointLimits, String> {
        self.adapter.get_limits().map_err(|e| format!("get_limits: {e}"))
    }

    /// Whether the motors are on.
    pub fn enabled(&mut self) -> Result<bool, String> {
        self.adapter.read_enabled().map_err(|e| format!("read_enabled: {e}"))
    }

    /// A call that may be late twice on a busy machine.
    fn steadily(
        &mut self,
        mut call: impl FnMut(&mut dyn ManipulatorAdapter) -> AdapterResult<()>,
        name: &str,
    ) -> Result<(), String> {
        let mut result = call(&mut *self.adapter);
        for _ in 0..2 {
            if !matches!(result, Err(AdapterError::Timeout(_))) {
                break;
            }
            result = call(&mut *self.adapter);
        }
        result.map_err(|e| format!("{name}: {e}"))
    }

    /// Joint positions a little off `from` [rad]: another amount for each joint, alternately up and down, inside
    /// the limits.
    pub fn nearby(&mut self, from: &[f64]) -> Result<Vec<f64>, String> {
        let limits = self.limits()?;
        let range = limits.position_lower.iter().zip(&limits.position_upper);
        let step = |i: usize| 0.02 * (i + 1) as f64 / from.len().max(6) as f64 * 6.0;
        Ok(from
            .iter()
            .zip(range)
            .enumerate()
            .map(|(i, (position, (lower, upper)))| {
                let wanted = position + if i % 2 == 0 { step(i) } else { -step(i) };
                if (*lower..=*upper).contains(&wanted) { wanted } else { 2.0 * position - wanted }
            })
            .collect())
    }

    /// Waits until `done` says so.
    pub fn until(&mut self, what: &str, mut done: impl FnMut(&mut Self) -> Result<bool, String>) -> Result<(), String> {
        let end = Instant::now() + PATIENCE;
        while !done(self)? {
            if Instant::now() > end {
                return Err(format!("{what}: not within {PATIENCE:?}"));
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(())
    }

    /// Waits until all joints stand still: positions that do not change for 50 ms.
    pub fn standstill(&mut self) -> Result<Vec<f64>, String> {
        let mut last = self.positions()?;
        self.until("standstill", |context| {
            std::thread::sleep(Duration::from_millis(50));
            let now = context.positions()?;
            let still = farthest(&now, &last) < 1e-6;
            last = now;
            Ok(still)
        })?;
        Ok(last)
    }

    /// Watches that no joint moves by more than `most` [rad] for a third of a second.
    pub fn stays(&mut self, from: &[f64], most: f64) -> Result<(), String> {
        for _ in 0..33 {
            std::thread::sleep(Duration::from_millis(10));
            let moved = farthest(&self.positions()?, from);
            if moved > most {
                return Err(format!("the arm moved by {moved:.6} rad"));
            }
        }
        Ok(())
    }
}

/// The largest difference of two vectors.
pub fn farthest(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max)
}

/// Fails with `why` unless `holds`.
pub fn require(holds: bool, why: impl FnOnce() -> String) -> Result<(), String> {
    if holds { Ok(()) } else { Err(why()) }
}

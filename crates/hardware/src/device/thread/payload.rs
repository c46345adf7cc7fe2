//! The load at the flange and the mounting: set at standstill only, and read back.

use super::Worker;
use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};
use dimos_core::arm::{Load, VelocitySource};
use dimos_core::joint::STANDSTILL;

/// Largest difference of a component of the direction of gravity that is read back.
const GRAVITY_TOLERANCE: f64 = 0.01;

impl Worker {
    /// Sets mounting and load before the motors are enabled. Errors name what the controller refused.
    pub(super) fn configure(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        if let Some(gravity) = self.config.setup.gravity {
            mount(adapter, gravity)?;
        }
        match self.payload {
            Some(load) if !read(adapter)?.is_some_and(|present| is_set(&load, &present)) => {
                self.set_payload(adapter, &load).map(drop)
            }
            _ => Ok(()),
        }
    }

    /// Sets the load and reads it back.
    pub(super) fn set_payload(
        &mut self,
        adapter: &mut dyn ManipulatorAdapter,
        load: &Load,
    ) -> AdapterResult<Option<Load>> {
        load.check().map_err(AdapterError::Rejected)?;
        let speed = self.state.velocity.iter().take(self.config.dof).fold(0.0, |most: f64, v| most.max(v.abs()));
        if self.state.velocity_source == VelocitySource::Measured && speed > STANDSTILL {
            let what = format!("the arm moves at {speed:.2} rad/s\nhint: set the payload when it is at rest");
            return Err(AdapterError::Rejected(what));
        }
        // A controller that resets changes its mode.
        if adapter.payload().is_some_and(|payload| payload.resets_controller()) {
            self.expect_nothing(self.ordered_power);
        }
        let actual = self.while_connected(adapter, |adapter| {
            let before = read(adapter)?;
            let actual = write(adapter, load);
            // A load that is not the one ordered does not stay, nor one that may be.
            if let (Err(_), Some(before)) = (&actual, before)
                && read(adapter).is_ok_and(|present| present.is_none_or(|present| !is_set(&before, &present)))
            {
                write(adapter, &before)?;
            }
            actual
        });
        // The state changes where setting the load resets the controller.
        self.read(adapter);
        let actual = actual?;
        self.payload = Some(*load);
        self.slow.take_payload(actual.or(Some(*load)), self.config.clock.now());
        self.publish_slow();
        Ok(actual)
    }
}

/// Returns whether the controller has the load already, inertia included: setting it may reset the controller.
fn is_set(load: &Load, present: &Load) -> bool {
    load.agrees_with(present) && present.agrees_with(load)
}

/// Reads the load that the controller calculates with.
pub(super) fn read(adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<Option<Load>> {
    adapter.payload().ok_or(AdapterError::Unsupported)?.read_payload()
}

fn write(adapter: &mut dyn ManipulatorAdapter, load: &Load) -> AdapterResult<Option<Load>> {
    let payload = adapter.payload().ok_or(AdapterError::Unsupported)?;
    payload.write_payload(load)?;
    let actual = payload.read_payload()?;
    match &actual {
        Some(actual) if !load.agrees_with(actual) => Err(AdapterError::Rejected(format!(
            "the controller reports a payload of {} after {} was set",
            described(actual),
            described(load)
        ))),
        _ => Ok(actual),
    }
}

fn mount(adapter: &mut dyn ManipulatorAdapter, gravity: [f64; 3]) -> AdapterResult<()> {
    let payload = adapter.payload().ok_or(AdapterError::Unsupported)?;
    let differs = |actual: &[f64; 3]| actual.iter().zip(gravity).any(|(a, b)| (a - b).abs() > GRAVITY_TOLERANCE);
    if matches!(payload.read_mounting(), Ok(Some(present)) if !differs(&present)) {
        return Ok(());
    }
    payload.write_mounting(gravity).map_err(|error| match error {
        AdapterError::Unsupported => AdapterError::Rejected(
            "the mounting of this arm cannot be set\nhint: remove `mounting`, and set it with the vendor's program"
                .into(),
        ),
        error => error,
    })?;
    match payload.read_mounting()? {
        Some(actual) if differs(&actual) => Err(AdapterError::Rejected(format!(
            "the controller reports gravity along {actual:.3?} of its base after {gravity:.3?} was set"
        ))),
        _ => Ok(()),
    }
}

fn described(load: &Load) -> String {
    let [x, y, z] = load.center.map(|v| format!("{v:.3}"));
    format!("{:.3} kg at {x} {y} {z} m", load.mass)
}

//! Connecting, reconnecting, enabling and disconnecting an arm.

use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use super::commands::MAX_IN_FLIGHT;
use super::{BACK_OFF, MAX_FAILURES, TURNS, Worker, slow_readings};
use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter, ManipulatorInfo};
use crate::device::identity::PARTS as IDENTITY_PARTS;
use crate::device::{Connected, Note};
use dimos_core::arm::{Interference, Link};
use dimos_core::joint::{JointLimits, Joints, STANDSTILL};

/// How long `activate` waits for plausible states, and again for the motors to come on.
const ACTIVATION_TIMEOUT: Duration = Duration::from_secs(1);
/// How long a stopped arm may take to be at rest before its motors are disabled anyway.
const REST_TIMEOUT: Duration = Duration::from_secs(1);
/// How long all joints must be below the standstill velocity to count as at rest [s].
const REST_TIME: f64 = 0.03;

impl Worker {
    pub(super) fn connect(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<Connected> {
        adapter.connect()?;
        let info = adapter.get_info();
        if info.dof != self.config.dof {
            adapter.disconnect();
            let (expected, found) = (self.config.dof, info.dof);
            let what = format!("expected an arm with {expected} joints, found {} with {found}", info.model);
            return Err(AdapterError::Rejected(what));
        }
        let limits = adapter.get_limits().inspect_err(|_| adapter.disconnect())?;
        self.check_parts(adapter).inspect_err(|_| adapter.disconnect())?;
        let calibration_offsets =
            slow_readings::calibration_offsets(adapter, self.config.dof).inspect_err(|_| adapter.disconnect())?;
        self.whole_state_at_once = info.whole_state_at_once;
        // An older controller may deliver less often than its kind.
        self.config.native_rate = self.config.native_rate.min(info.native_rate);
        self.should_reconnect = true;
        self.connected = true;
        self.write_errors = 0;
        self.reconnect.1 = BACK_OFF.0;
        self.plausible.reset();
        let identity = identity(&info, calibration_offsets.as_ref(), (self.config.usb)());
        self.health.with_identity(|known| known.connected(identity.clone()));
        self.expect_nothing(None);
        self.compare_identity();
        self.guard.forget();
        self.in_flight = 0;
        let reduction = adapter.reduction();
        let tool = reduction.as_ref().and_then(|reduction| reduction.tool_velocity);
        if self.speed == 0.0 {
            self.set_limits(&limits);
            self.limits.set_tool(self.config.setup.tool_velocity, tool);
        }
        self.compare_limits(&limits, tool);
        if let Some(text) = adapter.connection_warning().filter(|_| !self.warned) {
            self.warned = true;
            (self.config.notes)(Note::Began(text.to_owned()));
        }
        self.skip_command();
        self.read(adapter);
        let write_period = self.config.write_period(adapter.set_point_period());
        self.guard.set_period(write_period);
        let bridging = adapter.bridging();
        if let Some(bridging) = bridging {
            self.guard.set_gap_tolerance(bridging.tolerance);
        }
        let impedance = adapter.impedance();
        self.guard.set_efforts(self.config.setup.efforts, impedance.or(self.config.setup.impedance));
        let read_period = self.config.read_period();
        let gripper = self.gripper_info(adapter);
        let io = adapter.io().map(|io| io.get_io());
        let has_payload = adapter.payload().is_some();
        let payload_resets = adapter.payload().is_some_and(|payload| payload.resets_controller());
        Ok(Connected {
            info,
            limits,
            gripper,
            io,
            identity,
            calibration_offsets,
            kinematics: adapter.factory_kinematics(),
            bridging,
            reduction,
            setpoint: adapter.setpoint_fields(),
            impedance,
            streams: adapter.state_fd().is_some(),
            has_payload,
            payload_resets,
            read_period,
            write_period,
        })
    }

    pub(super) fn set_limits(&mut self, limits: &JointLimits) {
        self.speed = limits.velocity_max.iter().copied().fold(0.1, f64::max);
        self.guard.set_limits(limits);
        self.limits.set(limits);
    }

    /// Resets what the arm's state is compared with: no mode, and the motors as in `power`.
    pub(super) fn expect_nothing(&mut self, power: Option<bool>) {
        (self.ordered_mode, self.ordered_power, self.disagreeing) = (None, power, 0);
        self.mode_refused_since = None;
        self.state.interference = Interference::None;
    }

    pub(super) fn reconnect_arm(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        self.state.self_held = true; // only `enable` allows motion again
        match self.connect(adapter) {
            Ok(_) if self.connected => {
                self.health.reconnects.fetch_add(1, Relaxed);
                self.clear_trouble();
            }
            // Lost again in the first read, which has scheduled the next attempt.
            Ok(_) => {}
            Err(error) => {
                // That the arm cannot be reached has been logged; that it is another arm, or in error, has not.
                if matches!(error, AdapterError::Rejected(_) | AdapterError::Fault { .. }) {
                    self.trouble(&format!("cannot reconnect: {error}"));
                }
                let wait = self.reconnect.1;
                self.reconnect = (self.config.clock.now().after(wait), (wait * 2).min(BACK_OFF.1));
            }
        }
    }

    /// Enables the motors, given fresh states that agree with each other, and verifies that they are on.
    pub(super) fn activate(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        if !self.connected {
            return Err(AdapterError::NotConnected);
        }
        if self.health.is_other_arm() {
            let what = "another arm answers than the one with which the run began";
            let hint = format!("`dimos arm reset {}` shows both", self.config.hardware_id);
            return Err(AdapterError::Rejected(format!("{what}\nhint: {hint}")));
        }
        if let Some(narrower) = self.limits.narrower() {
            return Err(AdapterError::Rejected(format!(
                "{narrower}\nhint: restart the run, which then keeps these limits, or widen them at the controller"
            )));
        }
        let limit = self.config.clock.now().after(ACTIVATION_TIMEOUT);
        while !self.plausible.stable(self.state.stamp) {
            if self.config.clock.now() >= limit {
                return Err(AdapterError::Rejected(self.plausible.objection(&self.config.hardware_id)));
            }
            std::thread::sleep(self.config.read_period().min(Duration::from_millis(10)));
            self.read(adapter);
            if !self.connected {
                return Err(AdapterError::NotConnected);
            }
        }
        if let Some(joint) = self.state.missing.first() {
            let what = format!("joint {} does not answer\nhint: check the power and the cable of its motor", joint + 1);
            return Err(AdapterError::Rejected(what));
        }
        if let Some(stop) = self.config.setup.stop_input.filter(|_| self.state.stop_input_open) {
            let what = format!("the stop input di{} is open\nhint: close it, then enable the arm again", stop.input);
            return Err(AdapterError::Rejected(what));
        }
        self.configure(adapter)?;
        self.expect_nothing(None);
        self.lead.end("the arm was enabled");
        adapter.activate()?;
        let limit = self.config.clock.now().after(ACTIVATION_TIMEOUT);
        while !adapter.read_enabled()? {
            if self.config.clock.now() >= limit {
                return Err(AdapterError::Timeout("the motors did not come on within 1 s".to_owned()));
            }
            std::thread::sleep(Duration::from_millis(5));
            self.read(adapter);
        }
        self.ordered_power = Some(true);
        self.state.self_held = false;
        self.stop_pending = false;
        self.gripper_stop.end();
        self.write_errors = 0;
        self.turn = 0;
        for _ in 0..TURNS {
            self.read(adapter);
        }
        Ok(())
    }

    pub(super) fn finish(&mut self, adapter: &mut dyn ManipulatorAdapter, disable: bool) -> AdapterResult<()> {
        let mut result = Ok(());
        // An arm that another program has taken over is not stopped.
        let ours = self.state.interference != Interference::Mode;
        if ours && self.connected {
            result = adapter.deactivate(&self.stop_point());
            if disable {
                self.wait_for_standstill(adapter);
                result = result.and(adapter.write_enable(false));
            }
        } else if ours && self.should_reconnect {
            let orders = if disable { "neither a stop nor a disable" } else { "no stop" };
            result = Err(AdapterError::Io(format!("the connection is lost: {orders} reached the arm")));
        } else if self.connected {
            let orders = if disable { "neither stopped nor disabled" } else { "not stopped" };
            result = Err(AdapterError::Rejected(format!("another program commands it: it was {orders}")));
        }
        adapter.disconnect();
        self.connected = false;
        self.should_reconnect = false;
        self.state.link = Link::Down;
        self.states.write(&self.state);
        result
    }

    /// Waits until the arm is at rest, at most [`REST_TIMEOUT`]: brakes and disabled motors should not meet a moving
    /// arm.
    pub(super) fn wait_for_standstill(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let limit = self.config.clock.now().after(REST_TIMEOUT);
        let mut rest_time = 0.0;
        loop {
            let before = (self.state.position, self.state.stamp);
            std::thread::sleep(self.config.read_period());
            self.read(adapter);
            let past = self.state.stamp.seconds_since(before.1).max(1e-3);
            let moved = self.state.position.iter().zip(before.0).take(self.config.dof);
            let still = moved.map(|(now, then)| (now - then).abs() / past).all(|v| v <= STANDSTILL);
            // One sample is not enough: a reversing joint is slow too.
            rest_time = if still { rest_time + self.state.stamp.seconds_since(before.1) } else { 0.0 };
            if !self.connected || rest_time >= REST_TIME || self.config.clock.now() >= limit {
                return;
            }
        }
    }

    /// Marks the connection as lost and schedules the first attempt to reconnect.
    pub(super) fn mark_lost(&mut self) {
        self.connected = false;
        self.lead.end("the connection was lost");
        self.plausible.reset();
        self.state.link = Link::Faulted;
        self.reconnect = (self.config.clock.now().after(BACK_OFF.0), BACK_OFF.0);
    }

    /// Decides what an error means for the connection.
    pub(super) fn after_error(&mut self, adapter: &mut dyn ManipulatorAdapter, error: &AdapterError) {
        if matches!(error, AdapterError::NotConnected) || !adapter.is_connected() {
            adapter.discard_pending();
            adapter.disconnect();
            self.mark_lost();
        } else if self.in_flight >= MAX_IN_FLIGHT {
            self.discard(adapter);
        } else if self.write_errors >= MAX_FAILURES {
            self.state.link = Link::Faulted;
        }
        self.states.write(&self.state);
    }
}

/// Returns which arm this is: its serial number, else the calibration that its drives keep and the USB device of its
/// port.
fn identity(info: &ManipulatorInfo, offsets: Option<&Joints>, usb: Option<String>) -> Option<String> {
    let of_drives = |offsets: &Joints| {
        let offsets = offsets.iter().take(info.dof).map(|offset| format!("{offset:.4}")).collect::<Vec<_>>();
        format!("servo offsets {} rad", offsets.join(" "))
    };
    if let Some(serial) = &info.serial_number {
        return Some(format!("serial {serial}"));
    }
    let parts: Vec<String> = { offsets }.map(of_drives).into_iter().chain(usb).collect();
    (!parts.is_empty()).then(|| parts.join(IDENTITY_PARTS))
}

//! Reading the arm's state, and detecting changes that this run did not order.

use std::sync::atomic::Ordering::Relaxed;
use std::time::Duration;

use super::{ENABLED_TURN, ERROR_TURN, MAX_FAILURES, TURNS, Worker};
use crate::adapter::{AdapterError, AdapterResult, ManipulatorAdapter};
use crate::device::Ports;
use dimos_core::arm::{Interference, Link, VelocitySource};
use dimos_core::clock::Mono;
use dimos_core::joint::Joints;

/// Consecutive readings that contradict the orders before they count as interference: a single one may have been
/// measured before the order.
const INTERFERENCE_READINGS: u32 = 2;

impl Worker {
    /// Schedules the next read to end just before the tick at `next_tick`.
    pub(super) fn read_before(&mut self, next_tick: Mono) {
        let lead = Duration::from_secs_f64((3.0 * self.read_time).max(1e-3)).min(self.config.tick_period / 2);
        let earliest = self.last_read.after(self.config.read_period().mul_f64(0.8));
        self.next_read = self.next_read.min(next_tick.before(lead)).max(earliest);
    }

    pub(super) fn read(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        if !self.connected {
            return;
        }
        let began = self.config.clock.now();
        let before = self.state.seq;
        self.next_read = began.after(self.config.read_period());
        match self.read_all(adapter) {
            Ok(()) => {
                let ended = self.config.clock.now();
                self.read_time += 0.1 * (ended.seconds_since(began) - self.read_time);
                self.take_reading(began);
                self.read_errors = 0;
                self.state.link = if self.write_errors >= MAX_FAILURES { Link::Faulted } else { Link::Up };
                if self.state.link == Link::Up && self.write_errors == 0 && !self.state.self_held {
                    self.clear_trouble();
                }
            }
            Err(error) => {
                self.health.read_errors.fetch_add(1, Relaxed);
                self.read_errors += 1;
                self.plausible.reset();
                self.trouble(&format!("no state: {error}"));
                let age = self.config.clock.now().since(self.last_read);
                if self.read_errors >= MAX_FAILURES && age > self.config.state_timeout() {
                    self.state.link = Link::Stale;
                }
                self.after_error(adapter, &error);
            }
        }
        self.states.write(&self.state);
        if let Some(pace) = self.config.pace.as_ref().filter(|_| self.state.seq != before) {
            pace.raise();
        }
    }

    pub(super) fn read_all(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        if !std::mem::take(&mut self.exchanged) {
            match adapter.exchanges() {
                true => adapter.exchange(None, &mut self.reading)?,
                false => adapter.read_joints(&mut self.reading)?,
            }
        }
        self.fill_in_missing()?;
        self.read_inputs(adapter)?;
        let all = self.whole_state_at_once;
        let turn = self.turn;
        self.turn = (turn + 1) % TURNS;
        if all || turn == ERROR_TURN {
            let (code, text) = adapter.read_error()?;
            if code != self.state.error {
                self.health.set_error_text(text.clone());
                if code != 0 {
                    self.trouble(&format!("the arm reports error {code}: {text}"));
                }
            }
            self.state.error = code;
        }
        if all || turn == ENABLED_TURN {
            self.state.enabled = adapter.read_enabled()?;
        }
        let Ports { gripper, force_torque } = &self.config.peripherals;
        let (own_gripper, own_sensor) = (gripper.is_none(), force_torque.is_none());
        if own_gripper && (all || turn == 2) {
            let gripper = adapter.gripper();
            (self.state.gripper, self.state.gripper_force) = match gripper {
                Some(gripper) => {
                    self.health.set_gripper_holds(gripper.read_gripper_holds()?);
                    (gripper.read_gripper_position()?, gripper.read_gripper_force()?)
                }
                None => (None, None),
            };
            self.hold_gripper(adapter);
        }
        if own_sensor && (all || turn == 3) {
            let measured = adapter.force_torque().map_or(Ok(None), |sensor| sensor.read_force_torque())?;
            self.set_wrench(measured);
        }
        if all || turn == 4 {
            self.state.pose = adapter.cartesian().map_or(Ok(None), |poses| poses.read_cartesian_position())?;
        }
        if all || turn == 5 {
            self.read_codes(adapter)?;
        }
        self.read_peripherals();
        self.read_slowly(adapter)?;
        self.state.mode = adapter.get_control_mode();
        self.compare_with_orders();
        self.take_foreign_change(adapter.foreign_change());
        if adapter.reduction_changed() {
            let limits = adapter.get_limits()?;
            self.compare_limits(&limits, adapter.reduction().and_then(|reduction| reduction.tool_velocity));
        }
        Ok(())
    }

    /// Reads the device's own state codes, for `dimos status`.
    pub(super) fn read_codes(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        let codes = match adapter.read_state() {
            Err(AdapterError::Unsupported) => return Ok(()),
            codes => codes?,
        };
        if self.codes != Some(codes) {
            self.codes = Some(codes);
            self.health.set_codes(codes);
        }
        Ok(())
    }

    /// Records a change by another client that the adapter reports.
    pub(super) fn take_foreign_change(&mut self, foreign: Option<&'static str>) {
        let Some(what) = foreign.filter(|_| !self.is_taken_over()) else { return };
        let mode = self.ordered_mode.is_some_and(|ordered| ordered != self.state.mode);
        self.state.interference = if mode { Interference::Mode } else { Interference::Stop };
        self.trouble(what);
    }

    /// Returns whether another program or person, or another arm, was seen.
    fn is_taken_over(&self) -> bool {
        !matches!(self.state.interference, Interference::None | Interference::Limits | Interference::Tool)
    }

    /// Compares which arm answers with the one of the run: another one gets nothing until it is accepted.
    pub(super) fn compare_identity(&mut self) {
        match (self.health.is_other_arm(), self.state.interference) {
            (true, _) => self.state.interference = Interference::Identity,
            (false, Interference::Identity) => self.state.interference = Interference::None,
            _ => {}
        }
    }

    /// Compares arm, mode and motors with what this run ordered.
    pub(super) fn compare_with_orders(&mut self) {
        self.compare_identity();
        self.hold_for_limits();
        self.hold_for_peripherals();
        if !self.state.enabled {
            self.guard.forget();
        }
        let mode = self.ordered_mode.is_some_and(|ordered| ordered != self.state.mode);
        // The tick itself reports motors that go off.
        let power = self.ordered_power == Some(false) && self.state.enabled;
        self.disagreeing = if mode || power { self.disagreeing + 1 } else { 0 };
        if self.disagreeing >= INTERFERENCE_READINGS && !self.is_taken_over() {
            self.state.interference = if mode { Interference::Mode } else { Interference::Power };
        }
    }

    /// Keeps the last position of joints that the reading lacks, at rest: the others still count.
    fn fill_in_missing(&mut self) -> AdapterResult<()> {
        let (missing, dof) = (self.reading.missing, self.config.dof);
        if missing.is_empty() {
            return Ok(());
        }
        if (0..dof).all(|joint| missing.contains(joint)) {
            return Err(AdapterError::Timeout("none of its joints answers".to_owned()));
        }
        for joint in missing.iter() {
            let last = self.state.position.get(joint).copied().unwrap_or_default();
            self.reading.position.get_mut(joint).into_iter().for_each(|q| *q = last);
            let of = |list: &mut Option<Joints>, value: f64| {
                list.as_mut().and_then(|list| list.get_mut(joint)).into_iter().for_each(|slot| *slot = value);
            };
            of(&mut self.reading.velocity, 0.0);
            of(&mut self.reading.effort, f64::NAN);
        }
        Ok(())
    }

    pub(super) fn take_reading(&mut self, began: Mono) {
        let stamp = self.reading.stamp.unwrap_or(began);
        if self.state.seq != 0 && self.reading.stamp == Some(self.state.stamp) {
            return; // the same measurement again: its age grows
        }
        self.plausible.take(&self.reading, stamp, &self.state, self.speed, &self.config.supervision);
        self.health.state_came(if self.state.seq == 0 { 0.0 } else { began.seconds_since(self.last_read) });
        self.last_read = began;
        self.state.seq += 1;
        self.state.stamp = stamp;
        self.state.device_ns = self.reading.device_ns;
        self.state.position = self.reading.position;
        (self.state.effort, self.state.effort_kind) = (self.reading.effort, self.reading.effort_kind);
        self.state.missing = self.reading.missing;
        self.state.commanded = self.reading.commanded;
        self.state.speed_fraction = self.reading.speed_fraction;
        self.state.velocity = self.reading.velocity.unwrap_or_default();
        self.state.velocity_source =
            if self.reading.velocity.is_some() { VelocitySource::Measured } else { VelocitySource::Absent };
        self.health.history.take(&self.state);
    }
}

//! The loop of a device thread. One loop and its state belong together, hence its length.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::atomic::Ordering::{Relaxed, Release};
use std::sync::mpsc::{Receiver, TryRecvError};
use std::time::Duration;

use super::gripper::GripperStop;
use super::plausible::Plausible;
use super::wire_guard::WireGuard;
use super::{Connected, DeviceConfig, Health, Note, Order};
use crate::arm::{ArmCommand, ArmState, Interference, Link, VelocitySource};
use crate::clock::Mono;
use crate::hardware::spec::{AdapterError, AdapterResult, JointReading, ManipulatorAdapter, RobotState, Stop};
use crate::joint::{ControlMode, JointLimits, STANDSTILL};
use crate::rt::due::Due;
use crate::rt::host;
use crate::rt::slot::{SlotReader, SlotWriter};
use crate::rt::wake::Wake;

/// Consecutive failures before the connection is `Stale` (reads) or `Faulted` (writes).
const MAX_FAILURES: u32 = 3;
/// Unacknowledged setpoints before the connection is dropped.
const MAX_IN_FLIGHT: u32 = 2;
/// Consecutive readings that show a change that this run did not order, before it is one: a report may be older than
/// the order.
const INTERFERENCE_READINGS: u32 = 2;
/// The longest delay of this thread that does not count for the tick's silence.
const LONGEST_DELAY: Duration = Duration::from_millis(100);
/// Cycles in which everything is read once, where each read costs a round trip; in which of them the error code is
/// read, and the motors' state.
const TURNS: u8 = 6;
const ERROR_TURN: u8 = 0;
const ENABLED_TURN: u8 = 1;
/// Waits between two attempts to connect again.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(500), Duration::from_secs(5));
/// How long an arm may refuse a change of mode because it still moves.
const MODE_LIMIT: Duration = Duration::from_secs(1);
/// How long `activate` waits for plausible states, and for the motors.
const ACTIVATION_LIMIT: Duration = Duration::from_secs(1);
/// How long a stopped arm gets to stand still before its motors are disabled, and for how long it must stand [s].
const REST_LIMIT: Duration = Duration::from_secs(1);
const STILL_FOR: f64 = 0.03;

/// What the thread shares with its handle.
pub(super) struct Shared {
    pub wake: Wake,
    pub health: Arc<Health>,
    pub due: Arc<Due>,
}

pub(super) struct Worker {
    config: DeviceConfig,
    states: SlotWriter<ArmState>,
    commands: SlotReader<ArmCommand>,
    wake: Wake,
    health: Arc<Health>,
    due: Arc<Due>,
    state: ArmState,
    reading: JointReading,
    codes: Option<RobotState>,
    last: ArmCommand,
    /// A stop that the arm has not taken yet. Kept until it does, also over a new connection.
    stop_owed: bool,
    gripper_stop: GripperStop,
    /// What is told of writes that fail.
    write_trouble: String,
    /// Since when the arm refuses a change of mode.
    mode_wanted: Option<Mono>,
    /// It was connected once and should be again.
    wanted: bool,
    connected: bool,
    whole_state_at_once: bool,
    turn: u8,
    read_errors: u32,
    write_errors: u32,
    plausible: Plausible,
    /// The fastest joint's top speed [rad/s].
    speed: f64,
    guard: WireGuard,
    /// Setpoints that may be on their way.
    in_flight: u32,
    /// The newest command was not sent because others were on their way.
    again: bool,
    /// The mode that this run brought the arm into; `None` while none was ordered.
    ordered_mode: Option<ControlMode>,
    /// Whether this run enabled or disabled the motors last.
    ordered_power: Option<bool>,
    /// Consecutive readings that disagree with what was ordered.
    disagreeing: u32,
    /// How late this thread was since the tick's last beat.
    delay: (Option<Mono>, Duration),
    last_read: Mono,
    next_read: Mono,
    read_time: f64,
    reconnect: (Mono, Duration),
}

impl Worker {
    pub(super) fn new(
        config: DeviceConfig,
        states: SlotWriter<ArmState>,
        commands: SlotReader<ArmCommand>,
        shared: Shared,
    ) -> Self {
        let state = ArmState { dof: config.dof, ..ArmState::default() };
        let Shared { wake, health, due } = shared;
        Self {
            due,
            guard: WireGuard::new(config.dof, config.write_period(None), config.supervision),
            in_flight: 0,
            again: false,
            ordered_mode: None,
            ordered_power: None,
            disagreeing: 0,
            delay: (None, Duration::ZERO),
            speed: 0.0,
            config,
            states,
            commands,
            wake,
            health,
            state,
            reading: JointReading::default(),
            codes: None,
            last: ArmCommand::default(),
            stop_owed: false,
            gripper_stop: GripperStop::default(),
            write_trouble: String::new(),
            mode_wanted: None,
            wanted: false,
            connected: false,
            whole_state_at_once: false,
            turn: 0,
            read_errors: 0,
            write_errors: 0,
            plausible: Plausible::default(),
            last_read: Mono::ZERO,
            next_read: Mono::ZERO,
            read_time: 0.0,
            reconnect: (Mono::ZERO, BACK_OFF.0),
        }
    }

    /// Runs until it is told to finish. A panic of the adapter costs this arm only.
    pub(super) fn run(mut self, mut adapter: Box<dyn ManipulatorAdapter>, orders: Receiver<Order>) {
        host::enter_realtime(host::DEVICE_PRIORITY);
        let outcome = catch_unwind(AssertUnwindSafe(|| while !self.cycle(&mut *adapter, &orders) {}));
        if let Err(panic) = outcome {
            let what = panic.downcast_ref::<&str>().map(|s| (*s).to_owned());
            let what = what.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_default();
            self.trouble(&format!("the adapter panicked: {what}"));
            self.state.link = Link::Faulted;
            self.states.write(&self.state);
            let _ = catch_unwind(AssertUnwindSafe(|| adapter.write_stop()));
            // Nothing more can be had of this adapter; orders are refused by hanging up.
            let _ = catch_unwind(AssertUnwindSafe(move || drop(adapter)));
        }
    }

    /// One cycle: wait, obey orders, pass a command on, read. `true`: it is over.
    fn cycle(&mut self, adapter: &mut dyn ManipulatorAdapter, orders: &Receiver<Order>) -> bool {
        let due = if self.connected { self.next_read } else { self.reconnect.0 };
        let now = self.config.clock.now();
        let idle = if self.wanted { due.since(now) } else { Duration::from_secs(1) };
        let idle = idle.min(Duration::from_secs(1)).min(self.until_silent(now));
        let due = now.after(idle);
        self.due.wait_until(due);
        let arrived = match adapter.state_fd() {
            Some(states) if self.connected => self.wake.wait_or_readable(states, idle),
            _ => {
                self.wake.wait(idle);
                false
            }
        };
        self.due.awake();
        self.note_delay(self.config.clock.now().since(due));
        loop {
            match orders.try_recv() {
                Ok(order) => {
                    if self.obey(adapter, order) {
                        return true;
                    }
                }
                Err(TryRecvError::Empty) => break,
                Err(TryRecvError::Disconnected) => {
                    self.finish(adapter, false).ok();
                    return true;
                }
            }
        }
        if self.connected {
            self.pass_on_command(adapter);
            self.watch_the_tick();
            self.stop(adapter);
            self.drop_what_is_pending(adapter);
            if self.connected && (arrived || self.config.clock.now() >= self.next_read) {
                self.read(adapter);
                // The reply that a setpoint was waiting for may have come.
                if self.connected && self.again {
                    self.pass_on_command(adapter);
                }
            }
        } else {
            self.skip_command();
            if self.wanted && self.config.clock.now() >= self.reconnect.0 {
                self.connect_again(adapter);
            }
        }
        false
    }

    fn obey(&mut self, adapter: &mut dyn ManipulatorAdapter, order: Order) -> bool {
        match order {
            Order::Connect(reply) => {
                let _ = reply.send(self.connect(adapter));
            }
            Order::Activate(reply) => {
                let _ = reply.send(self.activate(adapter));
            }
            Order::Disable(reply) => {
                self.expect_nothing(Some(false));
                let result = self.while_connected(adapter, |a| a.write_enable(false));
                self.turn = ENABLED_TURN;
                self.read(adapter);
                let _ = reply.send(result);
            }
            Order::ClearErrors(reply) => {
                self.write_errors = 0;
                self.expect_nothing(Some(self.state.enabled));
                let result = self.while_connected(adapter, |a| a.write_clear_errors());
                self.turn = ERROR_TURN;
                self.read(adapter);
                let _ = reply.send(result);
            }
            Order::SetLimits(limits, reply) => {
                self.set_limits(&limits);
                let _ = reply.send(Ok(()));
            }
            Order::Finish { disable, reply } => {
                let _ = reply.send(self.finish(adapter, disable));
                return true;
            }
        }
        false
    }

    fn while_connected<T>(
        &mut self,
        adapter: &mut dyn ManipulatorAdapter,
        act: impl FnOnce(&mut dyn ManipulatorAdapter) -> AdapterResult<T>,
    ) -> AdapterResult<T> {
        if self.connected { act(adapter) } else { Err(AdapterError::NotConnected) }
    }

    fn connect(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<Connected> {
        adapter.connect()?;
        let info = adapter.get_info();
        if info.dof != self.config.dof {
            adapter.disconnect();
            let (expected, found) = (self.config.dof, info.dof);
            let what = format!("expected an arm with {expected} joints, found {} with {found}", info.model);
            return Err(AdapterError::Rejected(what));
        }
        let limits = adapter.get_limits().inspect_err(|_| adapter.disconnect())?;
        self.whole_state_at_once = info.whole_state_at_once;
        // An older controller may deliver less often than its kind.
        self.config.native_rate = self.config.native_rate.min(info.native_rate);
        self.wanted = true;
        self.connected = true;
        self.write_errors = 0;
        self.reconnect.1 = BACK_OFF.0;
        self.plausible.reset();
        self.expect_nothing(None);
        self.guard.forget();
        self.in_flight = 0;
        if self.speed == 0.0 {
            self.set_limits(&limits);
        }
        self.skip_command();
        self.read(adapter);
        let write_period = self.config.write_period(adapter.set_point_period());
        self.guard.set_period(write_period);
        let read_period = self.config.read_period();
        let gripper_range = adapter.gripper().and_then(|gripper| gripper.get_gripper_range());
        Ok(Connected { info, limits, gripper_range, read_period, write_period })
    }

    fn set_limits(&mut self, limits: &JointLimits) {
        self.speed = limits.velocity_max.iter().copied().fold(0.1, f64::max);
        self.guard.set_limits(limits);
    }

    /// From here on no mode is expected of the arm, and its motors are expected to be on or off, or either way.
    fn expect_nothing(&mut self, power: Option<bool>) {
        (self.ordered_mode, self.ordered_power, self.disagreeing) = (None, power, 0);
        self.state.interference = Interference::None;
    }

    fn connect_again(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        self.state.self_held = true; // Whoever held it before, only `enable` lets it move again.
        match self.connect(adapter) {
            Ok(_) => {
                self.health.reconnects.fetch_add(1, Relaxed);
                self.well_again();
            }
            Err(_) => {
                let wait = self.reconnect.1;
                self.reconnect = (self.config.clock.now().after(wait), (wait * 2).min(BACK_OFF.1));
            }
        }
    }

    /// Enables the motors: only with states that are fresh and agree with each other, and verified.
    fn activate(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        if !self.connected {
            return Err(AdapterError::NotConnected);
        }
        let limit = self.config.clock.now().after(ACTIVATION_LIMIT);
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
        self.expect_nothing(None);
        adapter.activate()?;
        let limit = self.config.clock.now().after(ACTIVATION_LIMIT);
        while !adapter.read_enabled()? {
            if self.config.clock.now() >= limit {
                return Err(AdapterError::Timeout("enabled, but the motors do not come on".to_owned()));
            }
            std::thread::sleep(Duration::from_millis(5));
            self.read(adapter);
        }
        self.ordered_power = Some(true);
        self.state.self_held = false;
        self.stop_owed = false;
        self.gripper_stop.end();
        self.write_errors = 0;
        self.turn = 0;
        for _ in 0..TURNS {
            self.read(adapter);
        }
        Ok(())
    }

    fn finish(&mut self, adapter: &mut dyn ManipulatorAdapter, disable: bool) -> AdapterResult<()> {
        let mut result = Ok(());
        // An arm that another program has taken over is left to it.
        if self.connected && self.state.interference != Interference::Mode {
            result = adapter.deactivate();
            if disable {
                self.wait_for_standstill(adapter);
                result = result.and(adapter.write_enable(false));
            }
        }
        adapter.disconnect();
        self.connected = false;
        self.wanted = false;
        self.state.link = Link::Down;
        self.states.write(&self.state);
        result
    }

    /// Motors are not switched off, and brakes not closed, under an arm that still moves; but not for ever either.
    fn wait_for_standstill(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let limit = self.config.clock.now().after(REST_LIMIT);
        let mut still_for = 0.0;
        loop {
            let before = (self.state.position, self.state.stamp);
            std::thread::sleep(self.config.read_period());
            self.read(adapter);
            let past = self.state.stamp.seconds_since(before.1).max(1e-3);
            let moved = self.state.position.iter().zip(before.0).take(self.config.dof);
            let still = moved.map(|(now, then)| (now - then).abs() / past).all(|v| v <= STANDSTILL);
            // One instant is not enough: it is also where a joint turns round.
            still_for = if still { still_for + self.state.stamp.seconds_since(before.1) } else { 0.0 };
            if !self.connected || still_for >= STILL_FOR || self.config.clock.now() >= limit {
                return;
            }
        }
    }

    /// Takes the newest command. Answers the one before it.
    fn take_command(&mut self) -> ArmCommand {
        let command = self.commands.read();
        self.stop_owed |= command.stop_seq != self.last.stop_seq;
        std::mem::replace(&mut self.last, command)
    }

    /// Takes the newest command while there is no connection: a stop is kept for later, a gripper order is refused.
    fn skip_command(&mut self) {
        let before = self.take_command();
        if self.last.gripper_seq != before.gripper_seq {
            self.health.answer_gripper(self.last.gripper_seq, Err(AdapterError::NotConnected));
        }
    }

    /// Whether the arm is being moved by commands, as far as this thread lets them through.
    fn moving(&self) -> bool {
        self.connected && self.last.mode.is_some() && !self.state.self_held
    }

    fn pass_on_command(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let before = self.take_command();
        let command = self.last;
        if command.seq == before.seq && !self.again {
            return;
        }
        self.again = false;
        // A device that is asked is asked just before the tick; one that sends by itself sets its own pace.
        if adapter.state_fd().is_none() {
            self.read_before(command.next_tick);
        }
        if command.gripper_seq != before.gripper_seq {
            self.move_gripper(adapter, &command);
        }
        if self.state.self_held || !self.connected {
            return;
        }
        match self.write(adapter, &command) {
            Ok(()) if self.stop_owed => {}
            Ok(()) => self.write_errors = 0,
            // Not sent, and no failure: the tick sees that it was not written.
            Err(AdapterError::Busy) => self.again = true,
            Err(error) => {
                if matches!(error, AdapterError::Timeout(_)) {
                    self.in_flight += 1;
                }
                self.not_taken(adapter, "a command was not taken", &error);
            }
        }
        // At once: the next tick continues from what was written.
        self.states.write(&self.state);
    }

    /// Commands the gripper and answers that order. A refusal costs the joints nothing.
    fn move_gripper(&mut self, adapter: &mut dyn ManipulatorAdapter, command: &ArmCommand) {
        let result = if self.state.self_held {
            Err(AdapterError::Rejected("the arm is held; `arm enable` makes it ready again".to_owned()))
        } else {
            self.gripper_stop.end();
            let gripper = adapter.gripper().ok_or(AdapterError::Unsupported);
            gripper.and_then(|gripper| gripper.write_gripper_position(command.gripper))
        };
        match &result {
            Ok(()) => {}
            Err(error @ (AdapterError::Rejected(_) | AdapterError::Unsupported | AdapterError::Fault { .. })) => {
                self.health.write_errors.fetch_add(1, Relaxed);
                self.trouble(&format!("the gripper did not take its order: {error}"));
            }
            Err(error) => {
                if matches!(error, AdapterError::Timeout(_)) {
                    self.in_flight += 1;
                }
                self.not_taken(adapter, "the gripper did not take its order", error);
            }
        }
        self.health.answer_gripper(command.gripper_seq, result);
    }

    /// Setpoints that the arm did not acknowledge must not reach it later: with two of them, or with one and no state,
    /// what is still on its way is discarded before anything new goes out.
    fn drop_what_is_pending(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let age = self.config.clock.now().since(self.state.stamp.max(self.last_read));
        let stale = age > self.config.state_timeout() && self.state.seq != 0;
        if self.connected && (self.in_flight > 0 || self.again) && stale {
            self.trouble("setpoints are not acknowledged and no state arrives: what is pending is discarded");
            self.discard(adapter);
        }
    }

    fn discard(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        (self.in_flight, self.again) = (0, false);
        self.state.self_held = true;
        adapter.discard_pending();
        if !adapter.is_connected() {
            self.lost();
        }
        self.states.write(&self.state);
    }

    /// The connection is gone; it is made again.
    fn lost(&mut self) {
        self.connected = false;
        self.plausible.reset();
        self.state.link = Link::Faulted;
        self.reconnect = (self.config.clock.now().after(BACK_OFF.0), BACK_OFF.0);
    }

    /// Sets the next read so that it ends just before the tick at `next_tick`.
    fn read_before(&mut self, next_tick: Mono) {
        let lead = Duration::from_secs_f64((3.0 * self.read_time).max(1e-3)).min(self.config.tick_period / 2);
        let earliest = self.last_read.after(self.config.read_period().mul_f64(0.8));
        self.next_read = self.next_read.min(next_tick.before(lead)).max(earliest);
    }

    fn write(&mut self, adapter: &mut dyn ManipulatorAdapter, command: &ArmCommand) -> AdapterResult<()> {
        let Some(mode) = command.mode else { return Ok(()) };
        // Another mode than the one that was ordered is somebody else's: it is left alone, and shows in the next state.
        let foreign = self.ordered_mode == Some(mode) && adapter.get_control_mode() != mode;
        if foreign || self.state.interference != Interference::None {
            return Ok(());
        }
        if adapter.get_control_mode() != mode {
            self.ordered_mode = None;
            match adapter.set_control_mode(mode) {
                // The arm may hold itself to be moving for a moment longer than we do: the tick waits for the mode,
                // and this is asked again with the next command.
                Err(AdapterError::Rejected(_)) if !self.waited_too_long_for_a_mode() => return Ok(()),
                result => result?,
            }
        }
        self.mode_wanted = None;
        self.ordered_mode = Some(mode);
        let age = self.config.clock.now().since(self.state.stamp);
        if !self.guard.admits(command, mode, &self.state, age, self.config.read_period()) {
            self.health.withheld.fetch_add(1, Relaxed);
            return Ok(());
        }
        let values = command.values.get(..self.config.dof).unwrap_or_default();
        let written = match mode {
            ControlMode::Velocity => adapter.write_joint_velocities(values),
            _ => adapter.write_joint_positions(values, 1.0),
        };
        // A setpoint without an answer may have reached the arm: what comes next continues from it.
        if matches!(written, Ok(()) | Err(AdapterError::Timeout(_))) {
            self.guard.wrote(command, mode);
            self.state.written = command.seq;
        }
        written?;
        self.in_flight = 0;
        self.health.writes.fetch_add(1, Relaxed);
        Ok(())
    }

    /// Whether the arm has refused a change of mode for longer than it may take to stand still.
    fn waited_too_long_for_a_mode(&mut self) -> bool {
        let now = self.config.clock.now();
        now.since(*self.mode_wanted.get_or_insert(now)) > MODE_LIMIT
    }

    /// Asks the arm to stop by its own means, again and again until it has taken it.
    fn stop(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        if !self.stop_owed || !self.connected {
            return;
        }
        let power = self.ordered_power;
        match adapter.write_stop() {
            Ok(stop) => {
                self.stop_owed = false;
                let interference = self.state.interference;
                self.expect_nothing(power);
                self.state.interference = interference;
                self.gripper_stop.begin(self.config.clock.now());
                if stop == Stop::Confirmed {
                    self.health.stop_confirmed.store(self.last.stop_seq, Relaxed);
                }
                // Last: whoever sees it sees the confirmation too.
                self.health.stop_sent.store(self.last.stop_seq, Release);
                self.health.answered();
            }
            Err(error) => self.not_taken(adapter, "the arm did not take the stop", &error),
        }
    }

    /// Holds a gripper that goes on after a stop. Joints and gripper are held one after the other: the joints first.
    fn hold_gripper(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let now = self.config.clock.now();
        let Some(here) = self.state.gripper.and_then(|opening| self.gripper_stop.look(opening, now)) else { return };
        let Some(gripper) = adapter.gripper() else { return };
        let (closed, open) = gripper.get_gripper_range().unwrap_or((0.0, f64::MAX));
        if let Err(error) = gripper.write_gripper_position(here.max(closed).min(open)) {
            self.trouble(&format!("the gripper did not take the stop: {error}"));
        }
    }

    fn not_taken(&mut self, adapter: &mut dyn ManipulatorAdapter, what: &str, error: &AdapterError) {
        self.health.write_errors.fetch_add(1, Relaxed);
        self.write_errors += 1;
        // Commands and stops go the same way: the first that is not taken is told, the rest only count.
        if self.write_errors == 1 {
            self.write_trouble = format!("{what}: {error}");
        }
        let text = self.write_trouble.clone();
        self.trouble(&text);
        self.after_error(adapter, error);
    }

    /// How long the tick may still be silent, where its silence would matter.
    fn until_silent(&self, now: Mono) -> Duration {
        let Some(silence) = self.config.beat.silence(now).filter(|_| self.moving()) else { return Duration::MAX };
        let timeout = self.config.beat_timeout();
        let left = (timeout + self.delay.1).saturating_sub(silence);
        // A tick that sleeps and was not woken does not hang, it got no processor: not for long enough to hold the arm.
        let overdue = self.config.beat.overdue(now);
        if overdue.is_zero() { left } else { left.max(LONGEST_DELAY.saturating_sub(overdue)) }
    }

    /// This thread woke late: it could not have seen the tick meanwhile, and the tick could hardly have run.
    fn note_delay(&mut self, late: Duration) {
        let beat = self.config.beat.last();
        if self.delay.0 != beat {
            self.delay = (beat, Duration::ZERO);
        }
        if (Duration::from_millis(1)..LONGEST_DELAY).contains(&late) {
            self.delay.1 = (self.delay.1 + late).min(LONGEST_DELAY);
        }
    }

    /// The checker is not the checked: when the tick falls silent, this thread holds the arm.
    fn watch_the_tick(&mut self) {
        if self.until_silent(self.config.clock.now()).is_zero() {
            self.state.self_held = true;
            self.stop_owed = true;
            let silence = self.config.beat.silence(self.config.clock.now()).unwrap_or_default().as_millis();
            let limit = self.config.beat_timeout().as_millis();
            self.trouble(&format!("no tick for {silence} ms (limit {limit} ms): held by the device thread"));
            self.states.write(&self.state);
        }
    }

    fn read(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        if !self.connected {
            return;
        }
        let began = self.config.clock.now();
        self.next_read = began.after(self.config.read_period());
        match self.read_all(adapter) {
            Ok(()) => {
                let ended = self.config.clock.now();
                self.read_time += 0.1 * (ended.seconds_since(began) - self.read_time);
                self.take_reading(began);
                self.read_errors = 0;
                self.state.link = if self.write_errors >= MAX_FAILURES { Link::Faulted } else { Link::Up };
                if self.state.link == Link::Up && self.write_errors == 0 && !self.state.self_held {
                    self.well_again();
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
    }

    fn read_all(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
        adapter.read_joints(&mut self.reading)?;
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
        if all || turn == 2 {
            self.state.gripper = adapter.gripper().map_or(Ok(None), |gripper| gripper.read_gripper_position())?;
            self.hold_gripper(adapter);
        }
        if all || turn == 3 {
            self.state.wrench = adapter.force_torque().map_or(Ok(None), |sensor| sensor.read_force_torque())?;
        }
        if all || turn == 4 {
            self.state.pose = adapter.cartesian().map_or(Ok(None), |poses| poses.read_cartesian_position())?;
        }
        if all || turn == 5 {
            self.read_codes(adapter)?;
        }
        self.state.mode = adapter.get_control_mode();
        self.compare_with_orders();
        self.heed(adapter.foreign_change());
        Ok(())
    }

    /// Reads the device's own state codes, for `status`.
    fn read_codes(&mut self, adapter: &mut dyn ManipulatorAdapter) -> AdapterResult<()> {
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

    /// What the adapter itself says was changed by another client of the device.
    fn heed(&mut self, foreign: Option<&'static str>) {
        let Some(what) = foreign.filter(|_| self.state.interference == Interference::None) else { return };
        let mode = self.ordered_mode.is_some_and(|ordered| ordered != self.state.mode);
        self.state.interference = if mode { Interference::Mode } else { Interference::Stop };
        self.trouble(what);
    }

    /// Whether the arm is in the condition that this run ordered.
    fn compare_with_orders(&mut self) {
        if !self.state.enabled {
            self.guard.forget();
        }
        let mode = self.ordered_mode.is_some_and(|ordered| ordered != self.state.mode);
        // Motors that go off are the tick's to see: it names that by itself.
        let power = self.ordered_power == Some(false) && self.state.enabled;
        self.disagreeing = if mode || power { self.disagreeing + 1 } else { 0 };
        if self.disagreeing >= INTERFERENCE_READINGS && self.state.interference == Interference::None {
            self.state.interference = if mode { Interference::Mode } else { Interference::Power };
        }
    }

    fn take_reading(&mut self, began: Mono) {
        let stamp = self.reading.stamp.unwrap_or(began);
        if self.state.seq != 0 && self.reading.stamp == Some(self.state.stamp) {
            return; // nothing new; its age tells
        }
        self.plausible.take(&self.reading, stamp, &self.state, self.speed, &self.config.supervision);
        self.health.state_came(if self.state.seq == 0 { 0.0 } else { began.seconds_since(self.last_read) });
        self.last_read = began;
        self.state.seq += 1;
        self.state.stamp = stamp;
        self.state.position = self.reading.position;
        self.state.effort = self.reading.effort;
        self.state.velocity = self.reading.velocity.unwrap_or_default();
        self.state.velocity_source =
            if self.reading.velocity.is_some() { VelocitySource::Measured } else { VelocitySource::Absent };
    }

    /// What an error means for the connection.
    fn after_error(&mut self, adapter: &mut dyn ManipulatorAdapter, error: &AdapterError) {
        if matches!(error, AdapterError::NotConnected) || !adapter.is_connected() {
            adapter.discard_pending();
            adapter.disconnect();
            self.lost();
        } else if self.in_flight >= MAX_IN_FLIGHT {
            self.discard(adapter);
        } else if self.write_errors >= MAX_FAILURES {
            self.state.link = Link::Faulted;
        }
        self.states.write(&self.state);
    }

    fn trouble(&mut self, text: &str) {
        if self.health.trouble(self.config.clock.now(), text) {
            (self.config.notes)(Note::Began(text.to_owned()));
        }
    }

    fn well_again(&mut self) {
        // An arm that reports an error is not well, only reachable.
        if self.state.error == 0
            && let Some(text) = self.health.over(self.config.clock.now())
        {
            (self.config.notes)(Note::Over(text));
        }
    }
}

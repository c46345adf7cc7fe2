//! The loop of a device thread: waits, executes orders, sends the newest command, reads the state.

mod commands;
mod connection;
mod lead;
mod limits;
mod payload;
mod peripherals;
mod readings;
mod slow_readings;
#[cfg(test)]
mod tests;
mod tick_monitor;
mod wrench;

pub use lead::Way;

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError};
use std::time::Duration;

use super::gripper::GripperStop;
use super::plausible::Plausible;
use super::wire_guard::WireGuard;
use super::{DeviceConfig, Health, Note, Order};
use crate::adapter::{AdapterError, AdapterResult, JointReading, ManipulatorAdapter, RobotState};
use dimos_core::arm::{ArmCommand, ArmState, Link, Load};
use dimos_core::clock::Mono;
use dimos_core::joint::ControlMode;
use dimos_core::sync::panic_text;
use dimos_rt::due::Due;
use dimos_rt::host;
use dimos_rt::slot::{SlotReader, SlotWriter};
use dimos_rt::wake::Wake;

/// Consecutive failures before the connection is `Stale` (reads) or `Faulted` (writes).
const MAX_FAILURES: u32 = 3;
/// Where each read costs a round trip, one cycle reads the joints and one more value; after this many cycles all values
/// have been read.
const TURNS: u8 = 6;
/// Cycles that read the error code and the motors' state.
const ERROR_TURN: u8 = 0;
const ENABLED_TURN: u8 = 1;
/// How long clearing the arm's errors may take; clients wait a little longer for it.
const CLEAR_LIMIT: Duration = Duration::from_millis(7500);
/// Shortest and longest wait between two attempts to reconnect.
const BACK_OFF: (Duration, Duration) = (Duration::from_millis(500), Duration::from_secs(5));

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
    /// `reading` has answered a setpoint, and is to be taken.
    exchanged: bool,
    codes: Option<RobotState>,
    last: ArmCommand,
    /// The arm has not taken the newest stop yet. Kept until it does, across reconnects.
    stop_pending: bool,
    gripper_stop: GripperStop,
    /// Text of the first of the consecutive failed writes, for the log.
    first_write_failure: String,
    /// When the arm began to refuse a change of mode.
    mode_refused_since: Option<Mono>,
    /// Connected once: reconnect when the connection is lost.
    should_reconnect: bool,
    connected: bool,
    whole_state_at_once: bool,
    turn: u8,
    read_errors: u32,
    write_errors: u32,
    /// The adapter's warning of its connection was logged.
    warned: bool,
    plausible: Plausible,
    /// Velocity limit of the fastest joint [rad/s].
    speed: f64,
    guard: WireGuard,
    /// Limits of commands, compared with the controller's own.
    limits: limits::RunLimits,
    /// Setpoints without an acknowledgement that may still reach the arm.
    in_flight: u32,
    /// The newest command was not sent because earlier ones were still in flight.
    resend: bool,
    /// The mode that this run has set; `None` while it has set none.
    ordered_mode: Option<ControlMode>,
    /// Whether this run enabled or disabled the motors last.
    ordered_power: Option<bool>,
    /// Consecutive readings that disagree with what was ordered.
    disagreeing: u32,
    /// How late this thread woke for the present cycle.
    late: Duration,
    /// The tick, as seen by this thread.
    tick: tick_monitor::Seen,
    slow: slow_readings::Slow,
    /// The arm is led, or about to be.
    lead: lead::Lead,
    /// The errors are being cleared, since then.
    clearing: Option<(SyncSender<AdapterResult<()>>, Mono)>,
    /// The load to set whenever the motors are enabled.
    payload: Option<Load>,
    /// The wrench as measured, and what is subtracted from it.
    measured_wrench: Option<wrench::Wrench>,
    tare: wrench::Wrench,
    /// A motion awaits an input: they are read with every state.
    watches_inputs: bool,
    last_read: Mono,
    next_read: Mono,
    read_time: f64,
    /// Time of the next attempt to reconnect, and the wait after it.
    reconnect: (Mono, Duration),
}

impl Worker {
    pub(super) fn new(
        config: DeviceConfig,
        states: SlotWriter<ArmState>,
        commands: SlotReader<ArmCommand>,
        shared: Shared,
    ) -> Self {
        let payload = config.setup.payload;
        let state = ArmState { dof: config.dof, ..ArmState::default() };
        let Shared { wake, health, due } = shared;
        Self {
            due,
            guard: WireGuard::new(config.dof, config.write_period(None), config.supervision),
            limits: limits::RunLimits::default(),
            in_flight: 0,
            resend: false,
            ordered_mode: None,
            ordered_power: None,
            disagreeing: 0,
            late: Duration::ZERO,
            tick: tick_monitor::Seen::default(),
            speed: 0.0,
            config,
            states,
            commands,
            wake,
            health,
            state,
            reading: JointReading::default(),
            exchanged: false,
            codes: None,
            last: ArmCommand::default(),
            stop_pending: false,
            gripper_stop: GripperStop::default(),
            first_write_failure: String::new(),
            mode_refused_since: None,
            should_reconnect: false,
            connected: false,
            whole_state_at_once: false,
            turn: 0,
            read_errors: 0,
            write_errors: 0,
            warned: false,
            plausible: Plausible::default(),
            slow: slow_readings::Slow::default(),
            lead: lead::Lead::default(),
            clearing: None,
            payload,
            measured_wrench: None,
            tare: wrench::Wrench::default(),
            watches_inputs: false,
            last_read: Mono::ZERO,
            next_read: Mono::ZERO,
            read_time: 0.0,
            reconnect: (Mono::ZERO, BACK_OFF.0),
        }
    }

    /// Runs until it is ordered to finish. A panic of the adapter affects this arm only.
    pub(super) fn run(mut self, mut adapter: Box<dyn ManipulatorAdapter>, orders: Receiver<Order>) {
        host::enter_realtime(host::DEVICE_PRIORITY);
        let outcome = catch_unwind(AssertUnwindSafe(|| while !self.cycle(&mut *adapter, &orders) {}));
        if let Err(panic) = outcome {
            self.trouble(&format!("the adapter panicked: {}", panic_text(&*panic)));
            self.state.link = Link::Faulted;
            self.states.write(&self.state);
            let _ = catch_unwind(AssertUnwindSafe(|| adapter.write_stop(&self.stop_point())));
            // The adapter is unusable. Dropping the receiver refuses further orders.
            let _ = catch_unwind(AssertUnwindSafe(move || drop(adapter)));
        }
    }

    /// Runs one cycle: waits, executes orders, sends the newest command, reads. Returns `true` when the thread is to
    /// end.
    fn cycle(&mut self, adapter: &mut dyn ManipulatorAdapter, orders: &Receiver<Order>) -> bool {
        let due = if self.connected { self.next_read } else { self.reconnect.0 };
        let now = self.config.clock.now();
        let idle = if self.should_reconnect { due.since(now) } else { Duration::from_secs(1) };
        let idle = idle.min(Duration::from_secs(1)).min(self.until_tick_check(now));
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
        let woke = self.config.clock.now();
        self.late = woke.since(due);
        self.see_tick(woke, self.late);
        // One per cycle: clients that ask without a pause delay no setpoint and no stop by more than one answer.
        match orders.try_recv() {
            Ok(order) => {
                if self.execute_order(adapter, order) {
                    return true;
                }
                self.wake.raise();
            }
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => {
                self.finish(adapter, false).ok();
                return true;
            }
        }
        self.clear_errors(adapter);
        if self.connected {
            self.send_command(adapter);
            self.check_tick();
            self.stop(adapter);
            self.begin_to_lead(adapter);
            self.discard_if_stale(adapter);
            if self.connected && (arrived || self.exchanged || self.config.clock.now() >= self.next_read) {
                self.read(adapter);
                // The read may have taken the acknowledgement that the command waits for.
                if self.connected && self.resend {
                    self.send_command(adapter);
                }
            }
        } else {
            self.skip_command();
            if self.should_reconnect && self.config.clock.now() >= self.reconnect.0 {
                self.reconnect_arm(adapter);
            }
        }
        false
    }

    fn execute_order(&mut self, adapter: &mut dyn ManipulatorAdapter, order: Order) -> bool {
        match order {
            Order::Connect(reply) => {
                let _ = reply.send(self.connect(adapter));
            }
            Order::Activate(reply) => {
                let _ = reply.send(self.activate(adapter));
            }
            Order::TakeOver(reply) => {
                // Motors that somebody has switched off meanwhile stay off.
                let off = self.ordered_power == Some(false) || !self.state.enabled;
                let refused = || Err(AdapterError::Rejected("its motors were switched off".to_owned()));
                let _ = reply.send(if off { refused() } else { self.activate(adapter) });
            }
            Order::Disable(reply) => {
                self.lead.end("the motors were switched off");
                let result = self.while_connected(adapter, |a| a.write_enable(false));
                // After a refusal the motors are still on, which is no interference.
                self.expect_nothing(result.is_ok().then_some(false));
                self.turn = ENABLED_TURN;
                self.read(adapter);
                let _ = reply.send(result);
            }
            Order::ClearErrors(reply) => {
                self.write_errors = 0;
                match self.clearing {
                    None => self.clearing = Some((reply, self.config.clock.now())),
                    Some(_) => {
                        drop(reply.send(Err(AdapterError::Rejected(
                            "a reset is under way\nhint: wait for its end".to_owned(),
                        ))))
                    }
                }
            }
            Order::SetLimits(limits, reply) => {
                self.set_limits(&limits);
                adapter.set_limits(&limits);
                let _ = reply.send(Ok(()));
            }
            Order::ReadIo(reply) => {
                let _ = reply.send(self.while_connected(adapter, slow_readings::read_io));
            }
            Order::SetOutput(value, reply) => {
                let result = self.while_connected(adapter, |a| slow_readings::set_output(a, value));
                self.slow.read_io_next();
                let _ = reply.send(result);
            }
            Order::ReadPayload(reply) => {
                let _ = reply.send(self.while_connected(adapter, payload::read));
            }
            Order::SetPayload(load, reply) => {
                let _ = reply.send(self.set_payload(adapter, &load));
            }
            Order::Tare(reply) => {
                let _ = reply.send(self.take_tare(adapter));
            }
            Order::WatchInputs(reply) => {
                let read = self.while_connected(adapter, slow_readings::read_io).map(drop);
                self.watches_inputs |= read.is_ok();
                let _ = reply.send(read);
            }
            Order::Lead(way, lead_seq, reply) => {
                self.expect_nothing(self.ordered_power);
                self.lead.order(way, lead_seq, reply, self.config.clock.now());
            }
            Order::Finish { disable, reply } => {
                let _ = reply.send(self.finish(adapter, disable));
                return true;
            }
        }
        false
    }

    /// Clears the arm's errors, if that was ordered. An arm that needs time for it is asked again in the next cycle.
    fn clear_errors(&mut self, adapter: &mut dyn ManipulatorAdapter) {
        let Some((reply, since)) = self.clearing.take() else { return };
        self.expect_nothing(Some(self.state.enabled));
        let result = self.while_connected(adapter, |a| a.write_clear_errors());
        if result == Err(AdapterError::Busy) && self.config.clock.now().since(since) < CLEAR_LIMIT {
            self.clearing = Some((reply, since));
            return;
        }
        self.turn = ERROR_TURN;
        self.read(adapter);
        let _ = reply.send(result);
    }

    fn while_connected<T>(
        &mut self,
        adapter: &mut dyn ManipulatorAdapter,
        act: impl FnOnce(&mut dyn ManipulatorAdapter) -> AdapterResult<T>,
    ) -> AdapterResult<T> {
        if self.connected { act(adapter) } else { Err(AdapterError::NotConnected) }
    }

    fn trouble(&mut self, text: &str) {
        if self.health.trouble(self.config.clock.now(), text) {
            (self.config.notes)(Note::Began(text.to_owned()));
        }
    }

    fn clear_trouble(&mut self) {
        // An arm that reports an error is reachable, but still in trouble.
        if self.state.error == 0
            && let Some(text) = self.health.over(self.config.clock.now())
        {
            (self.config.notes)(Note::Over(text));
        }
    }
}

//! What this run orders of a controller besides motion: power and brakes, the program, the end of a protective stop.
//! Nothing here is done without an order.

use std::time::Duration;

use super::Options;
use super::program;
use super::protocol::inputs::Order;
use super::protocol::status::{self, robot, robot_name, safety, safety_text};
use super::rtde::in_use;
use super::session::Session;
use dimos_core::clock::{Clock, Mono, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult};

/// How long enabling may take before the program starts: power and brakes of a real arm take longer, and enabling again
/// continues.
const POWER_LIMIT: Duration = Duration::from_millis(5500);
/// The brakes are released only if this much time is left: a release continues after this call.
const BRAKE_TIME: Duration = Duration::from_secs(4);
/// How long a program that an earlier connection has left may take to end: by order, or because no orders come.
const LEFTOVER_LIMIT: Duration = Duration::from_millis(1200);
/// How long the motors may take to go off.
const OFF_LIMIT: Duration = Duration::from_secs(3);
/// How long the arm may take to stop before the program starts, or its motors go off.
const REST_LIMIT: Duration = Duration::from_millis(1500);
/// How long the program may take to start.
const START_LIMIT: Duration = Duration::from_millis(1500);
/// A protective stop is released this long after it was seen at the earliest, as the controller demands, too.
const PROTECTED: Duration = Duration::from_millis(5100);
/// How long the end of a protective stop or of a paused program may take to show, and that of a fault of the safety
/// system.
const RELEASE_LIMIT: Duration = Duration::from_secs(1);
const RESTART_LIMIT: Duration = Duration::from_secs(5);

impl Session {
    /// Switches power on, releases the brakes, and starts the program. The joints move slightly when their brakes are
    /// released, and nothing moves otherwise.
    pub fn activate(&mut self, options: &Options) -> AdapterResult<()> {
        self.update(Duration::ZERO)?;
        self.fault()?;
        if !self.rtde.takes_orders() {
            return Err(in_use());
        }
        let limit = MonotonicClock.now().after(POWER_LIMIT);
        self.end_leftover()?;
        self.power_on(limit)?;
        // One that was started meanwhile.
        self.end_leftover()?;
        self.start(options)
    }

    /// Waits for the end of a program that an earlier connection of dimos has left; any other one is not replaced.
    fn end_leftover(&mut self) -> AdapterResult<()> {
        if self.ready.is_some() || !self.program_exists() {
            return Ok(());
        }
        // Only a program of dimos takes it; it also ends when orders do not come.
        self.order(Order::Stop)?;
        self.unanswered = None;
        let ended = self.wait(LEFTOVER_LIMIT, |session| Ok((!session.program_exists()).then_some(())))?;
        ended.ok_or_else(|| {
            AdapterError::Rejected(
                "another program is on the controller, running or paused: enabling would end it\nhint: end it first: \
                 `dimos stop`, then reset and enable the arm"
                    .into(),
            )
        })
    }

    fn power_on(&mut self, limit: Mono) -> AdapterResult<()> {
        let mut panel = self.panel()?;
        if !panel.is_in_remote_control(self.device.model.is_cb3())? {
            return Err(AdapterError::Rejected(
                "the controller is in local control\nhint: select remote control at the pendant".into(),
            ));
        }
        if self.enabled() {
            return Ok(());
        }
        if !matches!(self.state.robot_mode, robot::POWER_OFF | robot::POWER_ON | robot::IDLE) {
            let name = robot_name(self.state.robot_mode);
            return Err(AdapterError::Rejected(format!("the controller is not ready: its robot mode is {name}")));
        }
        let braked = self.state.robot_mode == robot::IDLE;
        panel.close_safety_popup()?;
        if !braked {
            panel.order("power on", "powering on")?;
            self.reach(robot::IDLE, limit)?;
        }
        // What is ordered continues after this call, and after the end of the run.
        if !braked && limit.since(MonotonicClock.now()) < BRAKE_TIME {
            return Err(AdapterError::Rejected(
                "the arm is on, and its brakes hold: too little time was left to release them\nhint: enable it again"
                    .into(),
            ));
        }
        panel.order("brake release", "brake releasing")?;
        self.reach(robot::RUNNING, limit)
    }

    /// Waits for a robot mode.
    fn reach(&mut self, mode: i32, limit: Mono) -> AdapterResult<()> {
        let reached = self.wait(limit.since(MonotonicClock.now()), |session| {
            session.fault()?;
            Ok((session.state.robot_mode >= mode).then_some(()))
        })?;
        reached.ok_or_else(|| {
            let name = robot_name(self.state.robot_mode);
            AdapterError::Rejected(format!(
                "the arm is still being switched on ({name}) after {POWER_LIMIT:?}\nhint: enable it again when the pendant \
                 shows it on"
            ))
        })
    }

    /// Starts the program, which replaces an earlier one of this session.
    fn start(&mut self, options: &Options) -> AdapterResult<()> {
        (self.ready, self.ended) = (None, None);
        // Any number that differs from that of the program before.
        let number = (MonotonicClock.now().0 >> 10) as i32 & i32::MAX;
        // What the registers hold from before is not an order for the new program.
        self.order(Order::Hold)?;
        // It would take joints that move for ones at rest. An earlier one decelerates them, as ordered.
        if self.wait(REST_LIMIT, |session| Ok(session.at_rest().then_some(())))?.is_none() {
            return Err(AdapterError::Rejected(format!(
                "the arm still moves after {REST_LIMIT:?}\nhint: enable it at rest"
            )));
        }
        let text = program::control(number, options, &self.device.limits);
        self.run_program(&text)?;
        let started = self.wait(START_LIMIT, |session| {
            session.fault()?;
            session.check_program()?;
            let holds = session.state.number == number && session.state.program == status::program::HOLDING;
            Ok((holds && session.program_runs() && session.state.count == session.count).then_some(()))
        })?;
        self.unanswered = None;
        if started.is_none() {
            return Err(AdapterError::Timeout(format!(
                "ur at {}: the program did not start within {START_LIMIT:?}\nhint: the pendant's log may say why",
                self.address
            )));
        }
        self.ready = Some(number);
        Ok(())
    }

    /// Stops, and switches power off: the brakes hold.
    pub fn disable(&mut self) -> AdapterResult<()> {
        if self.foreign_change().is_some() && self.program_exists() {
            return Err(AdapterError::Rejected(
                "another program commands the arm\nhint: `dimos arm reset`, then disable it".into(),
            ));
        }
        if self.program_exists() {
            self.stop()?;
            // A stop is confirmed when it begins; brakes are for joints at rest.
            self.wait(REST_LIMIT, |session| Ok(session.at_rest().then_some(())))?;
        }
        (self.ready, self.ended) = (None, None);
        self.panel()?.order("power off", "powering off")?;
        let off = self.wait(OFF_LIMIT, |session| Ok((session.state.robot_mode <= robot::POWER_OFF).then_some(())))?;
        off.ok_or_else(|| AdapterError::Timeout(format!("the motors do not go off within {OFF_LIMIT:?}")))
    }

    /// Ends a protective stop or a fault of the safety system. Only for an operator who has found its cause. A paused
    /// program is ended first: it would continue. `Busy` until it is done: call it again with the next state.
    pub fn clear_errors(&mut self) -> AdapterResult<()> {
        let cleared = self.update(Duration::ZERO).and_then(|()| self.next_step());
        if !matches!(cleared, Err(AdapterError::Busy)) {
            self.asked = None;
        }
        cleared
    }

    /// Does the next step of that, without waiting for its effect.
    fn next_step(&mut self) -> AdapterResult<()> {
        (self.ready, self.ended) = (None, None);
        let Some(stopped) = self.stopped else { return Ok(()) };
        match stopped.mode {
            // Also one that was paused after another was ended: by hand, at the pendant.
            safety::PROTECTIVE_STOP if self.program_exists() => self.once("stop", "stopped", RELEASE_LIMIT),
            safety::PROTECTIVE_STOP if MonotonicClock.now().since(stopped.since) < PROTECTED => {
                self.asked = None;
                Err(AdapterError::Busy)
            }
            safety::PROTECTIVE_STOP => self.once("unlock protective stop", "protective stop releasing", RELEASE_LIMIT),
            safety::VIOLATION | safety::FAULT => self.once("restart safety", "restarting safety", RESTART_LIMIT),
            mode => Err(AdapterError::Rejected(format!(
                "{}\nhint: end its cause, then reset the arm again",
                safety_text(mode)
            ))),
        }
    }

    /// Sends an order to the dashboard once; then `Busy` until `limit`, by which it must have had its effect.
    fn once(&mut self, order: &'static str, expected: &str, limit: Duration) -> AdapterResult<()> {
        if let Some((_, since, answer)) = self.asked.as_ref().filter(|(asked, ..)| *asked == order) {
            if MonotonicClock.now().since(*since) < limit {
                return Err(AdapterError::Busy);
            }
            answer.clone()?;
            return Err(AdapterError::Rejected(match self.program_exists() {
                true => {
                    "the paused program does not end, and would continue after the stop\nhint: end it at the pendant"
                        .into()
                }
                false => {
                    format!("{}, still\nhint: the pendant shows what to do", safety_text(self.state.safety_mode))
                }
            }));
        }
        let mut panel = self.panel()?;
        let answer = if order == "stop" {
            panel.order(order, expected) // the program may end although the dashboard answers otherwise
        } else {
            panel.close_safety_popup()?;
            Ok(panel.order(order, expected)?)
        };
        self.asked = Some((order, MonotonicClock.now(), answer));
        Err(AdapterError::Busy)
    }
}

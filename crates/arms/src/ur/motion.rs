//! Motion commands of a session: setpoints and stops.

use std::time::Duration;

use super::primary::Primary;
use super::protocol::inputs::Order;
use super::protocol::status::program;
use super::session::Session;
use dimos_core::clock::{Clock, MonotonicClock};
use dimos_hardware::adapter::{AdapterError, AdapterResult, Stop};

/// Setpoints are not sent while none of the last ones was answered for this time, of an e-Series and of a CB3
/// controller: longer than 3 steps of 2 and of 8 ms, and so short that an arm at top speed, which cannot catch up,
/// follows within its tracking tolerance.
const MAX_UNANSWERED: [Duration; 2] = [Duration::from_millis(20), Duration::from_millis(40)];
/// How long a stop waits for the program's answer, and for what the dashboard does after that.
pub(super) const STOP_LIMIT: Duration = Duration::from_millis(300);
const DASHBOARD_LIMIT: Duration = Duration::from_millis(700);

impl Session {
    /// Refuses motion unless our program takes orders.
    fn may_be_commanded(&self) -> AdapterResult<()> {
        self.fault()?;
        if !self.enabled() {
            return Err(AdapterError::Rejected("the motors are disabled".into()));
        }
        if self.ready.is_none() {
            let why = self.ended.unwrap_or("the arm was stopped");
            return Err(AdapterError::Rejected(format!("{why}: enable it again")));
        }
        Ok(())
    }

    /// Sends a setpoint. It replaces an earlier one that the program has not read yet. `Busy` while the program does
    /// not answer: a late setpoint must not follow a silence.
    pub fn stream(&mut self, order: Order) -> AdapterResult<()> {
        self.update(Duration::ZERO)?;
        self.may_be_commanded()?;
        let [e_series, cb3] = MAX_UNANSWERED;
        let most = if self.device.model.is_cb3() { cb3 } else { e_series };
        if self.unanswered.is_some_and(|since| MonotonicClock.now().since(since) > most) {
            return Err(AdapterError::Busy);
        }
        self.order(order)
    }

    /// Ends a stream of setpoints in another mode: the arm holds.
    pub fn hold(&mut self) -> AdapterResult<()> {
        if self.ready.is_some() && self.last != Order::Hold { self.order(Order::Hold) } else { Ok(()) }
    }

    /// Stops all motion, and ends the program. The arm stays stopped until it is activated. Confirmed by the program,
    /// which echoes the order in its registers, or by a later state with the joints at rest and no program that moves
    /// them.
    pub fn stop(&mut self) -> AdapterResult<Stop> {
        // While the program still runs: after that, nothing is known of what slows it.
        let limit = if self.crawls() { Duration::ZERO } else { STOP_LIMIT };
        (self.ready, self.ended) = (None, None);
        let sent = MonotonicClock.now();
        if self.rtde.takes_orders() {
            self.order(Order::Stop)?;
        }
        (self.unanswered, self.last) = (None, Order::Hold);
        let count = self.count;
        let done = |session: &mut Self| {
            let (state, measured) = session.state();
            let echoed = state.count == count && state.program >= program::STOPPED;
            let still = session.at_rest() && (!session.program_exists() || session.stopped.is_some());
            Ok((echoed || (still && measured > sent)).then_some(()))
        };
        if self.wait(limit, done)?.is_some() {
            return Ok(Stop::Confirmed);
        }
        // Another program, or ours does not run as it should.
        // The primary interface takes it at once and does not answer; the dashboard may be slow, or not there.
        let told = |primary: &mut Primary| !primary.read_only() && primary.run("stop program\n").is_ok();
        let told = self.primary.as_mut().is_some_and(told);
        let asked = self.panel().and_then(|mut panel| panel.order("stop", "stopped"));
        let asked = if told { Ok(()) } else { asked };
        let sent = MonotonicClock.now();
        let done = |session: &mut Self| {
            let still = session.at_rest() && !session.program_exists() && session.state().1 > sent;
            Ok(still.then_some(()))
        };
        match self.wait(DASHBOARD_LIMIT, done)? {
            Some(()) => Ok(Stop::Confirmed),
            None => asked.map(|()| Stop::Sent),
        }
    }
}

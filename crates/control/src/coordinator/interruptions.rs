//! Counts what interrupts the arms, and compares it with the origin of requests.

use super::Coordinator;
use crate::arm_control::ArmControl;
use crate::interruptions::Interruptions;
use crate::task::Task;
use crate::task_body::TargetKind;
use dimos_core::arm::Link;
use dimos_core::telemetry::{Cause, Interruption, Origin, Outcome, Phase, Reason, TaskState};

/// One arm's interruptions, and what they are noticed by.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Watched {
    known: Interruptions,
    /// The client that commands it, 0 for none.
    commander: u64,
    held: bool,
    connected: bool,
    powered: bool,
}

impl Watched {
    /// Takes the present state of the arm. Returns what has interrupted it since the last call.
    fn notice(&mut self, arm: &ArmControl) -> [Option<Interruption>; 3] {
        let state = arm.state();
        let connected = !matches!(state.link, Link::Down | Link::Faulted);
        let held = arm.failsafe.phase() == Phase::Held;
        let cause = arm.failsafe.cause();
        // Without a connection nothing is known of the motors.
        let powered = if connected { state.enabled } else { self.powered };
        let found = [
            (self.connected && !connected).then_some(Interruption::LinkLost),
            (self.powered && !powered).then_some(Interruption::PowerLost),
            // Each stop is counted with its request, also that of a held arm.
            (held && !self.held && cause != Cause::Operator).then_some(Interruption::Held(cause)),
        ];
        (self.held, self.connected, self.powered) = (held, connected, powered);
        found
    }
}

impl Coordinator {
    /// Begins an epoch for each interruption that an arm's state shows.
    pub(super) fn notice_interruptions(&mut self) {
        for i in 0..self.arms.len() {
            let (Some(arm), Some(watched)) = (self.arms.get(i), self.watched.get_mut(i)) else { continue };
            for interruption in watched.notice(arm).into_iter().flatten() {
                self.interrupt(i, interruption);
            }
        }
    }

    /// Begins an epoch: what was requested of an arm before no longer moves it.
    pub(super) fn interrupt(&mut self, arm: usize, interruption: Interruption) {
        if let Some(watched) = self.watched.get_mut(arm) {
            self.epoch += 1;
            watched.known.add(self.epoch, interruption);
        }
    }

    /// Takes the client that commands an arm. What others have requested before no longer moves the arm.
    pub(super) fn commanded_by(&mut self, arm: u16, client: u64) {
        let Some(watched) = self.watched.get_mut(usize::from(arm)) else { return };
        // The program that has started the run takes no leases.
        if client != 0 && watched.commander != client {
            watched.commander = client;
            self.interrupt(arm.into(), Interruption::LeaseTaken(client));
        }
    }

    /// A client no longer commands an arm: ends the chunks that it has sent, also one that waits for its start.
    pub(super) fn lease_ended(&mut self, arm: u16, client: u64) -> Outcome {
        if let Some(watched) = self.watched.get_mut(usize::from(arm)).filter(|watched| watched.commander == client) {
            watched.commander = 0;
        }
        self.interrupt(arm.into(), Interruption::LeaseEnded(client));
        let chunks_of = |task: &Task| task.takes(TargetKind::Chunk) && task.client == client;
        for t in 0..self.tasks.len() {
            if self.tasks.get(t).is_some_and(|task| task.is_active() && chunks_of(task) && self.moves(task, arm)) {
                self.end_task(t, TaskState::Aborted, Reason::LeaseEnded(arm));
            }
        }
        Outcome::Accepted
    }

    /// Returns an error if an arm was interrupted since a motion of it was requested.
    pub(super) fn still_valid(&self, arm: u16, origin: Option<Origin>) -> Result<(), Outcome> {
        let since = |origin| self.watched.get(usize::from(arm))?.known.since(origin);
        origin.and_then(since).map_or(Ok(()), |interruption| Err(Outcome::Superseded(arm, interruption)))
    }
}

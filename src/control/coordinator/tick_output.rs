//! Times and output of a tick.

use crate::arm::ArmCommand;
use crate::clock::Mono;
use crate::control::request::Motion;
use crate::control::speed_override::SpeedOverride;
use crate::telemetry::{ArmSample, Event, TaskView};

/// The times of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TickTime {
    /// Deadline of the tick, used as the current time.
    pub now: Mono,
    /// Deadline of the next tick.
    pub next: Mono,
    /// Whole periods skipped before this tick.
    pub skipped: u32,
    /// Lateness that caused the skip [ns].
    pub late_ns: u64,
    /// Wake-up after the deadline that this tick waited for [ns].
    pub woke_late_ns: u64,
}

/// Output of a tick. Reused from tick to tick.
#[derive(Debug)]
pub struct TickOutput {
    /// One command per arm.
    pub commands: Vec<ArmCommand>,
    /// One sample per arm.
    pub arms: Vec<ArmSample>,
    /// One view per task.
    pub tasks: Vec<TaskView>,
    /// The speed override.
    pub speed: SpeedOverride,
    /// Events of the tick.
    pub events: Vec<Event>,
    /// Motions that ended, to be freed on another thread.
    pub retired: Vec<Box<Motion>>,
    /// Number of events that did not fit.
    pub events_lost: u32,
}

impl TickOutput {
    /// Creates the output of this many arms and tasks, with room for events and for motions that end in one tick.
    pub(super) fn new(arms: usize, tasks: usize, events: usize, motions: usize) -> Self {
        Self {
            commands: vec![ArmCommand::default(); arms],
            arms: Vec::with_capacity(arms),
            tasks: vec![TaskView::default(); tasks],
            speed: SpeedOverride::default(),
            events: Vec::with_capacity(events),
            retired: Vec::with_capacity(motions),
            events_lost: 0,
        }
    }

    /// Reports an event, or counts it as lost: the tick does not allocate.
    pub(super) fn report(&mut self, event: Event) {
        if self.events.len() < self.events.capacity() {
            self.events.push(event);
        } else {
            self.events_lost = self.events_lost.saturating_add(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn events_that_do_not_fit_are_counted_and_nothing_is_allocated() {
        let mut output = TickOutput::new(1, 1, 3, 1);
        let room = output.events.capacity();
        for k in 0..room as u32 + 2 {
            output.report(Event::Overrun(k, 0));
        }
        assert_eq!((output.events.len(), output.events.capacity(), output.events_lost), (room, room, 2));
    }
}

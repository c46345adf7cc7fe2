//! Times and output of a tick.

use super::REQUESTS_PER_TICK;
use crate::request::Motion;
use crate::speed_override::SpeedOverride;
use dimos_core::arm::ArmCommand;
use dimos_core::clock::Mono;
use dimos_core::telemetry::{ArmSample, Event, TaskView};

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
    /// Number of interruptions of all arms so far.
    pub epoch: u64,
    /// Events of the tick.
    pub events: Vec<Event>,
    /// Motions that ended, to be freed on another thread.
    pub retired: Vec<Box<Motion>>,
    /// Number of events that did not fit.
    pub events_lost: u32,
}

impl TickOutput {
    /// Creates the output of this many arms, tasks and joints, with room for all that one tick reports and retires.
    pub(super) fn new(arms: usize, tasks: usize, joints: usize) -> Self {
        // Each request has an outcome and may change a task; arms, tasks and joints report a few events at most.
        let events = 2 * REQUESTS_PER_TICK + 6 * (arms + tasks) + 2 * joints;
        // Each task may end the motion that it has, and each request one more.
        let motions = 2 * tasks + REQUESTS_PER_TICK;
        Self {
            commands: vec![ArmCommand::default(); arms],
            arms: Vec::with_capacity(arms),
            tasks: vec![TaskView::default(); tasks],
            speed: SpeedOverride::default(),
            epoch: 0,
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
    fn there_is_room_for_a_few_events_of_each_arm_task_joint_and_request() {
        let room = |arms, tasks, joints| {
            let output = TickOutput::new(arms, tasks, joints);
            (output.events.capacity() - 2 * REQUESTS_PER_TICK, output.retired.capacity() - REQUESTS_PER_TICK)
        };
        assert_eq!(room(2, 0, 0), (12, 0));
        assert_eq!(room(0, 3, 0), (18, 6));
        assert_eq!(room(2, 3, 13), (12 + 18 + 26, 6));
    }

    #[test]
    fn events_that_do_not_fit_are_counted_and_nothing_is_allocated() {
        let mut output = TickOutput::new(1, 1, 3);
        let room = output.events.capacity();
        for k in 0..room as u32 + 2 {
            output.report(Event::Overrun(k, 0));
        }
        assert_eq!((output.events.len(), output.events.capacity(), output.events_lost), (room, room, 2));
    }
}

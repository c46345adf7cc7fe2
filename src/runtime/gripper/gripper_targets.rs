//! Gripper targets of streams and chunks. They are commanded at their times by the outcome thread, as ordinary gripper
//! commands at a bounded rate: the newest one that is due wins.

use std::collections::VecDeque;
use std::time::Duration;

use crate::runtime::client::dispatch::log_of;
use crate::runtime::client::tick_link::EachTick;
use crate::runtime::{Service, internal};
use dimos_control::request::Request;
use dimos_core::arm::GripperUnit;
use dimos_core::clock::Mono;
use dimos_core::sync::lock;
use dimos_core::telemetry::{Origin, Outcome, TaskState};
use dimos_rpc::{Code, RpcError};

/// Least time between two commands to a gripper.
const PERIOD: Duration = Duration::from_millis(50);
/// Part of the range by which a target differs from the last command to be commanded.
const SAME: f64 = 0.005;
/// Time for a task to begin to execute its first target.
const BEGINS: Duration = Duration::from_millis(500);

/// Pending gripper targets of an arm.
#[derive(Default)]
pub struct GripperTargets {
    /// The task whose stream they are of, and when it sent the latest.
    task: u16,
    origin: Origin,
    sent: Mono,
    /// Time and position [m or rad], in order of time.
    ahead: VecDeque<(Mono, f64)>,
    /// The newest target that is due, until it is commanded.
    due: Option<f64>,
    commanded: Option<f64>,
    not_before: Mono,
    /// While any is pending, every tick wakes the thread that commands them.
    each_tick: Option<EachTick>,
}

impl GripperTargets {
    /// Replaces the targets from the first of `targets` on.
    fn splice(&mut self, targets: impl Iterator<Item = (Mono, f64)>) {
        let mut targets = targets.peekable();
        if let Some((start, _)) = targets.peek() {
            self.ahead.retain(|(time, _)| time < start);
        }
        self.ahead.extend(targets);
    }

    fn is_pending(&self) -> bool {
        self.due.is_some() || !self.ahead.is_empty()
    }

    fn clear(&mut self) {
        self.ahead.clear();
        (self.due, self.commanded) = (None, None);
    }

    /// Returns the position to command now, if any; positions closer than `same` are not commanded again.
    fn next(&mut self, now: Mono, same: f64) -> Option<f64> {
        while let Some((_, position)) = self.ahead.pop_front_if(|(time, _)| *time <= now) {
            self.due = Some(position);
        }
        let due = self.due.filter(|_| now >= self.not_before)?;
        self.due = None;
        if self.commanded.is_some_and(|last| (last - due).abs() <= same) {
            return None;
        }
        (self.commanded, self.not_before) = (Some(due), now.after(PERIOD));
        Some(due)
    }
}

impl Service {
    /// Checks the gripper targets of a stream to a task: the arm of its joints has a gripper, and they are within its
    /// range. Returns the arm.
    pub(in crate::runtime) fn check_gripper_targets(&self, task: u16, targets: &[f64]) -> Result<u16, RpcError> {
        let joints = self.facts.config.tasks.get(task as usize).map(|task| task.joints.as_slice()).unwrap_or_default();
        let mut arms = joints.iter().filter_map(|joint| self.facts.locate(*joint)).map(|(arm, _)| arm as u16);
        let arm = arms.next().ok_or_else(internal)?;
        if arms.any(|other| other != arm) {
            let what =
                format!("task {} has joints of several arms: whose gripper is meant?", self.facts.names.task(task));
            return Err(RpcError::new(Code::InvalidParams, what).hint("send gripper targets to a task of one arm"));
        }
        let Some(info) = self.facts.gripper_info(arm.into()) else {
            return Err(self.refusal(&Outcome::NoGripper(arm)).unwrap_or_else(internal));
        };
        let (closed, open) = info.range.unwrap_or((f64::NEG_INFINITY, f64::INFINITY));
        let range = closed.min(open)..=closed.max(open);
        match targets.iter().find(|target| !(range.contains(target) && info.unit.has(**target))) {
            Some(wrong) => {
                let (unit, name) = (info.unit.name(), self.facts.names.arm(arm));
                let what = match info.unit {
                    GripperUnit::OnOff => format!("the gripper of {name} only closes (0) and opens (1), not {wrong}"),
                    _ => format!("the gripper of {name} goes from {closed} to {open} {unit}, not to {wrong} {unit}"),
                };
                Err(RpcError::new(Code::OutOfLimits, what).hint("`dimos status` shows its range"))
            }
            None => Ok(arm),
        }
    }

    /// Takes gripper targets of a stream, `period` apart from `start` on; those whose time is over are dropped. They
    /// replace what is pending from the first of them on. Returns how many were dropped.
    pub(in crate::runtime) fn take_gripper_targets(
        &self,
        (task, origin): (u16, Origin),
        arm: u16,
        start: Mono,
        period: f64,
        targets: &[f64],
    ) -> usize {
        let now = self.now();
        let at = |k: usize| start.after(Duration::from_secs_f64(k as f64 * period));
        // A single target is for now.
        let late = (0..targets.len()).take_while(|k| targets.len() > 1 && at(*k) < now).count();
        self.streams.count_gripper_targets(task, targets.len(), late);
        let Some(pending) = self.grippers.targets.get(arm as usize) else { return late };
        let mut pending = lock(pending);
        (pending.task, pending.origin, pending.sent) = (task, origin, now);
        pending.splice(targets.iter().enumerate().skip(late).map(|(k, target)| (at(k), *target)));
        pending.each_tick = pending.is_pending().then(|| self.tick.each_tick());
        late
    }

    /// Commands the gripper targets that are due. Those of a stream that has ended are dropped.
    pub fn command_gripper_targets(&self) {
        for ((arm, pending), info) in (0..).zip(&self.grippers.targets).zip(&self.facts.connected) {
            let mut pending = lock(pending);
            if !pending.is_pending() {
                continue;
            }
            let now = self.now();
            let runs = self.tick.task_view(pending.task as usize).state == TaskState::Executing;
            if !runs && now.since(pending.sent) > BEGINS || self.lifecycle.is_closed() {
                pending.clear();
            }
            let range = info.gripper.and_then(|gripper| gripper.range);
            let same = range.map_or(0.0, |(closed, open)| SAME * (open - closed).abs());
            // Paused, the gripper waits as the joints do.
            let next = if self.tick.speed_override().paused { None } else { pending.next(now, same) };
            if let Some(opening) = next {
                let request = Request::Gripper { arm, opening, force: None, speed: None };
                let log = log_of(&request);
                // A refusal is in the log; the next target tries again.
                if self.tick.dispatcher().send_from(request, Some(pending.origin), log).is_err() {
                    pending.commanded = None;
                }
            }
            if !pending.is_pending() {
                pending.each_tick = None;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> Mono {
        Mono(ms * 1_000_000)
    }

    #[test]
    fn the_newest_target_that_is_due_is_commanded_at_a_bounded_rate() {
        let mut targets = GripperTargets::default();
        targets.splice((0..10).map(|k| (at(100 + 10 * k), 0.01 * k as f64)));
        assert_eq!(targets.next(at(99), 1e-4), None, "its time has not come");
        assert_eq!(targets.next(at(125), 1e-4), Some(0.02), "the newest of three");
        assert_eq!(targets.next(at(165), 1e-4), None, "50 ms after the last");
        assert_eq!(targets.next(at(175), 1e-4), Some(0.07));
        assert_eq!(targets.next(at(190), 1e-4), None);
        assert!(targets.is_pending(), "the last one still waits");
        assert_eq!(targets.next(at(225), 1e-4), Some(0.09));
        assert!(!targets.is_pending());
    }

    #[test]
    fn a_new_chunk_replaces_the_targets_from_its_start_on() {
        let mut targets = GripperTargets::default();
        targets.splice((0..10).map(|k| (at(100 * k), 0.0)));
        targets.splice([(at(250), 0.05), (at(350), 0.06)].into_iter());
        let all: Vec<_> = (0..10).filter_map(|k| targets.next(at(100 * k), 0.0)).collect();
        assert_eq!(all, [0.0, 0.05, 0.06], "the rest of the first chunk is gone, the same target is commanded once");
    }
}

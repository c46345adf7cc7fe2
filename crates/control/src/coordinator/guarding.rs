//! The collision guard in the tick: between the limiters and the commands.

use super::Coordinator;
use crate::guard::{GuardWorld, Movement, Verdict};
use crate::task_body::TargetKind;
use dimos_core::telemetry::{Event, Reason, TaskState};

impl Coordinator {
    /// Replaces the robots and obstacles of the collision guard; `None`: nothing is guarded. Returns the ones before,
    /// to be freed on another thread.
    pub fn set_guard(&mut self, world: Option<Box<GuardWorld>>) -> Option<Box<GuardWorld>> {
        self.guard.set_world(world)
    }

    /// Gives the verdict of the guard in the next tick on an arm: for replays, which lack its world. It applies until
    /// the next one.
    pub fn replay_guard(&mut self, arm: u16, verdict: Verdict) {
        self.guard.give(arm, verdict);
    }

    /// Decelerates the arms whose way to rest from the next setpoints is not proven free.
    pub(super) fn guard(&mut self) {
        let dt = self.period;
        if self.guard.decides() {
            for (i, arm) in self.arms.iter().enumerate() {
                let (mut streams, mut executes) = (false, false);
                for joint in arm.first()..arm.first() + arm.config().dof {
                    let winner = self.arbiter.winner(joint).and_then(|(task, _)| self.tasks.get(usize::from(task)));
                    let trajectory = winner.map(|task| task.takes(TargetKind::Trajectory));
                    streams |= trajectory == Some(false);
                    executes |= trajectory == Some(true);
                }
                self.guard.set(
                    i,
                    match (streams, executes) {
                        _ if !arm.is_placed() => Movement::Unknown,
                        (true, _) => Movement::Stream,
                        (_, true) => Movement::Trajectory,
                        _ => Movement::Other,
                    },
                );
            }
            let (arms, arm_of) = (&self.arms, &self.arm_of);
            let step = |joint: u16, braking: u64| {
                let index = arm_of.get(usize::from(joint)).copied().unwrap_or(u16::MAX);
                let arm = arms.get(usize::from(index))?;
                Some(arm.step(usize::from(joint).checked_sub(arm.first())?, braking >> index & 1 == 1, dt))
            };
            let at_rest = |i: usize| arms.get(i).is_some_and(|arm| arm.was_at_rest());
            self.guard.judge(dt, step, at_rest);
        }
        for i in 0..self.arms.len() {
            if let Some(verdict) = self.guard.change(i) {
                self.output.report(Event::Guard(i as u16, verdict));
            }
            if self.guard.blocked(i as u16).is_some() {
                self.block(i);
            }
        }
    }

    /// Decelerates an arm. Its streams continue, its trajectories end.
    fn block(&mut self, index: usize) {
        let Some(arm) = self.arms.get_mut(index) else { return };
        arm.brake(self.period);
        let (first, dof) = (arm.first(), arm.config().dof);
        for joint in first..first + dof {
            let Some((winner, _)) = self.arbiter.winner(joint) else { continue };
            let Some(task) = self.tasks.get_mut(usize::from(winner)) else { continue };
            task.granted = false;
            if task.takes(TargetKind::Trajectory) && task.is_active() {
                self.end_task(usize::from(winner), TaskState::Aborted, Reason::Guarded(index as u16));
            }
        }
    }
}
